"""COLMAP's database: photos and their cameras, features and matches before their geometry is checked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

LEAST_PHOTOS = 3  # of a scene or model: one alone shows no depth
PROBED = 8  # photos that tell of all what files do not: how rich they are, whether they are panoramas
LARGEST = 1600  # px a side: features of larger photos cost minutes and place no camera better than that
FOCAL = pycolmap.ImageReaderOptions().default_focal_length_factor  # in longer sides, where nothing tells
MATCHES, INLIERS = "read_num_matches", "read_two_view_geometry_num_inliers"  # of the database
BLOCKS = 8  # of photos, squared: what matching tells its progress in, and goes on from when interrupted


def seen_size(size: tuple[int, int], largest: int) -> tuple[int, int]:
    """A size [2], px, no side longer than about `largest`: the one near it that distorts least."""
    if max(size) <= largest:
        return size
    small = [tuple(side * share / max(size) for side in size) for share in range(largest - 15, largest + 1)]
    width, height = min(reversed(small), key=lambda sides: sum(abs(side - round(side)) for side in sides))
    return max(1, round(width)), max(1, round(height))


def known_cameras(given: dict[str, Any], database: Path) -> pycolmap.Reconstruction:
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


def new_cameras(given: dict[str, Any], database: Path) -> None:
    """A database with the photos and their cameras, whose focal lengths and distortion COLMAP finds.

    Of photos of all around one rig for each size of their faces, known but for its pose: its sensors are
    turned by `rotations` [F, 3, 3], which map the first one's frame into theirs; the F faces of a photo are
    one frame.
    """
    rotations = given.get("rotations", np.eye(3)[None])
    faces, names, camera_of = len(rotations), given["names"].tolist(), given["camera_of"].tolist()
    model, distortion = ("SIMPLE_RADIAL", [0.0]) if faces == 1 else ("SIMPLE_PINHOLE", [])
    with pycolmap.Database.open(database) as db:
        for number, (focal, size) in enumerate(
            zip(given["focals"].tolist(), given["sizes"].tolist(), strict=True)
        ):
            rig = pycolmap.Rig(rig_id=number + 1)
            for k, rotation in enumerate(rotations):
                params = [focal or FOCAL * max(size), size[0] / 2, size[1] / 2, *distortion]
                camera = pycolmap.Camera(
                    camera_id=number * faces + k + 1,
                    model=model,
                    width=size[0],
                    height=size[1],
                    params=params,
                )
                camera.has_prior_focal_length = focal > 0
                db.write_camera(camera, use_camera_id=True)
                if k == 0:
                    rig.add_ref_sensor(camera.sensor_id)
                else:
                    turned = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.zeros(3))
                    rig.add_sensor(camera.sensor_id, turned)
            db.write_rig(rig, use_rig_id=True)
        for start in range(0, len(names), faces):
            number = camera_of[start]
            frame = pycolmap.Frame(frame_id=start // faces + 1, rig_id=number + 1)
            for k in range(faces):
                image = pycolmap.Image(
                    name=names[start + k], camera_id=number * faces + k + 1, image_id=start + k + 1
                )
                db.write_image(image, use_image_id=True)
                frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)


def extract(directory: Path, photos: Path, names: list[str], extraction: Any, database: Path) -> None:
    """Features of photos that have none yet."""
    reader = pycolmap.ImageReaderOptions()
    if (directory / "masks").is_dir():
        reader.mask_path = directory / "masks"
    found = {"reader_options": reader, "extraction_options": extraction, "device": pycolmap.Device.cpu}
    pycolmap.extract_features(database, photos, image_names=names, **found)


def match(directory: Path, names: list[str], pairs: Any, threads: int, database: Path) -> None:
    """Matches of the pairs [P, 2] that have none yet, None: of all; geometry is not checked."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.skip_geometric_verification = threads, True
    if pairs is None:
        every = pycolmap.ExhaustivePairingOptions()
        every.block_size = max(2, -(-len(names) // BLOCKS))
        pycolmap.match_exhaustive(
            database, matching_options=matching, pairing_options=every, device=pycolmap.Device.cpu
        )
        return
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path, listed.block_size = directory / "pairs.txt", -(-len(pairs) // BLOCKS**2)
    text = "".join(f"{names[i]} {names[j]}\n" for i, j in pairs.tolist())
    listed.match_list_path.write_text(text, encoding="utf-8")
    pycolmap.match_image_pairs(
        database, matching_options=matching, pairing_options=listed, device=pycolmap.Device.cpu
    )


def table(database: Path, photos: int, read: str) -> NDArray[np.int64]:
    """Counts [V, V] of each pair of photos, MATCHES or INLIERS."""
    found = np.zeros((photos, photos), np.int64)
    with pycolmap.Database.open(database) as db:
        for pair, count in zip(*getattr(db, read)(), strict=True):
            a, b = (number - 1 for number in pycolmap.pair_id_to_image_pair(pair))
            found[a, b] = found[b, a] = count
    return found


def pipeline_options() -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
    return options


def join(databases: Sequence[Path], into: Path, photos: int) -> None:
    """Write the features and matches of databases into one of the same photos, side by side.

    Each is matched by itself: a feature that two of them show would pass for ambiguous.
    """
    found = [[np.zeros((0, 6), np.float32)] for _ in range(photos + 1)]  # by the photo's number, from 1 on
    before, matches = np.zeros(photos + 1, np.int64), dict[int, list[NDArray[Any]]]()
    for path in databases:
        with pycolmap.Database.open(path) as db:
            for pair, rows in zip(*db.read_all_matches(), strict=True):
                matches.setdefault(pair, []).append(rows + before[[*pycolmap.pair_id_to_image_pair(pair)]])
            for k in (k for k in range(1, photos + 1) if db.exists_keypoints(k)):
                found[k].append(db.read_keypoints(k))
                before[k] += len(found[k][-1])
    with pycolmap.Database.open(into) as db:
        for k in range(1, photos + 1):
            db.write_keypoints(k, np.concatenate(found[k]))
        for pair, rows in matches.items():
            db.write_matches(*pycolmap.pair_id_to_image_pair(pair), np.concatenate(rows).astype(np.uint32))
