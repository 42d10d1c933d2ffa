"""How a degraded photo comes from a clean picture: the linear part, as an operator on renders.

A loss that compares the degraded render with the photo lets the scene stay sharp, where a loss on the render
itself would teach it the blur. Shrinking and Gaussian blur are separable, so each is a matrix per axis;
defocus and motion are small kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hqgs.photos.constants import KERNEL_REACH
from hqgs.photos.formula import Degradation, check_formation, small_side
from hqgs.photos.kernels import disc_kernel, motion_kernel
from hqgs.photos.operators import Kernel, Separable
from hqgs.photos.resize import resize_matrix


class Operator(Protocol):
    """A linear map of pictures, [H, W, C] to [h, w, C]."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of what comes out."""
        ...

    def __call__(self, image: Tensor) -> Tensor:
        """Differentiable once in the image."""
        ...

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """[h, w], True where no pixel that is left out, in `mask` [H, W], has a weight."""
        ...


@dataclass(frozen=True)
class Sequence:
    """Operators one after the other."""

    operators: tuple[Operator, ...]  # at least one

    @property
    def size(self) -> tuple[int, int]:
        return self.operators[-1].size

    def __call__(self, image: Tensor) -> Tensor:
        for operator in self.operators:
            image = operator(image)
        return image

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        for operator in self.operators:
            mask = operator.mask(mask)
        return mask


def formation(
    degradation: Degradation, height: int, width: int, direction: float | None = None
) -> Operator | None:
    """The linear steps of a degradation, for renders of `height` x `width` px.

    `direction` of the motion in radians from x towards y (down); without it motion is passed over, as are
    noise and JPEG. None where no step is left. ValueError where a kernel is too large for the render, or for
    a step that has no operator (`check_formation`).
    """
    operators: list[Operator] = []
    matrices: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None  # of the separable steps in a row
    size = height, width

    def close() -> None:
        nonlocal matrices
        if matrices is not None:
            operators.append(Separable.of(*matrices))
            matrices = None

    for step in check_formation(degradation).for_width(width, height).steps:
        value = step.value or 0.0
        if step.kind in ("blur", "lowres"):
            if step.kind == "blur":
                axes = tuple(blur_matrix(n, value) for n in size)
            else:
                axes = tuple(resize_matrix(n, small_side(n, int(value))) for n in size)
            size = len(axes[0]), len(axes[1])
            matrices = (
                (axes[0], axes[1]) if matrices is None else (axes[0] @ matrices[0], axes[1] @ matrices[1])
            )
        elif step.kind == "defocus":
            close()
            operators.append(Kernel.of(disc_kernel(value), *size))
        elif step.kind == "motion" and direction is not None:
            close()
            operators.append(Kernel.of(motion_kernel(value, direction), *size))
    close()
    if not operators:
        return None
    return operators[0] if len(operators) == 1 else Sequence(tuple(operators))


def blur_matrix(size: int, sigma: float) -> NDArray[np.float64]:
    """The matrix [size, size] of a Gaussian blur of `sigma` px along one axis, as the degradation has it.

    Sampled, ends at 4 sigma, sums to 1; the picture is mirrored at its border without repeating the edge.
    """
    reach = int(np.ceil(KERNEL_REACH * sigma))
    offsets = np.arange(-reach, reach + 1)
    kernel = np.exp(-0.5 * (offsets / sigma) ** 2)
    kernel /= kernel.sum()
    source = np.pad(np.arange(size), reach, mode="reflect")
    matrix = np.zeros((size, size))
    for k, weight in enumerate(kernel):
        matrix[np.arange(size), source[k : k + size]] += weight
    return matrix
