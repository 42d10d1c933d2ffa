"""Points by structure from motion with known cameras: the program `python sfm.py DIRECTORY`.

It runs as its own process, so that a crash or a hang of COLMAP cannot take its caller along, and it imports
nothing of hqgs, so that it starts at once. DIRECTORY holds `photos/` and `cameras.npz` (names [V], sizes
[V, 2] as width and height, Ks [V, 3, 3], viewmats [V, 4, 4]); the answer is `points.npz` (points [P, 3]
float32, colors [P, 3] uint8).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pycolmap

MAX_FEATURES = 2048  # per photo
MIN_TRACK, MAX_ERROR = 3, 1.0  # a point needs so many photos, and may miss them by so many pixels on average


def triangulate(directory: Path) -> None:
    """SIFT, exhaustive matching, epipolar check against the known poses, triangulation; all on one thread.

    The check with known poses needs no RANSAC, so the same photos give the same points.
    """
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL.value)
    pycolmap.set_random_seed(0)
    database, photos = directory / "colmap.db", directory / "photos"
    known = _known_cameras(directory, database)
    names = [image.name for _, image in sorted(known.images.items())]
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    extraction.sift.max_num_features = MAX_FEATURES
    pycolmap.extract_features(
        database, photos, image_names=names, extraction_options=extraction, device=pycolmap.Device.cpu
    )
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    matching.skip_geometric_verification = True
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    pycolmap.guided_geometric_verification(known, database, num_threads=1)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = options.triangulation.random_seed = 0
    (directory / "model").mkdir()
    model = pycolmap.triangulate_points(known, database, photos, directory / "model", options=options)
    points = [model.points3D[k] for k in sorted(model.points3D)]
    points = [p for p in points if p.track.length() >= MIN_TRACK and p.error <= MAX_ERROR]
    np.savez(
        directory / "points.npz",
        points=np.array([p.xyz for p in points], np.float32).reshape(-1, 3),
        colors=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
    )


def _known_cameras(directory: Path, database: Path) -> pycolmap.Reconstruction:
    """A reconstruction without points, and a database that gives its cameras and images the same numbers."""
    with np.load(directory / "cameras.npz", allow_pickle=False) as data:
        names, sizes, Ks, viewmats = (data[key] for key in ("names", "sizes", "Ks", "viewmats"))
    known = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as db:
        for k, (size, K, viewmat) in enumerate(zip(sizes.tolist(), Ks, viewmats, strict=True), 1):
            pinhole = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
            camera = pycolmap.Camera(
                camera_id=k, model="PINHOLE", width=size[0], height=size[1], params=pinhole
            )
            image = pycolmap.Image(name=str(names[k - 1]), camera_id=k, image_id=k)
            known.add_camera_with_trivial_rig(camera)
            known.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
            db.write_camera(camera, use_camera_id=True)
            db.write_rig(known.rigs[k], use_rig_id=True)
            db.write_image(image, use_image_id=True)
            db.write_frame(known.frames[k], use_frame_id=True)
    return known


if __name__ == "__main__":
    triangulate(Path(sys.argv[1]))
