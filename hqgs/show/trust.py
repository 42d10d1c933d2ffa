"""How far to believe each pixel of a new view: residuals of the training photos, carried by the Gaussians.

A Gaussian gets the error of the pixels that it shows in: u of the model w u = |photo - render| over the
pixels of all photos, w the blending weights, by expectation maximisation (Richardson 1972, Lucy 1974), which
keeps u above 0. Rendered as a channel, u is what the photos say of a new pixel; what no photo saw keeps a
prior. After GS-U and PRIMU (2508.02443), with one value for all directions and one curve for all scenes:
more features and a fit for each scene did not pay (docs/log.md). One factor on u is fitted for each run, to
the photos that it held out (`calibrated`): scenes learn their training photos by heart in different degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from hqgs.base.evenly import evenly
from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.scene.camera_files import KnownCamera, RunCameras
from hqgs.scene.geometry import resized_camera
from hqgs.scene.scene import Camera
from hqgs.show.constants import (
    CALIBRATORS,
    EMPTY,
    FLOOR,
    GOOD,
    LEAST_GOOD,
    POWER,
    PRIOR,
    SCALE,
    SEEN,
    SHARE,
    TRUST_PHOTOS,
    TRUST_ROUNDS,
    TRUST_SIDE,
    TRUST_TRAINED,
)

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Held:
    """A held-out photo against its render, with what the training photos say of its pixels, [H, W]."""

    name: str
    camera: Camera
    psnr: float  # dB, at the size that it was kept in
    error: Array  # mean of the channels, white is 1
    carried: Array  # before calibration
    alpha: Array
    seen: Array  # training photos

    def needed(self) -> NDArray[np.floating]:
        """The factor on what is carried at which each pixel's bound meets its error, flat."""
        known = np.minimum(self.error, (self.error / SCALE) ** (1 / POWER) - FLOOR)
        return self._factor(known)

    def good_below(self) -> NDArray[np.floating]:
        """The largest factor at which each pixel is called good, flat."""
        return self._factor(np.minimum(GOOD / 255, (GOOD / 255 / SCALE) ** (1 / POWER) - FLOOR))

    def _factor(self, known: NDArray[np.floating] | float) -> NDArray[np.floating]:
        return ((known - EMPTY * (1 - self.alpha)) / np.maximum(self.carried, 1e-6)).ravel()


@dataclass(frozen=True)
class Trust:
    """What the photos say of each Gaussian, by `learn_trust`."""

    gaussians: Gaussians
    errors: Tensor  # [N], mean over the channels, white is 1; calibrated
    photos: Tensor  # [N], how many see it; 0 where a file says the errors
    factor: float = 1.0  # by which the errors were calibrated
    held: tuple[Held, ...] = ()  # what calibrated them
    trained: tuple[Held, ...] = ()  # the same of a few training photos

    def bound(self, camera: Camera) -> Array:
        """Levels of 255 that a pixel's error, the mean of its channels, stays below 9 times of 10, [H, W].

        Of photos that are blurred or noisy, it is the distance from such photos.
        """
        return bound_of(*self.shown(camera, self.errors))

    def shown(self, camera: Camera, values: Tensor) -> tuple[Array, Array]:
        """Values of the Gaussians, [N], blended as colours are, and alpha, both [H, W]."""
        with one_torch_thread(), torch.no_grad():
            near = self.gaussians.near_plane()
            carried, alpha, _ = self.gaussians.rasterize(camera, values[:, None], near_plane=near)
        return carried[0, ..., 0].numpy(), alpha[0, ..., 0].numpy()


def bound_of(carried: Array, alpha: Array) -> Array:
    """Levels of 255."""
    known = carried + EMPTY * (1 - alpha)
    return (255 * np.maximum(known, SCALE * (known + FLOOR) ** POWER)).clip(0, 255)


def calibrated(held: Sequence[Held]) -> float:
    """The factor on what is carried at which SHARE of the photos' pixels stay below their bound, and SHARE
    of those that are called good are good: the least one. 1 without a photo."""
    if not held:
        return 1.0
    needed = np.concatenate([one.needed() for one in held])
    below = np.concatenate([one.good_below() for one in held])
    factor = max(float(np.quantile(needed, SHARE)), 0.0)
    right = np.concatenate([h.error.ravel() for h in held]) <= GOOD / 255
    order = np.argsort(-below, kind="stable")
    shares = np.cumsum(right[order]) / np.arange(1, len(order) + 1)
    called = int((below >= factor).sum())
    if called <= LEAST_GOOD * len(order) or shares[called - 1] >= SHARE:
        return factor
    enough = np.flatnonzero(shares[:called] >= SHARE)
    last = int(enough[-1]) if len(enough) and enough[-1] >= LEAST_GOOD * len(order) else 0
    return float(max(factor, below[order[last]]))


