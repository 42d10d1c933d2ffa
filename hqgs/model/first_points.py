"""More points to start from: between those of the reconstruction, along the photos' edges."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import sobel
from scipy.spatial import KDTree

from hqgs.base.stages import OnStage, Stage, silent
from hqgs.model.consistency import Agreement, SmallPhoto
from hqgs.model.constants import AROUND, FLAT, LEAST_AROUND, STRAY, WIDENED
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.geometry import project, unproject
from hqgs.scene.scene import View

Points = NDArray[np.float32]
Colors = NDArray[np.uint8]
Floats = NDArray[np.float64]
Found = tuple[int, Floats, Floats]  # the number of a view, pixels [M, 2] of it, and their depths [M]
STAGE = "first points, from photos"


def points_along_edges(
    views: Sequence[View],
    points: Points,
    seen: Mapping[str, NDArray[np.intp]],
    count: int,
    seed: int,
    agreement: Agreement,
    on_stage: OnStage = silent,
) -> tuple[Points, Colors, float]:
    """About `count` points [M, 3] (world) under pixels of the photos, and those pixels' colours [M, 3];
    and the share of so many that it found.

    Each view gets an equal share. Pixels are drawn without repetition, most of them in proportion to the
    photo's edges. Their depths are sought around those of the nearest points that the view sees, where other
    photos agree best. Views that see fewer than 3 points get none.

    Args:
        views: with cameras and photos; masked pixels are not drawn.
        points: [P, 3], world.
        seen: by the view's name, which rows of `points` it sees; a view that is not there sees none.
        count: at least 0.
        seed: of the draw. Each view has its own numbers, whatever the others are.
        agreement: of the same views: how they are looked at; it tells the depths, and points that it does
            not find are left out.
        on_stage: hears of each view.
    """
    found = list[Found]()
    for each in first_look(Surfaces(views, points, seen), shares(count, len(views)), seed, agreement):
        found.append(each)
        on_stage(Stage(STAGE, len(found), len(views)))
    agreeing = sum(len(depths) for _, _, depths in found)
    return *gathered(views, found), agreeing / max(count, 1)


def shares(count: int, views: int) -> list[int]:
    """So many points, shared out to the views equally."""
    return [count * (k + 1) // views - count * k // views for k in range(views)]


def first_look(surfaces: Surfaces, counts: Sequence[int], seed: int, agreement: Agreement) -> Iterator[Found]:
    """Of each view those of so many pixels at which others agree; none where too little is known."""
    for k, share in enumerate(counts):
        if not share or not surfaces.known(k):
            yield k, np.zeros((0, 2)), np.zeros(0)
            continue
        pixels = drawn(agreement.looks[k], share, np.random.default_rng([seed, k]))
        depths, agreed = agreement.depths(k, pixels, surfaces.ranges(k, pixels))
        yield k, pixels[agreed], depths[agreed]


class Surfaces:
    """Where the surfaces are that each view shows, as far as that is known."""

    def __init__(self, views: Sequence[View], points: Points, seen: Mapping[str, NDArray[np.intp]]) -> None:
        """Of points [P, 3], world, of which `seen` tells by the view's name what rows it sees."""
        self._pixels, self._depths = list[Floats](), list[Floats]()
        for view in views:
            rows = seen.get(view.name, np.zeros(0, np.intp))
            pixels, depths = project(view.camera, points[rows].astype(np.float64))
            self._pixels.append(pixels[depths > 0])
            self._depths.append(depths[depths > 0])

    def known(self, number: int) -> bool:
        """Whether enough is known of a view to tell ranges."""
        return len(self._depths[number]) >= LEAST_AROUND

    def add(self, number: int, pixels: Floats, depths: Floats) -> None:
        """More pixels [M, 2] of a view, and their depths [M]."""
        self._pixels[number] = np.concatenate([self._pixels[number], pixels])
        self._depths[number] = np.concatenate([self._depths[number], depths])

    def ranges(self, number: int, pixels: Floats, widened: float = WIDENED) -> Floats:
        """Between which depths [M, 2] the surface at `pixels` [M, 2] is sought: those of what is known
        nearest in the picture, times and over `widened`."""
        depths = self._depths[number]
        _, nearest = KDTree(self._pixels[number]).query(pixels, min(AROUND, len(depths)))
        around = depths[nearest]
        return np.stack([around.min(1) / widened, around.max(1) * widened], axis=1)

    def bounds(self, number: int) -> Floats:
        """The nearest and the farthest depth [2] at which anything of a view is sought, but for strays."""
        ends = np.quantile(self._depths[number], (STRAY, 1 - STRAY)) if self.known(number) else np.ones(2)
        return ends * (1 / WIDENED, WIDENED)


def gathered(views: Sequence[View], found: Sequence[Found]) -> tuple[Points, Colors]:
    """Points [M, 3] (world) under pixels of views at their depths, and those pixels' colours [M, 3]."""
    points, colors = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)]
    for number, pixels, depths in found:
        points.append(unproject(views[number].camera, pixels, depths).astype(np.float32))
        columns, lines = pixels.astype(np.intp).T
        colors.append(to_uint8(as_floats(views[number].image[lines, columns])))
    return np.concatenate(points), np.concatenate(colors)


def drawn(look: SmallPhoto, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Centres [M, 2] of pixels of the view as x, y; M is `count`, or fewer where so many do not count."""
    grey = look.grey
    mask = np.ones(grey.shape, bool) if look.mask is None else look.mask
    edges = np.where(mask, np.hypot(sobel(grey, 0), sobel(grey, 1)), 0.0)
    weights = np.where(mask, FLAT / max(mask.sum(), 1), 0.0)
    weights += (1 - FLAT) * edges / max(edges.sum(), np.finfo(float).tiny)
    weights = weights.ravel()
    count = min(count, int(np.count_nonzero(weights)))
    # The largest of u^(1 / w): a draw without repetition in proportion to w (Efraimidis and Spirakis 2006).
    with np.errstate(divide="ignore"):
        keys = np.log(rng.random(weights.size)) / weights
    chosen = np.sort(np.argpartition(-keys, max(count - 1, 0))[:count])
    lines, columns = np.divmod(chosen, look.camera.width)
    return (np.stack([columns, lines], 1) + 0.5) / look.scale
