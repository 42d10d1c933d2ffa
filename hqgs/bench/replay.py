"""An independent count of the work that an image needs: single pixels, composited in float64 numpy.

It shares no code with the crate; the formulas are those of docs/conventions.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from hqgs.bench.inputs import RasterInputs

ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.99, 0.999e-4
EPS2D, NEAR_PLANE, FOV_MARGIN = 0.3, 0.01, 0.3


def project(
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    viewmat: NDArray[np.float64],
    K: NDArray[np.float64],
    width: int,
    height: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """EWA projection: centres [N, 2] in pixels, depths [N], covariances [N, 2, 2] before the low-pass."""
    p = means.astype(np.float64) @ viewmat[:3, :3].T + viewmat[:3, 3]
    x, y, z = p.T
    focal, center = np.diag(K)[:2], K[:2, 2]
    size = np.array([width, height])
    margin = FOV_MARGIN * size / (2 * focal)
    low, high = -center / focal - margin, (size - center) / focal + margin
    slope = np.clip(p[:, :2] / z[:, None], low, high)
    jacobian = np.zeros((len(p), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = focal[0] / z, focal[1] / z
    jacobian[:, :, 2] = -focal * slope / z[:, None]
    rotation = Rotation.from_quat(quats[:, [1, 2, 3, 0]].astype(np.float64)).as_matrix()
    factor = jacobian @ viewmat[:3, :3] @ (rotation * scales[:, None, :].astype(np.float64))
    return focal * np.stack([x, y], axis=1) / z[:, None] + center, z, factor @ factor.swapaxes(1, 2)


def random_pixels(inputs: RasterInputs, count: int, seed: int) -> NDArray[np.int64]:
    """Columns and rows of pixels of the image, [count, 2]."""
    return np.random.default_rng(seed).integers(0, [inputs.width, inputs.height], (count, 2))


def blended_counts(inputs: RasterInputs, pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many Gaussians blend in each of the pixels [P, 2] (column, row), [P]."""
    means2d, depths, cov = project(
        inputs.means, inputs.quats, inputs.scales, inputs.viewmat, inputs.K, inputs.width, inputs.height
    )
    opacities = inputs.opacities.astype(np.float64)
    kept = np.flatnonzero((depths >= NEAR_PLANE) & (opacities >= ALPHA_MIN))
    kept = kept[np.argsort(depths[kept], kind="stable")]
    means2d, opacities, cov = means2d[kept], opacities[kept], cov[kept] + EPS2D * np.eye(2)
    reach2 = 2 * np.log(opacities / ALPHA_MIN)
    extent = np.sqrt(reach2[:, None] * np.diagonal(cov, axis1=1, axis2=2))
    conic = np.linalg.inv(cov)

    counts = np.zeros(len(pixels), np.int64)
    for k, pixel in enumerate(pixels + 0.5):
        near = np.flatnonzero(np.abs(means2d[:, 0] - pixel[0]) <= extent[:, 0])
        near = near[np.abs(means2d[near, 1] - pixel[1]) <= extent[near, 1]]
        d = pixel - means2d[near]
        sigma = 0.5 * np.einsum("ni,nij,nj->n", d, conic[near], d)
        alpha = np.minimum(ALPHA_MAX, opacities[near] * np.exp(-sigma))
        alpha = alpha[alpha >= ALPHA_MIN]
        counts[k] = np.count_nonzero(np.cumprod(1 - alpha) > TRANSMITTANCE_MIN)
    return counts
