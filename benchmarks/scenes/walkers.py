"""People who walk through photos: figures of limbs, and how they come into a photo."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hqgs.photos.pixels import Float32

SKIN = ("#f1c9a5", "#d9a066", "#8d5a3b", "#5c3a28")
HAIR = ("#20160f", "#4a2f1b", "#a8743c", "#8e8e90", "#e8e4dc")
CLOTHES = ("#1f2a44", "#7a1f2b", "#2f5d3a", "#c9b458", "#d8d8dc", "#3a3a3d", "#b5532a", "#5a7fa8", "#e0a4b0")
STRIDE = (0.03, 0.17)  # from which to which share of the height the feet are off the middle
HEIGHTS = (0.35, 0.9)  # shares of the photo's height, of the smallest and the tallest
GROUND = (0.6, 0.5)  # where feet are: share of the photo's height, and what the walker's own adds to it
DARKEST = 0.55  # light at a limb's edge: they are round
STRIPES = 60.0  # radians of the pattern over the whole height


class Limb(NamedTuple):
    """A rounded segment, in a plane through the feet's middle; the figure is 1 high and y points down."""

    a: tuple[float, float]
    b: tuple[float, float]
    radius: float
    colour: str
    striped: bool = False


class Figure(NamedTuple):
    """Who walks there."""

    stride: float  # share of the height that a foot is off the middle; negative: the other leg is in front
    skin: str
    hair: str
    top: str
    bottom: str
    striped: bool  # the top

    def limbs(self) -> list[Limb]:
        """From the farthest to the nearest."""
        s = self.stride
        return [
            Limb((0.0, -0.79), (0.8 * s, -0.50), 0.036, self.top),
            Limb((0.0, -0.50), (-s, -0.05), 0.050, self.bottom),
            Limb((0.0, -0.50), (s, -0.05), 0.052, self.bottom),
            Limb((0.0, -0.76), (0.0, -0.56), 0.105, self.top, self.striped),
            Limb((0.0, -0.925), (0.0, -0.955), 0.058, self.hair),
            Limb((0.012, -0.89), (0.012, -0.93), 0.052, self.skin),
            Limb((0.0, -0.79), (-0.8 * s, -0.50), 0.038, self.top),
        ]


def draw_figure(rng: np.random.Generator) -> Figure:
    """Each part uniform in what there is."""
    stride = rng.uniform(*STRIDE) * rng.choice([-1, 1])
    skin, hair = (palette[rng.integers(len(palette))] for palette in (SKIN, HAIR))
    top, bottom = (CLOTHES[k] for k in rng.choice(len(CLOTHES), 2, replace=False))
    return Figure(stride, skin, hair, top, bottom, bool(rng.integers(2)))


def walk_in(image: Float32, most: int, rng: np.random.Generator) -> tuple[Float32, list[dict[str, Any]]]:
    """The photo [H, W, 3] with 0 to `most` walkers in front of it, and each of them as JSON values.

    Their number is uniform; "x", "foot" and "height" are shares of the photo's sides. No pixel changes but
    those that a walker covers.
    """
    walkers = []
    for _ in range(int(rng.integers(most + 1))):
        height = rng.uniform(*HEIGHTS)
        place = {"x": rng.uniform(0, 1), "foot": GROUND[0] + GROUND[1] * height, "height": height}
        figure = draw_figure(rng)
        image = _painted(image, figure, **place)
        walkers.append(place | figure._asdict())
    return image, walkers


def _painted(image: Float32, figure: Figure, x: float, foot: float, height: float) -> Float32:
    rows, cols = image.shape[:2]
    scale, image = height * rows, image.copy()
    v, u = np.mgrid[:rows, :cols].astype(np.float64) + 0.5
    u, v = (u - x * cols) / scale, (v - foot * rows) / scale  # in units of the figure's height
    for limb in figure.limbs():
        (ax, ay), (bx, by) = limb.a, limb.b
        dx, dy = bx - ax, by - ay
        t = np.clip(((u - ax) * dx + (v - ay) * dy) / (dx * dx + dy * dy), 0, 1)
        distance = np.hypot(u - ax - t * dx, v - ay - t * dy)
        cover = np.clip((limb.radius - distance) * scale + 0.5, 0, 1)[..., None]
        light = DARKEST + (1 - DARKEST) * np.sqrt(np.clip(1 - (distance / limb.radius) ** 2, 0, 1))
        if limb.striped:
            light *= 0.8 + 0.2 * np.sin(STRIPES * v)
        paint = rgb(limb.colour) * light[..., None]
        image = np.where(cover > 0, cover * paint + (1 - cover) * image, image).astype(np.float32)
    return image


def rgb(colour: str) -> NDArray[np.float64]:
    """`#rrggbb` as values of 0..1, [3]."""
    return np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
