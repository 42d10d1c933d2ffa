"""A plain renderer in float64 that can be as wrong as viewers are: numpy, one Gaussian after the other.

As it is by default it follows docs/conventions.md and agrees with the rasterizer, without a line of its code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hqgs._rust import ALPHA_MAX, ALPHA_MIN, EPS2D, NEAR_PLANE, TRANSMITTANCE_MIN
from hqgs.model.constants import SH_C0
from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.turned import basis, matrices
from hqgs.photos.light import to_linear, to_srgb
from hqgs.scene.scene import Camera

Floats = NDArray[np.float64]

JACOBIAN_CLAMP = 0.3  # of half the picture, beyond its border (docs/conventions.md)


@dataclass(frozen=True)
class Ways:
    """How a viewer renders; the defaults are right."""

    eps2d: float = EPS2D  # px^2, of the low-pass
    antialiased: bool | None = None  # opacities compensated for it; None: as the file says
    sh_degree: int = 3  # at most
    brightest: float = np.inf  # to which the colour of a Gaussian is clamped
    directions: tuple[float, float, float] = (1.0, 1.0, 1.0)  # signs of the harmonics' axes
    linear: bool = False  # blended in linear light
    bits: Literal["", "front", "back"] = ""  # 8 bits after each Gaussian, from the front or from the back
    order: Literal["depth", "reversed", "file", "distance"] = "depth"
    far: float = np.inf  # depth beyond which nothing is shown
    positions: Callable[[Floats], Floats] | None = None  # what becomes of the means [N, 3]
    zoom: float = 1.0  # focal lengths of the viewer's camera to those that were asked for
    picture: tuple[int, int] = (1, 1)  # -1: rows, columns the other way round


@dataclass(frozen=True)
class Splats:
    """Gaussians in a picture, in the order in which they are blended."""

    means: Floats  # [V, 2] px
    conics: Floats  # [V, 3]
    reach: Floats  # [V, 2] px, beyond which alpha is below the floor
    opacities: Floats  # [V]
    colors: Floats  # [V, 3], not below 0


def render(scene: Arrays, camera: Camera, ways: Ways = Ways()) -> Floats:
    """The picture [H, W, 3] on black, clamped to [0, 1]."""
    splats = project(scene, camera, ways)
    image = _blended_in_bits(splats, camera, ways) if ways.bits else _blended(splats, camera, ways.linear)
    return image[:: ways.picture[0], :: ways.picture[1]]


def project(scene: Arrays, camera: Camera, ways: Ways) -> Splats:
    """EWA projection, harmonics and order."""
    means = scene["means"].astype(np.float64)
    if ways.positions is not None:
        means = ways.positions(means)
    R, width, height = camera.viewmat[:3, :3], camera.width, camera.height
    K = camera.K * np.array([[ways.zoom, 1, 1], [1, ways.zoom, 1], [1, 1, 1]])
    x, y, z = (means @ R.T + camera.viewmat[:3, 3]).T
    seen = (z >= NEAR_PLANE) & (z <= ways.far)
    means, x, y, z = means[seen], x[seen], y[seen], z[seen]
    ratios = []
    for ratio, focal, middle, side in ((x / z, K[0, 0], K[0, 2], width), (y / z, K[1, 1], K[1, 2], height)):
        over = JACOBIAN_CLAMP * side / (2 * focal)
        ratios.append(np.clip(ratio, -(middle / focal + over), (side - middle) / focal + over))
    zero = np.zeros_like(z)
    J = np.stack(
        [
            np.stack([K[0, 0] / z, zero, -K[0, 0] * ratios[0] / z], -1),
            np.stack([zero, K[1, 1] / z, -K[1, 1] * ratios[1] / z], -1),
        ],
        -2,
    )
    axes = matrices(scene["quats"][seen].astype(np.float64)) * np.exp(
        scene["scales"][seen].astype(np.float64)[:, None]
    )
    A = J @ (R @ axes)
    (xx, xy), (_, yy) = np.moveaxis(A @ A.swapaxes(1, 2), 0, -1)
    plain = np.square(np.cross(A[:, 0], A[:, 1])).sum(-1)
    det = plain + ways.eps2d * (xx + yy) + ways.eps2d**2
    opacities = 1 / (1 + np.exp(-scene["opacities"][seen].astype(np.float64)))
    compensated = scene.get("antialiased", False) if ways.antialiased is None else ways.antialiased
    if compensated:
        opacities = opacities * np.sqrt(plain / det)
    with np.errstate(divide="ignore", invalid="ignore"):
        conics = np.stack([yy + ways.eps2d, -xy, xx + ways.eps2d], -1) / det[:, None]
        sigmas = np.sqrt(2 * np.log(opacities / ALPHA_MIN))
    reach = sigmas[:, None] * np.sqrt(np.stack([xx, yy], -1) + ways.eps2d)
    pixels = np.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], -1)
    shown = (opacities >= ALPHA_MIN) & np.isfinite(conics).all(1)
    shown &= ((pixels + reach > 0) & (pixels - reach < (width, height))).all(1)
    away = np.linalg.norm(means - camera.center, axis=1)
    keys = {"depth": z, "reversed": -z, "file": zero, "distance": away}
    order = np.flatnonzero(shown)
    order = order[np.argsort(keys[ways.order][order], kind="stable")]
    colors = _colors(scene["sh0"][seen][order], scene["shN"][seen][order], means[order], camera, ways)
    return Splats(pixels[order], conics[order], reach[order], opacities[order], colors)


def _colors(
    sh0: NDArray[np.floating], rest: NDArray[np.floating], means: Floats, camera: Camera, ways: Ways
) -> Floats:
    colors = 0.5 + SH_C0 * sh0[:, 0].astype(np.float64)
    terms = min((ways.sh_degree + 1) ** 2 - 1, rest.shape[1])
    if terms:
        offsets = (means - camera.center) * ways.directions
        found = basis(offsets / np.linalg.norm(offsets, axis=1, keepdims=True))[:, :terms]
        colors = colors + np.einsum("nk,nkc->nc", found, rest[:, :terms].astype(np.float64))
    return np.clip(colors, 0, ways.brightest)


def _alphas(splats: Splats, k: int, camera: Camera) -> tuple[tuple[slice, slice], Floats]:
    """The pixels that a Gaussian may reach, and its alphas there."""
    low = np.maximum(np.floor(splats.means[k] - splats.reach[k]), 0).astype(int)
    high = np.minimum(np.ceil(splats.means[k] + splats.reach[k]), (camera.width, camera.height)).astype(int)
    dx = np.arange(low[0], high[0]) + 0.5 - splats.means[k, 0]
    dy = (np.arange(low[1], high[1]) + 0.5 - splats.means[k, 1])[:, None]
    a, b, c = splats.conics[k]
    alpha = splats.opacities[k] * np.exp(-0.5 * (a * dx**2 + c * dy**2) - b * dx * dy)
    alpha = np.minimum(alpha, ALPHA_MAX)
    return (slice(low[1], high[1]), slice(low[0], high[0])), np.where(alpha >= ALPHA_MIN, alpha, 0.0)


def _blended(splats: Splats, camera: Camera, linear: bool) -> Floats:
    """Front to back; a pixel stops where little light is left."""
    image = np.zeros((camera.height, camera.width, 3))
    left, going = np.ones(image.shape[:2]), np.ones(image.shape[:2], bool)
    colors = to_linear(splats.colors) if linear else splats.colors
    for k in range(len(colors)):
        box, alpha = _alphas(splats, k, camera)
        after = left[box] * (1 - alpha)
        going[box] &= (alpha == 0) | (after > TRANSMITTANCE_MIN)
        weight = np.where(going[box], left[box] * alpha, 0.0)
        image[box] += weight[..., None] * colors[k]
        left[box] -= weight
    return np.clip(to_srgb(image) if linear else image, 0, 1)


def _blended_in_bits(splats: Splats, camera: Camera, ways: Ways) -> Floats:
    """Into a framebuffer of 8 bits, which rounds and clamps after each Gaussian."""
    image, left = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width, 1))
    front = ways.bits == "front"
    for k in range(len(splats.colors)) if front else reversed(range(len(splats.colors))):
        box, alpha = _alphas(splats, k, camera)
        alpha = alpha[..., None]
        if front:
            image[box] = _rounded(image[box] + left[box] * alpha * splats.colors[k])
            left[box] = _rounded(left[box] * (1 - alpha))
        else:
            image[box] = _rounded(image[box] * (1 - alpha) + alpha * splats.colors[k])
    return image


def _rounded(values: Floats) -> Floats:
    return np.rint(np.clip(values, 0, 1) * 255) / 255
