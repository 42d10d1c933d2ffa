"""Scenes in metres: from the distance between two photos' cameras, or two points, as somebody measured it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches

import numpy as np
from numpy.typing import NDArray

from hqgs.base.text import some
from hqgs.scene.faces import photo_name
from hqgs.scene.named_split import names_by_any
from hqgs.scene.scene import Scene
from hqgs.scene.world import World

Distance = tuple[str, str, float]  # two photos' names or points, and how many metres lie between them
_COORDINATES = 3  # of a point, joined by commas: in the frame of the scene's files


def distance_of(value: Sequence[str | float]) -> Distance:
    """Two names or points, and metres, as they were given. ValueError where they can be no distance."""
    try:
        a, b, length = str(value[0]), str(value[1]), float(value[2])
    except (IndexError, TypeError, ValueError) as error:
        raise ValueError(
            f"distance takes two photos' names, or points x,y,z, and metres, got {list(value)}"
        ) from error
    if a == b:
        raise ValueError(f"distance: both photos are {a!r}; name two photos taken at different places")
    if not 0 < length < math.inf:
        raise ValueError(f"distance: {length:g} m between {a} and {b}; it must be more than 0")
    return a, b, length


def point_of(written: str) -> NDArray[np.float64] | None:
    """The point [3] that is meant; None: it is a photo's name."""
    parts = written.split(",")
    try:
        point = np.array([float(part) for part in parts])
    except ValueError:
        return None
    return point if len(point) == _COORDINATES and np.isfinite(point).all() else None


def named_photos(names: Sequence[str], distance: Distance) -> tuple[int | None, int | None]:
    """Where in `names` the two photos are, by whole name, else by its last part, with suffix or without.

    None: a point is meant.

    ValueError where one is not among them or could be several, or where both are one.
    """
    a, b = (None if point_of(wanted) is not None else _named(names, wanted) for wanted in distance[:2])
    if a is not None and a == b:
        raise ValueError(f"distance: {distance[0]!r} and {distance[1]!r} are both the photo {names[a]}")
    return a, b


def _named(names: Sequence[str], wanted: str) -> int:
    known = {other.casefold(): name for other, name in names_by_any(names).items()}
    key = wanted.replace("\\", "/").casefold()
    found = wanted if wanted in names else known.get(key)
    if found is None:
        near = get_close_matches(key, [*known], n=3, cutoff=0)
        raise ValueError(
            f"distance: no photo with a camera is called {wanted!r}, or several are; the most similar of the "
            f"{len(names)} are {some([*dict.fromkeys(known[other] for other in near)])}; give a whole name"
        )
    return names.index(found)


def in_metres(scene: Scene, distance: Distance) -> Scene:
    """The same scene, which is written in metres: the two cameras or points are that far apart then.

    Nothing that is trained or rendered changes. ValueError as `named_photos` raises it, or where both cameras
    are in one place.
    """
    views = [*scene.train, *scene.test]
    by_name = {view.name: view for view in views}
    for view in views:  # what is meant may also be the photo that faces are of: they share its centre
        if view.face:
            by_name.setdefault(photo_name(view.name, view.face), view)
    names = [*by_name]
    world, ends, called = scene.world, list[NDArray[np.floating]](), list[str]()
    for written, k in zip(distance[:2], named_photos(names, distance), strict=True):
        point = point_of(written) if k is None else world.out(by_name[names[k]].camera.center)
        assert point is not None
        ends.append(point)
        called.append(f"the point {written.strip()}" if k is None else f"the camera of {names[k]}")
    apart = float(np.linalg.norm(ends[0] - ends[1]))
    if not apart > 1e-6 * world.unit * scene.extent:
        raise ValueError(f"distance: {called[0]} and {called[1]} are in one place")
    metres = distance[2] / apart
    note = (
        f"{called[0]} and {called[1]} are {distance[2]:g} m apart, as --distance says: what is written is in "
        f"metres (1 unit of the cameras as they were found is {metres:.6g} m)"
    )
    x, y, z = (metres * value for value in world.shift)
    place = None if world.place is None else world.place.of_units(metres)
    made = World(world.unit * metres, (x, y, z), metres, world.up, place)
    return replace(scene, world=made, notes=[*scene.notes, note])
