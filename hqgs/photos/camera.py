"""What a camera chooses anew for each photo: exposure and white balance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hqgs.photos.constants import CAMERA_WHITE_BALANCE
from hqgs.photos.light import to_linear, to_srgb
from hqgs.photos.pixels import Float32


def draw_gains(rng: np.random.Generator, stops: float) -> NDArray[np.float64]:
    """The gains of red, green and blue, [3]: 2^(e + r), 2^e and 2^(e + b).

    The exposure e is uniform in +-`stops`, the white balance r and b uniform in +-`stops` / 4, drawn in this
    order.
    """
    exposure = rng.uniform(-stops, stops)
    red, blue = rng.uniform(-stops * CAMERA_WHITE_BALANCE, stops * CAMERA_WHITE_BALANCE, 2)
    return 2.0 ** np.array([exposure + red, exposure, exposure + blue])


def expose(image: Float32, gains: NDArray[np.float64]) -> Float32:
    """The photo [H, W, 3] with its linear light times the channels' gains, clipped at the sensor's white."""
    linear = to_linear(image) * gains.astype(np.float32)
    return to_srgb(np.minimum(linear, np.float32(1)))
