"""What the formats read and write."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32] | NDArray[np.float64]


class Arrays(TypedDict):
    """N Gaussians as `hqgs.Gaussians` has them, before their activations."""

    means: Floats  # [N, 3], world units
    scales: Floats  # [N, 3], logs
    quats: Floats  # [N, 4], w x y z
    opacities: Floats  # [N], logits
    sh0: Floats  # [N, 1, 3]
    shN: Floats
