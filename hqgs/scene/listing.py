"""COLMAP folders as lists: cameras and names of the photos, without a pixel or a point in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.base.files import existing_folder
from hqgs.base.text import some
from hqgs.scene.capture import Capture, Photo, find_mask, no_points, photo_folder
from hqgs.scene.formats.colmap import find_models, match_files, pose_viewmat
from hqgs.scene.formats.colmap_stream import read_cameras, read_images, stored_count
from hqgs.scene.load import bounded
from hqgs.scene.scene import View
from hqgs.scene.views import load_views

SAMPLE = 512  # points of each photo that are looked at
AT_ONCE = 16  # photos in memory


@dataclass(frozen=True)
class Listed:
    """A COLMAP folder; lists are in the order of the photos' names."""

    capture: Capture  # without points
    cameras: dict[int, pycolmap.Camera]
    image_ids: NDArray[np.int64]  # [N]
    camera_ids: NDArray[np.int64]  # [N]
    centers: NDArray[np.float64]  # [N, 3], world
    sample: list[NDArray[np.int64]]  # ids of at most SAMPLE points that each photo shows, evenly spread


@contextmanager
def binary_model(root: Path) -> Iterator[Path]:
    """The folder of the scene's largest COLMAP model, as binary files. ValueError where there is none."""
    with TemporaryDirectory(prefix="hqgs-model-") as name:
        found = list[Path]()
        for number, model in enumerate(find_models(root)):
            if not (model / "images.bin").is_file():
                copy = Path(name) / str(number)
                copy.mkdir()
                text = pycolmap.Reconstruction()
                try:
                    text.read_text(model)
                except (ValueError, IndexError, RuntimeError) as error:
                    raise ValueError(f"{model}: COLMAP cannot read its model there: {error}") from error
                text.write_binary(copy)
                model = copy
            found.append(model)
        if not found:
            raise ValueError(
                f"{root} holds no COLMAP model, the one format that can be split: `hqgs sfm` makes one of "
                "photos alone, `hqgs degrade --kind none` of other scenes"
            )
        yield max(found, key=lambda m: (stored_count(m / "images.bin"), stored_count(m / "points3D.bin")))


def listed(root: Path, model: Path, downscale: float = 1.0) -> Listed:
    """List the photos of the scene in `root`, whose model `binary_model` gave.

    ValueError for a damaged model, FileNotFoundError for a camera whose photo is missing.
    """
    found = photo_folder(root, downscale)
    if found is None:
        raise ValueError(f"{root} has a COLMAP model but no photos: looked for images, images_{downscale:g}")
    folder, left, notes = found
    cameras = read_cameras(model / "cameras.bin")
    photos, samples, rows = list[Photo](), list[NDArray[np.int64]](), list[tuple[int, int]]()
    for image in read_images(model / "images.bin"):
        if image.camera_id not in cameras:
            raise ValueError(
                f"{model}: photo {image.name!r} has the camera {image.camera_id}, which it lacks"
            )
        camera = cameras[image.camera_id]
        rotation = pycolmap.Rotation3d(np.roll(image.quat, -1))  # which wants w last
        viewmat = pose_viewmat(pycolmap.Rigid3d(rotation, image.shift), image.name)
        photos.append(Photo(image.name, folder, camera, viewmat))
        shown = image.pixels["point"][image.pixels["point"] >= 0]
        samples.append(shown[np.linspace(0, len(shown) - 1, min(SAMPLE, len(shown))).astype(int)])
        rows.append((image.image_id, image.camera_id))
    if not photos:
        raise ValueError(f"{model}: the COLMAP model has no registered photo")
    order = sorted(range(len(photos)), key=lambda k: photos[k].name)
    names = [photos[k].name for k in order]
    twice = sorted({a for a, b in pairwise(names) if a == b})
    if twice:
        raise ValueError(f"{model}: photo names appear more than once: {some(twice)}")
    files = match_files(names, root, folder, notes)
    photos = [
        Photo(p.name, files[p.name], p.camera, p.viewmat, find_mask(root, p.name))
        for p in (photos[k] for k in order)
    ]
    return Listed(
        Capture("colmap", photos, left, *no_points(), folder=folder, notes=notes),
        cameras,
        np.array([rows[k][0] for k in order], np.int64),
        np.array([rows[k][1] for k in order], np.int64),
        np.stack([-p.viewmat[:3, :3].T @ p.viewmat[:3, 3] for p in photos]),
        [samples[k] for k in order],
    )


def some_views(
    path: str | Path, names: Sequence[str], downscale: float = 1.0, longest: int | None = None
) -> Iterator[View]:
    """The views of these photos of a COLMAP folder, as `hqgs.load` has them, in the order of the names.

    A few are in memory at a time. A name may come more than once.

    Raises FileNotFoundError or ValueError for what is wrong with the folder or a photo, or a name that it
    does not have.
    """
    root = existing_folder(path)
    with binary_model(root) as model:
        capture = listed(root, model, downscale).capture
    if missing := sorted(set(names) - {photo.name for photo in capture.photos}):
        raise ValueError(f"{root} has no photo {some(missing)}")
    if longest is not None:
        capture = bounded(capture, longest)
    of_name = {photo.name: photo for photo in capture.photos}
    photos = [of_name[name] for name in names]
    for first in range(0, len(photos), AT_ONCE):
        yield from load_views(photos[first : first + AT_ONCE], capture.downscale)[0]
