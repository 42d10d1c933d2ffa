"""Held-out cameras moved to where they see the trained scene best: what is lost to the frame is set aside.

Where poses come from the photos, the frame of the scene is not quite that of the held-out cameras, which then
look at the right scene from slightly wrong places. The usual second measure (BARF, NoPe-NeRF, CF-3DGS) fits
each held-out camera, six numbers, to its photo with the scene frozen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.photos.pixels import as_floats
from hqgs.scene.geometry import project, within
from hqgs.scene.scene import Camera, View

Floats = NDArray[np.float64]
DIFFERENCE = 0.3  # px by which a camera is moved to see what that changes


@dataclass(frozen=True)
class Fitted:
    """A held-out view, its camera fitted."""

    view: View
    rotation_deg: float  # by which it was turned
    pixels: float  # by which the Gaussians moved in its picture, median


def fit_cameras(
    views: Sequence[View],
    gaussians: Gaussians,
    sh_degree: int,
    background: tuple[float, float, float],
    told: Callable[[int], None] = lambda done: None,
) -> list[Fitted]:
    """Each view with the camera from which the Gaussians look most like its photo.

    Gauss-Newton on the squared error of the pixels that count, in a turn about the camera's centre and a
    shift, smoothed photos first; the best camera counts, which may be the one it had. What a small move of
    the camera changes is seen by rendering. `told` hears how many are done.
    """
    done: list[Fitted] = []
    for view in views:
        done.append(fit_camera(view, gaussians, sh_degree, background))
        told(len(done))
    return done


def fit_camera(
    view: View, gaussians: Gaussians, sh_degree: int, background: tuple[float, float, float]
) -> Fitted:
    """The same for one view."""
    units = _units(view.camera, gaussians)
    counted = np.ones(view.image.shape[:2]) if view.mask is None else view.mask.astype(np.float64)
    photo = as_floats(view.image).astype(np.float64)

    def seen(camera: Camera) -> Floats:
        with one_torch_thread(), torch.no_grad():
            image, _ = render_view(gaussians, camera, sh_degree, background)
        return image.clamp(0, 1).numpy().astype(np.float64)

    camera = view.camera
    for sigma in (3.0, 1.0, 0.0):  # px, coarse to fine: a camera may be several pixels off
        camera = _level(camera, seen, photo, counted, units, sigma)
    if _cost(seen(camera), photo, counted, 0.0) >= _cost(seen(view.camera), photo, counted, 0.0):
        camera = view.camera
    own, now = view.camera.viewmat, camera.viewmat
    turn = Rotation.from_matrix(now[:3, :3] @ own[:3, :3].T).magnitude()
    means = gaussians.means.detach().numpy().astype(np.float64)
    (at, depths), (there, _) = project(view.camera, means), project(camera, means)
    shown = within(view.camera, at, depths)
    moved = float(np.median(np.linalg.norm(there - at, axis=1)[shown])) if shown.any() else 0.0
    return Fitted(replace(view, camera=camera), float(np.rad2deg(turn)), moved)


def _units(camera: Camera, gaussians: Gaussians) -> Floats:
    """Turns and shifts [6] that move a picture about one pixel: 1 / f, and the middle depth / f."""
    pixels, depths = project(camera, gaussians.means.detach().numpy().astype(np.float64))
    inside = within(camera, pixels, depths)
    depth = float(np.median(depths[inside])) if inside.any() else 1.0
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    return np.array([1.0, 1, 1, depth, depth, depth]) / focal


def _moved(camera: Camera, move: Floats) -> Camera:
    """The camera after a turn about its centre, a rotation vector, and a shift, both in its own frame [6]."""
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(move[:3]).as_matrix()
    step[:3, 3] = move[3:]
    return replace(camera, viewmat=step @ camera.viewmat)


def _smooth(image: Floats, sigma: float) -> Floats:
    return gaussian_filter(image, (sigma, sigma, 0), mode="nearest") if sigma else image


def _cost(render: Floats, photo: Floats, counted: Floats, sigma: float) -> float:
    return float((np.square(_smooth(render - photo, sigma)).sum(-1) * counted).sum())


def _level(
    camera: Camera,
    seen: Callable[[Camera], Floats],
    photo: Floats,
    counted: Floats,
    units: Floats,
    sigma: float,
) -> Camera:
    """Steps with photo and renders smoothed by `sigma` px, until they gain little."""
    weight, known = np.sqrt(counted)[..., None], dict[bytes, Floats]()

    def off(move: Floats) -> Floats:
        if (key := move.tobytes()) not in known:  # slopes are asked for where it was last
            known.clear()
            known[key] = (_smooth(seen(_moved(camera, move * units)) - photo, sigma) * weight).ravel()
        return known[key]

    def slopes(move: Floats) -> Floats:
        here = off(move)
        return np.stack([(off(move + one) - here) / DIFFERENCE for one in DIFFERENCE * np.eye(6)], axis=1)

    # Cameras turned by 1.5 degrees come home in so many steps (`tests/test_fit_cameras.py`).
    found = least_squares(off, np.zeros(6), slopes, ftol=1e-4, max_nfev=10)  # pyright: ignore[reportArgumentType]
    return _moved(camera, found.x * units)
