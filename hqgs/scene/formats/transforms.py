"""transforms.json (nerfstudio, instant-ngp) and transforms_train, _test and _val.json (Blender)."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.base.files import read_json
from hqgs.base.ply import read_points
from hqgs.photos.files import UnreadableError, stored_size
from hqgs.scene.capture import Capture, Photo, files_named, inside, keep_finite, no_points, viewmat_from_pose
from hqgs.scene.constants import MOST_SIDE, SMALLEST_SIDE
from hqgs.scene.faces import AROUND, around
from hqgs.scene.masks import masks_of
from hqgs.scene.named_split import held_out, lists_in, names_by_any
from hqgs.scene.photo_files import MASKS, Named

SINGLE = "transforms.json"
TRAIN, TEST, VAL = "transforms_train.json", "transforms_test.json", "transforms_val.json"

# Where only the photo tells the size and cannot be read: `load_views` meets the same error, and names it.
UNKNOWN_CAMERA = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[1, 0.5, 0.5])

_PERSPECTIVE = {"PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"}
_FISHEYE = {"OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
# What frames call their photo and their pose: nerfstudio, and others.
_FILE = ("file_path", "image_path", "img_path", "path", "filename", "file_name", "image")
_POSE = ("transform_matrix", "transformation_matrix", "c2w", "cam2world", "camera_to_world", "pose")
_WORLD_TO_CAMERA = ("w2c", "world2cam", "world_to_camera")
MATRICES = ("K", "intrinsic_matrix", "camera_intrinsics", "intrinsics", "camera_matrix", "intrinsic")
_KEYS = {  # nerfstudio's, and what others call them
    "fl_x": ("fx", "focal_x"),
    "fl_y": ("fy", "focal_y"),
    "cx": ("c_x", "ppx"),
    "cy": ("c_y", "ppy"),
    "w": ("width", "image_width"),
    "h": ("height", "image_height"),
}
_DISTORTIONS = ("dist_coeffs", "distortion_coefficients", "distortion")
_OF_OPENCV, _OF_FISHEYE = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
_FOCALS, _ANGLES = ("fl_x", "fl_y"), ("camera_angle_x", "camera_angle_y")
_SKEW = 1e-3  # of the focal length: less is none
_OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])  # y up and z back become y down and z forward


def read_transforms(root: Path, downscale: float) -> Capture:
    """Read `transforms.json`, or the Blender files, of which each names the views of a part of the split.

    Poses are camera to world in the OpenGL frame (x right, y up, z back). Intrinsics stand in the file or in
    a frame, which wins, as numbers or as a matrix. Distortion follows OpenCV: k1, k2, p1, p2,
    k3, or k1..k4 for a fisheye. Photos are found by what their paths say, whatever machine wrote them, but
    never outside of `root`; one that is not there keeps its path, for `load_scene` to name. Test views are
    those of the test file, of the validation file where there is none, or what the lists `train_filenames`,
    `test_filenames` and `val_filenames` say.

    A photo that appears twice with one pose is one, and points that are not there are none.

    Raises ValueError, FileNotFoundError for a mask that is missing; both name the file.
    """
    notes: list[str] = []
    present = [name for name in (TRAIN, TEST, VAL) if (root / name).is_file()]
    main = SINGLE if (root / SINGLE).is_file() and (TRAIN not in present or len(present) < 2) else TRAIN
    split_file = TEST if TEST in present else VAL if VAL in present else None
    metas, files = {name: _read(root / name) for name in (main, split_file) if name}, Named(root)
    paths = _paths(root, metas, files)
    photos, called = _read_frames(root, main, metas[main], paths)
    meta, test_names = metas[main], None
    if split_file is not None:
        test, _ = _read_frames(root, split_file, metas[split_file], paths)
        test_names = frozenset(p.name for p in test)
        if main == SINGLE:
            photos = [p for p in photos if p.name not in test_names]
        photos = photos + test
        notes.append(f"the test views are the {len(test)} of {split_file}; test_every is not used")
        unread = [
            name for name in (VAL, SINGLE) if (root / name).is_file() and name not in (main, split_file)
        ]
        if unread:
            notes.append(f"not read, as {main} and {split_file} name the views: {', '.join(unread)}")
    photos = _once(root, photos)
    names = [p.name for p in photos]
    split = lists_in(meta, main, "_filenames") if split_file is None else None
    if split is not None:
        kept, test_names = held_out(split, names, names_by_any(names) | called, notes)
        photos = [p for p in photos if p.name in kept | test_names]
    photos.sort(key=lambda p: p.name)
    notes += files.note()
    points, colors = no_points()
    ply = meta.get("ply_file_path")
    if ply not in (None, ""):
        written = _text(ply, "ply_file_path", root)
        path = files_named(root, [written], "ply_file_path", Named(root, (".ply",))).get(written)
        if path is None or not path.is_file():
            notes.append(f"ply_file_path {ply!r} is not a file in {root}")
        else:
            points, colors = keep_finite(*read_points(path), notes)
    return Capture("transforms", photos, downscale, points, colors, test_names=test_names, notes=notes)


def _read(path: Path) -> dict[str, Any]:
    meta = read_json(path)
    if isinstance(meta, list):
        meta = {"frames": meta}
    if not isinstance(meta, dict):
        meta = {}
    listed = meta.get("frames", meta.get("images"))
    if isinstance(listed, dict):  # by name
        listed = [{_FILE[0]: k} | v if isinstance(v, dict) else v for k, v in listed.items()]
    if not isinstance(listed, list) or not listed:
        raise ValueError(f"{path}: expected an object with a list 'frames' that is not empty")
    return meta | {"frames": listed}


def _told(frame: dict[str, Any], keys: Sequence[str]) -> Any:
    """What a frame has under the first of the keys; None: under none."""
    return next((frame[key] for key in keys if frame.get(key) is not None), None)


def _pose(frame: dict[str, Any], where: str) -> NDArray[np.float64]:
    """Camera to world, [3, 4], in the file's axes; nan: there is none."""
    value, inverse = _told(frame, _POSE), _told(frame, _WORLD_TO_CAMERA)
    if value is not None or inverse is None:
        return _matrix(value, where)
    viewmat = np.vstack([_matrix(inverse, where), [0, 0, 0, 1]])
    if np.isfinite(viewmat).all() and np.linalg.matrix_rank(viewmat) < 4:
        raise ValueError(f"{where}: {viewmat.tolist()} is not a pose matrix")
    return np.linalg.inv(viewmat)[:3]


