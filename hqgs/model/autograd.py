"""The rasterizer's stages as autograd functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hqgs import _rust


def _numpy(tensor: Tensor) -> np.ndarray[Any, Any]:
    """The tensor's memory as a C-contiguous array; copied only if it is not contiguous."""
    return tensor.detach().contiguous().numpy()


def _optional(tensor: Tensor | None) -> np.ndarray[Any, Any] | None:
    return None if tensor is None else _numpy(tensor)


def _tensor(array: np.ndarray[Any, Any] | None, *shape: int) -> Tensor | None:
    return None if array is None else torch.from_numpy(array).view(shape)


def _packed(tensor: Tensor | None, ids: tuple[Tensor, ...] | None) -> Tensor | None:
    return tensor if tensor is None or ids is None else tensor[ids]


class _First(torch.autograd.Function):
    """Gradients as they are, which say where they are differentiated that there is no more to have.

    Of `torch.autograd.function.once_differentiable` differs that it asks whether a graph is made: cotangents
    that do not depend on anything (of a mean, say) would let a penalty on the gradient do nothing.
    """

    @staticmethod
    def forward(ctx: Any, *grads):
        return tuple(None if grad is None else grad.view_as(grad) for grad in grads)

    @staticmethod
    def backward(ctx: Any, *grads):
        raise RuntimeError(
            "hqgs.rasterization has first derivatives alone: its gradient (create_graph=True) cannot be "
            "differentiated again"
        )


def _once(backward: Callable[..., tuple[Tensor | None, ...]]) -> Callable[..., tuple[Tensor | None, ...]]:
    """A backward pass that is an error to differentiate."""

    @wraps(backward)
    def once(ctx: Any, *grads):
        with torch.no_grad():
            found = backward(ctx, *grads)
        if not torch.is_grad_enabled():  # it is where create_graph is
            return found
        return _First.apply(*(None if grad is None else grad.requires_grad_() for grad in found))

    return once


class _Project(torch.autograd.Function):
    """Gaussians to splats. `link` has no values of interest: its cotangent carries the gradient of the 2D
    covariance in whitened form, which stays of order 1 however thin a Gaussian is. Nor have `covars`, [N, 6]
    or None: they get the gradient of what `quats` and `scales` stand for."""

    @staticmethod
    def forward(
        ctx: Any, means, quats, scales, opacities, covars, colors, rest, viewmats, Ks, config, enabled
    ):
        width, height, options, activate, sh_degree = config
        needs_means, *geometry, needs_harmonics, needs_rest, needs_viewmats = ctx.needs_input_grad[:8]
        colors_vary = needs_means or needs_viewmats or needs_harmonics or needs_rest
        others = (*options, enabled and colors_vary), sh_degree, activate
        inputs = _numpy(means), _numpy(quats), _numpy(scales), _numpy(opacities), _numpy(colors)
        frame, *arrays = _rust.project_forward(
            *inputs, _optional(rest), _numpy(viewmats), _numpy(Ks), width, height, *others
        )
        n, c = means.shape[0], viewmats.shape[0]
        means2d, depths, conics, radii, alphas, sh_colors = map(torch.from_numpy, arrays)
        ctx.frame, ctx.shapes, ctx.has_harmonics = frame, (n, c), sh_degree is not None
        ctx.sh_shapes = [() if t is None else tuple(t.shape) for t in (colors, rest)]
        ctx.save_for_backward(means, quats, scales, opacities)
        ctx.set_materialize_grads(False)
        link = means2d.new_zeros(()).expand(c, n, 3)
        means2d, depths, conics = means2d.view(c, n, 2), depths.view(c, n), conics.view(c, n, 3)
        radii, alphas = radii.view(c, n, 2), alphas.view(c, n)
        sh_colors = sh_colors.view(c, n, 3) if ctx.has_harmonics else sh_colors
        # What depends on no tensor that requires a gradient gets no cotangent, so that none is computed.
        constant = [radii]
        if not (needs_means or needs_viewmats or any(geometry)):
            constant += [means2d, link, depths, conics, alphas]
        if not colors_vary:
            constant.append(sh_colors)
        ctx.mark_non_differentiable(*constant)
        return frame, means2d, link, depths, conics, radii, alphas, sh_colors

    @staticmethod
    @_once
    def backward(ctx: Any, *grads):
        _, v_means2d, v_link, v_depths, v_conics, _, v_alphas, v_colors = grads
        means, quats, scales, opacities = ctx.saved_tensors
        n, c = ctx.shapes
        needs = list(ctx.needs_input_grad[:8])
        if not ctx.has_harmonics:
            v_colors = None
        *v_inputs, _ = _rust.project_backward(
            ctx.frame,
            (_numpy(means), _numpy(quats), _numpy(scales), _numpy(opacities)),
            (
                _optional(v_means2d),
                _optional(v_link),
                _optional(v_alphas),
                _optional(v_depths),
                _optional(v_conics),
                _optional(v_colors),
            ),
            needs,
        )
        if v_inputs[7] is not None:  # computed in f64; stay finite in the dtype of the inputs
            limit = torch.finfo(means.dtype).max
            v_inputs[7].clip(-limit, limit, out=v_inputs[7])
        shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, 6), *ctx.sh_shapes, (c, 4, 4)]
        return (*(_tensor(v, *shape) for v, shape in zip(v_inputs, shapes, strict=True)), None, None, None)


