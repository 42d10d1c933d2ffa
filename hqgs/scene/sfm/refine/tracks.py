"""A COLMAP model's points and observations as arrays, and the model that they make."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class Tracks:
    """Points [P, 3] and their observations: `view[k]` has point `point[k]` at `xy[k]`; sorted."""

    points: Floats
    colors: NDArray[np.uint8]
    view: Ints
    point: Ints
    xy: Floats

    def chosen(self, keep: NDArray[np.bool_]) -> Tracks:
        """Without the other observations, and without points that fewer than two see."""
        keep = keep & (np.bincount(self.point[keep], minlength=len(self.points)) >= 2)[self.point]
        rows, point = np.unique(self.point[keep], return_inverse=True)
        return Tracks(self.points[rows], self.colors[rows], self.view[keep], point, self.xy[keep])

    def more(self, view: Ints, point: Ints, xy: Floats) -> Tracks:
        """With more observations of the same points, after these."""
        return Tracks(
            self.points,
            self.colors,
            np.concatenate([self.view, view]),
            np.concatenate([self.point, point]),
            np.concatenate([self.xy, xy]),
        )

    def joined(self, other: Tracks) -> Tracks:
        """These points, then the other ones."""
        return Tracks(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.colors, other.colors]),
            np.concatenate([self.view, other.view]),
            np.concatenate([self.point, other.point + len(self.points)]),
            np.concatenate([self.xy, other.xy]),
        )


def read_tracks(model: pycolmap.Reconstruction) -> tuple[list[str], Tracks]:
    """The photos' names, sorted, and the model's points with their observations."""
    images = sorted((model.images[k] for k in model.reg_image_ids()), key=lambda image: image.name)
    keys = sorted(model.points3D)
    row = {key: k for k, key in enumerate(keys)}
    found = [
        (k, row[seen.point3D_id], *seen.xy)
        for k, image in enumerate(images)
        for seen in image.points2D
        if seen.has_point3D()
    ]
    table = np.array(found, np.float64).reshape(-1, 4)
    _, first = np.unique(table[:, :2], axis=0, return_index=True)  # a photo may see a point twice
    table = table[first]
    points = np.array([model.points3D[key].xyz for key in keys], np.float64).reshape(-1, 3)
    colors = np.array([model.points3D[key].color for key in keys], np.uint8).reshape(-1, 3)
    view, point = table[:, 0].astype(np.intp), table[:, 1].astype(np.intp)
    return [image.name for image in images], Tracks(points, colors, view, point, table[:, 2:])


def seen_at(pose: Any, camera: Any, points: Floats) -> tuple[Floats, Floats]:
    """Where a photo shows points [N, 3], px [N, 2], infinite behind it, and their depths [N]."""
    inside = pose * points
    front = inside[:, 2:] > 1e-9
    at = camera.img_from_cam(np.where(front, inside, [0.0, 0.0, 1.0]))
    return np.where(front, at, np.inf), inside[:, 2]


def errors(model: pycolmap.Reconstruction) -> Floats:
    """Distances [O] in px between the observations of `read_tracks` and where they should be."""
    names, tracks = read_tracks(model)
    images = {image.name: image for image in model.images.values()}
    found = np.zeros(len(tracks.view))
    for k, name in enumerate(names):
        mine, image = tracks.view == k, images[name]
        at, _ = seen_at(image.cam_from_world(), image.camera, tracks.points[tracks.point[mine]])
        found[mine] = np.linalg.norm(at - tracks.xy[mine], axis=1)
    return found


def usual(model: pycolmap.Reconstruction) -> float:
    """What an observation is off, px: the median of the errors, each as if its point were known.

    A point between two photos fits both nearly: its errors are made as large as those of a long track.
    """
    _, tracks = read_tracks(model)
    length = np.bincount(tracks.point, minlength=len(tracks.points))[tracks.point]
    return float(np.median(errors(model) * np.sqrt(2 * length / (2 * length - 3))))


def rebuilt(model: pycolmap.Reconstruction, names: list[str], tracks: Tracks) -> pycolmap.Reconstruction:
    """The cameras and photos of a model with these points and observations."""
    made = pycolmap.Reconstruction()
    old = {image.name: image for image in model.images.values()}
    for key in sorted({old[name].camera_id for name in names}):
        made.add_camera_with_trivial_rig(model.cameras[key])
    elements: list[list[tuple[int, int]]] = [[] for _ in tracks.points]
    for k, name in enumerate(names):
        mine = np.flatnonzero(tracks.view == k)
        image = pycolmap.Image(
            name=name, keypoints=tracks.xy[mine], camera_id=old[name].camera_id, image_id=old[name].image_id
        )
        made.add_image_with_trivial_frame(image, old[name].cam_from_world())
        for row, point in enumerate(tracks.point[mine].tolist()):
            elements[point].append((old[name].image_id, row))
    for xyz, color, seen in zip(tracks.points, tracks.colors, elements, strict=True):
        track = pycolmap.Track([pycolmap.TrackElement(*one) for one in seen])
        made.add_point3D(xyz, track, color)
    return made
