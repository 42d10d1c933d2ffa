"""More points to start from, between those of the reconstruction: pixels at depths on which photos agree.

Taken is what two other photos agree on. Of few photos it is sought twice: what is found at first, and found
back by other photos, tells more closely where to look; so does it where no two others agree, and one alone
must. Numbers were chosen on held-back photos.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, sobel
from scipy.sparse import csr_array
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from hqgs import _rust
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.threads import of_each
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.geometry import in_frame, project, shrunk, unproject
from hqgs.scene.scene import Camera, View

AGREEING, AGREED = 2, 0.6  # photos that must agree, and the correlation of patches
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SmallPhoto:
    """A photo as it is looked at: small, in one channel, smoothed."""

    camera: Camera  # of this size
    grey: NDArray[np.float32]  # [h, w]
    mask: NDArray[np.bool_] | None  # [h, w], as that of a view
    scale: Floats  # [2]: what takes a pixel (x, y) of the view to one of this photo

    @classmethod
    def of(cls, view: View, longest: int = 800) -> SmallPhoto:
        whole = view.camera
        view = shrunk(view, longest)
        camera, grey = view.camera, as_floats(view.image).mean(2, dtype=np.float32)
        smooth = np.ascontiguousarray(gaussian_filter(grey, 1.0), np.float32)
        scale = np.array([camera.width / whole.width, camera.height / whole.height])
        return cls(camera, smooth, view.mask, scale)


class Agreement:
    """The training photos as they are asked."""

    def __init__(self, views: Sequence[View], seen: Mapping[str, NDArray[np.intp]]) -> None:
        """`seen`: by the view's name, which points it sees. Views that share most are asked first, but of
        those from one place, as of a burst, one."""
        self.looks: list[SmallPhoto] = list(of_each(SmallPhoto.of, views))
        rows = [np.unique(seen.get(view.name, np.zeros(0, np.intp))) for view in views]
        ends = np.cumsum([0, *map(len, rows)])
        points = 1 + max((int(some[-1]) for some in rows if len(some)), default=0)
        sees = csr_array((np.ones(ends[-1], np.intp), np.concatenate(rows), ends), (len(views), points))
        self._shared: NDArray[np.intp] = (sees @ sees.T).toarray()
        np.fill_diagonal(self._shared, -1)
        centers = np.stack([view.camera.center for view in views])
        far = cdist(centers, centers)
        self._apart: NDArray[np.bool_] = far > 0.01 * np.median(far)  # nearer ones are from one place

    def asked(self, number: int, most: int = 4) -> list[int]:
        """Numbers of the photos that share most points with a view, at most so many, and apart from it."""
        order = [int(k) for k in np.argsort(-self._shared[number], kind="stable") if self._apart[number, k]]
        first = list[int]()
        for k in order:
            if len(first) == most:
                break
            if self._apart[k, first].all():
                first.append(k)
        return (first + [k for k in order if k not in first])[:most]

    def depths(
        self, number: int, pixels: Floats, ranges: Floats, others: Sequence[int] | None = None
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Depths [M] of pixels [M, 2] of a view, each within its range [M, 2], and where others agree.

        `others`: who is asked, None: `asked`.
        """
        others = self.asked(number) if others is None else others
        if len(others) < AGREEING:
            return ranges[:, 0], np.zeros(len(ranges), bool)
        depths, scores = self._swept(number, pixels, ranges, others, AGREEING)
        return depths, scores >= AGREED

    def depths_by(self, number: int, pixels: Floats, ranges: Floats, other: int) -> tuple[Floats, Floats]:
        """Depths [M] as `depths` has them by one other photo alone, and the correlations [M]; -1: none."""
        return self._swept(number, pixels, ranges, [other], 1)

    def _swept(
        self, number: int, pixels: Floats, ranges: Floats, others: Sequence[int], agreeing: int
    ) -> tuple[Floats, Floats]:
        look = self.looks[number]
        return _rust.agreed_depths(
            look.grey,
            [self.looks[k].grey for k in others],
            np.stack([pixel_map(look.camera, self.looks[k].camera) for k in others]),
            np.ascontiguousarray(pixels * look.scale),
            np.ascontiguousarray(ranges),
            agreeing,
        )


