"""What renders are compared with when it is known how the photos were made: the targets of HQGS."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from hqgs.diagnosis.resolution import undo_enlargement
from hqgs.diagnosis.scene import Inspector
from hqgs.photos.formation import Operator, formation
from hqgs.photos.formula import FILM, Degradation, parse_formation, small_side
from hqgs.photos.jpeg import tables_of_quality
from hqgs.photos.pixels import as_floats
from hqgs.scene.scene import Scene, View
from hqgs.training.config import AUTO
from hqgs.training.methods.base import Target
from hqgs.training.methods.held_pixels import HeldPixels
from hqgs.training.methods.jpeg_cells import Coefficients, JpegCells

# Levels of noise that the codec of a coarse film counts as: +0.4 dB to none on four scenes under `video:36`.
FILM_NOISE = 20.0


@dataclass(frozen=True)
class FormedTarget(Target):
    """The photo as it was taken, and how a render becomes like it."""

    operator: Operator | None  # from the render to the photo
    cells: JpegCells | None  # that the photo's file leaves open
    centres: Coefficients | None  # of these cells
    held: HeldPixels | None = None  # which the mask leaves out too
    noise: float = 0.0  # of this photo: standard deviation, where 1 is white

    @property
    def kept(self) -> int:
        """Luma coefficients that the photo's file holds: those that its codec did not round to zero."""
        return 0 if self.centres is None else int(torch.count_nonzero(self.centres.luma))


class Formation:
    """How a scene's photos were made."""

    def __init__(
        self, degradation: Degradation, directions: Mapping[str, float], noises: Mapping[str, float]
    ) -> None:
        """`directions`: of each photo's motion, radians from x towards y (down), where it is known.

        `noises`: of the photos that have noise of their own, where 1 is white.
        """
        self.degradation = degradation
        kinds = {step.kind: step.value for step in degradation.steps}
        self.kinds: frozenset[str] = frozenset(kinds)
        self.noise: float = noise_of(degradation)  # standard deviation, where 1 is white
        self.factor: int = int(kinds.get("lowres") or 1)  # by which the photos were enlarged
        self._quality = int(kinds["jpeg"] or 0) if "jpeg" in kinds else None
        self.directions: Mapping[str, float] = directions
        self.noises: Mapping[str, float] = noises
        self._operators: dict[tuple[int, int, float | None], Operator | None] = {}
        self._cells: dict[tuple[int, int], JpegCells] = {}

    def target(self, view: View) -> FormedTarget:
        """Of a training view. ValueError, which names it, where the photo does not fit the formation."""
        size, direction = (view.camera.height, view.camera.width), self.directions.get(view.name)
        key = (*size, direction)
        if key not in self._operators:
            self._operators[key] = formation(self.degradation, *size, direction)
        operator = self._operators[key]
        array = np.require(_photo(view, self.factor), requirements=["C", "W"])
        if operator is not None and operator.size != array.shape[:2]:
            raise ValueError(
                f"view {view.name!r}: the photo is {list(array.shape[:2])}, but {self.degradation} of its "
                f"camera's {list(size)} px gives {list(operator.size)}"
            )
        mask = view.mask
        if mask is not None and operator is not None:
            mask = operator.mask(mask)
        cells = centres = None
        if self._quality is not None:
            height, width = array.shape[:2]
            if (height, width) not in self._cells:
                self._cells[height, width] = JpegCells(tables_of_quality(self._quality), height, width)
            cells = self._cells[height, width]
            centres = cells.centres(torch.from_numpy(as_floats(array)))
        return FormedTarget(
            torch.from_numpy(array),
            None if mask is None else torch.from_numpy(mask),
            operator,
            cells,
            centres,
            noise=self.noises.get(view.name, self.noise),
        )


def noise_of(degradation: Degradation) -> float:
    """Standard deviation of the photos' noise, where 1 is white; of a coarse film what its codec left."""
    if {step.kind for step in degradation.steps} == FILM:
        return FILM_NOISE / 255
    return next((step.value or 0.0 for step in degradation.steps if step.kind == "noise"), 0.0) / 255


def find_formation(scene: Scene, text: str, inspector: Inspector) -> Formation:
    """The formation that `text` names, with "auto" the diagnosed one."""
    degradation = parse_formation(inspector.diagnose(scene).formation if text == AUTO else text)
    kinds = {step.kind for step in degradation.steps}
    directions = _motion_directions(scene, inspector) if "motion" in kinds else {}
    noises = _noises(scene, inspector) if "grain" in kinds else {}
    return Formation(degradation, directions, noises)


def _motion_directions(scene: Scene, inspector: Inspector) -> dict[str, float]:
    """Radians by photo, for those that tell one."""
    return {
        photo.name: math.radians(photo.blur.direction)
        for photo in inspector.diagnose(scene, max_photos=len(scene.train)).photos
        if photo.blur is not None and photo.blur.direction is not None
    }


def _noises(scene: Scene, inspector: Inspector) -> dict[str, float]:
    """Standard deviations by photo, where 1 is white, of those whose noise is told from texture."""
    return {
        photo.name: noise / 255
        for photo in inspector.diagnose(scene, max_photos=len(scene.train)).photos
        if (noise := photo.told_noise) is not None
    }


def _photo(view: View, factor: int) -> NDArray[np.uint8] | NDArray[np.float32]:
    """The photo as it was taken: the small one where it was enlarged by `factor`."""
    if factor == 1:
        return view.image
    if view.low is not None:
        return view.low
    size = (small_side(side, factor) for side in view.image.shape[:2])
    return undo_enlargement(as_floats(view.image).astype(np.float64), *size).astype(np.float32)
