"""How many Gaussians degraded photos can determine, and where to start them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hqgs.base.left_out import LeftOut
from hqgs.base.stages import OnStage, untold
from hqgs.model.consistency import Agreement
from hqgs.model.first_points import Colors, Points, points_along_edges
from hqgs.scene.scene import Scene
from hqgs.training.config import DensifyConfig
from hqgs.training.methods.formed import Formation, FormedTarget

PIXELS = 100  # of the photos, for each point to start from where they are as photographed
BESIDE = 1.5  # times the scene's own points, at least
HALVING = 6.0  # levels of noise at which two pixels tell what one does without noise
DETERMINED = 600.0  # Gaussians under noise, times the cube root of the pixels' worth of photos


def with_budget(
    densify: DensifyConfig,
    formation: Formation,
    targets: Sequence[FormedTarget],
    gaussians_per_pixel: float,
    least: int,
) -> DensifyConfig:
    """Growth that ends at what the photos can determine, but not below `least`; without resets.

    - The less the photos tell, the fewer Gaussians they determine: growth ends at a share of the pixels.
      Blur makes a pixel count less, and a photo tells no more than the coefficients that its codec kept. More
      Gaussians paint the ringing of deblurring.
    - Noise: growth ends at a multiple of E^(1/3), where E counts a pixel less for its noise. With M
      anisotropic atoms the error of a picture with edges falls as M^-2 (Candes and Donoho 2004), and that by
      the noise grows as M / E: their sum is least at an M that goes with E^(1/3).
    - JPEG without noise: growth asks for less gradient, since within the cells there is none. A share k of
      coefficients outside their cells, of any sign, adds up to sqrt(k) of the gradient of all; the share that
      the codec kept stands for it.
    - No resets of the opacities: with growth at its budget, what a reset takes away seldom comes back where
      it was.
    """
    threshold = densify.grad_threshold
    told = sum(_sharp_pixels(formation, target) for target in targets)
    if "jpeg" in formation.kinds and "noise" not in formation.kinds:
        kept = sum(target.kept for target in targets)
        pixels = sum(target.photo[..., 0].numel() for target in targets)
        threshold = min(threshold, DensifyConfig.grad_threshold * math.sqrt(min(kept / pixels, 1.0)))
        told = min(told, kept)
    most = gaussians_per_pixel * told
    if formation.noise:
        told = sum(_sharp_pixels(formation, target, formation.noise) for target in targets)
        most = min(most, DETERMINED * told ** (1 / 3))
    return replace(
        densify,
        max_gaussians=min(densify.max_gaussians, max(int(most), least)),
        grad_threshold=threshold,
        reset_every=max(densify.reset_every, densify.stop),
    )


def start_points(scene: Scene, most: int) -> int:
    """How many points photos without a fault call for, `most` at most.

    More than the scene's own always: those lie at corners alone, and a run from points all over the photos
    costs less.
    """
    pixels = sum(view.camera.width * view.camera.height for view in scene.train)
    return min(most, max(pixels // PIXELS, int(BESIDE * len(scene.points))))


def first_points(
    scene: Scene, wanted: int, seed: int, told: OnStage = untold
) -> tuple[Points, Colors, list[LeftOut]]:
    """The scene's points and more along the photos' edges that other photos agree with, at most `wanted` in
    all; and why there are no more. `told` hears of each photo."""
    what, points, colors = "first points along edges", scene.points, scene.point_colors
    if not wanted:
        return points, colors, []
    if scene.seen is None:
        why = "the scene does not tell which photos see which of its points"
        return points, colors, [LeftOut(what, why)]
    if len(points) >= wanted:
        why = f"it has {len(points)} points for {wanted} that are called for"
        return points, colors, [LeftOut(what, why)]
    agreement = Agreement(scene.train, scene.seen)
    more = points_along_edges(scene.train, points, scene.seen, wanted - len(points), seed, agreement, told)
    return np.concatenate([points, more[0]]), np.concatenate([colors, more[1]]), []


def _sharp_pixels(formation: Formation, target: FormedTarget, noise: float = 0.0) -> float:
    """How many sharp pixels without noise would tell as much as this photo does, roughly.

    A blur of sigma px spreads a point over 4 pi sigma^2 pixels, a disc or a line over its own. Noise (its
    standard deviation, where 1 is white) of s levels asks for the mean of (s / HALVING)^2 more pixels
    until it is below what one pixel may be off.
    """
    height, width = target.photo.shape[:2]
    share = 1.0 + (255 * noise / HALVING) ** 2
    for step in formation.degradation.for_width(width * formation.factor).steps:
        value_in_photo = (step.value or 0.0) / formation.factor
        if step.kind == "blur":
            share += 4 * math.pi * value_in_photo**2
        elif step.kind == "defocus":
            share += math.pi * value_in_photo**2
        elif step.kind == "motion":
            share += value_in_photo
    return height * width / share
