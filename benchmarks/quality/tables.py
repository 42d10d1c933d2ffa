"""The quality benchmark's numbers as Markdown tables, in the layout of the paper's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.quality.summary import COSTS, Group, Run, columns, density, mean_of
from hqgs.base.text import markdown_table

METRICS = {
    "psnr": ("PSNR", ".2f"),
    "ssim": ("SSIM", ".3f"),
    "haarpsi": ("HaarPSI", ".3f"),
    "lpips": ("LPIPS", ".3f"),
}
NOTHING = "–"

Summary = dict[str, Any]  # of `quality_summary.summary`


def quality(numbers: Summary, what: str) -> str:
    """Rows are methods, columns degradations: the metrics that all runs have. `what`: which runs they are."""
    shown = {
        metric: form
        for metric, form in METRICS.items()
        if all(entry[metric] is not None for row in numbers.values() for entry in row.values())
    }
    names = "/".join(name for name, _ in shown.values())
    body = [
        [
            label,
            *("/".join(_number(entry[m], form) for m, (_, form) in shown.items()) for entry in row.values()),
        ]
        for label, row in numbers.items()
    ]
    return markdown_table(f"{names}, {what}", ["", *_kinds(numbers)], body)


def gains(numbers: Summary, name: str, title: str) -> str:
    """Gains of the rows that have them: mean ± standard deviation over groups, and the worst group."""
    body = [
        [label, *(_gain(entry[name]) for entry in row.values())]
        for label, row in numbers.items()
        if all(name in entry for entry in row.values())
    ]
    return markdown_table(
        f"{title} (dB): mean ± std over scenes and seeds (worst)", ["", *_kinds(numbers)], body
    )


def one_scene(groups: Sequence[Group], labels: Sequence[str], what: str) -> str:
    """PSNR and SSIM of the groups of one scene, means over seeds."""
    parts = columns(groups)
    body = [
        [
            label,
            *(
                "/".join(
                    _number(mean_of(part, label, lambda run, m=m: run["metrics"][m]), METRICS[m][1])
                    for m in ("psnr", "ssim")
                )
                for part in parts.values()
            ),
        ]
        for label in labels
    ]
    return markdown_table(f"PSNR/SSIM, {what}", ["", *parts], body)


def costs(groups: Sequence[Group], labels: Sequence[str], facts: str) -> str:
    """Time, size and memory: means over all runs."""
    heads = {
        "seconds": ("training (s)", ".1f"), "cpu_seconds": ("CPU (s)", ".1f"),
        "setup_seconds": ("set-up (s)", ".2f"),
        "ms_per_step": ("step (ms)", ".1f"), "render_ms": ("render (ms)", ".2f"),
        "initial_points": ("first points", ",.0f"), "gaussians": ("Gaussians", ",.0f"),
        "peak_rss_mb": ("peak memory (MB)", ",.0f"),
    }  # fmt: skip
    body = [
        [label, *(_number(mean_of(groups, label, COSTS[name]), form) for name, (_, form) in heads.items())]
        for label in labels
    ]
    runs = [group.runs[label] for group in groups for label in labels]
    hours = sum(run["wall_seconds"] for run in runs) / 3600
    title = f"Cost, means over all {len(runs)} runs, which took {hours:.1f} h; {facts}"
    return markdown_table(title, ["", *(head for head, _ in heads.values())], body)


def training_times(numbers: Summary) -> str:
    """Seconds of training and number of Gaussians by degradation."""
    body = [
        [label, *(f"{entry['seconds']:.0f} s, {entry['gaussians']:,.0f}" for entry in row.values())]
        for label, row in numbers.items()
    ]
    return markdown_table("Training time, Gaussians", ["", *_kinds(numbers)], body)


def courses(groups: Sequence[Group], labels: Sequence[str]) -> str:
    """Held-out PSNR and seconds of training at the evaluations that all runs have, means over the runs."""
    runs = [group.runs[label] for group in groups for label in labels]
    shared = sorted(set.intersection(*({h["iteration"] for h in run["history"]} for run in runs)))

    def mean(label: str, iteration: int, name: str) -> float | None:
        def value(run: Run) -> float | None:
            return next(h[name] for h in run["history"] if h["iteration"] == iteration)

        return mean_of(groups, label, value)

    body = [
        [
            label,
            *(
                f"{_number(mean(label, k, 'psnr'), '.2f')}, {_number(mean(label, k, 'seconds'), '.0f')} s"
                for k in shared
            ),
        ]
        for label in labels
    ]
    return markdown_table(
        "PSNR (dB) and seconds of training on the way, means over all runs",
        ["iterations", *(f"{k:,}" for k in shared)],
        body,
    )


def regions(groups: Sequence[Group], labels: Sequence[str]) -> str:
    """Gaussians per 1,000 pixels on edges and in flat parts of the clean photos, means over all runs."""

    def ratio(run: Run) -> float | None:
        edge, flat = density(run, "edge"), density(run, "flat")
        return edge / flat if edge is not None and flat else None

    body = [
        [
            label,
            _number(mean_of(groups, label, lambda run: density(run, "edge")), ".1f"),
            _number(mean_of(groups, label, lambda run: density(run, "flat")), ".1f"),
            _number(mean_of(groups, label, ratio), ".2f"),
        ]
        for label in labels
    ]
    return markdown_table(
        "Gaussians per 1,000 pixels of a training view", ["", "edges", "flat", "edges / flat"], body
    )


def edge_maps(rows: Sequence[dict[str, Any]]) -> str:
    """PSNR of degraded photos and of their edge maps against those of the clean photos."""
    kinds = list(dict.fromkeys(kind for row in rows for kind in row["degradations"]))
    body = []
    for row in rows:
        for name, text in (("photo", "photos"), ("edge", "edge maps")):
            values = [row["degradations"][kind][f"{name}_psnr"] for kind in kinds]
            body.append(
                [
                    f"{row['scene']}, {text}",
                    *(f"{v:.2f}" for v in values),
                    _number(row[f"{name}_variance"], ".2f"),
                ]
            )
    return markdown_table(
        "PSNR (dB) of what a degradation leaves, against the clean photo; variance over degradations (dB²)",
        ["", *kinds, "variance"],
        body,
    )


def formations(groups: Sequence[Group], label: str) -> str:
    """What a method took for the photos' degradation, by scene; several where the seeds differ."""
    kinds = list(dict.fromkeys(group.degradation for group in groups))
    body = []
    for scene in dict.fromkeys(group.scene for group in groups):
        found = {
            kind: dict.fromkeys(
                group.runs[label]["formation"] or NOTHING
                for group in groups
                if (group.scene, group.degradation) == (scene, kind)
            )
            for kind in kinds
        }
        body.append([scene, *(", ".join(texts) or NOTHING for texts in found.values())])
    return markdown_table(f"What {label} took for the degradation", ["", *kinds], body)


