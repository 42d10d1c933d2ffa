"""EWA projection in float64 numpy, by the formulas of docs/conventions.md; of the crate only a constant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hqgs._rust import FOV_MARGIN


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
