"""What names a scene, a film or a built-in room, and the names of what is kept beside photos."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

EMBEDDED = "embedded"  # in the place of a scene folder: the room that is built in
FILM_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mts")
ARCHIVE_SUFFIXES = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar")
SCENE_SUFFIXES = (".ply", ".spz", ".splat", ".ksplat", ".sog", ".glb", ".gltf")
KEPT = "sfm"  # in the folder of a run: what COLMAP found
FRAMES = "frames.json"  # in a folder of photos: they are frames of a film, named in its order


def existing_folder(path: str | Path) -> Path:
    """The folder of a scene, resolved. FileNotFoundError where there is none, ValueError for a file, or where
    nothing is in it."""
    if "://" in str(path) or str(path).startswith(("http:/", "https:/")):
        raise ValueError(f"{path} is a web address: download it, and give the folder or film")
    folder = Path(path).expanduser().resolve()
    if not folder.exists():
        near = ""
        if folder.parent.is_dir():
            names = [entry.name for entry in folder.parent.iterdir() if entry.is_dir()]
            alike = get_close_matches(folder.name, names, n=1)
            near = f"; did you mean {folder.parent / alike[0]}?" if alike else ""
        if not near and (alike := get_close_matches(str(path), [EMBEDDED], n=1)):
            near = f"; did you mean the built-in {alike[0]}?"
        raise FileNotFoundError(f"there is no scene folder {folder}{near}")
    if folder.is_dir():
        if all(entry.name.startswith(".") for entry in folder.iterdir()):
            raise ValueError(f"{folder} is empty: give a folder with photos")
        return folder
    if folder.name.lower().endswith(ARCHIVE_SUFFIXES):
        raise ValueError(f"{folder} is an archive: unpack it, and give the folder with the photos")
    if folder.name.lower().endswith(SCENE_SUFFIXES):
        raise ValueError(
            f"{folder} is a trained scene file, which hqgs view shows; wanted a folder with photos"
        )
    raise ValueError(
        f"{folder} is a file; wanted a folder with photos, or a film: did you mean {folder.parent}?"
    )


def is_room(name: str | Path) -> bool:
    """Whether this names the built-in scene: a folder of that name comes first."""
    return str(name) == EMBEDDED and not Path(name).exists()
