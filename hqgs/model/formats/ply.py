"""PLY files in the layout of 3DGS, which the common viewers read; and compressed ones, of SuperSplat.

One vertex per Gaussian, float32: x y z, f_dc_0..2, f_rest_* (all red coefficients, then green, then blue; 0,
9, 24 or 45 of them for the SH degrees 0 to 3), opacity (logit), scale_0..2 (log), rot_0..3 (w x y z). Readers
find columns by their names; the normals of 3DGS, which are all zero, are not written (nor does gsplat).
Where trust was learned, hqgs_error is the error of the pixels that a Gaussian shows in, 0 to 1 (white).

What a file says of itself stands in comments of its header. Ours: the frame (`hqgs world`) and the antialias
flag. Of others: that flag (Postshot's `antialiased 1`, `SplatRenderMode: mip` of Brush and gsplat), where up
is (`Vertical axis: z` of nerfstudio), a unit.

Compressed: 16 bytes a Gaussian and a byte for each harmonic. Chunks of 256 Gaussians hold the bounds of their
positions, log scales and colours; each Gaussian is four words of 32 bits, which say where between those
bounds it is:

| word | bits | error at most |
|---|---|---|
| packed_position | x 11, y 10, z 11 | half of 1/2047 (y: 1/1023) of the chunk's box |
| packed_rotation | place of the largest component 2, the others 10 each | 0.003 rad |
| packed_scale | 11, 10, 11 | as positions, of the range of logs, which ends at -20 and 20 |
| packed_color | red, green, blue, opacity, 8 each | half of 1/255 of the chunk's colours; opacity 0.5/255 |

A harmonic is one byte, from -4 to 4 in 256 steps: an error of 1/64.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from hqgs.base.files import atomic_path
from hqgs.base.ply import bytes_after, header_of, read_elements, read_vertices
from hqgs.model.constants import MAX_SH_DEGREE
from hqgs.model.formats.arrays import (
    SHARE_STEP,
    Arrays,
    Format,
    Told,
    of_colors,
    of_smallest_three,
    pick,
    shown,
    smallest_three,
    sound_errors,
    to_logits,
    to_opacities,
    whole_rows,
    writable,
)
from hqgs.scene.world import World, world_for

_REST_COUNTS = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1)]  # 0, 9, 24, 45
_REST_4 = 72  # of degree 4, which some exporters write
_MEANS = ["x", "y", "z"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_COLORS = ["red", "green", "blue"]  # in place of _DC
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]
_ERROR = "hqgs_error"
MOST_LOGIT = 18.0  # of an opacity that is stored as infinite: float32 rounds its sigmoid to 1 or next to 0

OURS = "hqgs"  # how comments of the header begin that hqgs writes, one at least
_WORLD = f"{OURS} world "
_ANTIALIASED = [f"{OURS} antialiased", "SplatRenderMode: mip"]  # the latter for other programs

# Comments of other programs.
_MODE = re.compile(rf"(?:{OURS} )?(?:antialias\w*|train_flags|splat ?render ?mode)[\s:=]*(.*)")
_OFF: tuple[str, ...] = ("0", "false", "no", "off", "none", "default", "classic")
_ON: tuple[str, ...] = ("", "1", "true", "yes", "on", "mip", "antialiased", "antialiasing")
_UP = re.compile(r"(?:vertical|up)[ _-]?(?:axis|vector|direction)?[\s:=]+(.*)")
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_UNIT = re.compile(r"(?:\w+[ _-])?units?[\s:=]+(.*)")
_TELLING = re.compile(r"unit|axis|axes|handed|coordinate|colou?r|gamma|offset|shift|origin|epsg|crs|kernel")

CHUNK = 256
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_PARTS = (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
BOUNDS = [f"{end}_{kind}{axis}" for kind, axes in _PARTS for end in ("min", "max") for axis in axes]
LOG_LIMIT = 20.0
SPREAD = np.sqrt(0.5)  # a component that is not the largest is no larger
_BITS, _TURN_BITS = (11, 10, 11), (10, 10, 10)  # above those of a rotation: which component is left out


def write_ply(path: Path, arrays: Arrays, *, full: bool = False) -> int:
    """Write Gaussians atomically, without the rows that hold a NaN or Inf; return how many those were.

    Of a scene that is held in another frame than its files', positions and scales go back to that, positions
    as float64 where its origin was moved; the header says so in a comment. `full`: all 62 columns of 3DGS,
    for readers of a fixed layout, normals and harmonics of 0 where there are none, float32 throughout.
    """
    n, higher = arrays["shN"].shape[:2]
    world = World() if full else arrays.get("world", World())  # if full, it is said beside the file
    means, scales = world.out(arrays["means"]), arrays["scales"]
    if world.unit != 1:
        scales = scales + np.float32(math.log(world.unit))
    rest = arrays["shN"].transpose(0, 2, 1)  # [N, K - 1, 3] to channel-major
    if full:
        rest = np.pad(rest, ((0, 0), (0, 0), (0, _REST_COUNTS[-1] // 3 - higher)))
    columns = [
        (_MEANS, means),
        *([(["nx", "ny", "nz"], np.zeros((n, 3), np.float32))] if full else []),
        (_DC, arrays["sh0"][:, 0]),
        ([f"f_rest_{i}" for i in range(3 * rest.shape[2])], rest.reshape(n, 3 * rest.shape[2])),
        (["opacity"], arrays["opacities"][:, None]),
        (_SCALES, scales),
        (_QUATS, arrays["quats"]),
    ]
    if "errors" in arrays and not full:
        columns.append(([_ERROR], arrays["errors"][:, None]))
    names = [name for group, _ in columns for name in group]
    with np.errstate(over="ignore"):  # of float64: such a row is left out
        rows = np.concatenate([values for _, values in columns], axis=1, dtype=np.dtype("<f4"))
    finite = np.isfinite(rows).all(axis=1)
    far = any(world.shift)
    kinds = [(name, "<f8" if far and name in _MEANS else "<f4") for name in names]
    vertices = np.empty(int(finite.sum()), kinds)
    for k, name in enumerate(names):
        vertices[name] = means[finite, k] if name in _MEANS else rows[finite, k]
    says = comments_of(world, arrays.get("antialiased", False))
    with atomic_path(path) as tmp:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<", comments=says).write(str(tmp))
    return int(n - finite.sum())


def read_ply(path: Path) -> Arrays:
    """Read the Gaussians that hqgs, 3DGS, gsplat or Brush wrote.

    Properties are found by name, in any order, as numbers of any kind; others are passed by. Text files and
    binary ones of either byte order are read. An infinite opacity and a scale of 0 (a log of -inf) become the
    nearest that there is; other rows that are not finite are left out, harmonics above degree 3 too, and
    `notes` counts them. Positions of float64 that lie far from the origin are held around their middle.

    ValueError: not a PLY file, not this layout, more rows promised than the file can hold, or no row that is
    finite. The message names the property.
    """
    header, vertices = header_of(path), read_vertices(path)
    told = told_by(header.comments)
    notes, world = told.pop("notes"), told.get("world", World())
    present = {name for name in vertices.dtype.names or () if vertices.dtype[name].kind in "fiu"}
    rest = [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in present))]
    discs = _SCALES[2] not in present and {*_SCALES[:2]} <= present
    colored = {*_COLORS} <= present and not {*_DC} & present
    _check_columns(present, [*([] if colored else _DC), *rest, "opacity", *_SCALES[: 2 if discs else 3]])
    wide = any(vertices.dtype[name].itemsize > 4 for name in _MEANS)
    means = _columns(vertices, _MEANS, np.float64 if wide or not world.ordinary else np.float32)
    opacities, scales = (
        _columns(vertices, ["opacity"])[:, 0],
        _columns(vertices, _SCALES[: 2 if discs else 3]),
    )
    if not any(line.startswith(OURS) for line in header.comments):
        opacities, scales = _as_stored(opacities, scales, notes)
    if discs:
        flat = np.float32(math.log(1e-3))
        scales = np.append(scales, scales.min(1, keepdims=True) + flat, axis=1)
        notes.append("its Gaussians are discs (2DGS): their thickness was set to a thousandth of the radius")
    finite = means[np.isfinite(means).all(1)]
    if wide and world.ordinary and len(finite):
        world = replace(world, shift=world_for(finite, finite).shift)
    if not world.ordinary:
        means = world.into(means)
        scales -= np.float32(math.log(world.unit))
    clamped = int(np.isinf(opacities).sum()), int((scales == -np.inf).any(1).sum())
    opacities = np.where(np.isinf(opacities), np.copysign(np.float32(MOST_LOGIT), opacities), opacities)
    scales = np.where(scales == -np.inf, np.float32(math.log(1e-20)), scales)
    higher = _columns(vertices, rest).reshape(len(vertices), 3, len(rest) // 3).transpose(0, 2, 1)
    if len(rest) == _REST_4:
        notes.append("its harmonics of degree 4 were left out")
        higher = higher[:, : _REST_COUNTS[-1] // 3]
    arrays: Arrays = {
        "means": means.astype(np.float32),
        "scales": scales,
        "quats": _columns(vertices, _QUATS),
        "opacities": opacities,
        "sh0": _plain_colors(vertices) if colored else _columns(vertices, _DC)[:, None, :],
        "shN": higher,
    }
    if _ERROR in present:
        arrays["errors"] = sound_errors(_columns(vertices, [_ERROR])[:, 0])
    arrays = _whole(arrays, vertices, notes)
    for count, what in zip(clamped, ("infinite opacities", "scales of 0"), strict=True):
        if count:
            notes.append(f"{count} {what} were replaced by the nearest valid value")
    if more := bytes_after(path, header):
        notes.append(f"{more} bytes after its last row were ignored")
    return {**arrays, **told, "world": world, "notes": notes}


def _columns(vertices: NDArray[Any], names: list[str], kind: type = np.float32) -> NDArray[Any]:
    """[N, len(names)]."""
    found = np.empty((len(vertices), len(names)), kind)
    for k, name in enumerate(names):
        with np.errstate(over="ignore"):  # of float64
            found[:, k] = vertices[name]
    return found


def _as_stored(
    opacities: NDArray[Any], scales: NDArray[Any], notes: list[str]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Logits and logarithms, of values of another program that may be neither; `notes` tell."""
    # A hundred and more logits of a trained scene do not stay in 0..1.
    low, high = (opacities.min(), opacities.max()) if len(opacities) >= 100 else (0.5, 0.5)
    if not (low >= 0 and high <= 1 and low < 0.3 and high > 0.9):
        return opacities, scales
    notes.append("its opacities are between 0 and 1: they were read as they are, not as logits")
    if (scales > 0).all():
        scales = np.log(scales)
        notes.append("its scales are all positive: they were read as lengths, not as logarithms")
    return to_logits(opacities, SHARE_STEP), scales


