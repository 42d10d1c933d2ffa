"""LLFF and Deblur-NeRF folders, and what `load_scene` says to folders and arguments it cannot use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures_scenes import CX, CY, FX, HEIGHT, WIDTH, make_truth, write_colmap, write_llff, write_photos

from hqgs.scene.load import load_scene

CENTRED = np.array([[FX, 0, WIDTH / 2], [0, FX, HEIGHT / 2], [0, 0, 1]])


def test_cameras_and_random_points(tmp_path: Path) -> None:
    truth = make_truth()
    scene = load_scene(write_llff(truth, tmp_path))
    assert scene.source == "llff"
    assert [v.name for v in scene.test] == [truth.names[0], truth.names[8]]
    for view in scene.train + scene.test:
        i = truth.names.index(view.name)
        np.testing.assert_allclose(view.camera.viewmat, truth.viewmats[i], atol=1e-12)
        np.testing.assert_allclose(view.camera.K, CENTRED)
        np.testing.assert_array_equal(view.image, truth.photos[i])
    assert "there is no COLMAP model" in scene.notes[0]
    assert "20000 random points within the given depth bounds" in scene.notes[1]

    # 7 training views share the points in order; each share lies within its view's bounds and frame, and
    # has the colour of the pixel that it projects to.
    shares = np.split(scene.points.astype(np.float64), [20_000 * (k + 1) // 7 for k in range(6)])
    colors = np.split(scene.point_colors, [20_000 * (k + 1) // 7 for k in range(6)])
    for view, points, color in zip(scene.train, shares, colors, strict=True):
        p = (points @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]) @ view.camera.K.T
        assert 2 - 1e-4 < p[:, 2].min() < 2.1
        assert 8.5 < p[:, 2].max() < 9 + 1e-4
        x, y = np.floor(p[:, :2] / p[:, 2:]).astype(int).T
        np.testing.assert_array_equal(view.image[y, x], color)
    again = load_scene(tmp_path)
    np.testing.assert_array_equal(again.points, scene.points)


def test_size_and_focal_length_refer_to_the_full_photos(tmp_path: Path) -> None:
    scene = load_scene(write_llff(make_truth(), tmp_path, full=8))
    np.testing.assert_allclose(scene.train[0].camera.K, CENTRED)


def test_images_n_and_scaling(tmp_path: Path) -> None:
    truth = make_truth(3)
    write_llff(truth, tmp_path)
    write_photos(replace(truth, photos=[p[::2, ::2] for p in truth.photos]), tmp_path / "images_2")
    scene = load_scene(tmp_path, downscale=2)
    np.testing.assert_array_equal(scene.train[0].image, truth.photos[1][::2, ::2])
    assert scene.notes[0] == "photos were read from images_2, which has them at downscale 2"
    scaled = load_scene(tmp_path, downscale=3)
    np.testing.assert_allclose(scaled.train[0].camera.K, np.diag([1 / 3, 1 / 3, 1]) @ CENTRED)
    assert not any("images_" in n for n in scaled.notes)


def test_colmap_model_wins_where_it_has_photos(tmp_path: Path) -> None:
    """Both are there, in different frames: cameras and points must come from one of them."""
    truth = make_truth()
    moved = truth.viewmats.copy()
    moved[:, :3, 3] *= 3
    write_llff(replace(truth, viewmats=moved), tmp_path)
    write_colmap(truth, tmp_path)
    scene = load_scene(tmp_path)
    np.testing.assert_allclose(scene.train[0].camera.viewmat, truth.viewmats[1], atol=1e-12)
    np.testing.assert_array_equal(scene.points, truth.points)
    assert scene.source == "colmap"
    assert "cameras and points are read from the COLMAP model" in scene.notes[0]
    (tmp_path / "sparse/0/images.bin").unlink()  # half a model is none
    assert load_scene(tmp_path).source == "llff"


@pytest.mark.parametrize("images", ["images", "images_1"])
def test_deblur_nerf_layout(tmp_path: Path, images: str) -> None:
    truth = make_truth()
    write_llff(truth, tmp_path, images=images)
    (tmp_path / "hold=4").touch()
    scene = load_scene(tmp_path, test_every=8)
    assert [v.name for v in scene.test] == [truth.names[i] for i in (0, 4, 8)]
    assert len(scene.train) == 6
    assert any(n.startswith("hold=4: every 4th photo is held out") for n in scene.notes)


@pytest.mark.parametrize("markers", [["hold=0"], ["hold=x"], ["hold="], ["hold=4", "hold=8"]])
def test_bad_markers(tmp_path: Path, markers: list[str]) -> None:
    write_llff(make_truth(), tmp_path)
    for name in markers:
        (tmp_path / name).touch()
    with pytest.raises(ValueError, match="marker file hold=N"):
        load_scene(tmp_path)


def test_photo_count_must_match(tmp_path: Path) -> None:
    write_llff(make_truth(), tmp_path)
    (tmp_path / "images/view_04.png").unlink()
    with pytest.raises(ValueError, match=r"has 9 cameras, .* has 8 photos"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [
        (0, 5.0, r"view_01\.png.*no rotation"),
        (14, -1.0, r"view_01\.png.*h, w, f"),
        (9, 1e300, r"view_01\.png.*h, w, f"),
        (15, 0.0, r"view_01\.png.*depth bounds 0\.0, 9\.0"),
        (16, np.inf, r"view_01\.png.*depth bounds"),
    ],
)
def test_bad_rows_name_the_photo(tmp_path: Path, index: int, value: float, message: str) -> None:
    write_llff(make_truth(), tmp_path)
    rows = np.load(tmp_path / "poses_bounds.npy")
    rows[1, index] = value
    np.save(tmp_path / "poses_bounds.npy", rows)
    with pytest.raises(ValueError, match=message):
        load_scene(tmp_path)


@pytest.mark.parametrize("kind", ["objects", "shape", "integers", "empty"])
def test_bad_poses_file(tmp_path: Path, kind: str) -> None:
    write_llff(make_truth(), tmp_path)
    path = tmp_path / "poses_bounds.npy"
    if kind == "objects":
        np.save(path, np.array([[print] * 17], object), allow_pickle=True)
    elif kind == "shape":
        np.save(path, np.zeros((9, 15)))
    elif kind == "integers":
        np.save(path, np.zeros((9, 17), np.int64))
    else:
        path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"poses_bounds\.npy"):
        load_scene(tmp_path)


def test_unknown_folder_says_what_was_looked_for_and_found(tmp_path: Path) -> None:
    (tmp_path / "holiday.txt").touch()
    with pytest.raises(
        ValueError, match=r"no scene \(a COLMAP model.*poses_bounds\.npy\); it holds holiday\.txt"
    ):
        load_scene(tmp_path)
    with pytest.raises(ValueError, match="is a file"):
        load_scene(tmp_path / "holiday.txt")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_scene(tmp_path / "nowhere")


@pytest.mark.parametrize("downscale", [0.5, 0.0, -2.0, float("nan"), float("inf")])
def test_bad_downscale(tmp_path: Path, downscale: float) -> None:
    with pytest.raises(ValueError, match="downscale must be at least 1"):
        load_scene(write_llff(make_truth(), tmp_path), downscale=downscale)


def test_downscale_to_less_than_8_pixels(tmp_path: Path) -> None:
    write_llff(make_truth(), tmp_path)
    assert load_scene(tmp_path, downscale=4.5).train[0].image.shape == (8, 11, 3)
    with pytest.raises(ValueError, match=r"view_0.\.png' is 10 x 7 pixels after downscale 5"):
        load_scene(tmp_path, downscale=5)


def test_test_every(tmp_path: Path) -> None:
    write_llff(make_truth(), tmp_path)
    assert len(load_scene(tmp_path, test_every=0).test) == 0
    with pytest.raises(ValueError, match="test_every must be at least 0, got -1"):
        load_scene(tmp_path, test_every=-1)
    with pytest.raises(ValueError, match="all 9 photos are held out"):
        load_scene(tmp_path, test_every=1)


def test_a_relative_path_is_the_same_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(make_truth(), tmp_path / "a")
    (tmp_path / "b").mkdir()
    monkeypatch.chdir(tmp_path / "b")
    scene = load_scene("../a")
    assert scene.name == "a"
    assert scene.notes == []
    assert (scene.train[0].camera.K[0, 2], scene.train[0].camera.K[1, 2]) == (CX, CY)
