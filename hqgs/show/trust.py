"""How far to believe each pixel of a new view: residuals of the training photos, carried by the Gaussians.

A Gaussian gets the error of the pixels that it shows in: u of the model w u = |photo - render| over the
pixels of all photos, w the blending weights, by expectation maximisation (Richardson 1972, Lucy 1974), which
keeps u above 0. Rendered as a channel, u is what the photos say of a new pixel; what no photo saw keeps a
prior. After GS-U and PRIMU (2508.02443), with one value for all directions and one curve for all scenes:
more features and a fit for each scene did not pay (docs/log.md).
"""

from __future__ import annotations

from collections.abc import Callable
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
from hqgs.scene.paths import resized
from hqgs.scene.scene import Camera

PHOTOS, SIDE = 64, 400  # of the training photos are looked at, at most so many px wide and high
ROUNDS = 4  # of the maximisation: more change the order of the pixels by less than its scatter
PRIOR, PRIOR_PIXELS = 0.1, 1.0  # error of a Gaussian (white is 1), and how many pixels' weight that has
EMPTY = 0.3  # error of what is behind everything
FLOOR = 0.002  # keeps ratios of errors finite: half a level
POWER, SCALE = 0.70, 0.52  # from what is carried to what 9 of 10 pixels of new views stay below: fitted
GOOD = 20.0  # levels of 255
SEEN = 0.5  # pixels' weight that a Gaussian has in a photo that sees it
STEPS = 50  # of a sparsification curve
Array = NDArray[np.float32]
OnPass = Callable[[int, int], None]


@dataclass(frozen=True)
class Trust:
    """What the photos say of each Gaussian, by `learn_trust`."""

    gaussians: Gaussians
    errors: Tensor  # [N], mean over the channels, white is 1
    photos: Tensor  # [N], how many see it

    def bound(self, camera: Camera) -> Array:
        """Levels of 255 that a pixel's error, the mean of its channels, stays below 9 times of 10, [H, W].

        Fitted on other scenes. Of photos that are blurred or noisy, it is the distance from such photos.
        """
        carried, alpha = self._shown(camera, self.errors)
        known = carried + EMPTY * (1 - alpha)
        return (255 * np.maximum(known, SCALE * (known + FLOOR) ** POWER)).clip(0, 255)

    def seen(self, camera: Camera) -> Array:
        """How many photos see what a pixel shows, [H, W]: the measure that the bound is compared with."""
        return self._shown(camera, self.photos)[0]

    def _shown(self, camera: Camera, values: Tensor) -> tuple[Array, Array]:
        with one_torch_thread(), torch.no_grad():
            near = self.gaussians.near_plane()
            carried, alpha, _ = self.gaussians.rasterize(camera, values[:, None], near_plane=near)
        return carried[0, ..., 0].numpy(), alpha[0, ..., 0].numpy()


class LazyTrust:
    """Of one scene, learned when it is first asked for."""

    def __init__(self, known: RunCameras | None) -> None:
        self._known = known
        self._trust: Trust | None = None

    @property
    def possible(self) -> bool:
        """Whether the run has training photos."""
        views = [] if self._known is None else self._known.views
        return any(view.photo is not None for view in views if not view.held_out)

    def of(self, gaussians: Gaussians) -> Trust:
        """ValueError where it is not possible."""
        if self._trust is None or self._trust.gaussians is not gaussians:
            self._trust = learn_trust(gaussians, self._known or RunCameras(np.zeros(3), []))
        return self._trust


