"""SPZ files (Niantic's open format): a tenth of a PLY file, with a known error in every value.

One array after the other, positions, opacities, colours, scales, rotations, SH, in a container: of versions
2 and 3 one gzip stream of a 16-byte header and the arrays, of version 4 a 32-byte header, a table with the
packed and the unpacked size of each array that is not empty, and a zstd frame for each. Written are 3 and 4,
which differ in that alone. A file holds its scene in the frame RUB (x right, y up, z back), the Gaussians
here and PLY files are RDF (x right, y down, z forward): y and z change their sign, and with them those parts
of the rotations and of the SH that are odd in them.

What a value that was written and read back may differ by, float32 rounding aside:

| value | stored as | error at most | range |
|---|---|---|---|
| means | 24-bit fixed point | half a step of 2^-bits | the bits are chosen so that all fit |
| scales | log, 8 bits | 1/32 in the log: 3.2 % | e^-10 to e^5.9375 world units |
| quats | three components of 10 bits | 0.005 rad of rotation | all |
| opacities | 8 bits | 0.5 / 255 | 0 to 1 |
| sh0 | 8 bits | 1/76.5, a colour change of 0.0037 | -3.33 to 3.33, colours from -0.44 to 1.44 |
| shN | 8 bits, of which the first B are used | 2^-B | -0.992 to 0.992 |

Values outside a range become its end; `SpzFile.clipped` counts them.
"""

from __future__ import annotations

import math
import struct
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.base.files import atomic_path
from hqgs.model.formats.arrays import (
    TENSORS,
    Arrays,
    Format,
    of_smallest_three,
    smallest_three,
    to_logits,
    to_opacities,
    writable,
)

VERSIONS = (3, 4)  # that are written, first the one that more programs read; 2 is read too
SH_BITS = (8, 8)  # of degree 1, of degrees 2 and 3; less rounds small values that many Gaussians share to 0

MISFIT_SHARE = 0.01  # of the Gaussians, whose positions or sizes the format may miss

LOG_SCALE, LOG_OFFSET = 16.0, 10.0  # log scale = byte / 16 - 10
COLOR = 0.15 * 255  # sh0 = (byte - 127.5) / COLOR
SH_ONE = 128  # shN = byte / 128 - 1
QUAT_BITS = 9  # of a magnitude, beside its sign
QUAT_ONE = ((1 << QUAT_BITS) - 1) * math.sqrt(2)  # the three smallest components are at most sqrt(1/2)

# Signs that turn RDF into RUB and back: a half turn about x, which SH functions odd in y z answer by -1.
FLIP_MEANS = np.array([1.0, -1.0, -1.0])
FLIP_QUATS = np.array([1.0, -1.0, -1.0, 1.0])  # x y z w
FLIP_SH = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float64)

# The container: of versions up to 3 a header with magic, version, Gaussians, SH degree, fractional bits,
# flags and 0; of version 4 up to the flags the same, how many arrays, where the table begins, zeros.
MAGIC = 0x5053474E  # "NGSP"
ANTIALIASED, EXTENDED = 0x1, 0x2  # flags
MOST_DEGREE = 4  # of the harmonics that a file may hold
HEADER, HEADER_4, ENTRY = struct.Struct("<IIIBBBB"), struct.Struct("<IIIBBBBI12s"), struct.Struct("<QQ")
MAX_GAUSSIANS = 10_000_000  # Niantic's reader takes no more
MAX_FRACTION = 23  # bits after the point: a step of 1.2e-7, what float32 can tell apart at 1
GZIP = 31  # zlib's number for a stream with a gzip header
MAX_RATIO = {2: 1032, 3: 1032, 4: 1 << 15}  # deflate and zstd pack no better: 128 KiB of one byte take 4

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class SpzFile:
    """What an SPZ file holds of the Gaussians that it was made of."""

    data: bytes  # of the whole file
    gaussians: int
    left_out: int  # Gaussians that hold NaN or Inf, or a rotation of norm 0
    fraction: int  # bits after the point of a position
    clipped: dict[str, int]  # values outside the format's range, by name; only what is not 0


def write_spz(
    path: Path, gaussians: Arrays, sh_bits: tuple[int, int] = SH_BITS, version: int = VERSIONS[0]
) -> SpzFile:
    """Write Gaussians atomically. See `encode_spz` for the errors."""
    file = encode_spz(gaussians, sh_bits, version)
    with atomic_path(path) as tmp:
        tmp.write_bytes(file.data)
    return file


