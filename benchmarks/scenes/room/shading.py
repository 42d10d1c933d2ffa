"""Light, and the public renderers: `render_view` (photos), `render_light` and `render_depth`."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes.room.raycast import Array, Surface, Vec, along, dot, in_view, nearest
from benchmarks.scenes.room.studio import Studio, studio
from hqgs.photos.light import to_srgb
from hqgs.scene.scene import Camera

TILE, BLOCK = 64, 8  # pixels: a tile is one job; each surface is tried on the blocks that it may cover


def render_view(camera: Camera, samples: int = 3, threads: int | None = None) -> NDArray[np.uint8]:
    """Photo of the embedded scene, [H, W, 3] sRGB.

    A pixel is the mean of `samples`^2 rays in linear light, spread evenly over its square; use more when the
    picture is much smaller than 504 x 378. `threads` (default: the cores at hand) never changes a bit. Raises
    ValueError if the camera's size, `samples` or `threads` is below 1 or K has a skew.
    """
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
    return to_bytes(encode(render_light(camera, sample_pattern(samples), threads)))


def render_light(
    camera: Camera, jitter: NDArray[np.float64], threads: int | None = None
) -> NDArray[np.float32]:
    """Linear light of the embedded scene, [H, W, 3]: the mean of samples, rays through each pixel's corner +
    `jitter` [S, 2], x and y in the unit square; `threads` as in `render_view`."""
    light = np.empty((camera.height, camera.width, 3), np.float32)

    def work(tile: _Tile) -> None:
        light[tile.rows, tile.cols] = tile.picture(_render_tile(tile))

    _each_tile(camera, jitter, np.float32, work, threads)
    return light


def render_depth(camera: Camera) -> NDArray[np.float64]:
    """View-space z of the first surface at each pixel centre, [H, W]; inf where a ray leaves the scene.

    Raises ValueError as `render_view` does.
    """
    depth = np.empty((camera.height, camera.width))

    def work(tile: _Tile) -> None:
        t, _ = nearest(tile.seen, tile.blocks, tile.eye, tile.d)
        depth[tile.rows, tile.cols] = tile.picture(t[:, 0])

    _each_tile(camera, np.full((1, 2), 0.5), np.float64, work, None)
    return depth


def sample_pattern(n: int) -> NDArray[np.float64]:
    """Offsets (x, y) in the unit pixel, [n^2, 2]: one in each cell of an n x n grid, all x and y distinct.

    The canonical arrangement of correlated multi-jittered sampling (Kensler 2013), without its shuffle.
    """
    i, j = np.divmod(np.arange(n * n), n)
    return np.stack([(i + (j + 0.5) / n) / n, (j + (i + 0.5) / n) / n], -1)


class _Tile:
    """The rays of up to TILE x TILE pixels, in B blocks of S samples of n = BLOCK^2 pixels: [B, S, n]."""

    def __init__(
        self, camera: Camera, jitter: NDArray[np.float64], x: int, y: int, dtype: type, scene: Studio
    ) -> None:
        self.scene, self.jitter = scene, jitter
        width, height = (min(TILE, side - at) for side, at in ((camera.width, x), (camera.height, y)))
        self.rows, self.cols = slice(y, y + height), slice(x, x + width)
        self.grid = (-(-height // BLOCK), -(-width // BLOCK))  # the last blocks may reach past the picture
        row, col = (a.reshape(-1, 1) * BLOCK for a in np.indices(self.grid))
        i, j = (a.reshape(-1) for a in np.indices((BLOCK, BLOCK)))
        px, py = (x + col + j)[:, None], (y + row + i)[:, None]
        center = camera.center
        self.eye: Vec = (float(center[0]), float(center[1]), float(center[2]))
        directions = _directions(camera, px + jitter[:, :1], py + jitter[:, 1:])
        dx, dy, dz = (a.astype(dtype) for a in directions)
        self.d: Vec = (dx, dy, dz)
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])

        def meets(corners: NDArray[np.float64], left: Any, top: Any, side: int) -> NDArray[np.bool_]:
            """Which boxes, corners [N, 8, 3], the camera may see in squares at pixels [B, 1]; [N, B]."""
            rays = _directions(camera, left + side * square[:, 0], top + side * square[:, 1])
            return in_view(corners, center, np.stack(rays, -1))

        tile = np.zeros((1, 1), np.int64)
        visible = np.flatnonzero(meets(self.scene.corners, x + tile, y + tile, TILE))
        self.seen = [self.scene.surfaces[k] for k in visible]
        self.blocks = meets(self.scene.corners[visible], x + col, y + row, BLOCK)

    def picture(self, values: NDArray[Any]) -> NDArray[Any]:
        """Per-pixel values in blocks, [B, n, ...], as rows and columns of the tile."""
        down, across = self.grid
        blocks = values.reshape(down, across, BLOCK, BLOCK, *values.shape[2:])
        image = blocks.swapaxes(1, 2).reshape(down * BLOCK, across * BLOCK, *values.shape[2:])
        return image[: self.rows.stop - self.rows.start, : self.cols.stop - self.cols.start]


def _directions(camera: Camera, x: NDArray[Any], y: NDArray[Any]) -> list[NDArray[np.float64]]:
    """World directions through the pixel positions x, y; their view-space z is 1, so that t is depth."""
    K, R = camera.K, camera.viewmat[:3, :3]
    a, b = (x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]
    return [R[0, k] * a + R[1, k] * b + R[2, k] for k in range(3)]


def _each_tile(
    camera: Camera,
    jitter: NDArray[np.float64],
    dtype: type,
    work: Callable[[_Tile], None],
    threads: int | None,
) -> None:
    """Run `work` on fixed tiles that cover the picture; the tiles do not depend on the threads."""
    width, height, skew = camera.width, camera.height, camera.K[0, 1]
    if width < 1 or height < 1:
        raise ValueError(f"camera must be at least 1 x 1 pixels, got {width} x {height}")
    if skew != 0:
        raise ValueError(f"camera.K must have skew 0, got {skew}")
    if threads is not None and threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}")

    scene = studio()

    def job(corner: tuple[int, int]) -> None:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # rays parallel to a side
            work(_Tile(camera, jitter, *corner, dtype, scene))

    corners = [(x, y) for y in range(0, height, TILE) for x in range(0, width, TILE)]
    with ThreadPoolExecutor(threads or min(8, os.cpu_count() or 1)) as pool:  # more would wait for Python
        for _ in pool.map(job, corners):
            pass


def _render_tile(tile: _Tile) -> Array:
    """Linear light, [B, n, 3]."""
    scene, d = tile.scene, tile.d
    t, index = nearest(tile.seen, tile.blocks, tile.eye, d)
    p = along(tile.eye, np.where(index < 0, np.float32(0), t), d)
    lights = _key_lights(scene, tile.jitter)
    shadow = _in_shadow(scene, tile.seen, p, index, lights)
    color = np.empty((*t.shape, 3), np.float32)
    color[index < 0] = scene.backdrop
    view = -1 / np.sqrt(dot(d, d))
    for k in np.unique(index[index >= 0]):
        mask = index == k
        where = np.nonzero(mask)
        a, b, c = (light[0, where[1], 0] for light in lights)
        hits, away = (p[0][mask], p[1][mask], p[2][mask]), view[mask]
        to_eye = (d[0][mask] * away, d[1][mask] * away, d[2][mask] * away)
        lit = (~shadow[mask]).astype(np.float32)
        color[mask] = _shade(scene, tile.seen[k], hits, to_eye, (a, b, c), lit)
    return color.sum(1, dtype=np.float32) / np.float32(len(tile.jitter))


def _key_lights(scene: Studio, jitter: NDArray[np.float64]) -> Vec:
    """Directions to the key light, [1, S, 1] each: every sub-sample sees another point of the square lamp, so
    that the shadows of a pixel's rays blend into a penumbra that is the same from all views."""
    a, b = (jitter.T - 0.5) * 2 * scene.lamp_size
    across, down, towards = scene.lamp_frame
    omega = towards + a[:, None] * across + b[:, None] * down
    omega /= np.sqrt((omega * omega).sum(1, keepdims=True))
    x, y, z = omega.T.astype(np.float32)[:, None, :, None]
    return x, y, z


