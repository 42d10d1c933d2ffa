"""Textures of the embedded scene, made from seeded noise, PIL drawing and PIL's built-in font.

Every texture is an array of linear-light RGB. Colours are written as sRGB hex strings, as a painter would.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from hqgs.photos.light import to_linear

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class Texture:
    """A picture that repeats in u and v; one repeat is the unit square, v points down."""

    rgb: NDArray[np.float32]  # [H, W, 3], linear light
    alpha: NDArray[np.bool_] | None = None  # [H, W], False where the surface is cut away

    def sample(self, u: FloatArray, v: FloatArray) -> NDArray[np.float32]:
        """Bilinear lookup at u, v [n]; returns [n, 3]. Texel centres lie at half-integers."""
        height, width = self.rgb.shape[:2]
        texels = self.rgb.reshape(-1, 3)
        if len(texels) == 1:
            return np.broadcast_to(texels, (len(u), 3))
        x, y = u * width - 0.5, v * height - 0.5
        x0, y0 = np.floor(x), np.floor(y)
        fx, fy = (x - x0)[:, None], (y - y0)[:, None]
        col, row = x0.astype(np.int64) % width, y0.astype(np.int64) % height
        next_col, next_row = (col + 1) % width, (row + 1) % height * width
        row *= width
        top = texels[row + col] * (1 - fx) + texels[row + next_col] * fx
        bottom = texels[next_row + col] * (1 - fx) + texels[next_row + next_col] * fx
        return top * (1 - fy) + bottom * fy

    def opaque(self, u: FloatArray, v: FloatArray) -> NDArray[np.bool_]:
        """Whether the nearest texel at u, v [n] is part of the surface."""
        if self.alpha is None:
            return np.ones(len(u), bool)
        height, width = self.alpha.shape
        row = np.clip((v * height).astype(np.int64), 0, height - 1)
        return self.alpha[row, np.clip((u * width).astype(np.int64), 0, width - 1)]


def colour(name: str) -> NDArray[np.float32]:
    """A hex colour such as "#c0603a" as linear RGB, [3]."""
    return to_linear(np.array(ImageColor.getrgb(name)[:3], np.float64) / 255).astype(np.float32)


def noise(height: int, width: int, cells: tuple[int, int], seed: int, octaves: int = 4) -> FloatArray:
    """Periodic value noise in [0, 1], [height, width]; `cells` = lattice cells (down, across) of octave 0."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for octave in range(octaves):
        rows, cols = cells[0] << octave, cells[1] << octave
        lattice = rng.random((rows, cols))
        y, x = (np.arange(height) + 0.5) / height * rows, (np.arange(width) + 0.5) / width * cols
        i, j = y.astype(np.int64), x.astype(np.int64)
        fy, fx = (y - i)[:, None], x - j
        fy, fx = fy * fy * (3 - 2 * fy), fx * fx * (3 - 2 * fx)
        i, j = i % rows, j % cols
        along = lattice[:, j] * (1 - fx) + lattice[:, (j + 1) % cols] * fx
        total += 0.5**octave * (along[i] * (1 - fy) + along[(i + 1) % rows] * fy)
    return total / (2 - 0.5 ** (octaves - 1))


def mix(a: FloatArray, b: FloatArray, weight: FloatArray) -> NDArray[np.float32]:
    """Blend colours a and b ([3] or [H, W, 3]) with weight [H, W], clipped to [0, 1]."""
    w = np.clip(weight, 0, 1)[..., None]
    return (a * (1 - w) + b * w).astype(np.float32)


def plain(name: str) -> Texture:
    return Texture(colour(name).reshape(1, 1, 3))


def plaster(name: str, seed: int, contrast: float = 0.10) -> Texture:
    """A painted wall: almost flat, with faint clouds."""
    shade = 1 + contrast * (noise(256, 256, (3, 3), seed, 5) - 0.5)
    return Texture((colour(name) * shade[..., None]).astype(np.float32))


