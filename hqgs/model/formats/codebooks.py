"""Few values, or sets of values, that stand for many: what formats with codebooks are written with."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

CODES = 256  # values of a codebook
ROUNDS = 8  # of Lloyd's algorithm
Array = NDArray[np.float64]


def codebook(values: NDArray[np.floating]) -> tuple[Array, NDArray[np.uint8]]:
    """256 values, ascending, by Lloyd's algorithm, and for each of those given the nearest, in its shape."""
    flat = values.astype(np.float64).ravel()
    if not flat.size:
        return np.zeros(CODES), np.zeros(values.shape, np.uint8)
    # Where to begin: half of them where there are many values, half evenly over their range.
    ends = np.linspace(flat.min(), flat.max(), CODES // 2)
    book = np.sort(np.concatenate([np.quantile(flat, (np.arange(CODES // 2) + 0.5) / (CODES // 2)), ends]))
    for _ in range(ROUNDS):
        codes = np.searchsorted((book[1:] + book[:-1]) / 2, flat)
        counts = np.bincount(codes, minlength=CODES)
        sums = np.bincount(codes, flat, CODES)
        book = np.sort(np.where(counts > 0, sums / np.maximum(counts, 1), book))
    book = book.astype(np.float32).astype(np.float64)  # as readers hold them
    return book, np.searchsorted((book[1:] + book[:-1]) / 2, flat).astype(np.uint8).reshape(values.shape)


def palette(rows: NDArray[np.floating], weights: Array, wanted: int) -> tuple[Array, NDArray[np.int64]]:
    """Up to `wanted` sets of values [P, D] that stand for the rows [N, D], and each row's number [N]; N > 0.

    k-means twice: of all rows, then in each cluster with its part of the sets, by how far its rows scatter:
    so a row is compared with few. `weights` [N], above 0, say how much a row counts in its set.
    """
    rows = rows.astype(np.float64)
    coarse = _kmeans(rows, round(wanted**0.5))
    members = [np.flatnonzero(coarse == k) for k in np.unique(coarse)]
    scatter = [np.square(rows[m] - rows[m].mean(0)).sum(1) @ weights[m] for m in members]
    shares = np.cumsum(scatter) / max(np.sum(scatter), np.finfo(np.float64).tiny)
    counts = 1 + np.diff(np.rint(shares * (wanted - len(members))).astype(int), prepend=0)
    labels, found = np.zeros(len(rows), np.int64), 0
    for m, count in zip(members, counts, strict=True):
        numbers, labels[m] = np.unique(_kmeans(rows[m], count), return_inverse=True)
        labels[m] += found
        found += len(numbers)
    totals = np.bincount(labels, weights, found)
    return np.stack([np.bincount(labels, weights * c, found) / totals for c in rows.T], axis=1), labels


def _kmeans(rows: Array, count: int) -> NDArray[np.int64]:
    """The number of each row's cluster, of at most `count`."""
    from scipy.cluster.vq import kmeans2  # here: to read a file needs no scipy

    centers = np.unique(rows[np.linspace(0, len(rows) - 1, max(1, count)).astype(int)], axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of clusters that became empty
        return kmeans2(rows, centers, iter=ROUNDS, minit="matrix", missing="warn")[1]
