"""COLMAP models (binary or text) with their photos."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hqgs.base.ply import read_points
from hqgs.base.text import some
from hqgs.scene.capture import (
    NO_POSE,
    Capture,
    Photo,
    files_named,
    inside,
    keep_finite,
    list_photos,
    no_points,
    perhaps,
    photo_folder,
    viewmat_from_pose,
)
from hqgs.scene.film import frame_details
from hqgs.scene.formats.colmap_binary import cameras_file_size, check_binary_model, image_names
from hqgs.scene.formats.colmap_mended import NEEDED, POINTS, kind_of, mended, whole_names
from hqgs.scene.geometry import project
from hqgs.scene.masks import masks_of
from hqgs.scene.named_split import held_out, listed_split, names_by_any
from hqgs.scene.names import KEPT
from hqgs.scene.photo_files import Named, can_be_listed, is_mask_folder, is_run, of_maps, of_windows
from hqgs.scene.scene import Camera, TrackStatistics

_POINT_FILES = (f"{POINTS}.ply", "points.ply", "input.ply")  # in place of COLMAP's own


def find_models(root: Path) -> list[Path]:
    """Folders with a complete COLMAP model: those below `sparse/`, else `sparse` itself, else `root`."""
    sparse = _sparse(root)
    below = [sorted(sparse.glob(depth)) if sparse.is_dir() else [] for depth in ("*", "*/*")]
    fragments = next((models for paths in below if (models := [*filter(kind_of, paths)])), [])
    return fragments or [p for p in (sparse, root) if kind_of(p)][:1]


def _sparse(root: Path) -> Path:
    """`sparse` in a folder, however it is spelt."""
    named = root / "sparse"
    others = (p for p in sorted(root.iterdir()) if p.name.lower() == "sparse" and p.is_dir())
    return named if named.is_dir() else next(others, named)


def find_models_below(root: Path) -> list[Path]:
    """The same for the folders of `root`, and theirs: the first that has a model (`colmap/sparse/0`).

    A model outside of any `sparse` counts beside photos, or in a folder that is called after one: what a run
    keeps of COLMAP's work is none of the user's.
    """
    inner = [root]
    for _ in range(3):
        inner = [p for folder in inner for p in _folders(folder)]
        for folder in inner:
            models = find_models(folder)
            if models and (models != [folder] or _called_model(folder) or list_photos(folder)):
                return models
    return []


def _called_model(folder: Path) -> bool:
    """Whether it has the name of a model, or a number in such a folder (`colmap_output/0`)."""
    name = (folder.parent if folder.name.isdigit() else folder).name.lower()
    return any(word in name for word in ("colmap", "distorted", "model", "reconstruction", "sparse"))


def _folders(folder: Path) -> list[Path]:
    """Those in which a scene may lie."""
    inner = (p for p in folder.iterdir() if p.is_dir() and p.name[0] != "." and can_be_listed(p))
    return sorted(p for p in inner if not is_run(p) and (p.name != KEPT or _sparse(p).is_dir()))


def half_model(root: Path) -> Path | None:
    """A folder that holds some files of a COLMAP model, but not all."""
    sparse = _sparse(root)
    folders = [*(sorted(p for p in sparse.iterdir() if p.is_dir()) if sparse.is_dir() else []), sparse, root]
    for folder in folders:
        for kind in ("bin", "txt"):
            if any((folder / f"{name}.{kind}").exists() for name in (*NEEDED, POINTS)) and not kind_of(
                folder
            ):
                return folder
    return None


def read_colmap(root: Path, downscale: float) -> Capture:
    """Read the largest COLMAP model of the scene in `root`.

    COLMAP's camera frame and pixel centres (half-integers) are ours. A photo that is not there keeps its
    path, for `load_scene` to name. Raises ValueError for a damaged model, FileNotFoundError where no camera
    has a photo.
    """
    path, model, notes = _largest_model(root)
    images = _images(model, path)
    folder, left, files = photos_of([*images], root, path, downscale, notes)
    photos = _photos(model, images, path, files, folder, root)
    used = set(files.values())
    if len(used) < len(files):
        shared = [n for n, p in files.items() if list(files.values()).count(p) > 1]
        raise ValueError(f"{folder}: several cameras have the same photo: {some(shared)}")
    unused = [n for n in list_photos(folder) if folder / n not in used]
    if unused:
        notes.append(f"{len(unused)} photos have no camera (COLMAP did not register them): {some(unused)}")
    test_names = None
    split, known = listed_split([path, root], root), names_by_any([*images])
    if split is not None and not split.names_any(known):
        notes.append(f"{split.source} names none of the photos, and is not used as a split")
    elif split is not None:
        kept, test_names = held_out(split, [*images], known, notes)
        photos = [photo for photo in photos if photo.name in kept | test_names]
    points, colors = keep_finite(*(model_points(model) if model.points3D else _points(path, notes)), notes)
    tracks = _tracks(model, path)
    seen = None
    if tracks is not None and len(points) == model.num_points3D():  # else the rows would not be those
        seen = seen_points(model)
    return Capture(
        "colmap",
        photos,
        left,
        points,
        colors,
        folder=folder,
        test_names=test_names,
        notes=notes,
        tracks=tracks,
        seen=seen,
    )


def _largest_model(root: Path) -> tuple[Path, pycolmap.Reconstruction, list[str]]:
    """The model with most photos, where it is, and notes."""
    found = find_models(root) or find_models_below(root)
    told: dict[Path, list[str]] = {path: [] for path in found}
    models = dict[Path, pycolmap.Reconstruction]()
    for path in found:
        with mended(path, told[path]) as place:
            models[path] = _read_whole(place)
    path = max(models, key=lambda p: (models[p].num_reg_images(), models[p].num_points3D()))
    model, notes = models.pop(path), told[path]
    if path not in find_models(root):
        notes.append(f"the COLMAP model is the one in {path.relative_to(root)}")
    if models:
        others = ", ".join(f"{p.name}: {m.num_reg_images()}" for p, m in models.items())
        notes.append(
            f"{len(models) + 1} COLMAP models: took the largest, {path.relative_to(root)}, with "
            f"{model.num_reg_images()} photos (photos in the others: {others})"
        )
    return path, model, notes


def _images(model: pycolmap.Reconstruction, path: Path) -> dict[str, pycolmap.Image]:
    """The photos of a model that have a place, by name, sorted."""
    try:
        images = sorted((i.name, i.image_id) for i in model.images.values() if i.has_pose)
    except UnicodeDecodeError as e:  # of an image that the file's lines do not number alike: damaged
        raise ValueError(f"{path}: the name of a photo cannot be read: {e}") from e
    if not images:
        raise ValueError(f"{path}: the COLMAP model has no registered photo")
    counts = Counter(name for name, _ in images)
    if twice := [name for name, count in counts.items() if count > 1]:
        raise ValueError(f"{path}: photo names appear more than once: {some(twice)}")
    return {name: model.images[image_id] for name, image_id in images}


def _photos(
    model: pycolmap.Reconstruction,
    images: dict[str, pycolmap.Image],
    path: Path,
    files: dict[str, Path],
    folder: Path,
    root: Path,
) -> list[Photo]:
    """The photos of the model at `path`; one that has no file lies where it should in the folder."""
    details, masks, photos = frame_details(folder), masks_of(root, folder, [*images]), list[Photo]()
    for name, image in images.items():
        file, film = files.get(name, folder / name), None
        if name in files and file.is_relative_to(folder):
            film = details.get(file.relative_to(folder).as_posix())
        try:
            viewmat = pose_viewmat(image.cam_from_world(), name)
        except ValueError as e:
            raise ValueError(f"{path}: {e}") from e
        photos.append(Photo(name, file, model.cameras[image.camera_id], viewmat, masks.get(name), film))
    return photos


def _points(folder: Path, notes: list[str]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points [P, 3] and colours [P, 3] that lie beside a model without any."""
    path = next((folder / name for name in _POINT_FILES if (folder / name).is_file()), None)
    if path is None:
        return no_points()
    notes.append(f"the model has no points; those of {path.name} beside it are used")
    return read_points(path)


