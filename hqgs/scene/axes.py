"""Whether a file's cameras have the axes that its format states: matches between photos tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.base.evenly import evenly
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.constants import AXES_CLEAR, AXES_FEWEST, AXES_PAIRS, COPY_SIDE
from hqgs.scene.geometry import shrunk
from hqgs.scene.scene import View
from hqgs.scene.sfm.facts import EPIPOLAR
from hqgs.scene.sfm.likely import LOWE_RATIO

Floats = NDArray[np.float64]
TURNED = np.diag([1.0, -1.0, -1.0, 1.0])  # y down and z forward for y up and z back, and the other way round


def with_true_axes(views: Sequence[View]) -> tuple[list[View], str | None]:
    """The views, with cameras turned about x where y and z are meant the other way round; and what to say.

    Half of the programs that write transforms.json take OpenCV's axes for OpenGL's. No pose tells by itself:
    photos do, since matches of two of them lie on epipolar lines with one choice alone.
    """
    counts, told = np.zeros(3, int), pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING.value)
    try:
        for k in evenly(max(len(views) - 1, 0), AXES_PAIRS):
            counts += _fitting(views[k], views[k + 1])
    finally:
        pycolmap.logging.minloglevel = told
    stated, turned, matches = counts.tolist()
    if turned < AXES_FEWEST or turned < AXES_CLEAR * stated:
        return list(views), None
    note = (
        f"the cameras' y and z axes were flipped: {turned} of {matches} matches between photos then fit, "
        f"{stated} without (the file has OpenCV's axes; its format wants OpenGL's)"
    )
    return [
        replace(view, camera=replace(view.camera, viewmat=TURNED @ view.camera.viewmat)) for view in views
    ], note


def _fitting(first: View, second: View) -> NDArray[np.int_]:
    """Matches of two photos that fit the cameras as they are, and turned; and how many there are."""
    one, two = (shrunk(view, COPY_SIDE) for view in (first, second))
    points, others = _matches(one, two)
    found = []
    for turn in (np.eye(4), TURNED):
        relative = turn @ two.camera.viewmat @ np.linalg.inv(one.camera.viewmat) @ turn
        found.append(int((_distances(one, two, relative, points, others) < EPIPOLAR).sum()))
    return np.array([*found, len(points)])


def _matches(first: View, second: View) -> tuple[Floats, Floats]:
    """Pixels [M, 2] of each photo that are each other's nearest by their SIFT descriptors."""
    (points, a), (others, b) = (_features(view) for view in (first, second))
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    alike = a @ b.T  # of unit vectors, up to a factor
    alike /= np.linalg.norm(a, axis=1)[:, None] * np.linalg.norm(b, axis=1)
    far = np.sqrt(np.maximum(2 - 2 * alike, 0))
    nearest = far.argmin(1)
    best, second_best = np.partition(far, 1, axis=1)[:, :2].T
    kept = (best < LOWE_RATIO * second_best) & (far.argmin(0)[nearest] == np.arange(len(a)))
    return points[kept], others[nearest[kept]]


def _features(view: View) -> tuple[Floats, NDArray[np.float32]]:
    """SIFT features of a photo: pixels [F, 2] and descriptors [F, 128]."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    grey = to_uint8(as_floats(view.image).mean(2))
    keys, rows = pycolmap.FeatureExtractor.create(options).extract(pycolmap.Bitmap.from_array(grey))
    points = np.array([[key.x, key.y] for key in keys], float).reshape(-1, 2)
    return points, np.asarray(rows.data, np.float32).reshape(len(points), rows.data.shape[1])


def _distances(first: View, second: View, relative: Floats, points: Floats, others: Floats) -> Floats:
    """Of the pixels of the second photo from the epipolar lines of those of the first, px, [M]."""
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    essential = cross @ relative[:3, :3]
    fundamental = np.linalg.inv(second.camera.K).T @ essential @ np.linalg.inv(first.camera.K)
    lines = np.concatenate([points, np.ones((len(points), 1))], 1) @ fundamental.T
    offsets = np.abs((lines[:, :2] * others).sum(1) + lines[:, 2])
    return offsets / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-12)
