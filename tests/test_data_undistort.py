"""Every camera model becomes a pinhole, and points go into one and back."""

from __future__ import annotations

import tracemalloc
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from fixtures_scenes import HEIGHT, WIDTH, make_truth, write_colmap, write_transforms
from numpy.typing import NDArray
from PIL import Image
from tiny_scene import tiny_scene

from hqgs.scene.geometry import project, unproject
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Camera, Scene, View
from hqgs.scene.views import Pinhole

F = [40.0, 42.0, 25.0, 17.5]
MODELS = {
    "SIMPLE_RADIAL": [40.0, 25, 17.5, -0.2],
    "RADIAL": [40.0, 25, 17.5, -0.25, 0.05],
    "OPENCV": [*F, -0.2, 0.03, 0.01, -0.015],
    "FULL_OPENCV": [*F, -0.2, 0.03, 0.01, -0.01, 0.01, 0.02, 0.01, 0.0],
    "OPENCV_FISHEYE": [*F, 0.05, -0.01, 0.004, -0.001],
    "SIMPLE_RADIAL_FISHEYE": [40.0, 25, 17.5, 0.1],
    "RADIAL_FISHEYE": [40.0, 25, 17.5, 0.1, -0.02],
    "FOV": [*F, 1.6],
    "THIN_PRISM_FISHEYE": [*F, 0.05, -0.01, 0.005, 0.004, 0.002, 0, 0.01, -0.01],
    "RAD_TAN_THIN_PRISM_FISHEYE": [*F, 0.05, 0.01, 0, 0, 0, 0, 0.004, 0.003, 0.01, 0, -0.01, 0],
    "SIMPLE_DIVISION": [40.0, 25, 17.5, -0.3],
    "DIVISION": [*F, -0.3],
    "SIMPLE_FISHEYE": [40.0, 25, 17.5],
    "FISHEYE": F,
    "EUCM": [*F, 0.6, 1.1],
}
RAYS = np.array([[-0.4, -0.25, 1], [0.37, -0.27, 1], [-0.38, 0.28, 1], [0.33, 0.26, 1], [0.05, 0.02, 1]])


def dots(at: NDArray[np.float64], width: int, height: int, sigma: float = 1.0) -> NDArray[np.uint8]:
    """Soft white dots on black around the positions [P, 2], pixel centres at half-integers."""
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    far = (x[None, :, None] - at[:, 0]) ** 2 + (y[:, None, None] - at[:, 1]) ** 2
    grey = np.rint(250 * np.exp(-0.5 * far / sigma**2).max(-1)).astype(np.uint8)
    return np.repeat(grey[..., None], 3, -1)


def centroid(image: NDArray[Any], at: NDArray[np.float64], reach: float = 4.0) -> NDArray[np.float64]:
    """Centre of brightness within `reach` of `at`."""
    x, y = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
    weight = np.where((x - at[0]) ** 2 + (y - at[1]) ** 2 < reach**2, image[..., 0].astype(float), 0)
    return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


def check_dots(view: View, rays: NDArray[np.float64], tolerance: float) -> None:
    """Each ray's dot lies where the pinhole puts it, and every ray is in the picture."""
    pixels = (rays @ view.camera.K.T)[:, :2]
    assert (pixels > 2).all()
    assert (pixels < [view.camera.width - 2, view.camera.height - 2]).all()
    for pixel in pixels:
        assert np.abs(centroid(view.image, pixel) - pixel).max() < tolerance


def scene_of_dots(tmp_path: Path, model: str, params: list[float]) -> View:
    camera = pycolmap.Camera(model=model, params=params, width=WIDTH, height=HEIGHT)
    at = np.asarray(camera.img_from_cam(RAYS))
    straight = RAYS[:, :2] * [40, 42] + [25, 17.5]
    assert np.abs(at - straight).max() > 0.5  # or the test would not notice the distortion
    truth = replace(make_truth(1), model=model, params=params, photos=[dots(at, WIDTH, HEIGHT)])
    return load_scene(write_colmap(truth, tmp_path), test_every=0).train[0]


@pytest.mark.parametrize("model", MODELS)
def test_dots_land_where_the_pinhole_projects(tmp_path: Path, model: str) -> None:
    if model not in pycolmap.CameraModelId.__members__:
        pytest.skip(f"this pycolmap has no {model}")
    view = scene_of_dots(tmp_path, model, MODELS[model])
    assert view.camera.K[0, 0] == pytest.approx(40, rel=0.02)
    assert view.image.shape == (view.camera.height, view.camera.width, 3)
    check_dots(view, RAYS, tolerance=0.15)


