"""Folders that hold photos and nothing else: the cameras come from the photos."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from hqgs.base.text import some
from hqgs.photos.files import PHOTO_SUFFIXES
from hqgs.scene.capture import Capture, Photo, find_mask, keep_finite, photo_folder
from hqgs.scene.formats.colmap import model_points, registered, seen_points
from hqgs.scene.scene import Tracks
from hqgs.scene.sfm.run import run_colmap


def bare_photos(root: Path, downscale: float) -> tuple[Path, float, list[str], list[str]] | None:
    """The folder of the photos, the downscale left to do, notes and the photos' names; None without photos.

    The folder is that of `photo_folder`, or `root` itself; folders inside it are not looked into.
    """
    folder, left, notes = photo_folder(root, downscale) or (root, downscale, [])
    names = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES and p.is_file())
    names = [name for name in names if not name.startswith(".")]
    return (folder, left, notes, names) if names else None


def read_photos(root: Path, downscale: float, keep: Path | None = None) -> Capture:
    """Cameras and points of a folder of photos, from all of them, by COLMAP.

    Photos of one size share a camera (SIMPLE_RADIAL), which is found as well. Held-out views are among the
    photos: without them they would have no pose. The notes say so, and name the photos that have no place.
    `keep`: a folder for the reconstruction, see `run_colmap`. ValueError where there is no photo, or COLMAP
    cannot make a model of half of them.
    """
    found = bare_photos(root, downscale)
    if found is None:
        raise ValueError(f"{root} holds no photos")
    folder, left, notes, names = found
    with tempfile.TemporaryDirectory(prefix="hqgs-sfm-") as directory:
        model = run_colmap(Path(directory), folder, names, None, keep)
    poses = registered(model, len(names))
    cameras = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    photos = [
        Photo(name, folder / name, cameras[name], np.asarray(viewmat), find_mask(root, name))
        for name, viewmat in poses.items()
    ]
    tracks = Tracks(model.compute_mean_track_length(), model.compute_mean_reprojection_error())
    notes.append(
        f"cameras and points by COLMAP from all photos ({len(poses)} of {len(names)} registered), the "
        f"held-out views among them; {tracks.length:.1f} photos a point, {tracks.error:.2f} px of the stored "
        "photos off (mean)"
    )
    if missing := [name for name in names if name not in poses]:
        notes.append(
            f"{len(missing)} photos were left out, as COLMAP found no place for them: {some(missing)}"
        )
    points, colors = keep_finite(*model_points(model), notes)
    seen = seen_points(model) if len(points) == model.num_points3D() else None
    return Capture(
        "photos", photos, left, points, colors, folder=folder, notes=notes, tracks=tracks, seen=seen
    )
