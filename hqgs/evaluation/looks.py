"""What a run has learned of how the photos look, and its cameras' photos in the mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hqgs.base.files import REPORT
from hqgs.evaluation.records import LearnedRecord, read_report
from hqgs.evaluation.run_folder import RunFolder
from hqgs.photos.look import Look
from hqgs.scene.scene import View


def looks_of_devices(views: Sequence[View], looks: Mapping[str, Look]) -> dict[str, Look]:
    """By camera (`View.device`), in the mean over its photos, of what was learned of training photos; empty
    where nothing changes a picture. `looks`: by the photos' names."""
    photos: dict[str, list[Look]] = {}
    for view in views:
        if view.device and not view.face and view.name in looks:
            photos.setdefault(view.device, []).append(looks[view.name])
    found = {
        device: Look(
            np.exp(np.mean([np.log(look.gains) for look in own], 0)), own[0].vignetting, own[0].response
        )
        for device, own in photos.items()
    }
    return found if any(look.changes for look in found.values()) else {}


def looks_beside(file: Path, views: Sequence[View]) -> dict[str, Look]:
    """Those of `looks_of_devices` of the run that a scene file lies in; `views`: its training photos."""
    report = RunFolder.open(file).report
    return {} if report is None else looks_of_devices(views, _looks(report.get("learned", [])))


def _looks(learned: Sequence[LearnedRecord]) -> dict[str, Look]:
    return {
        record["name"]: Look(
            np.array(record["gains"], np.float64),
            np.array(record.get("vignetting", np.zeros(2)), np.float64),
            np.array(record.get("response", np.zeros((2, 3))), np.float64),
        )
        for record in learned
    }


def look_of(folder: Path, name: str) -> Look:
    """Of the photo of this name, with its suffix or without, as the run in a folder has learned it.

    Raises:
        FileNotFoundError: the folder has no report.
        ValueError: it is damaged, nothing was learned of the photos' looks, or there is no such photo.
    """
    looks = _looks(read_report(folder / REPORT).get("learned", []))
    if not any(one.changes for one in looks.values()):
        raise ValueError(
            f"{folder}: no exposure, vignetting or response was learned, so all photos are rendered alike"
        )
    stems = {Path(photo).stem: look for photo, look in looks.items()}
    if (found := looks.get(name, stems.get(name))) is None:
        some = ", ".join([*looks][:3])
        raise ValueError(f"no exposure of a photo {name!r} was learned; there are: {some}, ...")
    return found
