"""Analytic shapes and the nearest hit of a ray, on whole arrays of rays.

Points and directions are triples of arrays (or floats) that broadcast against each other, so that all rays
of a view share one origin. The arrays' dtype carries through: float32 for pictures, float64 for depth.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes.room.textures import Texture

Vec = tuple[Any, Any, Any]  # x, y, z: arrays or floats that broadcast
Array = NDArray[np.floating]

NEAR = 1e-3  # hits closer than this to the origin do not count


def dot(a: Vec, b: Vec) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def along(origin: Vec, t: Any, direction: Vec) -> Vec:
    """The points origin + t direction."""
    return origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2]


class Shape(Protocol):
    """A shape in its own frame, centred at the origin."""

    @property
    def half(self) -> tuple[float, float, float]:
        """Half the size of the bounding box."""
        ...

    def hit(self, o: Vec, d: Vec) -> Array:
        """Smallest t > NEAR with o + t d on the shape, inf where there is none."""
        ...

    def surface(self, p: Vec) -> tuple[Vec, Array, Array]:
        """At points p [n] on the shape: the outward unit normal and the texture's u, v in world units."""
        ...


@dataclass(frozen=True)
class Panel:
    """A rectangle in the plane z = 0, with an optional rectangular hole or a cut-out texture."""

    size: tuple[float, float]  # width, height
    hole: tuple[float, float, float, float] | None = None  # x0, y0, x1, y1 from the centre
    cutout: Texture | None = None

    @property
    def half(self) -> tuple[float, float, float]:
        return self.size[0] / 2, self.size[1] / 2, 0.0

    def hit(self, o: Vec, d: Vec) -> Array:
        t = -o[2] / d[2]
        x, y = o[0] + t * d[0], o[1] + t * d[1]
        ok = (t > NEAR) & (np.abs(x) <= self.half[0]) & (np.abs(y) <= self.half[1])
        if self.hole is not None:
            x0, y0, x1, y1 = self.hole
            ok &= ~((x > x0) & (x < x1) & (y > y0) & (y < y1))
        if self.cutout is not None:
            u, v = x[ok] / self.size[0] + 0.5, y[ok] / self.size[1] + 0.5
            ok[ok] = self.cutout.opaque(u, v)
        return np.where(ok, t, np.inf)

    def surface(self, p: Vec) -> tuple[Vec, Array, Array]:
        zero = np.zeros_like(p[0])
        return (zero, zero, zero - 1), p[0] + self.half[0], p[1] + self.half[1]


def _slab(o: Any, d: Any, half: float) -> tuple[Array, Array]:
    """Where the ray enters and leaves |coordinate| <= half."""
    inverse = 1 / d
    a, b = (-half - o) * inverse, (half - o) * inverse
    return np.minimum(a, b), np.maximum(a, b)


def _entry(enter: Array, leave: Array) -> Array:
    return np.where((enter <= leave) & (enter > NEAR), enter, np.inf)


def _box_interval(o: Vec, d: Vec, half: tuple[float, float, float]) -> tuple[Array, Array]:
    (x0, x1), (y0, y1), (z0, z1) = (_slab(a, b, h) for a, b, h in zip(o, d, half, strict=True))
    return np.maximum(np.maximum(x0, y0), z0), np.minimum(np.minimum(x1, y1), z1)


@dataclass(frozen=True)
class Box:
    half: tuple[float, float, float]

    def hit(self, o: Vec, d: Vec) -> Array:
        return _entry(*_box_interval(o, d, self.half))

    def surface(self, p: Vec) -> tuple[Vec, Array, Array]:
        excess = np.stack([np.abs(a) - h for a, h in zip(p, self.half, strict=True)])
        face = excess.argmax(0)
        normal = tuple(np.where(face == k, np.sign(p[k]), 0).astype(p[k].dtype) for k in range(3))
        x, y, z = (a + h for a, h in zip(p, self.half, strict=True))
        return (normal[0], normal[1], normal[2]), np.where(face == 0, z, x), np.where(face == 1, z, y)


