"""A renderer in 100 decimal digits, for a few Gaussians and a few pixels.

It follows docs/conventions.md by itself: it shares no code with the rasterizer and none with the float64
reference of the tests. Every step is one scalar of mpmath. Gradients are central differences with a step of
1e-30 of the parameter, whose error at this precision is far below one ulp of float64; the decisions (cull,
order, floor, cap, stop, clamp) are those of the unperturbed scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

DIGITS = 100
STEP = "1e-30"
ALPHA_FLOOR = 1.0 / 255.0
KINDS = {"f32": np.float32, "f64": np.float64}
GROUPS = ("means", "quats", "scales", "opacities", "colors")
Array = np.ndarray[Any, Any]
Pixel = tuple[int, int]  # row, column
Layer = tuple[int, Any, list[Any], bool]  # Gaussian, alpha, colour, whether its alpha is capped


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
        names = (*GROUPS, "viewmat", "K", *(["background"] if self.background is not None else []))
        with np.errstate(over="ignore"):  # what is too large for float32 becomes Inf, as for a user
            return replace(self, **{n: getattr(self, n).astype(KINDS[dtype]).astype(float) for n in names})

    def nudged(self, dtype: str, rng: np.random.Generator) -> OracleScene:
        """Each number that is not 0 moved one ulp of "f32" or "f64" up or down, at random."""
        arrays = {}
        for name in (*GROUPS, "viewmat", "K"):
            values = getattr(self, name).astype(KINDS[dtype])
            to = np.where(rng.random(values.shape) < 0.5, -np.inf, np.inf).astype(KINDS[dtype])
            arrays[name] = np.where(values == 0, values, np.nextafter(values, to)).astype(float)
        arrays["viewmat"][3] = self.viewmat[3]
        arrays["K"][2] = self.K[2]
        return replace(self, **arrays)

    def without(self, ids: Sequence[int]) -> OracleScene:
        """The scene without some Gaussians."""
        return replace(self, **{name: np.delete(getattr(self, name), ids, axis=0) for name in GROUPS})


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
        self.splat = cache(self._splat)
        self.R, self.t = (self.mp.matrix(part.tolist()) for part in np.split(scene.viewmat[:3], [3], axis=1))

    @cached_property
    def center(self) -> Any:
        """The camera centre -R^-1 t; a rounded R is not exactly a rotation, so it is inverted."""
        return -self.mp.lu_solve(self.R, self.t)

    @cached_property
    def order(self) -> list[int]:
        """Gaussians with finite numbers by (depth, index), before culling by anything that costs more."""
        finite = [i for i in range(len(self.scene.means)) if self._finite(i)]
        return sorted(finite, key=lambda i: (self._camera_point(self._numbers("means", i))[2], i))

    def pixel(self, pixel: Pixel) -> list[Any]:
        """Colour channels and alpha of a pixel (row, column)."""
        return self._blend(self._layers(pixel))

    def gradients(self, cotangents: dict[Pixel, Array], ids: list[int]) -> dict[str, list[list[Any]]]:
        """Gradients by group, for Gaussians `ids`, of the sum over pixels of cotangent . (color, alpha)."""
        plans = [(pixel, v, self._layers(pixel)) for pixel, v in cotangents.items()]
        return {name: [self._differences(i, name, plans) for i in ids] for name in GROUPS}

    def _differences(self, i: int, name: str, plans: list[Any]) -> list[Any]:
        mp, values = self.mp, self._numbers(name, i)
        touched = [plan for plan in plans if any(layer[0] == i for layer in plan[2])]
        if self.splat(i) is None or not touched:
            return [mp.mpf(0)] * len(values)
        largest = max(abs(v) for v in values)
        if name == "means":
            largest = max(largest, abs(self._camera_point(values)[2]))

        def loss(k: int, step: Any) -> Any:
            splat = self._project(i, {name: [*values[:k], values[k] + step, *values[k + 1 :]]})
            return mp.fsum(self._moved_loss(i, splat, *plan) for plan in touched)

        steps = [mp.mpf(STEP) * (abs(value) or largest or mp.mpf(1)) for value in values]
        return [(loss(k, h) - loss(k, -h)) / (2 * h) for k, h in enumerate(steps)]

    def _moved_loss(self, i: int, splat: Splat, pixel: Pixel, v: Array, layers: list[Layer]) -> Any:
        """The loss of a pixel where Gaussian `i` is another splat; who is capped remains so."""
        moved = [
            (j, alpha if capped else self._alpha(splat, pixel), splat.color, capped)
            if j == i
            else (j, alpha, color, capped)
            for j, alpha, color, capped in layers
        ]
        return self.mp.fdot(v.tolist(), self._blend(moved))

    def _layers(self, pixel: Pixel) -> list[Layer]:
        """What is blended into a pixel, front to back."""
        mp = self.mp
        transmittance, layers = mp.mpf(1), []
        cap, stop = mp.mpf("0.99"), mp.mpf("0.999e-4")
        for i in self.order:
            splat = self.splat(i)
            if splat is None or (alpha := self._alpha(splat, pixel)) < ALPHA_FLOOR:
                continue
            capped = alpha >= cap
            alpha = min(alpha, cap)
            if transmittance * (1 - alpha) <= stop:
                break
            transmittance *= 1 - alpha
            layers.append((i, alpha, splat.color, capped))
        return layers

    def _blend(self, layers: list[Layer]) -> list[Any]:
        mp, background = self.mp, self.scene.background
        channels = 3 if self.scene.sh_degree is not None else self.scene.colors.shape[1]
        transmittance, total = mp.mpf(1), [mp.mpf(0)] * channels
        for _, alpha, color, _ in layers:
            total = [a + transmittance * alpha * b for a, b in zip(total, color, strict=True)]
            transmittance *= 1 - alpha
        if background is not None:
            total = [a + transmittance * b for a, b in zip(total, background.tolist(), strict=True)]
        return [*total, 1 - transmittance]

    def _alpha(self, splat: Splat, pixel: Pixel) -> Any:
        half = self.mp.mpf("0.5")
        dx, dy = pixel[1] + half - splat.mean[0], pixel[0] + half - splat.mean[1]
        xx, xy, yy = splat.cov
        sigma = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (2 * splat.det)
        return splat.opacity * self.mp.exp(-sigma)

    def _finite(self, i: int) -> bool:
        return all(self.mp.isfinite(v) for name in GROUPS for v in self._numbers(name, i))

    def _numbers(self, name: str, i: int) -> list[Any]:
        values, degree = getattr(self.scene, name)[i], self.scene.sh_degree
        if name == "colors" and degree is not None:
            values = values[: (degree + 1) ** 2]
        return [self.mp.mpf(v) for v in np.ravel(values).tolist()]

    def _camera_point(self, mean: list[Any]) -> Any:
        return self.R * self.mp.matrix(mean) + self.t

    def _splat(self, i: int) -> Splat | None:
        """Gaussian `i` as it is projected; None where it is culled."""
        if not self._finite(i):
            return None
        mp, s = self.mp, self.scene
        depth = self._camera_point(self._numbers("means", i))[2]
        norm2 = sum(v * v for v in self._numbers("quats", i))
        if not s.near_plane <= depth <= s.far_plane or norm2 < 1e-12 or s.opacities[i] < ALPHA_FLOOR:
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
        mean, quat, scale, (opacity,), color = (changed.get(n) or self._numbers(n, i) for n in GROUPS)
        x, y, z = self._camera_point(mean)
        J, centers = mp.zeros(2, 3), []
        for k, (v, size) in enumerate(((x, s.width), (y, s.height))):
            f, c = mp.mpf(float(s.K[k, k])), mp.mpf(float(s.K[k, 2]))
            margin = mp.mpf("0.3") * size / (2 * f)
            J[k, k] = f / z
            J[k, 2] = -f * min(max(v / z, -(c / f + margin)), (size - c) / f + margin) / z
            centers.append(f * v / z + c)
        A = J * self.R * self._rotation(quat) * mp.diag(scale)
        plain = A * A.T
        cov = plain[0, 0] + mp.mpf(s.eps2d), plain[0, 1], plain[1, 1] + mp.mpf(s.eps2d)
        det = cov[0] * cov[2] - cov[1] ** 2
        if s.antialiased:
            area2 = plain[0, 0] * plain[1, 1] - plain[0, 1] ** 2
            opacity = opacity * mp.sqrt(max(mp.mpf(0), area2 / det))
        if s.sh_degree is not None:
            color = self._harmonics(color, mean, s.sh_degree)
        return Splat((centers[0], centers[1]), cov, det, opacity, color)

    def _rotation(self, quat: list[Any]) -> Any:
        """v -> q v q* / |q|^2: with S v = (x, y, z) x v it is 1 + (2 w S + 2 S^2) / |q|^2."""
        w, x, y, z = quat
        S = self.mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return self.mp.eye(3) + (w * S + S * S) * (2 / sum(v * v for v in quat))

    def _harmonics(self, coefficients: list[Any], mean: list[Any], degree: int) -> list[Any]:
        mp = self.mp
        offset = mp.matrix(mean) - self.center
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
