"""A scene as bytes for the page's own viewer: quantised, gzipped, in base64.

The arrays lie one after the other, little-endian, each component by itself, as gzip packs that best:

| values | stored as |
|---|---|
| means | sign(x) log(1 + abs(x)), 16 bits an axis between the bounds; all low bytes, then all high ones |
| scales | logs, 8 bits between the smallest and largest |
| quats | w x y z, unit, 127 levels to either side |
| opacities | 8 bits |
| sh0 | the colour that it gives, 8 bits from -0.25 to 1.25 |
| shN | the number of one of a few sets, 16 bits |
| the sets | 127 levels to either side of 0, up to a largest value of each band |

`templates/splats.js` reads them.
"""

from __future__ import annotations

import base64
import gzip
import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hqgs.model.constants import SH_C0
from hqgs.model.formats.sog import palette
from hqgs.model.gaussians import Gaussians
from hqgs.show.export import along_a_curve

COLORS = (-0.25, 1.25)
LEVELS = 127


def pack_scene(gaussians: Gaussians, most: int = 400_000) -> tuple[dict[str, Any], str]:
    """Quantise the Gaussians, or of more than `most` those that show most; NaN, Inf and invisible ones go.

    What shows most has the largest opacity times area. Many Gaussians share a set of harmonics, so that the
    page stays small: 50,000 Gaussians of degree 3 take less than 3 MB. Returns numbers for the viewer, and a
    gzip stream in base64.
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
    degree = g.sh_degree
    logs = np.sign(g.means.double().numpy()) * np.log1p(g.means.double().abs().numpy())
    low, high = (logs.min(0), logs.max(0)) if n else (np.zeros(3), np.ones(3))
    means = np.rint((logs - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.int64)
    scales = g.scales.double().numpy()
    bounds = (float(scales.min()), float(scales.max())) if n else (0.0, 0.0)
    quats = g.quats.double().numpy()
    quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    colors = 0.5 + SH_C0 * g.sh0[:, 0].double().numpy()
    opacities = g.activated_opacities().double().numpy()
    rest, labels = np.zeros((0, 3 * g.shN.shape[1])), np.zeros(n, np.int64)
    if n and degree:
        sets = min(n, 1 << 13, max(-(-n // 8), 1 << 11))  # eight Gaussians share one
        rest, labels = palette(g.shN.flatten(1).numpy(), opacities, sets)
    tops = [_top(rest[:, 3 * (d * d - 1) : 3 * ((d + 1) ** 2 - 1)]) for d in range(1, degree + 1)]
    units = np.repeat(tops, [3 * (2 * d + 1) for d in range(1, degree + 1)]) if degree else np.ones(0)
    parts = [
        _planes((means % 256).astype(np.uint8)),
        _planes((means // 256).astype(np.uint8)),
        _planes(_byte(scales, *bounds)),
        _planes(np.rint(quats * LEVELS).astype(np.int8)),
        _byte(opacities, 0, 1).tobytes(),
        _planes(_byte(colors, *COLORS)),
        labels.astype("<u2").tobytes(),
        _planes(np.rint(rest / units * LEVELS).clip(-LEVELS, LEVELS).astype(np.int8)),
    ]
    head: dict[str, Any] = {
        "count": n,
        "degree": degree,
        "sets": len(rest),
        "low": low.tolist(),
        "high": high.tolist(),
        "scales": bounds,
        "colors": COLORS,
        "tops": tops,
    }
    data = base64.b64encode(gzip.compress(b"".join(parts), 9, mtime=0)).decode()
    return head, data


def _byte(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.uint8]:
    return np.rint(((values - low) / max(high - low, 1e-12)).clip(0, 1) * 255).astype(np.uint8)


def _planes(values: NDArray[Any]) -> bytes:
    return np.ascontiguousarray(values.T).tobytes()


def _top(values: NDArray[np.float64]) -> float:
    """What a band's largest stored value stands for."""
    top = float(np.quantile(np.abs(values), 0.999)) if values.size else 0.0
    return top if math.isfinite(top) and top > 0 else 1.0
