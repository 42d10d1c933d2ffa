"""Scene loading: COLMAP, LLFF (with Deblur-NeRF's marker), nerfstudio, instant-ngp and Blender folders."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from hqgs.base.files import existing_folder
from hqgs.photos.files import UnreadableError
from hqgs.scene.capture import Capture, list_photos, photo_folder
from hqgs.scene.formats.colmap import find_models, read_colmap
from hqgs.scene.formats.degradation_json import DegradedFolder, read_degraded_folder, with_low
from hqgs.scene.formats.llff import POSES, hold_marker, read_llff
from hqgs.scene.formats.transforms import SINGLE, TRAIN, read_transforms
from hqgs.scene.random_points import random_points
from hqgs.scene.scene import Scene, Tracks, View
from hqgs.scene.sfm.bare_photos import bare_photos, read_photos
from hqgs.scene.views import load_views


def load_scene(
    path: str | Path,
    downscale: float = 1.0,
    test_every: int = 8,
    reconstruct: bool = False,
    skip_unreadable: bool = False,
    keep_sfm: Path | None = None,
) -> Scene:
    """Read a scene folder into memory: pinhole cameras, uint8 photos, starting points.

    The format is recognised in this order: a COLMAP model with photos (`sparse/0`, `sparse`, or the folder
    itself; `images`), `transforms.json` or `transforms_train.json`, `poses_bounds.npy`. Distorted photos are
    undistorted at their stored size, then scaled down by `downscale` (>= 1) by area; where a COLMAP or LLFF
    scene has `images_N` for N = `downscale`, those photos are taken as they are.

    Views are sorted by name; every `test_every`-th one (index % test_every == 0) is a test view, 0 means
    none. A Blender pair of files names its own test views; a marker file `hold=N` stands for test_every = N,
    counted over the photos in the folder. `Scene.notes` says which rule and which files were used.

    A folder that `hqgs degrade` wrote names its held-out photos itself. Its small photos go into `View.low`
    at downscale 1, the only one at which they stand for `View.image`.

    With `reconstruct` a folder that holds photos alone gets its cameras and points from them (`read_photos`).
    `keep_sfm` is a folder for that reconstruction, which the next call takes from there.

    With `skip_unreadable` training photos that cannot be decoded (or whose mask or small photo cannot) are
    left out, as long as at least half of the training photos remain; `Scene.notes` names them. The other
    photos are training or test views as if all could be read. A test photo must be readable, or the numbers
    of two copies of a scene could not be compared.

    Raises FileNotFoundError for a missing folder or photo, ValueError for anything else that is wrong.
    """
    root = existing_folder(path)
    if not (math.isfinite(downscale) and downscale >= 1):
        raise ValueError(f"downscale must be at least 1, got {downscale}")
    if test_every < 0:
        raise ValueError(f"test_every must be at least 0, got {test_every}")
    capture = _read(root, downscale, reconstruct, keep_sfm)
    degraded = read_degraded_folder(root)
    if degraded is not None:
        notes = [*degraded.notes, *capture.notes]
        capture = replace(capture, test_names=frozenset(degraded.held_out), notes=notes)
    notes = list(capture.notes)
    test_names = _test_names(root, capture, test_every, notes)
    train_names = frozenset(photo.name for photo in capture.photos) - test_names
    optional = train_names if skip_unreadable else frozenset[str]()
    views, unreadable = load_views(capture.photos, capture.downscale, optional)
    if degraded is not None and downscale == 1:
        views = _with_lows(views, degraded, root, optional, unreadable)
    train = [v for v in views if v.name not in test_names]
    test = [v for v in views if v.name in test_names]
    if not train_names:
        raise ValueError(f"{root}: all {len(views)} views are test views, none is left to train on")
    if unreadable:
        _check_half(train, unreadable)
        notes.append(
            f"{len(unreadable)} of {len(train_names)} training photos cannot be read and were left out: "
            + ", ".join(sorted(unreadable))
        )
    points, colors = capture.points, capture.point_colors
    if len(points) == 0:
        points, colors, note = random_points(train, capture.near_far)
        notes.append(note)
    tracks = _tracks(capture, views)
    return Scene(root.name, train, test, points, colors, capture.source, notes, tracks, capture.seen)


def _read(root: Path, downscale: float, reconstruct: bool, keep_sfm: Path | None) -> Capture:
    has_model, has_photos = bool(find_models(root)), photo_folder(root, downscale) is not None
    others = [name for name in (SINGLE, TRAIN, POSES) if (root / name).is_file()]
    if has_model and (has_photos or not others):
        capture = read_colmap(root, downscale)
        if others:
            note = (
                f"cameras and points are both the COLMAP model's, in its frame; not read: {', '.join(others)}"
            )
            capture = replace(capture, notes=[*capture.notes, note])
        return capture
    if SINGLE in others or TRAIN in others:
        return read_transforms(root, downscale)
    if POSES in others:
        return read_llff(root, downscale)
    bare = bare_photos(root, downscale) is not None
    if bare and reconstruct:
        return read_photos(root, downscale, keep_sfm)
    entries = sorted(p.name for p in root.iterdir())
    found = ", ".join(entries[:12]) + (" ..." if len(entries) > 12 else "") if entries else "nothing"
    raise ValueError(
        f"{root} is no scene: looked for a COLMAP model (cameras, images and points3D as .bin or .txt in "
        f"sparse/0, sparse or the folder), {SINGLE}, {TRAIN}, {POSES}; found {found}"
        + ("; --sfm makes a scene of photos alone" if bare else "")
    )


def _with_lows(
    views: list[View],
    folder: DegradedFolder,
    root: Path,
    optional: frozenset[str],
    unreadable: dict[str, UnreadableError],
) -> list[View]:
    """The views with their small photos, without those of `optional` whose small photo cannot be read."""
    found = []
    for view in views:
        try:
            found.append(with_low(view, folder, root))
        except UnreadableError as error:
            if view.name not in optional:
                raise
            unreadable[view.name] = error
    return found


def _check_half(train: list[View], unreadable: dict[str, UnreadableError]) -> None:
    """Raise the first error unless at least half of the training photos can be read."""
    if len(train) < len(unreadable):
        raise unreadable[min(unreadable)]


def _tracks(capture: Capture, views: list[View]) -> Tracks | None:
    """Those of the capture, in px of the views."""
    if capture.tracks is None:
        return None
    widths = {photo.name: photo.camera.width for photo in capture.photos}
    scales = [view.camera.width / widths[view.name] for view in views]
    return replace(capture.tracks, error=capture.tracks.error * float(np.mean(scales)))


def _test_names(root: Path, capture: Capture, test_every: int, notes: list[str]) -> frozenset[str]:
    """Names of the test views; says in `notes` where the scene itself decides."""
    if capture.test_names is not None:
        return capture.test_names
    hold = hold_marker(root)
    if hold is not None and capture.folder is not None:
        # The marker speaks of the photos in the folder: a blurred one that was not registered still counts,
        # or the sharp views after it would slip into the training set.
        held = {capture.folder / name for name in list_photos(capture.folder)[::hold]}
        notes.append(f"hold={hold}: every {hold}th photo is held out, the others are degraded")
        return frozenset(p.name for p in capture.photos if p.path in held)
    return frozenset([p.name for p in capture.photos][::test_every]) if test_every else frozenset()