def _in_shadow(
    scene: Studio, seen: Sequence[Surface], p: Vec, index: NDArray[np.int16], lights: Vec
) -> NDArray[np.bool_]:
    """Whether another surface hides the key light from the points p [B, S, n]."""
    shadow = np.zeros(index.shape, bool)
    # bounds of each block in the lamp's frame, from its box in the world
    bounds = np.stack([[a.min((1, 2)), a.max((1, 2))] for a in p]).astype(np.float64)  # [3, 2, B]
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    corners = bounds[np.arange(3), bits].transpose(0, 2, 1) @ np.stack(scene.lamp_frame).T  # [8, B, 3]
    low, high = corners.min(0), corners.max(0)
    box_low, box_high = (a[:, None] for a in scene.lamp_boxes)
    reach = box_high[..., 2] - low[:, 2]  # along the light; the shaft widens by lamp_size times it
    gap = np.maximum(box_low - high, low - box_high)[..., :2].max(-1)
    near = (reach > 0) & (gap <= 2 * scene.lamp_size * reach)  # [M, B]
    own = {id(surface): k for k, surface in enumerate(seen)}
    for k in np.flatnonzero(near.any(1)):
        surface, chosen = scene.casters[k], np.flatnonzero(near[k])
        blocked = np.isfinite(surface.hit((p[0][chosen], p[1][chosen], p[2][chosen]), lights))
        if id(surface) in own:  # rounding must not let a surface shade itself
            blocked &= index[chosen] != own[id(surface)]
        shadow[chosen] |= blocked
    return shadow