def pixel_map(first: Camera, second: Camera) -> Floats:
    """The matrix [3, 4] that takes (x, y, 1, 1 / depth) of a pixel of the first camera to the second's."""
    relative = second.viewmat @ np.linalg.inv(first.viewmat)
    turn = second.K @ relative[:3, :3] @ np.linalg.inv(first.K)
    return np.concatenate([turn, (second.K @ relative[:3, 3])[:, None]], 1)


WIDENED = 1.6  # what widens a range of depths between points around a pixel
ALONE = 0.8  # the correlation that one photo alone must have
STAGE = "first points, from photos"

Points = NDArray[np.float32]
Colors = NDArray[np.uint8]
Found = tuple[int, Floats, Floats]  # the number of a view, pixels [M, 2] of it, and their depths [M]


def points_along_edges(
    views: Sequence[View],
    points: Points,
    seen: Mapping[str, NDArray[np.intp]],
    count: int,
    seed: int,
    agreement: Agreement,
    on_stage: OnStage = silent,
    found_back: bool = False,
) -> tuple[Points, Colors, float]:
    """About `count` points [M, 3] (world) under pixels of the photos, and those pixels' colours [M, 3];
    and the share of a first look at so many pixels at which photos agree.

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
        found_back: look a second time, around what two others find back of the first look. A pixel counts
            where two others agree and one of them finds it back, or where one alone agrees much and finds it
            back: at the depth that it has there, within a pixel.
    """
    surfaces, each = Surfaces(views, points, seen), shares(count, len(views))
    looks, agreeing, found = (1 + found_back) * len(views), 0, list[Found]()

    def first(number: int) -> tuple[int, Found]:
        _, pixels, depths = first_look(surfaces, number, each[number], seed, agreement)
        kept = np.ones(len(depths), bool)
        if found_back:
            asked = agreement.asked(number)
            kept = _found_back(agreement, surfaces, number, pixels, depths, asked, 2)
        return len(depths), (number, pixels[kept], depths[kept])

    def second(number: int) -> Found:
        if not each[number] or not surfaces.known(number):
            return number, np.zeros((0, 2)), np.zeros(0)
        rng = np.random.default_rng([seed, number, 1])
        pixels = drawn(agreement.looks[number], each[number], rng)
        depths, kept = _borne_out(agreement, surfaces, number, pixels)
        return number, pixels[kept], depths[kept]

    for agreed, one in of_each(first, range(len(views))):
        agreeing += agreed
        found.append(one)
        on_stage(Stage(STAGE, len(found), looks))
    if found_back:
        for one in found:
            surfaces.add(*one)
        found = list[Found]()
        for one in of_each(second, range(len(views))):
            found.append(one)
            on_stage(Stage(STAGE, len(views) + len(found), looks))
    return *gathered(views, found), agreeing / max(count, 1)


