"""What an MP4 film says of its sphere: Google's spherical video metadata, version 1 (XML) and 2 (boxes)."""

from __future__ import annotations

import re
from pathlib import Path

_TOP = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"uuid", b"moof")
_LARGEST = 64 * 2**20  # bytes of the box that is looked at: longer films keep a table of frames there
_SIDES = (b"WidthPixels", b"HeightPixels")
_XML = re.compile(
    rb"<GSpherical:(ProjectionType|StereoMode|(?:FullPano|CroppedAreaImage)(?:Width|Height)Pixels)>"
    rb"\s*([a-z\d-]+)\s*</"
)
_PROJECTIONS = {b"equi": "equirectangular", b"cbmp": "cubemap", b"mshp": "mesh"}
_PART = "a part of the sphere"
_STEREO = {1: "top-bottom", 2: "left-right"}


def projection(path: Path) -> tuple[str, str] | None:
    """Projection ("equirectangular", "cubemap", "mesh", or that frames show a part of the sphere) and stereo
    mode ("mono", "top-bottom", "left-right").

    None where the film says nothing, or is no MP4. OSError where it cannot be read.
    """
    box = _moov(path)
    told = dict(_XML.findall(box))
    if b"ProjectionType" in told:
        sides = ((told.get(b"FullPano" + side), told.get(b"CroppedAreaImage" + side)) for side in _SIDES)
        cut = any(None not in side and side[0] != side[1] for side in sides)
        return _PART if cut else told[b"ProjectionType"].decode(), told.get(b"StereoMode", b"mono").decode()
    at = box.find(b"sv3d")
    if at < 0:
        return None
    kinds = [name for kind, name in _PROJECTIONS.items() if kind in box[at : at + 256]]
    if not kinds:
        return None
    bounds = box.find(b"equi", at) + 8  # after version and flags
    if kinds[0] == "equirectangular" and any(box[bounds : bounds + 16]):
        kinds = [_PART]
    stereo = box.find(b"st3d")
    mode = box[stereo + 8] if 0 <= stereo < len(box) - 8 else 0  # after version and flags
    return kinds[0], _STEREO.get(mode, "mono")


def _moov(path: Path) -> bytes:
    """The box that describes the film; empty where there is none."""
    end = path.stat().st_size
    with path.open("rb") as file:
        while file.tell() + 8 <= end:
            start, head = file.tell(), file.read(8)
            size, kind = int.from_bytes(head[:4], "big"), head[4:]
            if kind not in _TOP:
                return b""
            if size == 1:
                size = int.from_bytes(file.read(8), "big")
            size = size or end - start
            if kind == b"moov":
                file.seek(start)
                return file.read(min(size, _LARGEST))
            if size < 8:
                return b""
            file.seek(start + size)
    return b""
