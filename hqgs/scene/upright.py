"""Up, by what stands upright in a scene: edges in its photos.

An edge in a photo and the camera's centre span a plane. Whatever stands upright, up lies in the planes of its
edges, so that up is where most planes of edges that are nearly upright meet. One photo's edges tell it to a
part of a degree, and several bear each other out. Edges are found as Burns, Hanson and Riseman (1986) do:
neighbouring pixels whose gradients have one direction, and a line through them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hqgs.base.evenly import evenly
from hqgs.photos.pixels import as_floats
from hqgs.scene.constants import COPY_SIDE
from hqgs.scene.geometry import shrunk
from hqgs.scene.paths import scene_up
from hqgs.scene.scene import Scene, View

# Tried on the room and on 13 captures of others.
UP_CONE = 15.0  # degrees from how the photos were held, at most
UP_SURE = 1.0  # degrees: a wider 95 % interval is no answer
EDGE_LENGTH, EDGE_WIDTH = 0.04, 5.0  # of a photo's longer side, least; px, most
EDGE_OFF = 0.7  # degrees, sigma, that an upright edge may be off
EDGES_FEWEST, EDGES_SHARE = 20, 0.3  # upright ones; their share of the length of those within UP_CONE

Floats = NDArray[np.float64]
_NEAR = math.cos(math.radians(UP_CONE))


class Up(NamedTuple):
    """Up in a scene, and who says so."""

    direction: Floats  # [3], unit, world
    error: float  # degrees: it is no farther off in 95 % of cases, if what tells it is upright
    said: str


def direction_of(up: Sequence[float]) -> Floats:
    """Up as somebody gave it, [3], of length 1. ValueError for what has no direction."""
    given = np.asarray(up, np.float64)
    length = float(np.linalg.norm(given)) if given.shape == (3,) else math.nan
    if not 0 < length < math.inf:
        raise ValueError(f"up is {[*up]}, wanted three numbers x, y, z that are not all 0")
    return given / length


def with_up(scene: Scene) -> Scene:
    """The scene with up as edges or GPS tell it, in this order; a note says which.

    Where none does, up stays as the photos were held (`scene_up`).
    """
    before = scene_up(scene)
    views = [*scene.train, *scene.test]
    if max(max(view.camera.width, view.camera.height) for view in views) < EDGE_WIDTH / EDGE_LENGTH:
        return scene
    found = by_edges(views, before) or _by_gps(scene)
    if found is None:
        note = "up is as the photos were held, as upright edges or GPS are not clear enough"
        return replace(scene, notes=[*scene.notes, note])
    moved = math.degrees(math.acos(float(np.clip(found.direction @ before, -1, 1))))
    why = (
        f"by {found.said}: 95 % of it within {found.error:.2g} degrees, "
        f"and {moved:.2g} degrees from how the photos were held"
    )
    return told_up(scene, found.direction, why)


def told_up(scene: Scene, up: Floats, why: str) -> Scene:
    """The scene with `up`, unit, and a note that says why."""
    x, y, z = up.tolist()
    note = f"up is ({x:.3f}, {y:.3f}, {z:.3f}), {why}"
    return replace(scene, world=replace(scene.world, up=(x, y, z)), notes=[*scene.notes, note])


def by_edges(views: Sequence[View], before: Floats) -> Up | None:
    """Up within UP_CONE of `before`, by edges of photos that stand upright; None: too few agree on one."""
    chosen = [views[k] for k in evenly(len(views), 24)]
    edges = [_edges(view, before) for view in chosen]
    photo = np.repeat(np.arange(len(edges)), [len(rows) for rows in edges])
    planes, weights = np.concatenate(edges)[:, :3], np.concatenate(edges)[:, 3]
    if len(planes) < EDGES_FEWEST:
        return None
    tried = _cone(before)
    scores = np.array([_near(planes, weights, up).sum() for up in tried])
    up = _meeting(planes, weights, tried[scores.argmax()])
    away = _degrees(tried, up)
    beside = float(np.median(scores[(away > 6 * EDGE_OFF) & (away < UP_CONE)]))
    upright = np.abs(_along(planes, up)) < math.sin(math.radians(1.5 * EDGE_OFF))
    share, photos = float(weights[upright].sum() / weights.sum()), len(np.unique(photo[upright]))
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, len(edges), (100, len(edges)))  # of photos, to see how far the answer moves
    counts = [np.bincount(rows, minlength=len(edges))[photo] for rows in drawn]
    others = np.array([_meeting(planes, weights * count, up) for count in counts])
    lean = 0.5  # degrees that walls and furniture are off themselves; 40 draws of photos of the room
    error = math.hypot(float(np.quantile(_degrees(others, up), 0.95)), lean)
    # `beside`: what meets in the directions around.
    told = share > EDGES_SHARE and upright.sum() >= EDGES_FEWEST and scores.max() > 2.5 * beside
    if not told or photos < 3 or error > UP_SURE or up @ before < _NEAR:
        return None
    return Up(up, error, f"{upright.sum()} upright edges in {photos} photos")


def _by_gps(scene: Scene) -> Up | None:
    place = scene.world.place
    if place is None or place.tilt is None or place.tilt > UP_SURE:
        return None
    return Up(np.array(place.up), place.tilt, f"GPS of {place.used} photos")


def _edges(view: View, up: Floats) -> Floats:
    """[E, 4] Of straight edges that are within UP_CONE of upright: their planes' normals, world; weights."""
    from scipy.ndimage import gaussian_filter, label  # here: only loading needs it

    view = shrunk(view, COPY_SIDE)
    grey = as_floats(view.image).mean(2)
    across, down = np.gradient(gaussian_filter(grey, 1.0))[::-1]
    steep = np.hypot(across, down) > 0.01  # of white, for each px
    rows, columns = np.nonzero(steep if view.mask is None else steep & view.mask)
    gx, gy = (value[rows, columns].astype(np.float64) for value in (across, down))
    middle = view.camera.K[:2, 2]
    x, y = columns + 0.5 - middle[0], rows + 0.5 - middle[1]
    K = view.camera.K.copy()
    K[:2, 2] = 0
    to_world = K @ view.camera.viewmat[:3, :3]
    found = [np.zeros((0, 4))]
    normals = np.stack([gx, gy, -(gx * x + gy * y)], 1) @ to_world
    upright = np.abs(_along(normals, up)) < math.sin(math.radians(UP_CONE)) * np.linalg.norm(normals, axis=1)
    zenith = to_world @ up  # where upright lines meet in the picture
    left = gy * (zenith[0] - zenith[2] * x) > gx * (zenith[1] - zenith[2] * y)  # the brighter side
    for side in (upright & left, upright & ~left):
        labels = np.zeros(grey.shape, np.int32)
        labels[rows[side], columns[side]] = 1
        label(labels, np.ones((3, 3)), labels)
        found.append(
            _lines(
                labels[rows[side], columns[side]],
                x[side],
                y[side],
                np.hypot(gx, gy)[side],
                max(grey.shape),
                to_world,
            )
        )
    return np.concatenate(found)


