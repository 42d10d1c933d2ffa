"""Photos that were focused each in its own way: the lens, the signs of it, and what is learned."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from test_learned_cameras import textured_scene, trained

import hqgs
from benchmarks.scenes.wild import wild_room
from hqgs.diagnosis import focus
from hqgs.diagnosis.focus import DIFFERS, GOES_WITH_DEPTH, focus_signs
from hqgs.photos.formula import parse_formation
from hqgs.scene.geometry import median_depth
from hqgs.scene.scene import Scene
from hqgs.training.methods.cameras import lens_warps, samples, sharp_at, take_photo, widest

SIDE, MARGIN = 41, 8


@pytest.mark.parametrize(("slope", "offset", "near"), [(0.0, 4.0, 1.0), (3.0, -1.0, 2.0), (-2.0, 6.0, 0.5)])
def test_a_point_becomes_a_disc_of_its_radius(slope: float, offset: float, near: float) -> None:
    lens, nearness = torch.tensor([slope, offset]).double(), torch.full((SIDE, SIDE), near).double()
    render = torch.zeros(SIDE + 2 * MARGIN, SIDE + 2 * MARGIN, 3, dtype=torch.float64)
    middle = SIDE // 2 + MARGIN
    render[middle, middle] = 1
    ones = torch.ones(3, dtype=torch.float64)
    photo = take_photo(render, (SIDE, SIDE), nearness, lens_warps(lens, 24), ones)
    light = np.where(photo <= 0.04045, photo / 12.92, ((photo + 0.055) / 1.055) ** 2.4)[..., 0]
    at = np.arange(SIDE) - SIDE // 2
    assert light.sum() == pytest.approx(1, abs=1e-9)
    for axis in (0, 1):
        spread = light.sum(axis)
        assert spread @ at == pytest.approx(0, abs=1e-9)
        # A disc's variance along a line is r^2 / 4; linear interpolation adds up to 1/4.
        variance = abs(slope * near + offset) ** 2 / 4
        assert variance * 0.8 <= spread @ at**2 <= variance * 1.2 + 0.25


def test_a_photo_in_focus_stays_as_it_is() -> None:
    lens = torch.tensor([3.0, -6.0]).double()  # in focus at twice the nearness of the median depth
    generator = torch.Generator().manual_seed(0)
    render = torch.rand(SIDE + 2 * MARGIN, SIDE + 2 * MARGIN, 3, generator=generator, dtype=torch.float64)
    near = torch.full((SIDE, SIDE), 2.0).double()
    photo = take_photo(render, (SIDE, SIDE), near, lens_warps(lens, 8), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(photo, render[MARGIN:-MARGIN, MARGIN:-MARGIN], atol=1e-9, rtol=0)


def test_what_a_lens_says() -> None:
    assert widest(2.0, -1.0) == 3.0  # at nearness 2
    assert widest(1.0, -2.0) == pytest.approx(1.7)  # at nearness 0.3
    assert sharp_at(2.0, -1.0) == 2.0
    assert sharp_at(0.0, 1.0) is None
    assert sharp_at(0.1, -1.0) is None  # nearer than all that photos show
    assert samples(torch.tensor([0.0, 0.1])) < samples(torch.tensor([0.0, 3.0])) <= 24


def at_two_depths(scene: Scene) -> Scene:
    """All photos the same one; points in its left half are at depth 1, those in the right half at 3."""
    photo, camera = scene.train[0].image, scene.train[0].camera
    rng, side = np.random.default_rng(0), camera.width
    pixels = rng.uniform(6, side - 6, (600, 2))
    depths = np.where(pixels[:, 0] < side / 2, 1.0, 3.0)
    points = np.concatenate([(pixels - side / 2) / side, np.ones((600, 1))], 1) * depths[:, None]
    points -= camera.viewmat[:3, 3]
    train = [replace(view, camera=camera, image=photo) for view in scene.train]
    seen = {view.name: np.arange(600) for view in train}
    colors = np.full((600, 3), 128, np.uint8)
    return replace(scene, train=train, points=points.astype(np.float32), point_colors=colors, seen=seen)


def softer(scene: Scene, sigmas: list[tuple[float, float]]) -> Scene:
    """Each photo blurred by its two sigmas, in its left and its right half."""
    train = []
    for view, pair in zip(scene.train, sigmas, strict=True):
        left, right = (_blurred(view.image, sigma) for sigma in pair)
        half = view.image.shape[1] // 2
        train.append(replace(view, image=np.concatenate([left[:, :half], right[:, half:]], 1)))
    return replace(scene, train=train)


def _blurred(image: NDArray[Any], sigma: float) -> NDArray[Any]:
    return gaussian_filter(image, (sigma, sigma, 0)) if sigma else image


def test_what_photos_tell_of_their_focus() -> None:
    scene = at_two_depths(textured_scene())
    count = len(scene.train)
    clean = focus_signs(scene)
    assert clean == (0.0, 0.0)
    near_or_far = [(0.0, 1.0) if k % 2 else (1.0, 0.0) for k in range(count)]
    lens = focus_signs(softer(scene, near_or_far))
    assert lens is not None
    assert lens[0] > GOES_WITH_DEPTH
    some = focus_signs(softer(scene, [(1.5, 1.5) if k % 2 else (0.0, 0.0) for k in range(count)]))
    assert some is not None
    with_depth, in_all = some
    assert in_all > DIFFERS
    assert with_depth < GOES_WITH_DEPTH
    alike = focus_signs(softer(scene, [(1.5, 0.0)] * count))
    assert alike is not None
    assert max(alike) < GOES_WITH_DEPTH / 2


def test_large_photos_are_looked_at_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = at_two_depths(textured_scene())
    scene = softer(scene, [(0.0, 3.0) if k % 2 else (3.0, 0.0) for k in range(len(scene.train))])
    monkeypatch.setattr(focus, "FOCUS_LARGEST", 48)
    found = focus_signs(scene)
    assert found is not None
    assert found[0] > GOES_WITH_DEPTH


def test_few_shared_points_tell_nothing() -> None:
    scene = at_two_depths(textured_scene())
    assert focus_signs(replace(scene, seen=None)) is None
    assert focus_signs(replace(scene, seen={v.name: np.arange(20) for v in scene.train})) is None
    assert focus_signs(replace(scene, train=scene.train[:4])) is None


@pytest.mark.parametrize(
    ("kind", "needed"),
    [("none", False), ("some:noise:10", False), ("some:jpeg:20", False), ("some:defocus:2", True)],
)
def test_the_diagnosis_names_it(kind: str, needed: bool) -> None:
    diagnosis = hqgs.diagnose(hqgs.degrade(textured_scene(), kind))
    assert {part.name: part.needed for part in diagnosis.parts}["focus"] == needed
    assert ("focus" in diagnosis.formation) == needed
    assert (
        not needed
        or "differs from photo to photo" in dict((n, why) for n, _, why in diagnosis.needs())["blur"]
    )


def test_lenses_are_learned_and_the_scene_gets_sharper() -> None:
    room = wild_room("true-defocus:4", 0, None, 112, 84, num_views=12)
    plain, learned = trained(room.scene, "none"), trained(room.scene, "focus")
    true, found = [], []
    for view, photo in zip(room.scene.train, learned.method.learned(), strict=True):
        made = room.truth[view.name]
        disc = view.camera.K[0, 0] * made.aperture  # px, of a point at distance 1 that is focused at infinity
        slope, offset = disc / median_depth(room.scene, view), -disc / made.focus
        true += [abs(slope * near + offset) for near in (0.5, 1.7)]
        found += [abs(photo.lens @ [near, 1]) for near in (0.5, 1.7)]
    assert np.corrcoef(true, found)[0, 1] > 0.4
    for trainer in (plain, learned):
        trainer.evaluate()
    assert learned.history[-1]["psnr"] > plain.history[-1]["psnr"] + 0.3  # type: ignore[operator]


def test_where_it_cannot_stand() -> None:
    with pytest.raises(ValueError, match="focus"):
        hqgs.degrade(textured_scene(), "focus")
    with pytest.raises(ValueError, match="its own noise"):
        hqgs.degrade(textured_scene(), "grain")
    with pytest.raises(ValueError, match="write focus"):
        parse_formation("focus:0")
