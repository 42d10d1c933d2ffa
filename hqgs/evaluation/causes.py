"""Where in a photo a render is wrong, and what it comes from: parts of its squared error that add up to it.

Each part is what is left after those before it: colour (what a factor for each channel sets right), pose
(what fitting the camera sets right), then the pixels at the edge of the capture, those behind fog, and of the
rest the fine detail, less the photo's own noise, and broad errors of shape and shading. Without fitted
cameras a wrong pose counts as detail. It is a sorting, not a proof: fog before a wrong surface counts as fog.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from hqgs.base.evenly import evenly
from hqgs.diagnosis.photo import estimate_noise
from hqgs.evaluation.constants import FINE, FOG, MOST_CAMERAS, PATCH
from hqgs.evaluation.held_out import RenderedView
from hqgs.evaluation.metrics import color_factors
from hqgs.model.gaussians import Gaussians
from hqgs.photos.pixels import as_floats, to_levels
from hqgs.scene.constants import ENOUGH_SHOW
from hqgs.scene.geometry import in_frame, project, within
from hqgs.scene.scene import Camera, View

Floats = NDArray[np.float64]

PARTS = ("color", "pose", "edge", "fog", "noise", "detail", "broad")


Causes = dict[str, Any]  # of a photo, as `causes` tells it


def shown_by(gaussians: Gaussians, cameras: Sequence[Camera]) -> torch.Tensor:
    """How many of the cameras have each Gaussian's centre in view, [N], by MOST_CAMERAS of them at most."""
    means = gaussians.means.detach().double().numpy()
    counts = np.zeros(len(means), np.float32)
    asked = evenly(len(cameras), MOST_CAMERAS)
    for k in asked:
        counts += in_frame(cameras[k], means)
    return torch.from_numpy(counts * np.float32(len(cameras) / max(len(asked), 1)))


@torch.no_grad()
def pixel_maps(gaussians: Gaussians, camera: Camera, shown: torch.Tensor) -> tuple[Floats, Floats]:
    """Of a camera's pixels, [H, W]: the share of the colour that comes from before the surface, and the
    training photos that show what is seen, weighted as it is blended. `shown` [N]: of `shown_by`."""
    depths, alphas, _ = gaussians.rasterize(camera, gaussians.sh0[:, 0], render_mode="ED")
    pixels, z = project(camera, gaussians.means.double().numpy())
    inside = within(camera, pixels, z)
    column, row = pixels[inside].astype(int).T
    before = torch.zeros(len(gaussians))
    before[torch.from_numpy(inside)] = torch.from_numpy(z[inside]).float() / depths[0, row, column, 0]
    hangs = torch.from_numpy(inside) & (before < 0.75)  # of its pixel's depth: before the surface
    channels = torch.stack([hangs.float(), shown], 1).to(gaussians.means.dtype)
    found, solid = gaussians.rasterize(camera, channels)[0][0], alphas[0, ..., 0].clamp(min=1e-6)
    return found[..., 0].double().numpy(), (found[..., 1] / solid).double().numpy()


def causes(
    seen: RenderedView, maps: tuple[Floats, Floats], noise: float, fitted: RenderedView | None = None
) -> Causes:
    """Of one photo, as JSON values: `mse`, its mean squared error (white is 1); the parts of it, in the order
    of PARTS; and `levels`, the root mean square error of each patch of PATCH px (None: masked).

    `maps`: of `pixel_maps`; `noise`: the photo's own, its deviation, white is 1; `fitted`: with its camera
    fitted.
    """
    hanging, photos = maps
    photo = as_floats(seen.photo).astype(np.float64)
    counted = np.ones(photo.shape[:2], bool) if seen.mask is None else seen.mask
    first = seen.render.clip(0, 1) - photo
    aligned = _aligned(seen, photo)
    mse, after = (float(np.square(off)[counted].mean()) for off in (first, aligned))
    off, pose = aligned, 0.0
    if fitted is not None:
        other = _aligned(fitted, photo)
        now = float(np.square(other)[counted].mean())
        if now < after:
            off, pose = other, after - now
    error, fine = np.square(off).mean(-1), np.square(off - _smooth(off)).mean(-1)
    edge = counted & (photos < ENOUGH_SHOW)
    fog = counted & ~edge & (hanging > FOG)
    rest, pixels = counted & ~edge & ~fog, int(counted.sum())
    detail = min(float(fine[rest].sum()), float(error[rest].sum())) / pixels
    own = min(detail, noise**2 * int(rest.sum()) / pixels)
    parts = {
        "color": mse - after,
        "pose": pose,
        "edge": float(error[edge].sum()) / pixels,
        "fog": float(error[fog].sum()) / pixels,
        "noise": own,
        "detail": detail - own,
        "broad": float(error[rest].sum()) / pixels - detail,
    }
    levels = _patches(np.square(first).mean(-1), counted)
    told = [[None if np.isnan(v) else round(float(v), 1) for v in row] for row in levels]
    return {"mse": mse, **parts, "levels": told}


def noise_of(view: View) -> float:
    """Standard deviation of a photo's own noise, white is 1; 0 where texture could be it."""
    found = estimate_noise(to_levels(view.image, f"photo {view.name!r}"))
    return found[0] / 255 if found is not None and found[0] > found[1] else 0.0


def shares(of: Sequence[Causes]) -> dict[str, float]:
    """Each part of the squared error of all photos together; their sum is 1; all 0 without an error."""
    whole = sum(one["mse"] for one in of) or 1.0
    return {part: sum(one[part] for one in of) / whole for part in PARTS}


def _aligned(seen: RenderedView, photo: Floats) -> Floats:
    render = seen.render.clip(0, 1).astype(np.float64)
    return (color_factors(render, photo, seen.mask) * render).clip(0, 1) - photo


def _smooth(image: NDArray[np.floating]) -> Floats:
    return gaussian_filter(image.astype(np.float64), (FINE, FINE, 0), mode="nearest")


def _patches(error: Floats, counted: NDArray[np.bool_]) -> Floats:
    """Root of the mean over each patch of PATCH px, in levels."""
    starts = [np.arange(0, side, PATCH) for side in error.shape]

    def sums(values: Floats) -> Floats:
        return np.add.reduceat(np.add.reduceat(values, starts[0], 0), starts[1], 1)

    with np.errstate(invalid="ignore"):
        return 255 * np.sqrt(sums(np.where(counted, error, 0.0)) / sums(counted.astype(np.float64)))
