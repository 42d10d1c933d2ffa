"""Folders of photos as people have them: what is read, what is converted, what is left out and said."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from fixtures_cards import HEIGHT, WIDTH
from fixtures_photos import exif, looked_at, picture
from PIL import Image

from hqgs.base.stages import Stage
from hqgs.photos.exif import read_exif
from hqgs.photos.files import UnreadableError, decode, glance
from hqgs.scene.formats.colmap import registered
from hqgs.scene.load import load_pictures, load_scene
from hqgs.scene.scene import Scene
from hqgs.scene.sfm import passes as all_passes
from hqgs.scene.sfm import program
from hqgs.scene.sfm import run as colmap_run
from hqgs.scene.sfm.align import rotation_angles
from hqgs.scene.sfm.bare_photos import BarePhotos, bare_photos, readable
from hqgs.scene.sfm.database import join, known_cameras
from hqgs.scene.sfm.failure import Outcome, what_to_take, why_few, why_lost
from hqgs.scene.sfm.likely import likely_pairs
from hqgs.scene.sfm.passes import PASSES, Attempt, Work, best_attempt
from hqgs.scene.sfm.photos_alone import as_stored

ROOT = Path(__file__).parent.parent
FINE = PASSES[1]


def test_exif_tells_orientation_camera_and_focal_length(tmp_path: Path) -> None:
    for orientation, turn in ((1, 0), (3, 2), (6, 1), (8, 3)):
        picture(0).save(tmp_path / "a.jpg", exif=exif(orientation, 28, "Phone"))
        found = read_exif(tmp_path / "a.jpg")
        assert found.quarter_turns == turn
        assert found.camera == ("", "Phone", "0 28")
        assert found.focal == pytest.approx(28 / 43.27 * 50, rel=1e-3)  # the photo's diagonal is 50 px
    picture(0).save(tmp_path / "a.jpg", exif=exif(6, 9999))
    assert read_exif(tmp_path / "a.jpg").focal == 0  # no such lens
    picture(0).save(tmp_path / "a.png")
    (tmp_path / "b.jpg").write_text("no photo")
    for name in ("a.png", "b.jpg"):
        assert (read_exif(tmp_path / name).quarter_turns, read_exif(tmp_path / name).camera) == (0, ())


def test_photos_share_a_camera_by_size_make_and_zoom(tmp_path: Path) -> None:
    for seed, (name, size, focal) in enumerate(
        (
            ("a", (40, 30), 28),
            ("b", (40, 30), 28),
            ("c", (40, 30), 56),
            ("d", (30, 40), 28),
            ("e", (40, 30), 0),
        )
    ):
        picture(seed, size).save(tmp_path / f"{name}.jpg", exif=exif(1, focal, "Phone"))
    guess = looked_at(tmp_path).guess()
    assert guess.camera_of == [0, 0, 1, 2, 3]
    assert guess.sizes == [(40, 30), (40, 30), (30, 40), (40, 30)]
    assert guess.focals == pytest.approx([32.36, 64.71, 32.36, 0], rel=1e-3)


def test_photos_one_level_down_are_found_and_others_are_named(tmp_path: Path) -> None:
    inner = tmp_path / "holiday"
    inner.mkdir()
    for k in range(4):
        picture(k).save(inner / f"{k}.webp")
    (inner / "notes.png").write_text("milk, eggs")
    (inner / "cut.jpg").write_bytes(b"")
    picture(5).save(inner / "cut.jpg")
    (inner / "cut.jpg").write_bytes((inner / "cut.jpg").read_bytes()[:400])
    (tmp_path / "masks").mkdir()
    picture(6).save(tmp_path / "masks" / "0.png")
    found = bare_photos(tmp_path, 1)
    assert found is not None
    assert found.folder == inner
    assert "holiday" in found.notes[0]
    whole = readable(found)
    assert whole.names == [f"{k}.webp" for k in range(4)]
    assert list(whole.unreadable) == ["cut.jpg", "notes.png"]
    assert whole.unreadable["notes.png"] == "no picture"
    assert "truncated" in whole.unreadable["cut.jpg"].lower()
    (tmp_path / ".colmap").mkdir()
    whole.write(tmp_path / ".colmap")
    assert sorted(p.name for p in (tmp_path / ".colmap").iterdir()) == [f"{k}.webp.jpg" for k in range(4)]
    for k in range(5):
        (inner / f"x{k}.png").write_text("no photo")
    again = bare_photos(tmp_path, 1)
    assert again is not None
    with pytest.raises(
        ValueError, match=r"7 of 11 photos cannot be read: cut.jpg \(.*notes.png \(no picture\)"
    ):
        readable(again)


@pytest.mark.parametrize("around", [False, True])
@pytest.mark.parametrize(
    "names",
    [
        ["IMG_1.heic", "IMG_1.heic.jpg", "IMG_2.heic"],
        ["a b.webp", "a_b.webp", "a_b.webp.jpg", "a\tb.webp.JPG"],
        ["#1.png", "_1.png", "__1.png", "1.png"],
        ["x.webp", "_x.webp.jpg", "x.webp.jpg", "__x.webp.jpg"],
        ["a.jpg", "a.front.jpg", "a.jpg.webp"],
    ],
)
def test_photos_have_names_of_their_own_for_colmap(names: list[str], around: bool, tmp_path: Path) -> None:
    for k, name in enumerate(names):
        Image.fromarray(np.full((64, 128, 3), 9 * k, np.uint8)).save(tmp_path / name, format="PNG")
    photos = BarePhotos(tmp_path, 1.0, sorted(names), [(128, 64)] * len(names), around=around)
    called = photos.colmap_names
    assert len(called) == len(names) * (6 if around else 1)
    assert list(called.values()) == [name for name in sorted(names) for _ in range(6 if around else 1)]
    assert not any(" " in name or "\t" in name or name.startswith("#") for name in called)
    (tmp_path / "out").mkdir()
    photos.write(tmp_path / "out")
    for name, photo in called.items():
        with Image.open(tmp_path / "out" / name) as seen:
            assert abs(int(np.asarray(seen).mean()) - 9 * names.index(photo)) <= 1


def test_colmap_sees_large_photos_smaller_and_what_it_finds_is_at_their_stored_size(tmp_path: Path) -> None:
    ramp = np.repeat(np.linspace(0, 255, 300).astype(np.uint8)[None, :, None], 200, 0).repeat(3, 2)
    for name, size in (("a.jpg", (300, 200)), ("b.jpg", (200, 300)), ("c.webp", (60, 40))):
        Image.fromarray(ramp).resize(size).save(tmp_path / name, exif=exif(1, 72), quality=95)
    photos = looked_at(tmp_path)
    assert photos.guess().sizes == [(300, 200), (200, 300), (60, 40)]
    guess = photos.guess(100)
    assert guess.sizes == [(99, 66), (66, 99), (60, 40)]  # 3:2, exactly
    whole = photos.guess().focals
    assert guess.focals == pytest.approx([whole[0] * 0.33, whole[1] * 0.33, whole[2]])
    (tmp_path / "out").mkdir()
    photos.write(tmp_path / "out", 100)
    for name, size in (("a.jpg", (99, 66)), ("b.jpg", (66, 99)), ("c.webp.jpg", (60, 40))):
        with Image.open(tmp_path / "out" / name) as small:
            assert small.size == size
            columns = np.asarray(small, float).mean((0, 2))
        np.testing.assert_allclose(columns, (np.arange(size[0]) + 0.5) / size[0] * 255, atol=4)

    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=99, height=66, params=[80, 49.5, 33, 0.1]
    )
    model, rng = pycolmap.Reconstruction(), np.random.default_rng(0)
    model.add_camera_with_trivial_rig(camera)
    points = rng.uniform([-1, -1, 4], [1, 1, 6], (20, 3))
    seen = []
    for k in range(2):
        pixels = camera.img_from_cam(np.add(points, (k, 0, 0)))
        assert pixels is not None
        seen.append(np.add(pixels, (0.3, -0.4)))
    for k, xy in enumerate(seen):
        image = pycolmap.Image(name=f"{k}", keypoints=xy, camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), [k, 0, 0]))
    for row, point in enumerate(points):
        model.add_point3D(
            point, pycolmap.Track([pycolmap.TrackElement(k + 1, row) for k in range(2)]), [0, 0, 0]
        )
    as_stored(model, [(300, 200)], 1)
    assert model.cameras[1].params == pytest.approx([80 * 300 / 99, 150, 100, 0.1])
    np.testing.assert_allclose([point.xy for point in model.images[2].points2D], seen[1] * 300 / 99)
    assert model.compute_mean_reprojection_error() == pytest.approx(0.5 * 300 / 99)


def test_heic_photos_are_read_or_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    image = Image.fromarray(np.full((64, 96, 3), (200, 60, 90), np.uint8))
    for k in range(3):
        image.resize((96, 64 + 8 * k)).save(tmp_path / f"{k}.HEIC")
    assert glance(tmp_path / "0.HEIC").size == (96, 64)
    assert np.abs(decode(tmp_path / "0.HEIC")[0].mean((0, 1)) - (200, 60, 90)).max() < 4
    found = bare_photos(tmp_path, 1)
    assert found is not None
    assert readable(found).names == ["0.HEIC", "1.HEIC", "2.HEIC"]
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(ValueError, match=r"3 of 3 photos are HEIC .*pip install 'hqgs\[heic\]'"):
        readable(found)
    with pytest.raises(UnreadableError, match="extra 'heic'"):
        decode(tmp_path / "0.HEIC")


def test_the_world_stands_upright_and_every_photo_is_named(photos: list[np.ndarray], tmp_path: Path) -> None:
    """Photos that lie on their side, some as WebP, with a text file among them and one that fits nowhere."""
    for k, image in enumerate(photos):
        turned = Image.fromarray(np.ascontiguousarray(np.rot90(image)))
        turned.save(tmp_path / f"{k}.{'webp' if k % 2 else 'jpg'}", exif=exif(6), quality=98)
    picture(7, (HEIGHT, WIDTH)).save(tmp_path / "foreign.png")
    (tmp_path / "zz.png").write_text("a text")
    stages: list[Stage] = []
    scene = load_scene(tmp_path, keep_sfm=tmp_path / "kept", on_stage=stages.append)
    report = scene.sfm
    assert report is not None
    assert (report.photos, report.not_registered) == (10, ["foreign.png"])
    assert report.unreadable == {"zz.png": "no picture"}
    assert set(report.lost) == {"foreign.png"}
    assert f"foreign.png ({report.lost['foreign.png']})" in str(report)
    assert report.advice is not None
    assert "Take these photos again, sharp and bright: foreign.png" in report.advice
    assert "zz.png (no picture)" in str(report)
    views = [*scene.train, *scene.test]
    assert {view.quarter_turns for view in views} == {1}
    assert {view.image.shape for view in views} == {views[0].image.shape}
    ups = np.stack([-view.camera.viewmat[0, :3] for view in views])  # of the stored pixels up is to the left
    mean = ups.mean(0) / np.linalg.norm(ups.mean(0))
    np.testing.assert_allclose(mean, [0, -1, 0], atol=1e-6)
    assert {stage.what for stage in stages} >= {"photos read", "COLMAP: features", "COLMAP: photos placed"}
    assert scene.seen is not None
    assert set(scene.seen) == {view.name for view in views}
    pictures = load_pictures(tmp_path, most=4)
    assert pictures is not None
    assert len(pictures.train) == 4
    assert pictures.notes == ["10 photos, no camera in EXIF", "cannot be read (1): zz.png"]


def test_a_stopped_reconstruction_goes_on_where_it_was(
    found_cards: tuple[Path, Scene], tmp_path: Path
) -> None:
    """Stopped by Ctrl-C while it matches; features that are there are not looked for again."""
    folder, keep = found_cards[0] / "photos", tmp_path / "run" / "sfm"
    code = f"""
