"""COLMAP in a process of its own: the program `python program.py COMMAND DIRECTORY`.

So a crash or a hang of COLMAP cannot take its caller along. It imports nothing of hqgs, so that it starts at
once. DIRECTORY holds `input.npz`: photos (the folder), names [V], and of known cameras sizes [V, 2] as width
and height and Ks [V, 3, 3], of known poses viewmats [V, 4, 4]. If DIRECTORY has a folder `masks`, each photo
has a mask `NAME.png` there. The files of COLMAP and the answer go into DIRECTORY:

`triangulate`: points for known cameras and poses, `points.npz` (points [P, 3] float32, colors [P, 3] uint8,
and of each sighting the numbers of the photo and of the point: photos [O], rows [O]).

`reconstruct THREADS`: poses and points, the folder `model` with the largest COLMAP model; none if there is
no model. Known cameras stay as they are. Unknown ones are SIMPLE_RADIAL, one for all photos if they have one
size.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image

MAX_FEATURES = 2048  # per photo, of known cameras
MIN_TRACK, MAX_ERROR = 3, 1.0  # a point needs so many photos, and may miss them by so many pixels on average


def triangulate(directory: Path) -> None:
    """SIFT, exhaustive matching, epipolar check against the known poses, triangulation; all on one thread.

    The check with known poses needs no RANSAC, so the same photos give the same points.
    """
    database, given = directory / "colmap.db", _given(directory)
    known = _known_cameras(given, database)
    photos, names = Path(str(given["photos"])), given["names"].tolist()
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    extraction.sift.max_num_features = MAX_FEATURES
    _match(directory, photos, names, extraction, threads=1)
    pycolmap.guided_geometric_verification(known, database, num_threads=1)
    (directory / "model").mkdir()
    model = pycolmap.triangulate_points(
        known, database, photos, directory / "model", options=_pipeline_options()
    )
    points = [model.points3D[k] for k in sorted(model.points3D)]
    points = [p for p in points if p.track.length() >= MIN_TRACK and p.error <= MAX_ERROR]
    np.savez(
        directory / "points.npz",
        points=np.array([p.xyz for p in points], np.float32).reshape(-1, 3),
        colors=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        photos=np.array([e.image_id - 1 for p in points for e in p.track.elements], np.intp),
        rows=np.array([k for k, p in enumerate(points) for _ in p.track.elements], np.intp),
    )


def reconstruct(directory: Path, threads: int) -> None:
    """SIFT, exhaustive matching, RANSAC, incremental mapping; the threads change no bit of the result.

    Features and matches of one photo or pair depend on no other, and are read back in the order of their
    numbers. What draws random numbers or adds up in the order of arrival has one thread and the seed 0.
    """
    database, given = directory / "colmap.db", _given(directory)
    photos, names, fixed = Path(str(given["photos"])), given["names"].tolist(), "Ks" in given
    if fixed:
        _known_cameras(given, database)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    _match(directory, photos, names, extraction, threads)
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = 1
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = 0
    pycolmap.geometric_verification(database, verifier, two_view_geometry_options=geometry)
    options = _pipeline_options()
    options.min_model_size = 3
    if fixed:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    models = pycolmap.incremental_mapping(database, photos, directory / "models", options=options)
    if models:
        best = max(sorted(models), key=lambda k: (models[k].num_reg_images(), models[k].num_points3D()))
        (directory / "model").mkdir()
        models[best].write_binary(directory / "model")


def _match(
    directory: Path,
    photos: Path,
    names: list[str],
    extraction: pycolmap.FeatureExtractionOptions,
    threads: int,
) -> None:
    """Features and matches of every pair, not yet checked by geometry."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"  # of photos whose camera is not in the database yet
    if (directory / "masks").is_dir():
        reader.mask_path = directory / "masks"
    database = directory / "colmap.db"
    pycolmap.extract_features(
        database,
        photos,
        image_names=names,
        camera_mode=_camera_mode(photos, names),
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.skip_geometric_verification = True
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)


def _camera_mode(photos: Path, names: list[str]) -> pycolmap.CameraMode:
    """One camera for all photos of one size; it does not touch those that the database has already."""
    sizes = set()
    for name in names:
        with Image.open(photos / name) as photo:
            sizes.add(photo.size)
    return pycolmap.CameraMode.SINGLE if len(sizes) == 1 else pycolmap.CameraMode.AUTO


def _pipeline_options() -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
    return options


def _given(directory: Path) -> dict[str, Any]:
    with np.load(directory / "input.npz", allow_pickle=False) as data:
        return dict(data)


def _known_cameras(given: dict[str, Any], database: Path) -> pycolmap.Reconstruction:
    """A reconstruction without points, and a database that gives its cameras and images the same numbers."""
    known = pycolmap.Reconstruction()
    names, sizes, Ks = (given[key] for key in ("names", "sizes", "Ks"))
    viewmats = given.get("viewmats", np.broadcast_to(np.eye(4), (len(names), 4, 4)))
    with pycolmap.Database.open(database) as db:
        for k, (size, K, viewmat) in enumerate(zip(sizes.tolist(), Ks, viewmats, strict=True), 1):
            pinhole = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
            camera = pycolmap.Camera(
                camera_id=k, model="PINHOLE", width=size[0], height=size[1], params=pinhole
            )
            camera.has_prior_focal_length = True
            image = pycolmap.Image(name=str(names[k - 1]), camera_id=k, image_id=k)
            known.add_camera_with_trivial_rig(camera)
            known.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
            db.write_camera(camera, use_camera_id=True)
            db.write_rig(known.rigs[k], use_rig_id=True)
            db.write_image(image, use_image_id=True)
            db.write_frame(known.frames[k], use_frame_id=True)
    return known


def main(command: str, directory: str, *options: str) -> None:
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL.value)
    pycolmap.set_random_seed(0)
    if command == "triangulate":
        triangulate(Path(directory))
    else:
        reconstruct(Path(directory), *map(int, options))


if __name__ == "__main__":
    main(*sys.argv[1:])
