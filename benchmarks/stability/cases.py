"""The stiff and extreme scenes of The benchmark `stability`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.stability.oracle import GROUPS, Array, OracleScene, Pixel

F32_ULP, F64_ULP = 2.0**-23, 2.0**-52
FLOOR = 1.0 / 255.0
PIXELS: tuple[Pixel, ...] = ((4, 5), (4, 6), (3, 5), (6, 8), (0, 0), (8, 11))


@dataclass(frozen=True)
class Case:
    """One scene and what is expected of it."""

    name: str
    reason: str
    scene: OracleScene
    culled: tuple[int, ...] = ()  # Gaussians that must be culled; all others must not
    culled_f32: tuple[int, ...] | None = None  # where float32 inputs are another scene
    pixels: tuple[Pixel, ...] = PIXELS
    gradients_of: tuple[int, ...] | None = None  # all
    ordinary: bool = False  # float32 must be within 1e-5
    ill_conditioned: bool = False  # one ulp of the inputs changes more than the targets allow
    poison: bool = False  # not finite: no oracle, only that the others do not notice

    @property
    def compared(self) -> list[int]:
        """The Gaussians whose gradients are compared."""
        return list(range(len(self.scene.means)) if self.gradients_of is None else self.gradients_of)

    def expected_culled(self, dtype: str) -> tuple[int, ...]:
        """The Gaussians that must be culled in "f32" or "f64"."""
        return self.culled_f32 if dtype == "f32" and self.culled_f32 is not None else self.culled


def scene(**changes: Any) -> OracleScene:
    """Two ordinary Gaussians at depths 5 and 6 before a 12 x 9 camera of focal length 20 at the origin."""
    base = OracleScene(
        means=np.array([[-0.11, 0.07, 5.0], [0.31, -0.17, 6.0]]),
        quats=np.array([[0.83, -0.21, 0.42, 0.31], [0.47, 0.61, -0.33, 0.52]]),
        scales=np.array([[0.41, 0.23, 0.32], [0.52, 0.61, 0.27]]),
        opacities=np.array([0.73, 0.64]),
        colors=np.array([[0.81, 0.37, 0.22], [0.13, 0.58, 0.94]]),
        viewmat=np.eye(4),
        K=np.array([[20.0, 0.0, 6.0], [0.0, 20.0, 4.5], [0.0, 0.0, 1.0]]),
        width=12,
        height=9,
        background=np.array([0.31, 0.62, 0.17]),
    )
    return replace(base, **changes)


def first(name: str, value: Any, base: OracleScene | None = None) -> OracleScene:
    """A scene whose first Gaussian has another `name`."""
    base = base or scene()
    values = getattr(base, name).copy()
    values[0] = value
    return replace(base, **{name: values})


def turned_view(angle: float, axis: Array, t: Array) -> Array:
    """World to camera [4, 4]: a turn by `angle` radians about `axis`, then `t`."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    view = np.eye(4)
    view[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    view[:3, 3] = t
    return view


def shapes() -> Iterator[Case]:
    yield Case("ordinary", "the base of all others", scene(), ordinary=True)
    view = turned_view(0.4, np.array([0.3, 1.0, -0.2]), np.array([0.1, -0.2, 0.6]))
    means = np.linalg.solve(view[:3, :3], scene().means.T - view[:3, 3:]).T
    yield Case("turned camera", "a general rotation", scene(viewmat=view, means=means), ordinary=True)
    yield Case("antialiased", "compensated opacity", scene(antialiased=True), ordinary=True)
    for e in (0, 1, 2, 3, 4, 5, 6, 7):
        value = [0.4, 0.4, 0.4] if e == 0 else [0.4, 0.4 / 10**e, 0.4 / 10**e]
        yield Case(f"anisotropy 1e{e}", "thin: det of the covariance cancels", first("scales", value))
    for e in (1, 3, 5, 7):
        value = [0.03 * 10**e, 0.03, 0.03]
        yield Case(f"long needle 1e{e}", "det in f32 loses the minor axis", first("scales", value))
    for e in (-12, -6, -3, 3, 6, 12):
        near = first("means", [-0.126, 0.002, 5.0])  # a tiny one must cover a pixel centre
        yield Case(f"scale 1e{e}", "squares of 1e-24 and 1e24", first("scales", [10.0**e] * 3, near))
    yield Case("log scale 40", "exp(40) = 2.4e17", first("scales", [math.exp(40)] * 3))
    yield Case(
        "log scale 120",
        "exp(120) = 1.3e52 is Inf in f32",
        first("scales", [math.exp(120)] * 3),
        culled_f32=(0,),
    )
    frame = 12 * 5 / 20  # its width at depth 5
    for times in (10, 100, 1000, 4000):
        needle = first("scales", [times * frame, 0.02, 0.02])
        yield Case(f"needle {times}x the frame", "seen in trained scenes", needle)
    extreme = first("scales", [1e5 * frame, 0.02, 0.02])
    yield Case("needle 100000x the frame", "its VJP subtracts nearly equal rows", extreme)
    flat = first("scales", [1e5 * frame, 1e-3, 0.3])
    yield Case("needle 100000x, flat", "the same with three unequal axes", flat)
    turned = turned_view(0.4, np.array([0.3, 1.0, -0.2]), np.array([0.1, -0.2, 0.6]))
    means = np.linalg.solve(turned[:3, :3], scene().means.T - turned[:3, 3:]).T
    turned = replace(flat, viewmat=turned, means=means)
    yield Case("needle 100000x, turned camera", "the same with a rounded rotation", turned)
    thick = first("scales", [1e5 * frame, 0.1, 0.1], scene(antialiased=True))
    yield Case("needle 100000x, antialiased", "the same in the compensation of the opacity", thick)
    disc = first("quats", [1.0, 0.0, 0.0, 0.0], first("scales", [0.5, 0.5, 1e-7]))
    yield Case("disc face on", "one scale near 0", disc)
    nearly = first("quats", [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0], disc)
    edge = first("means", [-0.11, 0.0, 5.0], nearly)
    yield Case("disc edge on", "projects to a line", edge)
    yield Case("disc nearly edge on, antialiased", "small compensation", replace(nearly, antialiased=True))
    yield Case(
        "disc edge on, antialiased", "compensation near 0", replace(edge, antialiased=True), culled=(0,)
    )
    yield Case("no low-pass", "eps2d 0", scene(eps2d=0.0))
    for e in (2, 4, 6):
        thin = first("scales", [0.4, 0.4 / 10**e, 0.4 / 10**e], scene(eps2d=0.0))
        for _ in range(20):  # the axis through the centre of pixel (4, 5): else a thin one touches none
            mean = (np.array([5.5, 4.5]) + 0.3 * _image_axis(thin) - np.array([6.0, 4.5])) * 5 / 20
            thin = first("means", [*mean, 5.0], thin)
        yield Case(f"no low-pass, anisotropy 1e{e}", "det near 0", thin, ill_conditioned=e > 2)
    line = first("scales", [0.4, 0.0, 0.0], first("means", [-0.126, 0.002, 5.0]))
    yield Case("two scales 0", "det 0 before the low-pass", line)
    yield Case("all scales 0", "a point", first("scales", [0.0] * 3, first("means", [-0.126, 0.002, 5.0])))


def _image_axis(s: OracleScene) -> Array:
    """Unit direction in the image of the first axis of the first Gaussian (float64, to place cases only)."""
    w, x, y, z = s.quats[0] / np.linalg.norm(s.quats[0])
    column = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    px, py, pz = s.means[0]
    image = np.array([column[0] - px / pz * column[2], column[1] - py / pz * column[2]])
    return image / np.linalg.norm(image)


def places() -> Iterator[Case]:
    near = scene(near_plane=0.25)
    small = first("scales", [0.01, 0.02, 0.015], near)
    for name, z, gone in (
        ("at the near plane", 0.25, False),
        ("near plane + 1 ulp", 0.25 * (1 + F32_ULP), False),
        ("near plane - 1 ulp", 0.25 * (1 - F32_ULP / 2), True),
    ):
        placed = first("means", [-0.006, 0.004, z], small)
        yield Case(name, "cull before the division", placed, culled=(0,) if gone else ())
    yield Case(
        "default near plane", "depth 0.02", first("scales", [1e-3] * 3, first("means", [0.0, 0.0, 0.02]))
    )
    yield Case("behind the camera", "z < 0", first("means", [0.1, 0.1, -5.0]), culled=(0,))
    yield Case("on the camera centre", "no depth, no direction", first("means", [0.0] * 3), culled=(0,))
    far = first("scales", [4e6, 7e6, 5e6], first("means", [-2e6, 1e6, 1e8]))
    yield Case("depth 1e8", "far, large", far)
    yield Case("depth 1e8, small", "far, below a pixel", first("scales", [1.0, 2.0, 1.5], far))
    beyond = first("means", [0.0, 0.0, 2e10])
    yield Case("behind the far plane", "z > 1e10", beyond, culled=(0,))
    aside = first("scales", [3.0, 2.0, 2.0], first("means", [6.0, -1.0, 5.0]))
    yield Case("beside the image", "the clamp of the Jacobian is active", aside)
    means = scene().means * np.array([[1e-6 / 5], [1e6 / 6]])
    depths = scene(means=means, scales=scene().scales * np.array([[1e-6 / 5], [1e6 / 6]]), near_plane=1e-7)
    yield Case("depths 1e-6 to 1e6", "range of the sort keys", depths)
    same = scene().means + 0.0
    same[1, 2] = same[0, 2]
    yield Case("equal depths", "order by index", scene(means=same))
    same = same + 0.0
    same[1, 2] = same[0, 2] * (1 - F32_ULP)
    yield Case("depths 1 ulp apart", "order by depth", scene(means=same))
    offset = np.array([1e6, -2e6, 5e5])
    view = np.eye(4)
    view[:3, 3] = -offset
    yield Case("world offset 1e6", "geo-referenced", scene(means=scene().means + offset, viewmat=view))
    view = turned_view(0.4, np.array([0.3, 1.0, -0.2]), np.zeros(3))
    means = scene().means @ view[:3, :3] + offset
    view[:3, 3] = -view[:3, :3] @ offset
    turned = scene(means=means, viewmat=view)
    yield Case("world offset 1e6, turned", "R mean + t cancels 6 digits", turned)


def rotations() -> Iterator[Case]:
    base = scene().quats[0]
    yield Case("quaternion 0", "no direction", first("quats", [0.0] * 4), culled=(0,))
    yield Case("quaternion 1e-20", "norm^2 < 1e-12", first("quats", base * 1e-20), culled=(0,))
    yield Case("quaternion 2e-6", "just long enough", first("quats", base * 2e-6))
    # norm^2 of 1e40 is Inf in f32, unless it is formed in f64
    yield Case("quaternion 1e20", "norm^2 overflows f32", first("quats", base * 1e20))
    yield Case("quaternion 1e3", "not normalised", first("quats", base * 1e3))


def opacities() -> Iterator[Case]:
    centred = first("means", [-0.125, 0.0, 5.0])  # on the centre of pixel (4, 5)
    f32_floor = float(np.float32(FLOOR))  # larger than 1/255
    yield Case("opacity 0", "log of 0", first("opacities", 0.0), culled=(0,))
    below = f32_floor * (1 - F32_ULP)
    yield Case(
        "opacity 1/255 - 1 ulp", "radius of a negative log", first("opacities", below, centred), culled=(0,)
    )
    yield Case("opacity 1/255", "float32 nearest to it", first("opacities", f32_floor, centred))
    yield Case(
        "opacity 1/255 + 1 ulp", "radius of nearly 0", first("opacities", f32_floor * (1 + F32_ULP), centred)
    )
    exact = first("opacities", FLOOR, centred)
    yield Case("opacity 1/255 in f64", "radius of exactly 0", exact, culled=(0,), culled_f32=())
    yield Case("opacity 1 - 1e-7", "cap of 0.99, no gradient", first("opacities", 1 - 1e-7, centred))
    yield Case("opacity 1", "cap of 0.99, no gradient", first("opacities", 1.0, centred))
    two = replace(centred, opacities=np.array([1.0, 1.0]))
    two.means[1, :2] = [-0.15, 0.0]
    yield Case("two capped layers", "T = 1e-4 must not hang on rounding", two)


def stack(n: int, opacity: float, seed: int = 5) -> OracleScene:
    """`n` Gaussians over a single pixel, in random order of depth."""
    rng = np.random.default_rng(seed)
    z = 2.0 + 3.0 * rng.permutation(n) / n
    return OracleScene(
        means=np.stack([0.02 * rng.standard_normal(n), 0.02 * rng.standard_normal(n), z], axis=1),
        quats=rng.standard_normal((n, 4)),
        scales=rng.uniform(2.0, 4.0, (n, 3)),  # wide: nearly the opacity everywhere
        opacities=np.full(n, opacity),
        colors=rng.uniform(0.0, 1.0, (n, 1)),
        viewmat=np.eye(4),
        K=np.array([[20.0, 0.0, 0.5], [0.0, 20.0, 0.5], [0.0, 0.0, 1.0]]),
        width=1,
        height=1,
        background=np.array([0.4]),
    )


def stacks(long: bool) -> Iterator[Case]:
    one: tuple[Pixel, ...] = ((0, 0),)
    single = scene(**{name: getattr(scene(), name)[:1] for name in GROUPS})
    yield Case("1 Gaussian", "smallest scene", single)
    thousand = stack(1_000, 0.006)

    def front(s: OracleScene) -> tuple[int, ...]:
        order = np.argsort(s.means[:, 2], kind="stable")
        return int(order[0]), int(order[7])

    yield Case("stack of 1e3", "1,000 on one pixel", thousand, pixels=one, gradients_of=front(thousand))
    opaque = stack(1_000, 0.5)
    yield Case("stack of 1e3, opaque", "stops early", opaque, pixels=one, gradients_of=front(opaque))
    if long:
        many = stack(100_000, 0.02)
        yield Case("stack of 1e5", "100,000 on one pixel", many, pixels=one, gradients_of=front(many))
        faint = stack(30_000, 0.00395)
        yield Case(
            "30,000 faint layers", "sums of many small terms", faint, pixels=one, gradients_of=front(faint)
        )


def harmonics() -> Iterator[Case]:
    rng = np.random.default_rng(8)
    for degree in (0, 1, 2, 3):
        coefficients = 0.3 * rng.standard_normal((2, 16, 3))
        coefficients[:, 0] += 1.0
        yield Case(f"SH degree {degree}", "colour and its direction gradient",
                   scene(colors=coefficients, sh_degree=degree), ordinary=True)  # fmt: skip
    big = 1e6 * rng.uniform(0.1, 1.0, (2, 16, 3))
    yield Case("SH coefficients 1e6", "large sums", scene(colors=big, sh_degree=3))
    negative = scene(colors=-np.abs(coefficients), sh_degree=0)
    yield Case("SH all below 0", "the clamp is active: no gradient", negative)
    ahead = first("means", [0.0, 0.0, 5.0], scene(colors=coefficients, sh_degree=3))
    yield Case("SH along z", "two components of the direction are 0", ahead)
    for name, axis in (("x", [0.0, 1.0, 0.0]), ("y", [1.0, 0.0, 0.0])):
        view = turned_view(math.pi / 2, np.array(axis), np.zeros(3))
        side = replace(ahead, viewmat=view, means=ahead.means @ view[:3, :3])
        yield Case(f"SH along {name}", "two components are 0", side)
    tiny = replace(ahead, means=ahead.means * 1e-10, scales=ahead.scales * 1e-10, near_plane=0.0)
    yield Case("SH, distance 5e-10", "1 / length in the direction", tiny)


def images(long: bool) -> Iterator[Case]:
    K = scene().K
    yield Case(
        "image 1x1", "smallest", scene(width=1, height=1, K=_intrinsics(20.0, 0.5, 0.5)), pixels=((0, 0),)
    )
    strip = scene(width=1, height=10_000, K=_intrinsics(20.0, 0.5, 5000.0))
    yield Case("image 1x10000", "one column", strip, pixels=((5000, 0), (4999, 0), (0, 0), (9999, 0)))
    row = scene(width=10_000, height=1, K=_intrinsics(20.0, 5000.0, 0.5))
    yield Case("image 10000x1", "one row", row, pixels=((0, 5000), (0, 4999), (0, 0), (0, 9999)))
    odd = scene(width=33, height=17, K=_intrinsics(30.0, 16.0, 8.0))
    yield Case(
        "image 33x17", "not a multiple of the tile", odd, pixels=((8, 15), (16, 32), (15, 16), (16, 15))
    )
    f = 6.0 / math.tan(math.radians(1e-3) / 2)
    narrow = scene(K=_intrinsics(f, 6.0, 4.5))
    narrow = replace(
        narrow, means=narrow.means * np.array([20 / f, 20 / f, 1.0]), scales=narrow.scales * 20 / f
    )
    yield Case("field of view 0.001 degrees", "focal length 7e5", narrow)
    wide = 6.0 / math.tan(math.radians(179) / 2)
    sides = scene(K=_intrinsics(wide, 6.0, 4.5), means=np.array([[-1.2, 0.9, 0.02], [8.0, -3.0, 1.5]]))
    yield Case("field of view 179 degrees", "focal length 0.05", sides)
    outside = K + 0.0
    outside[0, 2] = 200.0
    shifted = scene().means - np.array([[194 * 5 / 20, 0, 0], [194 * 6 / 20, 0, 0]])
    yield Case("principal point outside", "clamp follows the centre", scene(K=outside, means=shifted))
    empty = scene(**{name: getattr(scene(), name)[:0] for name in GROUPS})
    yield Case("no Gaussian", "empty tensors", empty)
    gone = scene(means=scene().means * np.array([1.0, 1.0, -1.0]))
    yield Case("all culled", "background only", gone, culled=(0, 1))
    if long:
        large = scene(width=8192, height=8192, K=_intrinsics(9000.0, 4096.0, 4096.0))
        large = replace(large, **{name: getattr(large, name)[:1] for name in GROUPS})
        yield Case(
            "image 8192x8192",
            "one Gaussian",
            large,
            pixels=((4222, 3898), (4000, 3900), (0, 0), (8191, 8191)),
        )


def _intrinsics(f: float, cx: float, cy: float) -> Array:
    return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])


def poisons() -> Iterator[Case]:
    for name in GROUPS:
        for slot in range(np.size(getattr(scene(), name)[0])):
            for label, value in (("NaN", math.nan), ("+Inf", math.inf), ("-Inf", -math.inf)):
                yield Case(
                    f"{label} in {name}[{slot}]", "not finite", _slot(name, slot, value), (0,), poison=True
                )
            gone = (0,) if name == "opacities" or (name, slot) == ("means", 2) else ()
            yield Case(f"subnormal in {name}[{slot}]", "1e-40", _slot(name, slot, 1e-40), gone)


def _slot(name: str, slot: int, value: float) -> OracleScene:
    base = scene()
    values = getattr(base, name).copy()
    values.reshape(len(values), -1)[0, slot] = value
    return replace(base, **{name: values})


def cases(long: bool = False) -> list[Case]:
    """The catalogue; `long` adds what takes minutes or gigabytes."""
    parts = (shapes(), places(), rotations(), opacities(), stacks(long), harmonics(), images(long), poisons())
    return [case for part in parts for case in part]