def _tracks(model: pycolmap.Reconstruction, path: Path) -> TrackStatistics | None:
    """How the photos saw the points; None where the model does not tell."""
    try:
        if not model.points3D or not model.compute_num_observations():
            return None
        return TrackStatistics(model.compute_mean_track_length(), model.compute_mean_reprojection_error())
    except ValueError as e:
        raise ValueError(f"{path}: a point refers to a photo that is not in the model: {e}") from e


def _read_whole(folder: Path) -> pycolmap.Reconstruction:
    model, binary = pycolmap.Reconstruction(), kind_of(folder) == "bin"
    if binary:
        check_binary_model(folder)
    try:
        if binary:
            model.read_binary(folder)
        else:
            model.read_text(folder)
        names = image_names(folder / "images.bin") if binary else whole_names(folder / "images.txt")
        for image_id, name in names.items():
            if image_id in model.images:
                model.images[image_id].name = of_windows(name)
    except (ValueError, IndexError, RuntimeError) as e:
        raise ValueError(f"{folder}: COLMAP cannot read its model there: {e}") from e
    if binary:
        size = cameras_file_size([len(c.params) for c in model.cameras.values()])
        actual = (folder / "cameras.bin").stat().st_size
        if actual != size:
            raise ValueError(f"{folder / 'cameras.bin'} is damaged: {size} bytes expected, it has {actual}")
    return model


