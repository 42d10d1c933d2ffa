"""The vertices of a PLY file, whatever they are."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyParseError

MAX_HEADER_BYTES = 1 << 16
_TYPES = {1: "char uchar int8 uint8", 2: "short ushort int16 uint16", 8: "double float64"}
_TYPES[4] = "int uint int32 uint32 float float32"
SIZES = {name: size for size, names in _TYPES.items() for name in names.split()}  # bytes of a value


def read_vertices(path: str | Path) -> np.ndarray[Any, np.dtype[np.void]]:
    """The element `vertex` as a structured array [N], a field for each property; others are passed by.

    The file may be text or binary of either byte order. A header that promises more than the file holds is
    refused before anything of that size is allocated.

    Raises FileNotFoundError, or ValueError that names the file.
    """
    elements = read_elements(path)
    if "vertex" not in elements:
        raise ValueError(f"{path}: a PLY file without the element vertex")
    return elements["vertex"]


def read_elements(path: str | Path) -> dict[str, np.ndarray[Any, np.dtype[np.void]]]:
    """All elements by name; see `read_vertices`."""
    path = Path(path)
    head = _check_header(path)
    try:
        if head.isascii():
            ply = PlyData.read(str(path))
        else:
            with _Plain(path, len(head)) as stream:
                ply = PlyData.read(stream)
    except (PlyParseError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise ValueError(f"{path}: not a readable PLY file: {error}") from error
    return {element.name: element.data for element in ply.elements}


class _Plain(io.BufferedReader):
    """A PLY file whose header reads as ASCII, which plyfile wants: a comment may be a name in any letters."""

    def __init__(self, path: Path, head: int) -> None:
        super().__init__(io.FileIO(path))
        self._head = head  # bytes

    def read(self, size: int | None = -1, /) -> bytes:
        rest = max(0, self._head - self.tell())
        found = super().read(size)
        return found[:rest].decode("latin-1").encode("ascii", "replace") + found[rest:]


def _check_header(path: Path) -> bytes:
    """The header, of a file that can hold what that promises. ValueError that names the file."""
    with path.open("rb") as f:
        head = f.read(MAX_HEADER_BYTES)
    size = path.stat().st_size
    end = head.find(b"end_header")
    if not head.startswith(b"ply") or end < 0:
        raise ValueError(f"{path}: not a PLY file (no header that ends within {MAX_HEADER_BYTES} bytes)")
    promised = rows = most = 0
    for line in head[:end].splitlines():
        words = line.split()
        if words[:1] == [b"element"]:
            if len(words) != 3 or not words[2].isdigit() or len(words[2]) > 18:
                raise ValueError(f"{path}: not a readable PLY file: its header has the line {line[:80]!r}")
            rows = int(words[2])
            most = max(most, rows)
        elif words[:1] == [b"property"]:
            promised += rows  # a value takes at least one byte in every PLY format
    if max(promised, most) > size:
        raise ValueError(
            f"{path}: the header promises {max(promised, most)} values, the file has {size} bytes"
        )
    last = re.search(rb"[\r\n]end_header", head)  # a comment may have the word, too
    return head[: last.end()] if last else b""


def header_of(path: Path) -> tuple[list[str], int]:
    """The comments of a PLY file, and how many bytes follow its last element; 0 where lists hide that."""
    with path.open("rb") as f:
        head = f.read(MAX_HEADER_BYTES)
    end = head.find(b"\n", head.find(b"end_header")) + 1
    lines = head[:end].decode("latin-1").splitlines()
    comments = [line.removeprefix("comment ") for line in lines if line.startswith("comment ")]
    rows = size = 0
    for words in (line.split() for line in lines):
        if words[:1] == ["element"]:
            rows = int(words[2])
        elif words[:1] == ["property"]:
            if words[1] not in SIZES:
                return comments, 0
            size += rows * SIZES[words[1]]
    text = any(line.startswith("format ascii") for line in lines)
    return comments, 0 if text else max(0, path.stat().st_size - end - size)
