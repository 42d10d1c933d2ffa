"""Scene loading: COLMAP, LLFF (with Deblur-NeRF's marker), nerfstudio, instant-ngp and Blender folders."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.base.evenly import evenly
from hqgs.base.options import called_with, given
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.text import as_text, some
from hqgs.photos import profiles
from hqgs.photos.files import UnreadableError, stored_size, told_colors
from hqgs.photos.suffixes import PHOTO_SUFFIXES
from hqgs.scene import masks
from hqgs.scene.axes import unseen, with_true_axes
from hqgs.scene.capture import Capture, Photo, list_photos, no_points, odd_lenses, photo_folder
from hqgs.scene.checks import broken, elsewhere, nothing
from hqgs.scene.constants import BACKGROUND, COPY_SIDE, TEST_EVERY
from hqgs.scene.faces import CUBE, WIDE, around, face_name, faces_of
from hqgs.scene.film import frame_details
from hqgs.scene.formats.colmap import find_models, find_models_below, half_model, read_colmap
from hqgs.scene.formats.degradation_json import DegradedFolder, read_degraded_folder, with_low
from hqgs.scene.formats.llff import POSES, hold_marker, read_llff
from hqgs.scene.formats.transforms import SINGLE, TRAIN, read_transforms
from hqgs.scene.geometry import in_frame
from hqgs.scene.known_points import with_first_points
from hqgs.scene.metres import Distance, named_photos
from hqgs.scene.names import existing_folder
from hqgs.scene.options import LoadOptions
from hqgs.scene.place import cut_outs, located, placed, without_missing, without_poseless, without_strays
from hqgs.scene.scene import Camera, Scene, TrackStatistics, View
from hqgs.scene.sfm.bare_photos import bare_photos, readable
from hqgs.scene.sfm.photos_alone import Search, read_photos
from hqgs.scene.views import load_views

COLMAP = "colmap"
MOST_BYTES = 4e9  # of all photos, where `longest` bounds them; 1,000 of 1600 x 1200 px would be 5.8 GB


@dataclass(frozen=True, kw_only=True)
class FolderCall(LoadOptions):
    """The arguments of `load_scene`."""

    keep_sfm: Path | None = None
    on_stage: OnStage = silent


@called_with(FolderCall)
def load_scene(asked: FolderCall) -> Scene:
    """The scene of a folder; `hqgs.load` says what the options are.

    The format is recognised in this order: a COLMAP model with photos (`sparse/0`, `sparse`, or the folder
    itself; `images`), `transforms.json` or `transforms_train.json`, `poses_bounds.npy`, photos alone, whose
    cameras and points `keep_sfm` keeps for the next call. Where a COLMAP or LLFF scene has `images_N` for
    N = `downscale`, those photos are taken as they are.

    A folder of `hqgs degrade` and a Blender pair of files name the held-out photos themselves; a marker file
    `hold=N` stands for test_every = N, counted over the photos in the folder. Small photos of `hqgs degrade`
    go into `View.low` at downscale 1, the only one at which they stand for `View.image`.

    Raises FileNotFoundError for a missing folder or photo, ValueError for anything else that is wrong.
    """
    root, notes = scene_folder(asked.path)
    downscale, test_every = given(asked.downscale, 1.0), given(asked.test_every, TEST_EVERY)
    if not (math.isfinite(downscale) and downscale >= 1):
        raise ValueError(f"downscale must be at least 1, got {downscale}")
    if test_every < 0:
        raise ValueError(f"test_every must be at least 0, got {test_every}")
    search = Search(asked.keep_sfm, asked.on_stage, coarsely(asked.longest, asked.coarse))
    capture = with_faces(_read(root, downscale, asked.sfm, search))
    capture = capture if asked.longest is None else bounded(capture, asked.longest)
    degraded = read_degraded_folder(root)
    notes += [] if degraded is None else degraded.notes
    notes += [*capture.notes, *masks.told(root, capture), *odd_lenses(capture)]
    if capture.source != "photos":  # those were told of when they were looked at
        notes += profiles.told({photo.name: told_colors(photo.path) for photo in capture.photos})
    held_out = held_out_names(root, capture, test_every, notes, degraded)
    capture = without_poseless(root, without_missing(root, capture, notes), notes)
    capture = replace(capture, photos=masks.with_turns(capture.photos, notes))
    small = degraded if downscale == capture.downscale == 1 else None
    capture, views = _views(root, capture, asked, small, held_out, notes)
    place = located(capture)
    scene = Scene(
        root.name,
        [view for view in views if view.name not in held_out],
        [view for view in views if view.name in held_out],
        capture.points.astype(np.float64),
        capture.point_colors,
        capture.source,
        notes,
        _tracks(capture, views),
        capture.seen,
        capture.sfm,
        world=replace(capture.world, place=place),
    )
    scene = scene if len(scene.points) else with_first_points(scene, capture.near_far)
    return scene if place is None else replace(scene, notes=[*scene.notes, str(place)])


def _views(
    root: Path,
    capture: Capture,
    asked: FolderCall,
    degraded: DegradedFolder | None,
    held_out: frozenset[str],
    notes: list[str],
) -> tuple[Capture, list[View]]:
    """The capture in its frame, without strays, and its photos, decoded; `degraded`: where small ones are.
    `notes` hears of what was turned, and of photos that cannot be used.

    ValueError where too few are left to train on, or to measure with.
    """
    optional = frozenset(photo.name for photo in capture.photos if asked.skip_unreadable)
    over = BACKGROUND if cut_outs(capture) else None
    views, unreadable = load_views(capture.photos, capture.downscale, optional, asked.on_stage, over)
    capture, turned = with_true_axes(capture, views)
    notes += [] if turned is None else [turned]
    capture = placed(without_strays(capture, notes), notes)
    poses = {photo.name: photo.viewmat for photo in capture.photos}
    views = [
        replace(view, camera=replace(view.camera, viewmat=poses[view.name]))
        for view in views
        if view.name in poses
    ]
    names = frozenset(poses)
    if any(view.empty is not None for view in views):
        notes.append(
            f"the {len(views)} photos have transparent pixels, which are black in photos and renders"
        )
    if degraded is not None:
        views = _with_lows(views, degraded, root, optional, unreadable)
    if capture.source != "photos":
        notes += unseen(root, views, capture.points)
    if not names - held_out:
        raise ValueError(f"{root}: all {len(views)} photos are held out, none is left to train on")
    for those, what in ((names - held_out, "training"), (names & held_out, "held-out")):
        gone = {name: unreadable[name] for name in those if name in unreadable}
        if len(those) < 2 * len(gone):
            raise gone[min(gone)]
        if gone:
            notes.append(
                f"{len(gone)} of {len(those)} {what} photos cannot be used and were left out: "
                f"{some(sorted(gone))}. The first: {gone[min(gone)]}"
            )
    return capture, views


def coarsely(longest: int | None, coarse: bool | None = None) -> bool:
    """Whether cameras of photos alone are found coarsely: as asked, or where `longest` makes them small."""
    return longest is not None and longest <= COPY_SIDE if coarse is None else coarse


def load_pictures(
    path: str | Path,
    downscale: float | None = None,
    most: int = 16,
    longest: int | None = None,
    test_every: int = 0,
) -> Scene | None:
    """Some photos of a folder that holds photos alone, spread over it, as a scene that has no poses.

    Each camera is a placeholder: a plausible one at the origin. None where the folder has cameras of its own.
    `longest` bounds all photos of the folder as `load_scene` does, and those that `test_every` holds out are
    not among them. `Scene.of` tells how many they were chosen from. ValueError where it holds neither.
    """
    (root, _), downscale = scene_folder(path), given(downscale, 1.0)
    if formats_of(root, downscale) or (found := bare_photos(root, downscale)) is None:
        return None
    photos = readable(found)
    names, details = photos.names, frame_details(photos.folder)
    trained = [k for k in range(len(names)) if not test_every or k % test_every]
    chosen = []
    for k in (trained[i] for i in evenly(len(trained), most // len(CUBE) if photos.around else most)):
        size = photos.sizes[k]
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 1.2 * max(size), *size)
        camera = around(*size) if photos.around else camera
        chosen.append(
            Photo(as_text(names[k]), photos.folder / names[k], camera, np.eye(4), film=details.get(names[k]))
        )
    shown = with_faces(Capture("photos", chosen, photos.downscale, *no_points()))
    if longest is not None:
        sizes = photos.sizes
        if photos.around:
            sizes = [(face.width, face.height) for size in sizes for face in faces_of(around(*size))]
        shown = replace(shown, downscale=bound(sizes, photos.downscale, longest))
    views, _ = load_views(shown.photos, shown.downscale)
    notes = [f"cannot be read ({len(photos.unreadable)}): {some(sorted(photos.unreadable))}"]
    notes = [*photos.notes, *(notes if photos.unreadable else [])]
    nothing = no_points()
    points, colors = nothing[0].astype(np.float32), nothing[1]
    of = len(trained) * (len(CUBE) if photos.around else 1)
    return Scene(root.name, views, [], points, colors, "photos", notes, of=of)


def check_names(path: str | Path, downscale: float | None, distance: Distance) -> None:
    """ValueError where photos alone lack one of the two that a distance names: before COLMAP works."""
    (root, _), downscale = scene_folder(path), given(downscale, 1.0)
    if not formats_of(root, downscale) and (found := bare_photos(root, downscale)) is not None:
        named_photos(found.names, distance)


def scene_folder(path: str | Path) -> tuple[Path, list[str]]:
    """The folder of a scene: `path`, or the one in it that has cameras, where itself has none; and a note.

    ValueError where several have cameras.
    """
    root = existing_folder(path)
    bare = photo_folder(root, 1.0) is not None or any(
        path.suffix.lower() in PHOTO_SUFFIXES for path in root.iterdir()
    )
    if bare or formats_of(root, 1.0):
        return root, []
    names = (SINGLE, TRAIN, POSES)
    below = ({file.parent for name in names for file in root.glob(f"{deep}/{name}")} for deep in ("*", "*/*"))
    found = sorted(next(filter(None, below), ()))
    if len(found) > 1:
        inner = some([folder.relative_to(root).as_posix() for folder in found])
        raise ValueError(f"{root} holds several scenes: give one of {inner}")
    return (found[0], [f"the scene is the one in {found[0].relative_to(root)}"]) if found else (root, [])


def formats_of(root: Path, downscale: float) -> list[str]:
    """Names of the formats that a folder is in. A model further down counts where there is nothing else."""
    has_model, has_photos = bool(find_models(root)), photo_folder(root, downscale) is not None
    others = [name for name in (SINGLE, TRAIN, POSES) if (root / name).is_file()]
    if not others and not has_model and half_model(root) is None:
        has_model = bool(find_models_below(root))
    return [COLMAP, *others] if has_model and (has_photos or not others) else others


def _read(root: Path, downscale: float, sfm: bool, search: Search) -> Capture:
    formats = formats_of(root, downscale)
    others = [name for name in formats if name != COLMAP]
    if COLMAP in formats:
        capture = read_colmap(root, downscale)
        if others:
            note = f"cameras and points are read from the COLMAP model; not read: {', '.join(others)}"
            capture = replace(capture, notes=[*capture.notes, note])
        return capture
    if SINGLE in others or TRAIN in others:
        return read_transforms(root, downscale)
    if POSES in others:
        return read_llff(root, downscale)
    if not sfm and (half := broken(root)) is not None:
        raise ValueError(f"{half}; `--sfm` finds cameras and points from the photos instead")
    if (photos := bare_photos(root, downscale)) is not None:
        told = [] if sfm else elsewhere(root)
        if told:
            search.on_stage(Stage("COLMAP", 0, len(photos.names), told[0]))
        capture = read_photos(root, photos, search)
        return replace(capture, notes=[*capture.notes, *told])
    raise ValueError(nothing(root))


def bound(sizes: list[tuple[int, int]], downscale: float, longest: int) -> float:
    """What photos of these sizes are scaled down by: `downscale`, or more where `load_scene` bounds them."""
    pixels = sum(width * height for width, height in sizes)
    return max(downscale, max(map(max, sizes)) / longest, math.sqrt(3 * pixels / MOST_BYTES))


def bounded(capture: Capture, longest: int) -> Capture:
    """The capture with its photos scaled down until no side is longer, and all of them fit into memory."""
    sizes = [size for photo in capture.photos if photo.path.is_file() and (size := _size(photo))]
    if not sizes:
        return capture
    largest, downscale = max(sizes, key=max), bound(sizes, capture.downscale, longest)
    if downscale <= capture.downscale:
        return capture
    width, height = (round(side / downscale) for side in largest)
    straight = all(photo.camera.model.name.endswith("PINHOLE") for photo in capture.photos)
    then = "" if straight else ", before undistortion moves their borders"
    up_to, count = "" if len(set(sizes)) == 1 else "up to ", len(sizes)
    note = (
        f"{count} photos of {up_to}{largest[0]} x {largest[1]} px are used at {up_to}{width} x {height} px "
        f"(sides divided by {downscale:.3g}{then}); `--downscale 1` uses full size and takes far longer"
    )
    if downscale > max(max(largest) / longest, capture.downscale):
        note += (
            f". A side may have {longest} px, but so many photos would take more than "
            f"{MOST_BYTES / 1e9:g} GB of memory then"
        )
    return replace(capture, downscale=downscale, notes=[*capture.notes, note])


def _size(photo: Photo) -> tuple[int, int] | None:
    """Width and height of a photo as it is stored; of the face of one, what it shows of that.

    None: it cannot be opened; `load_views` meets the same error, and names it.
    """
    try:
        width, height = stored_size(photo.path)
    except UnreadableError:
        return None
    if (face := photo.face) is None:
        return width, height
    return round(face.width * width / photo.camera.width), round(face.height * height / photo.camera.height)


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


def _tracks(capture: Capture, views: list[View]) -> TrackStatistics | None:
    """Those of the capture, in px of the views."""
    if capture.tracks is None:
        return None
    widths = {photo.name: (photo.face or photo.camera).width for photo in capture.photos}
    scales = [view.camera.width / widths[view.name] for view in views]
    return replace(capture.tracks, error=capture.tracks.error * float(np.mean(scales)))


def held_out_names(
    root: Path, capture: Capture, test_every: int, notes: list[str], degraded: DegradedFolder | None
) -> frozenset[str]:
    """Names of the photos to hold out: `degraded`'s if given; `notes` hears where the scene decides."""
    if degraded is not None:
        return frozenset(degraded.held_out)
    if capture.test_names is not None:
        return capture.test_names
    hold = hold_marker(root)
    if hold is not None and capture.folder is not None:
        # The marker speaks of the photos in the folder: a blurred one that was not registered still counts,
        # or the sharp views after it would slip into the training set.
        held = {capture.folder / name for name in list_photos(capture.folder)[::hold]}
        notes.append(f"hold={hold}: every {hold}th photo is held out, the others are degraded")
        return frozenset(p.name for p in capture.photos if p.path in held)
    files = list(dict.fromkeys(p.path for p in capture.photos))
    held = set(files[::test_every]) if test_every else set[Path]()
    return frozenset(p.name for p in capture.photos if p.path in held)


