"""COLMAP's binary files read and written piece by piece, for models that do not fit into memory.

Layout: COLMAP's documentation, "Output Format", little endian. Nothing is taken on trust: a count that the
file cannot hold ends with a ValueError before memory is asked for.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from struct import Struct
from typing import Any, BinaryIO

import numpy as np
import pycolmap
from numpy.typing import NDArray

_COUNT, _CAMERA, _IMAGE = Struct("<Q"), Struct("<IiQQ"), Struct("<I7dI")
PIECE = 8 << 20  # bytes of points read at a time
POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)  # then, for each photo that shows it, two u32: the photo's id and the number of its pixel
PIXEL = np.dtype([("xy", "<f8", 2), ("point", "<i8")])  # of a photo; -1: no point is known there
_LENGTH_AT = POINT.itemsize - _COUNT.size
MAX_NAME = 4096  # bytes


@dataclass(frozen=True)
class Points:
    """Some points with their tracks."""

    heads: NDArray[np.void]  # [n] of POINT
    track: NDArray[np.uint32]  # [T, 2], all their tracks one after the other: photo id, number of the pixel

    @property
    def owner(self) -> NDArray[np.intp]:
        """The row in `heads` of each of `track`, [T]."""
        return np.repeat(np.arange(len(self.heads)), self.heads["length"].astype(np.intp))


@dataclass(frozen=True)
class StoredImage:
    """A photo of the model, as it is stored."""

    image_id: int
    name: str
    camera_id: int
    quat: NDArray[np.float64]  # [4], w x y z, world to camera
    shift: NDArray[np.float64]  # [3]
    pixels: NDArray[np.void]  # [n] of PIXEL


def stored_count(path: Path) -> int:
    """The number of records that a file of a model promises. ValueError where it has no header."""
    with path.open("rb") as file:
        return _count(file, path)


def read_cameras(path: Path) -> dict[int, pycolmap.Camera]:
    """Cameras by id. ValueError for a damaged file."""
    cameras = {}
    with path.open("rb") as file:
        for _ in range(_count(file, path)):
            number, model, width, height = _CAMERA.unpack(_take(file, _CAMERA.size, path))
            try:
                name = pycolmap.CameraModelId(model).name
                camera = pycolmap.Camera.create_from_model_name(number, name, 1.0, 1, 1)
            except (ValueError, IndexError, RuntimeError) as error:
                raise ValueError(f"{path} is damaged: there is no camera model {model}") from error
            count = len(camera.params)
            camera.width, camera.height = width, height
            camera.params = np.frombuffer(_take(file, 8 * count, path), "<f8").tolist()
            cameras[number] = camera
        _check_end(file, path)
    return cameras


def write_cameras(path: Path, cameras: dict[int, pycolmap.Camera]) -> None:
    """Write cameras by id."""
    with path.open("wb") as file:
        file.write(_COUNT.pack(len(cameras)))
        for number, camera in cameras.items():
            file.write(_CAMERA.pack(number, int(camera.model.value), camera.width, camera.height))
            file.write(np.asarray(camera.params, "<f8").tobytes())


def read_images(path: Path) -> Iterator[StoredImage]:
    """The photos in the file's order. ValueError for a damaged file."""
    with path.open("rb") as file:
        for _ in range(_count(file, path)):
            number, *pose, camera_id = _IMAGE.unpack(_take(file, _IMAGE.size, path))
            name = bytearray()
            while (letter := _take(file, 1, path)) != b"\0":
                name += letter
                if len(name) > MAX_NAME:
                    raise ValueError(f"{path} is damaged: a photo's name does not end")
            try:
                text = name.decode()
            except UnicodeDecodeError as error:
                raise ValueError(f"{path}: a photo name is not UTF-8: {error}") from error
            count = _COUNT.unpack(_take(file, _COUNT.size, path))[0]
            pixels = np.frombuffer(_take(file, PIXEL.itemsize * count, path), PIXEL)
            yield StoredImage(number, text, camera_id, np.array(pose[:4]), np.array(pose[4:]), pixels)
        _check_end(file, path)


