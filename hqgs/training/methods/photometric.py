"""The photometric loss: value and exact gradient in one pass over the images, on the CPU."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs import _rust
from hqgs.model.autograd import as_array

LAMBDA_DSSIM = 0.2  # the weight of D-SSIM beside L1 (Kerbl et al. 2023, equation 7)


def photometric_loss(
    render: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    lambda_dssim: float = LAMBDA_DSSIM,
    knee: float = 0.0,
) -> Tensor:
    """(1 - lambda_dssim) L1 + lambda_dssim (1 - SSIM) of a render against a photo, a scalar.

    SSIM as in Wang et al. 2004, per channel: Gaussian window of 11 x 11 with sigma 1.5, zero padding, mean
    over pixels and channels (Kerbl et al. 2023, equation 7, as the field computes it). The gradient of
    |x| at 0 is 0. Same inputs, same bits, for any number of threads; NaN in the render gives NaN.

    Args:
        render: [H, W, C], float32 or float64, on the scale where white is 1; it need not be clamped.
        target: [H, W, C], uint8 (divided by 255) or of the render's dtype. It gets no gradient.
        mask: bool [H, W], True where the photo counts. L1 is the mean over these pixels. For SSIM the render
            is replaced by the target elsewhere, and the mean is over all pixels.
        lambda_dssim: weight of 1 - SSIM, in [0, 1]; at 0 SSIM is not computed.
        knee: k in Huber's function, x^2 / (2 k) up to |x| = k and |x| - k / 2 beyond, which stands for |x|;
            at 0 it is |x|.

    Raises:
        ValueError: a wrong shape, dtype, device or value, with its name.
    """
    tensors = {"render": render, "target": target} | ({} if mask is None else {"mask": mask})
    for name, tensor in tensors.items():
        if tensor.device.type != "cpu":
            raise ValueError(f"{name}: must be on the CPU, got a tensor on {tensor.device}")
    if render.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"render: must be float32 or float64, got {render.dtype}")
    if target.dtype not in (torch.uint8, render.dtype):
        raise ValueError(f"target: must be uint8 or {render.dtype} as the render, got {target.dtype}")
    if target.requires_grad:
        raise ValueError("target: no gradient with respect to the target; pass target.detach()")
    if mask is not None and mask.dtype != torch.bool:
        raise ValueError(f"mask: must be bool, got {mask.dtype}")
    if not 0 <= lambda_dssim <= 1:
        raise ValueError(f"lambda_dssim: must be in [0, 1], got {lambda_dssim}")
    if not 0 <= knee < math.inf:
        raise ValueError(f"knee: must be finite and at least 0, got {knee}")
    return _Photometric.apply(render, target, mask, float(lambda_dssim), float(knee))


class _Photometric(torch.autograd.Function):
    """The gradient comes with the value, so the backward pass only scales it."""

    @staticmethod
    def forward(
        ctx: Any, render: Tensor, target: Tensor, mask: Tensor | None, lambda_dssim: float, knee: float
    ) -> Tensor:
        counts = None if mask is None else as_array(mask).view(np.uint8)
        x, y = as_array(render), as_array(target)
        loss, _, _, grad = _rust.photometric(x, y, counts, lambda_dssim, knee, ctx.needs_input_grad[0])
        if grad is not None:
            ctx.save_for_backward(torch.from_numpy(grad.reshape(x.shape)))
        return render.new_tensor(loss)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's own is too general)
        ctx: Any, v_loss: Tensor
    ) -> tuple[Tensor, None, None, None, None]:
        (grad,) = ctx.saved_tensors
        # A product with 1 would be one more pass through the image.
        return grad if v_loss == 1 else v_loss * grad, None, None, None, None
