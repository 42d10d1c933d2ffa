"""How far to believe each pixel of a new view: residuals of the training photos, carried by the Gaussians.

A Gaussian gets the error of the pixels that it shows in: u of the model w u = |photo - render| over the
pixels of all photos, w the blending weights, by expectation maximisation (Richardson 1972, Lucy 1974), which
keeps u above 0. Rendered as a channel, u is what the photos say of a new pixel; what no photo saw keeps a
prior. After GS-U and PRIMU (2508.02443), with one value for all directions and one curve for all scenes:
more features and a fit for each scene did not pay (docs/log.md). One factor on u is fitted for each run, to
the photos that it held out (`calibrated`): scenes learn their training photos by heart in different degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from hqgs.base.evenly import evenly
from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.scene.camera_files import KnownCamera, RunCameras
from hqgs.scene.geometry import resized_camera
from hqgs.scene.scene import Camera

WORST_SHOWN = 64.0  # levels of 255, of the brightest or reddest pixel of a map of errors
PHOTOS, SIDE = 64, 400  # training photos that are looked at, at most; px, of their longer side
PRIOR = 0.1  # error of a Gaussian (white is 1), as of one pixel's weight
EMPTY = 0.3  # error of what is behind everything
FLOOR = 0.002  # keeps ratios of errors finite: half a level
POWER, SCALE = 0.70, 0.52  # from what is carried to what SHARE of new pixels stay below: of three scenes
SHARE = 0.9  # of the pixels: what a bound promises
Array = NDArray[np.float32]


@dataclass(frozen=True)
class Held:
    """A held-out photo against its render, with what the training photos say of its pixels, [H, W]."""

    name: str
    camera: Camera
    error: Array  # mean of the channels, white is 1
    carried: Array  # before calibration
    alpha: Array
    counts: NDArray[np.bool_]  # by the photo's mask

    def flat(self, values: Array) -> Array:
        """Those of the pixels that count."""
        return values[self.counts]

    def needed(self) -> NDArray[np.floating]:
        """The factor on what is carried at which each pixel's bound meets its error, flat."""
        known = np.minimum(self.error, (self.error / SCALE) ** (1 / POWER) - FLOOR)
        return ((known - EMPTY * (1 - self.alpha)) / np.maximum(self.carried, 1e-6))[self.counts]


@dataclass(frozen=True)
class Trust:
    """What the photos say of each Gaussian, by `learn_trust`."""

    gaussians: Gaussians
    errors: Tensor  # [N], mean over the channels, white is 1; calibrated
    factor: float = 1.0  # by which the errors were calibrated
    held: tuple[Held, ...] = ()  # what calibrated them

    def bound(self, camera: Camera) -> Array:
        """Levels of 255 that a pixel's error, the mean of its channels, stays below 9 times of 10, [H, W].

        Of photos that are blurred or noisy, it is the distance from such photos.
        """
        return bound_of(*blended(self.gaussians, camera, self.errors))


def blended(gaussians: Gaussians, camera: Camera, values: Tensor) -> tuple[Array, Array]:
    """Values of the Gaussians, [N], blended as colours are, and alpha, both [H, W]."""
    with one_torch_thread(), torch.no_grad():
        near = gaussians.near_plane()
        pictures, alpha, _ = gaussians.rasterize(camera, values[:, None], near_plane=near)
    return pictures[0, ..., 0].numpy(), alpha[0, ..., 0].numpy()


def bound_of(carried: Array, alpha: Array) -> Array:
    """Levels of 255."""
    known = carried + EMPTY * (1 - alpha)
    return (255 * np.maximum(known, SCALE * (known + FLOOR) ** POWER)).clip(0, 255)


def calibrated(held: Sequence[Held]) -> float:
    """The factor on what is carried at which SHARE of the photos' pixels stay below their bound. 1 without a
    photo."""
    if not held:
        return 1.0
    return max(float(np.quantile(np.concatenate([one.needed() for one in held]), SHARE)), 0.0)


def trust_of(gaussians: Gaussians, known: RunCameras | None) -> Trust:
    """Of a run's photos; or without them, what the file of the Gaussians says. ValueError without either."""
    if gaussians.errors is not None and not has_photos(known):
        return Trust(gaussians, gaussians.errors)
    return learn_trust(gaussians, known or RunCameras(np.zeros(3), []))


def has_photos(known: RunCameras | None) -> bool:
    """Whether there are training photos to learn from."""
    return known is not None and any(shows(view) for view in known.views if not view.held_out)