def _paths(root: Path, metas: dict[str, dict[str, Any]], files: Named) -> dict[str, Path]:
    """The photos by what files call them. None is that of another frame, read or not."""
    others = list[str]()
    for name in {SINGLE, TRAIN, TEST, VAL} - {*metas}:
        with suppress(OSError, ValueError):  # of one that is not there, or is not read
            others += _written(_read(root / name))
    names = [name for meta in metas.values() for name in _written(meta)]
    found = files_named(root, names, "file_path", files, others)
    return {name: found.get(name) or inside(root, name.replace("\\", "/"), "file_path") for name in names}


def _written(meta: dict[str, Any]) -> list[str]:
    frames = (frame for frame in meta["frames"] if isinstance(frame, dict))
    return [name for frame in frames if isinstance(name := _told(frame, _FILE), str) and name]


def _read_frames(
    root: Path, file: str, meta: dict[str, Any], paths: dict[str, Path]
) -> tuple[list[Photo], dict[str, str]]:
    """The photos of a file, and their names by what the file calls them."""
    photos, called, in_masks = list[Photo](), dict[str, str](), Named(root / MASKS)
    for i, frame in enumerate(meta["frames"]):
        where = f"{root / file}, frame {i}"
        if not isinstance(frame, dict):
            raise ValueError(f"{where}: expected an object, got {frame!r:.80}")
        written = _text(_told(frame, _FILE), "file_path", where)
        path = paths[written]
        name = path.relative_to(root).as_posix()
        called[written] = name
        where = f"{where} ({name})"
        c2w = _pose(frame, where)
        c2w[:, :3] *= _OPENGL_TO_OPENCV
        viewmat = viewmat_from_pose(c2w, name, camera_to_world=True)
        mask, mask_path = frame.get("mask_path"), None
        if mask not in (None, ""):
            mask = _text(mask, "mask_path", where)
            mask_path = files_named(root, [mask], "mask_path", in_masks).get(mask)
            if mask_path is None and os.path.lexists(path):
                raise FileNotFoundError(f"{where}: mask_path {mask!r} is not a file")
        try:
            camera = _camera(_by_our_names(meta, frame, where), path, where)
        except UnreadableError:
            camera = UNKNOWN_CAMERA
        photos.append(Photo(name, path, camera, viewmat, mask_path))
    masks = masks_of(root, root, [photo.name for photo in photos])
    photos = [replace(photo, mask_path=photo.mask_path or masks.get(photo.name)) for photo in photos]
    return photos, called