from pathlib import Path
from hqgs.scene.load import load_scene
def told(stage):
    if "matched" in stage.what or "checked" in stage.what or "placed" in stage.what:
        print("now", flush=True)
load_scene(Path({str(folder)!r}), keep_sfm=Path({str(keep)!r}), on_stage=told)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"now\n"
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    (left,) = keep.iterdir()
    log = (left / "log.txt").read_text()
    assert log.count("Processed file [") >= 9
    assert (left / "fine.db").is_file()
    scene = load_scene(folder, keep_sfm=keep)
    assert [path.name for path in keep.iterdir()] == [left.name[1:]]
    # One run that nothing stopped had other last bits, in some 300: never twice in a row.
    points, once = scene.points.tobytes(), found_cards[1].points.tobytes()
    assert points == once or points == load_scene(folder).points.tobytes()


def outcome(features: int, inliers: list[int], photos: int = 20, registered: int = 0) -> Outcome:
    return Outcome(registered, {f"{k}.jpg": features for k in range(photos)}, inliers)


def test_a_failure_tells_blur_no_overlap_and_too_few_photos_apart() -> None:
    blurred = why_few(outcome(40, []))
    assert "40 features" in blurred
    assert "blurred or dark" in blurred
    apart = why_few(outcome(3000, [12, 9]))
    assert "0 of 190 pairs" in apart
    assert "do not overlap" in apart
    assert "are too few (take 20 to 100), were taken from one place" in why_few(outcome(3000, [900] * 100))
    assert "overlap too little" in why_few(outcome(3000, [900] * 100, registered=8))


