"""A diagnosis as text for people."""

from __future__ import annotations

from hqgs.diagnosis.photo import PhotoDiagnosis
from hqgs.diagnosis.scene import Diagnosis

_HEAD = ("photo", "size", "enlarged", "jpeg", "blocking", "noise", "blur")


def format_diagnosis(diagnosis: Diagnosis) -> str:
    """One row per photo, the formation, and per part whether it is needed and why."""
    rows = [_HEAD, *(_row(photo) for photo in diagnosis.photos)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(_HEAD))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
    lines += ["", f"{diagnosis.scene}: {diagnosis.formation}"]
    for name, needed, reason in diagnosis.needs():
        lines.append(f"  {name:8}{'needed   ' if needed else 'left out '} {reason}")
    return "\n".join(lines)


def _row(photo: PhotoDiagnosis) -> tuple[str, ...]:
    small = photo.enlargement
    enlarged = "no" if small.factor == 1 else f"x{small.factor} from {small.width} x {small.height}"
    if photo.noise is None:
        noise = "?"
    elif photo.noise == 0:
        noise = f"< {photo.noise_limit:.0f}"
    else:
        noise = f"{photo.noise:.1f}"
    blur = "?" if photo.blur is None else f"{photo.blur.kind} {photo.blur.amount:.2f} px"
    if photo.blur is not None and photo.blur.direction is not None:
        blur += f" at {photo.blur.direction:.0f} deg"
    quality = "no" if photo.jpeg.quality is None else str(photo.jpeg.quality)
    size = f"{photo.width} x {photo.height}"
    return photo.name, size, enlarged, quality, f"{photo.jpeg.blocking:.2f}", noise, blur
