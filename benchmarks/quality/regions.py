"""Where the Gaussians are, on edges or in flat parts; and how well edge maps outlive a degradation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pandas import DataFrame

from benchmarks.scenes import degraded
from hqgs._rust import NEAR_PLANE
from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.metrics import psnr
from hqgs.photos.edges import edge_magnitude
from hqgs.scene.geometry import project
from hqgs.scene.scene import Scene, View
from hqgs.training.methods.base import photo_tensors

EDGE_SHARE = 0.2  # of the pixels of a photo, those with the largest gradient, are its edges
MAX_PHOTOS = 8  # of a scene, whose edge maps are compared


def count_regions(means: NDArray[np.float32], views: Sequence[View]) -> dict[str, Any]:
    """Gaussians and pixels on edges and in flat parts, sums over the views.

    A Gaussian counts in each view into which its mean [N, 3] projects, seen or hidden there, however
    transparent. Edges are the `EDGE_SHARE` of a clean photo's pixels with the largest Sobel gradient, mean
    over channels; ties at the limit are flat. `density` is Gaussians per 1,000 pixels.
    """
    regions: dict[str, Any] = {name: {"gaussians": 0, "pixels": 0} for name in ("edge", "flat")}
    for view in views:
        camera = view.camera
        pixels, depths = project(camera, means.astype(np.float64))
        pixels = np.floor(pixels[depths > NEAR_PLANE])  # column, row: pixel j spans j to j + 1
        inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        columns, rows = pixels[inside].astype(np.int64).T
        hits = np.zeros((camera.height, camera.width), np.int64)
        np.add.at(hits, (rows, columns), 1)
        counted = np.ones(hits.shape, bool) if view.mask is None else view.mask
        edges = _edge_map(view).mean(axis=2)
        limit = np.quantile(edges[counted], 1 - EDGE_SHARE) if counted.any() else 0.0
        for name, where in (("edge", counted & (edges > limit)), ("flat", counted & (edges <= limit))):
            regions[name]["gaussians"] += int(hits[where].sum())
            regions[name]["pixels"] += int(where.sum())
    for region in regions.values():
        region["density"] = 1_000 * region["gaussians"] / region["pixels"] if region["pixels"] else None
    return regions


def edge_robustness(scene: Scene, degradations: Sequence[str], seed: int) -> dict[str, Any]:
    """How alike photos and their edge maps are before and after each degradation.

    Up to `MAX_PHOTOS` training photos, spread over the scene: PSNR of the degraded photo against the clean
    one, and of the edge map of the one against that of the other; means over the photos that the degradation
    changes. The variances are over the degradations (sample variance, dB^2; None for fewer than two).
    """
    spread = np.unique(np.linspace(0, len(scene.train) - 1, MAX_PHOTOS).round().astype(np.int64))
    values: dict[str, dict[str, float]] = {}
    for degradation in degradations:
        bad = degraded(
            scene, degradation, seed
        ).train  # all of them: what happens to one may hang on the others
        pairs = []
        for clean, view in ((scene.train[k], bad[k]) for k in spread):
            photo = psnr(view.image, clean.image, clean.mask)
            edges = psnr(_edge_map(view), _edge_map(clean), clean.mask)
            if photo is not None and edges is not None:
                pairs.append((photo, edges))
        if pairs:  # "none" leaves them identical
            photo, edges = np.mean(pairs, axis=0).tolist()
            values[degradation] = {"photo_psnr": photo, "edge_psnr": edges}
    found = DataFrame(values.values(), columns=["photo_psnr", "edge_psnr"]).var()
    variances = {
        str(name).replace("psnr", "variance"): None if v != v else float(v) for name, v in found.items()
    }
    return {"scene": scene.name, "photos": len(spread), "degradations": values, **variances}


def _edge_map(view: View) -> NDArray[np.float32]:
    photo, mask = photo_tensors(view)
    with one_torch_thread(), torch.no_grad():
        return edge_magnitude(photo, mask).float().numpy()
