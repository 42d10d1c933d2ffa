"""Degraded scenes in memory and as folders: what changes, what stays, and what an error leaves behind."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures_scenes import degrade_image, make_truth, write_colmap
from PIL import Image
from tiny_scene import tiny_scene

import hqgs.scene.degrade
from hqgs.photos.formula import parse_degradation
from hqgs.photos.jpeg import encode_jpeg
from hqgs.photos.pixels import to_uint8
from hqgs.scene.degrade import degrade_scene, degraded_views, write_degraded_scene
from hqgs.scene.formats.degradation_json import read_degraded_folder
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene, TrackStatistics

KINDS = [
    "none",
    "jpeg:10",
    "noise:25",
    "lowres:4",
    "blur:1",
    "defocus:2",
    "motion:5",
    "mixed",
    "jpeg:9+blur:1",
    "exposure",
    "chat:12",
    "phone:2",
    "video:30",
    "some:shake:2",
    "some:phone+shake:1",
]


def colmap_scene(root: Path) -> Scene:
    """Nine photos, the first and last held out."""
    return load_scene(write_colmap(make_truth(), root / "clean"))


def degrade(scene: Scene, kind: str, seed: int = 0) -> Scene:
    return degrade_scene(scene, parse_degradation(kind), seed)


def write(scene: Scene, out: Path, kind: str, seed: int = 0) -> Path:
    write_degraded_scene(scene, out, parse_degradation(kind), seed)
    return out


def stems(names: list[str]) -> list[str]:
    return [name.rsplit(".", 1)[0] for name in names]


# --- in memory


def test_only_the_training_photos_change() -> None:
    scene = tiny_scene()
    before = [view.image.copy() for view in scene.train]
    result = degrade(scene, "noise:25", seed=3)
    assert [v.name for v in result.train] == [v.name for v in scene.train]
    for old, new, image in zip(scene.train, result.train, before, strict=True):
        assert new.camera is old.camera
        assert new.image.dtype == np.float32
        assert new.low is None
        assert 20 < (new.image * 255 - image).std() < 30
        np.testing.assert_array_equal(old.image, image)
    assert result.test == scene.test  # the very views
    assert result.points is scene.points
    assert scene.notes == []
    assert result.notes == [
        "degradation noise:25, seed 3: all training photos (5), kept as 32-bit floats; "
        "held-out photos (1) are clean"
    ]


def test_defaults_are_in_the_note_in_pixels() -> None:
    (note,) = degrade(tiny_scene(), "mixed").notes
    assert note.startswith(
        "degradation mixed (blur:0.11904761904761904+lowres:2+noise:10+jpeg:20 at a width of 24 px), seed 0: "
    )


def test_a_photo_depends_on_the_seed_and_its_place_only() -> None:
    scene = tiny_scene()
    result = degrade(scene, "motion:3+noise:25", seed=4)
    for i, view in enumerate(scene.train, start=1):  # place 0 is the held-out photo's
        alone = degrade_image(
            view.image, parse_degradation("motion:3+noise:25"), np.random.default_rng([4, i])
        ).image
        np.testing.assert_array_equal(result.train[i - 1].image, alone)
    backwards = degrade(replace(scene, train=scene.train[::-1]), "motion:3+noise:25", seed=4)
    for view, same in zip(result.train, backwards.train[::-1], strict=True):
        np.testing.assert_array_equal(view.image, same.image)
    other = degrade(scene, "motion:3+noise:25", seed=5)
    noise = [view.image - same.image for view, same in zip(result.train, other.train, strict=True)]
    assert min(np.abs(n).mean() for n in noise) > 0.05
    still = degrade(
        replace(scene, train=[replace(v, image=np.zeros_like(v.image)) for v in scene.train]), "noise:25"
    )
    table = np.corrcoef([view.image.ravel() for view in still.train])
    assert np.abs(table - np.eye(5)).max() < 4 / np.sqrt(still.train[0].image.size)


def test_errors_name_the_photo_and_the_seed() -> None:
    with pytest.raises(ValueError, match=r"photo 'view1\.png': a blur of sigma 9 px reaches 36 px"):
        degrade(tiny_scene(), "blur:9")
    with pytest.raises(ValueError, match="seed is -1"):
        degrade(tiny_scene(), "noise:5", seed=-1)


# --- as a folder


def test_a_written_scene_tells_which_photos_show_which_points(tmp_path: Path) -> None:
    scene = colmap_scene(tmp_path)
    views = [*scene.train, *scene.test]
    rng = np.random.default_rng(0)
    seen = {view.name: np.flatnonzero(rng.random(len(scene.points)) < 0.5) for view in views}
    seen[views[0].name] = np.zeros(0, np.intp)
    length = sum(map(len, seen.values())) / len(np.unique(np.concatenate(list(seen.values()))))
    scene = replace(scene, seen=seen, tracks=TrackStatistics(length, 0.75))
    back = load_scene(write(scene, tmp_path / "out", "jpeg:9"))
    assert back.tracks is not None
    assert (back.tracks.length, back.tracks.error) == pytest.approx((length, 0.75))
    assert back.seen is not None
    assert set(back.seen) == {
        f"{stem}.{'png' if stem in ('view_00', 'view_08') else 'jpg'}"
        for stem in stems([v.name for v in views])
    }
    for name, rows in back.seen.items():
        np.testing.assert_array_equal(rows, seen[f"{stems([name])[0]}.{views[0].name.rsplit('.', 1)[1]}"])


@pytest.mark.parametrize("kind", KINDS)
def test_a_written_scene_reads_back(tmp_path: Path, kind: str) -> None:
    if "video" in kind:
        pytest.importorskip("av")
    scene = colmap_scene(tmp_path)
    memory = degrade(scene, kind, seed=2)
    back = load_scene(write(scene, tmp_path / "out", kind, seed=2), test_every=3)  # the folder's split counts

    assert stems([v.name for v in back.train]) == stems([v.name for v in scene.train])
    assert stems([v.name for v in back.test]) == stems([v.name for v in scene.test]) == ["view_00", "view_08"]
    for old, new in zip([*scene.train, *scene.test], [*back.train, *back.test], strict=True):
        assert (new.camera.width, new.camera.height) == (48, 36)
        np.testing.assert_array_equal(new.camera.K, old.camera.K)
        np.testing.assert_allclose(new.camera.viewmat, old.camera.viewmat, rtol=0, atol=1e-13)
        assert new.mask is None
    np.testing.assert_array_equal(back.points, scene.points)
    np.testing.assert_array_equal(back.point_colors, scene.point_colors)
    assert (scene.seen, scene.tracks, back.seen, back.tracks) == (None,) * 4

    for old, new in zip(scene.test, back.test, strict=True):
        np.testing.assert_array_equal(new.image, old.image)
        assert new.low is None
    for old, new in zip(memory.train, back.train, strict=True):
        np.testing.assert_array_equal(new.image, to_uint8(old.image.astype(np.float32)))
        assert (new.low is None) == (old.low is None)
        if old.low is not None and new.low is not None:
            assert new.low.dtype == np.float32
            np.testing.assert_array_equal(to_uint8(new.low), to_uint8(old.low))

    folder = read_degraded_folder(tmp_path / "out")
    assert folder is not None
    assert (folder.kind, folder.seed) == (kind, 2)
    assert list(folder.train) == [v.name for v in back.train]
    assert folder.held_out == [v.name for v in back.test]
    results = [result for _, result in degraded_views(scene, parse_degradation(kind), 2)]
    assert folder.steps == {v.name: r.records for v, r in zip(back.train, results, strict=True)}
    (note,) = back.notes
    assert note.startswith(f"degradation {kind}")
    hit = "4 of 7 training photos" if kind == "some:shake:2" else "all training photos (7)"
    assert f"seed 2: {hit}, " in note


def test_jpeg_files_are_the_codecs_own(tmp_path: Path) -> None:
    scene = colmap_scene(tmp_path)
    images = write(scene, tmp_path / "out", "jpeg:10") / "images"
    assert sorted(p.suffix for p in images.iterdir()) == [".jpg"] * 7 + [".png"] * 2
    for view in scene.train:
        data = encode_jpeg((view.image / 255).astype(np.float32), 10)
        assert (images / view.name).with_suffix(".jpg").read_bytes() == data


def test_jpeg_after_lowres_is_the_small_file(tmp_path: Path) -> None:
    scene = colmap_scene(tmp_path)
    out = write(scene, tmp_path / "out", "lowres:2+jpeg:30")
    assert {p.suffix for p in (out / "images").iterdir()} == {".png"}
    small = sorted((out / "low").iterdir())
    assert [p.name for p in small] == [f"view_{i:02d}.jpg" for i in range(1, 8)]
    with Image.open(small[0]) as photo:
        assert (photo.format, photo.size) == ("JPEG", (24, 18))
    memory = degrade(scene, "lowres:2+jpeg:30")
    for view, same in zip(load_scene(out).train, memory.train, strict=True):
        assert view.low is not None
        np.testing.assert_array_equal(view.low, same.low)  # nothing is lost


def test_small_photos_are_read_at_the_stored_size_only(tmp_path: Path) -> None:
    out = write(colmap_scene(tmp_path), tmp_path / "out", "lowres:2")
    for downscale, longest in ((2, None), (None, 24)):
        back = load_scene(out, downscale=downscale, longest=longest)
        assert {view.image.shape for view in back.train} == {(18, 24, 3)}
        assert [view.low for view in back.train] == [None] * 7
        assert len(back.test) == 2


def test_names_in_folders_masks_and_a_split_of_its_own(tmp_path: Path) -> None:
    scene = tiny_scene()
    views = [replace(v, name=f"{'abc'[i % 3]}/{i}.JPEG") for i, v in enumerate([*scene.test, *scene.train])]
    mask = np.zeros((16, 24), bool)
    mask[3:, :17] = True
    views[1] = replace(views[1], mask=mask)
    views.sort(key=lambda v: v.name)
    scene = replace(scene, train=views[:1] + views[3:], test=views[1:3])
    back = load_scene(write(scene, tmp_path / "out", "jpeg:50"))
    assert [v.name for v in back.train] == ["a/0.jpg", "b/4.jpg", "c/2.jpg", "c/5.jpg"]
    assert [v.name for v in back.test] == ["a/3.png", "b/1.png"]
    assert back.test[1].mask is not None
    np.testing.assert_array_equal(back.test[1].mask, mask)
    assert all(v.mask is None for v in [*back.train, back.test[0]])


def test_a_new_model_may_lack_photos(tmp_path: Path) -> None:
    """COLMAP is run on the degraded photos and does not register all of them."""
    out = write(colmap_scene(tmp_path), tmp_path / "out", "noise:25")
    truth = make_truth()
    for name in ("view_00.png", "view_03.png"):
        truth = replace(
            truth,
            viewmats=np.delete(truth.viewmats, truth.names.index(name), 0),
            names=[n for n in truth.names if n != name],
        )
    for file in (out / "sparse" / "0").iterdir():
        file.unlink()
    write_colmap(truth, out, images=None)
    back = load_scene(out)
    assert stems([v.name for v in back.train]) == [f"view_{i:02d}" for i in (1, 2, 4, 5, 6, 7)]
    assert [v.name for v in back.test] == ["view_08.png"]


def test_notes_of_the_clean_scene_go_along(tmp_path: Path) -> None:
    scene = replace(tiny_scene(), notes=["points are made up"])
    back = load_scene(write(scene, tmp_path / "out", "noise:25"))
    assert back.notes[0] == "points are made up"
    assert back.notes[1].endswith("clipped and rounded to 8-bit PNGs; held-out photos (1) are clean")


# --- what an error leaves behind


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    write(tiny_scene(), out, "none")  # an empty one is fine
    files = sorted(out.rglob("*"))
    with pytest.raises(FileExistsError, match="out exists and is not an empty folder"):
        write(tiny_scene(), out, "noise:25")
    assert sorted(out.rglob("*")) == files
    (tmp_path / "file").write_text("")
    with pytest.raises(FileExistsError, match="file exists and is not an empty folder"):
        write(tiny_scene(), tmp_path / "file", "none")


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
@pytest.mark.parametrize("place", ["degrade_sequence", "write_colmap", "write_degraded_folder"])
def test_nothing_is_left_after_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, error: type[BaseException]
) -> None:
    real, calls = getattr(hqgs.scene.degrade, place), []

    def failing(*arguments: Any, **named: Any) -> Any:
        calls.append(arguments)
        if len(calls) == (3 if place == "degrade_sequence" else 1):
            raise error
        return real(*arguments, **named)

    monkeypatch.setattr(hqgs.scene.degrade, place, failing)
    with pytest.raises(error):
        write(tiny_scene(), tmp_path / "out", "noise:25")
    assert calls
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "names", [("a.png", "a.jpg"), ("a.k.png", "a.png"), ("a.png", "b.png", "A.png", "a.PNG")]
)
def test_names_that_new_suffixes_would_mix_up_are_refused(tmp_path: Path, names: tuple[str, ...]) -> None:
    scene = tiny_scene()
    train = [replace(v, name=name) for v, name in zip(scene.train, names, strict=False)]
    with pytest.raises(ValueError, match=r"the photos' names must differ.* they are "):
        write(replace(scene, train=train), tmp_path / "out", "jpeg:10")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["../stray.png", "../../stray.png", "{}/stray.png"])
def test_a_name_that_leaves_the_folder_is_refused(tmp_path: Path, name: str) -> None:
    scene = tiny_scene()
    train = [replace(scene.train[0], name=name.format(tmp_path))]
    with pytest.raises(ValueError, match="is outside of the folder"):
        write(replace(scene, train=train), tmp_path / "out", "noise:10")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (None, "is not valid JSON: "),
        ({"train": ["view1.png"]}, r"is damaged: train is \['view1\.png'\], wanted dict"),
        ({"held_out": "view0.png"}, "held_out is 'view0.png', wanted list"),
        ({"notes": [3]}, r"notes\[0\] is 3, wanted str"),
        ({"train": {"view1.png": 3}}, r"train\['view1\.png'\] is 3, wanted str"),
        ({"train": {"view1.png": "../clean.png"}}, "is outside of the folder"),
        ({"train": {"view1.png": "images/../low/view9.png"}}, "has no small photo"),
        ({"train": {"view1.png": "large.png"}}, r"large\.png is 25 x 16, its photo 24 x 16"),
        ({"more": 1}, "is damaged: .*more"),
        ({"version": 3}, "is damaged: the version is 3, and only 2 is known"),
        ({"steps": []}, r"steps is \[\], wanted dict"),
        ({"steps": {"view1.png": {}}}, r"steps\['view1\.png'\] is {}, wanted list"),
        ({"steps": {"view1.png": ["blur"]}}, r"steps\['view1\.png'\]\[0\] is 'blur', wanted dict"),
    ],
)
def test_a_damaged_description_is_refused(
    tmp_path: Path, change: dict[str, Any] | None, message: str
) -> None:
    out = write(tiny_scene(), tmp_path / "out", "lowres:2")
    Image.new("RGB", (25, 16)).save(out / "large.png")
    path = out / "degradation.json"
    path.write_text("{" if change is None else json.dumps(json.loads(path.read_text()) | change))
    error = FileNotFoundError if "no small photo" in message else ValueError
    with pytest.raises(error, match=message):
        load_scene(out)
