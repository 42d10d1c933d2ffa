"""Cameras that no photo has: one that looks at a point, and smooth paths through or around given cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hqgs.base.evenly import evenly
from hqgs.scene.constants import PATH_SIZE
from hqgs.scene.scene import Camera, Scene

UP = (0.0, -1.0, 0.0)  # of a scene that says nothing: COLMAP's first camera has y down
AROUND = math.radians(150)  # cameras that see their focus from a wider range are walked around in a circle
_Array = NDArray[np.float64]


def look_at(
    eye: ArrayLike,
    target: ArrayLike,
    *,
    up: ArrayLike = UP,
    width: int = PATH_SIZE[0],
    height: int = PATH_SIZE[1],
    fov: float = 60.0,
) -> Camera:
    """A camera at `eye` that looks at `target`, the principal point in the middle.

    Args:
        eye, target: [3], world units.
        up: [3], the direction in the world that is up in the picture, of any length.
        width, height: pixels.
        fov: vertical field of view in degrees, above 0 and below 180.

    Raises:
        ValueError: a size or angle out of range, or `up` along the line of sight.
    """
    if width < 1 or height < 1:
        raise ValueError(f"the size is {width} x {height}, wanted at least 1 x 1")
    if not 0 < fov < 180:
        raise ValueError(f"fov is {fov}, wanted degrees between 0 and 180")
    eye, forward = _vector("eye", eye), _vector("target", target) - _vector("eye", eye)
    right = np.cross(forward, _vector("up", up))
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward) * np.linalg.norm(np.asarray(up, float)):
        raise ValueError(f"up is {np.asarray(up).tolist()}: it is parallel to the line from eye to target")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    focal = height / (2 * math.tan(math.radians(fov) / 2))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(width, height, K, view_matrix(np.stack([right, np.cross(forward, right), forward]), eye))


def view_matrix(R: _Array, center: _Array) -> _Array:
    """World to camera, [4, 4], of the camera's axes in the world as rows [3, 3] and its centre [3]."""
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ center
    return viewmat


def with_size(camera: Camera, width: int, height: int) -> Camera:
    """The camera with another size: the same vertical field of view, the principal point scaled along.

    ValueError where the size is below 1.
    """
    if width < 1 or height < 1:
        raise ValueError(f"the size is {width} x {height}, wanted at least 1 x 1")
    ratio = height / camera.height
    K = camera.K.copy()
    K[0, 0], K[1, 1] = ratio * K[0, 0], ratio * K[1, 1]
    K[0, 2], K[1, 2] = K[0, 2] * width / camera.width, K[1, 2] * ratio
    return Camera(width, height, K, camera.viewmat)


def world_up(cameras: Sequence[Camera]) -> _Array:
    """The direction in the world that is up, unit [3], as most photographers hold their cameras; those here
    have upright pictures (`View.upright_camera`).

    It is orthogonal to the upright pictures' x axes as far as that says anything (photos that look down do
    not tilt it then), and the mean of their upward directions where not.
    """
    R = np.stack([camera.viewmat[:3, :3] for camera in cameras])
    right, mean = R[:, 0], -R[:, 1].mean(axis=0)
    values, vectors = np.linalg.eigh(right.T @ right / len(R))
    level = vectors[:, 0] * np.sign(vectors[:, 0] @ mean)
    if values[1] > 0.1 and values[0] < 0.05 and level @ mean > 0.5:
        mean = level
    norm = np.linalg.norm(mean)
    return mean / norm if norm > 1e-6 else np.array(UP)


def scene_up(scene: Scene) -> _Array:
    """Up in a scene, unit [3]: as was told of its world, else as its photos were held (`world_up`)."""
    if scene.world.up is not None:
        return np.array(scene.world.up)
    return world_up([view.upright_camera for view in scene.train])


def sight_lines(cameras: Sequence[Camera]) -> tuple[_Array, _Array, _Array, _Array]:
    """Centres [n, 3], directions [n, 3], and the normal equations A [3, 3], b [3] of the point nearest to all
    lines of sight: there the mean of (I - d d^T) (x - c) is 0.
    """
    centers = np.stack([camera.center for camera in cameras])
    forward = np.stack([camera.viewmat[2, :3] for camera in cameras])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    return centers, forward, across.mean(0), (across @ centers[:, :, None])[..., 0].mean(0)


def focus(cameras: Sequence[Camera]) -> _Array:
    """The point that the cameras look at: nearest to all lines of sight, [3]; ahead of them if none is."""
    centers, forward, normal, moment = sight_lines(cameras)
    reach = max(float(np.linalg.norm(centers - centers.mean(0), axis=1).max()), 1e-6)
    # A pull towards what lies ahead by the cameras' own extent decides where the lines are parallel.
    ahead, pull = centers.mean(0) + 2 * reach * forward.mean(0), 0.02
    point = np.linalg.solve(normal + pull * np.eye(3), moment + pull * ahead)
    return point if ((point - centers) * forward).sum(axis=1).mean() > 0 else ahead


