"""Observations moved to where photos agree, and smoothed copies of photos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from hqgs.scene.sfm.passes import smooth_copy
from hqgs.scene.sfm.refine import patches, sharpened
from hqgs.scene.sfm.refine.tracks import Tracks, errors, read_tracks, rebuilt, usual

WIDTH, HEIGHT, FOCAL, DEPTH = 160, 120, 150.0, 4.0
NOISE = 12.0  # levels


def photo_of(pose: np.ndarray) -> np.ndarray:
    """A blotchy plane at DEPTH, seen from a world-to-camera pose [3, 4]."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones(rows.shape)], -1)
    R, t = pose[:, :3], pose[:, 3]
    center, directions = -R.T @ t, rays @ R
    hit = center + directions * ((DEPTH - center[2]) / directions[..., 2])[..., None]
    noise = np.random.default_rng(1).random((500, 500))
    texture = ndimage.gaussian_filter(noise, 2.0)
    texture = (texture - texture.mean()) / texture.std() * 40 + 128
    return ndimage.map_coordinates(texture, [hit[..., 1] * 55 + 250, hit[..., 0] * 55 + 250], order=1)


@pytest.fixture
def made(tmp_path: Path) -> tuple[pycolmap.Reconstruction, list[np.ndarray], Path]:
    """A model whose observations and poses are off, its true poses, and the folder of its noisy photos."""
    rng = np.random.default_rng(4)
    true, folder = [], tmp_path / "photos"
    folder.mkdir()
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT,
        params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2],
    )  # fmt: skip
    model.add_camera_with_trivial_rig(camera)
    names = [f"{k}.png" for k in range(8)]
    for k, name in enumerate(names):
        R = Rotation.from_rotvec(0.03 * rng.standard_normal(3)).as_matrix()
        center = np.array([0.7 * np.cos(k), 0.5 * np.sin(k), 0.3 * np.cos(2 * k)])
        true.append(np.concatenate([R, (-R @ center)[:, None]], axis=1))
        noisy = photo_of(true[-1]) + NOISE * rng.standard_normal((HEIGHT, WIDTH))
        Image.fromarray(np.rint(noisy.clip(0, 255)).astype(np.uint8)).save(folder / name)
        off = true[-1].copy()
        off[:, :3] = Rotation.from_rotvec(0.003 * rng.standard_normal(3)).as_matrix() @ off[:, :3]
        image = pycolmap.Image(name=name, camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(off))
    points = np.concatenate(
        [rng.uniform([-1.6, -1.1], [1.6, 1.1], (150, 2)), np.full((150, 1), DEPTH)], axis=1
    )
    view, point, xy = [], [], []
    for k, pose in enumerate(true):
        inside = points @ pose[:, :3].T + pose[:, 3]
        at = FOCAL * inside[:, :2] / inside[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        shown = ((at > 3) & (at < [WIDTH - 3, HEIGHT - 3])).all(1) & (rng.random(len(at)) < 0.6)
        view.append(np.full(shown.sum(), k))
        point.append(np.flatnonzero(shown))
        xy.append(at[shown] + 0.7 * rng.standard_normal((shown.sum(), 2)))
    tracks = Tracks(
        points + 0.02 * rng.standard_normal(points.shape), np.zeros((150, 3), np.uint8),
        np.concatenate(view), np.concatenate(point), np.concatenate(xy),
    )  # fmt: skip
    return rebuilt(model, names, tracks.chosen(np.ones(len(tracks.view), bool))), true, folder


def adjust(model: pycolmap.Reconstruction, scale: float, move: bool) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = False
    options.refine_rig_from_world = move
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = scale
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)


def turned(model: pycolmap.Reconstruction, true: list[np.ndarray]) -> float:
    """Median angle of the relative rotations of pairs from the true ones, degrees."""
    R = [model.images[k + 1].cam_from_world().matrix()[:, :3] for k in range(len(true))]
    found = [
        Rotation.from_matrix(R[i] @ R[j].T @ (true[i][:, :3] @ true[j][:, :3].T).T).magnitude()
        for i in range(len(true))
        for j in range(i)
    ]
    return float(np.rad2deg(np.median(found)))


