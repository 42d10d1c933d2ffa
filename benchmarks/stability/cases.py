"""The stiff and extreme scenes of the benchmark `stability`: cases.toml, and inputs that are not finite."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.protocol import read_toml
from benchmarks.stability.oracle import GROUPS, Array, OracleScene, Pixel
from hqgs.base.typed import build

PIXELS: tuple[Pixel, ...] = ((4, 5), (4, 6), (3, 5), (6, 8), (0, 0), (8, 11))
FILE = Path(__file__).with_suffix(".toml")
BASE = read_toml(FILE)["base"]


@dataclass(frozen=True)
class Case:
    """One scene and what is expected of it."""

    name: str
    why: str
    scene: OracleScene
    culled: tuple[int, ...] = ()  # Gaussians that must be culled; all others must not
    culled_f32: tuple[int, ...] | None = None  # where float32 inputs are another scene
    pixels: tuple[Pixel, ...] = PIXELS
    gradients_of: tuple[int, ...] | None = None  # all
    ordinary: bool = False  # float32 must be within 1e-5
    ill_conditioned: bool = False  # one ulp of the inputs changes more than the targets allow
    poison: bool = False  # not finite: no oracle, only that the others do not notice
    group: str = ""  # the table of cases.toml

    @property
    def compared(self) -> list[int]:
        """The Gaussians whose gradients are compared."""
        return list(range(len(self.scene.means)) if self.gradients_of is None else self.gradients_of)

    def expected_culled(self, dtype: str) -> tuple[int, ...]:
        """The Gaussians that must be culled in "f32" or "f64"."""
        return self.culled_f32 if dtype == "f32" and self.culled_f32 is not None else self.culled


def arrays(values: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a scene as cases.toml has them: its lists become arrays, `K` from focal length, cx, cy."""
    made = {name: np.array(value) if isinstance(value, list) else value for name, value in values.items()}
    return made | ({"K": _intrinsics(*values["K"])} if "K" in values else {})


def scene(**changes: Any) -> OracleScene:
    """Two ordinary Gaussians at depths 5 and 6 before a 12 x 9 camera of focal length 20 at the origin."""
    return OracleScene(**arrays(BASE) | changes)


def changed(
    stack: Mapping[str, Any] | None = None,
    keep: int | None = None,
    all: Mapping[str, Any] | None = None,
    sh: str | None = None,
    first: Mapping[str, Any] | None = None,
    times: Mapping[str, Any] | None = None,
    turn: Mapping[str, Any] | None = None,
) -> OracleScene:
    """The ordinary scene with the changes of cases.toml, in the order of the parameters."""
    s = scene() if stack is None else stacked(**stack)
    s = replace(s, **{name: getattr(s, name)[:keep] for name in GROUPS})
    s = replace(s, **arrays(all or {}))
    if sh is not None:
        s = replace(s, colors=harmonics()[sh])
    for name, value in (first or {}).items():
        values = getattr(s, name).copy()
        values[0] = value
        s = replace(s, **{name: values})
    s = replace(s, **{name: getattr(s, name) * np.array(value) for name, value in (times or {}).items()})
    return s if turn is None else turned(s, **turn)


def turned(
    s: OracleScene, angle: float = 0.0, axis: Any = (0, 0, 1), shift: Any = (0, 0, 0), offset: Any = (0, 0, 0)
) -> OracleScene:
    """A camera turned by `angle` radians about `axis` and shifted in a world that is moved by `offset`.

    The Gaussians keep their places before it, but not their orientations.
    """
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    view = np.eye(4)
    view[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    view[:3, 3] = shift - view[:3, :3] @ offset
    means = np.linalg.solve(view[:3, :3], (s.means - shift).T).T + offset
    return replace(s, viewmat=view, means=means)


def stacked(n: int, opacity: float, seed: int = 5) -> OracleScene:
    """`n` Gaussians over a single pixel, in random order of depth."""
    rng = np.random.default_rng(seed)
    z = 2.0 + 3.0 * rng.permutation(n) / n
    return scene(
        means=np.stack([0.02 * rng.standard_normal(n), 0.02 * rng.standard_normal(n), z], axis=1),
        quats=rng.standard_normal((n, 4)),
        scales=rng.uniform(2.0, 4.0, (n, 3)),  # wide: nearly the opacity everywhere
        opacities=np.full(n, opacity),
        colors=rng.uniform(0.0, 1.0, (n, 1)),
        K=_intrinsics(20.0, 0.5, 0.5),
        width=1,
        height=1,
        background=np.array([0.4]),
    )


@cache
def harmonics() -> dict[str, Array]:
    """Coefficients [2, 16, 3] of the two Gaussians, by name."""
    rng = np.random.default_rng(8)
    found = {f"normal {k}": 0.3 * rng.standard_normal((2, 16, 3)) for k in range(4)}
    for coefficients in found.values():
        coefficients[:, 0] += 1.0
    return found | {"large": 1e6 * rng.uniform(0.1, 1.0, (2, 16, 3)), "negative": -np.abs(found["normal 3"])}


def _intrinsics(f: float, cx: float, cy: float) -> Array:
    return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])


def poisons() -> Iterator[Case]:
    """Each number of the first Gaussian not finite, or subnormal."""
    for name in GROUPS:
        for slot in range(np.size(getattr(scene(), name)[0])):
            for label, value in (("NaN", math.nan), ("+Inf", math.inf), ("-Inf", -math.inf)):
                title = f"{label} in {name}[{slot}]"
                yield Case(
                    title, "not finite", _slot(name, slot, value), (0,), poison=True, group="not finite"
                )
            gone = (0,) if name == "opacities" or (name, slot) == ("means", 2) else ()
            yield Case(
                f"subnormal in {name}[{slot}]", "1e-40", _slot(name, slot, 1e-40), gone, group="subnormal"
            )


def _slot(name: str, slot: int, value: float) -> OracleScene:
    values = getattr(scene(), name).copy()
    values.reshape(len(values), -1)[0, slot] = value
    return scene(**{name: values})


def cases(long: bool = False) -> list[Case]:
    """The catalogue; `long` adds what takes minutes or gigabytes. ValueError names a mistake in the file."""
    found, changes = [], inspect.signature(changed).parameters
    for group, tables in read_toml(FILE).items():
        if group == "base":
            continue
        for table in tables if long or group != "long" else ():
            expected = {name: value for name, value in table.items() if name not in changes}
            made = changed(**{name: value for name, value in table.items() if name in changes})
            found.append(
                build(Case, expected | {"scene": made, "group": group}, f"{FILE.name}, {table.get('name')!r}")
            )
    return [*found, *poisons()]