def _whole(arrays: Arrays, vertices: NDArray[Any], notes: list[str]) -> Arrays:
    """Those that are finite; ValueError where none is."""
    keep = whole_rows(arrays)
    if keep.all():
        return arrays
    if not keep.any():
        raise ValueError(f"none of its {len(keep)} rows is finite, the first is {vertices[0]!s:.200}")
    notes.append(f"{int((~keep).sum())} of {len(keep)} Gaussians hold NaN or Inf and were left out")
    return pick(arrays, keep)


def _check_columns(present: set[str], wanted: list[str]) -> None:
    """ValueError where a column is missing, or the harmonics are of no degree."""
    if missing := [name for name in (*_MEANS, *wanted, *_QUATS) if name not in present]:
        points = {*_MEANS} <= present and not {"opacity", *_SCALES} & present
        of_them = "; it holds only points, from which `hqgs train` makes a scene, with their photos"
        why = of_them if points else ""
        raise ValueError(f"not a 3DGS scene, these properties are missing: {', '.join(missing)}{why}")
    rest = sum(name.startswith("f_rest_") for name in wanted)
    if rest not in [*_REST_COUNTS, _REST_4]:
        raise ValueError(f"{rest} f_rest_* properties, wanted one of {_REST_COUNTS}")


def _plain_colors(vertices: NDArray[Any]) -> NDArray[np.float64]:
    """The harmonics of degree 0 [N, 1, 3] of plain colours: bytes, or numbers where 1 is white."""
    colors = np.stack([vertices[name] for name in _COLORS], -1)
    return of_colors(colors / (255.0 if colors.dtype.kind in "ui" else 1.0))


