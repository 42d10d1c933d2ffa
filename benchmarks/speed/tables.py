"""The speed benchmark's numbers as Markdown tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hqgs.base.text import markdown_table

Rows = Sequence[dict[str, Any]]


def rasterizer(rows: Rows) -> list[str]:
    """Times of the stages, and the work behind them."""
    first = rows[0]
    stages = list(first["stages"])
    size = f"{first['width']} x {first['height']}"
    times = markdown_table(
        f"Rasterizer, {size}, harmonics of degree 3, forward and backward (ms, medians)",
        [
            "Gaussians", *stages, "whole", "quartiles", "limit", "whole / limit",
            "of it bin", "compositing alone", "compositing / limit",
        ],
        [
            [
                f"{r['gaussians']:,}",
                *(_ms(r["stages"][stage]) for stage in stages),
                _ms(r["seconds"]),
                " to ".join(map(_ms, r["seconds_quartiles"])),
                _ms(r["limit_seconds"]),
                f"{r['times_limit']:.2f}",
                _ms(r["bin_seconds"]),
                _ms(r["compositing_seconds"]),
                f"{r['compositing_times_limit']:.2f}",
            ]
            for r in rows
        ],
    )  # fmt: skip
    work = markdown_table(
        "Work of one pass",
        [
            "Gaussians", "blended per pixel", "tile pairs", "blocks", "of them changed", "lane use",
            "operations per blended pair", "bytes per tile pair", "operations per byte",
        ],
        [
            [
                f"{r['gaussians']:,}",
                f"{w['blended_per_pixel']:.1f} ± {w['blended_standard_error']:.1f}",
                f"{w['tile_pairs']:,}",
                f"{w['blocks']:,}",
                f"{100 * w['changed_blocks'] / w['blocks']:.1f} %",
                f"{100 * w['lane_use']:.0f} %",
                f"{w['operations_per_blended_pair']:.0f}",
                f"{w['bytes_per_tile_pair']:.0f}",
                f"{w['operations_per_byte']:.1f}",
            ]
            for r in rows
            for w in [r["work"]]
        ],
    )  # fmt: skip
    return [times, work]


def steps(rows: Rows) -> str:
    """One column for each case."""
    first = rows[0]
    body = [
        ["whole step (ms)", *(_ms(r["seconds"]) for r in rows)],
        ["quartiles (ms)", *(" to ".join(map(_ms, r["seconds_quartiles"])) for r in rows)],
        [f"over {first['case']}", *(f"{r['over_first']:.2f}" for r in rows)],
        ["target (ms)", *(str(r["target_ms"] or "") for r in rows)],
        *([f"{part} (%)", *(f"{r['percent'][part]:.1f}" for r in rows)] for part in first["percent"]),
        ["with clocks / without", *(f"{r['clocked']:.2f}" for r in rows)],
    ]
    title = f"One training step, {first['width']} x {first['height']}"
    return markdown_table(title, ["", *(r["case"] for r in rows)], body)


def threads(rows: Rows) -> str:
    return markdown_table(
        "Threads",
        ["", "threads", "ms", "speed-up", "per thread"],
        [
            [
                r["case"],
                str(r["threads"]),
                _ms(r["seconds"]),
                f"{r['speedup']:.2f}",
                f"{100 * r['speedup'] / r['threads']:.0f} %",
            ]
            for r in rows
        ],
    )


def scaling(result: dict[str, Any]) -> list[str]:
    """The powers, and the points that they were fitted to."""
    by_size, by_pixels = result["gaussians"], result["pixels"]
    powers = markdown_table(
        "Power with which the time of forward and backward grows",
        ["against", "fitted", "steepest between two points", "target"],
        [
            [name, f"{curve['exponent']:.2f}", f"{curve['steepest']:.2f}", f"<= {result['target_exponent']}"]
            for name, curve in (("Gaussians", by_size), ("pixels", by_pixels))
        ],
    )
    pixels = by_size["width"] * by_size["height"]
    points = [(n, pixels, seconds) for n, seconds in zip(by_size["x"], by_size["seconds"], strict=True)]
    points += [
        (by_pixels["gaussians"], pixels, seconds)
        for pixels, seconds in zip(by_pixels["x"], by_pixels["seconds"], strict=True)
    ]
    body = [[f"{n:,}", f"{pixels / 1e6:.3g}", _ms(seconds)] for n, pixels, seconds in points]
    return [powers, markdown_table("The points", ["Gaussians", "megapixels", "ms"], body)]


def memory(result: dict[str, Any]) -> str:
    megapixels = result["width"] * result["height"] / 1e6
    title = (
        f"Peak memory, {result['method']}, {result['gaussians']:,} Gaussians, {result['photos']} photos of "
        f"{megapixels:.2f} MP, {result['steps']} steps (GB = 10^9 bytes)"
    )
    head = ["after the imports", "with the scene", "in training", "target"]
    names = ("imports_mb", "scene_mb", "peak_mb", "target_mb")
    return markdown_table(title, head, [[f"{result[name] / 1000:.2f}" for name in names]])


def gsplat(rows: Rows) -> str:
    return markdown_table(
        f"gsplat on {rows[0]['device']}, the same inputs, forward and backward (ms, medians)",
        ["Gaussians", "gsplat", "hqgs", "hqgs / gsplat"],
        [
            [f"{r['gaussians']:,}", _ms(r["seconds"]), _ms(r["hqgs_seconds"]), f"{r['ratio']:.1f}"]
            for r in rows
        ],
    )


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.3g}" if seconds < 0.1 else f"{1000 * seconds:.0f}"
