"""The speed benchmark's numbers as Markdown tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.data import read_toml
from benchmarks.output import number, span, table
from hqgs.base.text import markdown_table

Rows = Sequence[dict[str, Any]]
AGAINST = {"gaussians": "Gaussians", "pixels": "pixels"}
COLUMNS = read_toml(Path(__file__).with_name("speed.toml"))["columns"]


def rasterizer(rows: Rows) -> list[str]:
    """Times of the stages, and the work behind them."""
    size = f"{rows[0]['width']} x {rows[0]['height']}"
    title = f"Rasterizer, {size}, harmonics of degree 3, forward and backward (ms, medians)"
    times = [row | row["stages"] | {"quartiles": _quartiles(row)} for row in rows]
    work = [row | row["work"] for row in rows]
    work = [row | {"changed": row["changed_blocks"] / row["blocks"]} for row in work]
    return [table(title, times, COLUMNS["rasterizer"]), table("Work of one pass", work, COLUMNS["work"])]


def steps(rows: Rows) -> str:
    """One column for each case."""
    first = rows[0]
    body = [
        ["whole step (ms)", *(number(r["seconds"], "ms") for r in rows)],
        ["quartiles (ms)", *map(_quartiles, rows)],
        [f"over {first['case']}", *(f"{r['over_first']:.2f}" for r in rows)],
        ["target (ms)", *(str(r["target_ms"] or "") for r in rows)],
        *([f"{part} (%)", *(f"{r['percent'][part]:.1f}" for r in rows)] for part in first["percent"]),
        ["with clocks / without", *(f"{r['clocked']:.2f}" for r in rows)],
    ]
    title = f"One training step, {first['width']} x {first['height']}"
    return markdown_table(title, ["", *(r["case"] for r in rows)], body)


def threads(rows: Rows) -> str:
    lines = [row | {"share": row["speedup"] / row["threads"]} for row in rows]
    return table("Threads", lines, COLUMNS["threads"])


def scaling(result: dict[str, Any]) -> str:
    """The powers; the points that they were fitted to are in the chart."""
    title = "Power with which the time of forward and backward grows"
    powers = [result[name] | {"against": what} for name, what in AGAINST.items()]
    return table(
        title, [curve | {"target": result["target_exponent"]} for curve in powers], COLUMNS["powers"]
    )


def memory(result: dict[str, Any]) -> str:
    megapixels = result["width"] * result["height"] / 1e6
    title = (
        f"Peak memory (MB = 10^6 bytes), {result['method']}, {result['gaussians']:,} Gaussians, "
        f"{result['photos']} photos of {megapixels:.2f} MP, {result['steps']} steps"
    )
    return table(title, [result], COLUMNS["memory"])


def _quartiles(row: dict[str, Any]) -> str:
    return span(row["seconds_quartiles"], "ms")