def comments_of(world: World, antialiased: bool) -> list[str]:
    """What is written into a header."""
    says = [f"{OURS} scene", *([f"{_WORLD}{json.dumps(world.json())}"] if world != World() else [])]
    return says + (_ANTIALIASED if antialiased else [])


def told_by(comments: list[str]) -> Told:
    """What comments of a header say of a scene, and `notes` of what they say beside that.

    ValueError where one of ours is damaged.
    """
    told: Told = {"notes": []}
    for comment in comments:
        line, world = comment.lower(), told.get("world", World())
        if comment.startswith(_WORLD):
            try:
                told["world"] = World.of_json(json.loads(comment.removeprefix(_WORLD)))
            except (ValueError, RecursionError) as error:
                raise ValueError(f"its comment {comment!r:.80} is damaged: {error}") from error
        elif (mode := _MODE.fullmatch(line)) and mode[1] in _OFF + _ON:
            told["antialiased"] = mode[1] in _ON
        elif (axis := _UP.fullmatch(line)) and (up := _direction(axis[1])):
            if up != (0.0, -1.0, 0.0):  # that of a scene that says nothing
                told["world"] = replace(world, up=up)
            told["notes"].append(f"up is ({up[0]:g}, {up[1]:g}, {up[2]:g}), as its header says: {comment}")
        elif (unit := _UNIT.fullmatch(line)) and unit[1] in ("m", "meter", "meters", "metre", "metres"):
            told["world"] = replace(world, metres=1.0)
            told["notes"].append("its unit is a metre, as its header says")
        elif mode or (not comment.startswith(OURS) and _TELLING.search(line)):
            told["notes"].append(f"its header says {comment!r:.100}, which was ignored")
    return told