def encode_spz(gaussians: Arrays, sh_bits: tuple[int, int] = SH_BITS, version: int = VERSIONS[0]) -> SpzFile:
    """The bytes of an SPZ file, without the Gaussians that hold NaN or Inf.

    Args:
        gaussians: at most 10,000,000.
        sh_bits: 1..8 bits for the SH coefficients of degree 1, and of degrees 2 and 3.
        version: 3 or 4; the same values in another container.

    Raises ValueError where the format's ranges do not fit the scene: where more than 1 % of the Gaussians
    would be displaced by more than an eighth of their largest scale, or have a largest scale out of range.
    """
    if len(sh_bits) != 2 or not all(1 <= bits <= 8 for bits in sh_bits):
        raise ValueError(f"sh_bits is {sh_bits}, wanted two numbers in 1..8")
    if version not in VERSIONS:
        raise ValueError(f"version is {version}, wanted one of: {', '.join(map(str, VERSIONS))}")
    n, rest = gaussians["shN"].shape[:2]
    if n > MAX_GAUSSIANS:
        raise ValueError(f"{n:,} Gaussians, but an SPZ file takes at most {MAX_GAUSSIANS:,}")
    g, left_out = writable(gaussians)
    arrays: dict[str, Array] = {name: np.asarray(g[name], np.float64) for name in TENSORS}
    means = FLIP_MEANS * arrays["means"]
    fraction = _fraction(means, arrays["scales"])
    clipped: dict[str, int] = {}
    steps = np.repeat([1 << (8 - bits) for bits in sh_bits], [3, 12])  # gzip finds few values

    def byte(name: str, values: Array, step: Array | int = 1) -> Bytes:
        stored = (np.rint(values / step) * step).clip(0, 255)
        outside = int((np.abs(stored - values) > 0.5 * step).sum())
        clipped.update({name: outside} if outside else {})
        return stored.astype(np.uint8)

    fixed = np.rint(means * 2.0**fraction).astype("<i4")
    sections = [
        fixed[..., None].view(np.uint8)[..., :3],
        byte("opacities", 255 * to_opacities(arrays["opacities"])),
        byte("sh0", arrays["sh0"][:, 0] * COLOR + 127.5),
        byte("scales", (arrays["scales"] + LOG_OFFSET) * LOG_SCALE),
        _pack_quats(FLIP_QUATS * np.roll(arrays["quats"], -1, axis=1)),
        byte("shN", FLIP_SH[:rest, None] * arrays["shN"] * SH_ONE + SH_ONE, steps[:rest, None]),
    ]
    flags = ANTIALIASED if gaussians.get("antialiased") else 0
    start = MAGIC, version, len(means), math.isqrt(rest + 1) - 1, fraction, flags
    return SpzFile(
        _pack(start, [part.tobytes() for part in sections]), len(means), left_out, fraction, clipped
    )


def read_spz(path: Path) -> Arrays:
    """Read an SPZ file of version 2, 3 or 4, with harmonics of degree 0 to 3.

    Those of degree 4, and extensions, are left out, which `notes` says. An opacity of 0 or 1 has no finite
    logit: it is taken a quarter of a step inwards.

    ValueError: not such a file, cut off, with more data than its header says, or with a header that says more
    than the file can hold. Memory stays in proportion to the header's count, which is at most 10,000,000.
    """
    version, n, degree, fraction, flags, parts = _unpack(path.read_bytes())
    stored = (degree + 1) ** 2 - 1
    rest = min(stored, len(FLIP_SH))
    means, opacities, colors, scales, quats, sh = parts
    fixed = np.zeros((n, 3, 4), np.uint8)
    fixed[..., 1:] = means.reshape(n, 3, 3)  # in the upper bytes, so that the shift below keeps the sign
    xyzw = (_unpack_quats if version >= 3 else _first_three)(quats.reshape(n, 4 if version >= 3 else 3))
    notes = ["its harmonics of degree 4 were left out"] if stored > rest else []
    return {
        "means": FLIP_MEANS * (fixed.view("<i4")[..., 0] >> 8) / 2.0**fraction,
        "scales": scales.reshape(n, 3) / LOG_SCALE - LOG_OFFSET,
        "quats": np.roll(FLIP_QUATS * xyzw, 1, axis=1),
        "opacities": to_logits(opacities.reshape(n) / 255, 1 / 255),
        "sh0": ((colors - 127.5) / COLOR).reshape(n, 1, 3),
        "shN": FLIP_SH[:rest, None] * (sh.reshape(n, stored, 3)[:, :rest] / SH_ONE - 1),
        "notes": notes + (["its extensions were ignored"] if flags & EXTENDED else []),
        "antialiased": bool(flags & ANTIALIASED),
    }


