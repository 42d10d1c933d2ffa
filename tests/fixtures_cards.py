"""Textured cards at known places, seen by known cameras."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from hqgs.scene.load import load_scene
from hqgs.scene.scene import Camera, Scene, View

WIDTH, HEIGHT = 192, 144
CARDS = [
    (5.0, -9, 9, -9, 9),
    (3.6, -1.4, -0.2, -1, 0.3),
    (3.0, 0.1, 1.2, -0.3, 0.8),
]  # z, x from, to, y from, to


@cache
def texture(card: int) -> np.ndarray:
    """Blotches [420, 420, 3] of two sizes."""
    rng = np.random.default_rng(card)
    layers = [ndimage.gaussian_filter(rng.random((420, 420, 3)), (s, s, 0)) for s in (1.8, 4.5)]
    return np.sum([(layer - 0.5) / layer.std() for layer in layers], axis=0) * 0.14 + 0.5


def photo_of(camera: Camera) -> np.ndarray:
    """The cards [HEIGHT, WIDTH, 3] uint8, nearest in front, each with a fixed blotchy texture."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.linalg.solve(camera.K, np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)]))
    directions = (camera.viewmat[:3, :3].T @ rays).T
    image = np.zeros((rows.size, 3))
    for k, (z, left, right, top, bottom) in enumerate(CARDS):
        hit = camera.center + directions * ((z - camera.center[2]) / directions[:, 2])[:, None]
        inside = (left < hit[:, 0]) & (hit[:, 0] < right) & (top < hit[:, 1]) & (hit[:, 1] < bottom)
        at = np.stack([hit[:, 1], hit[:, 0]]) * 60 + 210
        colors = np.stack(
            [ndimage.map_coordinates(texture(k)[..., c], at, order=1, mode="wrap") for c in range(3)], -1
        )
        image[inside] = colors[inside]
    return np.rint(image.clip(0, 1) * 255).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)


@pytest.fixture(scope="session")
def cards() -> Scene:
    """9 photos; the held-out ones are the first and the last."""
    rng = np.random.default_rng(5)
    K = np.array([[184.0, 0, WIDTH / 2], [0, 184, HEIGHT / 2], [0, 0, 1]])
    views = []
    for k in range(9):
        viewmat = np.eye(4)
        viewmat[:3, :3] = Rotation.from_rotvec(0.04 * rng.standard_normal(3)).as_matrix()
        center = np.array([k % 3 - 1, k // 3 - 1, 0]) * [0.5, 0.35, 0] + 0.05 * rng.standard_normal(3)
        viewmat[:3, 3] = -viewmat[:3, :3] @ center
        camera = Camera(WIDTH, HEIGHT, K, viewmat)
        views.append(View(f"photo {k}.jpg", camera, photo_of(camera)))
    points = rng.uniform([-2, -1.5, 5], [2, 1.5, 5], (500, 3)).astype(np.float32)
    return Scene("cards", views[1:-1], [views[0], views[-1]], points, np.zeros((500, 3), np.uint8), "test")


@pytest.fixture(scope="session")
def photos(cards: Scene) -> list[np.ndarray]:
    """The nine photos of the cards, in their order."""
    views = sorted([*cards.train, *cards.test], key=lambda view: view.name)
    return [view.image.astype(np.uint8) for view in views]


@pytest.fixture(scope="session")
def found_cards(photos: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    """A folder with the photos as `photos/0.png`, ..., and in `kept` what COLMAP found; and the scene."""
    root = tmp_path_factory.mktemp("cards")
    (root / "photos").mkdir()
    for k, image in enumerate(photos):
        Image.fromarray(image).save(root / "photos" / f"{k}.png")
    return root, load_scene(root / "photos", keep_sfm=root / "kept")
