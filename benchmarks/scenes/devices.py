"""Cameras of different makes that photograph the room: lenses that darken corners, responses of their own."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hqgs.scene.scene import Camera

Floats = NDArray[np.float64]

DARKEST = 0.1, 0.45  # of the corners: between them 1 / (1 + c)^2, of a lens that looks out at a steep angle
GAMMAS, CONTRAST = 0.18, 0.35  # either way: of the log exponents, and of the share of a curve in S


class Device(NamedTuple):
    """What a camera does to all its photos."""

    name: str
    corner: float  # c, of the natural darkening 1 / (1 + c r^2)^2, where r is 1 in the corner
    gammas: Floats  # [3], exponents of red, green and blue
    contrast: Floats  # [3], the share of 3 v^2 - 2 v^3, of each

    def shade(self, camera: Camera) -> Floats:
        """What arrives of the light at each pixel, [H, W]."""
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        square = np.square(x - camera.K[0, 2]) + np.square(y - camera.K[1, 2])
        return (1 + self.corner * square / (camera.width**2 + camera.height**2) * 4) ** -2

    def respond(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Values [..., 3] of 0..1 as this camera writes them; each channel rises, black and white stay."""
        v = np.power(values, self.gammas.astype(np.float32)).astype(np.float32)
        bent = v + self.contrast.astype(np.float32) * (v * v * (3 - 2 * v) - v)
        return np.clip(bent, 0, 1).astype(np.float32, copy=False)

    def record(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "name": self.name,
            "corner": self.corner,
            "gammas": self.gammas.tolist(),
            "contrast": self.contrast.tolist(),
        }


def draw_devices(rng: np.random.Generator, photos: int, devices: int) -> list[Device]:
    """The device of each photo: as many photos each, within one.

    The mean over photos of the log exponents and of the contrasts is 0, as no photo can tell it.
    """
    of_photo = rng.permutation(np.arange(photos) % devices)
    gammas = rng.uniform(-GAMMAS, GAMMAS, (devices, 3))
    contrast = rng.uniform(-CONTRAST, CONTRAST, (devices, 3))
    corners = rng.uniform(*DARKEST, devices)
    gammas, contrast = gammas - gammas[of_photo].mean(0), contrast - contrast[of_photo].mean(0)
    made = [
        Device(f"camera {k + 1}", float(corners[k]), np.exp(gammas[k]), contrast[k]) for k in range(devices)
    ]
    return [made[k] for k in of_photo]
