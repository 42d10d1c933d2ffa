"""The space before the cameras, in which nothing is."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from hqgs.scene.scene import Scene

NEXT = 10  # the point, from the nearest, whose distance counts: some of those before it may be wrong


class FreeSpace:
    """Half balls before the cameras, smaller than the distance to the points that are next to them.

    What hangs there, large in a single photo and out of all others, fits that photo and hides whatever a
    camera beside it looks at. No photo that is held back is needed to tell: cameras stand in free space. Half
    balls, since a bare wall right behind a camera has no points, and other photos show it.
    """

    def __init__(self, scene: Scene, clearance: float) -> None:
        """`clearance`: the radius of a half ball, of the distance from its camera to the points next to it.

        A part of a scene lacks points of others that may be near its cameras, so it has none; nor has a scene
        of few points.
        """
        centers = np.stack([view.camera.center for view in scene.train]).astype(np.float64)
        self._cameras = KDTree(centers)
        self._axes = np.stack([view.camera.viewmat[2, :3] for view in scene.train]).astype(np.float64)
        self._radii = np.zeros(len(centers))
        if scene.part is None and len(scene.points) >= NEXT:
            distances, _ = KDTree(scene.points.astype(np.float64)).query(centers, NEXT)
            self._radii = clearance * distances[:, -1]

    def holds(self, means: Tensor) -> Tensor:
        """Which of the means [N, 3] lie in the half ball of the camera that is nearest, bool [N].

        Those that are not finite do not: others have to find them.
        """
        held = torch.zeros(len(means), dtype=torch.bool)
        places = means.detach().numpy().astype(np.float64)
        finite = np.isfinite(places).all(axis=1)
        if self._radii.any() and finite.any():
            distances, nearest = self._cameras.query(places[finite])
            away = places[finite] - self._cameras.data[nearest]
            before = np.einsum("ni,ni->n", away, self._axes[nearest]) > 0
            held[torch.from_numpy(finite)] = torch.from_numpy(before & (distances < self._radii[nearest]))
        return held
