"""The numbers of a quality benchmark's tables, from its runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hqgs.evaluation.metrics import METRICS
from hqgs.photos.formula import NONE

DEGRADED = "degraded"  # in the place of a degradation: all of them, without the clean photos

Run = dict[str, Any]


@dataclass(frozen=True)
class Group:
    """The runs that see the same photos, by the label of their row."""

    scene: str
    degradation: str
    seed: int
    runs: dict[str, Run]


@dataclass(frozen=True)
class Spread:
    """Values over groups."""

    mean: float
    std: float | None  # sample standard deviation; None for one value
    min: float
    max: float
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        std = float(np.std(values, ddof=1)) if len(values) > 1 else None
        return cls(float(np.mean(values)), std, min(values), max(values), len(values))


def columns(groups: Sequence[Group]) -> dict[str, list[Group]]:
    """The groups of each degradation, in their order, and `DEGRADED` where there are several of them."""
    kinds = list(dict.fromkeys(group.degradation for group in groups))
    parts = {kind: [g for g in groups if g.degradation == kind] for kind in kinds}
    if len(kinds) - (NONE in kinds) > 1:
        parts[DEGRADED] = [g for g in groups if g.degradation != NONE]
    return parts


def mean_of(groups: Iterable[Group], label: str, value: Callable[[Run], float | None]) -> float | None:
    """Mean of a number of a row's runs; None where one of them lacks it."""
    values = [value(group.runs[label]) for group in groups]
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None


def psnr_gain(run: Run, base: Run) -> float | None:
    """PSNR of a run over that of the baseline, dB."""
    values = run["metrics"]["psnr"], base["metrics"]["psnr"]
    return None if None in values else values[0] - values[1]


def psnr_at(run: Run, seconds: float) -> float | None:
    """Held-out PSNR of a run when it had trained for so long, between two evaluations by a straight line.

    None before the first evaluation and after the end.
    """
    times = [h["seconds"] for h in run["history"]]
    values = [h["psnr"] for h in run["history"]]
    if None in values or not times[0] <= seconds <= times[-1]:
        return None
    return float(np.interp(seconds, times, values))


def equal_time_gain(run: Run, base: Run) -> float | None:
    """PSNR over that of the baseline at the moment when the faster of the two ends.

    The slower one is judged in the middle of its schedule, its learning rate still high: what it would reach
    with a schedule made for that time is rather more. Time is that of the wall, so another program on the
    machine moves this number: between two runs of one method it should be 0. None where the slower one had
    not been evaluated by then.
    """
    moment = min(r["history"][-1]["seconds"] for r in (run, base))
    mine, other = psnr_at(run, moment), psnr_at(base, moment)
    return None if mine is None or other is None else mine - other


def spread(
    groups: Sequence[Group], label: str, baseline: str, gain: Callable[[Run, Run], float | None]
) -> Spread | None:
    """A gain over the baseline in the same group, over groups; None where one has none."""
    values = [gain(group.runs[label], group.runs[baseline]) for group in groups]
    known = [v for v in values if v is not None]
    return Spread.of(known) if known and len(known) == len(values) else None


def density(run: Run, region: str) -> float | None:
    """Gaussians per 1,000 pixels of a region."""
    return run["regions"][region]["density"]


COSTS: dict[str, Callable[[Run], float | None]] = {
    "seconds": lambda run: run["seconds"],
    "cpu_seconds": lambda run: run["cpu_seconds"],
    "setup_seconds": lambda run: run["setup_seconds"],
    "ms_per_step": lambda run: 1_000 * run["seconds"] / run["iterations"],
    "render_ms": lambda run: run["render_ms"],
    "initial_points": lambda run: run["initial_points"],
    "gaussians": lambda run: run["gaussians"],
    "peak_rss_mb": lambda run: run["peak_rss_mb"],
}


def summary(groups: Sequence[Group], labels: Sequence[str], baseline: str | None) -> dict[str, Any]:
    """All means and gains by row and degradation, as JSON values. `baseline` None: no gains."""
    gains = {"gain": psnr_gain, "equal_time_gain": equal_time_gain}
    rows: dict[str, Any] = {}
    for label in labels:
        rows[label] = {}
        for kind, part in columns(groups).items():
            entry: dict[str, Any] = {"runs": len(part)}
            entry |= {m: mean_of(part, label, lambda run, m=m: run["metrics"][m]) for m in METRICS}
            entry |= {name: mean_of(part, label, cost) for name, cost in COSTS.items()}
            for region in ("edge", "flat"):
                entry[f"{region}_density"] = mean_of(part, label, lambda run, r=region: density(run, r))
            if baseline is not None and label != baseline:
                for name, gain in gains.items():
                    over = spread(part, label, baseline, gain)
                    entry[name] = None if over is None else asdict(over)
            rows[label][kind] = entry
    return rows
