"""A renderer in 100 decimal digits, for a few Gaussians and a few pixels.

It follows docs/conventions.md by itself: it shares no code with the rasterizer and none with the float64
reference of the tests. Every step is one scalar of mpmath. Gradients are central differences with a step of
1e-30 of the parameter, whose error at this precision is far below one ulp of float64; the decisions (cull,
order, floor, cap, stop, clamp) are those of the unperturbed scene.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

DIGITS = 100
STEP = "1e-30"
ALPHA_FLOOR = 1.0 / 255.0
GROUPS = ("means", "quats", "scales", "opacities", "colors")
Array = np.ndarray[Any, Any]
Pixel = tuple[int, int]  # row, column


def load_mpmath() -> Any:
    """mpmath, or a ValueError that says how to get it."""
    try:
        import mpmath
    except ModuleNotFoundError as error:
        raise ValueError("the oracle needs mpmath: install it with `pip install mpmath`") from error
    return mpmath


@dataclass(frozen=True)
class OracleScene:
    """Inputs of one camera, float64 arrays; units and frames as in `hqgs.rasterization`."""

    means: Array  # [N, 3]
    quats: Array  # [N, 4]
    scales: Array  # [N, 3]
    opacities: Array  # [N]
    colors: Array  # [N, D], or [N, K, 3] with sh_degree
    viewmat: Array  # [4, 4]
    K: Array  # [3, 3]
    width: int
    height: int
    background: Array | None = None  # [D]
    sh_degree: int | None = None
    eps2d: float = 0.3
    near_plane: float = 0.01
    far_plane: float = 1e10
    antialiased: bool = False

    def rounded(self, dtype: str) -> OracleScene:
        """The same scene with every number rounded to "f32" or "f64"."""
        kind = {"f32": np.float32, "f64": np.float64}[dtype]
        names = (*GROUPS, "viewmat", "K", *(["background"] if self.background is not None else []))
        with np.errstate(over="ignore"):  # what is too large for float32 becomes Inf, as for a user
            arrays = {name: getattr(self, name).astype(kind).astype(np.float64) for name in names}
        return replace(self, **arrays)

    def nudged(self, dtype: str, rng: np.random.Generator) -> OracleScene:
        """Each number that is not 0 moved one ulp of "f32" or "f64" up or down, at random."""
        kind = {"f32": np.float32, "f64": np.float64}[dtype]
        arrays = {}
        for name in (*GROUPS, "viewmat", "K"):
            values = getattr(self, name).astype(kind)
            to = np.where(rng.random(values.shape) < 0.5, -np.inf, np.inf).astype(kind)
            arrays[name] = np.where(values == 0, values, np.nextafter(values, to)).astype(np.float64)
        arrays["viewmat"][3] = self.viewmat[3]
        arrays["K"][2] = self.K[2]
        return replace(self, **arrays)

    def without(self, i: int) -> OracleScene:
        """The scene without Gaussian `i`."""
        return replace(self, **{name: np.delete(getattr(self, name), i, axis=0) for name in GROUPS})


@dataclass(frozen=True)
class Splat:
    """A projected Gaussian, in mpmath numbers."""

    mean: tuple[Any, Any]  # pixels
    cov: tuple[Any, Any, Any]  # xx, xy, yy, low-pass included
    det: Any
    opacity: Any  # compensated when antialiased
    color: list[Any]


class Oracle:
    """Pixels and gradients of one scene."""

    def __init__(self, scene: OracleScene) -> None:
        self.mp = load_mpmath().mp.clone()
        self.mp.dps = DIGITS
        self.scene = scene
        self.splats: dict[int, Splat | None] = {}
        mpf = self.mp.mpf
        self.R = [[mpf(float(v)) for v in row[:3]] for row in scene.viewmat[:3]]
        self.t = [mpf(float(row[3])) for row in scene.viewmat[:3]]
        self.background = None if scene.background is None else [mpf(float(v)) for v in scene.background]

    @cached_property
    def center(self) -> list[Any]:
        """The camera centre -R^-1 t; a rounded R is not exactly a rotation, so it is inverted."""
        solution = self.mp.lu_solve(self.mp.matrix(self.R), self.mp.matrix(self.t))
        return [-v for v in solution]

    @cached_property
    def order(self) -> list[int]:
        """Gaussians with finite numbers by (depth, index), before culling by anything that costs more."""
        finite = [i for i in range(len(self.scene.means)) if self._finite(i)]
        depths = {i: self._camera_point(self._numbers("means", i))[2] for i in finite}
        return sorted(finite, key=lambda i: (depths[i], i))

    def kept(self, i: int) -> bool:
        """Whether Gaussian `i` is not culled."""
        if not self._finite(i):
            return False
        return self._splat(i) is not None

    def pixel(self, pixel: Pixel) -> list[Any]:
        """Colour channels and alpha of a pixel (row, column)."""
        layers, _ = self._layers(pixel)
        return self._blend(layers)

    def gradients(self, cotangents: dict[Pixel, Array], ids: list[int]) -> dict[str, list[list[Any]]]:
        """Gradients by group, for Gaussians `ids`, of the sum over pixels of cotangent . (color, alpha)."""
        plans = [(pixel, v, *self._layers(pixel)) for pixel, v in cotangents.items()]
        found: dict[str, list[list[Any]]] = {name: [] for name in GROUPS}
        for i in ids:
            for name in GROUPS:
                found[name].append(self._differences(i, name, plans))
        return found

    def _differences(self, i: int, name: str, plans: list[Any]) -> list[Any]:
        mp = self.mp
        values = self._numbers(name, i)
        touched = [plan for plan in plans if any(layer[0] == i for layer in plan[2])]
        if self._splat(i) is None or not touched:
            return [mp.mpf(0)] * len(values)
        largest = max(abs(v) for v in values)
        if name == "means":
            largest = max(largest, abs(self._camera_point(values)[2]))
        gradient = []
        for k, value in enumerate(values):
            h = mp.mpf(STEP) * (abs(value) or largest or mp.mpf(1))
            sides = []
            for signed in (h, -h):
                moved = [v + signed if j == k else v for j, v in enumerate(values)]
                splat = self._project(i, {name: moved})
                sides.append(mp.fsum(self._moved_loss(i, splat, *plan) for plan in touched))
            gradient.append((sides[0] - sides[1]) / (2 * h))
        return gradient

    def _moved_loss(
        self, i: int, splat: Splat, pixel: Pixel, v: Array, layers: list[Any], capped: set[int]
    ) -> Any:
        moved = []
        for j, alpha, color in layers:
            if j == i:
                alpha = alpha if i in capped else self._alpha(splat, pixel)
                color = splat.color
            moved.append((j, alpha, color))
        return self.mp.fsum(self.mp.mpf(float(a)) * b for a, b in zip(v, self._blend(moved), strict=True))

    def _layers(self, pixel: Pixel) -> tuple[list[tuple[int, Any, list[Any]]], set[int]]:
        """What is blended into a pixel, front to back, as (Gaussian, alpha, colour), and who is capped."""
        mp = self.mp
        transmittance, layers, capped = mp.mpf(1), [], set()
        cap, stop = mp.mpf("0.99"), mp.mpf("0.999e-4")
        for i in self.order:
            splat = self._splat(i)
            if splat is None:
                continue
            alpha = self._alpha(splat, pixel)
            if alpha < ALPHA_FLOOR:
                continue
            if alpha >= cap:
                alpha = cap
                capped.add(i)
            if transmittance * (1 - alpha) <= stop:
                break
            transmittance *= 1 - alpha
            layers.append((i, alpha, splat.color))
        return layers, capped

    def _blend(self, layers: list[tuple[int, Any, list[Any]]]) -> list[Any]:
        mp = self.mp
        channels = 3 if self.scene.sh_degree is not None else self.scene.colors.shape[1]
        transmittance, total = mp.mpf(1), [mp.mpf(0)] * channels
        for _, alpha, color in layers:
            weight = transmittance * alpha
            total = [a + weight * b for a, b in zip(total, color, strict=True)]
            transmittance *= 1 - alpha
        if self.background is not None:
            total = [a + transmittance * b for a, b in zip(total, self.background, strict=True)]
        return [*total, 1 - transmittance]

    def _alpha(self, splat: Splat, pixel: Pixel) -> Any:
        half = self.mp.mpf("0.5")
        dx, dy = pixel[1] + half - splat.mean[0], pixel[0] + half - splat.mean[1]
        xx, xy, yy = splat.cov
        sigma = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (2 * splat.det)
        return splat.opacity * self.mp.exp(-sigma)

    def _finite(self, i: int) -> bool:
        return all(np.isfinite(self._used(name, i)).all() for name in GROUPS)

    def _used(self, name: str, i: int) -> Array:
        values = getattr(self.scene, name)[i]
        if name == "colors" and self.scene.sh_degree is not None:
            values = values[: (self.scene.sh_degree + 1) ** 2]
        return np.ravel(values)

    def _numbers(self, name: str, i: int) -> list[Any]:
        return [self.mp.mpf(float(v)) for v in self._used(name, i)]

    def _camera_point(self, mean: list[Any]) -> list[Any]:
        return [
            sum((a * b for a, b in zip(row, mean, strict=True)), t)
            for row, t in zip(self.R, self.t, strict=True)
        ]

    def _splat(self, i: int) -> Splat | None:
        if i not in self.splats:
            self.splats[i] = self._cull(i)
        return self.splats[i]

    def _cull(self, i: int) -> Splat | None:
        mp, s = self.mp, self.scene
        depth = self._camera_point(self._numbers("means", i))[2]
        if depth < s.near_plane or depth > s.far_plane:
            return None
        if sum(v * v for v in self._numbers("quats", i)) < 1e-12:
            return None
        if s.opacities[i] < ALPHA_FLOOR:
            return None
        splat = self._project(i, {})
        if splat.det <= 0 or splat.opacity < ALPHA_FLOOR:
            return None
        reach = mp.sqrt(2 * max(mp.mpf(0), mp.log(splat.opacity / ALPHA_FLOOR)))
        if reach == 0:  # both radii are 0, which is at most the default radius_clip
            return None
        for mean, variance, size in zip(splat.mean, splat.cov[::2], (s.width, s.height), strict=True):
            radius = mp.ceil(reach * mp.sqrt(variance))
            if mean + radius <= 0 or mean - radius >= size:
                return None
        return splat

    def _project(self, i: int, changed: dict[str, list[Any]]) -> Splat:
        """Gaussian `i`, with the parameters in `changed` instead of its own."""
        mp, s = self.mp, self.scene
        mean, quat, scale, (opacity,), color = (
            changed.get(name) or self._numbers(name, i) for name in GROUPS
        )
        x, y, z = self._camera_point(mean)
        fx, fy, cx, cy = (mp.mpf(float(s.K[k])) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
        rows = []
        for f, c, ratio, size in ((fx, cx, x / z, s.width), (fy, cy, y / z, s.height)):
            margin = mp.mpf("0.3") * size / (2 * f)
            rows.append(f * min(max(ratio, -(c / f + margin)), (size - c) / f + margin) / z)
        J = [[fx / z, mp.mpf(0), -rows[0]], [mp.mpf(0), fy / z, -rows[1]]]
        rotation = self._rotation(quat)
        M = [[rotation[r][k] * scale[k] for k in range(3)] for r in range(3)]
        A = _product(_product(J, self.R), M)  # [2, 3]
        xx, xy, yy = (mp.fdot(A[p], A[q]) for p, q in ((0, 0), (0, 1), (1, 1)))
        plain = xx * yy - xy * xy
        eps = mp.mpf(s.eps2d)
        cov = (xx + eps, xy, yy + eps)
        det = cov[0] * cov[2] - xy * xy
        if s.antialiased:
            opacity = opacity * mp.sqrt(max(mp.mpf(0), plain / det))
        if s.sh_degree is not None:
            color = self._harmonics(color, mean, s.sh_degree)
        return Splat((fx * x / z + cx, fy * y / z + cy), cov, det, opacity, color)

    def _rotation(self, quat: list[Any]) -> list[list[Any]]:
        """v -> q v q* / |q|^2, column by column with the product of quaternions."""
        norm2 = sum(v * v for v in quat)
        conjugate = [quat[0], -quat[1], -quat[2], -quat[3]]
        columns = []
        for k in range(3):
            unit = [self.mp.mpf(int(j == k + 1)) for j in range(4)]
            columns.append([v / norm2 for v in _hamilton(_hamilton(quat, unit), conjugate)[1:]])
        return [[columns[k][r] for k in range(3)] for r in range(3)]

    def _harmonics(self, coefficients: list[Any], mean: list[Any], degree: int) -> list[Any]:
        mp = self.mp
        offset = [a - b for a, b in zip(mean, self.center, strict=True)]
        length = mp.sqrt(sum(v * v for v in offset))
        x, y, z = [v / length for v in offset] if length > 0 else [mp.mpf(0)] * 3

        def k(a: int, b: int) -> Any:
            return mp.sqrt(mp.mpf(a) / (b * mp.pi))

        basis = [k(1, 4), -k(3, 4) * y, k(3, 4) * z, -k(3, 4) * x]
        basis += [k(15, 4) * x * y, -k(15, 4) * y * z, k(5, 16) * (2 * z * z - x * x - y * y)]
        basis += [-k(15, 4) * x * z, k(15, 16) * (x * x - y * y), -k(35, 32) * y * (3 * x * x - y * y)]
        basis += [k(105, 4) * x * y * z, -k(21, 32) * y * (4 * z * z - x * x - y * y)]
        basis += [k(7, 16) * z * (2 * z * z - 3 * x * x - 3 * y * y)]
        basis += [-k(21, 32) * x * (4 * z * z - x * x - y * y), k(105, 16) * z * (x * x - y * y)]
        basis += [-k(35, 32) * x * (x * x - 3 * y * y)]
        used = (degree + 1) ** 2 if length > 0 else 1
        sums = [mp.fsum(basis[j] * coefficients[3 * j + c] for j in range(used)) for c in range(3)]
        return [max(v + mp.mpf("0.5"), mp.mpf(0)) for v in sums]


def _product(a: list[list[Any]], b: list[list[Any]]) -> list[list[Any]]:
    columns = list(zip(*b, strict=True))
    return [[sum(p * q for p, q in zip(row, column, strict=True)) for column in columns] for row in a]


def _hamilton(p: list[Any], q: list[Any]) -> list[Any]:
    a, b, c, d = p
    e, f, g, h = q
    return [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]
