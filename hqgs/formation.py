"""How a degraded photo comes from a clean picture: the linear part, as an operator on renders.

A loss that compares the degraded render with the photo lets the scene stay sharp, where a loss on the render
itself would teach it the blur. Shrinking and Gaussian blur are separable, so each is a matrix per axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hqgs.degradations import REACH, Degradation, small_side
from hqgs.resize import resize_matrix
from hqgs.separable import Separable

LINEAR = ("blur", "lowres")  # the kinds that this module knows; noise and JPEG are the loss's business


def formation(degradation: Degradation, height: int, width: int) -> Separable | None:
    """The blur and low-res steps of a degradation, for renders of `height` x `width` px.

    Steps of other kinds are passed over; None where no step is left.
    """
    rows, columns = np.eye(height), np.eye(width)
    steps = [step for step in degradation.for_width(width).steps if step.kind in LINEAR]
    for step in steps:
        value = step.value or 0.0
        if step.kind == "blur":
            rows, columns = (blur_matrix(len(m), value) @ m for m in (rows, columns))
        else:
            rows, columns = (
                resize_matrix(len(m), small_side(len(m), int(value))) @ m for m in (rows, columns)
            )
    return Separable.of(rows, columns) if steps else None


def blur_matrix(size: int, sigma: float) -> NDArray[np.float64]:
    """The matrix [size, size] of a Gaussian blur of `sigma` px along one axis, as the degradation has it.

    Sampled, ends at 4 sigma, sums to 1; the picture is mirrored at its border without repeating the edge.
    """
    reach = int(np.ceil(REACH * sigma))
    offsets = np.arange(-reach, reach + 1)
    kernel = np.exp(-0.5 * (offsets / sigma) ** 2)
    kernel /= kernel.sum()
    source = np.pad(np.arange(size), reach, mode="reflect")
    matrix = np.zeros((size, size))
    for k, weight in enumerate(kernel):
        matrix[np.arange(size), source[k : k + size]] += weight
    return matrix
