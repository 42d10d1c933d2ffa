"""Whether photos show what a model says that they should: a check of their places that needs no truth.

Points that a photo should show are looked for in it by their patches: where its place says that they are,
whatever features told, and beside it, where only chance lets them agree. Photos of a part that few points
join to the rest bear each other out wherever it lies (two sides of a building look alike): there the points
of the other parts alone are looked for.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hqgs.scene.sfm.refine.patches import REACH, PatchView, fitted, read_photos, widened
from hqgs.scene.sfm.refine.tracks import read_tracks

SEARCHED = 60  # points of each photo that the others are searched for, those that most photos see
DEVIATIONS, TIMES = 3.0, 1.5  # by which more must agree at the place than beside it; the same, as a ratio
# Points that a photo must show, or share with others, to be told by them; parts share 12 and 15 with the rest
# where they are wrong, 36 and more where right.
JOINT = 20
WEAKLY_JOINT = 60  # parts that share fewer are looked for in each other: two like sides of a house share 46

BESIDE = 4 * REACH  # px of the photos that are looked at: there no patch reaches the place

Agreement = dict[str, tuple[int, int, int]]  # of a photo: points looked for, that agree, that agree beside


def agreement(model: pycolmap.Reconstruction, folder: Path) -> Agreement:
    """Of each photo with a place, how many points that it should show it shows; photos are in `folder`."""
    names, tracks = read_tracks(model)
    length = np.bincount(tracks.point, minlength=len(tracks.points))
    longest = np.zeros(len(length), bool)
    for k in range(len(names)):
        mine = tracks.point[tracks.view == k]
        longest[mine[np.argsort(-length[mine], kind="stable")[:SEARCHED]]] = True
    photos = read_photos(folder, names)
    views = [PatchView(model, name, photo) for name, photo in zip(names, photos, strict=True)]
    chosen = tracks.chosen(longest[tracks.point])
    should = chosen.xy.copy()
    for k, view in enumerate(views):
        mine = chosen.view == k
        should[mine] = view.project(chosen.points[chosen.point[mine]])[0]
    some, new = widened(views, chosen)
    part = np.zeros(len(names), np.intp)
    for k, (photos, _) in enumerate(loose_parts(model, WEAKLY_JOINT)):
        part[[names.index(name) for name in photos]] = k + 1
    own = np.zeros((part.max() + 1, len(chosen.points)), bool)
    own[part[chosen.view], chosen.point] = True
    foreign = new & ~own[part[some.view], some.point]
    some = some.more(chosen.view, chosen.point, should)
    new = np.concatenate([new, np.ones(len(should), bool)])
    foreign = np.concatenate([foreign, np.zeros(len(should), bool)])
    sizes, ratios = (np.array([getattr(v, key) for v in views])[some.view] for key in ("size", "ratio"))
    rows, axis = np.arange(len(new)), np.arange(len(new)) % 2
    shift = np.zeros(some.xy.shape)
    towards = np.where(some.xy[rows, axis] < sizes[rows, axis] / 2, BESIDE, -BESIDE)  # stays in the photo
    shift[rows, axis] = np.where(new, towards / ratios[rows, axis], 0)
    at, beside = (fitted(views, replace(some, xy=xy), new)[1] for xy in (some.xy, some.xy + shift))
    all_of_it, others = (
        np.array([np.bincount(some.view[rows & that], minlength=len(names)) for that in (new, at, beside)])
        for rows in (new, foreign)
    )
    for k in range(1, len(own)):
        mine = part == k
        looked, agreed, by_chance = others[:, mine].sum(1).tolist()
        # Within one deviation of chance: bad photos in their places show such points seldom, but more often.
        if looked >= JOINT and agreed - by_chance <= (agreed + by_chance) ** 0.5:
            all_of_it[:, mine] = others[:, mine]
    return {name: (int(a), int(b), int(c)) for name, a, b, c in zip(names, *all_of_it, strict=True)}


def confirmed(looked: int, agreed: int, beside: int) -> bool:
    """Whether a photo shows more of what it should than chance lets it; where little was looked for, no."""
    more = agreed - beside
    return more > DEVIATIONS * (agreed + beside) ** 0.5 and agreed > TIMES * beside


def loose_parts(model: pycolmap.Reconstruction, joint: int = JOINT) -> list[tuple[list[str], int]]:
    """Photos, all but those of the largest part, that share fewer than `joint` points with any others, and
    how many: inside such a part all may agree, and yet it lies where it does by a few false matches."""
    names, tracks = read_tracks(model)
    part = np.arange(len(names))
    while True:
        ones, shape = np.ones(len(tracks.view), np.int64), (part.max() + 1, len(tracks.points))
        seen = coo_matrix((ones, (part[tracks.view], tracks.point)), shape).tocsr()
        seen.data[:] = 1
        shared = (seen @ seen.T).toarray()
        np.fill_diagonal(shared, 0)
        count, joined = connected_components(shared >= joint, directed=False)
        if count < len(shared):
            part = joined[part]
            continue
        sizes = np.bincount(part)
        largest = int(np.argmax(sizes))
        among = shared.copy()  # parts beside the largest, which may join each other by fewer
        among[largest] = among[:, largest] = 0
        k, other = np.unravel_index(int(np.argmax(among)), among.shape)
        if among[k, other] <= shared[[k, other], largest].max():
            break
        part = np.unique(np.where(part == k, other, part), return_inverse=True)[1]
    loose = [k for k in range(len(sizes)) if k != largest]
    return [([names[v] for v in np.flatnonzero(part == k)], int(shared[k].max())) for k in loose]
