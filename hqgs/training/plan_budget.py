"""How many Gaussians photos can determine, and from how many a run starts."""

from __future__ import annotations

import math

from hqgs.photos.formula import FILM, Degradation
from hqgs.training.config import DensifyConfig, TrainConfig
from hqgs.training.constants import (
    DETERMINED,
    FEW_STEPS,
    FILM_NOISE,
    NOISE_HALVING,
    PIXELS,
    POINTS_AGREED,
    TIMES_OWN_POINTS,
)
from hqgs.training.plan import Facts


def first_points_wanted(facts: Facts, settings: TrainConfig) -> int:
    """How many points photos without a fault call for.

    More than the scene's own always: those lie at corners alone, and a run from points all over the photos
    costs less. Twice as many where few steps are to come, in which little grows, and the photos agree.
    """
    timed = settings.seconds is not None or settings.timed  # a repeat starts as what it repeats
    few = not timed and settings.iterations < FEW_STEPS * facts.photos
    times = 2 if few and (facts.agreed or 0) >= POINTS_AGREED else 1
    most = min(times * settings.start_points, settings.densify.max_gaussians)
    return min(most, max(times * facts.pixels // PIXELS, int(TIMES_OWN_POINTS * facts.points)))


def no_growth(growth: DensifyConfig) -> dict[str, int]:
    """The fields of a schedule by which nothing grows, and nothing is removed."""
    return {"start": growth.stop, "reset_every": max(1, growth.stop)}


def gaussians_determined(facts: Facts, formation: Degradation, per_pixel: float) -> int:
    """How many Gaussians degraded photos can determine.

    - The less the photos tell, the fewer: a share of the pixels. Blur makes a pixel count less, and a photo
      tells no more than the coefficients that its codec kept (JPEG without noise). More Gaussians paint the
      ringing of deblurring.
    - Noise: at most a multiple of E^(1/3), where E counts a pixel less for its noise. With M anisotropic
      atoms the error of a picture with edges falls as M^-2 (Candes and Donoho 2004), and that by the noise
      grows as M / E: their sum is least at an M that goes with E^(1/3).
    """
    told = sharp_pixels(facts, formation)
    if _codec_alone(facts, formation):
        told = min(told, float(facts.kept or 0))
    most = per_pixel * told
    if noise := noise_of(formation):
        most = min(most, DETERMINED * sharp_pixels(facts, formation, noise) ** (1 / 3))
    return int(most)


def kept_gradient(facts: Facts, formation: Degradation, threshold: float) -> float:
    """The gradient that growth asks for, `threshold` but for JPEG without noise.

    There it asks for less, since within the cells there is none. A share k of coefficients outside their
    cells, of any sign, adds up to sqrt(k) of the gradient of all; the share that the codec kept stands for
    it.
    """
    if not _codec_alone(facts, formation):
        return threshold
    pixels = sum(height * width for height, width in facts.sizes)
    return min(threshold, DensifyConfig.grad_threshold * math.sqrt(min((facts.kept or 0) / pixels, 1.0)))


def sharp_pixels(facts: Facts, formation: Degradation, noise: float = 0.0) -> float:
    """How many sharp pixels without noise would tell as much as the photos do, roughly."""
    return sum(_sharp_pixels(height, width, formation, noise) for height, width in facts.sizes)


def noise_of(formation: Degradation) -> float:
    """Standard deviation of the photos' noise, where 1 is white; of a coarse film what its codec left."""
    if {step.kind for step in formation.steps} == FILM:
        return FILM_NOISE / 255
    return next((step.value or 0.0 for step in formation.steps if step.kind == "noise"), 0.0) / 255


def _codec_alone(facts: Facts, formation: Degradation) -> bool:
    kinds = {step.kind for step in formation.steps}
    return facts.kept is not None and "jpeg" in kinds and "noise" not in kinds


def _sharp_pixels(height: int, width: int, formation: Degradation, noise: float) -> float:
    """Of one photo, of its size as it was taken.

    A blur of sigma px spreads a point over 4 pi sigma^2 pixels, a disc or a line over its own. Noise (its
    standard deviation, where 1 is white) of s levels asks for the mean of (s / NOISE_HALVING)^2 more pixels
    until it is below what one pixel may be off.
    """
    factor = next((int(step.value or 1) for step in formation.steps if step.kind == "lowres"), 1)
    share = 1.0 + (255 * noise / NOISE_HALVING) ** 2
    for step in formation.for_width(width * factor).steps:
        value_in_photo = (step.value or 0.0) / factor
        if step.kind == "blur":
            share += 4 * math.pi * value_in_photo**2
        elif step.kind == "defocus":
            share += math.pi * value_in_photo**2
        elif step.kind == "motion":
            share += value_in_photo
    return height * width / share
