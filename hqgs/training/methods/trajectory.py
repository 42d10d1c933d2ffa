"""A camera's trajectory, turns and moves about a photo's pose, as warps of the photo's render.

It is a polynomial: in t from -1/2 to 1/2, t v + 4 (t^2 - mean t^2) c, where v and c turn and move in all six
freedoms. Turns are in px of the picture's middle, moves in px at the photo's median depth.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hqgs.scene.scene import Camera
from hqgs.training.constants import TRAJECTORY_POINTS


def trajectory_warps(path: Tensor, camera: Camera, count: int) -> Tensor:
    """Warps of a camera that goes along a trajectory, [count, 3, 4]."""
    steps, focal, K = _steps(path, count), float(camera.K[0, 0]), torch.from_numpy(camera.K)
    turned = K @ _turns(steps[:, :3] / focal) @ torch.linalg.inv(K)
    moved = steps[:, 3:] @ (K / focal).T
    return torch.cat([turned, moved[:, :, None]], dim=2)


def middle_of(path: Tensor) -> Tensor:
    """The trajectory of the picture's middle at the median depth, px, [9, 2]."""
    steps = _steps(path.detach(), TRAJECTORY_POINTS)
    return torch.stack([steps[:, 1] + steps[:, 3], steps[:, 4] - steps[:, 0]], dim=1)


def longest(points: Tensor) -> float:
    """Distance of two of the points [K, 2]."""
    return float((points[:, None] - points).norm(dim=-1).max())


def moved_by(warps: Tensor, camera: Camera, nearness: float) -> Tensor:
    """How far warps take the corners and the middle of a picture, px, [K, 5, 2]."""
    w, h = camera.width, camera.height
    corners = [[x, y, 1.0, nearness] for x, y in ((0, 0), (w, 0), (0, h), (w, h), (w / 2, h / 2))]
    points = torch.tensor(corners, dtype=torch.float64)
    e = points @ warps.transpose(1, 2)  # [K, 5, 3]
    return (e[..., :2] - points[:, :2] * e[..., 2:]) / (1 + e[..., 2:])


def _steps(path: Tensor, count: int) -> Tensor:
    """Where a trajectory is in the middles of `count` equal parts of the exposure, [count, 6]; of mean 0."""
    t = (torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5
    square = t.square()
    return t[:, None] * path[0] + 4 * (square - square.mean())[:, None] * path[1]


def _turns(vectors: Tensor) -> Tensor:
    """Rotations less the identity by small vectors [K, 3], to third order, [K, 3, 3]."""
    x, y, z = vectors.unbind(1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
    square = cross @ cross
    return cross + square / 2 + square @ cross / 6
