"""Cameras and points for a folder of photos alone, by COLMAP."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hqgs.base.stages import OnStage, silent
from hqgs.base.text import as_text
from hqgs.photos.exif import Exif
from hqgs.photos.files import is_shown
from hqgs.scene.capture import Capture, Photo, keep_finite
from hqgs.scene.faces import CUBE, around
from hqgs.scene.film import frame_details
from hqgs.scene.formats.colmap import model_points, registered, seen_points
from hqgs.scene.masks import masks_of
from hqgs.scene.paths import UP
from hqgs.scene.scene import SfmReport, TrackStatistics
from hqgs.scene.sfm.bare_photos import BarePhotos, readable, ups
from hqgs.scene.sfm.database import LARGEST
from hqgs.scene.sfm.run import run_colmap


@dataclass(frozen=True)
class Search:
    """How cameras are looked for; see `run_colmap`."""

    keep: Path | None = None
    on_stage: OnStage = silent
    coarse: bool = False


@dataclass(frozen=True)
class FoundCameras:
    """What COLMAP found in photos alone, upright."""

    photos: BarePhotos  # those that can be read
    model: pycolmap.Reconstruction
    report: SfmReport


def find_cameras(root: Path, photos: BarePhotos, search: Search) -> FoundCameras:
    """Cameras and points of photos that are readable, by COLMAP, as `read_photos` has them."""
    names = photos.colmap_names
    files = {name: file for file, name in reversed(names.items())}  # of a panorama its first face
    try:
        ran = run_colmap(
            list(names),
            photos.contents(),
            photos.guess(LARGEST),
            lambda folder: photos.write(folder, LARGEST),
            called=names,
            **vars(search),
        )
        poses = {names[file]: viewmat for file, viewmat in ran.poses().items() if file in files.values()}
    except ValueError as error:
        raise ValueError(f"{root}: {error}") from error
    model = ran.found
    as_stored(model, photos.guess().sizes, len(CUBE) if photos.around else 1)
    tags = dict(zip(photos.names, photos.exif, strict=True))
    upright = _upright(np.stack(list(poses.values())), [tags[name] for name in poses])
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(upright), np.zeros(3)))
    report = SfmReport(
        photos=len(files),
        not_registered=[as_text(name) for name in photos.names if name not in poses],
        points=model.num_points3D(),
        track_length=model.compute_mean_track_length(),
        reprojection_error_px=model.compute_mean_reprojection_error(),
        unreadable=photos.unreadable,
        advice=ran.advice(),
        lost={as_text(name): why for name, why in ran.lost().items() if name not in poses},
    )
    return FoundCameras(photos, model, report)


def read_photos(root: Path, photos: BarePhotos, search: Search) -> Capture:
    """Cameras and points of a folder of photos, from all of them, by COLMAP.

    Photos of one size share a camera (SIMPLE_RADIAL), unless EXIF tells cameras or zooms apart; it is
    found as well, from the focal length in EXIF where that has one. Held-out views are among the photos:
    without them they would have no pose. The report says so, and names the photos that have no place. The
    world is turned so that the photos' mean up is -y; up is what EXIF says of how each was held.
    ValueError where COLMAP cannot make a model of half of the photos.
    """
    photos = readable(photos, search.on_stage)
    masks = masks_of(root, photos.folder, photos.names)
    for name, size, exif in zip(photos.names, photos.sizes, photos.exif, strict=True):
        if name in masks:
            is_shown(masks[name], *size, exif.orientation)
    cameras = find_cameras(root, photos, search)
    model, names, folder = cameras.model, cameras.photos.colmap_names, cameras.photos.folder
    of_image = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    sizes = dict(zip(cameras.photos.names, cameras.photos.sizes, strict=True))
    details = frame_details(folder)
    found: dict[str, Photo] = {}
    files = {name: file for file, name in reversed(names.items())}
    for file, viewmat in registered(model).items():
        name = names[file]
        if file == files[name]:
            camera = around(*sizes[name]) if cameras.photos.around else of_image[file]
            found[name] = Photo(
                as_text(name), folder / name, camera, viewmat, masks.get(name), details.get(name)
            )
    notes = [str(cameras.report), *cameras.photos.notes]
    points, colors = keep_finite(*model_points(model), notes)
    seen = None
    if len(points) == model.num_points3D():
        parts: dict[str, list[NDArray[np.intp]]] = {}
        for file, rows in seen_points(model).items():
            parts.setdefault(names[file], []).append(rows)
        seen = {as_text(name): np.unique(np.concatenate(rows)) for name, rows in parts.items()}
    return Capture(
        "photos",
        [photo for _, photo in sorted(found.items())],
        cameras.photos.downscale,
        points,
        colors,
        folder=folder,
        notes=notes,
        tracks=TrackStatistics(cameras.report.track_length, cameras.report.reprojection_error_px),
        seen=seen,
        sfm=cameras.report,
    )


def as_stored(model: pycolmap.Reconstruction, sizes: list[tuple[int, int]], faces: int) -> None:
    """The cameras and observations of a model at the photos' stored sizes, px: of each camera, or of so many
    for the faces of a photo."""
    wanted = {number: sizes[(number - 1) // faces] for number in model.cameras}
    if all((camera.width, camera.height) == wanted[number] for number, camera in model.cameras.items()):
        return
    for image in model.images.values():
        camera, size = model.cameras[image.camera_id], wanted[image.camera_id]
        if (camera.width, camera.height) != size:
            for point in image.points2D:
                point.xy = point.xy * size / (camera.width, camera.height)
    for number, camera in model.cameras.items():
        camera.rescale(*wanted[number])
    model.update_point_3d_errors()


def _upright(viewmats: NDArray[np.float64], exif: list[Exif]) -> NDArray[np.float64]:
    """The rotation [3, 3] that takes the cameras' mean up to UP; the unit where they agree on none."""
    mean = np.einsum("nji,nj->ni", viewmats[:, :3, :3], ups(exif)).mean(0)
    length = float(np.linalg.norm(mean))
    if length < 0.3:  # they agree on none
        return np.eye(3)
    return Rotation.align_vectors(np.array([UP]), (mean / length)[None])[0].as_matrix()
