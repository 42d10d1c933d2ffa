"""Intrinsics in transforms.json by other names than nerfstudio's: a matrix, or fx, fy, width and height."""

from __future__ import annotations

from typing import Any

import numpy as np

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


def with_matrix(values: dict[str, Any], fisheye: bool, where: str) -> dict[str, Any]:
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
    try:
        numbers = np.asarray(listed, np.float64).ravel().tolist()
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: distortion must be numbers, got {listed!r:.80}") from error
    order = _OF_FISHEYE if fisheye else _OF_OPENCV
    if any(numbers[len(order) :]):
        raise ValueError(f"{where}: distortion must be {' '.join(order)}, got {listed!r:.80}")
    return found | dict(zip(order, numbers, strict=False))


def under(of_file: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """The values of a file with a frame's own over them: its angles of view count, not the file's lengths."""
    if any(key in own for key in _ANGLES) and not any(key in own for key in _FOCALS):
        of_file = {k: v for k, v in of_file.items() if k not in (*_FOCALS, *_ANGLES)}
    return of_file | own


def _of_matrix(value: object, what: str) -> dict[str, float]:
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{what} must be numbers: {error}") from error
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
        raise ValueError(f"{what} is no matrix of intrinsics: {K.tolist()}")
    if abs(K[0, 1]) > _SKEW * abs(K[0, 0]):
        raise ValueError(f"{what} has a skew of {K[0, 1]:g}, which no camera here has")
    return {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