class LazyTrust:
    """Of one scene, learned when it is first asked for."""

    def __init__(self, known: RunCameras | None) -> None:
        self._known = known
        self._trust: Trust | None = None

    def possible(self, gaussians: Gaussians) -> bool:
        """Whether the run has training photos, or the file of the Gaussians says their errors."""
        if gaussians.errors is not None:
            return True
        views = [] if self._known is None else self._known.views
        return any(view.photo is not None for view in views if not view.held_out)

    def of(self, gaussians: Gaussians) -> Trust:
        """ValueError where it is not possible."""
        if self._trust is None or self._trust.gaussians is not gaussians:
            self._trust = trust_of(gaussians, self._known)
        return self._trust


def trust_of(gaussians: Gaussians, known: RunCameras | None) -> Trust:
    """Of a run's photos; or without them, what the file of the Gaussians says. ValueError without either."""
    photos = known is not None and any(v.photo is not None for v in known.views if not v.held_out)
    if gaussians.errors is not None and not photos:
        return Trust(gaussians, gaussians.errors, torch.zeros(len(gaussians)))
    return learn_trust(gaussians, known or RunCameras(np.zeros(3), []))


def learn_trust(gaussians: Gaussians, known: RunCameras, photos: int = TRUST_PHOTOS) -> Trust:
    """What the photos of a run, in its folder, say of its Gaussians.

    The errors are those of at most `photos` training photos, the factor is that of the held-out ones.
    ValueError where the run has no training photo.
    """
    views = [view for view in known.views if not view.held_out and view.photo is not None]
    if not views:
        raise ValueError("trust needs the photos of a run: give its folder, with cameras.json and photos/")
    chosen, n = [views[k] for k in evenly(len(views), photos)], len(gaussians)
    looks = list[tuple[Camera, Tensor]]()
    sums, seen = torch.zeros(n, 2), torch.zeros(n)  # sums of weights, and of weights times errors

    with one_torch_thread():
        for view in chosen:
            camera, error, _ = error_of(gaussians, view)
            looks.append((camera, error))
            both = _back(
                gaussians, camera, torch.zeros(n, 2), torch.stack([torch.ones_like(error), error], -1)
            )
            sums += both
            seen += both[:, 0] > SEEN
        weights = sums[:, 0] + 1
        errors = (sums[:, 1] + PRIOR) / weights
        for _ in range(TRUST_ROUNDS):
            found = torch.zeros(n)
            for camera, error in looks:
                found += _back(gaussians, camera, errors[:, None], error[..., None], ratio=True)[:, 0]
            errors = (errors * found + PRIOR) / weights
    carried = Trust(gaussians, errors, seen)

    def look(view: KnownCamera) -> Held:
        camera, error, psnr = error_of(gaussians, view, psnr=True)
        shown = *carried.shown(camera, errors), carried.shown(camera, seen)[0]
        return Held(view.name, camera, psnr, error.numpy(), *shown)

    out = [view for view in known.views if view.held_out and view.photo is not None]
    held = tuple(look(out[k]) for k in evenly(len(out), CALIBRATORS))
    trained = tuple(look(chosen[k]) for k in evenly(len(chosen), TRUST_TRAINED)) if held else ()
    factor = calibrated(held)
    return Trust(gaussians, factor * errors, seen, factor, held, trained)


def _back(
    gaussians: Gaussians, camera: Camera, values: Tensor, pixels: Tensor, ratio: bool = False
) -> Tensor:
    """For each Gaussian [N, D] the sum over pixels [H, W, D] of its weight times the pixel; or, by `ratio`,
    times the pixel over what the values [N, D] render to there."""
    values = values.clone().requires_grad_()
    render = gaussians.rasterize(camera, values, near_plane=gaussians.near_plane())[0][0]
    render.backward((pixels + FLOOR) / (render.detach() + FLOOR) if ratio else pixels)
    assert values.grad is not None
    return values.grad


def error_of(gaussians: Gaussians, view: KnownCamera, psnr: bool = False) -> tuple[Camera, Tensor, float]:
    """A smaller camera of a view, the error of its render there, mean of the channels, [H, W], and the PSNR,
    dB; with `psnr` at the size that the photo was kept in."""
    assert view.photo is not None
    with Image.open(view.photo) as file:
        picture = file.convert("RGB")
    large = (
        psnr_of(_off(gaussians, view.camera, picture)[1]) if psnr and max(picture.size) > TRUST_SIDE else None
    )
    picture.thumbnail((TRUST_SIDE, TRUST_SIDE), Image.Resampling.LANCZOS)
    camera, off = _off(gaussians, view.camera, picture)
    return camera, off.abs().mean(-1), psnr_of(off) if large is None else large


@torch.no_grad()
def _off(gaussians: Gaussians, camera: Camera, picture: Image.Image) -> tuple[Camera, Tensor]:
    """The camera of a photo of another size, and render less photo, [H, W, 3]."""
    camera = resized_camera(camera, picture.width, picture.height)
    return camera, gaussians.render(camera).clamp(0, 1) - torch.from_numpy(np.array(picture)).float() / 255


def psnr_of(off: Tensor) -> float:
    """dB, of differences where white is 1; 100 where there are none."""
    return -10 * math.log10(max(float(off.square().mean()), 1e-10))
