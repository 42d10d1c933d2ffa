"""A scene as bytes for the page's own viewer: quantised, gzipped, in base64.

The arrays lie one after the other, little-endian, each component by itself, as gzip packs that best:

| values | stored as |
|---|---|
| means | 16 bits an axis, between the bounds of each block of 256 Gaussians along a curve through space |
| scales | logs, 8 bits between the smallest and largest |
| quats | w x y z, unit, 127 levels to either side |
| opacities | 8 bits |
| sh0 | the colour that it gives, 8 bits from -0.25 to 1.25 |
| shN | 127 levels to either side of 0, up to a largest value of each band |

`templates/splats.js` reads them.
"""

from __future__ import annotations

import base64
import gzip
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hqgs.model.constants import SH_C0
from hqgs.model.gaussians import Gaussians
from hqgs.show.export import along_a_curve

BLOCK = 256
MOST = 400_000  # Gaussians in a page
DEGREES = ((60_000, 3), (120_000, 2), (200_000, 1), (MOST, 0))  # up to so many, harmonics of this degree
COLORS = (-0.25, 1.25)
LEVELS = 127
SHARE = 0.999  # of a band's coefficients that its largest value covers


@dataclass(frozen=True)
class PackedScene:
    """What the page holds of a scene."""

    head: dict[str, Any]  # numbers for the viewer
    data: str  # base64 of a gzip stream
    gaussians: int
    left_out: int  # Gaussians
    sh_degree: int

    @property
    def bytes(self) -> int:
        """In the page."""
        return len(self.data)


def pack_scene(gaussians: Gaussians, most: int = MOST) -> PackedScene:
    """Quantise the Gaussians, or of more than `most` those that show most; NaN, Inf and invisible ones go.

    What shows most has the largest opacity times area. The harmonics' degree falls with the number, so that
    the page stays small: 50,000 Gaussians of degree 3 take less than 5 MB.
    """
    g = gaussians.detached()
    keep = g.finite() & (g.activated_opacities() > 1 / 255) & (g.quats.square().sum(1) > 1e-12)
    if int(keep.sum()) > most:
        area = g.scales.double().sort(dim=1).values[:, 1:].sum(1)
        shown = torch.where(keep, area + torch.nn.functional.logsigmoid(g.opacities.double()), -torch.inf)
        keep = torch.zeros_like(keep)
        keep[shown.topk(most).indices] = True
    g = along_a_curve(g.rows(keep))
    n = len(g)
    degree = min(g.sh_degree, next((d for count, d in DEGREES if n <= count), 0))
    means, low, size = _blocks(g.means.double().numpy())
    scales = g.scales.double().numpy()
    bounds = (float(scales.min()), float(scales.max())) if n else (0.0, 0.0)
    quats = g.quats.double().numpy()
    quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    colors = 0.5 + SH_C0 * g.sh0[:, 0].double().numpy()
    rest = g.shN[:, : (degree + 1) ** 2 - 1].double().flatten(1).numpy()
    tops = [_top(rest[:, 3 * (d * d - 1) : 3 * ((d + 1) ** 2 - 1)]) for d in range(1, degree + 1)]
    units = np.repeat(tops, [3 * (2 * d + 1) for d in range(1, degree + 1)]) if degree else np.ones(0)
    parts = [
        _planes(means.astype("<u2")),
        _planes(_byte(scales, *bounds)),
        _planes(np.rint(quats * LEVELS).astype(np.int8)),
        _byte(g.activated_opacities().double().numpy(), 0, 1).tobytes(),
        _planes(_byte(colors, *COLORS)),
        _planes(np.rint(rest / units * LEVELS).clip(-LEVELS, LEVELS).astype(np.int8)),
    ]
    head: dict[str, Any] = {
        "count": n,
        "degree": degree,
        "block": BLOCK,
        "low": low.ravel().tolist(),
        "size": size.ravel().tolist(),
        "scales": bounds,
        "colors": COLORS,
        "tops": tops,
    }
    data = base64.b64encode(gzip.compress(b"".join(parts), 9, mtime=0)).decode()
    return PackedScene(head, data, n, len(gaussians) - n, degree)


def _blocks(
    means: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Levels 0..65535 [N, 3], and for each block the lower corner and the size of the box, [B, 3]."""
    starts = np.arange(0, len(means), BLOCK)
    if not len(starts):
        return np.zeros((0, 3)), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    low = np.minimum.reduceat(means, starts).astype(np.float32)
    size = np.maximum((np.maximum.reduceat(means, starts) - low).astype(np.float32), 1e-12)
    block = np.arange(len(means)) // BLOCK
    return np.rint(((means - low[block]) / size[block]).clip(0, 1) * 65535), low, size


def _byte(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.uint8]:
    return np.rint(((values - low) / max(high - low, 1e-12)).clip(0, 1) * 255).astype(np.uint8)


def _planes(values: NDArray[Any]) -> bytes:
    return np.ascontiguousarray(values.T).tobytes()


def _top(values: NDArray[np.float64]) -> float:
    top = float(np.quantile(np.abs(values), SHARE)) if values.size else 0.0
    return top if math.isfinite(top) and top > 0 else 1.0
