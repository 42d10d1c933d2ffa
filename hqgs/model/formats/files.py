"""Which format a file has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from hqgs.base.files import PLY
from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.compressed_ply import is_compressed_ply, read_compressed_ply, write_compressed_ply
from hqgs.model.formats.content import format_held
from hqgs.model.formats.gltf import read_gltf, write_gltf
from hqgs.model.formats.ksplat import read_ksplat
from hqgs.model.formats.nerfstudio import in_data_frame
from hqgs.model.formats.ply import read_ply, write_ply
from hqgs.model.formats.sog import read_sog
from hqgs.model.formats.sog_writer import write_sog
from hqgs.model.formats.splat import read_splat, write_splat
from hqgs.model.formats.spz import read_spz, write_spz
from hqgs.model.formats.world_file import keep_world, read_world
from hqgs.scene.photo_files import is_run
from hqgs.scene.world import World


def read_scene(path: Path, format: str) -> Arrays:
    """What a scene file holds, with the frame that stands beside it, if one does."""
    arrays = in_data_frame(path, FORMATS[format].read(path))
    if "world" not in arrays and (world := read_world(path)) != World():
        arrays["world"] = world
    return arrays


def write_scene(path: Path, arrays: Arrays, format: str) -> int:
    """Write a scene file, and its frame beside it where the format has no place for that."""
    write = FORMATS[format].write
    assert write is not None
    left_out = write(path, arrays)
    keep_world(path, World() if FORMATS[format].world else arrays.get("world", World()))
    return left_out


def _read_any_ply(path: Path) -> Arrays:
    return read_compressed_ply(path) if is_compressed_ply(path) else read_ply(path)


@dataclass(frozen=True)
class Format:
    """How scenes are read and written, and what such a file has a place for."""

    read: Callable[[Path], Arrays]
    write: Callable[[Path, Arrays], int] | None = None  # None: it is only read
    of: str | None = None  # the format whose content it has, where that is another's
    world: bool = False  # the frame of the scene
    errors: bool = False  # what trust was learned
    antialiased: bool = False  # that flag


# By the ends of their files' names; where two fit, the longer counts.
FORMATS = {
    "ply": Format(_read_any_ply, write_ply, world=True, errors=True, antialiased=True),
    "spz": Format(read_spz, lambda path, arrays: write_spz(path, arrays).left_out, antialiased=True),
    "splat": Format(read_splat, write_splat),
    "compressed.ply": Format(_read_any_ply, write_compressed_ply, of="ply"),
    "glb": Format(read_gltf, write_gltf, world=True, errors=True),
    "gltf": Format(read_gltf, world=True),
    "full.ply": Format(_read_any_ply, partial(write_ply, full=True), of="ply", antialiased=True),
    "sog": Format(read_sog, write_sog, antialiased=True),
    "meta.json": Format(read_sog, of="sog"),
    "ksplat": Format(read_ksplat),
}
WRITTEN = [name for name, format in FORMATS.items() if format.write is not None]


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
    if path.is_dir() and (path / "meta.json").is_file():
        return "meta.json"
    fitting = _fitting(path, known)
    held = None if written or not path.is_file() else format_held(path)
    if held is not None and not any((FORMATS[format].of or format) == held for format in fitting):
        return held
    if not fitting:
        raise ValueError(f"{path}: the suffix says no format; wanted .{', .'.join(known)}")
    return max(fitting, key=len)


def scene_file(path: str | Path) -> Path:
    """The file itself, scene.ply of a run's folder, or meta.json of a SOG scene's that was unpacked.

    FileNotFoundError where there is none.
    """
    path = Path(path)
    file = path / PLY if path.is_dir() else path
    if path.is_dir() and not file.is_file() and (path / "meta.json").is_file():
        file = path / "meta.json"
    if file.is_file():
        return file
    if is_run(path):
        raise FileNotFoundError(
            f"{path} holds a run that has not ended, and no scene yet: "
            f"hqgs train PHOTOS --out {path} --resume goes on"
        )
    raise FileNotFoundError(f"there is no {file}: give the folder of a run, or a scene file")
