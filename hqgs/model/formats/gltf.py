"""glTF files with KHR_gaussian_splatting, the extension that Khronos has ratified.

One mesh primitive of points, float32 throughout (integers of others are read): POSITION, ROTATION (x y z w),
SCALE (standard deviations, where drafts had logs), OPACITY (0..1), SH_DEGREE_l_COEF_n. Colours are written as
sRGB; linear ones are converted on reading. glTF has y up and z towards the viewer, here y is down and z
forward: y and z change their sign as in SPZ files, which is exact. Scales and opacities are rounded once by
exp and the sigmoid; an opacity that float32 rounds to 0 or 1 is read a quarter of 2^-24 inwards. Of a scene
whose trust was learned, _HQGS_ERROR is the error of the pixels that a Gaussian shows in.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from hqgs.base.files import atomic_path
from hqgs.model.constants import LEAST_SCALE, MAX_SH_DEGREE
from hqgs.model.formats.arrays import (
    SHARE_STEP,
    TENSORS,
    Arrays,
    Format,
    sound_errors,
    to_logits,
    to_opacities,
    writable,
)
from hqgs.model.formats.spz import FLIP_MEANS, FLIP_QUATS, FLIP_SH, MAX_GAUSSIANS
from hqgs.model.formats.turned import matrices, near_origin, placed, recolored
from hqgs.photos.light import to_srgb
from hqgs.scene.world import World

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

NAME = "KHR_gaussian_splatting"
ERROR = "_HQGS_ERROR"  # glTF keeps names that begin so for applications
MAGIC, VERSION, JSON, BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
FLOAT = 5126
INTEGERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2"}  # which stand for shares where normalized
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
# What is read of what a file may require: materials are not those of Gaussians.
_KNOWN, _OF_MATERIALS = (NAME, "KHR_mesh_quantization"), ("KHR_materials_", "KHR_texture_")
# What a primitive may say, the first where it says nothing. The order along the view and by distance differ
# where Gaussians are as far as large; drafts had other names of colour spaces.
_SAYS = {
    "kernel": ("ellipse",),
    "colorSpace": ("srgb_rec709_display", "BT.709-sRGB", "lin_rec709_display", "BT.709-linear"),
    "projection": ("perspective",),
    "sortingMethod": ("cameraDistance", "zDepth"),
}
_LINEAR = _SAYS["colorSpace"][2:]
Array = NDArray[np.float64]


def write_gltf(path: Path, arrays: Arrays) -> int:
    """Write a .glb file atomically, without rows that hold NaN or Inf; return how many those were."""
    g, left_out = writable(arrays)
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
    primitive = {
        "mode": 0,  # points
        "attributes": {name: k for k, name in enumerate(parts)},
        "extensions": {NAME: {name: allowed[0] for name, allowed in _SAYS.items()}},
    }
    world, node = arrays.get("world", World()), dict[str, Any](mesh=0)
    asset: dict[str, Any] = {"version": "2.0", "generator": "hqgs"}
    if world != World():  # the node places it upright, and what is read again is held as it was
        turn = upright(world.up)
        node |= {"rotation": turn.as_quat().tolist(), "scale": [world.unit] * 3}
        node["translation"] = turn.apply(FLIP_MEANS * world.shift).tolist()
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
    return left_out


def read_gltf(path: Path) -> Arrays:
    """Read all Gaussians of a .glb or .gltf file, where its nodes place them.

    Of several primitives those with fewer harmonics get zeros. A scene that its nodes take far from the
    origin is held around its middle (`world`). A file of ours that another program moved says so in `moved`.

    ValueError: damaged, without Gaussians, or with what is not read here, by name: extensions, kernels, ways
    to project and to sort, colour spaces, integers that are no shares.
    """
    content, buffers = _content(path)
    required = content.get("extensionsRequired", [])
    if needed := [name for name in required if name not in _KNOWN and not name.startswith(_OF_MATERIALS)]:
        raise ValueError(f"it needs extensions that hqgs does not read: {', '.join(needed)}")
    extras = content["asset"].get("extras")
    said = extras.get("hqgs_world") if isinstance(extras, dict) else None
    world = World() if said is None else World.of_json(said)
    notes, parts, maps = list[str](), list[Arrays](), list[Array]()
    left = max(MAX_GAUSSIANS, sum(map(len, buffers)) // 10)  # a stored one takes more than ten bytes
    for number, matrix in _placed_meshes(content):
        for primitive in content["meshes"][number]["primitives"]:
            if NAME in primitive.get("extensions", {}):
                parts.append(_gaussians(content, buffers, primitive, notes))
                maps.append(_in_frame(matrix, world))
                if (left := left - len(parts[-1]["means"])) < 0:
                    raise ValueError(f"its nodes show more than {MAX_GAUSSIANS:,} Gaussians, many again")
    if not parts:
        raise ValueError(f"no primitive with {NAME}")
    still = all(np.array_equal(by, np.eye(4)) for by in maps)
    if not still:
        parts = [placed(part, by, world) for part, by in zip(parts, maps, strict=True)]
    most = max(part["shN"].shape[1] for part in parts)
    for part in parts:
        added = np.zeros((len(part["shN"]), most - part["shN"].shape[1], 3))
        part["shN"] = np.concatenate([part["shN"], added], axis=1, dtype=np.float64)
    named = (*TENSORS, *(["errors"] if all("errors" in part for part in parts) else []))
    found = cast(Arrays, {name: np.concatenate([part[name] for part in parts]) for name in named})
    if said is None or not still:
        found = near_origin(found, replace(world, place=world.place if still else None))
    else:
        found["world"] = world
    if said is not None and not still:
        notes.append("another program moved it: the transform of its node was applied")
        if all(np.array_equal(by, maps[0]) for by in maps):
            found["moved"] = maps[0]
    return {**found, "notes": notes}


def upright(up: tuple[float, float, float] | None) -> Rotation:
    """The least turn that brings up of a scene, with glTF's axes, to their y; none where it is not known."""
    from scipy.spatial.transform import Rotation  # here: to read a scene does not need it

    if up is None:
        return Rotation.identity()
    x, y, z = FLIP_MEANS * up
    if y < -1 + 1e-9:
        return Rotation.from_quat([1.0, 0, 0, 0])
    return Rotation.from_quat([-z, 0.0, x, 1 + y])


