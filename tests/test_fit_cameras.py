"""Held-out cameras fitted to a trained scene, and the errors of poses between pairs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hqgs.evaluation.fit_cameras import fit_camera
from hqgs.evaluation.metrics import psnr
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.scene.scene import Camera, View
from hqgs.scene.sfm.align import pose_auc

WIDTH, HEIGHT = 64, 48
BLACK = (0.0, 0.0, 0.0)


def blobs() -> Gaussians:
    rng = np.random.default_rng(3)
    points = rng.uniform([-2, -1.5, 3], [2, 1.5, 6], (400, 3)).astype(np.float32)
    gaussians = Gaussians.from_points(points, rng.integers(0, 255, (400, 3)).astype(np.uint8), 0)
    gaussians.opacities.data.fill_(2.0)
    gaussians.scales.data -= 1.2  # or else they hide each other, in an order that jumps
    return gaussians


def off(viewmat: np.ndarray, degrees: float, shift: float) -> np.ndarray:
    move = np.eye(4)
    move[:3, :3] = Rotation.from_rotvec(np.deg2rad(degrees) * np.array([0.6, -0.8, 0.3])).as_matrix()
    move[:3, 3] = shift * np.array([0.5, 0.7, -0.5])
    return move @ viewmat


@pytest.fixture(scope="module")
def true_view() -> View:
    K = np.array([[60.0, 0, WIDTH / 2], [0, 60, HEIGHT / 2], [0, 0, 1]])
    camera = Camera(WIDTH, HEIGHT, K, np.eye(4))
    with torch.no_grad():
        image, _ = render_view(blobs(), camera, 0, BLACK)
    return View("view", camera, image.clamp(0, 1).numpy())


def test_a_camera_that_is_pixels_off_comes_home(true_view: View) -> None:
    moved = replace(true_view, camera=replace(true_view.camera, viewmat=off(np.eye(4), 1.5, 0.06)))
    fitted = fit_camera(moved, blobs(), 0, BLACK)
    found = fitted.view.camera.viewmat
    turned = Rotation.from_matrix(found[:3, :3]).magnitude()
    assert np.rad2deg(turned) < 0.02
    assert np.abs(found[:3, 3]).max() < 2e-3
    assert fitted.rotation_deg == pytest.approx(1.5 * np.linalg.norm([0.6, -0.8, 0.3]), abs=0.03)
    assert fitted.pixels > 0.5
    with torch.no_grad():
        image, _ = render_view(blobs(), fitted.view.camera, 0, BLACK)
    after = psnr(image.clamp(0, 1).numpy(), true_view.image, None)
    assert after is not None
    assert after > 50


def test_a_camera_that_fits_stays(true_view: View) -> None:
    fitted = fit_camera(true_view, blobs(), 0, BLACK)
    assert fitted.pixels < 1e-3
    assert fitted.view.image is true_view.image


def test_masked_pixels_do_not_pull(true_view: View) -> None:
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, : WIDTH // 3] = False
    image = np.where(mask[..., None], true_view.image, 1.0).astype(np.float32)
    viewmat = off(np.eye(4), 0.7, 0.03)
    view = replace(true_view, image=image, mask=mask, camera=replace(true_view.camera, viewmat=viewmat))
    found = fit_camera(view, blobs(), 0, BLACK).view.camera.viewmat
    assert np.rad2deg(Rotation.from_matrix(found[:3, :3]).magnitude()) < 0.03


def test_area_under_the_curve_of_pairs() -> None:
    rng = np.random.default_rng(0)
    own = np.tile(np.eye(4), (4, 1, 1))
    own[:, :3, :3] = Rotation.from_rotvec(0.2 * rng.standard_normal((4, 3))).as_matrix()
    own[:, :3, 3] = rng.standard_normal((4, 3))
    # The same poses in another frame, twice as large: all pairs are exact.
    turn, there = Rotation.from_rotvec([0.3, 1, -2]).as_matrix(), own.copy()
    centers = -np.einsum("nji,nj->ni", own[:, :3, :3], own[:, :3, 3])
    there[:, :3, :3] = own[:, :3, :3] @ turn.T
    there[:, :3, 3] = -np.einsum("nij,nj->ni", there[:, :3, :3], 2 * centers @ turn.T + [1, 2, 3])
    assert pose_auc(there, own, 4) == pytest.approx([1, 1, 1], abs=1e-6)
    # One of four photos is missing: 3 of 6 pairs are left.
    assert pose_auc(there[:3], own[:3], 4) == pytest.approx([0.5, 0.5, 0.5], abs=1e-6)
    # One camera turned about its centre by 2 degrees: its 3 pairs are 2 degrees off at least.
    there[0, :3] = Rotation.from_rotvec([np.deg2rad(2), 0, 0]).as_matrix() @ there[0, :3]
    one, three, five = pose_auc(there, own, 4, (1, 3, 5))
    assert one == pytest.approx(0.5, abs=1e-6)
    assert 0.5 < three <= 0.5 + 0.5 / 3 + 1e-6
    assert 0.5 + 0.5 * 0.5 < five <= 0.5 + 0.5 * 3 / 5 + 1e-6
