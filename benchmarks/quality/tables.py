"""The quality benchmark's numbers, Markdown tables of them in the layout of the paper's, and their chart.

A mean is that of all runs of its group: where one of them lacks the number, there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pandas import DataFrame, Series, concat

from benchmarks.output import NOTHING, means, number, paired, panels, records, table, title
from benchmarks.protocol import read_toml
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


def crossed(
    title: str,
    frame: DataFrame,
    text: Callable[[DataFrame], str],
    across: str = "degradation",
    down: str = "row",
    corner: str = "",
) -> str:
    """A row for each value of `down`, a column for each of `across`, the text of the runs that have both."""
    cells: dict[Any, str] = {key: text(part) for key, part in frame.groupby([down, across], sort=False)}
    labels, heads = (list(dict.fromkeys(key[k] for key in cells)) for k in (0, 1))
    body = [[label, *(cells.get((label, head), NOTHING) for head in heads)] for label in labels]
    return markdown_table(title, [corner, *heads], body)


def metrics(frame: DataFrame, what: str, names: Sequence[str] = ("psnr", "ssim", "haarpsi", "lpips")) -> str:
    """Those of the metrics that all runs have. `what`: which runs they are."""
    shown = {name: COLUMNS["metrics"][name] for name in names if frame[name].notna().all()}
    title = f"{'/'.join(head for head, _ in shown.values())}, {what}"
    return crossed(
        title,
        with_degraded(frame),
        lambda part: "/".join(number(part[name].mean(), form) for name, (_, form) in shown.items()),
    )


def fitted(frame: DataFrame, what: str) -> str:
    """The means once each held-out camera was fitted to the trained scene, and how far the cameras moved."""
    own = DataFrame(frame["fitted"].tolist(), frame.index).astype(float)

    def text(part: DataFrame) -> str:
        mean = own.loc[part["index"]].mean(skipna=False)
        moved = number(mean["moved_px"], ".2f")
        return f"{number(mean['psnr'], '.2f')}/{number(mean['ssim'], '.3f')}, {moved} px"

    title = f"PSNR/SSIM, each held-out camera fitted to the trained scene, and its move (median), {what}"
    return crossed(title, with_degraded(frame.reset_index()), text)


def gains(frame: DataFrame, name: str, title: str, baseline: str) -> str:
    """Gains of the rows that have them: mean ± standard deviation over groups, and the worst group."""

    def text(part: DataFrame) -> str:
        over = part[name]
        mean = number(over.mean(skipna=False), "+.2f")
        return mean if len(over) == 1 or mean == NOTHING else f"{mean} ± {over.std():.2f} ({over.min():+.2f})"

    title = f"{title} (dB): mean ± std over scenes and seeds (worst)"
    return crossed(title, with_degraded(frame.loc[frame["row"] != baseline]), text)


def gain_chart(frame: DataFrame, baseline: str) -> Figure:
    """A heat map for each method but the baseline: its PSNR over the baseline's in each group."""
    others = frame.loc[frame["row"] != baseline]
    kinds = list(frame["degradation"].unique())
    lines = frame[["scene", "seed"]].drop_duplicates()
    limit = others["gain"].abs().max()
    limit = limit if limit > 0 else 1.0  # NaN, where there is no gain, is not
    parts = others.groupby("row", sort=False)
    size = 2.2 + 0.85 * len(kinds), (1.1 + 0.34 * len(lines)) * len(parts) + 0.3
    figure, grid = panels(*size, len(parts))
    image = None
    for axes, (label, part) in zip(grid, parts, strict=True):
        values = part.set_index(["scene", "seed", "degradation"])["gain"].unstack()
        values = values.reindex(index=list(lines.itertuples(index=False, name=None)), columns=kinds)
        image = axes.imshow(values.to_numpy(), cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto")
        axes.grid(visible=False)
        title(axes, f"{label} over {baseline}")
        names = [f"{scene}, seed {seed}" for scene, seed in values.index]
        axes.set_xticks(range(len(kinds)), kinds, fontsize=8, parse_math=False)
        axes.set_yticks(range(len(names)), names, fontsize=8, parse_math=False)
        for (i, j), value in np.ndenumerate(values.to_numpy()):
            if np.isfinite(value):
                shade = "white" if abs(value) > 0.6 * limit else "black"
                axes.text(j, i, f"{value:+.2f}", ha="center", va="center", fontsize=8, color=shade)
    if image is not None:
        figure.colorbar(image, ax=grid, label="PSNR gain (dB)")
    return figure


def costs(frame: DataFrame, facts: str) -> str:
    """Time, size and memory: means over all runs."""
    hours = frame["wall_seconds"].sum() / 3600
    title = f"Cost, means over all {len(frame)} runs, which took {hours:.1f} h; {facts}"
    return table(title, records(means(frame, ["row"], COSTS)), LABEL | COLUMNS["costs"])


def training_times(frame: DataFrame) -> str:
    """Seconds of training and number of Gaussians by degradation."""
    return crossed(
        "Training time, Gaussians",
        with_degraded(frame),
        lambda part: f"{part['seconds'].mean():.0f} s, {part['gaussians'].mean():,.0f}",
    )


def best_and_last(frame: DataFrame) -> str:
    """PSNR at the end, and how far below the best moment of the run that is, over moments that measured as
    many views as the end did."""
    frame = frame.assign(fall=[fall(history) for history in frame["history"]])
    return crossed(
        "PSNR at the end (below the best moment of the run), means",
        frame,
        lambda part: f"{number(part['psnr'].mean(), '.2f')} ({number(part['fall'].mean(), '.2f')})",
        across="scene",
    )


def fall(history: Sequence[dict[str, Any]]) -> float:
    """dB from the best moment to the last one."""
    last = history[-1]
    values = [entry["psnr"] for entry in history if entry.get("views") == last.get("views")]
    return max(values) - last["psnr"]


def courses(frame: DataFrame) -> str:
    """Held-out PSNR and seconds of training at the evaluations that all runs have, means over the runs."""
    histories = zip(frame["row"], frame["history"], strict=True)
    way = DataFrame([entry | {"row": row} for row, history in histories for entry in history])
    shared = way.groupby("iteration")["row"].transform("size") == len(frame)
    way = way.loc[shared].astype({"psnr": float, "seconds": float}).sort_values("iteration", kind="stable")

    def text(part: DataFrame) -> str:
        return f"{number(part['psnr'].mean(skipna=False), '.2f')}, {part['seconds'].mean():.0f} s"

    title = "PSNR (dB) and seconds of training on the way, means over all runs"
    way["iteration"] = way["iteration"].map("{:,}".format)
    return crossed(title, way, text, across="iteration", corner="iterations")


def regions(frame: DataFrame) -> str:
    """Gaussians per 1,000 pixels on edges and in flat parts of the clean photos, means over all runs."""
    edge, flat = frame["edge_density"], frame["flat_density"]
    frame = frame.assign(edge=edge, flat=flat, ratio=edge / flat.where(flat > 0))
    rows = records(means(frame, ["row"], list(COLUMNS["regions"])))
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
    return crossed(
        f"What {label} took for the degradation",
        frame.loc[frame["row"] == label].fillna({"formation": NOTHING}),
        lambda part: ", ".join(dict.fromkeys(part["formation"])),
        down="scene",
    )


def reconstructions(frame: DataFrame) -> str:
    """Poses and points from the degraded photos against the scenes' own; all rows of a group share them."""
    lines = []
    for line in frame.drop_duplicates(GROUP).to_dict("records"):
        s = line["sfm"]
        rotation, translation = s["rotation_error_deg"], s["translation_error"]
        own_error = number(s["own_reprojection_error_px"], ".2f")
        words = {
            "row": f"{line['scene']}, {line['degradation']}, seed {line['seed']}",
            "registered": f"{s['photos'] - len(s['not_registered'])} / {s['photos']}",
            "rotation": f"{rotation['median']:.3f} / {rotation['max']:.3f}",
            "translation": f"{translation['median']:.2%} / {translation['max']:.2%}",
            "points": f"{s['points']:,} ({s['own_points']:,})",
            "track_length": f"{s['track_length']:.1f} ({number(s['own_track_length'], '.1f')})",
            "reprojection": f"{s['reprojection_error_px']:.2f} ({own_error})",
            "auc": "/".join(f"{value:.2f}" for value in (s.get("auc") or {}).values()) or NOTHING,
        }
        lines.append(s | words)
    title = "Poses and points from the degraded photos (the scene's own); distances in scene extents"
    return table(title, lines, LABEL | COLUMNS["sfm"])


def frame_of(runs: DataFrame, baseline: str | None = None) -> DataFrame:
    """The runs with the numbers of the tables beside what they hold, NaN where there is none.

    Gains are over the run of the `baseline` in the same group; without one there are none.
    """
    frame = runs.reset_index(drop=True)
    frame = frame.join(DataFrame(frame["metrics"].tolist(), columns=METRICS))
    frame["ms_per_step"] = 1_000 * frame["seconds"] / frame["iterations"]
    for name in ("edge", "flat"):
        frame[f"{name}_density"] = [regions[name]["density"] for regions in frame["regions"]]
    frame = frame.astype(dict.fromkeys([*METRICS, *COSTS], float))
    if baseline is not None:
        pairs = paired(frame, baseline, GROUP)
        frame["gain"] = pairs["psnr"] - pairs["psnr_base"]
        both = zip(pairs["history"], pairs["history_base"], strict=True)
        frame["equal_time_gain"] = Series([equal_time_gain(*two) for two in both], pairs.index, dtype=float)
    return frame


def with_degraded(frame: DataFrame) -> DataFrame:
    """The runs of each degradation, in their order, and as `DEGRADED` all of them where there are several."""
    bad = frame.loc[frame["degradation"] != NONE]
    if len(set(bad["degradation"])) < 2:
        return frame
    return concat([frame, bad.assign(degradation=DEGRADED)], ignore_index=True)


def psnr_at(history: Sequence[dict[str, Any]], seconds: float) -> float | None:
    """Held-out PSNR of a run when it had trained for so long, between two evaluations by a straight line.

    None before the first evaluation and after the end.
    """
    times, values = ([entry[name] for entry in history] for name in ("seconds", "psnr"))
    if None in values or not times[0] <= seconds <= times[-1]:
        return None
    return float(np.interp(seconds, times, values))


def equal_time_gain(history: Sequence[dict[str, Any]], base: Sequence[dict[str, Any]]) -> float | None:
    """PSNR over that of the baseline at the moment when the faster of the two ends.

    The slower one is judged in the middle of its schedule, its learning rate still high: what it would reach
    with a schedule made for that time is rather more. Time is that of the wall, so another program on the
    machine moves this number: between two runs of one method it should be 0. None where the slower one had
    not been evaluated by then.
    """
    moment = min(history[-1]["seconds"], base[-1]["seconds"])
    mine, other = psnr_at(history, moment), psnr_at(base, moment)
    return None if mine is None or other is None else mine - other