def _direction(words: str) -> tuple[float, float, float] | None:
    """The unit vector of an axis, or of three numbers; None of anything else.

    y without a sign means down of COLMAP's frame, as in Brush, and x and z are up, as z is in nerfstudio.
    """
    words = words.strip().replace("neg_", "-").replace("pos_", "+")
    if (axis := words.lstrip("+-")) in _AXES and len(words) <= 2:
        sign = -1.0 if words in ("y", f"-{axis}") else 1.0
        x, y, z = (sign * value + 0.0 for value in _AXES[axis])
        return x, y, z
    try:
        x, y, z = (float(value) for value in re.sub(r"[\[\](),]", " ", words).split())
    except ValueError:
        return None
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length) if 0 < length < math.inf else None


def write_compressed_ply(path: Path, arrays: Arrays) -> int:
    """Write atomically along a curve through space, without rows that hold NaN or Inf; return how many."""
    g, left_out = writable(arrays, curve=True)
    n = len(g["means"])
    logs = g["scales"].astype(np.float64).clip(-LOG_LIMIT, LOG_LIMIT)
    starts, chunk = np.arange(0, n, CHUNK), np.arange(n) // CHUNK
    chunks = np.zeros(len(starts), [(name, "<f4") for name in BOUNDS])
    words = np.zeros(n, [(name, "<u4") for name in WORDS])
    shares = []
    for k, values in enumerate((g["means"].astype(np.float64), logs, shown(g["sh0"]))):
        names = BOUNDS[6 * k : 6 * k + 6]
        low = np.minimum.reduceat(values, starts).astype("<f4") if n else values
        high = np.maximum.reduceat(values, starts).astype("<f4") if n else values
        for axis in range(3):
            chunks[names[axis]], chunks[names[3 + axis]] = low[:, axis], high[:, axis]
        span = np.maximum(high.astype(np.float64) - low, 1e-30)
        shares.append(((values - low[chunk]) / span[chunk]).clip(0, 1))
    words["packed_position"] = _pack(shares[0], _BITS)
    words["packed_scale"] = _pack(shares[1], _BITS)
    alphas = to_opacities(g["opacities"])[:, None]
    words["packed_color"] = _pack(np.concatenate([shares[2], alphas], axis=1), (8, 8, 8, 8))
    place, three = smallest_three(g["quats"].astype(np.float64))
    turns = _pack((three / SPREAD * 0.5 + 0.5).clip(0, 1), _TURN_BITS)
    words["packed_rotation"] = place.astype(np.uint32) << np.uint32(sum(_TURN_BITS)) | turns
    elements = [PlyElement.describe(chunks, "chunk"), PlyElement.describe(words, "vertex")]
    if count := 3 * g["shN"].shape[1]:
        rest = g["shN"].astype(np.float64).transpose(0, 2, 1).reshape(n, count)
        # No byte stands for 0: its two neighbours take turns, or colours would all shift to one side.
        turns = (rest == 0) & ((np.arange(n)[:, None] + np.arange(count)) % 2 == 0)
        levels = (np.floor((rest / 8 + 0.5) * 256) - turns).clip(0, 255).astype(np.uint8)
        names = [(f"f_rest_{k}", "u1") for k in range(count)]
        elements.append(PlyElement.describe(np.ascontiguousarray(levels).view(names)[:, 0], "sh"))
    comments = comments_of(World(), arrays.get("antialiased", False))  # its frame is said beside it
    with atomic_path(path) as tmp:
        PlyData(elements, byte_order="<", comments=comments).write(str(tmp))
    return left_out