def camera_path(
    cameras: Sequence[Camera],
    frames: int = 240,
    *,
    closed: bool = False,
    cuts: bool = False,
    sort: bool = True,
) -> list[Camera]:
    """A smooth path through given cameras, at an even speed: cubic splines through places and rotations.

    Cameras in an order that jumps to and fro are put in the order of a short walk, and of many some are
    chosen. All frames have the size of the first camera and its intrinsics.

    Args:
        cameras: at least 1, such as those of the training views.
        frames: how many, at least 1.
        closed: end where it began.
        cuts: go on at the other side of a leap, ten times as long as the walk's usual step, in place of
            flying where no camera stood: through walls and trees.
        sort: False: through all of them, in the order given.

    Raises:
        ValueError: no camera, or no frame.
    """
    _check(cameras, frames)
    walk = [*cameras]
    if sort:  # in the order of a walk; of very many, every so manieth
        walk = [walk[k] for k in evenly(len(walk), 400)]
        tour = [walk[k] for k in _short_walk(np.stack([camera.center for camera in walk]))]
        walk = walk if _lengths(walk).sum() <= 1.5 * _lengths(tour).sum() else tour
    pieces = _between_leaps(walk) if cuts else [walk]
    ways = np.array([_lengths(piece).sum() for piece in pieces])
    shares = ways / ways.sum() if len(pieces) > 1 else np.ones(1)
    ends = [0, *(int(end) for end in np.rint(frames * np.cumsum(shares)))]
    viewmats: list[_Array] = []
    for piece, share, (begin, end) in zip(pieces, shares, pairwise(ends), strict=True):
        # Of many more cameras a path shakes.
        keys = [piece[k] for k in evenly(len(piece), max(2, round(24 * share)))] if sort else piece
        viewmats += _spline(keys, end - begin, closed) if end > begin else []
    first = cameras[0]
    return [Camera(first.width, first.height, first.K, viewmat) for viewmat in viewmats]


def _spline(keys: list[Camera], frames: int, closed: bool) -> list[_Array]:
    """World to camera [4, 4], of at least one frame of a path through at least one camera, in their order."""
    from scipy.interpolate import CubicSpline, make_interp_spline  # here: only a path needs scipy
    from scipy.spatial.transform import Rotation

    keys = [*keys, keys[0]] if closed and len(keys) > 1 else keys
    centers = np.stack([camera.center for camera in keys])
    rotations = Rotation.from_matrix(np.stack([camera.viewmat[:3, :3] for camera in keys]))
    steps = _steps(centers, rotations.as_matrix())
    keep = np.concatenate([[True], steps > 1e-9])  # the same camera twice is one
    centers, steps = centers[keep], steps[steps > 1e-9]
    if len(centers) == 1:
        return [keys[0].viewmat] * frames
    times = np.concatenate([[0.0], np.cumsum(steps)])
    # Quaternions of one sign, splined and normalised: neighbours on a path are far from opposite.
    quats = rotations.as_quat()[keep]
    for k in range(1, len(quats)):
        quats[k] *= -1 if quats[k] @ quats[k - 1] < 0 else 1
    values = np.concatenate([centers, quats], axis=1)
    if closed and len(values) > 2 and quats[0] @ quats[-1] > 0:
        values[-1] = values[0]
        spline = CubicSpline(times, values, bc_type="periodic")
    else:
        spline = make_interp_spline(times, values, k=min(3, len(times) - 1))
    fine = np.linspace(0, times[-1], 20 * len(times) + 1)
    dense = spline(fine)
    turned = Rotation.from_quat(dense[:, 3:]).as_matrix()
    way = np.concatenate([[0.0], np.cumsum(_steps(dense[:, :3], turned))])
    even = np.linspace(0, way[-1], frames + closed)[:frames] if frames > 1 else np.zeros(1)
    found = spline(np.interp(even, way, fine))
    return [
        view_matrix(R, center)
        for R, center in zip(Rotation.from_quat(found[:, 3:]).as_matrix(), found[:, :3], strict=True)
    ]


def circle(
    center: ArrayLike,
    radius: float,
    *,
    height: float = 0.0,
    frames: int = 120,
    up: ArrayLike = UP,
    like: Camera | None = None,
) -> list[Camera]:
    """Cameras on a circle around `center`, all of which look at it.

    Args:
        center: [3], world units.
        radius: of the circle, world units, above 0.
        height: of the circle above the centre, world units.
        frames: how many, at least 1.
        up: [3], the axis of the circle.
        like: the camera whose size and intrinsics they have; None: 504 x 378 px, 60 degrees.
    """
    if frames < 1:
        raise ValueError(f"frames is {frames}, wanted at least 1")
    if not 0 < radius < math.inf:
        raise ValueError(f"radius is {radius}, wanted a number above 0")
    middle, axis = _vector("center", center), _unit("up", up)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    made = []
    for angle in np.linspace(0, 2 * math.pi, frames, endpoint=False):
        eye = middle + radius * (math.cos(angle) * side + math.sin(angle) * other) + height * axis
        made.append(like_camera(look_at(eye, middle, up=axis), like))
    return made