def test_patches_make_poses_and_observations_more_precise(
    made: tuple[pycolmap.Reconstruction, list[np.ndarray], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, true, folder = made
    adjust(model, 1.0, True)
    by_features, off = turned(model, true), usual(model)
    better = sharpened(model, folder, adjust)
    assert better.num_reg_images() == 8
    assert usual(better) < 0.5 * off
    assert turned(better, true) < 0.5 * by_features
    # Photos see points that no feature told of, and the rest of the model is one.
    assert better.compute_mean_track_length() > model.compute_mean_track_length()
    assert better.num_points3D() > 0.8 * model.num_points3D()
    assert better.compute_mean_reprojection_error() < 0.5 * off
    monkeypatch.setattr(patches, "AT_ONCE", 200)  # what it holds at once changes no bit
    again = sharpened(model, folder, adjust)
    for k in range(1, 9):
        a, b = (m.images[k].cam_from_world().matrix() for m in (better, again))
        assert a.tobytes() == b.tobytes()


def test_large_photos_are_looked_at_smaller(
    made: tuple[pycolmap.Reconstruction, list[np.ndarray], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, true, folder = made
    adjust(model, 1.0, True)
    by_features, off = turned(model, true), usual(model)
    monkeypatch.setattr(patches, "PATCH_SIDE", 100)
    better = sharpened(model, folder, adjust)
    assert usual(better) < 0.6 * off
    assert turned(better, true) < 0.6 * by_features


def test_photos_that_do_not_fit_change_nothing(
    made: tuple[pycolmap.Reconstruction, list[np.ndarray], Path],
) -> None:
    model, _, folder = made
    adjust(model, 1.0, True)
    rng = np.random.default_rng(7)
    for file in folder.iterdir():
        Image.fromarray(rng.integers(0, 255, (HEIGHT, WIDTH)).astype(np.uint8)).save(file)
    assert sharpened(model, folder, adjust) is model


def test_a_photo_unlike_the_others_keeps_its_observations(
    made: tuple[pycolmap.Reconstruction, list[np.ndarray], Path],
) -> None:
    model, true, folder = made
    adjust(model, 1.0, True)
    by_features = turned(model, true)
    grain = np.random.default_rng(7).integers(0, 255, (HEIGHT, WIDTH)).astype(np.uint8)
    Image.fromarray(grain).save(folder / "3.png")
    better = sharpened(model, folder, adjust)
    assert better.num_reg_images() == 8
    before, after = (m.images[4].num_points3D for m in (model, better))
    assert after > 0.5 * before
    assert turned(better, true) < 0.7 * by_features


def test_tracks_are_read_and_written(made: tuple[pycolmap.Reconstruction, list[np.ndarray], Path]) -> None:
    model, _, _ = made
    names, tracks = read_tracks(model)
    again = rebuilt(model, names, tracks)
    assert len(errors(model)) == len(tracks.view) == model.compute_num_observations()
    np.testing.assert_allclose(errors(again), errors(model))
    first = np.flatnonzero(tracks.point == 0)
    kept = tracks.chosen(~np.isin(np.arange(len(tracks.view)), first[1:]))  # one photo sees it: it goes
    assert len(kept.points) == len(tracks.points) - 1
    both = kept.joined(replace(kept))
    assert len(both.points) == 2 * len(kept.points)
    assert both.point.max() == len(both.points) - 1


def test_smoothed_copies_are_those_of_what_sift_sees(tmp_path: Path) -> None:
    (tmp_path / "photos" / "a").mkdir(parents=True)
    photo = np.zeros((41, 61), np.uint8)
    photo[20, 30] = 255
    Image.fromarray(photo).save(tmp_path / "photos" / "a" / "dot.png")
    for largest, sigma in ((100, 1.0), (30, 61 / 30)):
        copy = tmp_path / f"out{largest}" / "a" / "dot.png"
        smooth_copy(tmp_path / "photos" / "a" / "dot.png", copy, 1.0, largest)
        with Image.open(copy) as image:
            assert image.getpixel((30, 20)) == pytest.approx(255 / (2 * np.pi * sigma**2), rel=0.05)
        assert [p.name for p in copy.parent.iterdir()] == ["dot.png"]
