"""What folders hold beside photos, or in their place: what is not read, and what to do about it."""

from __future__ import annotations

import re
from pathlib import Path

from hqgs.base.text import some
from hqgs.photos.suffixes import PHOTO_SUFFIXES, RAW_SUFFIXES
from hqgs.scene.capture import perhaps
from hqgs.scene.formats.colmap import find_models, half_model
from hqgs.scene.formats.llff import POSES
from hqgs.scene.formats.transforms import SINGLE, TRAIN
from hqgs.scene.names import ARCHIVE_SUFFIXES, FILM_SUFFIXES
from hqgs.scene.photo_files import can_be_listed, is_run

CAMERAS = (SINGLE, TRAIN, POSES)


def _ending(suffixes: tuple[str, ...]) -> re.Pattern[str]:
    return re.compile(f".*({'|'.join(map(re.escape, suffixes))})", re.IGNORECASE)


# Files that are told by their names, and what to do about them.
BESIDE = (  # photos
    (_ending(FILM_SUFFIXES), "not read beside photos; to use a film, give it instead of the folder"),
    (
        _ending((".icloud", ".crdownload", ".part", ".partial", ".download")),
        "not fully downloaded: download it first",
    ),
    (
        re.compile(
            r".*(camera|cams|pose|traj|groundtruth|registration|bundle|reconstruction|sfm|transforms|mesh_info)"
            r".*\.(xml|csv|out|json|txt|log|bin|np[yz])|.*\.(psx|rcproj|nvm|mg)",
            re.IGNORECASE,
        ),
        "not read; hqgs finds the cameras from the photos instead. Exports for COLMAP or nerfstudio are read",
    ),
)
IN_PLACE = (  # of photos
    (_ending(RAW_SUFFIXES), "raw photos: develop them to JPEG, all with the same settings"),
    (_ending(ARCHIVE_SUFFIXES), "unpack it, and give the folder with the photos"),
    (_ending(FILM_SUFFIXES), "several films: give one of them instead of the folder"),
)


def beside(*folders: Path) -> list[str]:
    """What lies beside photos and is not read, a sentence for each kind."""
    names = sorted({path.name for folder in folders for path in folder.iterdir()})
    found = ((advice, [name for name in names if named.fullmatch(name)]) for named, advice in BESIDE)
    return [f"{some(files)}: {advice}" for advice, files in found if files]


def elsewhere(root: Path) -> list[str]:
    """That folders above or below the photos hold cameras, which are not read; or nothing."""
    parent, told = root.parent, list[str]()
    above = ["colmap"] if can_be_listed(parent) and find_models(parent) else []
    above += [name for name in CAMERAS if (parent / name).is_file()]
    if above:
        which = f"{parent} holds cameras and points ({', '.join(above)})"
        told.append(f"{which}, which are not read: give that folder to train with them")
    if below := sorted(p.relative_to(root).as_posix() for name in CAMERAS for p in root.glob(f"*/{name}")):
        which = f"{some(below)} hold cameras, which are not read"
        told.append(f"{which}: put such a file into {root} to train with them")
    return told


def broken(root: Path) -> str | None:
    """What is there of a scene that is not whole; None: nothing."""
    if (folder := half_model(root)) is not None:
        return f"{folder} holds a part of a COLMAP model: wanted cameras, images, points3D, as .bin or .txt"
    names = [name for name in CAMERAS if (root / name).exists()]
    return f"{root / names[0]} is not a file" if names else None


def nothing(root: Path) -> str:
    """What is wrong with a folder in which no format is recognised."""
    if is_run(root):
        return f"{root} is the folder of a run that hqgs wrote: give the folder with the photos"
    entries = sorted(p.name for p in root.iterdir() if not p.name.startswith("."))
    for named, advice in IN_PLACE:
        if found := [name for name in entries if named.fullmatch(name)]:
            return f"{root} holds no photos, but {some(found)}: {advice}"
    return (
        f"{root} holds no photos ({', '.join(PHOTO_SUFFIXES)}), here or in a folder further down, and no "
        f"scene (a COLMAP model, {SINGLE}, {TRAIN} or {POSES}); it holds {some(entries)}{perhaps(root)}"
    )