@dataclass(frozen=True)
class Ellipsoid:
    half: tuple[float, float, float]  # the three radii

    def hit(self, o: Vec, d: Vec) -> Array:
        a, b, c = (1 / h for h in self.half)
        o, d = (o[0] * a, o[1] * b, o[2] * c), (d[0] * a, d[1] * b, d[2] * c)
        length2 = dot(d, d)
        middle = -dot(o, d) / length2
        q = along(o, middle, d)  # nearest point to the centre: no cancellation in 1 - |q|^2
        chord2 = (1 - dot(q, q)) / length2
        t = middle - np.sqrt(np.maximum(chord2, 0))
        return np.where((chord2 >= 0) & (t > NEAR), t, np.inf)

    def surface(self, p: Vec) -> tuple[Vec, Array, Array]:
        x, y, z = (a / h for a, h in zip(p, self.half, strict=True))
        normal = (x / self.half[0], y / self.half[1], z / self.half[2])
        scale = 1 / np.sqrt(dot(normal, normal))
        u = np.arctan2(x, -z) * self.half[0]
        v = np.arcsin(np.clip(y, -1, 1)) * self.half[1]
        return (normal[0] * scale, normal[1] * scale, normal[2] * scale), u, v


@dataclass(frozen=True)
class Cylinder:
    """A capped cylinder along y; with a small radius, a wire."""

    radius: float
    length: float

    @property
    def half(self) -> tuple[float, float, float]:
        return self.radius, self.length / 2, self.radius

    def hit(self, o: Vec, d: Vec) -> Array:
        length2 = d[0] * d[0] + d[2] * d[2]
        cross = (o[0] * d[2] - o[2] * d[0]) / length2  # distance from the axis / |d|: safe for thin wires
        chord2 = self.radius**2 / length2 - cross * cross
        middle = -(o[0] * d[0] + o[2] * d[2]) / length2
        chord = np.sqrt(np.maximum(chord2, 0))
        y0, y1 = _slab(o[1], d[1], self.length / 2)
        t = _entry(np.maximum(middle - chord, y0), np.minimum(middle + chord, y1))
        return np.where(chord2 >= 0, t, np.inf)

    def surface(self, p: Vec) -> tuple[Vec, Array, Array]:
        x, y, z = p
        side = np.abs(y) / (self.length / 2) < 1 - 1e-5
        radial = 1 / np.maximum(np.sqrt(x * x + z * z), 1e-12)
        normal = (np.where(side, x * radial, 0), np.where(side, 0, np.sign(y)), np.where(side, z * radial, 0))
        u = np.where(side, np.arctan2(x, -z) * self.radius, x)
        return normal, u, np.where(side, y + self.length / 2, z)


@dataclass(frozen=True)
class Torus:
    """A ring about the y axis, found by sphere tracing (steps of the distance to the surface)."""

    ring: float
    tube: float

    STEPS = 48

    @property
    def half(self) -> tuple[float, float, float]:
        return self.ring + self.tube, self.tube, self.ring + self.tube

    def hit(self, o: Vec, d: Vec) -> Array:
        enter, leave = _box_interval(o, d, self.half)
        t = np.full(enter.shape, np.inf, enter.dtype)
        near = (enter <= leave) & (enter > NEAR)  # never started inside the box: nothing looks from in there
        if not near.any():
            return t
        ox, oy, oz, dx, dy, dz = (np.broadcast_to(a, t.shape)[near].astype(np.float64) for a in (*o, *d))
        s, end = enter[near].astype(np.float64), leave[near]
        norm = np.sqrt(dx * dx + dy * dy + dz * dz)
        distance = s
        for _ in range(self.STEPS):
            x, y, z = ox + s * dx, oy + s * dy, oz + s * dz
            distance = np.sqrt((np.sqrt(x * x + z * z) - self.ring) ** 2 + y * y) - self.tube
            s = s + distance / norm
        t[near] = np.where((np.abs(distance) < 1e-4 * self.ring) & (s <= end), s, np.inf)
        return t

    def surface(self, p: Vec) -> tuple[Vec, Array, Array]:
        x, y, z = p
        axis = np.sqrt(x * x + z * z)
        out = axis - self.ring
        scale = 1 / np.sqrt(out * out + y * y)
        normal = (x / axis * out * scale, y * scale, z / axis * out * scale)
        return normal, np.arctan2(x, -z) * self.ring, np.arctan2(y, out) * self.tube


