"""What a run has learned of the photos' cameras: the looks of photos and of cameras, and a picture of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from hqgs.base.evenly import evenly
from hqgs.base.files import REPORT
from hqgs.evaluation.constants import AMPLIFICATION, SHEET_PHOTOS, TILE_SIDE
from hqgs.evaluation.records import LearnedRecord, read_report
from hqgs.evaluation.run_folder import RunFolder
from hqgs.photos.look import Look
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.photos.sheet import tiled
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
            f"{folder}: no gains, vignetting or response of photos were learned: the photos look alike"
        )
    stems = {Path(photo).stem: look for photo, look in looks.items()}
    if (found := looks.get(name, stems.get(name))) is None:
        some = ", ".join([*looks][:3])
        raise ValueError(f"no look of a photo {name!r} was learned; there are: {some}, ...")
    return found


def learned_picture(
    photos: Sequence[NDArray[np.uint8] | NDArray[np.float32]], learned: Sequence[LearnedRecord]
) -> Image.Image:
    """Up to 12 photos [H, W, 3], the least sharp one first, each with its camera's trajectory and largest
    disc out of focus (four times as large) in its middle and its gain in the caption.
    """
    order = sorted(range(len(learned)), key=lambda k: -learned[k]["shake_px"] - 2 * learned[k]["defocus_px"])
    chosen = [order[k] for k in evenly(len(order), SHEET_PHOTOS)]
    return tiled([_tile(photos[k], learned[k]) for k in chosen])


def _tile(photo: NDArray[np.uint8] | NDArray[np.float32], record: LearnedRecord) -> Image.Image:
    picture, caption = Image.fromarray(to_uint8(as_floats(photo))), 18  # px
    scale = TILE_SIDE / max(picture.size)
    picture = picture.resize((max(round(picture.width * scale), 1), max(round(picture.height * scale), 1)))
    tile = Image.new("RGB", (picture.width, picture.height + caption), "white")
    tile.paste(picture, (0, caption))
    draw = ImageDraw.Draw(tile)
    stops = float(np.log2(record["gains"]).mean())
    facts = [f"{record['shake_px']:.1f} px" if record["shake_px"] else "still"]
    facts += [f"focus {record['defocus_px']:.1f} px"] if record["defocus_px"] else []
    facts += [f"{stops:+.2f} stops"] if np.ptp(record["gains"]) or stops else []
    draw.text((2, 3), f"{Path(record['name']).stem[-16:]}  {', '.join(facts)}", fill=(25, 25, 25))
    middle = np.array([picture.width / 2, caption + picture.height / 2])
    scale *= AMPLIFICATION
    trajectory = [tuple(middle + scale * np.array(point)) for point in record["trajectory_px"]]
    if record["defocus_px"]:
        radius = scale * record["defocus_px"]
        for width, color in ((3, (0, 0, 0)), (1, (255, 210, 0))):
            draw.circle(tuple(middle), radius, outline=color, width=width)
    if record["shake_px"]:
        draw.line(trajectory, fill=(0, 0, 0), width=5, joint="curve")
        draw.line(trajectory, fill=(255, 210, 0), width=3, joint="curve")
    return tile