def orbit_cameras(cameras: Sequence[Camera], frames: int = 120, up: ArrayLike | None = None) -> list[Camera]:
    """An orbit of what given cameras look at, as far away as they are. `up`: [3]; None: `world_up`.

    Cameras that stand around their focus are followed in a circle; those on one side of it get a small
    ellipse before it, since what is behind it was never seen.
    """
    _check(cameras, frames)
    up, middle = world_up(cameras) if up is None else _unit("up", up), focus(cameras)
    offsets = np.stack([camera.center for camera in cameras]) - middle
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    radii = np.linalg.norm(flat, axis=1)
    like = cameras[0]
    mean = flat.mean(axis=0)
    if len(cameras) > 2 and _range(flat, up) > AROUND:
        radius, height = float(np.median(radii)), float(np.median(heights))
        return circle(middle, radius, height=height, frames=frames, up=up, like=like)
    ahead = -mean / max(float(np.linalg.norm(mean)), 1e-9)
    right = np.cross(ahead, up)
    wide = max(float(np.abs((flat - mean) @ right).max()), 0.02 * float(radii.mean()))
    high = max(float(np.abs(heights - heights.mean()).max()), 0.25 * wide)
    eye = middle + mean + heights.mean() * up
    angles = np.linspace(0, 2 * math.pi, frames, endpoint=False)
    return [
        like_camera(
            look_at(eye + 0.5 * (wide * math.cos(a) * right + high * math.sin(a) * up), middle, up=up), like
        )
        for a in angles
    ]


def like_camera(camera: Camera, like: Camera | None) -> Camera:
    """The pose of a camera with the size and intrinsics of another."""
    return camera if like is None else Camera(like.width, like.height, like.K, camera.viewmat)


def _range(flat: _Array, up: _Array) -> float:
    """The angle that directions [n, 3] in the plane across `up` cover: all but their widest gap."""
    side = flat[np.linalg.norm(flat, axis=1).argmax()]
    angles = np.sort(np.arctan2(flat @ np.cross(up, side), flat @ side))
    gaps = np.diff(np.concatenate([angles, angles[:1] + 2 * math.pi]))
    return float(2 * math.pi - gaps.max())


def _lengths(walk: list[Camera]) -> _Array:
    """From each camera to the next, [n - 1]."""
    return np.linalg.norm(np.diff([camera.center for camera in walk], axis=0), axis=1)


def _between_leaps(walk: list[Camera]) -> list[list[Camera]]:
    """The pieces of a walk between leaps; cameras that stand alone there are left out."""
    steps = _lengths(walk)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    # South has a leap of 26, from one side of a house to another; films and walks around have up to 7.
    ends = [0, *(int(k) + 1 for k in np.flatnonzero(steps > 10 * usual)), len(walk)]
    pieces = [walk[begin:end] for begin, end in pairwise(ends)]
    return [piece for piece in pieces if _lengths(piece).sum() > 0] or [walk]


def _short_walk(centers: _Array) -> list[int]:
    """From one end through all points [n, 3], the nearest first, with crossings taken out (2-opt)."""
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    left = set(range(len(centers)))
    order = [int(np.linalg.norm(centers - centers.mean(0), axis=1).argmax())]
    left.remove(order[0])
    while left:
        order.append(min(left, key=lambda k: float(apart[order[-1], k])))
        left.remove(order[-1])
    for _ in range(4):
        before = list(order)
        for i in range(len(order) - 2):
            a, b = order[i], order[i + 1]
            ends = np.array(order[i + 2 :])
            after = np.array([*order[i + 3 :], -1])
            old = apart[a, b] + np.where(after < 0, 0, apart[ends, after])
            new = apart[a, ends] + np.where(after < 0, 0, apart[b, after])
            best = int((old - new).argmax())
            if (old - new)[best] > 1e-12:
                order[i + 1 : i + 3 + best] = order[i + 1 : i + 3 + best][::-1]
        if order == before:
            break
    return order


def _steps(centers: _Array, R: _Array) -> _Array:
    """How far each camera is from the one before it, [n - 1]: the way, and the turn as a way."""
    extent = float(np.linalg.norm(centers - centers.mean(0), axis=1).max()) or 1.0
    cosines = (np.einsum("nij,nij->n", R[1:], R[:-1]) - 1) / 2
    turns = np.arccos(cosines.clip(-1, 1))
    return np.hypot(np.linalg.norm(np.diff(centers, axis=0), axis=1), 0.5 * extent * turns)


def _check(cameras: Sequence[Camera], frames: int) -> None:
    if not cameras:
        raise ValueError("cameras is empty, wanted at least one")
    if frames < 1:
        raise ValueError(f"frames is {frames}, wanted at least 1")


def _vector(name: str, value: ArrayLike) -> _Array:
    vector = np.asarray(value, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} is {np.asarray(value).tolist()}, wanted three finite numbers")
    return vector


def _unit(name: str, value: ArrayLike) -> _Array:
    vector = _vector(name, value)
    length = float(np.linalg.norm(vector))
    if not length > 0:
        raise ValueError(f"{name} is {vector.tolist()}, wanted a direction")
    return vector / length
