"""Shapes of first Gaussians: discs as dense neighbours lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import KDTree

from hqgs.model.formats.turned import quaternions
from hqgs.model.gaussians import Gaussians

THINNEST = (1.0, 0.2, 0.1)  # of a disc's three axes, of the longest: few neighbours tell no more


def as_discs(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians, turned and shaped as their nearest neighbours lie; the rest is shared.

    The axes are those of the directions to the 5 nearest neighbours: a disc where those lie on a surface, a
    needle where they lie along an edge. The area of a Gaussian seen along its shortest axis stays as it was.
    Round Gaussians become such discs by training, which takes hundreds of steps.
    """
    means = gaussians.means.detach().numpy().astype(np.float64)
    _, nearest = KDTree(means).query(means, min(6, len(means)))  # the first is itself
    away = means[np.asarray(nearest)[:, 1:]] - means[:, None]
    away /= np.maximum(np.linalg.norm(away, axis=2, keepdims=True), np.finfo(float).tiny)
    squares, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away))
    squares, axes = squares[:, ::-1], axes[:, :, ::-1]  # the longest first
    axes[np.linalg.det(axes) < 0, :, 2] *= -1  # a turn, no mirror
    longest = np.maximum(squares[:, :1], np.finfo(float).tiny)
    shape = np.maximum(np.sqrt(np.maximum(squares, 0.0) / longest), THINNEST)
    shape /= np.sqrt(shape[:, :1] * shape[:, 1:2])
    quats = quaternions(axes)
    return replace(
        gaussians,
        scales=gaussians.scales + torch.from_numpy(np.log(shape)).float(),
        quats=torch.from_numpy(quats).float(),
    )
