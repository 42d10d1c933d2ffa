"""What of a glTF file is read: its JSON text and buffers, and the maps of its nodes."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from hqgs.model.formats.turned import matrices

MAGIC, VERSION, JSON, BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
DEEPEST, MOST = 100, 100_000  # nodes below each other, and in all
Array = NDArray[np.float64]


def content_of(path: Path) -> tuple[Any, list[bytes]]:
    """The JSON text of a .glb or .gltf file and its buffers. ValueError, which names it, where it is damaged
    or a buffer is not in its folder."""
    file = path.read_bytes()
    if file[:4] == MAGIC.to_bytes(4, "little"):
        content, own = _chunks(path, file)
    else:
        content, own = _json(path, file), None
    buffers = list[bytes]()
    try:
        for number, buffer in enumerate(content.get("buffers", [])):
            if "uri" in buffer:
                buffers.append(_outside(path, buffer["uri"]))
            elif own is not None and number == 0:
                buffers.append(own)
            else:
                raise ValueError(f"buffer {number} is nowhere")
    except (TypeError, AttributeError, ValueError, OSError) as error:
        raise ValueError(f"{path}: damaged: {error}") from error
    return content, buffers


def _outside(path: Path, uri: str) -> bytes:
    if uri.startswith("data:"):
        head, _, data = uri.partition(",")
        if not head.endswith(";base64"):
            raise ValueError(f"a buffer is no base64 data: {uri[:40]!r}")
        return base64.b64decode(data, validate=True)
    name = unquote(uri).replace("\\", "/")
    file = (path.parent / name).resolve()
    if "\0" in name or not file.is_relative_to(path.parent.resolve()):
        raise ValueError(f"the buffer {uri!r:.80} leaves the folder")
    if not file.is_file():
        raise ValueError(f"the buffer {uri!r:.80} is not there: it belongs beside the file")
    return file.read_bytes()


def _json(path: Path, text: bytes) -> Any:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        what = "not a glTF file" if not text.lstrip().startswith(b"{") else "damaged"
        raise ValueError(f"{path}: {what}: its text is not valid JSON: {error}") from error
    if not isinstance(content, dict) or "asset" not in content:
        raise ValueError(f"{path}: not a glTF file")
    return content


def _chunks(path: Path, file: bytes) -> tuple[Any, bytes]:
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


def placed_meshes(content: Any) -> Iterator[tuple[int, Array]]:
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
        if depth > DEEPEST or visited > MOST:
            raise ValueError("its nodes are no tree")
        node = nodes[number]
        here = above @ _matrix(node)
        if "mesh" in node:
            yield node["mesh"], here
        waiting += [(k, here, depth + 1) for k in reversed(node.get("children", []))]


def _matrix(node: Any) -> Array:
    if "matrix" in node:
        found = np.array(node["matrix"], np.float64).reshape(4, 4).T  # columns first
    else:
        quat = np.roll(np.array(node.get("rotation", [0, 0, 0, 1]), np.float64), 1)  # w first
        turn = matrices(quat[None])[0]
        found = np.eye(4)
        found[:3, :3] = turn * np.array(node.get("scale", [1, 1, 1]), np.float64)
        found[:3, 3] = np.array(node.get("translation", [0, 0, 0]), np.float64)
    if found.shape != (4, 4) or not np.isfinite(found).all() or not np.array_equal(found[3], [0, 0, 0, 1]):
        raise ValueError(f"a node has no map of space: {node!r:.80}")
    return found
