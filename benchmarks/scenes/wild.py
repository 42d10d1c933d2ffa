"""The room photographed as life does it, in linear light, with everything about each photo known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes.exposure import render_exposure, shaken, through_lens
from benchmarks.scenes.room.scene import FOCUS, HEIGHT, WIDTH, embedded_scene, keep, kept
from benchmarks.scenes.shake import draw_path, draw_strength, knots_mean, path_extent, path_length
from hqgs.photos.formula import Kind
from hqgs.scene.scene import Camera, Scene

Floats = NDArray[np.float64]

TRUE_KINDS = {
    "true-shake": Kind(0.5, 100, "the longest extent of a shake in px", at_504=12.0),
    "true-defocus": Kind(0.5, 20, "the largest radius in px of a point at infinity", at_504=4.0),
}
DISTANCE = FOCUS[2]  # at which translations and lenses have the stated effect, world units
TURNS, MOVES = 0.75, 0.25  # shares of a path's extent: turns up, down and sideways; each other freedom
NEAREST, FARTHEST = 2.5, 8.0  # between which photos are focused, world units
SHAKE_SAMPLES = (12, 96)  # at least and at most, rays a pixel
LENS_SAMPLES = (16, 64)


class PhotoTruth(NamedTuple):
    """How one photo was made; what does not concern its kind has its neutral value.

    The photo's camera in the scene is the one of the mean of the path.
    """

    extent: float = 0.0  # px, of the path of the picture's centre at DISTANCE, to first order
    path: Floats = np.zeros((4, 6))  # knots as `path_viewmats` takes them
    aperture: float = 0.0  # radius of the lens, world units
    focus: float = math.inf  # depth in focus, world units
    samples: int = 1  # rays a pixel

    def record(self, kind: str) -> dict[str, Any]:
        """The same as JSON values, without what is neutral."""
        facts: dict[str, Any] = {"kind": kind}
        if self.extent:
            facts |= {"extent": self.extent, "path": self.path.tolist()}
        if self.aperture:
            facts |= {"aperture": self.aperture, "focus": self.focus}
        return facts


class WildRoom(NamedTuple):
    """A scene and its truth."""

    scene: Scene  # photos to train on as the kind has made them; held-out ones clean
    clean: Scene  # the same with clean photos to train on
    truth: dict[str, PhotoTruth]  # of each training photo, by name


def wild_room(
    kind: str,
    seed: int = 0,
    cache: Path | None = None,
    width: int = WIDTH,
    height: int = HEIGHT,
    num_views: int = 24,
) -> WildRoom:
    """`embedded_scene` with training photos that a camera has truly taken so, by ray casting.

    Kinds, each with a value of its own or without one (px are for a width of 504 and scale with it):

    - `true-shake[:PX]` (12): the mean over the exposure while the camera turns and moves in all six freedoms
      along the smooth path of `path_viewmats`. Its knots are drawn as those of `shake` (`draw_path`): turns
      up, down and sideways carry 0.75 of the extent, and 0.25 of it each: moves up, down and sideways (at
      DISTANCE), a roll, and a move forwards (both at a corner). The extent of the centre's path at DISTANCE
      is uniform in [0.2, 1] PX. The mean of the path is the photo's pose.
    - `true-defocus[:R]` (4): a thin lens. Its radius makes a point at infinity a disc of radius r px when it
      is focused at DISTANCE, r uniform in [0.2, 1] R; the focus of each photo is uniform in 1/z between
      depths of 2.5 and 8.

    All is averaged in linear light; the camera's curve (`render_exposure`) comes last, then 8 bits. Each
    photo has a generator of its own from the seed and its place among all names. Points and poses are those
    of the clean photos. `cache` keeps the clean scene and the photos of each kind and seed in folders of
    their own. ValueError for an unknown kind, its value, a negative seed, or as `embedded_scene`.
    """
    name, value = parse_true_kind(kind, width)
    if seed < 0:
        raise ValueError(f"seed is {seed}, wanted at least 0")
    clean = embedded_scene(None if cache is None else cache / "clean", width, height, num_views)
    names = sorted(view.name for view in (*clean.train, *clean.test))
    truth = {
        view.name: _draw(name, value, view.camera, np.random.default_rng([seed, names.index(view.name)]))
        for view in clean.train
    }
    made = {"kind": name, "value": value, "seed": seed, "size": [width, height], "num_views": num_views}
    file = None if cache is None else cache / f"{name}_{value:g}_{seed}.npz"
    photos = None if file is None else kept(file, made)
    if photos is None:
        photos = {view.name: taken(name, view.camera, truth[view.name]) for view in clean.train}
        if file is not None:
            keep(file, made, photos)
    note = (
        f"photographed with {name}:{value:g}, seed {seed}: all training photos ({len(clean.train)}), "
        f"ray-cast in linear light; held-out photos ({len(clean.test)}) are clean; points and poses are exact"
    )
    train = [replace(view, image=photos[view.name]) for view in clean.train]
    return WildRoom(replace(clean, train=train, notes=[*clean.notes, note]), clean, truth)


def parse_true_kind(text: str, width: int = WIDTH) -> tuple[str, float]:
    """A kind of `wild_room` and its value for this width. ValueError names the kinds and values there are."""
    name, colon, number = text.partition(":")
    if name not in TRUE_KINDS:
        raise ValueError(f"unknown kind {text!r}; the room has: {', '.join(TRUE_KINDS)}")
    kind = TRUE_KINDS[name]
    if not colon:
        return name, (kind.at_504 or 0) * width / WIDTH
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not kind.lowest <= value <= kind.highest:
        raise ValueError(f"{name} is {number}, wanted {kind.unit}, {kind.lowest:g}..{kind.highest:g}")
    return name, value


def taken(kind: str, camera: Camera, truth: PhotoTruth) -> NDArray[np.uint8]:
    """The photo that the truth stands for."""
    if kind == "true-shake":
        return render_exposure(shaken(camera, truth.path, truth.samples))
    return render_exposure(through_lens(camera, truth.aperture, truth.focus, truth.samples))


def _draw(kind: str, value: float, camera: Camera, rng: np.random.Generator) -> PhotoTruth:
    strength, focal = value * draw_strength(rng), camera.K[0, 0]
    if kind == "true-defocus":
        aperture = strength * DISTANCE / focal
        focus = 1 / rng.uniform(1 / FARTHEST, 1 / NEAREST)
        widest = focal * aperture * max(abs(1 / z - 1 / focus) for z in (NEAREST, 2 * FARTHEST))
        samples = int(np.clip(math.ceil(math.pi * widest**2 / 2), *LENS_SAMPLES))  # one for 2 px of the disc
        return PhotoTruth(aperture=aperture, focus=focus, samples=samples)
    knots = _draw_knots(camera, strength, rng)
    length = path_length(_picture_path(camera, knots))
    samples = int(np.clip(math.ceil(1.5 * length), *SHAKE_SAMPLES))
    return PhotoTruth(extent=strength, path=knots, samples=samples)


def _draw_knots(camera: Camera, extent: float, rng: np.random.Generator) -> Floats:
    """Knots [4, 6] of a path in all freedoms, of mean 0, that moves the centre at DISTANCE by `extent` px."""
    focal = camera.K[0, 0]
    corner = math.hypot(camera.width, camera.height) / 2  # px from the centre
    turn, move, others = draw_path(rng, TURNS), draw_path(rng, MOVES), draw_path(rng, MOVES)
    knots = np.zeros((4, 6))
    # A camera that turns by w about x and y moves the picture by focal (w_y, -w_x) px.
    knots[:, 0], knots[:, 1], knots[:, 2] = -turn[:, 1] / focal, turn[:, 0] / focal, others[:, 0] / corner
    knots[:, 3:5] = move * DISTANCE / focal
    knots[:, 5] = others[:, 1] * DISTANCE / corner
    knots *= extent / path_extent(_picture_path(camera, knots))
    return knots - knots_mean(knots)


def _picture_path(camera: Camera, knots: Floats) -> Floats:
    """Knots [4, 2] in px of the path of the picture's centre at DISTANCE, to first order."""
    turn = np.stack([knots[:, 1], -knots[:, 0]], -1)
    return camera.K[0, 0] * (turn + knots[:, 3:5] / DISTANCE)