@dataclass(frozen=True)
class Material:
    """How a surface looks. Speculars depend on the view; a glowing surface takes no light."""

    texture: Texture
    repeat: tuple[float, float] = (1.0, 1.0)  # world units that one repeat of the texture covers
    gloss: float = 0.0  # strength of the Blinn highlight
    shine: int = 5  # the highlight's exponent is 2^shine
    mirror: float = 0.0  # reflectance of the surroundings at normal incidence
    glow: float = 0.0  # light given off, times the texture


def _rotate(rows: list[list[float]], v: Vec) -> Vec:
    """Matrix times vector without the products with 0 and 1, of which upright objects have many."""
    x, y, z = (
        reduce(operator.add, [a if c == 1 else c * a for c, a in zip(row, v, strict=True) if c != 0])
        for row in rows
    )
    return x, y, z


@dataclass(frozen=True)
class Surface:
    """A shape put into the world: p_world = rotation p_local + center."""

    shape: Shape
    material: Material
    center: tuple[float, float, float]
    rotation: NDArray[np.float64]  # [3, 3]
    shadow: bool = True  # whether it throws one
    occludes: float = 0.0  # radius of the sphere that dims the ambient light around it; 0: none

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """Corners of the bounding box in the world, [8, 3]."""
        signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), -1).reshape(8, 3)
        return (signs * np.array(self.shape.half)) @ self.rotation.T + np.array(self.center)

    @cached_property
    def _columns(self) -> list[list[float]]:
        return self.rotation.T.tolist()

    @cached_property
    def _rows(self) -> list[list[float]]:
        return self.rotation.tolist()

    def to_local(self, v: Vec) -> Vec:
        """Rotate a world direction into the shape's frame."""
        return _rotate(self._columns, v)

    def to_world(self, v: Vec) -> Vec:
        """Rotate a direction in the shape's frame into the world."""
        return _rotate(self._rows, v)

    def local_point(self, p: Vec) -> Vec:
        c = self.center
        return self.to_local((p[0] - c[0], p[1] - c[1], p[2] - c[2]))

    def hit(self, o: Vec, d: Vec) -> Array:
        return self.shape.hit(self.local_point(o), self.to_local(d))


def nearest(
    surfaces: Sequence[Surface], blocks: NDArray[np.bool_], o: Vec, d: Vec
) -> tuple[Array, NDArray[np.int16]]:
    """First hit along each ray: t (inf: none) and the index of the surface (-1: none).

    o: three floats; d: three [B, S, n] of rays in B blocks. Surface k is tried where `blocks` [N, B] is True.
    """
    t = np.full_like(d[0], np.inf)
    index = np.full(t.shape, -1, np.int16)
    for k, surface in enumerate(surfaces):
        chosen = np.flatnonzero(blocks[k])
        if not len(chosen):
            continue
        hit = surface.hit(o, (d[0][chosen], d[1][chosen], d[2][chosen]))
        before = t[chosen]
        closer = hit < before
        t[chosen] = np.where(closer, hit, before)
        index[chosen] = np.where(closer, np.int16(k), index[chosen])
    return t, index


def in_view(
    corners: NDArray[np.float64], eye: NDArray[np.float64], rays: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which boxes, corners [N, 8, 3], may meet the pyramids from `eye` through `rays` [B, 4, 3]; [N, B].

    The four rays go around their pyramid in either sense.
    """
    normals = np.cross(rays, np.roll(rays, -1, axis=1))
    normals *= np.sign((normals * rays.sum(1, keepdims=True)).sum(-1, keepdims=True))  # inwards
    side = (corners - eye).reshape(-1, 3) @ normals.reshape(-1, 3).T
    return (side >= 0).reshape(len(corners), 8, len(rays), 4).any(1).all(-1)
