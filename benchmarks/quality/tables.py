"""The quality benchmark's numbers as Markdown tables, in the layout of the paper's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pandas import DataFrame, Series

from benchmarks.data import read_toml
from benchmarks.output import NOTHING, number, table
from benchmarks.quality.summary import means, spread, with_degraded
from hqgs.base.text import markdown_table

COLUMNS = read_toml(Path(__file__).with_name("protocols.toml"))["columns"]
METRICS, COSTS, REGIONS, SFM = (COLUMNS[name] for name in ("metrics", "costs", "regions", "sfm"))
LABEL = {"row": ("", "")}


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
    title = "/".join(METRICS[name][0] for name in shown)

    def text(part: DataFrame) -> str:
        return "/".join(number(part[name].mean(), METRICS[name][1]) for name in shown)

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
    return table(title, _records(means(frame, ["row"], list(COSTS))), LABEL | COSTS)


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
    rows = _records(means(frame, ["row"], list(REGIONS)))
    return table("Gaussians per 1,000 pixels of a training view", rows, LABEL | REGIONS)


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
    return table(title, lines, LABEL | SFM)


def _records(frame: DataFrame) -> list[dict[str, Any]]:
    return frame.reset_index().to_dict("records")
