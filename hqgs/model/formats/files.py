"""The formats of scene files, and which one a file has: by what it holds, whatever its suffix says."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hqgs.base.files import PLY
from hqgs.model.formats import gltf, ply, sog, splat, spz
from hqgs.model.formats.arrays import TENSORS, Arrays, Format
from hqgs.model.formats.beside import in_data_frame, keep_world, read_world
from hqgs.photos.files import DECODE_ERRORS
from hqgs.scene.photo_files import is_run
from hqgs.scene.world import World

# By the ends of their files' names; where two fit, the longer counts.
FORMATS: dict[str, Format] = {
    name: row for module in (ply, spz, splat, gltf, sog) for name, row in module.FORMATS.items()
}
WRITTEN = [name for name, row in FORMATS.items() if row.write is not None]
DAMAGED = (
    *DECODE_ERRORS,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    zipfile.BadZipFile,
    zlib.error,
)
_PAGES = (b"<!doctype", b"<html", b"<?xml")
_NOT = "not a scene file, but"


def read_scene(path: Path, format: str) -> Arrays:
    """What a scene file holds, float32, in the frame that it or a file beside it says.

    Raises FileNotFoundError, or ValueError that names the file.
    """
    try:
        arrays = in_data_frame(path, FORMATS[format].read(path))
    except DAMAGED as error:
        if isinstance(error, FileNotFoundError) and not path.exists():
            raise
        told = str(error)
        if type(error) is not ValueError:
            told = f"not a readable {FORMATS[format].of or format} file: {error!r:.200}"
        raise ValueError(told if str(path.parent) in told else f"{path}: {told}") from error
    for name in TENSORS:
        with np.errstate(over="ignore"):
            arrays[name] = np.ascontiguousarray(arrays[name], np.float32)
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{path}: {name} are not finite in float32")
    if arrays.get("world", World()) == World():
        arrays["world"] = read_world(path)
    return arrays


def write_scene(path: Path, arrays: Arrays, format: str) -> int:
    """Write a scene file, and its frame beside it where the format has no place for that."""
    write = FORMATS[format].write
    assert write is not None
    try:
        left_out = write(path, arrays)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    keep_world(path, World() if FORMATS[format].world else arrays.get("world", World()))
    return left_out


def has_format(path: Path) -> bool:
    """Whether the name of a file, or what it holds, says a format that is read."""
    return bool(_fitting(path, [*FORMATS])) or format_held(path) is not None


def _fitting(path: Path, known: Sequence[str]) -> list[str]:
    lower = path.name.lower()
    return [format for format in known if lower.endswith(f".{format}") or lower == format]


def format_of(path: Path, name: str | None = None, *, written: bool = False) -> str:
    """The format of that name, or the one that the file holds, or its suffix says.

    ValueError where there is none, or, of a file that is to be `written`, where it is only read.
    """
    known = WRITTEN if written else [*FORMATS]
    if written and path.is_dir():
        raise ValueError(f"{path} is a folder: name the file to write, with one of .{', .'.join(known)}")
    if name is not None:
        if name not in known:
            raise ValueError(f"format is {name!r}, wanted one of: {', '.join(known)}")
        return name
    if path.is_dir() and (path / sog.META).is_file():
        return sog.META
    fitting = _fitting(path, known)
    held = None if written or not path.is_file() else format_held(path)
    if held is not None and not any((FORMATS[format].of or format) == held for format in fitting):
        return held
    if not fitting:
        raise ValueError(f"{path}: unknown suffix; wanted .{', .'.join(known)}")
    return max(fitting, key=len)


def format_held(path: Path) -> str | None:
    """The format of a file by its first bytes; None: they tell none, as those of .splat.

    ValueError for what people have in place of a scene file: nothing, a web page, a pointer, a packed file.
    """
    with path.open("rb") as file:
        head = file.read(512)
    if not head:
        raise ValueError(f"{path}: {_NOT} empty: the download failed")
    if head.startswith(b"version https://git-lfs"):
        raise ValueError(f"{path}: {_NOT} a pointer of Git LFS: `git lfs pull` fetches the file")
    if head.lstrip().lower().startswith(_PAGES):
        raise ValueError(f"{path}: {_NOT} a web page: download the file itself")
    if head.startswith(b"\x1f\x8b"):
        try:
            head = zlib.decompressobj(spz.GZIP).decompress(head, 4)
        except zlib.error:
            return None
        if head.startswith(b"ply"):
            raise ValueError(f"{path}: {_NOT} one packed by gzip: unpack it")
    if head.startswith(b"PK\3\4") and zipfile.is_zipfile(path):
        return _of_zip(path)
    return next((name for name, row in FORMATS.items() if row.starts and head.startswith(row.starts)), None)


def _of_zip(path: Path) -> str | None:
    try:
        with zipfile.ZipFile(path) as packed:
            names = [Path(name).name for name in packed.namelist()]
    except (*DECODE_ERRORS, zipfile.BadZipFile):  # damaged; or of a version to come
        return None
    if "data.pkl" in names:
        raise ValueError(f"{path}: {_NOT} a checkpoint of PyTorch: export the scene as .ply")
    if sog.META not in names:
        raise ValueError(f"{path}: {_NOT} an archive: unpack it")
    return "sog"


def scene_file(path: str | Path) -> Path:
    """The file itself, scene.ply of a run's folder, or meta.json of a SOG scene's that was unpacked.

    FileNotFoundError where there is none.
    """
    path = Path(path)
    file = path / PLY if path.is_dir() else path
    if path.is_dir() and not file.is_file() and (path / sog.META).is_file():
        file = path / sog.META
    if file.is_file():
        return file
    if is_run(path):
        raise FileNotFoundError(
            f"{path} holds an unfinished run without a scene: "
            f"hqgs train PHOTOS --out {path} --resume continues it"
        )
    raise FileNotFoundError(f"there is no {file}: give the folder of a run, or a scene file")


def bytes_of(file: Path) -> int:
    """The size of a `scene_file`, with the pictures beside a meta.json."""
    parts = file.parent.iterdir() if file.name == sog.META else [file]
    return sum(part.stat().st_size for part in parts if part.is_file())
