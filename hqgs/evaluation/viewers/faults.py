"""Which fault a viewer's pictures show: each is imitated, and the nearest imitation names it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hqgs.evaluation.constants import APART, ROUNDED, SEARCH_ROUNDS, SEARCH_STEPS, WHOLLY
from hqgs.evaluation.viewers.plain import Floats, Ways, render
from hqgs.model.formats.arrays import Arrays
from hqgs.photos.pixels import to_uint8
from hqgs.scene.scene import Camera

RIGHT = "right"
FAR = "far clip"
ZOOM, ZOOMS = "another field of view", (0.4, 2.5)


@dataclass(frozen=True)
class Verdict:
    """What pictures show."""

    fault: str | None  # RIGHT, a fault's name, or None: none of these
    detail: str  # which form of it
    off: float  # levels, root mean square: from the right pictures
    left: float  # and from the nearest imitation
    nearest: str  # the fault of that imitation
    worst: tuple[int, int, int]  # picture, row and column that differ most from the right ones

    def __str__(self) -> str:
        if self.fault == RIGHT:
            return f"right ({self.off:.2f} levels off)"
        if self.fault is None:
            nearest = "" if self.nearest == RIGHT else f" (nearest: {self.nearest}, {self.left:.2f} left)"
            return f"{self.off:.2f} levels off, by none of the known faults{nearest}"
        form = f" ({self.detail})" if self.detail else ""
        return f"{self.fault}{form}: {self.off:.2f} levels off, {self.left:.2f} left where it is imitated"


def imitations(scene: Arrays) -> list[tuple[str, str, Ways]]:
    """Faults, their forms, and how they render; all but those of which a number is looked for."""
    flag = bool(scene.get("antialiased", False))
    order, degree = "wrong order", int(np.sqrt(scene["shN"].shape[1] + 1)) - 1
    found = [
        (RIGHT, "", Ways()),
        ("missing low-pass", "", Ways(eps2d=0.0)),
        (
            "antialias flag ignored" if flag else "antialiased without the flag",
            "",
            Ways(antialiased=not flag),
        ),
        *(("harmonics cut", f"to degree {k}", Ways(sh_degree=k)) for k in range(degree)),
        ("harmonics cut", "to degree 0, clamped to white", Ways(sh_degree=0, brightest=1.0)),
        ("harmonics clamped", "to white", Ways(brightest=1.0)),
        ("blended in linear light", "", Ways(linear=True)),
        ("8-bit accumulation", "from the front", Ways(bits="front")),
        ("8-bit accumulation", "from the back", Ways(bits="back")),
        (order, "reversed", Ways(order="reversed")),
        (order, "as in the file", Ways(order="file")),
        (order, "by distance, not depth", Ways(order="distance")),
    ]
    for form, positions in _coarse(scene["means"].astype(np.float64)).items():
        found.append(("quantised positions", form, Ways(positions=positions)))
    for form, directions in {"x": (-1, 1, 1), "y": (1, -1, 1), "z": (1, 1, -1), "all": (-1, -1, -1)}.items():
        found.append(("flipped axes", f"of the harmonics, {form}", Ways(directions=directions)))
    for form, picture in {"left to right": (1, -1), "upside down": (-1, 1), "both": (-1, -1)}.items():
        found.append(("flipped axes", f"picture {form}", Ways(picture=picture)))
    return found


def far_depths(scene: Arrays, cameras: Sequence[Camera]) -> tuple[float, float]:
    """Between which depths a far plane would be seen."""
    depths = np.concatenate([scene["means"] @ c.viewmat[2, :3] + c.viewmat[2, 3] for c in cameras])
    depths = depths[depths > 0]
    return float(np.median(depths)), float(depths.max())


def _coarse(means: Floats) -> dict[str, Callable[[Floats], Floats]]:
    """Positions as files and shaders hold them."""
    low = means.min(0)
    span = np.maximum(means.max(0) - low, 1e-12)

    def steps(bits: int) -> Callable[[Floats], Floats]:
        return lambda x: low + np.rint((x - low) / span * (2**bits - 1)) / (2**bits - 1) * span

    return {
        "16-bit floats": lambda x: x.astype(np.float16).astype(np.float64),
        **{f"{bits} bits over the scene": steps(bits) for bits in (10, 11, 12, 14, 16)},
    }


class Imitations:
    """The pictures of a scene as each fault makes them, rendered when they are asked for and kept."""

    def __init__(self, scene: Arrays, cameras: Sequence[Camera]) -> None:
        self._scene, self._cameras = scene, cameras
        self._faults = imitations(scene)
        self._kept: dict[tuple[Ways, int], NDArray[np.uint8]] = {}

    def verdict(self, pictures: Mapping[int, NDArray[np.uint8]]) -> Verdict:
        """The fault that the pictures [H, W, 3], by the number of their camera, show together.

        ValueError for one of another size than its camera's.
        """
        for number, picture in pictures.items():
            camera = self._cameras[number]
            if picture.shape != (camera.height, camera.width, 3):
                size, wanted = f"{picture.shape[1]} x {picture.shape[0]}", f"{camera.width} x {camera.height}"
                raise ValueError(
                    f"picture {number} is {size} px, its camera wants {wanted}, at one px a pixel"
                )
        first = dict([min(pictures.items(), key=lambda item: item[0])])
        best: dict[str, tuple[float, str, Ways]] = {}  # the form of each fault that is best in one picture
        for fault, form, ways in self._faults:
            left = self._left(ways, first)
            if fault not in best or left < best[fault][0]:
                best[fault] = left, form, ways
        if min(left for left, _, _ in best.values()) > ROUNDED:  # or else nothing is left to look for
            far = far_depths(self._scene, self._cameras)
            best[FAR] = self._search("at {:.3g}", lambda value: Ways(far=value), far, pictures)
            best[ZOOM] = self._search("focal lengths x {:.3g}", lambda value: Ways(zoom=value), ZOOMS, first)
        lefts = {fault: self._left(ways, pictures) for fault, (_, _, ways) in best.items()}
        off, nearest = lefts[RIGHT], min(lefts, key=lambda fault: lefts[fault])
        left = lefts[nearest]
        others = [one for fault, one in lefts.items() if fault not in (nearest, RIGHT)]
        fault = nearest if nearest != RIGHT and left <= min(WHOLLY * off, APART * min(others)) else None
        if off <= ROUNDED:
            fault = RIGHT
        return Verdict(fault, best[nearest][1], off, left, nearest, self._worst(pictures))

    def _search(
        self,
        words: str,
        ways: Callable[[float], Ways],
        between: tuple[float, float],
        pictures: Mapping[int, NDArray[np.uint8]],
    ) -> tuple[float, str, Ways]:
        """The form of a fault with the best value: looked for closer and closer around the best."""
        low, high = between
        found: list[tuple[float, float]] = []
        for _ in range(SEARCH_ROUNDS):
            steps = np.geomspace(low, high, SEARCH_STEPS + 2).tolist()
            tried = [(self._left(ways(value), pictures), value) for value in steps[1:-1]]
            found.append(min(tried))
            middle = tried.index(found[-1]) + 1
            low, high = steps[middle - 1], steps[middle + 1]
        left, value = min(found)
        return left, words.format(value), ways(value)

    def _left(self, ways: Ways, pictures: Mapping[int, NDArray[np.uint8]]) -> float:
        """Levels, root mean square, between pictures and an imitation."""
        apart = [np.square(self._apart(ways, number, shot)).mean() for number, shot in pictures.items()]
        return float(np.sqrt(np.mean(apart)))

    def _apart(self, ways: Ways, number: int, picture: NDArray[np.uint8]) -> Floats:
        if (ways, number) not in self._kept:
            made = render(self._scene, self._cameras[number], ways)
            self._kept[ways, number] = to_uint8(made.astype(np.float32))
        return picture.astype(np.float64) - self._kept[ways, number]

    def _worst(self, pictures: Mapping[int, NDArray[np.uint8]]) -> tuple[int, int, int]:
        found = []
        for number, picture in pictures.items():
            apart = np.abs(self._apart(Ways(), number, picture)).sum(-1)
            row, column = np.unravel_index(int(apart.argmax()), apart.shape)
            found.append((float(apart.max()), (number, int(row), int(column))))
        return max(found)[1]
