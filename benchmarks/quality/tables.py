"""The quality benchmark's numbers, and Markdown tables of them in the layout of the paper's.

A mean is that of all runs of its group: where one of them lacks the number, there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pandas import DataFrame, Series, concat

from benchmarks.data import read_toml
from benchmarks.measure import Run
from benchmarks.output import NOTHING, number, table
from benchmarks.study import Cell
from hqgs.base.text import markdown_table
from hqgs.evaluation.metrics import METRICS
from hqgs.photos.formula import NONE

COLUMNS = read_toml(Path(__file__).with_name("protocols.toml"))["columns"]
LABEL = {"row": ("", "")}
DEGRADED = "degraded"  # in the place of a degradation: all of them, without the clean photos
GROUP = ["scene", "degradation", "seed"]  # the runs that see the same photos
GAINS = ("gain", "equal_time_gain")  # over the baseline, dB
KEPT = ("seconds", "cpu_seconds", "setup_seconds", "render_ms", "initial_points", "gaussians", "peak_rss_mb")
COSTS = (*KEPT, "ms_per_step", "edge_density", "flat_density")


def by_degradation(title: str, frame: DataFrame, text: Callable[[DataFrame], str]) -> str:
    """A table with a row for each method and a column for each degradation."""
    parts = with_degraded(frame).groupby(["row", "degradation"], sort=False)
    cells: dict[Any, str] = {key: text(part) for key, part in parts}
    labels, kinds = (list(dict.fromkeys(key[k] for key in cells)) for k in (0, 1))
    body = [[label, *(cells[label, kind] for kind in kinds)] for label in labels]
    return markdown_table(title, ["", *kinds], body)


def metrics(frame: DataFrame, what: str, names: Sequence[str] = ("psnr", "ssim", "haarpsi", "lpips")) -> str:
    """Those of the metrics that all runs have. `what`: which runs they are."""
    shown = [name for name in names if frame[name].notna().all()]
    title = "/".join(COLUMNS["metrics"][name][0] for name in shown)

    def text(part: DataFrame) -> str:
        return "/".join(number(part[name].mean(), COLUMNS["metrics"][name][1]) for name in shown)

    return by_degradation(f"{title}, {what}", frame, text)


def gains(frame: DataFrame, name: str, title: str, baseline: str) -> str:
    """Gains of the rows that have them: mean ± standard deviation over groups, and the worst group."""

    def text(part: DataFrame) -> str:
        over = spread(part[name])
        if over is None or over["std"] is None:
            return number(None if over is None else over["mean"], "+.2f")
        return f"{over['mean']:+.2f} ± {over['std']:.2f} ({over['min']:+.2f})"

    title = f"{title} (dB): mean ± std over scenes and seeds (worst)"
    return by_degradation(title, frame.loc[frame["row"] != baseline], text)


def costs(frame: DataFrame, facts: str) -> str:
    """Time, size and memory: means over all runs."""
    hours = sum(run["wall_seconds"] for run in frame["run"]) / 3600
    title = f"Cost, means over all {len(frame)} runs, which took {hours:.1f} h; {facts}"
    return table(title, _records(means(frame, ["row"], COSTS)), LABEL | COLUMNS["costs"])


def training_times(frame: DataFrame) -> str:
    """Seconds of training and number of Gaussians by degradation."""

    def text(part: DataFrame) -> str:
        return f"{part['seconds'].mean():.0f} s, {part['gaussians'].mean():,.0f}"

    return by_degradation("Training time, Gaussians", frame, text)


def courses(frame: DataFrame) -> str:
    """Held-out PSNR and seconds of training at the evaluations that all runs have, means over the runs."""
    histories = [{h["iteration"]: h for h in run["history"]} for run in frame["run"]]
    shared = sorted(set.intersection(*map(set, histories)))
    body = []
    for label, part in frame.assign(history=histories).groupby("row", sort=False)["history"]:
        cells = []
        for k in shared:
            psnr, seconds = (Series([h[k][n] for h in part], dtype=float) for n in ("psnr", "seconds"))
            cells.append(f"{number(psnr.mean(skipna=False), '.2f')}, {seconds.mean():.0f} s")
        body.append([str(label), *cells])
    title = "PSNR (dB) and seconds of training on the way, means over all runs"
    return markdown_table(title, ["iterations", *(f"{k:,}" for k in shared)], body)


def regions(frame: DataFrame) -> str:
    """Gaussians per 1,000 pixels on edges and in flat parts of the clean photos, means over all runs."""
    edge, flat = frame["edge_density"], frame["flat_density"]
    frame = frame.assign(edge=edge, flat=flat, ratio=edge / flat.where(flat > 0))
    rows = _records(means(frame, ["row"], list(COLUMNS["regions"])))
    return table("Gaussians per 1,000 pixels of a training view", rows, LABEL | COLUMNS["regions"])


def edge_maps(rows: Sequence[dict[str, Any]]) -> str:
    """PSNR of degraded photos and of their edge maps against those of the clean photos."""
    kinds = list(dict.fromkeys(kind for row in rows for kind in row["degradations"]))
    lines = []
    for row in rows:
        for name, text in (("photo", "photos"), ("edge", "edge maps")):
            line = {kind: found[f"{name}_psnr"] for kind, found in row["degradations"].items()}
            lines.append(line | {"row": f"{row['scene']}, {text}", "variance": row[f"{name}_variance"]})
    title = "PSNR (dB) of what a degradation leaves, against the clean photo; variance over them (dB²)"
    heads = {kind: (kind, ".2f") for kind in kinds} | {"variance": ("variance", ".2f")}
    return table(title, lines, LABEL | heads)


def formations(frame: DataFrame, label: str) -> str:
    """What a method took for the photos' degradation, by scene; several where the seeds differ."""
    mine = frame.loc[frame["row"] == label]
    found = mine.assign(text=[run["formation"] or NOTHING for run in mine["run"]])
    kinds = list(dict.fromkeys(mine["degradation"]))
    lines = []
    for scene, part in found.groupby("scene", sort=False):
        texts = part.groupby("degradation", sort=False)["text"].agg(lambda t: ", ".join(dict.fromkeys(t)))
        lines.append({"row": scene} | {kind: texts.get(kind, NOTHING) for kind in kinds})
    columns = LABEL | {kind: (kind, "") for kind in kinds}
    return table(f"What {label} took for the degradation", lines, columns)


