"""The photos of a COLMAP model: the folder that holds them, and the file of each name."""

from __future__ import annotations

from pathlib import Path

from hqgs.base.text import some
from hqgs.scene.capture import files_named, inside, list_photos, perhaps, photo_folder
from hqgs.scene.photo_files import Named, is_mask_folder, is_run, of_maps

INPUT = "input"  # 3DGS's convert.py: photos as they were before they were undistorted


def photos_of(
    names: list[str], root: Path, model: Path, downscale: float, notes: list[str]
) -> tuple[Path, float, dict[str, Path]]:
    """The folder of photos, the downscale left to do, and the file of each name that has one.

    The folder is that of `photo_folder`, where it has any of the photos; else the one that has most: those
    beside the model, `images` or `input` beside it, the scene's folder, any folder in it; one that is called
    after maps only where no other has any.

    Raises ValueError without photos, FileNotFoundError where none of the names has one.
    """
    found = photo_folder(root, downscale)
    if found is not None:
        folder, left, told = found
        if files := match_some(names, root, folder, notes):
            notes[:0] = told
            return folder, left, files
    base = model.parent.parent if model.parent.name == "sparse" else model.parent
    beside = [place / name for place in (base, model, root) for name in (INPUT, "images")]
    inner = [p for p in sorted(root.iterdir()) if p.is_dir() and p.name[0] != "." and not is_run(p)]
    maps = [p for p in inner if of_maps(p.name)]
    options = [*beside, model, base, root, *(p for p in inner if p not in maps)]
    options = [p for p in dict.fromkeys(options) if p.is_dir() and p.is_relative_to(root)]
    best = _fullest(options, names) or (root if found is None else found[0])
    files = match_some(names, root, best, notes) if list_photos(best) else {}
    called = _fullest([p for p in maps if not is_mask_folder(p.name)], names)
    if not files and called is not None:  # photos after all
        best, files = called, match_some(names, root, called, notes)
    if not files and not list_photos(best):
        raise ValueError(
            f"{root} has a COLMAP model but no photos: looked for images, images_{downscale:g}, and in "
            f"{some([p.relative_to(root).as_posix() for p in options])}{perhaps(root)}"
        )
    if files:
        if best != (root / "images"):
            notes.append(f"the photos are those in {best.relative_to(root).as_posix()}")
        return best, downscale, files
    raise FileNotFoundError(f"{len(names)} cameras have no photo in {best}: {some(names)}")


def _fullest(folders: list[Path], names: list[str]) -> Path | None:
    """The first of the folders that have most of the photos; None where none has any."""
    counts = {folder: sum(_named(folder, name) for name in names) for folder in folders}
    most = max(counts.values(), default=0)
    return next((folder for folder in folders if counts[folder] == most), None) if most else None


def _named(folder: Path, name: str) -> bool:
    """Whether a folder has the photo of a name, by its name or up to the suffix."""
    try:
        path = inside(folder, name.replace("\\", "/"), "photo")
    except ValueError:
        return False
    return path.is_file()


def match_some(names: list[str], root: Path, folder: Path, notes: list[str]) -> dict[str, Path]:
    """The files of the photos that have one (`files_named`); in `images_N` by sorted position where none has.

    LLFF's scaled photos have names of their own (image000.png for IMG_4026.JPG) in the same order.
    """
    listed, present, originals = Named(folder), list_photos(folder), root / "images"
    all_names = list_photos(originals) if originals.is_dir() else names
    scaled = folder.name.startswith("images_") and set(names) <= set(all_names)
    if scaled and len(all_names) == len(present) and not any(map(listed.up_to_suffix, names)):
        notes.append(
            f"{folder.name} has other file names than the cameras: photos were assigned in sorted order"
        )
        return {n: folder / p for n, p in zip(all_names, present, strict=True) if n in set(names)}
    files = files_named(folder, names, "the COLMAP model's photo", listed)
    notes += listed.note()
    return files
