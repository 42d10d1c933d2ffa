"""The space before the cameras, in which nothing is but what several photos show."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from hqgs.model.constants import SH_C0
from hqgs.model.gaussians import Gaussians
from hqgs.photos.pixels import as_floats
from hqgs.scene.geometry import project
from hqgs.scene.scene import Scene

NEXT = 10  # the point, from the nearest, whose distance counts: some of those before it may be wrong
SHOWING = 3  # photos that show a thing that is there: the one it is before, and two that agree with it
ALIKE = 0.15  # by which a channel of such a photo may differ, where 1 is white


class FreeSpace:
    """Half balls before the cameras, smaller than the distance to the points that are next to them.

    What hangs there, large in a single photo and out of or hidden in all others, fits that photo and hides
    whatever a camera beside it looks at. No photo that is held back is needed to tell: cameras stand in free
    space, but for bare things, which have no points. Several photos show the colour of such a thing where it
    is. Half balls, since a bare wall may be right behind a camera.
    """

    def __init__(self, scene: Scene, clearance: float) -> None:
        """`clearance`: the radius of a half ball, of the distance from its camera to the points next to it.

        A part of a scene lacks points of others that may be near its cameras, so it has none; nor has a scene
        of few points.
        """
        self._views = scene.train
        centers = np.stack([view.camera.center for view in scene.train]).astype(np.float64)
        self._cameras = KDTree(centers)
        self._axes = np.stack([view.camera.viewmat[2, :3] for view in scene.train]).astype(np.float64)
        self._radii = np.zeros(len(centers))
        if scene.part is None and len(scene.points) >= NEXT:
            distances, _ = KDTree(scene.points.astype(np.float64)).query(centers, NEXT)
            self._radii = clearance * distances[:, -1]

    def wrongly_held(self, gaussians: Gaussians) -> Tensor:
        """Which Gaussians lie in the half ball of the nearest camera and are not shown there, bool [N].

        Those with means that are not finite do not: others have to find them.
        """
        wrong = torch.zeros(len(gaussians), dtype=torch.bool)
        places = gaussians.means.detach().numpy().astype(np.float64)
        rows = np.nonzero(np.isfinite(places).all(axis=1))[0]
        if not self._radii.any() or not len(rows):
            return wrong
        distances, nearest = self._cameras.query(places[rows])
        away = places[rows] - self._cameras.data[nearest]
        before = np.einsum("ni,ni->n", away, self._axes[nearest]) > 0
        rows = rows[before & (distances < self._radii[nearest])]
        colors = 0.5 + SH_C0 * gaussians.sh0.detach()[rows, 0].numpy()
        wrong[rows[self._showing(places[rows], colors) < SHOWING]] = True
        return wrong

    def _showing(self, places: NDArray[np.float64], colors: NDArray[np.floating]) -> NDArray[np.intp]:
        """How many photos have these colors [M, 3] where they show the places [M, 3]; [M]."""
        showing = np.zeros(len(places), np.intp)
        for view in self._views:
            pixels, depths = project(view.camera, places)
            inside = (pixels >= 0) & (pixels < [view.camera.width, view.camera.height])
            rows = np.nonzero((depths > 0) & inside.all(axis=1))[0]
            x, y = pixels[rows].astype(np.intp).T
            alike = (np.abs(as_floats(view.image[y, x]) - colors[rows]) <= ALIKE).all(axis=1)
            showing[rows] += alike if view.mask is None else alike & view.mask[y, x]
        return showing