def _by_our_names(meta: dict[str, Any], frame: dict[str, Any], where: str) -> dict[str, Any]:
    """What a file and a frame say of the camera; the frame wins, by whatever names. null says nothing."""
    meta, frame = ({k: v for k, v in said.items() if v is not None} for said in (meta, frame))
    told = meta | frame
    fisheye = bool(told.get("is_fisheye")) or str(told.get("camera_model")).upper() in _FISHEYE
    return _under(_with_matrix(meta, fisheye, where), _with_matrix(frame, fisheye, where))


def _once(root: Path, photos: list[Photo]) -> list[Photo]:
    """The photos without repetitions. ValueError where two poses of one differ."""
    found: dict[str, Photo] = {}
    for photo in photos:
        first = found.setdefault(photo.name, photo)
        if not np.allclose(first.viewmat, photo.viewmat, equal_nan=True):
            raise ValueError(f"{root}: photo {photo.name!r} appears more than once, with different poses")
    return [*found.values()]


def _number(values: dict[str, Any], key: str, where: str) -> float | None:
    """What a file says under a key; None: nothing."""
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, str):
        with suppress(ValueError):
            value = float(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not -1e300 < value < 1e300:
        raise ValueError(f"{where}: {key} must be a finite number, got {value!r:.80}")
    return float(value)


def _camera(values: dict[str, Any], path: Path, where: str) -> pycolmap.Camera:
    """The camera from the file's values, overridden by the frame's."""
    told = values.get("camera_model", "OPENCV")
    model = told.upper() if isinstance(told, str) else told
    if model not in _PERSPECTIVE | _FISHEYE | {AROUND}:
        known = sorted(_PERSPECTIVE | _FISHEYE | {AROUND})
        raise ValueError(f"{where}: camera_model {told!r:.80} is none of {known}")
    width, height = (_number(values, key, where) for key in ("w", "h"))
    if width is None or height is None:
        width, height = stored_size(path)
    if not (1 <= width <= MOST_SIDE and 1 <= height <= MOST_SIDE):
        raise ValueError(f"{where}: w, h = {width}, {height} is not a photo size")
    if model == AROUND:
        return around(round(width), round(height))
    kind, distortion = _lens(values, model, where)
    params = [*_pinhole(values, width, height, where), *distortion]
    return pycolmap.Camera(model=kind, width=round(width), height=round(height), params=params)


def _pinhole(values: dict[str, Any], width: float, height: float, where: str) -> list[float]:
    """Focal lengths and principal point, px."""
    fx, fy, across, down, cx, cy = (_number(values, key, where) for key in (*_FOCALS, *_ANGLES, "cx", "cy"))
    fx, fy = _focal(fx, across, width, where), _focal(fy, down, height, where)
    either = fy if fx is None else fx
    if either is None:
        raise ValueError(
            f"{where}: no focal length: looked for fl_x, fl_y, camera_angle_x, camera_angle_y and a matrix "
            f"{', '.join(MATRICES)}"
        )
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    if 0 < cx <= 1 and 0 < cy <= 1 and min(width, height) > SMALLEST_SIDE:
        raise ValueError(
            f"{where}: cx, cy = {cx:g}, {cy:g} are fractions of w, h = {width:g}, {height:g}: multiply fl_x, "
            "fl_y, cx and cy by them to get pixels"
        )
    return [either if fx is None else fx, either if fy is None else fy, cx, cy]


def _lens(values: dict[str, Any], model: str, where: str) -> tuple[str, list[float]]:
    """COLMAP's model, and its coefficients of distortion."""
    order = ("k1", "k2", "k3", "k4", "p1", "p2")  # of nerfstudio's list
    listed = values.get("distortion_params")
    if listed is not None:
        if not isinstance(listed, list) or len(listed) > len(order):
            raise ValueError(f"{where}: distortion_params must be k1 k2 k3 k4 p1 p2, got {listed!r:.80}")
        values = {**values, **dict(zip(order, listed, strict=False))}
    k1, k2, k3, k4, p1, p2 = (_number(values, key, where) or 0.0 for key in order)
    if model in _FISHEYE or values.get("is_fisheye"):
        if p1 or p2:
            raise ValueError(f"{where}: a fisheye with p1, p2 = {p1}, {p2} is not an OpenCV fisheye")
        return "OPENCV_FISHEYE", [k1, k2, k3, k4]
    if k4:  # the one k4 of a perspective camera is r^8 here and a denominator in OpenCV
        raise ValueError(f"{where}: k4 = {k4} is not defined for a {model} camera")
    if k3:
        return "FULL_OPENCV", [k1, k2, p1, p2, k3, 0, 0, 0]
    return ("OPENCV", [k1, k2, p1, p2]) if k1 or k2 or p1 or p2 else ("PINHOLE", [])


def _focal(focal: float | None, angle: float | None, size: float, where: str) -> float | None:
    """Focal length in pixels, as given or from the full angle of view in radians."""
    if focal is not None or angle is None:
        return focal
    if not 0 < angle < math.pi:
        raise ValueError(f"{where}: the angle of view {angle} is not between 0 and pi: radians are wanted")
    return 0.5 * size / math.tan(0.5 * angle)


def _matrix(value: object, where: str) -> NDArray[np.float64]:
    """Rows of a camera-to-world matrix, [3, 4], from 3 or 4 rows, nested or in one list; nan: null.

    Column by column is seen from where 0 0 0 1 stands.
    """
    if value is None:
        return np.full((3, 4), np.nan)
    matrix = _array(value, f"{where}: transform_matrix")
    if matrix.shape in ((16,), (12,)):
        matrix = matrix.reshape(-1, 4)
    last = np.array([0, 0, 0, 1.0])
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], last) and np.allclose(matrix[:, 3], last):
        matrix = matrix.T
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"{where}: transform_matrix must be 4 x 4, got shape {list(matrix.shape)}")
    if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise ValueError(f"{where}: the last row of transform_matrix is {matrix[3].tolist()}, not 0 0 0 1")
    return matrix[:3]


