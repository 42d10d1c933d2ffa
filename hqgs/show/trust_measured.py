"""How right a map of trust is, and what it says of a camera path: both by the held-out photos of the run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hqgs.base.evenly import evenly
from hqgs.evaluation.constants import CONFIDENCE
from hqgs.scene.geometry import shrunk_camera
from hqgs.scene.scene import Camera
from hqgs.show.constants import (
    EMPTY,
    GOOD,
    HELD_AWAY,
    PATH_LOOKS,
    SLOPE_WEIGHT,
    SPREAD,
    SPREAD_PHOTOS,
    TRUST_SIDE,
)
from hqgs.show.trust import Array, Trust, bound_of, calibrated


@dataclass(frozen=True)
class Measured:
    """A map of trust against the held-out photos of its run, over all of their pixels.

    Each photo is judged by a calibration on the others; a single one by none.
    """

    photos: int
    covered: float  # share of the pixels whose error stays below its bound; 0.9 was promised
    good: float  # share of those with a bound of at most GOOD
    right: float  # share of the good ones with an error of at most GOOD
    ause: float  # area between the sparsification curves of trust and of the true error, over the mean error
    by_photos: float  # the same of the number of photos that see a pixel

    def __str__(self) -> str:
        right = f", {100 * self.right:.1f} % of them are" if self.good else ""
        return (
            f"on {self.photos} held-out photo{'s' * (self.photos > 1)} {100 * self.covered:.1f} % of the "
            f"pixels stay below their bound; {100 * self.good:.1f} % are called good to {GOOD:.0f} levels"
            f"{right}; AUSE {self.ause:.3f}, by the number of photos that see a pixel {self.by_photos:.3f}"
        )


def measure_trust(trust: Trust) -> Measured | None:
    """None where the run has no held-out photo."""
    held, pixels = trust.held, 0
    if not held:
        return None
    below = good = right = 0
    areas = list[tuple[float, float]]()
    for k, one in enumerate(held):
        factor = calibrated([*held[:k], *held[k + 1 :]])
        bound, error = one.flat(bound_of(factor * one.carried, one.alpha)), 255 * one.flat(one.error)
        called = bound <= GOOD
        pixels += error.size
        below += int((error <= bound).sum())
        good += int(called.sum())
        right += int((called & (error <= GOOD)).sum())
        areas.append((_ause(bound, error), _ause(-one.flat(one.seen), error)))
    ause, by_photos = np.mean(areas, axis=0).tolist()
    return Measured(len(held), below / pixels, good / pixels, right / max(good, 1), ause, by_photos)


@dataclass(frozen=True)
class Predicted:
    """The PSNR of photos that nobody has taken: of each camera, and of all of them with its interval, dB."""

    each: list[float]
    mean: float
    half_width: float  # of CONFIDENCE
    photos: int  # held-out ones that this goes by

    def __str__(self) -> str:
        return (
            f"{self.mean:.1f} ± {self.half_width:.1f} dB ({CONFIDENCE:.0%} interval, by {self.photos} "
            f"held-out photo{'s' * (self.photos > 1)}); least {min(self.each):.1f} dB"
        )


def predict_psnr(trust: Trust, cameras: Sequence[Camera], taken: Sequence[Camera]) -> Predicted | None:
    """PSNR against photos that these cameras would take: of a few of them, evenly chosen.

    A regression of the held-out photos' PSNR on what the pixels' trust says of it, with priors for its slope
    and scatter (normal, inverse gamma), and Student's predictive interval of a mean. From where photos were
    trained on (`taken`) a scene shows more: what it shows of some of those more than the regression says is
    added there, and less the farther a camera stands off, none where held-out ones do. Cameras that go past
    many photos average over as many held-out photos' scatter as the held-out ones' share of all photos makes
    of those; others are taken for one photo. None without a held-out photo.
    """
    if not trust.held or not cameras:
        return None
    from scipy.special import stdtrit  # here: the command line waits for no scipy

    (psnr, said), (own, own_said) = (
        np.array([[one.psnr, said_of(one.flat(one.carried), one.flat(one.alpha))] for one in of])
        .reshape(-1, 2)
        .T
        for of in (trust.held, trust.trained)
    )
    chosen = [cameras[k] for k in evenly(len(cameras), PATH_LOOKS)]
    raw = trust.errors / max(trust.factor, 1e-6)
    of_path = np.array([said_of(*trust.shown(shrunk_camera(camera, TRUST_SIDE), raw)) for camera in chosen])
    count, away = len(psnr), said - said.mean()
    weight = float(np.square(away).sum()) + SLOPE_WEIGHT
    slope = (SLOPE_WEIGHT + float(away @ psnr)) / weight
    left = psnr - psnr.mean() - slope * away
    squares = float(np.square(left).sum()) + SLOPE_WEIGHT * (slope - 1) ** 2
    freedom = SPREAD_PHOTOS + count - 1
    variance = (SPREAD_PHOTOS * SPREAD**2 + squares) / freedom
    each = psnr.mean() + slope * (of_path - said.mean())
    if len(own) and taken:
        more = max(float((own - psnr.mean() - slope * (own_said - said.mean())).mean()), 0.0)
        usual = np.quantile(_away([one.camera for one in trust.held], taken), HELD_AWAY)
        each = each + more * (1 - (_away(chosen, taken) / max(float(usual), 1e-12)).clip(0, 1))
    off = float(of_path.mean() - said.mean())
    averaged = max(1.0, _passed(cameras, taken) * count / (count + len(taken)))
    spread = math.sqrt(variance * (1 / averaged + 1 / count + off**2 / weight))
    half = float(stdtrit(freedom, (1 + CONFIDENCE) / 2)) * spread
    return Predicted(each.tolist(), float(each.mean()), half, count)


def _away(cameras: Sequence[Camera], taken: Sequence[Camera]) -> NDArray[np.float64]:
    """How far each camera is from the nearest of the others, world units."""
    return _apart(cameras, taken).min(1)


def _apart(cameras: Sequence[Camera], taken: Sequence[Camera]) -> NDArray[np.float64]:
    """Distance of each camera from each of the others, world units."""
    centers, others = (np.stack([camera.center for camera in some]) for some in (cameras, taken))
    return np.linalg.norm(centers[:, None] - others[None], axis=2)


def said_of(carried: Array, alpha: Array) -> float:
    """What a picture's pixels say of its PSNR, dB: in steps of it, not where it begins."""
    known = (carried + EMPTY * (1 - alpha)).astype(np.float64)
    return -10 * math.log10(max(float(np.square(known).mean()), 1e-10))


def _passed(cameras: Sequence[Camera], taken: Sequence[Camera]) -> int:
    """How many of the photos are nearest to one of the cameras."""
    return len(set(_apart(cameras, taken).argmin(1).tolist())) if taken else 0


def _ause(doubt: Array, error: Array) -> float:
    """Area under the mean error of the pixels least in doubt, over all shares of them, less that of those
    with the least error, over the mean of all."""

    def curve(key: Array) -> NDArray[np.float64]:
        sums = error[np.argsort(key, kind="stable")].cumsum(dtype=np.float64)
        ends = np.linspace(0, len(error), 50 + 1)[1:].astype(int).clip(1)
        return sums[ends - 1] / ends

    return float((curve(doubt) - curve(error)).mean() / max(float(error.mean()), 1e-9))
