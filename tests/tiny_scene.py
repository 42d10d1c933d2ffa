"""A scene that trains in a fraction of a second: a wavy picture on the plane z = 3, seen by six cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.config import DensifyConfig, TrainConfig

WIDTH, HEIGHT, DEPTH = 24, 16, 3.0


def texture(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours [..., 3] at points of the plane."""
    channels = [0.5 + 0.4 * np.sin(2 * x), 0.5 + 0.4 * np.cos(2 * y), 0.5 + 0.3 * np.sin(x + 2 * y)]
    return np.round(255 * np.stack(channels, axis=-1)).astype(np.uint8)


def tiny_scene(num_views: int = 6, num_points: int = 40) -> Scene:
    """Photos that follow from the plane and the cameras by ray casting, so that every view agrees."""
    K = np.array([[20.0, 0.0, WIDTH / 2], [0.0, 20.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    views = []
    for i in range(num_views):
        shift = np.array([0.3 * np.cos(i), 0.3 * np.sin(i), 0.0])  # of the camera's centre
        viewmat = np.eye(4)
        viewmat[:3, 3] = -shift
        x = shift[0] + DEPTH * (columns - K[0, 2]) / K[0, 0]
        y = shift[1] + DEPTH * (rows - K[1, 2]) / K[1, 1]
        views.append(View(f"view{i}.png", Camera(WIDTH, HEIGHT, K, viewmat), texture(x, y)))
    rng = np.random.default_rng(5)
    xy = rng.uniform([-2.2, -1.5], [2.2, 1.5], (num_points, 2))
    points = np.concatenate([xy, np.full((num_points, 1), DEPTH)], axis=1).astype(np.float32)
    return Scene("tiny", views[1:], views[:1], points, texture(xy[:, 0], xy[:, 1]), "test")


def tiny_config(iterations: int = 30, **changes: object) -> TrainConfig:
    """Two rounds of densification, a reset and every SH degree within 30 iterations."""
    densify = DensifyConfig(
        start=5, stop=25, every=8, reset_every=12, grad_threshold=1e-6, percent_dense=0.6, prune_scale=10.0
    )
    settings: dict[str, object] = {
        "iterations": iterations,
        "method": "3dgs",
        "leave_out": (),
        "sh_interval": 6,
        "eval_every": 10,
        "checkpoint_every": 5,
        "densify": densify,
    }
    return TrainConfig(**(settings | changes))  # type: ignore[arg-type]
