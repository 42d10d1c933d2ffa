"""The numbers of the quality benchmark's tables, from its runs: a frame with one line for each run.

A mean is that of all runs of its group: where one of them lacks the number, there is none.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from pandas import DataFrame, Series, concat

from benchmarks.measure import Run
from benchmarks.study import Cell
from hqgs.evaluation.metrics import METRICS
from hqgs.photos.formula import NONE

DEGRADED = "degraded"  # in the place of a degradation: all of them, without the clean photos
GROUP = ["scene", "degradation", "seed"]  # the runs that see the same photos
GAINS = ("gain", "equal_time_gain")  # over the baseline, dB
KEPT = ("seconds", "cpu_seconds", "setup_seconds", "render_ms", "initial_points", "gaussians", "peak_rss_mb")
COSTS = (*KEPT, "ms_per_step", "edge_density", "flat_density")


def frame_of(runs: Iterable[tuple[Cell, Run]], baseline: str | None = None) -> DataFrame:
    """A line for each run with all numbers of the tables, NaN where there is none; the runs are in `run`.

    Gains are over the run of the `baseline` in the same group; without one there are none.
    """
    pairs = list(runs)
    base = {cell.group: run for cell, run in pairs if cell.row.label == baseline}
    lines = []
    for cell, run in pairs:
        line = dict(zip(GROUP, cell.group, strict=True)) | {"row": cell.row.label, "run": run}
        line |= {name: run["metrics"][name] for name in METRICS}
        line |= {name: run[name] for name in KEPT} | {
            "ms_per_step": 1_000 * run["seconds"] / run["iterations"]
        }
        line |= {f"{name}_density": region["density"] for name, region in run["regions"].items()}
        if baseline is not None:
            line["gain"] = psnr_gain(run, base[cell.group])
            line["equal_time_gain"] = equal_time_gain(run, base[cell.group])
        lines.append(line)
    frame = DataFrame(lines)
    return frame.astype({name: float for name in frame.columns if name not in ("row", "run", *GROUP)})


def with_degraded(frame: DataFrame) -> DataFrame:
    """The runs of each degradation, in their order, and as `DEGRADED` all of them where there are several."""
    bad = frame.loc[frame["degradation"] != NONE]
    if len(set(bad["degradation"])) < 2:
        return frame
    return concat([frame, bad.assign(degradation=DEGRADED)], ignore_index=True)


def means(frame: DataFrame, by: Sequence[str], values: Sequence[str]) -> DataFrame:
    """Means over the runs that share `by`, in their order; NaN where one of them lacks the number."""
    parts = frame.groupby(list(by), sort=False)[list(values)]
    return DataFrame(parts.agg(lambda v: v.mean(skipna=False)))


def spread(values: Series) -> dict[str, float | None] | None:
    """Mean, sample standard deviation (None for one value), range and number; None where a value lacks."""
    if values.isna().any():
        return None
    found = values.agg(["mean", "std", "min", "max"]).to_dict()
    return found | {"std": found["std"] if len(values) > 1 else None, "count": len(values)}


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


def summary(frame: DataFrame, baseline: str | None) -> dict[str, Any]:
    """All means and gains by row and degradation, as JSON values. `baseline` None: no gains."""
    numbers = means(with_degraded(frame), ["row", "degradation"], [*METRICS, *COSTS])
    rows: dict[str, Any] = {}
    for label, of_row in with_degraded(frame).groupby("row", sort=False):
        kinds = rows[str(label)] = {}
        for kind, part in of_row.groupby("degradation", sort=False):
            line = numbers.loc[(label, kind)].items()
            kinds[str(kind)] = {"runs": len(part)} | {n: None if v != v else float(v) for n, v in line}
            if baseline is not None and label != baseline:
                kinds[str(kind)] |= {name: spread(part[name]) for name in GAINS}
    return rows