def _fraction(means: Array, scales: Array) -> int:
    """Bits after the point of a position: no more than needed, since gzip shrinks no noise; ValueError."""
    if not len(means):
        return 0
    farthest = float(np.abs(means).max())
    largest = scales.max(axis=1)  # logs
    end = 255 / LOG_SCALE - LOG_OFFSET
    outside = (largest < -LOG_OFFSET) | (largest > end)
    if outside.mean() > MISFIT_SHARE:
        raise ValueError(
            f"scales: the largest scale of {outside.sum():,} of {len(means):,} Gaussians is not in the range "
            f"of SPZ, {math.exp(-LOG_OFFSET):.2g} to {math.exp(end):.3g} world units; write a PLY file"
        )
    smallest = float(np.quantile(largest, MISFIT_SHARE, method="lower"))
    size = math.exp(min(max(smallest, -LOG_OFFSET), end))
    fits = math.floor(math.log2(((1 << 23) - 1) / max(farthest, 0.5)))  # of 24 bits, one is the sign
    needed = math.ceil(-math.log2(size / 32))  # an error of 1/64 of the size is fine enough
    fraction = min(fits, max(needed, 0), MAX_FRACTION)
    error = 0.5 * 2.0**-fraction
    if fraction < 0 or error > size / 8:  # which shows
        raise ValueError(
            f"means: SPZ has 24 bits for a position, so {farthest:.3g} world units from the origin the error "
            f"is {error:.2g}, but 1 % of the Gaussians are no larger than {size:.2g}; write a PLY file"
        )
    return fraction


def _pack_quats(xyzw: Array) -> Bytes:
    """Quaternions [n, 4] as 32 bits: the place of the largest component, sign and magnitude of the others."""
    place, three = smallest_three(xyzw)
    parts = np.rint(np.abs(three) * QUAT_ONE).astype(np.uint32) | (three < 0).astype(np.uint32) << QUAT_BITS
    word = place.astype(np.uint32)
    for part in parts.T:
        word = word << (QUAT_BITS + 1) | part
    return word.astype("<u4")[:, None].view(np.uint8)


def _unpack_quats(packed: Bytes) -> Array:
    word = np.ascontiguousarray(packed).view("<u4")
    parts = word >> np.arange(2, -1, -1, dtype=np.uint32) * (QUAT_BITS + 1)
    three = (parts & ((1 << QUAT_BITS) - 1)) / QUAT_ONE * np.where(parts >> QUAT_BITS & 1, -1, 1)
    return of_smallest_three(word[:, 0] >> 30, three)


def _first_three(packed: Bytes) -> Array:
    """Quaternions of version 2: x y z in 8 bits each, w is not negative."""
    xyz = packed / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(axis=1)))
    return np.concatenate([xyz, w[:, None]], axis=1)


def _pack(start: tuple[int, ...], data: list[bytes]) -> bytes:
    """The file of a header's first numbers and the arrays."""
    if start[1] == 4:
        zstd, parts = _zstd(), [part for part in data if part]
        wanted = zstd.CompressionParameter
        # The best level that asks no more memory of a reader.
        options = {wanted.compression_level: 19, wanted.checksum_flag: 1}
        frames = [zstd.compress(part, options=options) for part in parts]
        table = [ENTRY.pack(len(frame), len(part)) for frame, part in zip(frames, parts, strict=True)]
        return b"".join([HEADER_4.pack(*start, len(parts), HEADER_4.size, bytes(12)), *table, *frames])
    packer = zlib.compressobj(wbits=GZIP)
    packed = packer.compress(HEADER.pack(*start, 0)) + b"".join(map(packer.compress, data))
    return packed + packer.flush()


def _unpack(packed: bytes) -> tuple[int, int, int, int, int, list[Bytes]]:
    """Version, Gaussians, SH degree, fractional bits, flags and the arrays of a file. ValueError for one that
    is not whole or promises too much."""
    length = len(packed)
    if packed[:4] == MAGIC.to_bytes(4, "little"):
        if length < HEADER.size or int.from_bytes(packed[4:8], "little") not in (2, 3):
            return _unpack_4(packed)
        packer = zlib.compressobj(1, wbits=GZIP)  # some tools leave the stream as it is
        packed = packer.compress(packed) + packer.flush()
    unpacker = zlib.decompressobj(wbits=GZIP)
    head = _inflate(unpacker, packed, HEADER.size)
    if len(head) < HEADER.size:
        raise ValueError("not an SPZ file: it ends within the header")
    magic, *start, _ = HEADER.unpack(head)
    if magic != MAGIC:
        raise ValueError(f"not an SPZ file: its first number is {magic:#x}, wanted {MAGIC:#x}")
    version, n, degree, fraction, flags = start
    sizes = _checked(length, (2, 3), *start)
    data = np.frombuffer(_inflate(unpacker, unpacker.unconsumed_tail, sum(sizes)), np.uint8)
    more = _inflate(unpacker, unpacker.unconsumed_tail, 1) or unpacker.unused_data
    if len(data) < sum(sizes) or (not flags & EXTENDED and (not unpacker.eof or more)):
        raise _damaged(n, bool(more))
    return version, n, degree, fraction, flags, np.split(data, np.cumsum(sizes)[:-1])


