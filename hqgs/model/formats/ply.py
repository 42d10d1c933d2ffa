"""PLY files in the layout of 3DGS, which the common viewers read.

One vertex per Gaussian, float32: x y z, f_dc_0..2, f_rest_* (all red coefficients, then green, then blue; 0,
9, 24 or 45 of them for the SH degrees 0 to 3), opacity (logit), scale_0..2 (log), rot_0..3 (w x y z). Readers
find columns by their names; the normals of 3DGS, which are all zero, are not written (nor does gsplat).
Where trust was learned, hqgs_error is the error of the pixels that a Gaussian shows in, 0 to 1 (white).
What it says of itself stands in comments of its header (`ply_comments.py`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from hqgs.base.files import atomic_path
from hqgs.base.ply import bytes_after, header_of, read_vertices
from hqgs.model.constants import MAX_SH_DEGREE
from hqgs.model.formats.arrays import (
    SHARE_STEP,
    Arrays,
    Format,
    of_colors,
    pick,
    sound_errors,
    to_logits,
    whole_rows,
)
from hqgs.model.formats.compressed_ply import read_compressed_ply, write_compressed_ply
from hqgs.model.formats.ply_comments import OURS, comments_of, told_by
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
        why = (
            "; it holds only points, from which `hqgs train` makes a scene, with their photos"
            if points
            else ""
        )
        raise ValueError(f"not a 3DGS scene, these properties are missing: {', '.join(missing)}{why}")
    rest = sum(name.startswith("f_rest_") for name in wanted)
    if rest not in [*_REST_COUNTS, _REST_4]:
        raise ValueError(f"{rest} f_rest_* properties, wanted one of {_REST_COUNTS}")


def _plain_colors(vertices: NDArray[Any]) -> NDArray[np.float64]:
    """The harmonics of degree 0 [N, 1, 3] of plain colours: bytes, or numbers where 1 is white."""
    colors = np.stack([vertices[name] for name in _COLORS], -1)
    return of_colors(colors / (255.0 if colors.dtype.kind in "ui" else 1.0))


def _read_any_ply(path: Path) -> Arrays:
    lines = header_of(path).lines
    packed = any("packed_position" in line for line in lines if "property" in line)
    return read_compressed_ply(path) if packed else read_ply(path)


FORMATS = {
    "ply": Format(_read_any_ply, write_ply, (b"ply\n", b"ply\r"), world=True, errors=True, antialiased=True),
    "full.ply": Format(_read_any_ply, partial(write_ply, full=True), of="ply", antialiased=True),
    "compressed.ply": Format(_read_any_ply, write_compressed_ply, of="ply", antialiased=True),
}