def write_image(file: BinaryIO, image: StoredImage, points: NDArray[np.int64]) -> None:
    """Append a photo whose pixels show these points, [n], -1 for none."""
    file.write(_IMAGE.pack(image.image_id, *image.quat, *image.shift, image.camera_id))
    file.write(image.name.encode() + b"\0" + _COUNT.pack(len(points)))
    pixels = image.pixels.copy()
    pixels["point"] = points
    file.write(pixels.tobytes())


def read_points(path: Path) -> Iterator[Points]:
    """The points in the file's order, PIECE bytes at a time. ValueError for a damaged file."""
    size = path.stat().st_size
    with path.open("rb", buffering=0) as file:
        left, rest = _count(file, path), b""
        if left * POINT.itemsize > size:
            raise ValueError(f"{path} is damaged: its header promises {left} points, it has {size} bytes")
        wanted = PIECE
        while left:
            data = rest + file.read(wanted)
            if len(data) == len(rest):
                raise ValueError(f"{path} is damaged: it ends {left} points too early")
            starts, at = _starts(data, left)
            if starts:
                yield _points(data, np.array(starts))
            # One track may be longer than a piece, but not than the file.
            wanted = PIECE if starts else min(2 * wanted, size)
            left, rest = left - len(starts), data[at:]
        if rest or file.read(1):
            raise ValueError(f"{path} is damaged: it goes on after its last point")


def write_points(file: BinaryIO, points: Points) -> None:
    """Append points."""
    lengths = points.heads["length"].astype(np.intp)
    ends = np.cumsum(POINT.itemsize + 8 * lengths)
    starts = ends - POINT.itemsize - 8 * lengths
    data = np.empty(ends[-1] if len(ends) else 0, np.uint8)
    data[starts[:, None] + np.arange(POINT.itemsize)] = _bytes(points.heads)
    data[_track_starts(starts, lengths)[:, None] + np.arange(8)] = _bytes(points.track)
    file.write(data.data)


def put_count(file: BinaryIO, count: int) -> None:
    """Write the number of records at the start of a file and flush it to disk."""
    file.seek(0)
    file.write(_COUNT.pack(count))
    file.flush()
    os.fsync(file.fileno())


def _starts(data: bytes, most: int) -> tuple[list[int], int]:
    """Where the whole records in a piece begin, at most so many, and where the last of them ends."""
    starts, at, end, unpack = list[int](), 0, len(data), _COUNT.unpack_from
    head = POINT.itemsize
    while at + head <= end and len(starts) < most:
        after = at + head + 8 * unpack(data, at + _LENGTH_AT)[0]
        if after > end:
            break
        starts.append(at)
        at = after
    return starts, at


def _points(data: bytes, starts: NDArray[np.intp]) -> Points:
    raw = np.frombuffer(data, np.uint8)
    heads = raw[starts[:, None] + np.arange(POINT.itemsize)].view(POINT)[:, 0]
    at = _track_starts(starts, heads["length"].astype(np.intp))
    return Points(heads, raw[at[:, None] + np.arange(8)].view("<u4"))


def _track_starts(starts: NDArray[np.intp], lengths: NDArray[np.intp]) -> NDArray[np.intp]:
    """Where each 8 bytes of the tracks of records begin."""
    before = np.cumsum(lengths) - lengths
    return np.repeat(starts + POINT.itemsize - 8 * before, lengths) + 8 * np.arange(lengths.sum())


def _bytes(rows: NDArray[Any]) -> NDArray[np.uint8]:
    """Records or rows as bytes, [n, bytes of one]."""
    rows = np.ascontiguousarray(rows)
    size = rows.dtype.itemsize * (rows.shape[1] if rows.ndim == 2 else 1)
    return rows.view(np.uint8).reshape(len(rows), size)


def _take(file: BinaryIO, size: int, path: Path) -> bytes:
    """So many bytes; a promise that the file cannot keep is refused before they are asked for."""
    left = path.stat().st_size - file.tell() if size > PIECE else size
    data = file.read(size) if size <= left else b""
    if len(data) < size:
        raise ValueError(f"{path} is damaged: it ends inside a record")
    return data


def _count(file: BinaryIO, path: Path) -> int:
    return int(_COUNT.unpack(_take(file, _COUNT.size, path))[0])


def _check_end(file: BinaryIO, path: Path) -> None:
    if file.read(1):
        raise ValueError(f"{path} is damaged: it goes on after its last record")
