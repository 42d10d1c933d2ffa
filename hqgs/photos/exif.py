"""What cameras write beside the pixels: how a photo was held, by which camera, how far it was zoomed."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hqgs.photos.files import DECODE_ERRORS, open_photo

_ORIENTATION, _MAKE, _MODEL, _MORE = 274, 271, 272, 0x8769  # tags; the last one is a table of its own:
_FOCAL, _FOCAL_35MM, _WIDTH, _HEIGHT = 37386, 41989, 40962, 40963
_X_RESOLUTION, _RESOLUTION_UNIT = 41486, 41488
_XMP = ("xmp", "XML:com.adobe.xmp")  # what Pillow calls it in JPEG, WebP and HEIC, and in PNG
_PANORAMA = re.compile(  # attributes, or elements
    rb"GPano:(ProjectionType|(?:FullPano|CroppedAreaImage)(?:Width|Height)Pixels)\s*(?:=\s*[\"']|>)\s*(\w+)"
)
_GPS = 0x8825  # another such table, with these:
_NORTH_OR_SOUTH, _LATITUDE, _EAST_OR_WEST, _LONGITUDE, _BELOW_SEA, _ALTITUDE = range(1, 7)
_MM = {2: 25.4, 3: 10.0}  # of the units that resolutions come in
_DIAGONAL = math.hypot(36, 24)  # mm, of 35 mm film
_DRONE = re.compile(
    rb'drone-dji:(RelativeAltitude|GimbalPitchDegree|GimbalRollDegree)(?:="|>)\s*([+-]?\d+\.?\d*)'
)
_LEVEL = 5.0  # degrees of roll that a gimbal may leave
_SHORTEST, _LONGEST = 0.2, 20.0  # focal length in longer sides; what lies beyond is a mistake


@dataclass(frozen=True)
class Exif:
    """Of a photo. What nothing is known of is 0, or empty."""

    orientation: int = 1  # how the stored pixels are to be shown: 1..8, as they are, mirrored, turned
    camera: tuple[str, ...] = ()  # make, model and focal length: photos with the same ones share a camera
    focal: float = 0.0  # px of the stored photo
    gps: tuple[float, float, float] | None = None  # degrees north and east, m up; nan: no altitude
    panorama: bool | None = None  # of the whole sphere, equirectangular, or not: by its XMP data (GPano)
    above: float = math.nan  # m above where a drone took off, by its barometer
    pitch: float | None = None  # degrees above level that its gimbal held the camera, upright

    @property
    def quarter_turns(self) -> int:
        """Clockwise, that show the stored pixels upright, mirrored or not: 0..3."""
        return (0, 0, 2, 2, 1, 1, 3, 3)[self.orientation - 1]


def read_exif(path: Path) -> Exif:
    """The EXIF data of a photo; nothing where there is none, or where it is damaged."""
    try:
        with open_photo(path) as photo:
            width, height = photo.size
            found = photo.getexif()
            more = found.get_ifd(_MORE)
            gps = _position(found.get_ifd(_GPS))
            xmp = next((photo.info[key] for key in _XMP if key in photo.info), b"")
    except DECODE_ERRORS:
        return Exif()
    orientation = found.get(_ORIENTATION, 1)
    orientation = orientation if orientation in range(1, 9) else 1
    focal = _focal(more, width, height)
    if not _SHORTEST < focal / max(width, height) < _LONGEST:
        focal = 0.0
    names = tuple(str(found.get(tag, "")).strip("\0 ") for tag in (_MAKE, _MODEL))
    lens = f"{_number(more, _FOCAL):g} {_number(more, _FOCAL_35MM):g}"
    known = any(names) or focal > 0
    xmp = xmp.encode(errors="replace") if isinstance(xmp, str) else bytes(xmp)
    named = (*names, lens) if known else ()
    return Exif(orientation, named, focal, gps, _around(xmp), *_of_drone(xmp))


def _focal(more: dict[int, Any], width: int, height: int) -> float:
    """In px; 0 where it is not told."""
    if (equivalent := _number(more, _FOCAL_35MM)) > 0:
        return equivalent / _DIAGONAL * math.hypot(width, height)
    # The sensor's longer side, if the photo was shrunk, or turned, since.
    stored = max(_number(more, _WIDTH), _number(more, _HEIGHT)) or max(width, height)
    per_mm = _number(more, _X_RESOLUTION) / _MM.get(int(_number(more, _RESOLUTION_UNIT)), 25.4)
    return _number(more, _FOCAL) * per_mm * max(width, height) / stored


def _position(tags: dict[int, Any]) -> tuple[float, float, float] | None:
    """Where a photo was taken; None where it is not told, or 0, 0, which phones write without a fix."""
    north = _degrees(tags.get(_LATITUDE), tags.get(_NORTH_OR_SOUTH), "S")
    east = _degrees(tags.get(_LONGITUDE), tags.get(_EAST_OR_WEST), "W")
    if not (abs(north) <= 90 and abs(east) <= 180) or (north, east) == (0, 0):
        return None
    try:
        up = float(tags[_ALTITUDE])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        up = math.nan
    if tags.get(_BELOW_SEA) in (b"\1", 1):
        up = -up
    return north, east, up if math.isfinite(up) else math.nan


def _around(xmp: bytes) -> bool | None:
    """Whether a photo is said to show the whole sphere; None where it is not said to be a panorama."""
    told = {name.decode(): value.decode().lower() for name, value in _PANORAMA.findall(xmp)}
    if (kind := told.get("ProjectionType", "rectilinear")) == "rectilinear":
        return None
    sides = (
        (told.get(f"FullPano{side}Pixels"), told.get(f"CroppedAreaImage{side}Pixels"))
        for side in ("Width", "Height")
    )
    return kind == "equirectangular" and all(None in (full, part) or full == part for full, part in sides)


def _of_drone(xmp: bytes) -> tuple[float, float | None]:
    """Metres above the start, nan, and the camera's pitch, None, of the XMP that DJI's drones write.

    The gimbal holds cameras upright: one that does not (a roll) is not believed.
    """
    values = {name.decode(): float(value) for name, value in _DRONE.findall(xmp)}
    pitch, roll = values.get("GimbalPitchDegree"), values.get("GimbalRollDegree", 0.0)
    upright = pitch is not None and abs(pitch) <= 90 and abs(roll) <= _LEVEL
    return values.get("RelativeAltitude", math.nan), pitch if upright else None


def _degrees(parts: Any, side: Any, negative: str) -> float:
    """Degrees, minutes and seconds as one number; nan where they are none."""
    try:
        degrees, minutes, seconds = (float(part) for part in parts)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
    value = degrees + minutes / 60 + seconds / 3600
    return -value if str(side).strip("\0 ").upper() == negative else value


def _number(tags: dict[int, Any], tag: int) -> float:
    """A tag's value; 0 where it is missing, no number or not finite."""
    try:
        value = float(tags.get(tag, 0))
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return value if math.isfinite(value) and value > 0 else 0.0
