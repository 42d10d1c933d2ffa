"""Which format a file has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hqgs.base.files import PLY
from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.compressed_ply import is_compressed_ply, read_compressed_ply, write_compressed_ply
from hqgs.model.formats.gltf import read_gltf, write_gltf
from hqgs.model.formats.ply import read_ply, write_ply
from hqgs.model.formats.splat import read_splat, write_splat
from hqgs.model.formats.spz import read_spz, write_spz


def _read_any_ply(path: Path) -> Arrays:
    return read_compressed_ply(path) if is_compressed_ply(path) else read_ply(path)


# By the ends of their files' names; where two fit, the longer counts.
READERS: dict[str, Callable[[Path], Arrays]] = {
    "ply": _read_any_ply,
    "spz": read_spz,
    "splat": read_splat,
    "compressed.ply": read_compressed_ply,
    "glb": read_gltf,
}
WRITERS: dict[str, Callable[[Path, Arrays], int]] = {
    "ply": write_ply,
    "spz": lambda path, arrays: write_spz(path, arrays).left_out,
    "splat": write_splat,
    "compressed.ply": write_compressed_ply,
    "glb": write_gltf,
}


def format_of(path: Path, name: str | None = None) -> str:
    """The format of that name, or the one that the file's suffix says. ValueError where there is none."""
    if name is not None:
        if name not in READERS:
            raise ValueError(f"format is {name!r}, wanted one of: {', '.join(READERS)}")
        return name
    fitting = [format for format in READERS if path.name.lower().endswith(f".{format}")]
    if not fitting:
        raise ValueError(f"{path}: the suffix says no format; wanted .{', .'.join(READERS)}")
    return max(fitting, key=len)


def scene_file(path: str | Path) -> Path:
    """The file itself, or scene.ply of a run's folder. FileNotFoundError where there is none."""
    path = Path(path)
    file = path / PLY if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(f"there is no {file}")
    return file