def _lines(
    labels: NDArray[np.int32], x: Floats, y: Floats, mass: Floats, side: int, to_world: Floats
) -> Floats:
    """[E, 4] as `_edges`, through the pixels of each label that are long and thin."""
    if not len(labels):
        return np.zeros((0, 4))

    def mean(values: Floats) -> Floats:
        return np.bincount(labels, mass * values)[1:] / total

    total = np.bincount(labels, mass)[1:]
    mx, my = mean(x), mean(y)
    xx, yy, xy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    half, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    length, width = (np.sqrt(12 * np.maximum(half + sign * apart, 0)) for sign in (1, -1))
    kept = (length > EDGE_LENGTH * side) & (width < EDGE_WIDTH) & (width < length / 2)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)[kept]
    a, b = -np.sin(angle), np.cos(angle)
    normals = np.stack([a, b, -(a * mx[kept] + b * my[kept])], 1) @ to_world
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.column_stack([normals, np.minimum(length[kept] / side, 8 * EDGE_LENGTH)])


def _cone(middle: Floats) -> Floats:
    """Directions [D, 3] within UP_CONE of one, EDGE_OFF apart."""
    side = np.cross(middle, np.eye(3)[np.abs(middle).argmin()])
    side /= np.linalg.norm(side)
    steps = np.tan(np.radians(np.arange(-UP_CONE, UP_CONE + EDGE_OFF, EDGE_OFF)))
    a, b = (steps.repeat(len(steps)), np.tile(steps, len(steps)))
    tried = middle + a[:, None] * side + b[:, None] * np.cross(middle, side)
    tried /= np.linalg.norm(tried, axis=1, keepdims=True)
    return tried[_along(tried, middle) > _NEAR]


def _meeting(planes: Floats, weights: Floats, start: Floats) -> Floats:
    """The direction [3] in which most of the planes of normals [E, 3] meet, from one nearby."""
    for _ in range(20):  # it settles sooner
        rows = planes * _near(planes, weights, start)[:, None]
        axis = np.linalg.eigh(np.einsum("ni,nj->ij", rows, planes))[1][:, 0]
        start, last = axis * np.sign(axis @ start), start
        if start @ last > 1 - 1e-12:
            break
    return start


def _near(planes: Floats, weights: Floats, up: Floats) -> Floats:
    """What the planes count for a direction: less, the farther it is from them."""
    return weights * np.exp(-0.5 * (_along(planes, up) / math.radians(EDGE_OFF)) ** 2)


def _along(rows: Floats, axis: Floats) -> Floats:
    """[N, 3] along [3]. Written out: BLAS would round by the number of its threads."""
    return rows[:, 0] * axis[0] + rows[:, 1] * axis[1] + rows[:, 2] * axis[2]


def _degrees(rows: Floats, axis: Floats) -> Floats:
    return np.degrees(np.arccos(np.minimum(_along(rows, axis), 1.0)))
