"""Linear operators on pictures that are a sparse matrix per axis: resizing, blur, block transforms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor
from torch.autograd.function import once_differentiable


@dataclass(frozen=True)
class Separable:
    """rows @ channel @ columns^T for each channel of a picture: [H, W, C] to [h, w, C].

    Sparse, because the dense product for a photo of 1920 x 1080 px takes seconds.
    """

    rows: csr_array  # [h, H]
    columns: csr_array  # [w, W]

    @classmethod
    def of(cls, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> Separable:
        """From dense matrices."""
        return cls(csr_array(rows.astype(np.float32)), csr_array(columns.astype(np.float32)))

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of what comes out."""
        return len(self.rows.indptr) - 1, len(self.columns.indptr) - 1

    def __call__(self, image: Tensor) -> Tensor:
        """Differentiable once in the image; the sums have one order."""
        return _Apply.apply(image, self.rows, self.columns)

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """[h, w], True where no pixel that is left out, in `mask` [H, W], has a weight."""
        left_out = abs(self.rows) @ (~mask).astype(np.float32)
        return (abs(self.columns) @ left_out.T).T == 0


class _Apply(torch.autograd.Function):
    """The operator is linear: its gradient is the transposed operator."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, rows: csr_array, columns: csr_array) -> Tensor:
        ctx.matrices = rows, columns
        return _both_axes(image, rows, columns)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's own is too general)
        ctx: Any, v_out: Tensor
    ) -> tuple[Tensor, None, None]:
        rows, columns = ctx.matrices
        return _both_axes(v_out, rows.T, columns.T), None, None


def _both_axes(image: Tensor, rows: Any, columns: Any) -> Tensor:
    """[H, W, C] to [h, w, C] by sparse matrices [h, H] and [w, W]."""
    array = image.detach().contiguous().numpy()
    height, width, channels = array.shape
    tall = rows @ array.reshape(height, width * channels)
    turned = tall.reshape(-1, width, channels).swapaxes(0, 1).reshape(width, -1)
    out = (columns @ turned).reshape(columns.shape[0], rows.shape[0], channels).swapaxes(0, 1)
    return torch.from_numpy(np.ascontiguousarray(out))
