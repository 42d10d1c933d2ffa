"""Scenes whose photos differ: half of them hit, films with held-out neighbours, and what the folder tells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures_scenes import degrade_image
from PIL import Image
from tiny_scene import tiny_scene

from benchmarks.scenes.kinds import shake
from benchmarks.scenes.video import film
from hqgs.photos.formula import parse_degradation
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.degrade import degrade_scene, degraded_views, write_degraded_scene
from hqgs.scene.formats.degradation_json import read_degraded_folder
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene


def degrade(scene: Scene, kind: str, seed: int = 0) -> Scene:
    return degrade_scene(scene, parse_degradation(kind), seed)


def held_out_between(num_views: int = 9) -> Scene:
    """A tiny scene whose held-out photos, 0, 4 and 8, lie between the others."""
    scene = tiny_scene(num_views)
    views = [*scene.test, *scene.train]
    return replace(scene, train=[v for k, v in enumerate(views) if k % 4], test=views[::4])


# --- some


@pytest.mark.parametrize("num_views", [5, 6, 12])
def test_some_hits_exactly_half_at_mixed_strengths(num_views: int) -> None:
    scene = tiny_scene(num_views)
    count, chosen = num_views - 1, set()
    for seed in range(8):
        factors = []
        for view, result in degraded_views(scene, parse_degradation("some:noise:20"), seed):
            if not result.records:
                np.testing.assert_array_equal(result.image, as_floats(view.image))
                continue
            (record,) = result.records
            assert record["kind"] == "noise"
            spread = (result.image * 255 - view.image).std()
            assert spread == pytest.approx(record["value"], rel=0.1)
            factors.append(record["value"] / 20)
            chosen.add((seed, view.name))
        assert len(factors) == (count + 1) // 2
        assert all(0.5 <= factor <= 1.5 for factor in factors)
        assert len(set(factors)) == len(factors)
    assert len({name for _, name in chosen}) == count  # other seeds choose others


def test_all_some_steps_hit_the_same_photos() -> None:
    scene = tiny_scene(8)
    kinds = [
        [record["kind"] for record in result.records]
        for _, result in degraded_views(scene, parse_degradation("some:blur:0.5+jpeg:30+some:noise:9"), 3)
    ]
    assert sorted(kinds, key=len) == [["jpeg"]] * 3 + [["blur", "jpeg", "noise"]] * 4
    (note,) = degrade(scene, "some:blur:0.5+jpeg:30").notes
    assert ", seed 0: all training photos (7), the steps of some: 4 of 7, kept" in note
    (note,) = degrade(scene, "some:blur:0.5").notes
    assert note.startswith("degradation some:blur:0.5, seed 0: 4 of 7 training photos, kept as")


def test_the_choice_leaves_the_photos_own_randomness_alone() -> None:
    scene = tiny_scene()
    names = sorted(view.name for view in (*scene.train, *scene.test))
    for view, result in degraded_views(scene, parse_degradation("some:motion:4"), 5):
        for record in result.records:
            rng = np.random.default_rng([5, names.index(view.name)])
            assert record["direction"] == rng.uniform(0, np.pi)
    backwards = replace(scene, train=scene.train[::-1])
    first, second = degrade(scene, "some:noise:9", 1), degrade(backwards, "some:noise:9", 1)
    for view, same in zip(first.train, second.train[::-1], strict=True):
        np.testing.assert_array_equal(view.image, same.image)


# --- video


def test_a_film_holds_the_held_out_photos_too() -> None:
    pytest.importorskip("av")
    scene = held_out_between()
    kept = [view.image.copy() for view in scene.test]
    result = degrade(scene, "video:30")
    views = sorted((*scene.train, *scene.test), key=lambda view: view.name)
    frames = dict(zip([v.name for v in views], film([as_floats(v.image) for v in views], 30), strict=True))
    assert len(frames) == 9
    for view in result.train:
        np.testing.assert_array_equal(view.image, frames[view.name].image)
    assert result.test == scene.test
    for view, image in zip(result.test, kept, strict=True):
        np.testing.assert_array_equal(view.image, image)
    without = degrade(replace(scene, test=[]), "video:30")
    assert any((a.image != b.image).any() for a, b in zip(result.train, without.train, strict=True))
    for _, degraded in degraded_views(scene, parse_degradation("video:30"), 0):
        assert degraded.records[0]["frame"] in ("I", "P", "B")


def test_a_shaken_film_shakes_each_frame_by_itself() -> None:
    pytest.importorskip("av")
    scene = held_out_between()
    views = sorted((*scene.train, *scene.test), key=lambda view: view.name)
    shaken = [
        degrade_image(v.image, parse_degradation("shake:3"), np.random.default_rng([2, k])).image
        for k, v in enumerate(views)
    ]
    frames = dict(zip([v.name for v in views], film(shaken, 25), strict=True))
    for view in degrade(scene, "shake:3+video:25", seed=2).train:
        np.testing.assert_array_equal(view.image, frames[view.name].image)


def test_a_photo_of_another_size_is_named() -> None:
    scene = tiny_scene()
    odd = replace(scene.train[3], image=scene.train[3].image[:-1])
    scene = replace(scene, train=[*scene.train[:3], odd, *scene.train[4:]])
    message = r"photo 'view4\.png': a film has one size, but 'view0\.png' and it have 24 x 16 and 24 x 15 px"
    with pytest.raises(ValueError, match=message):
        degrade(scene, "video")


# --- as a folder


def test_a_photo_follows_from_what_the_folder_tells(tmp_path: Path) -> None:
    scene = held_out_between()
    write_degraded_scene(scene, tmp_path / "shake", parse_degradation("shake:3"), 3)
    folder = read_degraded_folder(tmp_path / "shake")
    assert folder is not None
    for view, clean in zip(load_scene(tmp_path / "shake").train, scene.train, strict=True):
        (record,) = folder.steps[view.name]
        again = shake(as_floats(clean.image), np.array(record["path"]))
        np.testing.assert_array_equal(view.image, to_uint8(again))
    write_degraded_scene(scene, tmp_path / "phone", parse_degradation("phone:2"), 3)
    for old, result in degraded_views(scene, parse_degradation("phone:2"), 3):
        file = (tmp_path / "phone" / "images" / old.name).with_suffix(".jpg")
        assert file.read_bytes() == result.jpeg


def test_a_film_of_one_photo_is_stored_at_its_size(tmp_path: Path) -> None:
    pytest.importorskip("av")
    scene = tiny_scene()
    views = [replace(v, image=v.image[:15, :23]) for v in (*scene.train, *scene.test)]
    views = [replace(v, camera=replace(v.camera, width=23, height=15)) for v in views]
    scene = replace(scene, train=views[:1], test=[])
    write_degraded_scene(scene, tmp_path / "out", parse_degradation("video:20"), 0)
    with Image.open(tmp_path / "out" / "images" / "view1.png") as photo:
        assert photo.size == (23, 15)
