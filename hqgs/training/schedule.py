"""What a step does, as a pure function of the configuration and the iteration."""

from __future__ import annotations

import numpy as np

from hqgs.photos.resize import area_downscale
from hqgs.scene.scene import Camera, View

COARSE_PART, COARSE_FACTOR, SMALLEST_SIDE = 0.3, 2, 32  # of the run; of the sides; px that are left


def smaller(view: View) -> View:
    """The view with photo and camera at 1 / COARSE_FACTOR of the size."""
    camera = view.camera
    width, height = round(camera.width / COARSE_FACTOR), round(camera.height / COARSE_FACTOR)
    image, mask = area_downscale(view.image, view.mask, width, height)
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    return View(view.name, Camera(width, height, K, camera.viewmat), image, mask)
