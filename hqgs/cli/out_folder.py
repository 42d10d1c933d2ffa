"""What `--out` names, the folder of a new run above all: what lies there, before anything is written."""

from __future__ import annotations

from pathlib import Path

from hqgs.base.files import CHECKPOINT
from hqgs.base.text import some
from hqgs.scene.photo_files import strangers


def check_out(out: Path, scene: str, resume: bool, overwrite: bool) -> list[str]:
    """Lines on what is there, for the user.

    ValueError or FileExistsError where the run cannot begin, or go on, in the folder `out`.
    """
    if (out / CHECKPOINT).exists():
        if resume or overwrite:
            return []
        raise FileExistsError(
            f"{out} holds a run; continue it with --resume, begin anew with --overwrite, or choose another "
            "--out"
        )
    if out.is_dir() and Path(scene).is_dir() and out.samefile(scene):
        raise ValueError(f"--out {out} is the folder of the photos: name another for the run")
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file: name a folder for the run")
    lines = [f"--resume: {out} holds no run to go on with; a new one begins"] if resume else []
    if others := strangers(out):
        lines.append(f"--out {out} holds other files too ({some(others)}): those of the run go beside them")
    return lines


def check_out_file(out: Path) -> None:
    """ValueError where `--out` cannot be a file: before the work, or its result would be lost."""
    if out.is_dir():
        raise ValueError(f"--out {out} is a folder: name the file to write")
    check_above(out)


def check_out_folder(out: Path) -> None:
    """ValueError where `--out` cannot be a folder, new or not."""
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file: name a folder")
    check_above(out)


def check_above(out: Path) -> None:
    """ValueError where `--out` would lie below a file."""
    above = next(path for path in out.absolute().parents if path.exists())
    if not above.is_dir():
        raise ValueError(f"--out {out} lies below {above}, which is a file")
