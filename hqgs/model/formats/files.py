"""Which format a file has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hqgs.base.files import PLY
from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.ply import read_ply, write_ply
from hqgs.model.formats.spz import read_spz, write_spz

READERS: dict[str, Callable[[Path], Arrays]] = {"ply": read_ply, "spz": read_spz}
WRITERS: dict[str, Callable[[Path, Arrays], int]] = {
    "ply": write_ply,
    "spz": lambda path, arrays: write_spz(path, arrays).left_out,
}


def format_of(path: Path, name: str | None = None) -> str:
    """The format of that name, or the one that the file's suffix says. ValueError where there is none."""
    if name is not None:
        if name not in READERS:
            raise ValueError(f"format is {name!r}, wanted one of: {', '.join(READERS)}")
        return name
    suffix = path.suffix[1:].lower()
    if suffix not in READERS:
        raise ValueError(f"{path}: the suffix says no format; wanted .{' or .'.join(READERS)}")
    return suffix


def scene_file(path: str | Path) -> Path:
    """The file itself, or scene.ply of a run's folder. FileNotFoundError where there is none."""
    path = Path(path)
    file = path / PLY if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(f"there is no {file}")
    return file
