"""Structure of COLMAP's binary files, checked before the reader allocates what their headers promise.

Layout: COLMAP's documentation, "Output Format", little endian. Each list starts with a 64-bit count. The
reader trusts counts and does not notice the end of a file, so a short or hostile file could fill the memory.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable
from pathlib import Path
from struct import Struct

_U32, _U64 = Struct("<I"), Struct("<Q")
_IMAGE_HEAD = 4 + 7 * 8 + 4  # id, quaternion and translation, camera id; then the name and the 2D points
_POINT_HEAD = 8 + 3 * 8 + 3 + 8  # id, xyz, rgb, error; then the track
_SMALLEST_CAMERA = 4 + 4 + 8 + 8 + 2 * 8  # id, model, width, height, and at least two parameters
_SENSOR = 8  # type and id
_POSE = 7 * 8


class _CutOffError(Exception):
    """The walk ran over the end of the file."""


def _read(unpack: Struct, data: mmap.mmap, at: int) -> int:
    if at + unpack.size > len(data):
        raise _CutOffError
    return unpack.unpack_from(data, at)[0]


def _skip_image(data: mmap.mmap, at: int) -> int:
    name_end = data.find(b"\0", at + _IMAGE_HEAD)
    if name_end < 0:
        raise _CutOffError
    at = name_end + 1
    return at + 8 + 24 * _read(_U64, data, at)


def _skip_rig(data: mmap.mmap, at: int) -> int:
    sensors = _read(_U32, data, at + 4)
    at += 8 + (_SENSOR if sensors else 0)
    if sensors * _SENSOR > len(data):
        raise _CutOffError
    for _ in range(1, sensors):
        has_pose = _read(Struct("<B"), data, at + _SENSOR)
        at += _SENSOR + 1 + (_POSE if has_pose else 0)
    return at


_RECORDS: dict[str, tuple[Callable[[mmap.mmap, int], int], int]] = {  # how to skip one, its smallest size
    "images.bin": (_skip_image, _IMAGE_HEAD + 1 + 8),
    "points3D.bin": (
        lambda data, at: at + _POINT_HEAD + 8 + 8 * _read(_U64, data, at + _POINT_HEAD),
        _POINT_HEAD + 8,
    ),
    "rigs.bin": (_skip_rig, 8),
    "frames.bin": (
        lambda data, at: at + 8 + _POSE + 4 + (_SENSOR + 8) * _read(_U32, data, at + 8 + _POSE),
        8 + _POSE + 4,
    ),
}


def check_binary_model(folder: Path) -> None:
    """Raise ValueError when a binary file of the model is not exactly as long as its own counts say.

    `cameras.bin` is checked for its count only: the length of a record depends on the camera model, see
    `cameras_file_size`.
    """
    _check_count(folder / "cameras.bin", _SMALLEST_CAMERA)
    for name, (skip, smallest) in _RECORDS.items():
        path = folder / name
        if not path.exists():
            continue
        count = _check_count(path, smallest)
        with path.open("rb") as f, mmap.mmap(f.fileno(), 0, access=mmap.ACCESS_READ) as data:
            at = 8
            try:
                for _ in range(count):
                    at = skip(data, at)
                    if at > len(data):
                        raise _CutOffError
            except _CutOffError:
                at = len(data) + 1
            if at != len(data):
                problem = "ends inside a record" if at > len(data) else f"goes on after its {count} records"
                raise ValueError(f"{path} is damaged: it {problem} ({len(data)} bytes)")


def image_names(path: Path) -> dict[int, str]:
    """The photos' names in a whole images.bin by their ids; bytes that are no UTF-8 are escaped."""
    names, at = dict[int, str](), 8
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for _ in range(_read(_U64, data, 0)):
            start = at + _IMAGE_HEAD
            name = data[start : data.find(b"\0", start)]
            names[_read(_U32, data, at)] = name.decode("utf-8", "surrogateescape")
            at = _skip_image(data, at)
    return names


def cameras_file_size(param_counts: list[int]) -> int:
    """Bytes of a cameras.bin whose cameras have these numbers of parameters."""
    return 8 + sum(24 + 8 * n for n in param_counts)


def _check_count(path: Path, smallest: int) -> int:
    size = path.stat().st_size
    with path.open("rb") as f:
        head = f.read(8)
    count = _U64.unpack(head)[0] if len(head) == 8 else -1
    if count < 0 or count * smallest > size - 8:
        promise = f"its header promises {count} records" if count >= 0 else "it has no header"
        raise ValueError(f"{path} is damaged: {promise}, the file has {size} bytes")
    return count
