"""Inputs of the rasterizer's benchmark: a seeded cloud of Gaussians in front of one camera.

The size of the Gaussians follows from their number and the image, so that 37 to 40 of them blend per pixel,
whatever the two are: the work per pixel is that of a trained scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root_scalar
from scipy.spatial.transform import Rotation

from hqgs._rust import ALPHA_MIN, EPS2D, FOV_MARGIN
from hqgs.model.constants import SH_C0

Array32 = NDArray[np.float32]
Array64 = NDArray[np.float64]

SIZE = (504, 378)  # pixels; other sizes scale the focal length with them
FOCAL = 400.0  # pixels, at 504
NEAR, FAR = 2.0, 6.0  # depths of the cloud, world units
MARGIN = 0.05  # of the image, on each side, that the cloud reaches beyond it
COVERAGE = 39.0  # supports per pixel; a few pixels are full before their last one
LEAVES = ("means", "quats", "scales", "opacities", "sh")  # what gets a gradient
SAMPLE = 20_000  # Gaussians from which the size is computed


@dataclass(frozen=True)
class RasterInputs:
    """What the rasterizer takes, and the gradient of a loss with respect to its image."""

    means: Array32  # [N, 3], world
    quats: Array32  # [N, 4], w x y z, unit
    scales: Array32  # [N, 3], world
    opacities: Array32  # [N], after the sigmoid
    sh: Array32  # [N, 16, 3]
    v_image: Array32  # [H, W, 3]
    viewmat: Array64  # [4, 4], world to camera
    K: Array64  # [3, 3], pixels
    background: Array32  # [3]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def width(self) -> int:
        return self.v_image.shape[1]

    @property
    def height(self) -> int:
        return self.v_image.shape[0]


def make_inputs(n: int, width: int = SIZE[0], height: int = SIZE[1], seed: int = 2026) -> RasterInputs:
    """N Gaussians, uniform in the volume that a camera of this size sees between two depths.

    Scales are log-normal (0.5 per axis), rotations uniform, opacities the sigmoid of a normal (-0.5, 1.5),
    harmonics of degree 3 normal (0.1). The camera is turned and shifted, so that no matrix is trivial.

    Raises ValueError where the image is so small that even points would overlap more than wanted.
    """
    rng = np.random.default_rng(seed)
    x = rng.uniform(-0.5 - MARGIN, 0.5 + MARGIN, n) * SIZE[0] / FOCAL
    y = rng.uniform(-0.5 - MARGIN, 0.5 + MARGIN, n) * SIZE[1] / FOCAL
    z = np.cbrt(rng.uniform(NEAR**3, FAR**3, n))  # the cross-section grows with z^2
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_euler("yxz", [0.4, -0.3, 0.2]).as_matrix()
    viewmat[:3, 3] = [-0.2, 0.4, 0.3]
    quats = rng.standard_normal((n, 4))
    sh = 0.1 * rng.standard_normal((n, 16, 3), dtype=np.float32)
    sh[:, 0] = (rng.random((n, 3)) - 0.5) / SH_C0
    focal = FOCAL * width / SIZE[0]
    v_image = np.random.default_rng(n).standard_normal((height, width, 3), dtype=np.float32)
    inputs = RasterInputs(
        means=_f32((np.stack([x * z, y * z, z], axis=1) - viewmat[:3, 3]) @ viewmat[:3, :3]),
        quats=_f32(quats / np.linalg.norm(quats, axis=1, keepdims=True)),
        scales=_f32(np.exp(0.5 * rng.standard_normal((n, 3)))),
        opacities=_f32(1 / (1 + np.exp(0.5 - 1.5 * rng.standard_normal(n)))),
        sh=sh,
        v_image=_f32(v_image / np.float32(v_image.size)),
        viewmat=viewmat,
        K=np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]),
        background=_f32([0.1, 0.2, 0.3]),
    )
    return replace(inputs, scales=inputs.scales * np.float32(_size(inputs)))


def _size(inputs: RasterInputs) -> float:
    """The factor on all scales with which the supports cover each pixel COVERAGE times on average.

    A support is the ellipse where alpha >= 1/255: 2 pi ln(255 opacity) sqrt(det(cov2d)) square pixels.
    """
    sample = replace(inputs, **{name: getattr(inputs, name)[:SAMPLE] for name in LEAVES})
    _, _, cov = project(sample)
    reach2 = 2 * np.log(np.maximum(sample.opacities.astype(np.float64) / ALPHA_MIN, 1))
    area = (1 + 2 * MARGIN) ** 2 * inputs.width * inputs.height

    def excess(log_factor: float) -> float:
        scaled = math.exp(2 * log_factor) * cov + EPS2D * np.eye(2)
        support = math.pi * reach2 * np.sqrt(np.linalg.det(scaled))
        return len(inputs) / area * float(support.mean()) - COVERAGE

    if excess(-30.0) >= 0:
        raise ValueError(
            f"{len(inputs)} Gaussians are too many for {inputs.width} x {inputs.height} pixels: as points "
            f"they already cover each one {excess(-30.0) + COVERAGE:.0f} times, wanted {COVERAGE:.0f}"
        )
    return math.exp(root_scalar(excess, bracket=(-30.0, 10.0)).root)


def _f32(values: Any) -> Array32:
    return np.ascontiguousarray(values, np.float32)


def project(inputs: RasterInputs) -> tuple[Array64, Array64, Array64]:
    """EWA projection in float64, by the formulas of docs/conventions.md with no code of the crate: centres
    [N, 2] in pixels, depths [N], covariances [N, 2, 2] before the low-pass."""
    viewmat, K = inputs.viewmat, inputs.K
    p = inputs.means.astype(np.float64) @ viewmat[:3, :3].T + viewmat[:3, 3]
    x, y, z = p.T
    focal, center = np.diag(K)[:2], K[:2, 2]
    size = np.array([inputs.width, inputs.height])
    margin = FOV_MARGIN * size / (2 * focal)
    low, high = -center / focal - margin, (size - center) / focal + margin
    slope = np.clip(p[:, :2] / z[:, None], low, high)
    jacobian = np.zeros((len(p), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = focal[0] / z, focal[1] / z
    jacobian[:, :, 2] = -focal * slope / z[:, None]
    rotation = Rotation.from_quat(inputs.quats[:, [1, 2, 3, 0]].astype(np.float64)).as_matrix()
    factor = jacobian @ viewmat[:3, :3] @ (rotation * inputs.scales[:, None, :].astype(np.float64))
    return focal * np.stack([x, y], axis=1) / z[:, None] + center, z, factor @ factor.swapaxes(1, 2)