def _array(value: Any, what: str) -> NDArray[np.float64]:
    try:
        return np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{what} must be numbers: {error}") from error


def _text(value: object, key: str, where: object) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError(f"{where}: {key} must be a path, got {value!r:.80}")
    return value


def _with_matrix(values: dict[str, Any], fisheye: bool, where: str) -> dict[str, Any]:
    """The values of a file or frame, with fl_x, fl_y, cx, cy, w, h and k1 ... by whatever name it has them.

    A matrix has 3 x 3 numbers or more, nested or in one list, row by row, or column by column where 0 0 1
    stands so; or four, fx fy cx cy. Distortion may be OpenCV's list. ValueError where it is none.
    """
    found = dict(values)
    for key in (*MATRICES, *_DISTORTIONS):
        if isinstance(inner := values.get(key), dict):  # {"fx": ...}
            found = {**inner, **found}
    for key in MATRICES:
        inner = values.get(key)
        if inner is not None and not isinstance(inner, dict) and "fl_x" not in values:
            found.update(_of_matrix(inner, f"{where}: {key}"))
            break
    for key, others in _KEYS.items():
        told = next((found[other] for other in others if other in found), None)
        if told is not None:
            found.setdefault(key, told)
    listed = next((values[key] for key in _DISTORTIONS if key in values), None)
    if listed is None or isinstance(listed, dict) or any(key in found for key in _OF_OPENCV):
        return found
    numbers = _array(listed, f"{where}: distortion").ravel().tolist()
    order = _OF_FISHEYE if fisheye else _OF_OPENCV
    if any(numbers[len(order) :]):
        raise ValueError(f"{where}: distortion must be {' '.join(order)}, got {listed!r:.80}")
    return found | dict(zip(order, numbers, strict=False))


def _under(of_file: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """The values of a file with a frame's own over them: its angles of view count, not the file's lengths."""
    if any(key in own for key in _ANGLES) and not any(key in own for key in _FOCALS):
        of_file = {k: v for k, v in of_file.items() if k not in (*_FOCALS, *_ANGLES)}
    return of_file | own


def _of_matrix(value: object, what: str) -> dict[str, float]:
    matrix = _array(value, what)
    if matrix.shape == (4,):
        return dict(zip(("fl_x", "fl_y", "cx", "cy"), matrix.tolist(), strict=True))
    if matrix.size in (9, 16) and matrix.ndim == 1:
        matrix = matrix.reshape(round(matrix.size**0.5), -1)
    if matrix.shape not in ((3, 3), (3, 4), (4, 4)):
        raise ValueError(f"{what} must be 3 x 3, or fx fy cx cy, got shape {list(matrix.shape)}")
    K = matrix[:3, :3]
    if np.allclose(K[:, 2], [0, 0, 1]) and not np.allclose(K[2], [0, 0, 1]):
        K = K.T
    if (
        not np.isfinite(K).all()
        or not np.allclose(K[2], [0, 0, 1])
        or K[1, 0]
        or K[0, 0] == 0
        or K[1, 1] == 0
    ):
        raise ValueError(f"{what} is not a matrix of intrinsics: {K.tolist()}")
    if abs(K[0, 1]) > _SKEW * abs(K[0, 0]):
        raise ValueError(f"{what} has a skew of {K[0, 1]:g}, wanted 0")
    return {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