def reconstructions(frame: DataFrame) -> str:
    """Poses and points from the degraded photos against the scenes' own; all rows of a group share them."""
    lines = []
    for line in frame.drop_duplicates(["scene", "degradation", "seed"]).to_dict("records"):
        s = line["run"]["sfm"]
        rotation, translation = s["rotation_error_deg"], s["translation_error"]
        lines.append(
            s
            | {
                "row": f"{line['scene']}, {line['degradation']}, seed {line['seed']}",
                "registered": f"{s['photos'] - len(s['not_registered'])} / {s['photos']}",
                "rotation": f"{rotation['median']:.3f} / {rotation['max']:.3f}",
                "translation": f"{translation['median']:.2%} / {translation['max']:.2%}",
                "points": f"{s['points']:,} ({s['own_points']:,})",
                "track_length": f"{s['track_length']:.1f} ({number(s['own_track_length'], '.1f')})",
                "reprojection": f"{s['reprojection_error_px']:.2f} "
                f"({number(s['own_reprojection_error_px'], '.2f')})",
            }
        )
    title = "Poses and points from the degraded photos (the scene's own); distances in scene extents"
    return table(title, lines, LABEL | COLUMNS["sfm"])


def _records(frame: DataFrame) -> list[dict[str, Any]]:
    return frame.reset_index().to_dict("records")


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
        line |= {name: run[name] for name in KEPT}
        line["ms_per_step"] = 1_000 * run["seconds"] / run["iterations"]
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
