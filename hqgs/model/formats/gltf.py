"""glTF files with KHR_gaussian_splatting, the extension that Khronos has ratified.

One mesh primitive of points, float32 throughout (normalized integers of others are read): POSITION, ROTATION
(x y z w), SCALE (standard deviations, where drafts had logs), OPACITY (0..1), SH_DEGREE_l_COEF_n.
glTF has y up and z towards the viewer, here y is down and z forward: y and z change their sign as in SPZ
files, which is exact. Scales and opacities are rounded once by exp and the sigmoid; an opacity that float32
rounds to 0 or 1 is read a quarter of 2^-24 inwards. Of a scene whose trust was learned, _HQGS_ERROR is the
error of the pixels that a Gaussian shows in.
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from hqgs.base.files import atomic_path
from hqgs.model.constants import LEAST_SCALE, MAX_SH_DEGREE
from hqgs.model.formats.arrays import Arrays, Floats
from hqgs.model.formats.gltf_nodes import BIN, JSON, MAGIC, VERSION, content_of, placed_meshes
from hqgs.model.formats.rows import SHARE_STEP, finite_rows, pick, sound_errors, to_logits, to_opacities
from hqgs.model.formats.spz import FLIP_MEANS, FLIP_QUATS, FLIP_SH
from hqgs.model.formats.turned import mapped
from hqgs.scene.world import World, world_for

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

NAME = "KHR_gaussian_splatting"
ERROR = "_HQGS_ERROR"  # glTF keeps names that begin so for applications
FLOAT, POINTS = 5126, 0
INTEGERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2"}  # which stand for shares where normalized
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


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
    if "errors" in g:
        parts[ERROR] = g["errors"][:, None]
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
    world, node = arrays.get("world", World()), dict[str, Any](mesh=0)
    asset: dict[str, Any] = {"version": "2.0", "generator": "hqgs"}
    if world != World():  # the node places it upright, and what is read again is held as it was
        shift, turn = FLIP_MEANS * world.shift, upright(world.up)
        node |= {"translation": turn.apply(shift).tolist(), "rotation": turn.as_quat().tolist()}
        node |= {"scale": [world.unit] * 3}
        asset["extras"] = {"hqgs_world": world.json()}
    content = {
        "asset": asset,
        "extensionsUsed": [NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
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
    """Read all Gaussians of a .glb or .gltf file, where its nodes place them: float32 arrays.

    Of several primitives those with fewer harmonics get zeros. A scene that its nodes take far from the
    origin is held around its middle (`world`).

    Raises FileNotFoundError, or ValueError that names the file: damaged, without Gaussians, or with what is
    not read here: integers, compression.
    """
    path = Path(path)
    content, buffers = content_of(path)
    try:
        extras = content["asset"].get("extras")
        said = extras.get("hqgs_world") if isinstance(extras, dict) else None
        world = World() if said is None else World.of_json(said)
        parts = [
            _placed(_gaussians(content, buffers, primitive), matrix, placed=said is None)
            for number, matrix in placed_meshes(content)
            for primitive in content["meshes"][number]["primitives"]
            if NAME in primitive.get("extensions", {})
        ]
        if not parts:
            raise ValueError(f"no primitive with {NAME}")
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError, ValueError) as error:
        raise ValueError(f"{path}: no Gaussians that can be read: {error!r:.160}") from error
    most = max(part["shN"].shape[1] for part in parts)
    means = np.concatenate([part["means"] for part in parts])
    if said is None and len(means):
        world = World(1.0, world_for(means, means).shift)
        means = world.into(means)
    whole = {
        name: np.concatenate([part[name] for part in parts]).astype(np.float32)
        for name in ("scales", "quats", "opacities", "sh0")
    }
    shN = np.concatenate([_widened(part["shN"], most) for part in parts])
    found = cast(Arrays, {"means": means.astype(np.float32), **whole, "shN": shN})
    if all("errors" in part for part in parts):
        found["errors"] = np.concatenate([part["errors"] for part in parts if "errors" in part])
    if world != World():
        found["world"] = world
    return found


def upright(up: tuple[float, float, float] | None) -> Rotation:
    """The least turn that brings up of a scene, with glTF's axes, to their y; none where it is not known."""
    from scipy.spatial.transform import Rotation  # here: to read a scene does not need it

    if up is None:
        return Rotation.identity()
    x, y, z = FLIP_MEANS * up
    if y < -1 + 1e-9:
        return Rotation.from_quat([1.0, 0, 0, 0])
    return Rotation.from_quat([-z, 0.0, x, 1 + y])