class _Composite(torch.autograd.Function):
    """Splats to pixels. Of `means2d`, [C, N, 2], or [M, 2] of the pairs `ids` (cameras and Gaussians, [M]
    each), no value is looked at, for the frame has them: it gets the gradient."""

    @staticmethod
    def forward(ctx: Any, frame, means2d, link, alphas_in, colors, backgrounds, absgrad, ids):
        channels = colors.shape[-1]
        state, image, alphas = _rust.composite_forward(
            frame, _numpy(colors), _optional(backgrounds), channels
        )
        c = link.shape[0]
        width, height = frame.width, frame.height
        image = torch.from_numpy(image).view(c, height, width, channels)
        alphas = torch.from_numpy(alphas).view(c, height, width, 1)
        ctx.state, ctx.absgrad, ctx.ids, ctx.splats = state, absgrad, ids, link.shape[:2]
        ctx.save_for_backward(means2d, colors, backgrounds)
        ctx.image_shape = image.shape
        ctx.set_materialize_grads(False)
        return image, alphas, state.work

    @staticmethod
    @_once
    def backward(ctx: Any, *grads):
        v_image, v_alphas, _ = grads
        means2d, colors, backgrounds = ctx.saved_tensors
        _, need_means2d, need_link, need_alphas, need_colors, need_backgrounds, *_ = ctx.needs_input_grad
        geometry = need_means2d or need_link or need_alphas
        if v_image is None and v_alphas is None:
            return (None,) * 8
        (c, n), channels = ctx.splats, colors.shape[-1]
        v_image = means2d.new_zeros(ctx.image_shape) if v_image is None else v_image
        wanted = [geometry, ctx.absgrad, need_colors, need_backgrounds]
        *v_inputs, _ = _rust.composite_backward(
            ctx.state, _optional(backgrounds), _numpy(v_image), _optional(v_alphas), wanted
        )
        v_means2d, v_link, v_alphas_in, v_abs, v_colors, v_backgrounds = v_inputs
        if v_abs is not None:
            means2d.absgrad = _packed(_tensor(v_abs, c, n, 2), ctx.ids)
        v_color = _tensor(v_colors, c, n, channels)
        if v_color is not None and colors.dim() == 2:
            v_color = v_color[0] if c == 1 else v_color.sum(0)
        return (
            None,
            _packed(_tensor(v_means2d, c, n, 2), ctx.ids),
            _tensor(v_link, c, n, 3),
            _tensor(v_alphas_in, c, n),
            v_color,
            _tensor(v_backgrounds, c, channels),
            None,
            None,
        )
