"""SPZ files (Niantic's open format): a tenth of a PLY file, with a known error in every value.

One array after the other, positions, opacities, colours, scales, rotations, SH, in a container
(`hqgs.model.formats.spz_container`): versions 3 and 4 differ in that alone. Written are both; version 2 is
read too. A file holds its scene in the frame RUB (x right, y up, z back), the Gaussians here and PLY files
are RDF (x right, y down, z forward): y and z change their sign, and with them those parts of the rotations
and of the SH that are odd in them.

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.base.files import atomic_path
from hqgs.model.formats.arrays import TENSORS, Arrays
from hqgs.model.formats.rows import (
    finite_rows,
    of_smallest_three,
    pick,
    smallest_three,
    to_logits,
    to_opacities,
)
from hqgs.model.formats.spz_container import (
    MAX_FRACTION,
    MAX_GAUSSIANS,
    VERSIONS,
    Bytes,
    Content,
    pack,
    unpack,
)

VERSION = VERSIONS[0]  # what more programs read
SH_BITS = (8, 8)  # of degree 1, of degrees 2 and 3; less rounds small values that many Gaussians share to 0

LIMIT = (1 << 23) - 1  # of a 24-bit number; its negative is used alike
FINE = 1 / 64  # the error of a position, as a share of its Gaussian's largest scale, that is fine enough
COARSE = 1 / 8  # and the one that shows
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

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SpzFile:
    """What an SPZ file holds of the Gaussians that it was made of."""

    data: bytes  # of the whole file
    gaussians: int
    left_out: int  # Gaussians that hold NaN or Inf, or a rotation of norm 0
    fraction: int  # bits after the point of a position
    clipped: dict[str, int]  # values outside the format's range, by name; only what is not 0


def write_spz(
    path: str | Path, gaussians: Arrays, sh_bits: tuple[int, int] = SH_BITS, version: int = VERSION
) -> SpzFile:
    """Write Gaussians atomically. See `encode_spz` for the errors."""
    file = encode_spz(gaussians, sh_bits, version)
    with atomic_path(path) as tmp:
        tmp.write_bytes(file.data)
    return file


def encode_spz(gaussians: Arrays, sh_bits: tuple[int, int] = SH_BITS, version: int = VERSION) -> SpzFile:
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
    g = pick(gaussians, finite_rows(gaussians))
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
    antialiased = gaussians.get("antialiased", False)
    content = Content(version, len(means), math.isqrt(rest + 1) - 1, fraction, sections, antialiased)
    return SpzFile(pack(content), len(means), n - len(means), fraction, clipped)


def read_spz(path: str | Path) -> Arrays:
    """Read an SPZ file of version 2, 3 or 4: float32 arrays, with harmonics of degree 0 to 3.

    Those of degree 4, and extensions, are left out, which `notes` says. An opacity of 0 or 1 has no finite
    logit: it is taken a quarter of a step inwards.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not such a file, cut off, with more data than its header says, or with a header that
            says more than the file can hold. Memory stays in proportion to the header's count, which is at
            most 10,000,000. The message names the file.
    """
    path = Path(path)
    file = unpack(path.read_bytes(), path)
    n, stored = file.gaussians, (file.sh_degree + 1) ** 2 - 1
    rest = min(stored, len(FLIP_SH))
    means, opacities, colors, scales, quats, sh = file.arrays
    fixed = np.zeros((n, 3, 4), np.uint8)
    fixed[..., 1:] = means.reshape(n, 3, 3)  # in the upper bytes, so that the shift below keeps the sign
    xyzw = _unpack_quats(quats) if file.version >= 3 else _first_three(quats)
    found: Arrays = {
        "means": _floats(FLIP_MEANS * (fixed.view("<i4")[..., 0] >> 8) / 2.0**file.fraction),
        "scales": _floats(scales / LOG_SCALE - LOG_OFFSET),
        "quats": _floats(np.roll(FLIP_QUATS * xyzw, 1, axis=1)),
        "opacities": to_logits(opacities[:, 0] / 255, 1 / 255),
        "sh0": _floats(((colors - 127.5) / COLOR)[:, None]),
        "shN": _floats(FLIP_SH[:rest, None] * (sh.reshape(n, stored, 3)[:, :rest] / SH_ONE - 1)),
    }
    notes = ["its harmonics of degree 4 were left out"] if stored > rest else []
    if file.extended:
        notes.append("its extensions were passed by")
    if notes:
        found["notes"] = notes
    if file.antialiased:
        found["antialiased"] = True
    return found


def _floats(values: NDArray[Any]) -> NDArray[np.float32]:
    return values.astype(np.float32)


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
    fits = math.floor(math.log2(LIMIT / max(farthest, 0.5)))
    needed = math.ceil(-math.log2(2 * FINE * size))
    fraction = min(fits, max(needed, 0), MAX_FRACTION)
    error = 0.5 * 2.0**-fraction
    if fraction < 0 or error > COARSE * size:
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