def learn_trust(gaussians: Gaussians, known: RunCameras, progress: OnPass | None = None) -> Trust:
    """What the training photos of a run, in its folder, say of its Gaussians.

    `progress` hears how many passes over a photo are done, and how many there are. ValueError where the run
    has no training photo.
    """
    views = [view for view in known.views if not view.held_out and view.photo is not None]
    if not views:
        raise ValueError("trust needs the photos of a run: give its folder, with cameras.json and photos/")
    chosen, n = [views[k] for k in evenly(len(views), PHOTOS)], len(gaussians)
    looks, done = list[tuple[Camera, Tensor]](), 0
    sums, photos = torch.zeros(n, 2), torch.zeros(n)  # sums of weights, and of weights times errors

    def tell() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, len(chosen) * (ROUNDS + 1))

    with one_torch_thread():
        for view in chosen:
            camera, error = _error(gaussians, view)
            looks.append((camera, error))
            both = _back(
                gaussians, camera, torch.zeros(n, 2), torch.stack([torch.ones_like(error), error], -1)
            )
            sums += both
            photos += both[:, 0] > SEEN
            tell()
        weights, prior = sums[:, 0] + PRIOR_PIXELS, PRIOR * PRIOR_PIXELS
        errors = (sums[:, 1] + prior) / weights
        for _ in range(ROUNDS):
            found = torch.zeros(n)
            for camera, error in looks:
                found += _back(gaussians, camera, errors[:, None], error[..., None], ratio=True)[:, 0]
                tell()
            errors = (errors * found + prior) / weights
    return Trust(gaussians, errors, photos)


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


def _error(gaussians: Gaussians, view: KnownCamera) -> tuple[Camera, Tensor]:
    """A smaller camera of a view, and the error of its render, mean of the channels, [H, W]."""
    assert view.photo is not None
    with Image.open(view.photo) as file:
        picture = file.convert("RGB")
    picture.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
    photo = torch.from_numpy(np.array(picture)).float() / 255
    camera = resized(view.camera, picture.width, picture.height)
    with torch.no_grad():
        render = gaussians.render(camera)
    return camera, (render.clamp(0, 1) - photo).abs().mean(-1)


@dataclass(frozen=True)
class Measured:
    """A map of trust against the held-out photos of its run, over all of their pixels."""

    covered: float  # share of the pixels whose error stays below its bound; 0.9 was promised
    good: float  # share of those with a bound of at most GOOD
    right: float  # share of the good ones with an error of at most GOOD
    ause: float  # area between the sparsification curves of trust and of the true error, over the mean error
    by_photos: float  # the same of the number of photos that see a pixel

    def __str__(self) -> str:
        return (
            f"on the held-out photos {100 * self.covered:.1f} % of the pixels stay below their bound; "
            f"{100 * self.good:.1f} % are called good to {GOOD:.0f} levels, {100 * self.right:.1f} % of them "
            f"are; AUSE {self.ause:.3f}, by the number of photos that see a pixel {self.by_photos:.3f}"
        )


def measure_trust(trust: Trust, known: RunCameras) -> Measured | None:
    """None where the run has no held-out photo."""
    errors, bounds, areas = list[Array](), list[Array](), list[tuple[float, float]]()
    for view in known.views:
        if view.held_out and view.photo is not None:
            camera, error = _error(trust.gaussians, view)
            errors.append(255 * error.numpy().ravel())
            bounds.append(trust.bound(camera).ravel())
            seen = trust.seen(camera).ravel()
            areas.append((_ause(bounds[-1], errors[-1]), _ause(-seen, errors[-1])))
    if not errors:
        return None
    error, bound = np.concatenate(errors), np.concatenate(bounds)
    good = bound <= GOOD
    right = float((error[good] <= GOOD).mean()) if good.any() else 1.0
    ause, by_photos = np.mean(areas, axis=0).tolist()
    return Measured(float((error <= bound).mean()), float(good.mean()), right, ause, by_photos)


def _ause(doubt: Array, error: Array) -> float:
    """Area under the mean error of the pixels least in doubt, over all shares of them, less that of those
    with the least error, over the mean of all."""

    def curve(key: Array) -> NDArray[np.float64]:
        sums = error[np.argsort(key, kind="stable")].cumsum(dtype=np.float64)
        ends = np.linspace(0, len(error), STEPS + 1)[1:].astype(int)
        return sums[ends - 1] / ends

    return float((curve(doubt) - curve(error)).mean() / max(float(error.mean()), 1e-9))
