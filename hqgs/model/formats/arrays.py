"""What the formats read and write."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from hqgs.scene.world import World

Floats = NDArray[np.float32] | NDArray[np.float64]


class Told(TypedDict, total=False):
    """What a file says beside its numbers."""

    world: World  # the frame of the file, where that is another
    antialiased: bool  # it was trained with, and is to be seen with, the compensation of "antialiased"
    notes: list[str]  # what was left out or changed on reading
    errors: NDArray[np.float32]  # [N], of the pixels that each shows, white is 1


class Arrays(Told):
    """N Gaussians as `hqgs.Gaussians` has them, before their activations."""

    means: Floats  # [N, 3], world units
    scales: Floats  # [N, 3], logs
    quats: Floats  # [N, 4], w x y z
    opacities: Floats  # [N], logits
    sh0: Floats  # [N, 1, 3]
    shN: Floats


TENSORS = tuple(name for name in Arrays.__annotations__ if name in Arrays.__required_keys__)