def read_compressed_ply(path: Path) -> Arrays:
    """Read such a file. ValueError where it is damaged."""
    told, elements = told_by(header_of(path).comments), read_elements(path)
    if "vertex" not in elements or "chunk" not in elements:
        raise ValueError("a compressed PLY file has the elements chunk and vertex")
    vertices, chunks = elements["vertex"], elements["chunk"]
    n = len(vertices)
    words = _of_kind(vertices, WORDS, "u").astype(np.uint32)
    colored = "min_r" in (chunks.dtype.names or ())
    bounds = _of_kind(chunks, BOUNDS if colored else BOUNDS[:12], "f").astype(np.float64)
    if len(bounds) * CHUNK < n:
        raise ValueError(f"{len(bounds)} chunks of {CHUNK} are too few for {n:,} Gaussians")
    if not np.isfinite(bounds).all():
        raise ValueError("a bound of a chunk is not finite")
    if not colored:
        bounds = np.concatenate([bounds, np.tile([0.0] * 3 + [1.0] * 3, (len(bounds), 1))], axis=1)
    own = bounds[np.arange(n) // CHUNK].reshape(n, 3, 2, 3)

    def between(shares: NDArray[np.float64], k: int) -> NDArray[np.float64]:
        return own[:, k, 0] * (1 - shares) + own[:, k, 1] * shares

    color = _unpack(words[:, 3], (8, 8, 8, 8))
    three = (_unpack(words[:, 1], _TURN_BITS) - 0.5) * 2 * SPREAD
    return {
        "means": between(_unpack(words[:, 0], _BITS), 0),
        "scales": between(_unpack(words[:, 2], _BITS), 1),
        "quats": of_smallest_three(words[:, 1] >> np.uint32(sum(_TURN_BITS)), three),
        "opacities": to_logits(color[:, 3], 1 / 255),
        "sh0": of_colors(between(color[:, :3], 2)),
        "shN": _packed_harmonics(elements.get("sh"), n),
        **told,
    }


def _packed_harmonics(rows: NDArray[Any] | None, n: int) -> NDArray[np.float64]:
    if rows is None:
        return np.zeros((n, 0, 3))
    names = [name for name in rows.dtype.names or () if name.startswith("f_rest_")]
    if len(names) not in _REST_COUNTS or len(rows) != n:
        raise ValueError(
            f"{len(rows):,} rows of {len(names)} harmonics, wanted {n:,} of one of {_REST_COUNTS}"
        )
    levels = _of_kind(rows, [f"f_rest_{k}" for k in range(len(names))], "u").astype(np.float64)
    values = ((levels + 0.5) / 256 - 0.5) * 8
    return values.reshape(n, 3, len(names) // 3).transpose(0, 2, 1)


def _of_kind(rows: NDArray[Any], names: Any, kind: str) -> NDArray[Any]:
    present = rows.dtype.names or ()
    missing = [name for name in names if name not in present or rows.dtype[name].kind != kind]
    if missing:
        raise ValueError(f"these properties are missing or of another type: {', '.join(missing)}")
    return np.stack([rows[name] for name in names], axis=1) if names else np.zeros((len(rows), 0))


def _pack(shares: NDArray[np.float64], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Numbers 0..1 [n, len(bits)] in one word, the first in the highest bits."""
    word = np.zeros(len(shares), np.uint32)
    for k, width in enumerate(bits):
        word = word << np.uint32(width) | np.rint(shares[:, k] * ((1 << width) - 1)).astype(np.uint32)
    return word


def _unpack(word: NDArray[np.uint32], bits: tuple[int, ...]) -> NDArray[np.float64]:
    shares, shift = [], sum(bits)
    for width in bits:
        shift -= width
        most = (1 << width) - 1
        shares.append((word >> np.uint32(shift) & np.uint32(most)) / most)
    return np.stack(shares, axis=1)


def _read_any_ply(path: Path) -> Arrays:
    lines = header_of(path).lines
    packed = any("packed_position" in line for line in lines if "property" in line)
    return read_compressed_ply(path) if packed else read_ply(path)


FORMATS = {
    "ply": Format(_read_any_ply, write_ply, (b"ply\n", b"ply\r"), world=True, errors=True, antialiased=True),
    "full.ply": Format(_read_any_ply, partial(write_ply, full=True), of="ply", antialiased=True),
    "compressed.ply": Format(_read_any_ply, write_compressed_ply, of="ply", antialiased=True),
}
