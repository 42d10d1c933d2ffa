"""Poses and points from photos: textured cards at known places, seen by known cameras."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from fixtures_cards import CARDS, HEIGHT, WIDTH
from PIL import Image

import hqgs
from hqgs.base.stages import Stage
from hqgs.photos.formula import parse_degradation
from hqgs.scene.degrade import degrade_scene
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene, View
from hqgs.scene.sfm import run as colmap_run
from hqgs.scene.sfm.reconstruct import sfm_scene


@pytest.fixture(scope="module")
def found(cards: Scene) -> Scene:
    return sfm_scene(replace(cards, guessed=True))


def test_poses_and_points_are_those_of_the_scene(cards: Scene, found: Scene) -> None:
    assert [view.name for view in found.train] == [view.name for view in cards.train]
    for new, own in zip(found.train, cards.train, strict=True):
        cosine = (np.trace(new.camera.viewmat[:3, :3] @ own.camera.viewmat[:3, :3].T) - 1) / 2
        assert np.rad2deg(np.arccos(min(cosine, 1))) < 0.2
        assert np.linalg.norm(new.camera.center - own.camera.center) < 0.02 * cards.extent
        assert new.camera.K is own.camera.K
        assert new.image is own.image
    assert found.test is cards.test
    assert not found.guessed
    depth = found.points[:, 2, None]
    away = np.abs(depth - [card[0] for card in CARDS]).min(1)
    assert len(found.points) > 150
    assert np.median(away) < 0.03
    assert found.points.dtype == np.float32
    assert found.point_colors.shape == found.points.shape


def test_it_tells_which_photos_show_which_points(found: Scene) -> None:
    assert found.seen is not None
    assert found.sfm is not None
    assert set(found.seen) == {view.name for view in found.train}
    observations = sum(map(len, found.seen.values()))
    assert observations == pytest.approx(found.sfm.track_length * len(found.points), rel=0.01)
    shown, colors = [], []
    for view in found.train:
        rows, camera = found.seen[view.name], view.camera
        inside = found.points[rows] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        x, y = ((inside @ camera.K.T)[:, :2] / inside[:, 2:]).T.astype(int)
        assert ((x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)).all()
        shown.append(view.image[y, x].ravel())
        colors.append(found.point_colors[rows].ravel())
    # Features lie where the photo changes, and the colours are means over the photos.
    likeness = np.corrcoef(np.concatenate(shown), np.concatenate(colors))[0, 1]
    others = np.corrcoef(np.concatenate(shown), np.roll(np.concatenate(colors), 30))[0, 1]
    assert likeness > 0.7 > 0.3 > others


def test_the_report_says_how_far_they_are_off(cards: Scene, found: Scene) -> None:
    report = found.sfm
    assert report is not None
    assert report.translation_error is not None
    assert report.rotation_error_deg is not None
    assert report.own_cameras_px is not None
    errors = [
        np.linalg.norm(new.camera.center - own.camera.center) / cards.extent
        for new, own in zip(found.train, cards.train, strict=True)
    ]
    assert report.translation_error["median"] == pytest.approx(np.median(errors))
    assert report.translation_error["max"] == pytest.approx(max(errors))
    assert 0 < report.rotation_error_deg["median"] <= report.rotation_error_deg["max"] < 0.2
    assert (report.photos, report.not_registered, report.points) == (7, [], len(found.points))
    assert report.own_cameras_px < 0.5
    assert report.track_length >= 2
    assert 0 < report.reprojection_error_px < 1
    assert report.own_points == 500
    assert report.auc is not None
    assert 0.5 < report.auc["1"] < report.auc["3"] < report.auc["5"] < 1
    json.dumps(asdict(report), allow_nan=False)
    assert found.notes == [*cards.notes, str(report)]
    assert "7 of 7 registered" in str(report)
    behind = str(replace(report, own_cameras_px=None))
    assert "the scene's own cameras see the new points behind them" in behind


def test_no_thread_and_no_held_out_view_changes_a_bit(cards: Scene, found: Scene) -> None:
    black = [replace(view, image=np.zeros_like(view.image)) for view in cards.test]
    threads = hqgs.get_num_threads()
    hqgs.set_num_threads(3 if threads < 3 else 1)
    again = sfm_scene(replace(cards, test=black))
    assert again.points.tobytes() == found.points.tobytes()
    for a, b in zip(again.train, found.train, strict=True):
        assert a.camera.viewmat.tobytes() == b.camera.viewmat.tobytes()


def test_smoothed_photos_and_patches_place_noisy_ones_on_any_threads(cards: Scene) -> None:
    """Without them 6 of the 7 or fewer have a place."""
    noisy = degrade_scene(cards, parse_degradation("noise:50"), 0)
    stages, found = set[str](), []
    for count in (1, 3):
        hqgs.set_num_threads(count)
        found.append(sfm_scene(noisy, on_stage=lambda stage: stages.add(stage.what)))
    assert "COLMAP: features of smoothed photos" in stages
    assert len(found[0].train) == 7
    assert found[0].sfm is not None
    assert found[0].sfm.rotation_error_deg is not None
    assert found[0].sfm.rotation_error_deg["median"] < 0.3
    assert found[0].points.tobytes() == found[1].points.tobytes()
    for a, b in zip(found[0].train, found[1].train, strict=True):
        assert a.camera.viewmat.tobytes() == b.camera.viewmat.tobytes()


def test_a_reconstruction_that_is_kept_is_not_made_again(
    cards: Scene, found: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sfm_scene(cards, tmp_path / "run" / "sfm")
    (kept,) = (tmp_path / "run" / "sfm").iterdir()
    assert {file.name for file in kept.iterdir()} >= {"cameras.bin", "images.bin", "points3D.bin"}

    def run(*args: object, **kwargs: object) -> None:
        raise AssertionError("COLMAP runs")

    monkeypatch.setattr(colmap_run.subprocess, "Popen", run)
    again = sfm_scene(cards, tmp_path / "run" / "sfm")
    assert again.points.tobytes() == found.points.tobytes()
    assert again.sfm == found.sfm
    for a, b in zip(again.train, found.train, strict=True):
        assert a.camera.viewmat.tobytes() == b.camera.viewmat.tobytes()
    darker = replace(cards.train[0], image=cards.train[0].image - (cards.train[0].image > 0))
    half = np.zeros(darker.image.shape[:2], bool)
    half[: HEIGHT // 2] = True
    wider = replace(darker.camera, K=darker.camera.K * [[1.01], [1.01], [1]])
    for first in (darker, replace(cards.train[0], mask=half), replace(cards.train[0], camera=wider)):
        with pytest.raises(AssertionError, match="COLMAP runs"):
            sfm_scene(replace(cards, train=[first, *cards.train[1:]]), tmp_path / "run" / "sfm")


def test_degraded_photos_without_a_place_are_left_out(cards: Scene) -> None:
    rng = np.random.default_rng(0)
    foreign = replace(cards.train[2], image=rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8))
    bad = degrade_scene(
        replace(cards, train=[*cards.train[:2], foreign, *cards.train[3:]]), parse_degradation("noise:8"), 0
    )
    found = sfm_scene(bad)
    assert [view.name for view in found.train] == [v.name for v in cards.train if v.name != foreign.name]
    assert found.sfm is not None
    assert found.sfm.not_registered == [foreign.name]
    assert foreign.name in found.notes[-1]
    assert found.train[0].image is bad.train[0].image


def test_masked_pixels_give_no_points(cards: Scene) -> None:
    """With the nearest card's half of each photo masked out, no point lies on it."""

    def masked(view: View) -> View:
        x, _, z = (np.array([0.1, 0.25, 3.0]) - view.camera.center) @ view.camera.viewmat[:3, :3].T
        mask = np.ones((HEIGHT, WIDTH), bool)
        mask[:, int(184 * x / z + WIDTH / 2) - 12 :] = False
        return replace(view, mask=mask)

    found = sfm_scene(replace(cards, train=[masked(view) for view in cards.train]))
    assert len(found.points) > 50
    assert (np.abs(found.points[:, 2] - 3.0) < 0.3).mean() < 0.02


