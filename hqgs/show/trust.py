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
from dataclasses import dataclass, replace

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
    NONE_GOOD,
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
    counts: NDArray[np.bool_]  # by the photo's mask

    def flat(self, values: Array) -> Array:
        """Those of the pixels that count."""
        return values[self.counts]

    def needed(self) -> NDArray[np.floating]:
        """The factor on what is carried at which each pixel's bound meets its error, flat."""
        known = np.minimum(self.error, (self.error / SCALE) ** (1 / POWER) - FLOOR)
        return self._factor(known)

    def good_below(self) -> NDArray[np.floating]:
        """The largest factor at which each pixel is called good, flat."""
        return self._factor(np.minimum(GOOD / 255, (GOOD / 255 / SCALE) ** (1 / POWER) - FLOOR))

    def _factor(self, known: NDArray[np.floating] | float) -> NDArray[np.floating]:
        return ((known - EMPTY * (1 - self.alpha)) / np.maximum(self.carried, 1e-6))[self.counts]


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
    right = np.concatenate([one.flat(one.error) for one in held]) <= GOOD / 255
    order = np.argsort(-below, kind="stable")
    shares = np.cumsum(right[order]) / np.arange(1, len(order) + 1)
    called = int((below >= factor).sum())
    if called <= LEAST_GOOD * len(order) or shares[called - 1] >= SHARE:
        return factor
    ends = np.append(np.diff(below[order]) < 0, True)[:called]  # pixels that are alike are good together
    enough = np.flatnonzero(ends & (shares[:called] >= SHARE))
    if len(enough) and enough[-1] >= LEAST_GOOD * len(order):
        return float(max(factor, below[order[enough[-1]]]))
    return float(max(factor, NONE_GOOD * below[order[0]]))


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
        return any(shows(view) for view in views if not view.held_out)

    def of(self, gaussians: Gaussians) -> Trust:
        """ValueError where it is not possible."""
        if self._trust is None or self._trust.gaussians is not gaussians:
            self._trust = trust_of(gaussians, self._known)
        return self._trust


def trust_of(gaussians: Gaussians, known: RunCameras | None) -> Trust:
    """Of a run's photos; or without them, what the file of the Gaussians says. ValueError without either."""
    photos = known is not None and any(shows(view) for view in known.views if not view.held_out)
    if gaussians.errors is not None and not photos:
        return Trust(gaussians, gaussians.errors, torch.zeros(len(gaussians)))
    return learn_trust(gaussians, known or RunCameras(np.zeros(3), []))


def learn_trust(gaussians: Gaussians, known: RunCameras, photos: int = TRUST_PHOTOS) -> Trust:
    """What the photos of a run, in its folder, say of its Gaussians.

    The errors are those of at most `photos` training photos, the factor is that of the held-out ones.
    ValueError where the run has no training photo.
    """
    views = [view for view in known.views if not view.held_out and shows(view)]
    if not views:
        raise ValueError("trust needs the photos of a run: give its folder, with cameras.json and photos/")
    chosen, n = [views[k] for k in evenly(len(views), photos)], len(gaussians)
    looks = list[Off]()
    sums, seen = torch.zeros(n, 2), torch.zeros(n)  # sums of weights, and of weights times errors

    with one_torch_thread():
        for view in chosen:
            off = error_of(gaussians, view, known.background)
            looks.append(off)
            pixels = torch.stack([off.counts.float(), off.error], -1)
            both = _back(gaussians, off.camera, torch.zeros(n, 2), pixels)
            sums += both
            seen += both[:, 0] > SEEN
        weights = sums[:, 0] + 1
        errors = (sums[:, 1] + PRIOR) / weights
        for _ in range(TRUST_ROUNDS):
            found = torch.zeros(n)
            for off in looks:
                found += _back(gaussians, off.camera, errors[:, None], off.error[..., None], off.counts)[:, 0]
            errors = (errors * found + PRIOR) / weights
    carried = Trust(gaussians, errors, seen)

    def look(view: KnownCamera) -> Held:
        off = error_of(gaussians, view, known.background, psnr=True)
        shown = *carried.shown(off.camera, errors), carried.shown(off.camera, seen)[0]
        return Held(view.name, off.camera, off.psnr, off.error.numpy(), *shown, off.counts.numpy())

    out = [view for view in known.views if view.held_out and shows(view)]
    held = tuple(one for k in evenly(len(out), CALIBRATORS) if (one := look(out[k])).counts.any())
    trained = tuple(look(chosen[k]) for k in evenly(len(chosen), TRUST_TRAINED)) if held else ()
    factor = calibrated(held)
    return Trust(gaussians, factor * errors, seen, factor, held, trained)


def _back(
    gaussians: Gaussians, camera: Camera, values: Tensor, pixels: Tensor, counts: Tensor | None = None
) -> Tensor:
    """For each Gaussian [N, D] the sum over pixels [H, W, D] of its weight times the pixel; or, where the
    pixels of `counts` [H, W] alone count, times the pixel over what the values [N, D] render to there."""
    values = values.clone().requires_grad_()
    render = gaussians.rasterize(camera, values, near_plane=gaussians.near_plane())[0][0]
    if counts is not None:
        pixels = (pixels + FLOOR) / (render.detach() + FLOOR) * counts[..., None]
    render.backward(pixels)
    assert values.grad is not None
    return values.grad


@dataclass(frozen=True)
class Off:
    """A photo against its render, small."""

    camera: Camera
    error: Tensor  # [H, W], mean of the channels, white is 1; 0 where it does not count
    counts: Tensor  # [H, W], bool, by its mask
    psnr: float  # dB


def error_of(
    gaussians: Gaussians, view: KnownCamera, background: tuple[float, float, float], psnr: bool = False
) -> Off:
    """The error of a view's render; with `psnr` that of the size that the photo was kept in, else at the
    smaller size of the error."""
    assert view.photo is not None
    with Image.open(view.photo) as file:
        picture = file.convert("RGB")
    large = None
    if psnr and max(picture.size) > TRUST_SIDE:
        large = _off(gaussians, view, picture, background).psnr
    picture.thumbnail((TRUST_SIDE, TRUST_SIDE), Image.Resampling.LANCZOS)
    off = _off(gaussians, view, picture, background)
    return off if large is None else replace(off, psnr=large)


@torch.no_grad()
def _off(
    gaussians: Gaussians, view: KnownCamera, picture: Image.Image, background: tuple[float, float, float]
) -> Off:
    """Of the photo at this size."""
    camera = resized_camera(view.camera, picture.width, picture.height)
    counts = torch.from_numpy(counted(view, picture.size))
    render = gaussians.render(camera, background=background).clamp(0, 1)
    off = (render - torch.from_numpy(np.array(picture)).float() / 255) * counts[..., None]
    return Off(camera, off.abs().mean(-1), counts, psnr_of(off[counts]))


def shows(view: KnownCamera) -> bool:
    """Whether its photo is there, and its mask leaves something of it."""
    if view.photo is None or view.mask is None:
        return view.photo is not None
    with Image.open(view.mask) as file:
        return bool(counted(view, file.size).any())


def counted(view: KnownCamera, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Where the photo counts, at a size (width, height), [H, W]."""
    if view.mask is None:
        return np.ones(size[::-1], bool)
    with Image.open(view.mask) as file:
        return np.array(file.convert("L").resize(size, Image.Resampling.BOX)) == 255


def psnr_of(off: Tensor) -> float:
    """dB, of differences where white is 1; 100 where there are none."""
    return -10 * math.log10(max(float(off.square().mean()), 1e-10)) if off.numel() else 100.0