def _in_frame(matrix: Array, world: World) -> Array:
    """From where a scene's files had it to where a node has it, [4, 4], in our axes and upright as it was.

    The unit matrix where the node is the one that is written, but for float32 rounding.
    """
    flip, held, turn = np.diag([*FLIP_MEANS, 1.0]), np.diag([*[world.unit] * 3, 1.0]), np.eye(4)
    held[:3, 3] = world.shift
    turn[:3, :3] = upright(world.up).as_matrix()
    own = turn @ flip @ held @ flip
    sizes = np.full(4, world.unit)
    sizes[3] = np.linalg.norm(world.shift)
    if (np.abs(matrix - own) <= 1e-6 * sizes).all():
        return np.eye(4)
    return np.asarray(flip @ turn.T @ matrix @ flip @ np.linalg.inv(held))


def _gaussians(content: Any, buffers: list[bytes], primitive: Any, notes: list[str]) -> Arrays:
    """Those of one primitive, in our axes; adds to `notes` what was converted."""
    extension = primitive["extensions"][NAME]
    if inner := extension.get("extensions"):
        raise ValueError(
            f"its Gaussians need {', '.join(inner)}, which hqgs does not read, such as compression"
        )
    for name, allowed in _SAYS.items():
        if (said := extension.get(name, allowed[0])) not in allowed:
            raise ValueError(f"its {name} is {said!r:.60}, wanted one of: {', '.join(allowed)}")
    attributes = primitive["attributes"]
    count = content["accessors"][attributes["POSITION"]]["count"]
    higher = sum(name.startswith(f"{NAME}:SH_DEGREE_") for name in attributes) - 1
    degree = math.isqrt(higher + 1) - 1 if higher >= 0 else -1
    if not 0 <= degree <= MAX_SH_DEGREE or (degree + 1) ** 2 - 1 != higher:
        raise ValueError(f"{higher + 1} coefficients of harmonics, wanted 1, 4, 9 or 16")
    if type(count) is not int or count < 0:
        raise ValueError(f"a count of {count!r:.40}")

    def values(name: str, kind: str, whole: bool = False) -> Array:
        return _values(content, buffers, attributes[name], kind, count, whole).astype(np.float64)

    means, scales = values("POSITION", "VEC3", True), values(f"{NAME}:SCALE", "VEC3", True)
    if (scales < 0).any():
        raise ValueError(f"a scale is below 0; drafts of {NAME} had logs there")
    rest = [FLIP_SH[k] * values(_harmonic(k), "VEC3") for k in range(higher)]
    found: Arrays = {
        "means": FLIP_MEANS * means,
        "scales": np.log(np.maximum(scales, LEAST_SCALE)),
        "quats": np.roll(FLIP_QUATS * values(f"{NAME}:ROTATION", "VEC4"), 1, axis=1),
        "opacities": to_logits(values(f"{NAME}:OPACITY", "SCALAR")[:, 0], SHARE_STEP),
        "sh0": values(f"{NAME}:SH_DEGREE_0_COEF_0", "VEC3")[:, None],
        "shN": np.stack(rest, axis=1) if rest else np.zeros((count, 0, 3)),
    }
    if ERROR in attributes:
        found["errors"] = sound_errors(values(ERROR, "SCALAR")[:, 0])
    if (space := extension.get("colorSpace")) in _LINEAR:
        found = recolored(found, to_srgb)
        told = f"its colours are linear ({space}): those of each Gaussian were converted to sRGB"
    else:
        told = "" if space else "it names no colour space: its colours were read as sRGB"
    notes += [told] if told and told not in notes else []
    return found


def _harmonic(k: int) -> str:
    """The attribute of the k-th of the higher harmonics."""
    degree = math.isqrt(k + 1)
    return f"{NAME}:SH_DEGREE_{degree}_COEF_{k + 1 - degree * degree}"


