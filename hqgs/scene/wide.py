"""Captures whose photos see more than a flat picture holds: each photo becomes faces of a cube."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hqgs.scene.capture import Capture, Photo
from hqgs.scene.faces import CUBE, WIDE, face_name, faces_of
from hqgs.scene.geometry import in_frame
from hqgs.scene.scene import Camera


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