def reconstructions(groups: Sequence[Group]) -> str:
    """Poses and points from the degraded photos against the scenes' own; all rows of a group share them."""
    body = []
    for group in groups:
        found = next(iter(group.runs.values()))["sfm"]
        rotation, translation = found["rotation_error_deg"], found["translation_error"]
        own_error = _number(found["own_reprojection_error_px"], ".2f")
        body.append(
            [
                f"{group.scene}, {group.degradation}, seed {group.seed}",
                f"{found['photos'] - len(found['not_registered'])} / {found['photos']}",
                f"{rotation['median']:.3f} / {rotation['max']:.3f}",
                f"{translation['median']:.2%} / {translation['max']:.2%}",
                f"{found['own_cameras_px']:.2f}",
                f"{found['points']:,} ({found['own_points']:,})",
                f"{found['point_distance']:.2%}",
                f"{found['track_length']:.1f} ({_number(found['own_track_length'], '.1f')})",
                f"{found['reprojection_error_px']:.2f} ({own_error})",
            ]
        )
    return markdown_table(
        "Poses and points from the degraded photos, in brackets the scene's own; distances in scene extents",
        [
            "",
            "registered",
            "rotation error (deg), median / max",
            "centre error, median / max",
            "own cameras off (px)",
            "points",
            "to the nearest own point",
            "photos a point",
            "reprojection error (px)",
        ],
        body,
    )


def _kinds(numbers: Summary) -> list[str]:
    return list(next(iter(numbers.values())))


def _number(value: float | None, form: str) -> str:
    return NOTHING if value is None else format(value, form)


def _gain(over: dict[str, Any] | None) -> str:
    if over is None:
        return NOTHING
    if over["std"] is None:
        return f"{over['mean']:+.2f}"
    return f"{over['mean']:+.2f} ± {over['std']:.2f} ({over['min']:+.2f})"