def opencv(x: NDArray[np.float64], k1: float, k2: float, p1: float, p2: float) -> NDArray[np.float64]:
    """OpenCV's documented model, x' = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2), and so on."""
    r2 = (x**2).sum(-1)
    xy = x[:, 0] * x[:, 1]
    radial = x * (1 + k1 * r2 + k2 * r2**2)[:, None]
    a = 2 * p1 * xy + p2 * (r2 + 2 * x[:, 0] ** 2)
    b = p1 * (r2 + 2 * x[:, 1] ** 2) + 2 * p2 * xy
    return radial + np.stack([a, b], -1)


def fisheye(x: NDArray[np.float64], k1: float, k2: float, k3: float, k4: float) -> NDArray[np.float64]:
    """OpenCV's fisheye: the angle t becomes t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)."""
    r = np.linalg.norm(x, axis=-1)
    t = np.arctan(r)
    return x * (t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) / r)[:, None]


@pytest.mark.parametrize("kind", ["OPENCV", "OPENCV_FISHEYE"])
def test_against_the_formula_through_transforms_json(tmp_path: Path, kind: str) -> None:
    """No pycolmap in the drawing, and intrinsics declared at twice the photo's size."""
    if kind == "OPENCV":
        values = {"k1": -0.2, "k2": 0.03, "p1": 0.01, "p2": -0.015}
        at = opencv(RAYS[:, :2], **values)
    else:
        values = {"k1": 0.05, "k2": -0.01, "k3": 0.004, "k4": -0.001}
        at = fisheye(RAYS[:, :2], **values)
    photo = dots(at * [40, 42] + [25, 17.5], WIDTH, HEIGHT)
    size = {"fl_x": 80.0, "fl_y": 84.0, "cx": 50.0, "cy": 35.0, "w": 2 * WIDTH, "h": 2 * HEIGHT}
    truth = replace(make_truth(1), photos=[photo])
    write_transforms(truth, tmp_path, **values, **size, camera_model=kind)
    view = load_scene(tmp_path, test_every=0).train[0]
    assert view.camera.K[0, 0] == pytest.approx(40, rel=0.02)
    check_dots(view, RAYS, tolerance=0.15)


def test_one_focal_length_and_two_ratios(tmp_path: Path) -> None:
    """A SIMPLE_RADIAL camera of 97 x 73 with a photo of 48 x 37: each axis scales by its own ratio."""
    params = [80.0, 50.0, 35.0, -0.2]
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", params=params, width=97, height=73)
    at = np.asarray(camera.img_from_cam(RAYS)) * [48 / 97, 37 / 73]
    truth = replace(make_truth(1), model="SIMPLE_RADIAL", params=params, width=97, height=73)
    truth = replace(truth, photos=[dots(at, 48, 37)])
    view = load_scene(write_colmap(truth, tmp_path), test_every=0).train[0]
    check_dots(view, RAYS, tolerance=0.1)
    assert view.camera.K[0, 0] / view.camera.K[1, 1] == pytest.approx((48 / 97) / (37 / 73), rel=0.02)


def test_undistort_comes_before_downscale(tmp_path: Path) -> None:
    params = [160.0, 100.0, 70.0, -0.2]
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", params=params, width=192, height=144)
    photo = dots(np.asarray(camera.img_from_cam(RAYS)), 192, 144, sigma=4)
    truth = replace(
        make_truth(1), model="SIMPLE_RADIAL", params=params, width=192, height=144, photos=[photo]
    )
    write_colmap(truth, tmp_path)
    full = load_scene(tmp_path, test_every=0).train[0]
    small = load_scene(tmp_path, downscale=4, test_every=0).train[0]
    assert small.camera.width == round(full.camera.width / 4)
    ratio = np.diag([small.camera.width / full.camera.width, small.camera.height / full.camera.height, 1])
    np.testing.assert_allclose(small.camera.K, ratio @ full.camera.K)
    check_dots(small, RAYS, tolerance=0.15)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", [40.0, 25.0, 17.5]),
        ("OPENCV", [*F, 0, 0, 0, 0]),
        ("SIMPLE_RADIAL", [40.0, 25.0, 17.5, 1e-5]),
    ],
)
def test_straight_cameras_keep_their_pixels(tmp_path: Path, model: str, params: list[float]) -> None:
    truth = replace(make_truth(1), model=model, params=params)
    view = load_scene(write_colmap(truth, tmp_path), test_every=0).train[0]
    np.testing.assert_array_equal(view.image, truth.photos[0])
    expected = [params[0], params[-3 if model == "SIMPLE_RADIAL" else 1], 25.0, 17.5]
    if model != "OPENCV":
        expected = [params[0], params[0], 25.0, 17.5]
    np.testing.assert_allclose(view.camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], expected)


