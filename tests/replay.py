"""An independent count of the Gaussians that blend: single pixels, composited in float64 numpy.

It shares the constants with the crate, and no code; the formulas are those of docs/conventions.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from benchmarks.speed.inputs import project
from hqgs._rust import ALPHA_MAX, ALPHA_MIN, EPS2D, NEAR_PLANE, TRANSMITTANCE_MIN

if TYPE_CHECKING:
    from benchmarks.speed.inputs import RasterInputs


def random_pixels(inputs: RasterInputs, count: int, seed: int) -> NDArray[np.int64]:
    """Columns and rows of pixels of the image, [count, 2]."""
    return np.random.default_rng(seed).integers(0, [inputs.width, inputs.height], (count, 2))


def blended_counts(inputs: RasterInputs, pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many Gaussians blend in each of the pixels [P, 2] (column, row), [P]."""
    means2d, depths, cov = project(inputs)
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
