"""Who passes by is masked, where other photos contradict it: in the ray-cast room, whose truth is exact."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from tiny_scene import tiny_config, tiny_scene

import hqgs
from benchmarks.scenes.wild import WildRoom, wild_room
from hqgs.evaluation.passing import passing_picture
from hqgs.model.consistency import Agreement
from hqgs.photos.formula import parse_degradation
from hqgs.photos.pixels import as_floats
from hqgs.scene.builtin import scene as builtin
from hqgs.scene.builtin.scene import surface_points
from hqgs.scene.builtin.shading import render_depth
from hqgs.scene.capture import find_mask
from hqgs.scene.degrade import degrade_scene
from hqgs.scene.scene import Scene, View
from hqgs.scene.sfm.triangulated import SparsePoints
from hqgs.training import passersby
from hqgs.training.frame import Frame
from hqgs.training.passersby import without_passersby
from hqgs.training.prepare import Prepared
from hqgs.training.trainer import Trainer

Mask = NDArray[np.bool_]


@pytest.fixture(scope="module")
def crowd() -> WildRoom:
    """Eleven training photos of 128 x 96 px; points by ray casting, not by COLMAP."""
    with pytest.MonkeyPatch.context() as patch:

        def cast(views: list[View]) -> SparsePoints:
            return surface_points(views, 400)._replace(note="cast")

        patch.setattr(builtin, "sfm_points", cast)
        return wild_room("true-crowd:2", 1, None, 128, 96, num_views=13)


def truth_of(bad: Scene, clean: Scene) -> dict[str, Mask]:
    pairs = zip(bad.train, clean.train, strict=True)
    return {a.name: mask for a, b in pairs if (mask := (a.image != b.image).any(-1)).any()}


def test_walkers_are_found_and_nothing_else(crowd: WildRoom) -> None:
    truth = truth_of(crowd.scene, crowd.clean)
    assert 4 < len(truth) < len(crowd.scene.train)
    masked, found = without_passersby(crowd.scene, 0)
    blank = np.zeros((96, 128), bool)
    both = [(found.get(v.name, blank), truth.get(v.name, blank)) for v in masked.train]
    assert sum((a & b).sum() for a, b in both) / sum((a | b).sum() for a, b in both) > 0.6
    assert sum(a.mean() for a, b in both if not b.any()) < 0.005
    for view, before in zip(masked.train, crowd.scene.train, strict=True):
        if view.name in found:
            np.testing.assert_array_equal(view.mask, np.logical_not(found[view.name]))
        else:
            assert view is before
    again = without_passersby(crowd.scene, 0)[1]
    assert {name: mask.tobytes() for name, mask in again.items()} == {
        name: mask.tobytes() for name, mask in found.items()
    }


@pytest.mark.parametrize("kind", ["none", "noise:25", "blur:2", "exposure"])
def test_a_room_without_walkers_keeps_its_pixels(kind: str, crowd: WildRoom) -> None:
    bad = degrade_scene(crowd.clean, parse_degradation(kind), 0)
    found = without_passersby(bad, 0)[1]
    assert sum(mask.sum() for mask in found.values()) < 0.002 * len(bad.train) * 128 * 96


def test_a_mask_of_the_scene_stays(crowd: WildRoom) -> None:
    left = np.ones((96, 128), bool)
    left[:, :64] = False
    scene = replace(crowd.scene, train=[replace(view, mask=left) for view in crowd.scene.train])
    masked, found = without_passersby(scene, 0)
    assert found
    assert not any(mask[:, :62].any() for mask in found.values())
    assert all(not view.mask[:, :64].any() for view in masked.train if view.mask is not None)


def test_where_the_scene_is_wrong_nobody_passes_by(crowd: WildRoom) -> None:
    """Regions in which the photo is right, and the render is not: others side with the photo."""
    views = crowd.clean.train
    agreement = Agreement(views, crowd.clean.seen or {})
    regions = np.zeros((48, 64), np.intp)
    regions[18:30, 20:44] = 1
    near = 1 / render_depth(views[3].camera)[::2, ::2]
    right = as_floats(views[3].image)
    wrong = right[::-1].copy()
    assert not passersby._contradicted(agreement, 3, wrong, near, regions).any()
    flipped = replace(views[3], image=np.ascontiguousarray(views[3].image[::-1]))
    turned = Agreement([*views[:3], flipped, *views[4:]], crowd.clean.seen or {})
    np.testing.assert_array_equal(passersby._contradicted(turned, 3, right, near, regions), regions == 1)


@pytest.mark.parametrize(
    ("scene", "photo", "passing"), [(0.4, 0.0, False), (0.6, 0.0, True), (0.6, 0.2, True), (0.6, 0.4, False)]
)
def test_most_of_a_region_is_borne_out_by_others(
    scene: float, photo: float, passing: bool, crowd: WildRoom, monkeypatch: pytest.MonkeyPatch
) -> None:
    def depths(*_: object, grey: object = None) -> tuple[NDArray[np.float64], Mask]:
        return np.ones(100), np.arange(100) < 100 * (photo if grey is None else scene)

    monkeypatch.setattr(Agreement, "depths", depths)
    regions = np.zeros((48, 64), np.intp)
    regions[10:20, 10:20] = 1
    agreement, render = Agreement(crowd.clean.train, {}), as_floats(crowd.clean.train[0].image)
    found = passersby._contradicted(agreement, 0, render, np.ones((48, 64)), regions)
    np.testing.assert_array_equal(found, (regions == 1) & passing)


def test_differences_that_do_not_count(crowd: WildRoom) -> None:
    view = crowd.clean.train[0]
    render: NDArray[np.float32] = as_floats(view.image)
    assert passersby._unlike(view, render).max() == 0
    assert passersby._unlike(view, np.roll(render, 2, axis=1))[:, 2:-2].max() < 1e-6  # a cell aside
    assert passersby._unlike(view, np.float32(0.5) * render).max() < 1e-6  # a gain of the whole photo
    other = render.copy()
    other[40:60, 50:80] = 1 - other[40:60, 50:80]
    found = passersby._unlike(view, other) > passersby.DIFFERS
    assert found[20:30, 25:40].mean() > 0.5
    found[19:31, 24:41] = False
    assert not found.any()


def test_what_cannot_be_told_is_left_as_it_is(crowd: WildRoom) -> None:
    for scene in (replace(crowd.scene, seen=None), replace(crowd.scene, train=crowd.scene.train[:2])):
        same, found = without_passersby(scene, 0)
        assert same is scene
        assert not found


def test_how_large_the_scene_is_is_asked_once(crowd: WildRoom, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes a look at all points in all photos."""
    asked = list[str]()
    reach = Scene.reach.fget
    assert reach is not None

    def counted(scene: Scene) -> float:
        asked.append(scene.name)
        return reach(scene)

    monkeypatch.setattr(Scene, "reach", property(counted))
    monkeypatch.setattr(passersby, "SCOUT_STEPS", 3)
    monkeypatch.setattr(passersby, "SCOUT_STEPS_EACH", 0)
    without_passersby(crowd.scene, 0)
    assert len(asked) == 1


