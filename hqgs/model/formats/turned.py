"""Gaussians under an affine map: positions, shapes and harmonics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hqgs.base.machine import AT_ONCE
from hqgs.model.constants import LEAST_SCALE
from hqgs.model.formats.arrays import Arrays, of_colors, shown
from hqgs.scene.constants import ROUNDING
from hqgs.scene.world import World, world_for

Array = NDArray[np.float64]


def mapped(arrays: Arrays, linear: Array, shift: Array) -> Arrays:
    """The Gaussians x -> linear x + shift: `linear` [3, 3] may stretch, shear and mirror; means are float64.

    Covariances become linear Sigma linear^T; colours are seen from the directions that the map's rotation
    (its polar factor, where it stretches) takes the old ones to. ValueError for a map that is singular.
    """
    means = arrays["means"].astype(np.float64) @ linear.T + shift
    if np.array_equal(linear, np.eye(3)):
        return {**arrays, "means": means}
    u, stretch, vt = np.linalg.svd(linear)
    if not stretch[2] > 1e-12 * stretch[0]:
        raise ValueError(f"the transform is singular: {linear.tolist()}")
    rotation = u @ vt
    quats, logs = arrays["quats"].astype(np.float64), arrays["scales"].astype(np.float64)
    if np.ptp(stretch) < ROUNDING * stretch[0] and np.linalg.det(rotation) > 0:
        quats, logs = _times(quaternions(rotation[None]), quats), logs + np.log(stretch[0])
    else:
        factor = linear @ matrices(quats) * np.exp(logs)[:, None, :]
        axes, lengths, _ = np.linalg.svd(factor)
        axes[..., 0] *= np.sign(np.linalg.det(axes))[:, None]
        quats, logs = quaternions(axes), np.log(np.maximum(lengths, LEAST_SCALE))
    return {
        **arrays,
        "means": means,
        "quats": quats.astype(np.float32),
        "scales": logs.astype(np.float32),
        "shN": turned_harmonics(arrays["shN"].astype(np.float64), rotation).astype(np.float32),
    }


def placed(arrays: Arrays, by: Array, world: World) -> Arrays:
    """Gaussians that are held in a world, mapped by [4, 4] in the frame of its files.

    Their means are those of that frame, float64 (`near_origin` holds them again); shapes stay in the unit.
    """
    moved = mapped(arrays, by[:3, :3], np.zeros(3))
    moved["means"] = world.unit * moved["means"] + by[:3, :3] @ world.shift + by[:3, 3]
    return moved


def near_origin(arrays: Arrays, world: World) -> Arrays:
    """Gaussians with means of a file, held in its world's unit, and around their middle if that is far."""
    finite = arrays["means"][np.isfinite(arrays["means"]).all(1)]
    shift = world_for(finite, finite).shift if len(finite) else (0.0, 0.0, 0.0)
    held = replace(world, shift=shift)
    return {**arrays, "means": held.into(arrays["means"]), "world": held}


def recolored(arrays: Arrays, curve: Callable[[Array], Array]) -> Arrays:
    """Gaussians whose colour from each direction became curve(colour): harmonics that are nearest to that."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    functions = np.append(np.ones((64, 1)), basis(directions)[:, : arrays["shN"].shape[1]], axis=1)
    back = np.linalg.pinv(functions)
    sh0, shN = arrays["sh0"].astype(np.float64), arrays["shN"].astype(np.float64)
    step = max(1, AT_ONCE // 64)
    for rows in (slice(at, at + step) for at in range(0, len(sh0), step)):
        coefficients = np.append(shown(sh0[rows])[:, None], shN[rows], axis=1)  # the first: a colour
        colors = curve(np.maximum(functions @ coefficients, 0))
        new = back @ colors
        sh0[rows], shN[rows] = of_colors(new[:, 0]), new[:, 1:]
    return {**arrays, "sh0": sh0, "shN": shN}


def turned_harmonics(coefficients: Array, rotation: Array) -> Array:
    """Coefficients [N, K - 1, 3] of colours that are seen alike after a rotation (or mirror) [3, 3].

    What a function of degree l becomes is one of degree l again: solved for in enough directions.
    """
    if not coefficients.shape[1]:
        return coefficients
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    new, old = basis(directions), basis(directions @ rotation)  # f'(d) = f(R^T d)
    turned, at = np.empty_like(coefficients), 0
    for degree in (1, 2, 3):
        band = slice(at, at + 2 * degree + 1)
        if band.stop > coefficients.shape[1]:
            break
        matrix = np.linalg.lstsq(new[:, band], old[:, band], rcond=None)[0]
        turned[:, band] = np.einsum("ij,njc->nic", matrix, coefficients[:, band])
        at = band.stop
    return turned


def basis(d: Array) -> Array:
    """The harmonics of degree 1 to 3 in unit directions [M, 3], in 3DGS's order and signs, [M, 15]."""
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    c1, c2, c3 = np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi)), np.sqrt(1 / np.pi) / 4
    return np.stack(
        [
            *(-c1 * y, c1 * z, -c1 * x),
            *(c2 * x * y, -c2 * y * z, np.sqrt(5 / (16 * np.pi)) * (2 * zz - xx - yy)),
            *(-c2 * x * z, c2 / 2 * (xx - yy)),
            *(-np.sqrt(35 / 2) * c3 * y * (3 * xx - yy), 2 * np.sqrt(105) * c3 * x * y * z),
            -np.sqrt(21 / 2) * c3 * y * (4 * zz - xx - yy),
            np.sqrt(7) * c3 * z * (2 * zz - 3 * xx - 3 * yy),
            -np.sqrt(21 / 2) * c3 * x * (4 * zz - xx - yy),
            np.sqrt(105) * c3 * z * (xx - yy),
            -np.sqrt(35 / 2) * c3 * x * (xx - 3 * yy),
        ],
        axis=-1,
    )


def matrices(quats: Array) -> Array:
    """Rotations [N, 3, 3] of w x y z, of any norm; the unit for one of norm 0."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    w, x, y, z = np.where(norms == 0, [1, 0, 0, 0], quats / np.where(norms == 0, 1, norms)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quaternions(matrices: Array) -> Array:
    """w x y z of rotations [N, 3, 3]."""
    from scipy.spatial.transform import Rotation  # here: only maps need scipy

    return np.roll(Rotation.from_matrix(matrices).as_quat(), 1, axis=1)


def _times(left: Array, right: Array) -> Array:
    """Products [N, 4] of quaternions w x y z [1 or N, 4]."""
    w, x, y, z = left.T
    a, b, c, d = right.T
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=-1,
    )
