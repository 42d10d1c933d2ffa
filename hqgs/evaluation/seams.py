"""Seams: where one part of a merged scene takes over from another in a picture, and how good it is there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from hqgs.evaluation.metrics import psnr, psnr_aligned
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import composited
from hqgs.scene.scene import Camera, View

Metric = Callable[[NDArray[Any], NDArray[Any], "NDArray[np.bool_] | None"], "float | None"]
ALIGNED = "all, brightness and tint set aside"
NEAR = 8  # px on either side of a seam
LEAST = 0.01  # of a view's pixels lie beside a seam; else it shows none


@dataclass(frozen=True)
class SeamRow:
    """Some pixels of the held-out views, and the mean over the views of their PSNR, dB."""

    what: str
    views: int
    psnr: list[float | None]  # of each set of Gaussians; None: there are no such pixels


def seams(gaussians: Gaussians, parts: NDArray[np.integer], camera: Camera) -> NDArray[np.bool_]:
    """Which pixels lie within NEAR px of where another part begins, [H, W].

    `parts` [N] is the part of each of the first N Gaussians; others do not count. A pixel is that part's
    which has most of its light, taken digit by digit of the parts' binary numbers, so that 256 parts cost no
    more than 8 colours.
    """
    digits = max(1, int(parts.max(initial=0)).bit_length())
    bits = parts[:, None] >> np.arange(digits) & 1
    gaussians = gaussians.rows(torch.arange(len(parts)))
    shares, alphas = composited(gaussians, camera, torch.from_numpy(bits.astype(np.float32)))
    label = ((shares > alphas / 2).numpy() << np.arange(digits)).sum(2)
    size = 2 * NEAR + 1
    return maximum_filter(label, size) != minimum_filter(label, size)


def measure_seams(
    scenes: list[Gaussians], parts: NDArray[np.integer], views: Iterable[View]
) -> list[SeamRow]:
    """PSNR of all pixels, of views with and without a seam, and beside the seams and elsewhere.

    Args:
        scenes: the merged Gaussians, and others to compare them with, looked at in the same pixels.
        parts: [N], the part of each merged Gaussian.
        views: held-out ones; they are taken one after the other.
    """
    rows: dict[str, list[list[float | None]]] = {
        name: []
        for name in (
            "all",
            ALIGNED,
            "views without a seam",
            "views with a seam",
            "beside the seam",
            "elsewhere",
        )
    }
    for view in views:
        with torch.no_grad():
            renders = [gaussians.render(view.camera).numpy() for gaussians in scenes]
        beside = seams(scenes[0], parts, view.camera)
        counts = np.ones_like(beside) if view.mask is None else view.mask

        def add(name: str, mask: NDArray[np.bool_], metric: Metric = psnr) -> None:
            rows[name].append([metric(render, view.image, mask) for render in renders])  # noqa: B023

        add("all", counts)
        add(ALIGNED, counts, psnr_aligned)
        if beside.mean() < LEAST:
            add("views without a seam", counts)
        else:
            add("views with a seam", counts)
            add("beside the seam", counts & beside)
            add("elsewhere", counts & ~beside)
    return [SeamRow(name, len(found), _means(found, len(scenes))) for name, found in rows.items()]


def _means(rows: list[list[float | None]], columns: int) -> list[float | None]:
    """Of each column, over the rows that have a value in all."""
    whole = [row for row in rows if None not in row]
    return [*np.mean(np.array(whole, float), axis=0).tolist()] if whole else [None] * columns