def test_mask_is_undistorted_with_its_photo(tmp_path: Path) -> None:
    """A hidden dot: hidden everywhere its light reaches in the new picture, and nowhere far from it."""
    camera = pycolmap.Camera(model="OPENCV", params=MODELS["OPENCV"], width=WIDTH, height=HEIGHT)
    spot = np.asarray(camera.img_from_cam(RAYS[:1]))
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    x, y = np.floor(spot[0]).astype(int)
    mask[y - 2 : y + 3, x - 2 : x + 3] = 255
    truth = replace(make_truth(1), model="OPENCV", params=MODELS["OPENCV"])
    truth = replace(truth, photos=[np.repeat(mask[..., None], 3, -1)])
    write_colmap(truth, tmp_path)
    (tmp_path / "masks").mkdir()
    Image.fromarray(255 - mask).save(tmp_path / "masks/view_00.png")
    view = load_scene(tmp_path, test_every=0).train[0]
    assert view.mask is not None
    assert view.image[view.mask].max() == 0
    ys, xs = np.nonzero(~view.mask)
    pixel = (RAYS[0] @ view.camera.K.T)[:2]
    assert 25 <= len(xs) <= 110
    assert max(np.abs(xs + 0.5 - pixel[0]).max(), np.abs(ys + 0.5 - pixel[1]).max()) < 6


def test_pixels_outside_the_photo_do_not_count() -> None:
    """A picture moved left by half its width by a grid made by hand."""
    y, x = np.mgrid[:8, :8]
    grid = torch.from_numpy(np.stack([(x + 0.5 + 4) / 4 - 1, (y + 0.5) / 4 - 1], -1).astype(np.float32))[None]
    inside = x < 4
    pinhole = Pinhole(8, 8, np.eye(3), grid, inside)
    image = np.repeat((10 * x).astype(np.uint8)[..., None], 3, -1)
    np.testing.assert_array_equal(pinhole.picture(image)[:, :4], image[:, 4:])
    np.testing.assert_array_equal(pinhole.mask(None), inside)
    hidden = np.ones((8, 8), bool)
    hidden[2, 6] = False
    mask = pinhole.mask(hidden)
    assert mask is not None
    assert not mask[2, 2]
    assert mask[:, :4].sum() == 32 - 9  # the hidden pixel and those whose bicubic footprint may reach it
    assert not mask[:, 4:].any()


def test_a_camera_that_sees_nothing_is_refused(tmp_path: Path) -> None:
    truth = replace(make_truth(1), model="OPENCV", params=[40, 40, 40_000, 18, -0.1, 0, 0, 0])
    with pytest.raises(ValueError, match=r"view_00\.png' cannot be undistorted: .*nothing of the photo"):
        load_scene(write_colmap(truth, tmp_path), test_every=0)


# --- Points into a camera and back


# The camera stands at (1, 2, 3) and looks along world x: its right is -y, its down is -z.
LOOKS_ALONG_X = np.array([[0, -1, 0, 2], [0, 0, -1, 3], [1, 0, 0, -1], [0, 0, 0, 1]], dtype=np.float64)


@pytest.fixture
def camera():
    return Camera(64, 48, np.array([[50.0, 0, 30], [0, 40, 20], [0, 0, 1]]), LOOKS_ALONG_X)


def test_a_point_worked_out_by_hand(camera):
    pixels, depths = project(camera, np.array([[5.0, 1.0, 4.0]]))  # 4 ahead, 1 to the right, 1 up
    np.testing.assert_allclose(depths, [4])
    np.testing.assert_allclose(pixels, [[30 + 50 / 4, 20 - 40 / 4]])


def test_unproject_is_the_way_back(camera):
    rng = np.random.default_rng(0)
    pixels, depths = rng.uniform(-20, 90, (100, 2)), rng.uniform(0.01, 1e4, 100)
    again, same = project(camera, unproject(camera, pixels, depths))
    np.testing.assert_allclose(again, pixels, atol=1e-8)
    np.testing.assert_allclose(same, depths, rtol=1e-9, atol=1e-12)


def test_points_beside_and_behind_are_told_by_their_depths(camera):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pixels, depths = project(camera, np.array([[1.0, 1.0, 1.0], [0.0, 2.0, 3.0]]))
    np.testing.assert_array_equal(depths, [0, -1])
    assert not np.isfinite(pixels[0]).any()
    assert project(camera, np.zeros((0, 3)))[0].shape == (0, 2)


def test_the_reach_of_a_large_scene_takes_little_memory() -> None:
    view, rng = tiny_scene().train[0], np.random.default_rng(0)
    points = rng.normal([0, 0, 5], 1, (400_000, 3)).astype(np.float32)
    scene = Scene("many", [view] * 60, [], points, np.zeros((400_000, 3), np.uint8), "test")
    tracemalloc.start()
    reach = scene.reach
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6  # 672 MB if each view kept the depths of all points
    depths = points @ view.camera.viewmat[2, :3] + view.camera.viewmat[2, 3]
    assert reach == pytest.approx(np.median(depths[depths > 0]), rel=0.01)