def _widened(harmonics: Floats, most: int) -> NDArray[np.float32]:
    """With zeros up to so many coefficients."""
    return np.pad(harmonics.astype(np.float32), ((0, 0), (0, most - harmonics.shape[1]), (0, 0)))


def _placed(arrays: Arrays, matrix: NDArray[np.float64], *, placed: bool) -> Arrays:
    """The Gaussians where a node has them, in our axes; as they are where the file says the frame itself."""
    if not placed or np.array_equal(matrix, np.eye(4)):
        return arrays
    flip = np.diag(FLIP_MEANS)
    return mapped(arrays, flip @ matrix[:3, :3] @ flip, flip @ matrix[:3, 3])


def _gaussians(content: Any, buffers: list[bytes], primitive: Any) -> Arrays:
    """Those of one primitive, in our axes; means are float64."""
    if "extensions" in primitive["extensions"][NAME]:
        raise ValueError("a compressed primitive")
    attributes = primitive["attributes"]
    count = content["accessors"][attributes["POSITION"]]["count"]
    higher = sum(name.startswith(f"{NAME}:SH_DEGREE_") for name in attributes) - 1
    degree = math.isqrt(higher + 1) - 1 if higher >= 0 else -1
    if not 0 <= degree <= MAX_SH_DEGREE or (degree + 1) ** 2 - 1 != higher:
        raise ValueError(f"{higher + 1} coefficients of harmonics, wanted 1, 4, 9 or 16")
    if type(count) is not int or count < 0:
        raise ValueError(f"a count of {count!r:.40}")

    def values(name: str, kind: str) -> NDArray[np.float64]:
        return _values(content, buffers, attributes[name], kind, count).astype(np.float64)

    means, scales = values("POSITION", "VEC3"), values(f"{NAME}:SCALE", "VEC3")
    if (scales < 0).any():
        raise ValueError(f"a scale is below 0; drafts of {NAME} had logs there")
    rest = [FLIP_SH[k] * values(_harmonic(k), "VEC3") for k in range(higher)]
    found: Arrays = {
        "means": FLIP_MEANS * means,
        "scales": np.log(np.maximum(scales, LEAST_SCALE)).astype(np.float32),
        "quats": np.roll(FLIP_QUATS * values(f"{NAME}:ROTATION", "VEC4"), 1, axis=1).astype(np.float32),
        "opacities": to_logits(values(f"{NAME}:OPACITY", "SCALAR")[:, 0], SHARE_STEP),
        "sh0": values(f"{NAME}:SH_DEGREE_0_COEF_0", "VEC3")[:, None].astype(np.float32),
        "shN": (np.stack(rest, axis=1) if rest else np.zeros((count, 0, 3))).astype(np.float32),
    }
    if ERROR in attributes:
        found["errors"] = sound_errors(values(ERROR, "SCALAR")[:, 0])
    return found


def _harmonic(k: int) -> str:
    """The attribute of the k-th of the higher harmonics."""
    degree = math.isqrt(k + 1)
    return f"{NAME}:SH_DEGREE_{degree}_COEF_{k + 1 - degree * degree}"


def _values(content: Any, buffers: list[bytes], number: int, kind: str, count: int) -> NDArray[np.float32]:
    accessor = content["accessors"][number]
    view = content["bufferViews"][accessor["bufferView"]]
    stored = "<f4" if accessor["componentType"] == FLOAT else None
    if accessor.get("normalized") is True:
        stored = INTEGERS.get(accessor["componentType"])
    if stored is None or accessor["type"] != kind or "sparse" in accessor:
        raise ValueError(f"accessor {number} is not {kind} of float32 or normalized integers")
    width, data, size = WIDTHS[kind], buffers[view["buffer"]], np.dtype(stored).itemsize
    stride = view.get("byteStride", size * width)
    start, offset, length = view.get("byteOffset", 0), accessor.get("byteOffset", 0), view["byteLength"]
    sound = all(type(value) is int and value >= 0 for value in (start, offset, length, stride))
    if accessor["count"] != count or (sound and stride < size * width):
        raise ValueError(f"accessor {number} has another count or stride")
    end = offset + stride * (count - 1) + size * width if count else 0
    if not sound or end > length or start + length > len(data):
        raise ValueError(f"accessor {number} reaches beyond the data")
    raw = np.ndarray((count, width), stored, data, start + offset, (stride, size))
    values = raw.astype(np.float32)
    if stored != "<f4":
        values = np.maximum(values / np.float32(np.iinfo(stored).max), -1)
    if not np.isfinite(values).all():
        raise ValueError(f"accessor {number} holds NaN or Inf")
    return values
