"""The frame in which a scene is held, beside that of its files: a unit, and a shift of the origin.

Training and rendering round to float32, and a few of their bounds (the near plane, say) are lengths. A scene
in millimetres, or one whose origin lies 5,000 km away, would suffer from both. On load it is brought near the
origin and to an ordinary size, by a power of two, which changes no bit of its digits; what is written goes
back to the frame of the files. A scene of an ordinary size and place stays as it is.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.scene.constants import ONE_PLACE, SMALLEST, USUAL
from hqgs.scene.georeference import Georeference

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class World:
    """Coordinates of the files are `unit * x + shift` of those in memory.

    Where the length of a metre was told, what is written is in metres, and unit and shift lead to those.
    """

    unit: float = 1.0  # a power of two, times `metres`
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    metres: float | None = None  # that a unit of the files that were read has; None: nobody knows
    up: tuple[float, float, float] | None = None  # unit, in both frames; None: nothing told but the cameras
    place: Georeference | None = None  # on Earth, of what is written; None: nothing tells

    @property
    def ordinary(self) -> bool:
        """Whether both frames are one."""
        return self.unit == 1 and not any(self.shift)

    @property
    def frame(self) -> tuple[float, tuple[float, float, float], float]:
        """Of two worlds with the same one, coordinates in memory mean the same."""
        return self.unit, self.shift, self.metres or 1.0

    def out(self, points: Array) -> Array:
        """Points [..., 3] in the frame of the files, float64; themselves where that is the same."""
        return points if self.ordinary else points.astype(np.float64) * self.unit + self.shift

    def into(self, points: Array) -> Array:
        """Points [..., 3] of the files in the scene's frame, float64; themselves where that is the same."""
        return points if self.ordinary else (points.astype(np.float64) - self.shift) / self.unit

    def unlike(self, other: World) -> float:
        """What lengths of this frame's files are multiplied by in those of another one."""
        return (other.metres or 1.0) / (self.metres or 1.0)

    def to(self, other: World, points: Array) -> Array:
        """Points [..., 3] held in this frame, in another one of the same scene."""
        return other.into(self.unlike(other) * self.out(points))

    def viewmat_to(self, other: World, viewmat: NDArray[np.float64]) -> NDArray[np.float64]:
        """A world-to-camera matrix [4, 4] of this frame for another one of the same scene."""
        moved = self.viewmat_out(viewmat).copy()
        moved[:3, 3] *= self.unlike(other)
        return other.viewmat_into(moved)

    def viewmat_out(self, viewmat: NDArray[np.float64]) -> NDArray[np.float64]:
        """A world-to-camera matrix [4, 4] for the frame of the files; its camera's units are theirs."""
        if self.ordinary:
            return viewmat
        moved = viewmat.copy()
        moved[:3, 3] = self.unit * viewmat[:3, 3] - viewmat[:3, :3] @ np.array(self.shift)
        return moved

    def viewmat_into(self, viewmat: NDArray[np.float64]) -> NDArray[np.float64]:
        """A world-to-camera matrix [4, 4] of the files for the scene's frame."""
        if self.ordinary:
            return viewmat
        moved = viewmat.copy()
        moved[:3, 3] = (viewmat[:3, 3] + viewmat[:3, :3] @ np.array(self.shift)) / self.unit
        return moved

    def json(self) -> dict[str, Any]:
        """As JSON values."""
        known: dict[str, Any] = {"metres": self.metres}
        known["up"] = None if self.up is None else [*self.up]
        known["place"] = None if self.place is None else asdict(self.place)
        told = {name: value for name, value in known.items() if value is not None}
        return {"unit": self.unit, "shift": [*self.shift], **told}

    @classmethod
    def of_json(cls, value: Any) -> World:
        """What `json` gave. ValueError for anything else."""
        try:
            unit, shift = float(value["unit"]), tuple(float(x) for x in value["shift"])
            metres = float(value["metres"]) if "metres" in value else None
            up = tuple(float(x) for x in value["up"]) if "up" in value else None
            place = Georeference(**value["place"]) if "place" in value else None
        except (TypeError, KeyError, ValueError, OverflowError) as error:
            raise ValueError(f"not a unit and shift of a world: {value!r:.80}") from error
        known = metres is None or 0 < metres < math.inf
        known = known and (up is None or (len(up) == 3 and abs(math.hypot(*up) - 1) < 1e-6))
        if not (0 < unit < math.inf and known) or len(shift) != 3 or not all(map(math.isfinite, shift)):
            raise ValueError(f"not a unit and shift of a world: {value!r:.80}")
        upward = None if up is None else (up[0], up[1], up[2])
        return cls(unit, (shift[0], shift[1], shift[2]), metres, upward, place)

    def __str__(self) -> str:
        words = []
        if self.unit != 1:
            units = "of the files' units" if self.metres is None else "m"
            words.append(f"a unit of {self.unit:g} {units}")
        if any(self.shift):
            words.append(f"the origin at {', '.join(f'{x:.15g}' for x in self.shift)}")
        return " and ".join(words) or "the frame of the files"


def middle_and_size(centers: Array, points: Array) -> tuple[Array, float]:
    """Of a scene with cameras at `centers` [C, 3] and `points` [P, 3], P may be 0.

    Its middle [3] is the cameras', a median. Its size is the median distance from there of cameras and of
    points, the larger of the two: none that lies far off moves it.
    """
    middle = np.median(centers, axis=0)
    size = float(np.median(np.linalg.norm(centers - middle, axis=1)))
    if len(points):
        size = max(size, float(np.median(np.linalg.norm(points.astype(np.float64) - middle, axis=1))))
    return middle, size


def world_for(centers: Array, points: Array) -> World:
    """The frame for a scene with cameras at `centers` [C, 3] and `points` [P, 3], P may be 0."""
    middle, size = middle_and_size(centers, points)
    if not ONE_PLACE * float(np.abs(middle).max()) < size < math.inf:
        return World()
    shift = (0.0, 0.0, 0.0)
    if np.abs(middle).max() > 16 * size:  # before float32 is 1e-3 of 1,000 px off
        step = 10.0 ** math.ceil(math.log10(size))
        x, y, z = (round(float(value) / step) * step for value in middle)
        shift = (x, y, z)
    unit = 1.0 if SMALLEST <= size < 256 else 2.0 ** round(math.log2(size / USUAL))
    return World(unit, shift)
