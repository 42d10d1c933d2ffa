"""The two containers of SPZ files, around the same arrays of bytes.

Versions 2 and 3: one gzip stream of a 16-byte header and the arrays. Version 4: a 32-byte header, a table
with the packed and the unpacked size of each array that is not empty, and a zstd frame for each.
"""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

VERSIONS = (3, 4)  # that are written; 2 is read too
MAGIC = 0x5053474E  # "NGSP"
ANTIALIASED, EXTENDED = 0x1, 0x2  # flags
MOST_DEGREE = 4  # of the harmonics that a file may hold
HEADER = struct.Struct("<IIIBBBB")  # magic, version, Gaussians, SH degree, fractional bits, flags, 0
HEADER_4 = struct.Struct("<IIIBBBBI12s")  # up to the flags the same; arrays, where the table begins, zeros
ENTRY = struct.Struct("<QQ")  # of the table
MAX_GAUSSIANS = 10_000_000  # Niantic's reader takes no more
MAX_FRACTION = 23  # bits after the point: a step of 1.2e-7, what float32 can tell apart at 1
GZIP = 31  # zlib's number for a stream with a gzip header
LEVEL = 19  # of zstd: the best that asks no more memory of a reader
MAX_RATIO = {3: 1032, 4: 1 << 15}  # deflate and zstd pack no better: 128 KiB of one byte take 4


@dataclass(frozen=True)
class Content:
    """What a file holds, its arrays still in bytes."""

    version: int
    gaussians: int
    sh_degree: int
    fraction: int  # bits after the point of a position
    arrays: list[Bytes]  # [n, width]: positions, opacities, colours, scales, rotations, SH
    antialiased: bool = False  # trained with the compensation of "antialiased"
    extended: bool = False  # the file holds more, for those who know it


def widths(version: int, sh_degree: int) -> list[int]:
    """Bytes of a Gaussian in each array."""
    return [9, 1, 3, 3, 4 if version >= 3 else 3, 3 * ((sh_degree + 1) ** 2 - 1)]


def pack(content: Content) -> bytes:
    """The file."""
    data = [array.tobytes() for array in content.arrays]
    flags = ANTIALIASED if content.antialiased else 0
    start = MAGIC, content.version, content.gaussians, content.sh_degree, content.fraction, flags
    if content.version == 4:
        parts = [part for part in data if part]
        frames = [_frame(part) for part in parts]
        table = [ENTRY.pack(len(frame), len(part)) for frame, part in zip(frames, parts, strict=True)]
        return b"".join([HEADER_4.pack(*start, len(parts), HEADER_4.size, bytes(12)), *table, *frames])
    packer = zlib.compressobj(wbits=GZIP)
    packed = packer.compress(HEADER.pack(*start, 0)) + b"".join(map(packer.compress, data))
    return packed + packer.flush()


def unpack(packed: bytes, path: Path) -> Content:
    """What a file holds. ValueError, which names it, for one that is not whole or promises too much."""
    if packed[:4] == MAGIC.to_bytes(4, "little"):
        raw = len(packed) >= HEADER.size and int.from_bytes(packed[4:8], "little") in (2, 3)
        if not raw:
            return _unpack_4(packed, path)
        packer = zlib.compressobj(1, wbits=GZIP)  # some tools leave the stream as it is
        packed = packer.compress(packed) + packer.flush()
    unpacker = zlib.decompressobj(wbits=GZIP)
    head = _inflate(unpacker, packed, HEADER.size, path)
    if len(head) < HEADER.size:
        raise ValueError(f"{path}: not an SPZ file: it ends within the header")
    magic, version, n, sh_degree, fraction, flags, _ = HEADER.unpack(head)
    if magic != MAGIC:
        raise ValueError(f"{path}: not an SPZ file: its first number is {magic:#x}, wanted {MAGIC:#x}")
    sizes = _checked(path, len(packed), version, (2, 3), n, sh_degree, fraction, flags)
    size = sum(sizes)
    data = np.frombuffer(_inflate(unpacker, unpacker.unconsumed_tail, size, path), np.uint8)
    more = _inflate(unpacker, unpacker.unconsumed_tail, 1, path) or unpacker.unused_data
    extended = bool(flags & EXTENDED)
    if len(data) < size or (not extended and (not unpacker.eof or more)):
        raise _damaged(path, n, bool(more))
    arrays = np.split(data, np.cumsum(sizes)[:-1])
    return _content(version, n, sh_degree, fraction, arrays, flags)


