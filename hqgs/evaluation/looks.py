"""The look of a photo, as the report of a run keeps it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hqgs.evaluation.report import REPORT, read_report
from hqgs.photos.look import Look


def look_of(folder: Path, name: str) -> Look:
    """Of the photo of this name, with its suffix or without, as the run in a folder has learned it.

    Raises:
        FileNotFoundError: the folder has no report.
        ValueError: it is damaged, nothing was learned of the photos' looks, or there is no such photo.
    """
    looks = {
        record["name"]: Look(
            np.array(record["gains"], np.float64),
            np.array(record.get("vignetting", np.zeros(2)), np.float64),
            np.array(record.get("response", np.zeros((2, 3))), np.float64),
        )
        for record in read_report(folder / REPORT)["learned"]
    }
    if not any(
        (one.gains != 1).any() or one.vignetting.any() or one.response.any() for one in looks.values()
    ):
        raise ValueError(
            f"{folder}: no gains, vignetting or response of photos were learned: the photos look alike"
        )
    stems = {Path(photo).stem: look for photo, look in looks.items()}
    if (found := looks.get(name, stems.get(name))) is None:
        some = ", ".join([*looks][:3])
        raise ValueError(f"no look of a photo {name!r} was learned; there are: {some}, ...")
    return found
