"""COLMAP models (binary or text) with their photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.camera import Tracks
from hqgs.colmap_run import model_points, seen_points
from hqgs.data.capture import (
    Capture,
    Photo,
    find_mask,
    inside,
    keep_finite,
    list_photos,
    photo_folder,
    some,
    viewmat_from_pose,
)
from hqgs.data.colmap_files import cameras_file_size, check_binary_model

_FILES = ("cameras", "images", "points3D")


def find_models(root: Path) -> list[Path]:
    """Folders with a complete COLMAP model: those below `sparse/`, else `sparse` itself, else `root`."""
    sparse = root / "sparse"
    fragments = sorted(p for p in sparse.iterdir() if _kind(p)) if sparse.is_dir() else []
    return fragments or [p for p in (sparse, root) if _kind(p)][:1]


def read_colmap(root: Path, downscale: float) -> Capture:
    """Read the largest COLMAP model of the scene in `root`.

    COLMAP's camera frame and pixel centres (half-integers) are ours. Raises ValueError for a damaged model,
    FileNotFoundError for a camera whose photo is missing.
    """
    found = photo_folder(root, downscale)
    if found is None:
        raise ValueError(f"{root} has a COLMAP model but no photos: looked for images, images_{downscale:g}")
    folder, left, notes = found
    models = {path: _read_model(path) for path in find_models(root)}
    path = max(models, key=lambda p: (len(_registered(models[p])), models[p].num_points3D()))
    model = models.pop(path)
    if models:
        others = ", ".join(f"{p.name}: {len(_registered(m))}" for p, m in models.items())
        notes.append(
            f"{len(models) + 1} COLMAP models: took the largest, {path.relative_to(root)}, with "
            f"{len(_registered(model))} photos (photos in the others: {others})"
        )
    try:
        by_name = sorted((image.name, image.image_id) for image in _registered(model))
    except UnicodeDecodeError as e:
        raise ValueError(f"{path}: a photo name is not UTF-8: {e}") from e
    if not by_name:
        raise ValueError(f"{path}: the COLMAP model has no registered photo")
    names = [name for name, _ in by_name]
    twice = sorted({n for n in names if names.count(n) > 1}) if len(set(names)) < len(names) else []
    if twice:
        raise ValueError(f"{path}: photo names appear more than once: {some(twice)}")

    files = _match_files(names, root, folder, notes)
    photos = []
    for name, image_id in by_name:
        image = model.images[image_id]
        camera = model.cameras[image.camera_id]
        photos.append(Photo(name, files[name], camera, _viewmat(image), find_mask(root, name)))
    used = set(files.values())
    if len(used) < len(files):
        shared = [n for n, p in files.items() if list(files.values()).count(p) > 1]
        raise ValueError(f"{folder}: several cameras have the same photo: {some(shared)}")
    unused = [n for n in list_photos(folder) if folder / n not in used]
    if unused:
        notes.append(f"{len(unused)} photos have no camera (COLMAP did not register them): {some(unused)}")
    points, colors = keep_finite(*model_points(model), notes)
    tracks = _tracks(model, path)
    seen = None
    if tracks is not None and len(points) == model.num_points3D():  # else the rows would not be those
        seen = seen_points(model)
    return Capture(
        "colmap", photos, left, points, colors, folder=folder, notes=notes, tracks=tracks, seen=seen
    )


def _tracks(model: pycolmap.Reconstruction, path: Path) -> Tracks | None:
    """How the photos saw the points; None where the model does not tell."""
    try:
        if not model.compute_num_observations():
            return None
        return Tracks(model.compute_mean_track_length(), model.compute_mean_reprojection_error())
    except ValueError as e:
        raise ValueError(f"{path}: a point was seen by a photo that the model lacks: {e}") from e


def _kind(folder: Path) -> str:
    """ "bin", "txt" or "" (no complete model). COLMAP itself prefers the binary files."""
    for kind in ("bin", "txt"):
        if all((folder / f"{name}.{kind}").is_file() for name in _FILES):
            return kind
    return ""


def _read_model(folder: Path) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    binary = _kind(folder) == "bin"
    if binary:
        check_binary_model(folder)
    try:
        if binary:
            model.read_binary(folder)
        else:
            model.read_text(folder)
    except (ValueError, IndexError, RuntimeError) as e:
        raise ValueError(f"{folder}: COLMAP cannot read its model there: {e}") from e
    if binary:
        size = cameras_file_size([len(c.params) for c in model.cameras.values()])
        actual = (folder / "cameras.bin").stat().st_size
        if actual != size:
            raise ValueError(f"{folder / 'cameras.bin'} is damaged: {size} bytes expected, it has {actual}")
    return model


def _registered(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [image for image in model.images.values() if image.has_pose]


def _viewmat(image: pycolmap.Image) -> NDArray[np.float64]:
    pose = image.cam_from_world()
    viewmat = viewmat_from_pose(pose.matrix(), image.name, camera_to_world=False)
    quat = pose.rotation.quat
    if abs(np.linalg.norm(quat) - 1) > 1e-2:  # the matrix does not show it: that of a zero quaternion is I
        raise ValueError(
            f"photo {image.name!r}: its quaternion (x, y, z, w) is not of length 1: {quat.tolist()}"
        )
    return viewmat


def _match_files(names: list[str], root: Path, folder: Path, notes: list[str]) -> dict[str, Path]:
    """The file of each photo: by name; by name up to the suffix; in `images_N` also by sorted position.

    LLFF's scaled photos have names of their own (image000.png for IMG_4026.JPG) in the same order.
    """
    present = list_photos(folder)
    by_stem: dict[str, list[str]] = {}
    for n in present:
        by_stem.setdefault(_stem(n), []).append(n)
    files: dict[str, Path] = {}
    missing = []
    for name in names:
        exact = inside(folder, name, "the COLMAP model's photo")
        similar = by_stem.get(_stem(name), [])
        if exact.is_file():
            files[name] = exact
        elif len(similar) == 1:
            files[name] = folder / similar[0]
        else:
            missing.append(name)
    if not missing:
        return files
    originals = root / "images"
    originals_names = list_photos(originals) if originals.is_dir() else names
    renamed = folder != originals and len(missing) == len(names) and len(originals_names) == len(present)
    if renamed and set(names) <= set(originals_names):
        notes.append(f"{folder.name} has other file names than the cameras: matched by sorted position")
        return {n: folder / p for n, p in zip(originals_names, present, strict=True) if n in set(names)}
    raise FileNotFoundError(f"{len(missing)} cameras have no photo in {folder}: {some(missing)}")


def _stem(name: str) -> str:
    return name.rsplit(".", 1)[0]
