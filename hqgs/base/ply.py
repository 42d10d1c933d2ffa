"""The header and the elements of a PLY file, whatever they are."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError

MAX_HEADER_BYTES = 1 << 16
_END = re.compile(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r|\Z)")  # a line: a comment may have the word, too
_TYPES = {1: "char uchar int8 uint8", 2: "short ushort int16 uint16", 8: "double float64"}
_TYPES[4] = "int uint int32 uint32 float float32"
SIZES = {name: size for size, names in _TYPES.items() for name in names.split()}  # bytes of a value


@dataclass(frozen=True)
class Header:
    """The lines of a PLY file before its data."""

    lines: list[str]
    size: int  # bytes, to where the data begins
    ascii: bool

    @property
    def comments(self) -> list[str]:
        """What the lines say that begin with `comment` or `obj_info`."""
        words = (line.split(None, 1) for line in self.lines)
        return [text[1].strip() for text in words if len(text) > 1 and text[0] in ("comment", "obj_info")]


def header_of(path: Path) -> Header:
    """The header of a PLY file. ValueError, which names the file, where it has none that ends."""
    with path.open("rb") as f:
        head = f.read(MAX_HEADER_BYTES)
    end = _END.search(head)
    if not head.startswith(b"ply") or end is None:
        raise ValueError(f"{path}: not a PLY file (no end of a header within {MAX_HEADER_BYTES} bytes)")
    return Header(head[: end.start()].decode("latin-1").splitlines(), end.end(), head[: end.end()].isascii())


def read_vertices(path: str | Path) -> NDArray[np.void]:
    """The element `vertex` as a structured array [N], a field for each property; others are passed by.

    The file may be text or binary of either byte order. A header that promises more than the file holds is
    refused before anything of that size is allocated.

    Raises FileNotFoundError, or ValueError that names the file.
    """
    elements = read_elements(path)
    if "vertex" not in elements:
        raise ValueError(f"{path}: a PLY file without the element vertex")
    return elements["vertex"]


def read_elements(path: str | Path) -> dict[str, NDArray[np.void]]:
    """All elements by name; see `read_vertices`."""
    path = Path(path)
    header = header_of(path)
    promised = rows = most = 0
    for line in header.lines:
        words = line.split()
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > 18:
                raise ValueError(f"{path}: not a readable PLY file: its header has the line {line[:80]!r}")
            rows = int(words[2])
            most = max(most, rows)
        elif words[:1] == ["property"]:
            promised += rows  # a value takes at least one byte in every PLY format
    if max(promised, most) > (size := path.stat().st_size):
        raise ValueError(
            f"{path}: the header promises {max(promised, most)} values, the file has {size} bytes"
        )
    try:
        if header.ascii:
            ply = PlyData.read(str(path))
        else:
            with _Plain(path, header.size) as stream:
                ply = PlyData.read(stream)
    except (PlyParseError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise ValueError(f"{path}: not a readable PLY file: {error}") from error
    return {element.name: element.data for element in ply.elements}


def read_points(
    path: Path,
) -> tuple[np.ndarray[Any, np.dtype[np.float64]], np.ndarray[Any, np.dtype[np.uint8]]]:
    """Points [P, 3] and colours [P, 3] of the PLY's `vertex` element; grey where it has no red, green, blue.

    Raises ValueError that names the file.
    """
    vertex = read_vertices(path)
    try:
        points = np.stack([vertex[k].astype(np.float64) for k in ("x", "y", "z")], -1)
        colors = np.full((len(points), 3), 128, np.uint8)
        if {"red", "green", "blue"} <= set(vertex.dtype.names or ()):
            colors = np.stack([vertex[k] for k in ("red", "green", "blue")], -1)
            if colors.dtype.kind == "f":
                colors = np.rint(np.nan_to_num(colors) * 255)
            colors = colors.clip(0, 255).astype(np.uint8)
    except (ValueError, KeyError, TypeError, OverflowError) as e:
        raise ValueError(f"cannot read the points in {path}: {e}") from e
    return points, colors


class _Plain(io.BufferedReader):
    """A PLY file whose header reads as ASCII, which plyfile wants: a comment may be a name in any letters."""

    def __init__(self, path: Path, head: int) -> None:
        super().__init__(io.FileIO(path))
        self._head = head  # bytes

    def read(self, size: int | None = -1, /) -> bytes:
        rest = max(0, self._head - self.tell())
        found = super().read(size)
        return found[:rest].decode("latin-1").encode("ascii", "replace") + found[rest:]


def bytes_after(path: Path, header: Header) -> int:
    """How many bytes follow the last element; 0 where text or lists hide that."""
    rows = size = 0
    for words in (line.split() for line in header.lines):
        if words[:1] == ["element"]:
            rows = int(words[2])
        elif words[:1] == ["property"]:
            if words[1] not in SIZES:
                return 0
            size += rows * SIZES[words[1]]
    text = any(line.startswith("format ascii") for line in header.lines)
    return 0 if text else max(0, path.stat().st_size - header.size - size)
