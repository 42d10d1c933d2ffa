"""Binary glTF files with KHR_gaussian_splatting, the extension that Khronos has ratified.

One mesh primitive of points, float32 throughout: POSITION, ROTATION (x y z w), SCALE (standard deviations,
where drafts had logs), OPACITY (0..1), SH_DEGREE_l_COEF_n. glTF has y up and z towards the viewer, here y is
down and z forward: y and z change their sign as in SPZ files, which is exact. Scales and opacities are
rounded once by exp and the sigmoid; an opacity that float32 rounds to 0 or 1 is read a quarter of 2^-24
inwards.
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.base.files import atomic_path
from hqgs.model.constants import MAX_SH_DEGREE
from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.rows import finite_rows, pick, to_logits, to_opacities
from hqgs.model.formats.spz import FLIP_MEANS, FLIP_QUATS, FLIP_SH

NAME = "KHR_gaussian_splatting"
MAGIC, VERSION, JSON, BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
FLOAT, POINTS = 5126, 0
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
SMALLEST = 1e-30  # a scale of 0 has no log
STEP = 2.0**-24  # of opacities near 1


def write_gltf(path: str | Path, arrays: Arrays) -> int:
    """Write a .glb file atomically, without rows that hold NaN or Inf; return how many those were."""
    finite = finite_rows(arrays)
    g = pick(arrays, finite)
    quats = g["quats"].astype(np.float64)
    quats = np.roll(quats / np.linalg.norm(quats, axis=1, keepdims=True), -1, axis=1)
    higher = g["shN"].shape[1]
    parts: dict[str, NDArray[Any]] = {
        "POSITION": FLIP_MEANS * g["means"],
        f"{NAME}:ROTATION": FLIP_QUATS * quats,
        f"{NAME}:SCALE": np.exp(g["scales"].astype(np.float64).clip(-87, 88)),
        f"{NAME}:OPACITY": to_opacities(g["opacities"])[:, None],
        f"{NAME}:SH_DEGREE_0_COEF_0": g["sh0"][:, 0],
    }
    for k in range(higher):
        parts[_harmonic(k)] = FLIP_SH[k] * g["shN"][:, k]
    kinds = {width: kind for kind, width in WIDTHS.items()}
    binary, views, accessors = [], [], list[dict[str, Any]]()
    at = 0
    for name, values in parts.items():
        stored = np.ascontiguousarray(values, "<f4")
        accessor = {"bufferView": len(views), "componentType": FLOAT, "count": len(stored)}
        accessor |= {"type": kinds[stored.shape[1]]}
        if name == "POSITION" and len(stored):
            accessor |= {"min": stored.min(axis=0).tolist(), "max": stored.max(axis=0).tolist()}
        views.append({"buffer": 0, "byteOffset": at, "byteLength": stored.nbytes, "target": 34962})
        accessors.append(accessor)
        binary.append(stored.tobytes())
        at += stored.nbytes
    settings = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    settings |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive = {
        "mode": POINTS,
        "attributes": {name: k for k, name in enumerate(parts)},
        "extensions": {NAME: settings},
    }
    content = {
        "asset": {"version": "2.0", "generator": "hqgs"},
        "extensionsUsed": [NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    with atomic_path(path) as tmp, tmp.open("wb") as file:
        file.write(struct.pack("<III", MAGIC, VERSION, 12 + 8 + len(text) + 8 + at))
        file.write(struct.pack("<II", len(text), JSON) + text + struct.pack("<II", at, BIN))
        file.writelines(binary)
    return int(len(finite) - finite.sum())


def read_gltf(path: str | Path) -> Arrays:
    """Read a .glb file with one primitive of Gaussians: float32 arrays.

    Raises FileNotFoundError, or ValueError that names the file: damaged, without Gaussians, or with what is
    not read here: several primitives, integers, compression, a node that moves or turns them.
    """
    path = Path(path)
    content, data = _chunks(path)
    try:
        primitive = _primitive(content)
        attributes, count = (
            primitive["attributes"],
            content["accessors"][primitive["attributes"]["POSITION"]]["count"],
        )
        higher = sum(name.startswith(f"{NAME}:SH_DEGREE_") for name in attributes) - 1
        degree = math.isqrt(higher + 1) - 1 if higher >= 0 else -1
        if not 0 <= degree <= MAX_SH_DEGREE or (degree + 1) ** 2 - 1 != higher:
            raise ValueError(f"{higher + 1} coefficients of harmonics, wanted 1, 4, 9 or 16")
        if type(count) is not int or count < 0:
            raise ValueError(f"a count of {count!r:.40}")

        def values(name: str, kind: str) -> NDArray[np.float64]:
            return _values(content, data, attributes[name], kind, count).astype(np.float64)

        means = values("POSITION", "VEC3")
        quats = values(f"{NAME}:ROTATION", "VEC4")
        scales = values(f"{NAME}:SCALE", "VEC3")
        opacities = values(f"{NAME}:OPACITY", "SCALAR")[:, 0]
        sh0 = values(f"{NAME}:SH_DEGREE_0_COEF_0", "VEC3")
        rest = [FLIP_SH[k] * values(_harmonic(k), "VEC3") for k in range(higher)]
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError, ValueError) as error:
        raise ValueError(f"{path}: no Gaussians that can be read: {error!r:.160}") from error
    shN = np.stack(rest, axis=1) if rest else np.zeros((count, 0, 3))
    if (scales < 0).any():
        raise ValueError(f"{path}: a scale is below 0; drafts of {NAME} had logs there")
    return {
        "means": (FLIP_MEANS * means).astype(np.float32),
        "scales": np.log(np.maximum(scales, SMALLEST)).astype(np.float32),
        "quats": np.roll(FLIP_QUATS * quats, 1, axis=1).astype(np.float32),
        "opacities": to_logits(opacities, STEP),
        "sh0": sh0[:, None].astype(np.float32),
        "shN": shN.astype(np.float32),
    }


def _harmonic(k: int) -> str:
    """The attribute of the k-th of the higher harmonics."""
    degree = math.isqrt(k + 1)
    return f"{NAME}:SH_DEGREE_{degree}_COEF_{k + 1 - degree * degree}"


def _chunks(path: Path) -> tuple[Any, bytes]:
    file = path.read_bytes()
    if len(file) < 20 or struct.unpack_from("<II", file) != (MAGIC, VERSION):
        raise ValueError(f"{path}: not a binary glTF file of version 2")
    size, kind = struct.unpack_from("<II", file, 12)
    if kind != JSON or 20 + size > len(file):
        raise ValueError(f"{path}: damaged: its text ends beyond the file")
    try:
        content = json.loads(file[20 : 20 + size])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: damaged: its text is not valid JSON: {error}") from error
    at = 20 + size
    if at + 8 > len(file):
        return content, b""
    size, kind = struct.unpack_from("<II", file, at)
    if kind != BIN or at + 8 + size > len(file):
        raise ValueError(f"{path}: damaged: its data ends beyond the file")
    return content, file[at + 8 : at + 8 + size]


def _primitive(content: Any) -> Any:
    found = [
        (number, primitive)
        for number, mesh in enumerate(content["meshes"])
        for primitive in mesh["primitives"]
        if NAME in primitive.get("extensions", {})
    ]
    if len(found) != 1:
        raise ValueError(f"{len(found)} primitives with {NAME}, wanted one")
    if "extensions" in found[0][1]["extensions"][NAME]:
        raise ValueError("a compressed primitive")
    moved = {"matrix", "translation", "rotation", "scale"}
    if any(moved & node.keys() for node in content.get("nodes", [])):
        raise ValueError("a node that moves, turns or scales it")
    return found[0][1]


def _values(content: Any, data: bytes, number: int, kind: str, count: int) -> NDArray[np.float32]:
    accessor = content["accessors"][number]
    view = content["bufferViews"][accessor["bufferView"]]
    if (accessor["componentType"], accessor["type"]) != (FLOAT, kind) or "sparse" in accessor:
        raise ValueError(f"accessor {number} is not float32 {kind}")
    width = WIDTHS[kind]
    if accessor["count"] != count or view.get("byteStride", 4 * width) != 4 * width or view["buffer"] != 0:
        raise ValueError(f"accessor {number} has another count or stride, or another buffer")
    start, offset, length = view.get("byteOffset", 0), accessor.get("byteOffset", 0), view["byteLength"]
    sound = all(type(value) is int and value >= 0 for value in (start, offset, length))
    if not sound or offset + 4 * width * count > length or start + length > len(data):
        raise ValueError(f"accessor {number} reaches beyond the data")
    values = np.frombuffer(data, "<f4", width * count, start + offset).reshape(count, width)
    if not np.isfinite(values).all():
        raise ValueError(f"accessor {number} holds NaN or Inf")
    return values
