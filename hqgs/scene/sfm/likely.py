"""Which of many photos may show the same things, so that not each has to be matched with each."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.base.threads import of_each

LOWE_RATIO = pycolmap.FeatureMatchingOptions().sift.max_ratio  # of descriptors' distances (Lowe 2004)
MATCHED_ALL = 60  # photos; of fewer each is matched with each
COMPARED = 256  # features of a photo, the largest, that tell its partners
PARTNERS, NEXT = 20, 4  # of a photo: those that are most like it, and those that follow it
DESCRIPTOR = 512  # length of COLMAP's descriptors, whole numbers


def likely_pairs(db: pycolmap.Database, count: int, most: int = PARTNERS) -> NDArray[np.int64]:
    """Pairs [P, 2] of `count` photos, which have the numbers 1 to `count` in `db`, sorted, from 0.

    The largest features of each photo are compared with those of each other. A photo is paired with the
    `most` that most of its features fit, and the 4 next ones by name: people walk on between photos.
    The numbers are whole and below 2^24, so that no order of sums and no number of threads changes a pair.
    """
    descriptors = [_largest(db, k + 1) for k in range(count)]
    scores = np.zeros((count, count), np.int64)

    def compare(k: int) -> None:
        for j in range(k):
            alike = descriptors[k] @ descriptors[j].T
            scores[k, j] = scores[j, k] = fitting(alike, DESCRIPTOR) + fitting(alike.T, DESCRIPTOR)

    list(of_each(compare, range(count)))
    chosen = np.zeros((count, count), bool)
    best = np.argsort(-scores, axis=1, kind="stable")[:, :most]
    np.put_along_axis(chosen, best, np.take_along_axis(scores, best, axis=1) > 0, axis=1)
    chosen |= chosen.T
    first, second = np.triu_indices(count, 1)
    wanted = chosen[first, second] | (second - first <= NEXT)
    return np.stack([first[wanted], second[wanted]], axis=1)


def pairs_of_faces(count: int, faces: int, some: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    """Pairs [P, 2] of `count` faces of photos, `faces` in a row of each: all, or `some` and each with those
    of its direction in the 4 next photos. Never two of one photo, which share nothing."""
    pairs = np.stack(np.triu_indices(count, 1), axis=1)
    if some is not None:
        steps = pairs[:, 1] - pairs[:, 0]
        near = (steps % faces == 0) & (steps <= NEXT * faces)
        pairs = np.unique(np.concatenate([some, pairs[near]]), axis=0)
    photos = pairs // faces
    return pairs[photos[:, 0] != photos[:, 1]]


def _largest(db: pycolmap.Database, number: int) -> NDArray[np.float32]:
    """Descriptors [N, 128] of a photo's largest features."""
    if not db.exists_keypoints(number):
        return np.zeros((0, 128), np.float32)
    keypoints: NDArray[Any] = db.read_keypoints(number)
    area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    rows = np.argsort(-area, kind="stable")[:COMPARED]
    return np.asarray(db.read_descriptors(number).data)[rows].astype(np.float32)


def fitting(alike: NDArray[np.float32], length: int) -> int:
    """How many of the features [N] have one of another photo's [M] that fits clearly better than the rest.

    `alike` [N, M] holds products of descriptors: the squared distance is 2 (length^2 - product).
    """
    if alike.shape[0] == 0 or alike.shape[1] < 2:
        return 0
    second, first = np.partition(alike, -2, axis=1)[:, -2:].T
    return int((length**2 - first < LOWE_RATIO**2 * (length**2 - second)).sum())
