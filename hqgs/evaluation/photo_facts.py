"""What a photo was found to suffer from, as the report keeps it, and in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hqgs.diagnosis.photo import PhotoDiagnosis
from hqgs.evaluation.records import LearnedRecord, PhotoRecord


def photo_record(found: PhotoDiagnosis) -> PhotoRecord:
    """The diagnosis of a photo as the report keeps it."""
    return {
        "name": found.name,
        "width": found.width,
        "height": found.height,
        "blur": None if found.blur is None else found.blur.kind,
        "blur_px": None if found.blur is None else found.blur.amount,
        "noise": found.noise,
        "jpeg_quality": found.jpeg.quality,
        "enlarged": found.enlargement.factor,
    }


def photo_words(record: PhotoRecord) -> dict[str, str]:
    """Size and faults, by name, for people."""
    blur, quality, factor = record["blur"], record["jpeg_quality"], record["enlarged"]
    return {
        "size": f"{record['width']} x {record['height']}",
        "blur": "unknown" if blur is None else f"{blur}, {record['blur_px']:.2f} px",
        "noise": "unknown" if record["noise"] is None else f"{record['noise']:.1f} levels",
        "JPEG quality": "not visible" if quality is None else f"{quality}",
        "enlarged": "no" if factor == 1 else f"x{factor}",
    }


def learned_words(record: LearnedRecord) -> dict[str, str]:
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


def facts_of_diagnosis(photos: Iterable[PhotoDiagnosis]) -> dict[str, dict[str, str]]:
    """What photos were found to suffer from, by their names."""
    return {found.name: photo_words(photo_record(found)) for found in photos}


def facts_of_photos(report: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """What a report says of each photo, by its name: faults, what was learned, how well it is rendered.

    Reports of older runs say less.
    """
    found: dict[str, dict[str, str]] = {}
    for record in report.get("photos", []):
        found.setdefault(record["name"], {}).update(photo_words(record))
    for record in report.get("learned", []):
        found.setdefault(record["name"], {}).update(learned_words(record))
    for name, px in ((report.get("sfm") or {}).get("sure_px") or {}).items():
        found.setdefault(name, {})["pose sure to"] = f"{px:.2f} px"
    for view in report["metrics"]["views"]:
        values = {name.upper(): view.get(name) for name in ("psnr", "ssim", "haarpsi")}
        told = {name: f"{value:.3f}" for name, value in values.items() if value is not None}
        found.setdefault(view["name"], {}).update(told)
    return found