def test_each_lost_photo_is_told_why_and_what_to_take() -> None:
    features = {"a": 900, "b": 40, "c": 800, "d": 700, "e": 900, "f": 1000, "g": 950, "h": 900}
    best = {
        "b": [3, 0, 0],
        "c": [14, 0, 0],
        "d": [60, 9, 0],
        "e": [99, 80, 0],
        "f": [99, 80, 3],
        "h": [99, 50, 40],
    }
    one = Outcome(9, features, [], best, apart=[["e", "x", "y"]])
    lost = {name: why_lost(name, one) for name in "bcdefh"}
    assert lost == {
        "b": "blurred, dark or without texture: 40 features (median of all photos: 900)",
        "c": "it matches no other photo",
        "d": "60 matches with its best partner, of which only 9 fit one camera geometry",
        "e": "it only matches photos that have no pose either",
        "f": "it only matches photos that have no pose either",
        "h": "too few matches (40) with photos that have a pose",
    }
    assert what_to_take({name: lost[name] for name in "bch"}, []) == (
        "take these photos again, sharp and bright: b; take photos between the others and c, h"
    )
    assert what_to_take({"e": lost["e"]}, one.apart).startswith("1 photos match each other but no")
    assert what_to_take({}, []) == ""


def test_two_captures_in_one_folder_are_told_apart(photos: list[np.ndarray], tmp_path: Path) -> None:
    """The second one is the first in a mirror, which no feature recognises."""
    for k, image in enumerate(photos[:5]):
        Image.fromarray(image).save(tmp_path / f"a{k}.png")
        if k < 3:
            Image.fromarray(np.ascontiguousarray(image[:, ::-1])).save(tmp_path / f"b{k}.png")
    report = load_scene(tmp_path, test_every=3).sfm
    assert report is not None
    assert report.not_registered == ["b0.png", "b1.png", "b2.png"]
    assert set(report.lost.values()) == {"it only matches photos that have no pose either"}
    assert report.advice is not None
    assert "3 photos match each other but no others (b0.png, b1.png, b2.png)" in report.advice