def test_what_is_kept_stays_until_its_format_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new COLMAP, or another comment in the code, finds no cameras anew for photos that have some."""
    key = colmap_run.key_of("names", [b"photo"])
    monkeypatch.setattr(pycolmap, "__version__", "99.0")
    monkeypatch.setattr(Path, "read_bytes", lambda path: b"other code")
    assert colmap_run.key_of("names", [b"photo"]) == key
    assert colmap_run.key_of("names", [b"other photo"]) != key
    assert colmap_run.key_of("sizes", [b"photo"]) != key
    monkeypatch.setattr(colmap_run, "FORMAT", colmap_run.FORMAT + 1)
    assert colmap_run.key_of("names", [b"photo"]) != key


def test_photos_that_make_no_scene_are_refused(cards: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="at least 3 photos, got 2"):
        sfm_scene(replace(cards, train=cards.train[:2]))
    flat = [replace(view, image=np.full_like(view.image, 90)) for view in cards.train[:4]]
    with pytest.raises(
        ValueError, match=r"no poses for these 4 photos.* found 0 features .* photos are blurred or dark"
    ):
        sfm_scene(replace(cards, train=flat))
    rng = np.random.default_rng(0)
    foreign = [
        replace(view, name=f"foreign {k}", image=rng.integers(0, 256, view.image.shape).astype(np.uint8))
        for k, view in enumerate(cards.train[:5])
    ]
    with pytest.raises(ValueError, match="registered only 4 of 9 photos"):
        sfm_scene(replace(cards, train=[*cards.train[:4], *foreign]))
    program = Path(sys.prefix) / "no such program.py"
    monkeypatch.setattr(colmap_run, "PROGRAM", program)
    with pytest.raises(ValueError, match=r"COLMAP ended with status 2 .*no such program"):
        sfm_scene(cards)


def test_a_folder_of_photos_alone_becomes_a_scene(cards: Scene, tmp_path: Path) -> None:
    folder, heard = tmp_path / "images", list[Stage]()
    folder.mkdir()
    (tmp_path / "transforms.json").write_text("{}")
    for view in [*cards.train, *cards.test]:
        Image.fromarray(view.image).save(folder / view.name.replace(".jpg", ".png"))
    scene = load_scene(folder, on_stage=heard.append)
    above = f"{tmp_path} holds cameras and points (transforms.json), which are not read: give that folder"
    told = [stage.note for stage in heard if stage.note]
    assert told == [f"{above} to train with them", "9 photos, no camera in EXIF"]
    assert scene.notes[-1].startswith(above)
    assert [view.name for view in scene.test] == ["photo 0.png", "photo 8.png"]
    assert len(scene.train) == 7
    assert scene.source == "photos"
    assert "from all photos, held-out ones too (9 of 9 registered)" in scene.notes[0]
    assert scene.tracks is not None
    assert scene.tracks.error < 1
    assert scene.seen is not None
    assert set(scene.seen) == {f"photo {k}.png" for k in range(9)}
    own = [*cards.test[:1], *cards.train, *cards.test[1:]]
    new = sorted([*scene.train, *scene.test], key=lambda view: view.name)
    a, b = (np.array([v.camera.center for v in views]) for views in (own, new))
    a, b = (np.linalg.norm(c - c[:, None], axis=-1) for c in (a, b))
    np.testing.assert_allclose(b / b.mean(), a / a.mean(), atol=0.1)  # up to its unit, with found intrinsics