def pose_viewmat(pose: pycolmap.Rigid3d, name: str) -> NDArray[np.float64]:
    """World to camera, [4, 4], of the photo of that name; its quaternion may have any length but 0."""
    matrix, quat = pose.matrix(), pose.rotation.quat
    length = np.linalg.norm(quat)
    if not length > 0:  # the matrix does not show it: that of a zero quaternion is I
        return NO_POSE.copy()
    if abs(length - 1) > 1e-2:
        matrix[:, :3] = Rotation.from_quat(quat).as_matrix()
    return viewmat_from_pose(matrix, name, camera_to_world=False)


def seen_points(model: pycolmap.Reconstruction) -> dict[str, NDArray[np.intp]]:
    """By photo, the rows of `model_points` that it shows, ascending; photos without a place show none.

    Points that the model lacks do not count: tools remove some and leave the photos as they are.
    """
    row = {point: k for k, point in enumerate(sorted(model.points3D))}
    return {
        image.name: np.array(
            sorted({row[p.point3D_id] for p in image.points2D if p.point3D_id in row}), dtype=np.intp
        )
        for image in model.images.values()
        if image.has_pose
    }


def registered(model: pycolmap.Reconstruction) -> dict[str, NDArray[np.float64]]:
    """World-to-camera matrices [4, 4] by photo, sorted; those that have a place."""
    poses = {}
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.has_pose:
            poses[image.name] = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
    return poses


def model_points(model: pycolmap.Reconstruction) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points [P, 3] and colours [P, 3] by ascending id: COLMAP keeps them in a hash map without an order."""
    points = [point for _, point in sorted(model.points3D.items(), key=lambda item: item[0])]
    xyz = np.array([p.xyz for p in points], np.float64).reshape(-1, 3)
    return xyz, np.array([p.color for p in points], np.uint8).reshape(-1, 3)


def write_colmap(
    folder: Path,
    cameras: dict[str, Camera],
    points: NDArray[np.floating],
    colors: NDArray[np.uint8],
    seen: dict[str, NDArray[np.intp]] | None = None,
    reprojection_error: float = 0.0,
) -> None:
    """Write a binary model into `folder`: the camera of each photo name, points [P, 3] and colours [P, 3].

    Photos with equal intrinsics share a PINHOLE camera. The names are COLMAP's, relative to the folder of
    photos. `seen` has for each of them the rows of the points that it shows; where it shows them is not
    known, so they are written where the camera sees them. Every point gets `reprojection_error`, px, as its
    mean distance from the photos. Without `seen` the points have no tracks. Raises OSError if the files are
    not whole.
    """
    model = pycolmap.Reconstruction()
    ids: dict[tuple[float, ...], int] = {}
    for image_id, (name, camera) in enumerate(sorted(cameras.items()), start=1):
        params = (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2])
        key = (camera.width, camera.height, *params)
        if key not in ids:
            ids[key] = len(ids) + 1
            pinhole = pycolmap.Camera(
                camera_id=ids[key], model="PINHOLE", width=camera.width, height=camera.height, params=params
            )
            model.add_camera_with_trivial_rig(pinhole)
        image = pycolmap.Image(name=name, camera_id=ids[key], image_id=image_id)
        rotation = pycolmap.Rotation3d(camera.viewmat[:3, :3])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, camera.viewmat[:3, 3]))
    ids_of_points = [
        model.add_point3D(point.astype(np.float64), pycolmap.Track(), color)
        for point, color in zip(points, colors, strict=True)
    ]
    if seen is not None:
        _add_tracks(model, cameras, points.astype(np.float64), ids_of_points, seen, reprojection_error)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
    # COLMAP takes no notice of a full disk.
    cameras_file = folder / "cameras.bin"
    try:
        check_binary_model(folder)
        if cameras_file.stat().st_size != cameras_file_size([4] * len(ids)):
            raise ValueError(f"{cameras_file} is damaged")
    except ValueError as error:
        raise OSError(f"cannot write the COLMAP model (is the disk full?): {error}") from error


def _add_tracks(
    model: pycolmap.Reconstruction,
    cameras: dict[str, Camera],
    points: NDArray[np.float64],
    ids: list[int],
    seen: dict[str, NDArray[np.intp]],
    reprojection_error: float,
) -> None:
    for image in model.images.values():
        camera, rows = cameras[image.name], seen.get(image.name, np.zeros(0, np.intp))
        pixels, _ = project(camera, points[rows])
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        for k, row in enumerate(rows.tolist()):
            model.add_observation(ids[row], pycolmap.TrackElement(image.image_id, k))
    for point in model.points3D.values():
        point.error = reprojection_error


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
    inner = [p for p in inner if can_be_listed(p)]
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