def with_faces(capture: Capture) -> Capture:
    """The capture with the faces of its wide photos in their place."""
    faces = {photo.name: faces_of(photo.camera) for photo in capture.photos}
    wide = [name for name, found in faces.items() if found]
    if not wide:
        return capture
    called = {name: [face_name(name, face.name) for face in found] or [name] for name, found in faces.items()}
    photos, seen = list[Photo](), dict[str, NDArray[np.intp]]()
    for photo in capture.photos:
        rows = None if capture.seen is None else capture.seen.get(photo.name)
        if not faces[photo.name]:
            photos.append(photo)
            if rows is not None:
                seen[photo.name] = rows
        for name, face in zip(called[photo.name], faces[photo.name], strict=False):
            viewmat = np.eye(4)
            viewmat[:3] = face.rotation @ photo.viewmat[:3]
            photos.append(replace(photo, name=name, viewmat=viewmat, face=face, film=None))
            if rows is not None:
                camera = Camera(face.width, face.height, face.K, viewmat)
                seen[name] = rows[in_frame(camera, capture.points[rows].astype(np.float64))]
    tests = capture.test_names
    most = max(len(found) for found in faces.values())
    note = (
        f"{len(wide)} photos see {'all around' if most == len(CUBE) else f'{WIDE:g} degrees and more'}: each "
        f"is used as {most} faces of a cube, called {', '.join(called[wide[0]][:2])} and so on"
    )
    return replace(
        capture,
        photos=sorted(photos, key=lambda photo: photo.name),
        seen=None if capture.seen is None else seen,
        test_names=None if tests is None else frozenset(own for name in tests for own in called[name]),
        near_far={own: depths for name, depths in capture.near_far.items() for own in called[name]},
        notes=[*capture.notes, note],
    )