def test_the_run_goes_by_the_masks_and_tells(crowd: WildRoom, tmp_path: Path) -> None:
    asked = tiny_config(4, leave_out=("passersby",))
    run = hqgs.train(crowd.scene, config=asked, out=tmp_path / "run")
    prepared = Prepared(Frame.of(crowd.scene), asked)
    names = list(prepared.passersby)
    row = next(row for row in prepared.plan().rows if row.what == "passers-by")
    share = sum(mask.sum() for mask in prepared.passersby.values()) / (11 * 96 * 128)
    assert row.value == f"masked in {len(names)} of 11 photos, {share:.1%} of all pixels"
    assert f"passers-by in {len(names)} of 11 photos" in [item.what for item in run.left_out]
    for view, target in zip(prepared.scene.train, prepared.training_views.targets, strict=True):
        assert (target.mask is not None) == (view.name in names)
        path = find_mask(tmp_path / "run", view.name)  # as a scene's masks are read
        assert path is not None
        assert path.name == f"{view.name}.png"  # as COLMAP reads them
        passing = prepared.passersby.get(view.name, np.zeros((96, 128), bool))
        np.testing.assert_array_equal(np.asarray(Image.open(path)), np.where(passing, 0, 255))
    assert 'alt="photos, what was masked in red"' in (tmp_path / "run" / "report.html").read_text()
    with Image.open(tmp_path / "run" / "passersby.png") as picture:
        assert picture.width > picture.height > 90
    trainer = Trainer(Frame.of(crowd.scene), asked)
    trainer.restore(tmp_path / "run" / "checkpoint.safetensors")
    assert trainer.iteration == 4


def test_without_passersby_nothing_is_written(tmp_path: Path) -> None:
    hqgs.train(tiny_scene(), config=tiny_config(2, leave_out=("passersby",)), out=tmp_path / "run")
    assert not {"masks", "passersby.png"} & {path.name for path in (tmp_path / "run").iterdir()}
    plan = Prepared(tiny_scene(), tiny_config(2)).plan()
    assert "passers-by" not in [row.what for row in plan.rows]


def test_the_picture_shows_what_was_masked() -> None:
    views = tiny_scene().train[:2]
    mask = np.zeros((16, 24), bool)
    mask[4:8, 5:9] = True
    pixels = np.asarray(passing_picture(views, {views[1].name: mask}))[:16, :24].astype(int)
    wanted = views[1].image + 0.6 * (np.array([220, 30, 30]) - views[1].image.astype(float))
    np.testing.assert_allclose(pixels[mask], wanted[mask], atol=1)
    np.testing.assert_array_equal(pixels[~mask], views[1].image[~mask])