def wood(light: str, dark: str, seed: int, boards: int = 4) -> Texture:
    """Boards that run along u, each cut from another place of the trunk."""
    height, width = 384, 768
    row = (np.arange(height) + 0.5) / height * boards
    board = row.astype(np.int64)
    rng = np.random.default_rng(seed + 2)
    tone, shift = rng.random(boards)[board][:, None], rng.integers(0, width, boards)[board]
    column = (np.arange(width) + shift[:, None]) % width
    rows = np.arange(height)[:, None]
    grain = noise(height, width, (64, 4), seed, 3)[rows, column]
    bend = noise(height, width, (7, 2), seed + 1, 4)[rows, column]
    ring = (9 * bend + 2.5 * (row % 1)[:, None]) % 1  # late wood darkens slowly and ends sharply
    ring = np.where(ring < 0.8, ring / 0.8, (1 - ring) / 0.2)
    rgb = mix(colour(light), colour(dark), 0.45 * ring**2 + 1.0 * (grain - 0.45) + 0.3 * tone)
    gap = np.minimum(row % 1, 1 - row % 1)[:, None] * np.ones(width)
    return Texture(mix(rgb * 0.25, rgb, gap / 0.03))


def bricks(seed: int, rows: int = 30, cols: int = 18) -> Texture:
    """A running-bond brick wall with mortar; `rows` must be even so that the pattern repeats."""
    height, width = 900, 1152
    y = np.repeat(((np.arange(height) + 0.5) / height * rows)[:, None], width, 1)
    x = (np.arange(width) + 0.5) / width * cols + 0.5 * (y.astype(np.int64) % 2)
    rng = np.random.default_rng(seed)
    tone = rng.random((rows, cols))[y.astype(np.int64), x.astype(np.int64) % cols]
    edge = np.minimum(np.minimum(x % 1, 1 - x % 1) * 2.1, np.minimum(y % 1, 1 - y % 1))
    edge = edge + 0.08 * (noise(height, width, (60, 60), seed + 1, 2) - 0.5)
    grit = noise(height, width, (90, 110), seed + 2, 2)
    face = mix(colour("#b5593c"), colour("#7d3a2c"), tone) * (0.70 + 0.6 * grit[..., None])
    face = mix(face, colour("#d08a5e") * (0.75 + 0.5 * grit[..., None]), (tone > 0.86) * 0.8)
    mortar = colour("#b3a797") * (0.75 + 0.4 * grit[..., None])
    return Texture(mix(mortar, face, (edge - 0.07) / 0.05))


def tiles(first: str, second: str, seed: int) -> Texture:
    """A floor of 2 x 2 square tiles, veined and jointed."""
    size = 512
    cell = (np.arange(size) + 0.5) / size * 2
    odd = (cell.astype(np.int64)[:, None] + cell.astype(np.int64)) % 2
    cloud = noise(size, size, (4, 4), seed, 4)
    vein = 1 - np.clip(np.abs(cloud - 0.5) / 0.05, 0, 1)
    rgb = mix(colour(first), colour(second), odd.astype(np.float64))
    rgb = rgb * (0.8 + 0.4 * cloud[..., None]) + 0.06 * vein[..., None].astype(np.float32)
    edge = np.minimum(cell % 1, 1 - cell % 1)
    return Texture(mix(colour("#4a4640"), rgb, np.minimum(edge[:, None], edge) / 0.02 - 0.5))


def marble(light: str, dark: str, seed: int) -> Texture:
    cloud = noise(256, 512, (3, 6), seed, 5)
    wave = 0.5 + 0.5 * np.sin(2 * np.pi * (2 * np.arange(512) / 512 + 4 * cloud))
    return Texture(mix(colour(light), colour(dark), 0.85 * wave**2))


def checker(first: str, second: str, cells: int) -> Texture:
    size = 32 * cells
    cell = np.arange(size) // 32
    return Texture(mix(colour(first), colour(second), ((cell[:, None] + cell) % 2).astype(np.float64)))


def wallpaper(seed: int) -> Texture:
    """Stripes with rows of diamonds."""
    size = 256
    x = (np.arange(size) + 0.5) / size * 4 % 1
    y = (np.arange(size) + 0.5)[:, None] / size * 4 % 1
    cloud = noise(size, size, (8, 8), seed, 3)
    rgb = mix(colour("#e3d6b4"), colour("#cdb98d"), (np.abs(x - 0.5) < 0.25) * np.ones((size, 1)))
    diamond = 0.16 - np.abs(x - 0.5) - 0.6 * np.abs(y - 0.5)
    rgb = mix(rgb, colour("#8c3b3a"), diamond / 0.02)
    return Texture(rgb * (0.9 + 0.2 * cloud[..., None]).astype(np.float32))


