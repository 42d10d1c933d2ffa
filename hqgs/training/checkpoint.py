"""Checkpoints: all that a run needs to go on, in one safetensors file."""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from hqgs.base.files import atomic_path
from hqgs.scene.scene import Scene
from hqgs.training.config import LENGTHS, Due

FORMAT = 8  # raised when a newer reader could not use an older file
FREE_FIELDS = ("eval_every", "checkpoint_every")  # may differ on resume: they do not change the result


def save_checkpoint(path: str | Path, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
    """Write tensors and JSON values as one file, atomically. OSError names the path (a full disk)."""
    path = Path(path)
    contiguous = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
    text = json.dumps(meta, allow_nan=False)
    header = {"format": str(FORMAT), "meta": text, "crc32": str(checksum(contiguous, text))}
    try:
        with atomic_path(path) as tmp:
            save_file(contiguous, tmp, metadata=header)
    except (OSError, SafetensorError) as error:  # the library reports a full disk as its own error
        raise OSError(f"cannot write the checkpoint {path}: {error}") from error


def load_checkpoint(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_checkpoint` wrote: tensors (fresh copies) and JSON values.

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, cut off, or of another format. The message names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no checkpoint {path}")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"the checkpoint {path} is damaged: {error}") from error
    if header.get("format") != str(FORMAT) or "meta" not in header:
        raise ValueError(
            f"{path} is not a checkpoint of this version: format {header.get('format')}, wanted {FORMAT}"
        )
    if header.get("crc32") != str(checksum(tensors, header["meta"])):
        raise ValueError(f"the checkpoint {path} is damaged: its checksum does not match")
    try:
        meta = json.loads(header["meta"])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the checkpoint {path} is damaged: {error}") from error
    if not isinstance(meta, dict):
        raise ValueError(f"the checkpoint {path} is damaged: its values are not a JSON object")
    return tensors, meta


def part(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """The tensors whose names start with `prefix`, without it."""
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}


OTHER = {  # what is other where a part of the fingerprint is
    "views": "its photos had other names, or others were held out (--test-every)",
    "cameras": "its photos had another size (--downscale, --preset) or other poses (--sfm)",
    "photos": "its photos had other pixels (--degrade, --restore, --downscale)",
    "low": "its photos had other pixels (--degrade, --restore, --downscale)",
    "masks": "its photos had other masks",
    "points": "it began with other points (--sfm)",
}


def check_same(
    path: str | Path, prefix: str, saved: dict[str, Any], here: dict[str, Any], longer: bool = False
) -> None:
    """ValueError for the first field that differs; nested fields are named with dots.

    `longer`: this run goes on where the saved one ended, so that the fields of its length may differ.
    """
    free = {*LENGTHS, *Due._fields, "leave_out"} if longer else {*FREE_FIELDS}
    if not isinstance(saved, dict):
        raise ValueError(f"{path} is damaged: {prefix or 'config'} is {saved!r:.80}")
    for name in here | saved:
        old, new = saved.get(name), here.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            check_same(path, f"{prefix}{name}.", old, new, longer)
        elif old != new and name not in free:
            raise ValueError(
                f"{path} was made with another {prefix}{name}: {old!r} there, {new!r} in this run; "
                "use the same one, or another folder"
            )


def check_scene(path: str | Path, saved: object, scene: Scene) -> None:
    """ValueError, in the words of the options, where a fingerprint is not that of the scene."""
    if not isinstance(saved, dict):
        raise ValueError(f"{path} is damaged: scene is {saved!r:.80}")
    here = scene_fingerprint(scene)
    for name in here | saved:
        if saved.get(name) != here.get(name):
            why = OTHER.get(name, f"it had {name}")
            raise ValueError(f"{path} is of another scene: {why}; ask for the same, or for another folder")


def scene_fingerprint(scene: Scene) -> dict[str, str]:
    """Digests of what a run reads of a scene, each under the name of what it covers.

    The same on every machine: cameras count to 1e-9 and to float32, since linear algebra rounds by CPU.
    """

    def digest(arrays: Iterable[NDArray[Any]]) -> str:
        sha = hashlib.sha256()
        for array in arrays:
            sha.update(f"{array.dtype} {array.shape}".encode())
            sha.update(np.ascontiguousarray(array).data)
        return sha.hexdigest()[:16]

    views = [*scene.train, *scene.test]
    names = "\n".join([*(v.name for v in scene.train), "", *(v.name for v in scene.test)])
    return {
        "views": hashlib.sha256(names.encode()).hexdigest()[:16],
        "cameras": digest(
            np.round(array, 9).astype(np.float32) + 0.0  # -0 becomes 0
            for v in views
            for array in (v.camera.K, v.camera.viewmat)
        ),
        "photos": digest(v.image for v in views),
        "low": digest(v.low for v in views if v.low is not None),
        "masks": digest(v.mask for v in views if v.mask is not None),
        "points": digest([scene.points, scene.point_colors]),
    }


def checksum(tensors: dict[str, Tensor], text: str = "") -> int:
    """Of a text and of each tensor's name, type, shape and bytes."""
    crc = zlib.crc32(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().contiguous()
        crc = zlib.crc32(f"{name} {tensor.dtype} {list(tensor.shape)}".encode(), crc)
        crc = zlib.crc32(tensor.reshape(-1).view(torch.uint8).numpy().data, crc)
    return crc
