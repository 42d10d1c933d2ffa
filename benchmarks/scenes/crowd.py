"""Figures that walk through the room while it is photographed."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from benchmarks.scenes.walkers import Figure, draw_figure
from hqgs.scene.builtin import textures as tx
from hqgs.scene.builtin.raycast import Ellipsoid, Material, Surface
from hqgs.scene.builtin.studio import FLOOR, rotation

TALL = (2.2, 2.7)  # world units
BEFORE, BEHIND = (1.7, 2.1), (4.8, 7.0)  # the table: depths at which they walk
OFTEN_BEFORE = 0.3  # of the walkers
ASIDE = 0.55  # of the depth, to either side: as far as the photos show


class Walker(NamedTuple):
    """A figure and its place on the floor."""

    x: float
    z: float
    yaw: float  # degrees
    height: float  # world units
    figure: Figure

    def record(self) -> dict[str, Any]:
        """As JSON values."""
        return {"x": self.x, "z": self.z, "yaw": self.yaw, "height": self.height, **self.figure._asdict()}

    def surfaces(self) -> list[Surface]:
        """The limbs, each an ellipsoid that throws no shadow: only the pixels that it covers change."""
        turn, found = rotation(yaw=self.yaw), []
        for k, limb in enumerate(self.figure.limbs()):
            (ax, ay), (bx, by) = limb.a, limb.b
            length = math.hypot(bx - ax, by - ay)
            half = np.array([limb.radius, length / 2 + limb.radius, limb.radius]) * self.height
            lean = rotation(roll=math.degrees(math.atan2(ax - bx, by - ay)))
            x, _, z = turn @ [(ax + bx) / 2 * self.height, 0, 0] + [self.x, 0, self.z]
            centre = (float(x), FLOOR + (ay + by) / 2 * self.height, float(z))
            cloth = tx.plaster(limb.colour, 40 + k, 0.7 if limb.striped else 0.2)
            shape = Ellipsoid((float(half[0]), float(half[1]), float(half[2])))
            found.append(Surface(shape, Material(cloth, (0.5, 0.5)), centre, turn @ lean, shadow=False))
        return found


def draw_walkers(rng: np.random.Generator, most: int) -> tuple[Walker, ...]:
    """0 to `most` of them, each number as likely."""
    walkers = []
    for _ in range(int(rng.integers(most + 1))):
        z = rng.uniform(*(BEFORE if rng.random() < OFTEN_BEFORE else BEHIND))
        x, yaw = rng.uniform(-ASIDE, ASIDE) * z, rng.uniform(-60, 60)
        walkers.append(Walker(x, z, yaw, rng.uniform(*TALL), draw_figure(rng)))
    return tuple(walkers)