def landscape(seed: int) -> Texture:
    """Sky, clouds, ranges of hills with trees, and a meadow with flowers: the view out of the window."""
    height, width = 640, 1120
    y = np.repeat(np.linspace(0, 1, height)[:, None], width, 1)
    rgb = mix(colour("#3f86d2"), colour("#f6dfb9"), (y / 0.55) ** 1.5)
    cloud = noise(height, width, (9, 7), seed, 6)
    rgb = mix(rgb, colour("#ffffff"), (cloud - 0.52) * 7 * (1 - y / 0.6))
    for k, name in enumerate(("#8fa5c4", "#68889a", "#4d7a55", "#3b6a33", "#86a544")):
        ridge = 0.37 + 0.075 * k + (0.15 - 0.02 * k) * (noise(1, width, (1, 4 + k), seed + k, 6) - 0.5)
        crowns = noise(height, width, (60 - 6 * k, 100 - 10 * k), seed + 9 + k, 3)
        ridge = ridge - (0.006 + 0.006 * min(k, 3)) * crowns[height // 2]  # tree tops
        light = 1 + (0.3 + 0.25 * k) * (crowns[..., None] - 0.5)
        rgb = mix(rgb, colour(name) * light, (y - ridge) * height / 2)
    flowers = noise(height, width, (160, 240), seed + 20, 1) * (y > 0.70)
    return Texture(mix(rgb, colour("#f0d36a"), (flowers - 0.86) * 12))


def painting(seed: int) -> Texture:
    """An abstract picture: seeded discs and bars on a warm ground."""
    size = 320
    rng = np.random.default_rng(seed)
    image = Image.new("RGB", (size, size), "#ecd9a8")
    draw = ImageDraw.Draw(image)
    palette = ("#1f4e79", "#d1495b", "#edae49", "#00798c", "#30343f", "#f4f1de", "#66a182")
    for k in range(26):
        x, y, r = (int(a) for a in (*rng.integers(0, size, 2), rng.integers(12, 62)))
        fill = palette[k % len(palette)]
        if k % 3 == 0:
            draw.line((x, y, size - y, x), fill=fill, width=4 + r // 8)
        else:
            draw.ellipse((x - r, y - r, x + r, y + r), fill=fill)
    cloud = noise(size, size, (20, 20), seed, 3)
    return Texture(_pixels(image) * (0.85 + 0.3 * cloud[..., None]).astype(np.float32))


def leaf(seed: int) -> Texture:
    """A cut-out leaf; stem at v = 1, tip at v = 0."""
    height, width = 384, 160
    v = ((np.arange(height) + 0.5) / height)[:, None]
    u = (np.arange(width) + 0.5) / width * 2 - 1
    outline = 0.95 * np.sin(np.pi * v**0.75) ** 0.8 * (1 - 0.10 * np.cos(2 * np.pi * 13 * v))
    blade = np.abs(u) < outline
    vein = np.clip(1 - np.abs((v + 0.35 * np.abs(u)) * 11 % 1 - 0.5) / 0.12, 0, 1)
    vein = np.maximum(0.6 * vein, np.clip(1 - np.abs(u) / 0.05, 0, 1) * np.ones_like(v))
    cloud = noise(height, width, (8, 4), seed, 4)
    rgb = mix(colour("#2f6b2a"), colour("#7fae3c"), 1.4 * cloud - 0.2)
    return Texture(mix(rgb, colour("#c5d98a"), 0.55 * vein), blade)


def text(
    size: tuple[int, int],
    lines: Sequence[tuple[str, float, float]],
    paper: str,
    ink: str,
    border: bool = False,
) -> Texture:
    """Lines of text, centred; `lines` holds (text, size of the font, y of the middle), both over height."""
    width, height = size
    image = Image.new("RGB", size, paper)
    draw = ImageDraw.Draw(image)
    if border:
        draw.rectangle((6, 6, width - 7, height - 7), outline=ink, width=3)
    for words, letters, y in lines:
        font = ImageFont.load_default(size=letters * height)
        draw.text((width / 2, y * height), words, fill=ink, font=font, anchor="mm")
    return Texture(_pixels(image))


def _pixels(image: Image.Image) -> NDArray[np.float32]:
    return to_linear(np.asarray(image, np.float64) / 255).astype(np.float32)