def _unpack_4(packed: bytes) -> tuple[int, int, int, int, int, list[Bytes]]:
    if len(packed) < HEADER_4.size:
        raise ValueError("not an SPZ file: it ends within the header")
    _, version, n, degree, fraction, flags, count, table, zeros = HEADER_4.unpack_from(packed)
    sizes = _checked(len(packed), (4,), version, n, degree, fraction, flags)
    wanted = [size for size in sizes if size]
    place = table + count * ENTRY.size
    extended = bool(flags & EXTENDED)  # what it adds lies between the header and the table
    moved = table < HEADER_4.size if extended else table != HEADER_4.size or zeros.strip(b"\0")
    if count != len(wanted) or moved or place > len(packed):
        raise ValueError(f"the header promises {count} arrays at {table}, wanted {len(wanted)}")
    found, entries = list[Bytes](), ENTRY.iter_unpack(packed[table:place])
    for size in sizes:
        length, promised = next(entries) if size else (0, 0)
        if promised != size or length > len(packed) - place:
            raise _damaged(n, promised > size)
        data = _unframe(packed[place : place + length], size, n) if size else b""
        found.append(np.frombuffer(data, np.uint8))
        place += length
    if place < len(packed) and not extended:
        raise _damaged(n, True)
    return version, n, degree, fraction, flags, found


def _checked(
    length: int, versions: tuple[int, ...], version: int, n: int, degree: int, fraction: int, flags: int
) -> list[int]:
    """The sizes of the arrays in bytes; ValueError for a header that is not to be believed."""
    if version not in versions:
        raise ValueError(f"SPZ version {version}, wanted {' or '.join(map(str, versions))}")
    if degree > MOST_DEGREE:
        raise ValueError(f"harmonics of degree {degree}, wanted 0..{MOST_DEGREE}")
    if flags & ~(ANTIALIASED | EXTENDED):
        raise ValueError(f"flags {flags:#x}, of which only {ANTIALIASED | EXTENDED:#x} are known")
    if fraction > MAX_FRACTION:
        raise ValueError(f"{fraction} fractional bits, wanted at most {MAX_FRACTION}")
    sizes = [n * width for width in (9, 1, 3, 3, 4 if version >= 3 else 3, 3 * ((degree + 1) ** 2 - 1))]
    if n > MAX_GAUSSIANS or sum(sizes) > MAX_RATIO[version] * length:
        raise ValueError(f"the header promises {n:,} Gaussians, the file has {length:,} bytes")
    return sizes


def _damaged(n: int, more: bool) -> ValueError:
    return ValueError(f"damaged: {'more' if more else 'less'} data than {n:,} Gaussians have")


def _inflate(unpacker: Any, packed: bytes, size: int) -> bytes:
    """The next `size` bytes of a gzip stream, never more; less where it ends."""
    return unpacker.decompress(packed, size) if size else b""  # zlib would take 0 for no limit


def _zstd() -> Any:
    """The module of Python's own library, or what it was before Python 3.14. Only version 4 needs it."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd


def _unframe(frame: bytes, size: int, n: int) -> bytes:
    """The `size` bytes of a zstd frame, never more."""
    zstd = _zstd()
    unpacker = zstd.ZstdDecompressor()
    try:
        data = unpacker.decompress(frame, size + 1)
        if len(data) == size and not unpacker.eof:
            data += unpacker.decompress(b"", 1)  # the checksum
    except (zstd.ZstdError, EOFError) as error:
        raise ValueError(f"not a readable SPZ file: {error}") from error
    if len(data) != size or not unpacker.eof or unpacker.unused_data:
        raise _damaged(n, len(data) > size or bool(unpacker.unused_data))
    return data


FORMATS = {
    "spz": Format(
        read_spz,
        lambda path, arrays: write_spz(path, arrays).left_out,
        starts=(MAGIC.to_bytes(4, "little"),),
        antialiased=True,
    )
}