def learn_trust(gaussians: Gaussians, known: RunCameras) -> Trust:
    """What the photos of a run, in its folder, say of its Gaussians.

    The errors are those of at most PHOTOS training photos, the factor is that of up to 40 others.
    ValueError where the run has no training photo.
    """
    views = [view for view in known.views if not view.held_out and shows(view)]
    if not views:
        raise ValueError("trust needs the photos of a run: give its folder, with cameras.json and photos/")
    n = len(gaussians)
    sums = torch.zeros(n, 2)  # of weights, and of weights times errors
    with one_torch_thread():
        looks = [error_of(gaussians, views[k], known.background) for k in evenly(len(views), PHOTOS)]
        for camera, error, counts in looks:
            pixels = torch.stack([counts.float(), error], -1)
            sums += _back(gaussians, camera, torch.zeros(n, 2), pixels)
        weights = sums[:, 0] + 1
        errors = (sums[:, 1] + PRIOR) / weights
        for _ in range(4):  # more change the order of the pixels by less than its scatter
            found = torch.zeros(n)
            for camera, error, counts in looks:
                found += _back(gaussians, camera, errors[:, None], error[..., None], counts)[:, 0]
            errors = (errors * found + PRIOR) / weights
    out, held = [view for view in known.views if view.held_out and shows(view)], list[Held]()
    for view in (out[k] for k in evenly(len(out), 40)):
        camera, error, counts = error_of(gaussians, view, known.background)
        if counts.any():
            seen = blended(gaussians, camera, errors)
            held.append(Held(view.name, camera, error.numpy(), *seen, counts.numpy()))
    factor = calibrated(held)
    return Trust(gaussians, factor * errors, factor, tuple(held))


def _back(
    gaussians: Gaussians, camera: Camera, values: Tensor, pixels: Tensor, counts: Tensor | None = None
) -> Tensor:
    """For each Gaussian [N, D] the sum over pixels [H, W, D] of its weight times the pixel; or, where the
    pixels of `counts` [H, W] alone count, times the pixel over what the values [N, D] render to there."""
    values = values.clone().requires_grad_()
    render = gaussians.rasterize(camera, values, near_plane=gaussians.near_plane())[0][0]
    if counts is not None:
        pixels = (pixels + FLOOR) / (render.detach() + FLOOR) * counts[..., None]
    (render * pixels).sum().backward()  # one number: for a picture torch would import sympy, for seconds
    assert values.grad is not None
    return values.grad


@torch.no_grad()
def error_of(
    gaussians: Gaussians, view: KnownCamera, background: tuple[float, float, float]
) -> tuple[Camera, Tensor, Tensor]:
    """Of a photo against its render, small: the camera, the error [H, W], mean of the channels, white is 1,
    and 0 where the mask hides the photo; and where it counts, [H, W]."""
    assert view.photo is not None
    with Image.open(view.photo) as file:
        picture = file.convert("RGB")
    picture.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
    camera = resized_camera(view.camera, picture.width, picture.height)
    counts = torch.from_numpy(counted(view, picture.size))
    render = gaussians.render(camera, background=background).clamp(0, 1)
    off = (render - torch.from_numpy(np.array(picture)).float() / 255) * counts[..., None]
    return camera, off.abs().mean(-1), counts


def shows(view: KnownCamera) -> bool:
    """Whether its photo is there, and its mask leaves something of it."""
    if view.photo is None or view.mask is None:
        return view.photo is not None
    with Image.open(view.mask) as file:
        return bool(counted(view, file.size).any())


def counted(view: KnownCamera, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Where the photo counts, at a size (width, height), [H, W]."""
    if view.mask is None:
        return np.ones(size[::-1], bool)
    with Image.open(view.mask) as file:
        return np.array(file.convert("L").resize(size, Image.Resampling.BOX)) == 255


@dataclass(frozen=True)
class Measured:
    """A map of trust against the held-out photos of its run, over all of their pixels.

    Each photo is judged by a calibration on the others; a single one by none.
    """

    photos: int
    covered: float  # share of the pixels whose error stays below its bound; 0.9 was promised
    ause: float  # area between the sparsification curves of trust and of the true error, over the mean error

    def __str__(self) -> str:
        return (
            f"on {self.photos} held-out photo{'s' * (self.photos > 1)} {100 * self.covered:.1f} % of the "
            f"pixels stay below their bound; AUSE {self.ause:.3f}"
        )


def measure_trust(trust: Trust) -> Measured | None:
    """None where the run has no held-out photo."""
    held, below, areas = trust.held, list[NDArray[np.bool_]](), list[float]()
    if not held:
        return None
    for k, one in enumerate(held):
        factor = calibrated([*held[:k], *held[k + 1 :]])
        bound, error = one.flat(bound_of(factor * one.carried, one.alpha)), 255 * one.flat(one.error)
        below.append(error <= bound)
        areas.append(_ause(bound, error))
    return Measured(len(held), float(np.concatenate(below).mean()), float(np.mean(areas)))


def _ause(doubt: Array, error: Array) -> float:
    """Area under the mean error of the pixels least in doubt, over all shares of them, less that of those
    with the least error, over the mean of all."""

    def curve(key: Array) -> NDArray[np.float64]:
        sums = error[np.argsort(key, kind="stable")].cumsum(dtype=np.float64)
        ends = np.linspace(0, len(error), 50 + 1)[1:].astype(int).clip(1)
        return sums[ends - 1] / ends

    return float((curve(doubt) - curve(error)).mean() / max(float(error.mean()), 1e-9))
