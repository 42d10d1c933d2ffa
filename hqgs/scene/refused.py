"""What is wrong with folders that hold no scene, and what is not read of others."""

from __future__ import annotations

from pathlib import Path

from hqgs.base.text import some
from hqgs.photos.suffixes import PHOTO_SUFFIXES, RAW_SUFFIXES
from hqgs.scene.capture import perhaps
from hqgs.scene.formats.colmap import find_models, half_model
from hqgs.scene.formats.llff import POSES
from hqgs.scene.formats.transforms import SINGLE, TRAIN
from hqgs.scene.names import ARCHIVE_SUFFIXES, FILM_SUFFIXES
from hqgs.scene.photo_files import is_run


def above(root: Path) -> list[str]:
    """That the folder above has cameras, which are not read for a folder of photos; or nothing."""
    parent = root.parent
    found = ["colmap"] if find_models(parent) else []
    found += [name for name in (SINGLE, TRAIN, POSES) if (parent / name).is_file()]
    which = f"{parent} holds cameras and points ({', '.join(found)})"
    return [f"{which}, which are not read: give that folder to train with them"] if found else []


def beside(root: Path) -> list[str]:
    """That folders beside the photos hold cameras, which are not read; or nothing."""
    found = sorted(path for name in (SINGLE, TRAIN, POSES) for path in root.glob(f"*/{name}"))
    which = f"{some([path.relative_to(root).as_posix() for path in found])} hold cameras, which are not read"
    return [f"{which}: put such a file into {root} to train with them"] if found else []


def broken(root: Path) -> str | None:
    """What is there of a scene that is not whole; None: nothing."""
    if (folder := half_model(root)) is not None:
        return f"{folder} holds half a COLMAP model: cameras, images and points3D are wanted, as .bin or .txt"
    names = [name for name in (SINGLE, TRAIN, POSES) if (root / name).exists()]
    return f"{root / names[0]} is no file" if names else None


def nothing(root: Path) -> str:
    """What is wrong with a folder in which no format is recognised."""
    if is_run(root):
        return f"{root} is the folder of a run that hqgs wrote: give the folder with the photos"
    entries = sorted(p.name for p in root.iterdir() if not p.name.startswith("."))
    for suffixes, advice in (
        (RAW_SUFFIXES, "raw data of a camera: develop them to JPEG, all with the same settings"),
        (ARCHIVE_SUFFIXES, "unpack it, and give the folder with the photos"),
        (FILM_SUFFIXES, "several films: give one of them in place of the folder"),
    ):
        if found := [name for name in entries if name.lower().endswith(suffixes)]:
            return f"{root} holds no photos, but {some(found)}: {advice}"
    return (
        f"{root} holds no photos ({', '.join(PHOTO_SUFFIXES)}), here or in a folder further down, and no "
        f"scene (a COLMAP model, {SINGLE}, {TRAIN} or {POSES}); it holds {some(entries)}{perhaps(root)}"
    )