def work_on(photos: list[np.ndarray], folder: Path) -> dict[str, np.ndarray]:
    """The photos in `folder / "photos"`, and what the program of COLMAP is given of them."""
    (folder / "photos").mkdir(parents=True)
    names = [f"{k}.png" for k in range(len(photos))]
    for name, image in zip(names, photos, strict=True):
        Image.fromarray(image).save(folder / "photos" / name)
    given = {"names": np.array(names), "photos": np.array(str(folder / "photos")), "coarse": np.array(True)}
    given |= {"sizes": np.array([(WIDTH, HEIGHT)]), "focals": np.zeros(1)}
    given["camera_of"] = np.zeros(len(names), np.intp)
    np.savez(folder / "input.npz", **given)  # pyright: ignore[reportArgumentType]
    return given


def test_photos_are_looked_at_coarsely_where_that_is_enough(photos: list[np.ndarray], tmp_path: Path) -> None:
    found = []
    for folder, coarse in ((tmp_path / "a", True), (tmp_path / "b", False)):
        given = work_on(photos, folder)
        if not coarse:
            del given["coarse"]
        found.append(best_attempt(Work(folder, given)))
    assert [one.one.name for one in found] == ["coarse", "fine"]
    assert [one.registered for one in found] == [len(photos)] * 2
    counts = [sum(one.facts()["features"].values()) for one in found]
    assert counts[0] < 0.6 * counts[1]