def _shade(scene: Studio, surface: Surface, p: Vec, to_eye: Vec, light: Vec, lit: Array) -> Array:
    """Linear RGB, [n, 3], at points p [n] of one surface; `lit` is 0 in the key light's shadow."""
    material = surface.material
    normal, u, v = surface.shape.surface(surface.local_point(p))
    albedo = material.texture.sample(u / material.repeat[0], v / material.repeat[1])
    n = surface.to_world(normal)
    flip = np.where(dot(n, to_eye) < 0, np.float32(-1), np.float32(1))  # panels are two-sided
    n = (n[0] * flip, n[1] * flip, n[2] * flip)
    facing = np.maximum(dot(n, to_eye), 0)
    if material.glow > 0:  # a milky shade: brightest where it is seen head on
        return albedo * (material.glow * (0.55 + 0.45 * facing))[:, None]
    key = np.maximum(dot(n, light), 0) * lit
    fill = np.maximum(dot(n, scene.fill_direction), 0)
    open_sky = (0.5 - 0.5 * n[1]) * np.float32(1)  # y points down
    ambient = scene.ground + (scene.sky - scene.ground) * open_sky[:, None]
    ambient = ambient * _openness(scene, surface, p, n)[:, None]
    color = albedo * (ambient + scene.key * key[:, None] + scene.fill * fill[:, None])
    if material.gloss > 0:
        half = (light[0] + to_eye[0], light[1] + to_eye[1], light[2] + to_eye[2])
        blinn = np.maximum(dot(n, half), 0) / np.sqrt(dot(half, half))
        for _ in range(material.shine):
            blinn = blinn * blinn
        color = color + scene.key * (material.gloss * blinn * lit)[:, None]
    if material.mirror > 0:
        grazing = 1 - facing
        fresnel = material.mirror + (1 - material.mirror) * grazing * (grazing * grazing) ** 2
        bounce = along((-to_eye[0], -to_eye[1], -to_eye[2]), 2 * dot(n, to_eye), n)
        color = color * (1 - 0.5 * fresnel[:, None]) + _surroundings(scene, bounce) * fresnel[:, None]
    return color


def _openness(scene: Studio, surface: Surface, p: Vec, n: Vec) -> Array:
    """Share of the ambient light that reaches p: dimmed near the room's planes and beside solid objects."""
    share = np.ones_like(p[0])
    for axis, position, sign in scene.room:
        distance = np.maximum((p[axis] - position) * sign, 0)
        share = share * (1 - 0.28 * (1 - n[axis] * sign) / (1 + 3 * distance) ** 2)
    for other in scene.occluders:
        c, r = other.center, other.occludes
        if other is surface:
            continue
        away = [max(float(a.min()) - x, x - float(a.max()), 0.0) for a, x in zip(p, c, strict=True)]
        if max(away) > 4 * r:
            continue
        to = (c[0] - p[0], c[1] - p[1], c[2] - p[2])
        d2 = np.maximum(dot(to, to), r * r)
        # solid angle of a sphere weighted by the cosine: (n . d) r^2 / d^2; faded out to 0 at 4 r
        share = share * (1 - np.maximum(dot(n, to), 0) / np.sqrt(d2) * np.maximum(r * r / d2 - 1 / 16, 0))
    return share


def _surroundings(scene: Studio, r: Vec) -> Array:
    """What a mirror sees in direction r [n]: floor and sky, and the lamp as a window of four panes."""
    color = scene.ground + (scene.sky - scene.ground) * np.clip(0.5 - 1.5 * r[1], 0, 1)[:, None]
    across, down, ahead = (
        float(axis[0]) * r[0] + float(axis[1]) * r[1] + float(axis[2]) * r[2] for axis in scene.lamp_frame
    )
    ahead = np.maximum(ahead, 1e-3)
    a, b = np.abs(across / ahead), np.abs(down / ahead)
    pane = np.clip((0.34 - np.maximum(a, b)) / 0.04, 0, 1) * np.clip((np.minimum(a, b) - 0.02) / 0.02, 0, 1)
    return color + scene.key * (3 * pane)[:, None]


def encode(linear: Array) -> Array:
    """Roll off the highlights above 0.7 and apply the sRGB curve; [0, inf) to [0, 1]."""
    over = np.maximum(linear - 0.7, 0)
    x = np.minimum(linear, 0.7) + 0.3 * over / (over + 0.3)
    return to_srgb(x)


def to_bytes(values: Array) -> NDArray[np.uint8]:
    """Values of 0..1 as a photo stores them."""
    return (values * 255 + 0.5).astype(np.uint8)
