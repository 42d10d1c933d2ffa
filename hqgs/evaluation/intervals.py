"""How sure a mean over photos is, and a difference of two scenes on the same photos.

A scene is photographed from a few of the places from which it could be: another draw of held-out photos gives
another mean. The interval holds the mean over all such photos in CONFIDENCE of the draws. It is Student's,
of the photos' own values, photos being what is drawn: patches drawn within drawn photos count what differs
within a photo twice, and cover 97.5 % and more (`tests/test_results.py` and docs/log.md have the figures).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hqgs.evaluation.constants import CONFIDENCE

# The deviation of photos' values within a scene, its median over nine captures, and the deviation of its log
# between them: what a few photos that happen to agree are held against.
SPREADS = {"psnr": 2.0, "psnr_aligned": 2.0, "ssim": 0.025, "haarpsi": 0.04}
SPREAD_LOGS = 0.7


def half_width(values: Sequence[float | None], metric: str | None = None) -> float | None:
    """Half the interval of the mean of photos' values; None of fewer than two, or where one is None.

    Of a few photos that happen to agree Student's is too narrow: of a metric whose spread in other scenes is
    known, it is no less than what that and the photos say together.
    """
    known = [value for value in values if value is not None]
    if len(known) < max(2, len(values)):
        return None
    import numpy as np  # here: the command line waits for neither
    from scipy.special import stdtrit

    quantile = float(stdtrit(len(known) - 1, (1 + CONFIDENCE) / 2))
    deviation = float(np.std(known, ddof=1))
    half = quantile * deviation / math.sqrt(len(known))
    return half if metric not in SPREADS else max(half, _expected(SPREADS[metric], deviation, len(known)))


def _expected(usual: float, deviation: float, count: int) -> float:
    """Half the interval of a mean, of normal values whose log deviation is normal around that of `usual`."""
    import numpy as np
    from scipy.special import erf

    away = np.linspace(-4, 4, 161)
    sigmas = usual * np.exp(SPREAD_LOGS * away)
    logs = -(count - 1) * (np.log(sigmas) + (deviation / sigmas) ** 2 / 2) - away**2 / 2
    weights = np.exp(logs - logs.max())
    low, high = 0.0, 10 * float(sigmas[-1])
    for _ in range(60):
        half = (low + high) / 2
        inside = float(weights @ erf(half * math.sqrt(count / 2) / sigmas) / weights.sum())
        low, high = (half, high) if inside < CONFIDENCE else (low, half)
    return high


def difference(one: Sequence[float | None], other: Sequence[float | None]) -> dict[str, Any] | None:
    """Of a metric between two scenes on the same photos, JSON values: `mean`, of the one's less the other's,
    half its `interval` (None of a single photo), and whether that leaves 0 out: `sure`. Paired: narrower than
    two intervals, as hard photos are hard for both. None where a value is None."""
    pairs = [(a, b) for a, b in zip(one, other, strict=True) if a is not None and b is not None]
    if not pairs or len(pairs) < len(one):
        return None

    import numpy as np

    apart = [a - b for a, b in pairs]
    mean, half = float(np.mean(apart)), half_width(apart)
    return {"mean": mean, "interval": half, "sure": half is not None and abs(mean) > half}


def half_widths(views: Sequence[Mapping[str, float | None]], names: Sequence[str]) -> dict[str, float | None]:
    """`half_width` of each metric of these names."""
    return {name: half_width([view[name] for view in views], name) for name in names}


def with_half(value: float, half: float | None, form: str) -> str:
    """`28.31 ± 0.42`, or the value alone."""
    return format(value, form) + ("" if half is None else f" ± {half:{form.lstrip('+')}}")