def test_photos_that_coarse_features_do_not_place_are_looked_at_finely(
    photos: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(all_passes, "COARSE", 3)  # features, which place nothing
    work_on(photos, tmp_path)
    program.reconstruct(tmp_path)
    told = json.loads((tmp_path / "facts.json").read_text())
    assert told["registered"] == len(photos)
    assert min(told["features"].values()) > 50


@pytest.mark.parametrize("coarse", [True, False])
def test_all_photos_are_looked_at_again_only_where_a_few_lost_ones_gain_by_it(
    photos: list[np.ndarray], tmp_path: Path, coarse: bool
) -> None:
    """A photo of something else has no place, however it is looked at."""
    foreign = np.random.default_rng(0).integers(0, 256, photos[0].shape).astype(np.uint8)
    given = work_on([*photos, foreign], tmp_path)
    if not coarse:
        del given["coarse"]
    assert best_attempt(Work(tmp_path, given)).registered == len(photos)
    tried = tmp_path / ("fine.db" if coarse else "smoothed.db")
    with pycolmap.Database.open(tried) as db:
        seen = [db.num_keypoints_for_image(k + 1) > 0 for k in range(len(photos) + 1)]
    assert 0 < sum(seen) <= 3  # it, and the two that it matches best


def test_features_of_several_looks_lie_side_by_side(tmp_path: Path) -> None:
    """The second photo has none in the first look."""
    given = {"names": np.array(["a", "b"]), "sizes": np.full((2, 2), 9), "Ks": np.tile(np.eye(3), (2, 1, 1))}
    paths = [tmp_path / f"{k}.db" for k in range(3)]
    for path in paths:
        known_cameras(given, path)
    points = np.random.default_rng(0).random((2, 5, 6), np.float32)
    rows = np.array([[0, 1], [3, 2]], np.uint32)
    for path, features, count in zip(paths, points, (0, 4), strict=False):
        with pycolmap.Database.open(path) as db:
            db.write_keypoints(1, features)
            if count:
                db.write_keypoints(2, features[:count])
                db.write_matches(1, 2, rows)
    join(paths[:2], paths[2], 2)
    with pycolmap.Database.open(paths[2]) as db:
        np.testing.assert_array_equal(db.read_keypoints(1), points.reshape(10, 6))
        np.testing.assert_array_equal(db.read_keypoints(2), points[1, :4])
        np.testing.assert_array_equal(db.read_matches(1, 2), np.add(rows, [5, 0]))


def test_where_photos_placed_one_after_the_other_find_no_place_all_are_placed_at_once(
    photos: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And where the matches do not bear that out, they are not."""
    monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *args, **kwargs: {})
    given = work_on(photos, tmp_path)
    found = Attempt(Work(tmp_path, given), PASSES[0])
    found.run()
    assert found.registered == len(photos)
    monkeypatch.setattr(all_passes, "borne_out", lambda *args: 0.7)
    found = Attempt(Work(tmp_path, given), PASSES[0])
    found.run()
    assert found.model is None


def test_of_many_photos_those_that_are_alike_are_matched(tmp_path: Path) -> None:
    """Three things in turn, 90 photos: each photo shows half of one thing, and something of its own."""
    rng = np.random.default_rng(0)

    def descriptors(count: int) -> np.ndarray:
        found = rng.exponential(size=(count, 128))
        return np.rint(512 * found / np.linalg.norm(found, axis=1, keepdims=True)).clip(0, 255)

    things, count = [descriptors(300) for _ in range(3)], 90
    with pycolmap.Database.open(tmp_path / "a.db") as db:
        db.write_camera(
            pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=9, height=9, params=[9, 4, 4])
        )
        for k in range(count):
            db.write_image(pycolmap.Image(name=str(k), camera_id=1, image_id=k + 1), use_image_id=True)
            if k == 7:
                continue  # a photo without features
            seen = np.concatenate([rng.permutation(things[k % 3])[:150], descriptors(150)])
            seen = (seen + rng.normal(0, 4, seen.shape)).clip(0, 255).round().astype(np.uint8)
            points = np.column_stack([rng.random((300, 2)), np.tile([3.0, 0, 0, 3.0], (300, 1))])
            points[:150, 2:] *= 2  # what it shares is larger
            db.write_keypoints(k + 1, points.astype(np.float32))
            db.write_descriptors(k + 1, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, seen))
        pairs = likely_pairs(db, count)
    assert pairs.tolist() == sorted(pairs.tolist())
    chosen = {(i, j) for i, j in pairs.tolist()}
    near = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + 5))}
    assert near <= chosen
    alike = [(i - j) % 3 == 0 for i, j in chosen - near]
    assert len(alike) > 20 * count / 2 * 0.8
    assert np.mean(alike) > 0.95
    assert len(chosen) < count * (count - 1) / 2 / 2


def test_few_photos_and_a_colmap_that_fails_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture(0).save(tmp_path / "one.jpg")
    with pytest.raises(ValueError, match="at least 3 photos, got 1: 20 to 100 that overlap"):
        load_scene(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="is empty: give a folder with photos"):
        load_scene(tmp_path / "empty")
    (tmp_path / "empty" / "all.zip").write_bytes(b"")
    with pytest.raises(ValueError, match=r"holds no photos, but all.zip: unpack it"):
        load_scene(tmp_path / "empty")
    for k in range(4):
        picture(k).save(tmp_path / f"{k}.jpg")
    monkeypatch.setattr(colmap_run, "PROGRAM", tmp_path / "no such program.py")
    with pytest.raises(ValueError, match=r"COLMAP ended with status 2 .*no such program"):
        load_scene(tmp_path)


def test_observations_that_lie_far_off_do_not_turn_the_cameras(
    photos: list[np.ndarray], tmp_path: Path
) -> None:
    """3 px is near enough to be placed with, and far in photos of this size."""
    given = work_on(photos, tmp_path)
    one = Attempt(Work(tmp_path, given), FINE)
    one.run()
    assert one.model is not None
    right = rotations(one.model)
    for image in one.model.images.values():
        for point in list(image.points2D)[::10]:
            point.xy = np.add(point.xy, (3.0, 0.0))
    pycolmap.bundle_adjustment(one.model, one.work.mapping().get_global_bundle_adjustment())
    one.model.update_point_3d_errors()
    turned = rotation_angles(rotations(one.model) @ right.swapaxes(1, 2))
    one.work.settle(one.model)
    settled = rotation_angles(rotations(one.model) @ right.swapaxes(1, 2))
    assert np.median(settled) < 0.3 * np.median(turned)


def rotations(model: Any) -> np.ndarray:
    """[V, 3, 3] from the first camera to each other one."""
    matrices = np.stack([pose[:3, :3] for pose in registered(model).values()])
    return matrices[1:] @ matrices[0].T
