"""What a run leaves out by itself, decided while it trains, from training photos that are held back.

A few training photos are held back until growth ends. What may go is tried on them: the scene is rendered
without it, and it goes where that costs no more than TOLERANCE dB. Test views are never looked at. Then the
photos come back and all are trained on to the end.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from hqgs.camera import Camera, View
from hqgs.config import TrainConfig
from hqgs.data.images import area_downscale
from hqgs.densify import DensifyConfig, Growth, cut_harmonics
from hqgs.gaussians import Gaussians
from hqgs.left_out import LeftOut
from hqgs.methods.base import Method
from hqgs.render import render_view
from hqgs.smallest import photo_pixels
from hqgs.weights import largest_weights

if TYPE_CHECKING:
    from hqgs.train import Trainer  # which itself imports this module

HELD_SHARE, MOST_HELD, FEWEST_VIEWS = 1 / 10, 4, 10  # of the training views; with fewer none is held back
TOLERANCE = 0.02  # dB on the held-back photos that leaving one thing out may cost
FINEST = 1.5  # px of the photo that sees a Gaussian best: with a larger standard deviation it may still grow
COARSE_PART, COARSE_FACTOR, SMALLEST_SIDE = 0.3, 2, 32  # of the run; of the sides; px that are left
WEIGHTS = (0.1, 0.05, 0.02, 0.01, 0.005)  # limits of the largest blending weight; the first that costs little