def _unpack_4(packed: bytes, path: Path) -> Content:
    if len(packed) < HEADER_4.size:
        raise ValueError(f"{path}: not an SPZ file: it ends within the header")
    _, version, n, sh_degree, fraction, flags, count, table, zeros = HEADER_4.unpack_from(packed)
    sizes = _checked(path, len(packed), version, (4,), n, sh_degree, fraction, flags)
    wanted = [size for size in sizes if size]
    place = table + count * ENTRY.size
    extended = bool(flags & EXTENDED)  # what it adds lies between the header and the table
    moved = table < HEADER_4.size if extended else table != HEADER_4.size or zeros.strip(b"\0")
    if count != len(wanted) or moved or place > len(packed):
        raise ValueError(f"{path}: the header promises {count} arrays at {table}, wanted {len(wanted)}")
    found: list[Bytes] = []
    for k, size in enumerate(wanted):
        length, promised = ENTRY.unpack_from(packed, table + k * ENTRY.size)
        if promised != size or length > len(packed) - place:
            raise _damaged(path, n, promised > size)
        found.append(np.frombuffer(_unframe(packed[place : place + length], size, path, n), np.uint8))
        place += length
    if place < len(packed) and not extended:
        raise _damaged(path, n, True)
    parts = iter(found)
    arrays = [next(parts) if size else np.zeros(0, np.uint8) for size in sizes]
    return _content(version, n, sh_degree, fraction, arrays, flags)


def _checked(
    path: Path,
    length: int,
    version: int,
    versions: tuple[int, ...],
    n: int,
    sh_degree: int,
    fraction: int,
    flags: int,
) -> list[int]:
    """The sizes of the arrays in bytes; ValueError for a header that is not to be believed."""
    if version not in versions:
        raise ValueError(f"{path}: SPZ version {version}, wanted {' or '.join(map(str, versions))}")
    if sh_degree > MOST_DEGREE:
        raise ValueError(f"{path}: harmonics of degree {sh_degree}, wanted 0..{MOST_DEGREE}")
    if flags & ~(ANTIALIASED | EXTENDED):
        raise ValueError(f"{path}: flags {flags:#x}, of which only {ANTIALIASED | EXTENDED:#x} are known")
    if fraction > MAX_FRACTION:
        raise ValueError(f"{path}: {fraction} fractional bits, wanted at most {MAX_FRACTION}")
    sizes = [n * width for width in widths(version, sh_degree)]
    if n > MAX_GAUSSIANS or sum(sizes) > MAX_RATIO[max(version, 3)] * length:
        raise ValueError(f"{path}: the header promises {n:,} Gaussians, the file has {length:,} bytes")
    return sizes


def _content(
    version: int, n: int, sh_degree: int, fraction: int, arrays: Sequence[Bytes], flags: int
) -> Content:
    shaped = [a.reshape(n, w) for a, w in zip(arrays, widths(version, sh_degree), strict=True)]
    antialiased, extended = bool(flags & ANTIALIASED), bool(flags & EXTENDED)
    return Content(version, n, sh_degree, fraction, shaped, antialiased, extended)


def _damaged(path: Path, n: int, more: bool) -> ValueError:
    return ValueError(f"{path}: damaged: {'more' if more else 'less'} data than {n:,} Gaussians have")


def _inflate(unpacker: Any, packed: bytes, size: int, path: Path) -> bytes:
    """The next `size` bytes of a gzip stream, never more; less where it ends."""
    if size == 0:
        return b""  # zlib would take 0 for no limit
    try:
        return unpacker.decompress(packed, size)
    except zlib.error as error:
        raise ValueError(f"{path}: not a readable SPZ file: {error}") from error


def _zstd() -> Any:
    """The module of Python's own library, or what it was before Python 3.14. Only version 4 needs it."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd


def _frame(data: bytes) -> bytes:
    """A zstd frame with its size and a checksum."""
    zstd = _zstd()
    wanted = zstd.CompressionParameter
    return zstd.compress(data, options={wanted.compression_level: LEVEL, wanted.checksum_flag: 1})


def _unframe(frame: bytes, size: int, path: Path, n: int) -> bytes:
    """The `size` bytes of a frame, never more."""
    zstd = _zstd()
    unpacker = zstd.ZstdDecompressor()
    try:
        data = unpacker.decompress(frame, size + 1)
        if len(data) == size and not unpacker.eof:
            data += unpacker.decompress(b"", 1)  # the checksum
    except (zstd.ZstdError, EOFError) as error:
        raise ValueError(f"{path}: not a readable SPZ file: {error}") from error
    if len(data) != size or not unpacker.eof or unpacker.unused_data:
        raise _damaged(path, n, len(data) > size or bool(unpacker.unused_data))
    return data
