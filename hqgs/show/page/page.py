"""report.html: all of a run in one file that needs no network."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.evenly import evenly
from hqgs.base.left_out import CORRECTION
from hqgs.diagnosis.photo import PhotoDiagnosis
from hqgs.diagnosis.scene import Diagnosis
from hqgs.evaluation.constants import MOST_CAMERAS
from hqgs.evaluation.held_out import RenderedView, names_of
from hqgs.evaluation.records import Json, LearnedRecord, PlanRowRecord, Report, ViewMetricValues, alike
from hqgs.evaluation.verdict import judged_by, told, verdict
from hqgs.model.gaussians import Gaussians
from hqgs.photos.pixels import as_floats, to_uint8, upright
from hqgs.scene.paths import focus, scene_up
from hqgs.scene.scene import Camera, Scene
from hqgs.show.page.packing import pack_scene

TEMPLATES = Path(__file__).parent / "templates"


def filled(template: str, **values: Any) -> Markup:
    """A template with these values, which are escaped."""
    from jinja2 import Environment, FileSystemLoader  # here: only a page needs it

    loader = FileSystemLoader(TEMPLATES)
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return Markup(environment.get_template(template).render(**values))


def line_chart(title: str, unit: str, lines: Sequence[Sequence[tuple[float, float]]], color: str) -> Markup:
    """Values against seconds of run time, as lines. Without points: the title and a sentence."""
    points = [point for line in lines for point in line]
    if not points:
        return filled("line_chart.svg.j2", title=title, lines=[])
    xs, ys = (np.array(values, float) for values in zip(*points, strict=True))
    low, high = float(ys.min()), float(ys.max())
    pad = 0.06 * (high - low) or 0.5 * abs(high) or 1.0
    low, high = max(low - pad, 0.0) if low >= 0 else low - pad, high + pad
    end = float(xs.max()) or 1.0

    def down(y: float) -> float:
        return (high - y) / (high - low)

    return filled(
        "line_chart.svg.j2",
        title=title,
        color=color,
        lines=[
            [(x / end, down(y), f"{_number(y)} {unit} after {x:.0f} s") for x, y in line] for line in lines
        ],
        rows=[(down(y), _number(y)) for y in _ticks(low, high)],
        columns=[(x / end, _number(x)) for x in _ticks(0, end)],
    )


def _ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers between the ends."""
    step = 10.0 ** np.floor(np.log10((high - low) / 2))
    while (high - low) / step > 5:
        step *= 2 if round(step / 10 ** np.floor(np.log10(step))) in (1, 5) else 2.5
    return [float(k * step) for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


CHARTS = (
    ("Held-out PSNR", "dB", "psnr", "#2f7fc4"),
    ("Held-out SSIM", "", "ssim", "#d0672a"),
    ("Gaussians", "", "gaussians", "#3f9b57"),
    ("Memory", "MB", "memory_mb", "#8a5fbf"),
)


def told_verdict(report: Report) -> str:
    """What came out, in words, with the number that it goes by."""
    psnr, name = judged_by(report)
    word, why = verdict(psnr, report["metrics"])
    text = f"Quality: {word}. {why[0].upper()}{why[1:]}."
    if psnr is None:
        return text
    count = len(report["metrics"]["views"])
    value = told(report, "psnr" if psnr == report["metrics"]["mean"]["psnr"] else "psnr_aligned", ".1f")
    return f"{text} Measured on {count} held-out photo{'s' * (count > 1)}: {value} dB {name}."


def summary_html(report: Report, views: Sequence[RenderedView]) -> str:
    """The verdict, and the first held-out photo beside its render, as HTML for a notebook."""
    parts = [
        Markup("<p>{}: {} iterations, {} Gaussians, {}. {}</p>").format(
            report["scene"],
            report["iterations"],
            report["gaussians"],
            _time(report["seconds"]),
            told_verdict(report),
        )
    ]
    for view in views[:1]:
        both = pair(view, None)
        shown = Markup('<img src="{}" alt="photo" width="45%"> <img src="{}" alt="render" width="45%">')
        parts.append(shown.format(both["photo"], both["render"]))
    return str(Markup("").join(parts))


def page_text(
    report: Report,
    scene: Scene,
    gaussians: Gaussians | None,
    views: Sequence[RenderedView],
    diagnosis: Diagnosis | None = None,
) -> str:
    """The page as HTML. Without Gaussians it has no scene to fly through.

    Names from files are escaped; nothing in it is loaded from elsewhere.
    """
    history = report["history"]
    measured = {view["name"]: view for view in report["metrics"]["views"]}
    chosen = _chosen(views, measured)
    charts = [
        line_chart(
            name,
            unit,
            [[(h["seconds"], v) for h in part if (v := h.get(key)) is not None] for part in alike(history)],
            color,
        )
        for name, unit, key, color in CHARTS
    ]
    measured_some = [h["views"] for h in history if "views" in h]
    learned = [_learned(record) for record in report["learned"]]
    return filled(
        "report.html.j2",
        title=f"{report['scene']}, {report['method']}",
        verdict=told_verdict(report),
        facts=_facts(report, scene),
        report=report,
        scene=None if gaussians is None else _scene(scene, gaussians, report["config"]["background"]),
        splats=Markup(
            "\n".join((TEMPLATES / f"{name}.js").read_text("utf-8") for name in ("splat_shaders", "splats"))
        ),
        pairs=[pair(view, measured.get(view.name)) for view in chosen],
        pairs_left=len(views) - len(chosen),
        charts=charts,
        measured_on=max(measured_some, default=0),
        parts=[] if diagnosis is None else diagnosis.parts,
        photos=[] if diagnosis is None else [_photo(found) for found in diagnosis.photos],
        learned=[
            words | {"photo": record["name"]}
            for record, words in zip(report["learned"], learned, strict=True)
        ],
        learned_heads=["photo", *dict.fromkeys(head for words in learned for head in words)],
        left_out=[
            (item["what"], item["why"], item.get("evidence", ""))
            for item in report["left_out"]
            if not _correction(item)
        ],
        plan=[_plan_row(row) for row in report.get("plan", []) if not _correction(row)],
        notes=report["notes"],
        lost=[*((report.get("sfm") or {}).get("lost") or {}).items()],
        environment=_environment(report),
        config=json.dumps(report["config"], indent=1),
    )


def _facts(report: Report, scene: Scene) -> list[tuple[str, str]]:
    psnr = told(report, "psnr", ".2f")
    facts = [
        ("PSNR, held out", "-" if psnr is None else f"{psnr} dB"),
        ("SSIM, held out", told(report, "ssim", ".3f") or "-"),
        ("Gaussians", f"{report['gaussians']:,}"),
        ("training", _time(report["seconds"])),
        ("photos trained on", f"{len(scene.train)}"),
        ("iterations", f"{report['iterations']:,}"),
    ]
    if (shown := report["metrics"].get("psnr_shown")) is not None:
        facts.insert(1, ("PSNR without the cameras' vignetting and response", f"{shown:.2f} dB"))
    if report["peak_rss_mb"] is not None:
        facts.append(("memory", f"{report['peak_rss_mb']:,.0f} MB"))
    if report["scene_bytes"] is not None:
        facts.append(("scene.ply", f"{report['scene_bytes'] / 1e6:.1f} MB"))
    return facts


def _scene(scene: Scene, gaussians: Gaussians, background: Json) -> dict[str, Any]:
    head, data = pack_scene(gaussians)
    views = [*scene.test, *scene.train]
    views = [views[k] for k in evenly(len(views), MOST_CAMERAS)]
    cameras = [view.upright_camera for view in views]
    middle = focus([view.camera for view in scene.train])
    note = f"{head['count']:,} Gaussians, harmonics of degree {head['degree']}, {len(data) / 1e6:.1f} MB"
    if left_out := len(gaussians) - head["count"]:
        note += f"; the {left_out:,} least visible ones are left out"
    first = cameras[0]
    return {
        "data": data,
        "head": {**head, "background": background},
        "views": [{"name": v.name, **_view(c, middle)} for v, c in zip(views, cameras, strict=True)],
        "up": scene_up(scene).tolist(),
        "aspect": f"{first.width} / {first.height}",
        "note": note,
    }


def _view(camera: Camera, middle: NDArray[np.float64]) -> dict[str, Any]:
    R, K = camera.viewmat[:3, :3], camera.K
    away = float(np.linalg.norm(middle - camera.center))
    ahead = float(R[2] @ (middle - camera.center))
    return {
        "R": R.tolist(),
        "eye": camera.center.tolist(),
        "fy": K[1, 1] / camera.height,
        "ratio": K[0, 0] / K[1, 1],
        "middle": [K[0, 2] / camera.width, K[1, 2] / camera.height],
        "distance": max(ahead, 0.1 * away, 1e-3),
    }


def _chosen(views: Sequence[RenderedView], measured: dict[str, ViewMetricValues]) -> list[RenderedView]:
    """Some of the held-out views, evenly from the best to the worst."""
    names = names_of(views)

    def psnr(number: int) -> float:
        value = measured[names[number]]["psnr"] if names[number] in measured else None
        return -np.inf if value is None else value

    ordered = sorted(range(len(views)), key=psnr, reverse=True)
    places = evenly(len(ordered), 8)
    return [views[ordered[k]] for k in places]


def pair(view: RenderedView, metrics: Mapping[str, Any] | None) -> dict[str, str]:
    numbers = []
    if metrics is not None:
        numbers += [] if metrics["psnr"] is None else [f"{metrics['psnr']:.2f} dB"]
        numbers += [] if metrics["ssim"] is None else [f"SSIM {metrics['ssim']:.3f}"]
    return {
        "name": view.name,
        "numbers": ", ".join(numbers),
        "photo": jpeg(Image.fromarray(upright(to_uint8(as_floats(view.photo)), view.quarter_turns))),
        "render": jpeg(Image.fromarray(upright(to_uint8(view.render), view.quarter_turns))),
    }


def jpeg(picture: Image.Image, side: int = 720) -> str:
    picture, file = picture.copy(), io.BytesIO()
    picture.thumbnail((side, side), Image.Resampling.LANCZOS)
    picture.save(file, "JPEG", quality=82)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def _photo(found: PhotoDiagnosis) -> tuple[str, ...]:
    """Name, size and faults of a photo."""
    blur, quality, factor = found.blur, found.jpeg.quality, found.enlargement.factor
    return (
        found.name,
        f"{found.width} x {found.height}",
        "unknown" if blur is None else f"{blur.kind}, {blur.amount:.2f} px",
        "unknown" if found.noise is None else f"{found.noise:.1f} levels",
        "not visible" if quality is None else f"{quality}",
        "no" if factor == 1 else f"x{factor}",
    )


def _learned(record: LearnedRecord) -> dict[str, str]:
    """Shake, focus and exposure, by name, for people."""
    stops = np.log2(record["gains"])
    rgb = {name: f"{value:+.2f}" for name, value in zip("RGB", stops - stops.mean(), strict=True)}
    shake = f"{record['shake_px']:.1f} px" if record["shake_px"] else "still"
    focus = f"{record['defocus_px']:.1f} px" if record["defocus_px"] else "sharp"
    if record["focus"] is not None:
        focus += f", sharp at {record['focus']:.2g} of the median depth"
    words = {"shake": shake, "out of focus": focus, "exposure, stops": f"{stops.mean():+.2f}", **rgb}
    if (fall := sum(record.get("vignetting", [0.0]))) != 0:
        words["vignetting"] = f"{np.expm1(-fall):+.0%} light in the corners"
    if (bends := np.abs(record.get("response", [[0.0]]))).any():
        words["response curve"] = f"slope up to {bends.sum(0).max():.0%} off the mean"
    return words


def _plan_row(row: PlanRowRecord) -> tuple[str, ...]:
    """The cells of a decision."""
    when = f"after iteration {row['iteration']:,}: " if "iteration" in row else ""
    return row["what"], row["value"], when + row["why"], row.get("evidence", ""), row.get("rule", "")


def _correction(item: Mapping[str, Any]) -> bool:
    """Whether it is of a correction that was not needed: those are told once, with what the photos show."""
    return item["what"].startswith(CORRECTION)


def _environment(report: Report) -> list[tuple[str, str]]:
    machine, versions = report["machine"], report["versions"]
    rows = [("seed", str(report["seed"])), ("scene read as", report["source"])]
    rows += [(name.replace("_", " "), str(value)) for name, value in machine.items() if value is not None]
    return rows + [
        (name.replace("_", " "), str(value)) for name, value in versions.items() if value is not None
    ]


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