def _values(
    content: Any, buffers: list[bytes], number: int, kind: str, count: int, whole: bool = False
) -> NDArray[np.float32]:
    """Of an accessor, [count, width]; integers stand for shares, or if `whole` for themselves."""
    accessor = content["accessors"][number]
    view = content["bufferViews"][accessor["bufferView"]]
    shares = accessor.get("normalized") is True
    stored = "<f4" if accessor["componentType"] == FLOAT else None
    if shares or (whole and stored is None):
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
    if stored != "<f4" and shares:
        values = np.maximum(values / np.float32(np.iinfo(stored).max), -1)
    if not np.isfinite(values).all():
        raise ValueError(f"accessor {number} holds NaN or Inf")
    return values


def _content(path: Path) -> tuple[Any, list[bytes]]:
    """The JSON text of a .glb or .gltf file and its buffers. ValueError where it is damaged, or a buffer is
    not in its folder."""
    file, own = path.read_bytes(), None
    if file[:4] == MAGIC.to_bytes(4, "little"):
        text, own = _chunks(file)
    elif (text := file).lstrip()[:1] != b"{":
        raise ValueError("not a glTF file")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"damaged: its text is not valid JSON: {error}") from error
    if not isinstance(content, dict) or "asset" not in content:
        raise ValueError("not a glTF file")
    buffers = list[bytes]()
    for number, buffer in enumerate(content.get("buffers", [])):
        if "uri" in buffer:
            buffers.append(_outside(path, buffer["uri"]))
        elif own is not None and number == 0:
            buffers.append(own)
        else:
            raise ValueError(f"damaged: buffer {number} is missing")
    return content, buffers


def _outside(path: Path, uri: str) -> bytes:
    if uri.startswith("data:"):
        head, _, data = uri.partition(",")
        if not head.endswith(";base64"):
            raise ValueError(f"a buffer is not base64 data: {uri[:40]!r}")
        return base64.b64decode(data, validate=True)
    name = unquote(uri).replace("\\", "/")
    file = (path.parent / name).resolve()
    if "\0" in name or not file.is_relative_to(path.parent.resolve()):
        raise ValueError(f"the buffer {uri!r:.80} is outside of the folder")
    if not file.is_file():
        raise ValueError(f"the buffer {uri!r:.80} is missing: it belongs beside the file")
    return file.read_bytes()


def _chunks(file: bytes) -> tuple[bytes, bytes]:
    """Text and data of a .glb file."""
    if len(file) < 20 or struct.unpack_from("<II", file) != (MAGIC, VERSION):
        raise ValueError("not a binary glTF file of version 2")
    parts, at = list[bytes](), 12
    for kind, what in ((JSON, "text"), (BIN, "data")):
        if kind == BIN and at + 8 > len(file):
            return parts[0], b""
        size, found = struct.unpack_from("<II", file, at)
        if found != kind or at + 8 + size > len(file):
            raise ValueError(f"damaged: its {what} ends beyond the file")
        parts.append(file[at + 8 : at + 8 + size])
        at += 8 + size
    return parts[0], parts[1]


def _placed_meshes(content: Any) -> Iterator[tuple[int, Array]]:
    """Meshes of the scene that is shown, in its nodes' order, each with its map [4, 4].

    Without nodes each mesh is where its numbers are. ValueError where nodes are no tree.
    """
    nodes = content.get("nodes")
    if not nodes:
        yield from ((number, np.eye(4)) for number in range(len(content["meshes"])))
        return
    scenes = content.get("scenes")
    if scenes:
        roots = scenes[content.get("scene", 0)].get("nodes", [])
    else:
        inner = {child for node in nodes for child in node.get("children", [])}
        roots = [k for k in range(len(nodes)) if k not in inner]
    waiting = [(k, np.eye(4), 0) for k in reversed(roots)]
    visited = 0
    while waiting:
        number, above, depth = waiting.pop()
        visited += 1
        if depth > 100 or visited > 100_000:
            raise ValueError("its nodes do not form a tree")
        node = nodes[number]
        here = above @ _matrix(node)
        if "mesh" in node:
            yield node["mesh"], here
        waiting += [(k, here, depth + 1) for k in reversed(node.get("children", []))]


def _matrix(node: Any) -> Array:
    try:
        found = np.array(node.get("matrix", np.eye(4)), np.float64).reshape(4, 4).T  # columns first
        if "matrix" not in node:
            quat = np.roll(np.array(node.get("rotation", [0, 0, 0, 1]), np.float64), 1)  # w first
            found[:3, :3] = matrices(quat[None])[0] * np.array(node.get("scale", [1, 1, 1]), np.float64)
            found[:3, 3] = np.array(node.get("translation", [0, 0, 0]), np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (4, 4) or not np.isfinite(found).all() or not np.array_equal(found[3], [0, 0, 0, 1]):
        raise ValueError(f"a node has no valid transform: {node!r:.80}")
    return found


FORMATS = {
    "glb": Format(read_gltf, write_gltf, (b"glTF",), world=True, errors=True),
    "gltf": Format(read_gltf, world=True),
}