def shares(count: int, views: int) -> list[int]:
    """So many points, shared out to the views equally."""
    return [count * (k + 1) // views - count * k // views for k in range(views)]


def first_look(surfaces: Surfaces, number: int, count: int, seed: int, agreement: Agreement) -> Found:
    """Of a view those of so many pixels at which others agree; none where too little is known."""
    if not count or not surfaces.known(number):
        return number, np.zeros((0, 2)), np.zeros(0)
    pixels = drawn(agreement.looks[number], count, np.random.default_rng([seed, number]))
    depths, agreed = agreement.depths(number, pixels, surfaces.ranges(number, pixels))
    return number, pixels[agreed], depths[agreed]


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
        self._trees: list[KDTree | None] = [None] * len(views)

    def known(self, number: int) -> bool:
        """Whether enough is known of a view to tell ranges."""
        return len(self._depths[number]) >= 3

    def add(self, number: int, pixels: Floats, depths: Floats) -> None:
        """More pixels [M, 2] of a view, and their depths [M]."""
        self._pixels[number] = np.concatenate([self._pixels[number], pixels])
        self._depths[number] = np.concatenate([self._depths[number], depths])
        self._trees[number] = None

    def ranges(self, number: int, pixels: Floats, widened: float = WIDENED) -> Floats:
        """Between which depths [M, 2] the surface at `pixels` [M, 2] is sought: those of what is known
        nearest in the picture, times and over `widened`."""
        depths = self._depths[number]
        tree = self._trees[number] or KDTree(self._pixels[number])
        self._trees[number] = tree
        _, nearest = tree.query(pixels, min(6, len(depths)))
        around = depths[nearest]
        return np.stack([around.min(1) / widened, around.max(1) * widened], axis=1)


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
    weights = np.where(mask, 0.2 / max(mask.sum(), 1), 0.0)  # all pixels alike get a fifth
    weights += 0.8 * edges / max(edges.sum(), np.finfo(float).tiny)
    weights = weights.ravel()
    count = min(count, int(np.count_nonzero(weights)))
    # The largest of u^(1 / w): a draw without repetition in proportion to w (Efraimidis and Spirakis 2006).
    with np.errstate(divide="ignore"):
        keys = np.log(rng.random(weights.size)) / weights
    chosen = np.sort(np.argpartition(-keys, max(count - 1, 0))[:count])
    lines, columns = np.divmod(chosen, look.camera.width)
    return (np.stack([columns, lines], 1) + 0.5) / look.scale


def _borne_out(
    agreement: Agreement, surfaces: Surfaces, number: int, pixels: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Depths [M] of a view's pixels [M, 2], and which of them others bear out."""
    others = agreement.asked(number, 8)
    depths, kept = agreement.depths(number, pixels, surfaces.ranges(number, pixels, 1.15), others)
    kept[kept] = _found_back(agreement, surfaces, number, pixels[kept], depths[kept], others, 1)
    best, ranges = np.full(len(pixels), ALONE), surfaces.ranges(number, pixels)
    for other in others:
        rows = np.flatnonzero(~kept)
        there, scores = agreement.depths_by(number, pixels[rows], ranges[rows], other)
        better = scores > best[rows]
        rows, there, scores = rows[better], there[better], scores[better]
        back = _seen_alike(agreement, number, other, pixels[rows], there)
        rows = rows[back]
        depths[rows], best[rows] = there[back], scores[back]
    return depths, kept | (best > ALONE)


def _found_back(
    agreement: Agreement,
    surfaces: Surfaces,
    number: int,
    pixels: Floats,
    depths: Floats,
    others: Sequence[int],
    wanted: int,
) -> NDArray[np.bool_]:
    """Whether at least `wanted` of the others find pixels [M, 2] of a view back from `depths`."""
    counts = np.zeros(len(pixels), np.intp)
    for other in others:
        rows = np.flatnonzero(counts < wanted)
        if not surfaces.known(other) or not len(rows):
            continue
        at, far, inside = _shown(agreement, number, other, pixels[rows], depths[rows])
        rows, at, far = rows[inside], at[inside], far[inside]
        ranges = surfaces.ranges(other, at)
        ranges = np.stack(
            [np.minimum(ranges[:, 0], far / WIDENED), np.maximum(ranges[:, 1], far * WIDENED)], 1
        )
        there, agreed = agreement.depths(other, at, ranges)
        counts[rows] += agreed & _back(agreement, number, other, pixels[rows], at, there)
    return counts >= wanted


def _seen_alike(
    agreement: Agreement, number: int, other: int, pixels: Floats, depths: Floats
) -> NDArray[np.bool_]:
    """Whether the other photo, by the view alone, finds its pixels [M, 2] at `depths` back."""
    at, far, inside = _shown(agreement, number, other, pixels, depths)
    rows = np.flatnonzero(inside)
    ranges = np.stack([far[rows] / WIDENED, far[rows] * WIDENED], 1)
    there, scores = agreement.depths_by(other, at[rows], ranges, number)
    inside[rows] = (scores > ALONE) & _back(agreement, number, other, pixels[rows], at[rows], there)
    return inside


def _shown(
    agreement: Agreement, number: int, other: int, pixels: Floats, depths: Floats
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Where the other photo shows pixels [M, 2] of a view at `depths`, how far away, and whether."""
    look, camera = agreement.looks[number], agreement.looks[other].camera
    points = unproject(look.camera, pixels * look.scale, depths)
    at, far = project(camera, points)
    return at / agreement.looks[other].scale, far, in_frame(camera, points)


def _back(
    agreement: Agreement, number: int, other: int, pixels: Floats, at: Floats, depths: Floats
) -> NDArray[np.bool_]:
    """Whether pixels `at` [M, 2] of the other photo, at `depths`, lie where the view has its `pixels`."""
    look, there = agreement.looks[number], agreement.looks[other]
    again, _ = project(look.camera, unproject(there.camera, at * there.scale, depths))
    return np.linalg.norm(again - pixels * look.scale, axis=1) < 1.0
