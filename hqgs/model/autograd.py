"""The rasterizer's stages as autograd functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs import _rust
from hqgs.base.threads import one_torch_thread
from hqgs.model.formats.turned import quaternions

# Rows and columns of the six entries that count: xx, xy, xz, yy, yz, zz.
UPPER = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]


def quats_and_scales(covars: Tensor, means: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions w x y z [..., N, 4] and standard deviations [..., N, 3] of covariances [..., N, 3, 3].

    As for gsplat, the entries on and above the diagonal count.

    They have no gradient: rotations have none where two scales are equal. Eigenvalues and eigenvectors in
    float64, rounded to the dtype of the covariances; eigenvalues below 0 are 0. Where a covariance is not
    finite, neither are the scales, so that the Gaussian is culled.

    Raises:
        ValueError: another type, dtype or shape than that of the `means`.
    """
    if not isinstance(covars, Tensor):
        raise ValueError(f"covars: expected a torch tensor, got {covars!r:.60}")
    if covars.dtype != means.dtype:
        raise ValueError(f"covars: must have the dtype of means, {means.dtype}, got {covars.dtype}")
    if covars.shape != (*means.shape[:-1], 3, 3):
        wanted = [*means.shape[:-1], 3, 3]
        raise ValueError(f"covars: expected shape {wanted}, got {list(covars.shape)}")
    entries = covars.detach().double()[..., UPPER[0], UPPER[1]]
    finite = entries.isfinite().all(-1, keepdim=True)
    matrices = entries.new_zeros(*entries.shape[:-1], 3, 3)
    matrices[..., UPPER[1], UPPER[0]] = entries.where(finite, 0.0)  # below the diagonal, where eigh looks
    values, axes = torch.linalg.eigh(matrices)
    axes = axes * torch.where(torch.linalg.det(axes) < 0, -1.0, 1.0)[..., None, None]
    scales = values.clamp(min=0).sqrt().where(finite, torch.nan)
    quats = torch.from_numpy(quaternions(axes.reshape(-1, 3, 3).numpy())).view(*axes.shape[:-2], 4)
    return quats.to(covars.dtype), scales.to(covars.dtype)


def whole(upper: NDArray[np.floating]) -> NDArray[np.floating]:
    """Matrices [N, 3, 3] with these entries [N, 6], and 0 below the diagonal."""
    matrices = np.zeros((len(upper), 3, 3), upper.dtype)
    matrices[:, UPPER[0], UPPER[1]] = upper
    return matrices


LEAST_ALPHA = 1e-10  # by which an expected depth is divided
_ZERO = {dtype: torch.zeros((), dtype=dtype) for dtype in (torch.float32, torch.float64)}


def as_array(tensor: Tensor) -> np.ndarray[Any, Any]:
    """The tensor's memory as a C-contiguous array; copied only if it is not contiguous.

    A call of torch that finds nothing to do costs as much as one that does, most of it in cold caches.
    """
    if tensor.requires_grad:
        tensor = tensor.detach()
    return (tensor if tensor.is_contiguous() else tensor.contiguous()).numpy()


def _optional(tensor: Tensor | None) -> np.ndarray[Any, Any] | None:
    return None if tensor is None else as_array(tensor)


def _tensor(array: np.ndarray[Any, Any] | None, *shape: int) -> Tensor | None:
    return None if array is None else torch.from_numpy(array.reshape(shape))


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
            "hqgs.rasterization has only first derivatives: its gradient (create_graph=True) cannot be "
            "differentiated again"
        )


Gradients = tuple[Tensor | None, ...]


def first_derivative(backward: Callable[..., Gradients]) -> Callable[..., Gradients]:
    """A backward pass that is an error to differentiate. Frees `ctx.state`, what is kept for it, when torch
    frees tensors, which are all that `save_for_backward` takes."""

    @wraps(backward)
    def once(ctx: Any, *grads):
        if ctx.state is None:
            raise RuntimeError(
                "Trying to backward through the graph of hqgs.rasterization a second time, when what it kept "
                "is freed: say backward(retain_graph=True) the first time"
            )
        with one_torch_thread(), torch.no_grad():
            found = backward(ctx, *grads)
        if not torch._C._autograd._get_current_graph_task_keep_graph():  # pyright: ignore[reportAttributeAccessIssue]
            ctx.state = None
        if not torch.is_grad_enabled():  # it is where create_graph is
            return found
        return _First.apply(*(None if grad is None else grad.requires_grad_() for grad in found))

    return once


class _Project(torch.autograd.Function):
    """Gaussians to splats. `link` has no values of interest: its cotangent carries the gradient of the 2D
    covariance in whitened form, which stays of order 1 however thin a Gaussian is. Nor have `covars`: they
    get the gradient of what `quats` and `scales` stand for."""

    @staticmethod
    def forward(
        ctx: Any, means, quats, scales, opacities, covars, colors, rest, viewmats, Ks, config, enabled
    ):
        width, height, options, activate, sh_degree = config
        needs_means, *geometry, needs_harmonics, needs_rest, needs_viewmats = ctx.needs_input_grad[:8]
        colors_vary = needs_means or needs_viewmats or needs_harmonics or needs_rest
        others = (*options, enabled and colors_vary), sh_degree, activate
        inputs = as_array(means), as_array(quats), as_array(scales), as_array(opacities), as_array(colors)
        poses, intrinsics = (as_array(matrices).astype(np.float64) for matrices in (viewmats, Ks))
        ctx.pose = viewmats.dtype
        frame, *arrays = _rust.project_forward(
            *inputs, _optional(rest), poses, intrinsics, width, height, *others
        )
        n, c = means.shape[0], viewmats.shape[0]
        ctx.state, ctx.shapes, ctx.has_harmonics = frame, (n, c), sh_degree is not None
        ctx.sh_shapes = [() if t is None else tuple(t.shape) for t in (colors, rest)]
        ctx.save_for_backward(means, quats, scales, opacities)
        ctx.set_materialize_grads(False)
        shapes = (c, n, 2), (c, n), (c, n, 3), (c, n, 2), (c, n), (c, n, 3) if ctx.has_harmonics else (0,)
        shaped = [torch.from_numpy(array.reshape(shape)) for array, shape in zip(arrays, shapes, strict=True)]
        means2d, depths, conics, radii, alphas, sh_colors = shaped
        link = _ZERO[means.dtype].expand(c, n, 3)
        # What depends on no tensor that requires a gradient gets no cotangent, so that none is computed.
        constant = [radii]
        if not (needs_means or needs_viewmats or any(geometry)):
            constant += [means2d, link, depths, conics, alphas]
        if not colors_vary:
            constant.append(sh_colors)
        ctx.mark_non_differentiable(*constant)
        return frame, means2d, link, depths, conics, radii, alphas, sh_colors

    @staticmethod
    @first_derivative
    def backward(ctx: Any, *grads):
        _, v_means2d, v_link, v_depths, v_conics, _, v_alphas, v_colors = grads
        means, quats, scales, opacities = ctx.saved_tensors
        n, c = ctx.shapes
        needs = list(ctx.needs_input_grad[:8])
        if not ctx.has_harmonics:
            v_colors = None
        cotangents = v_means2d, v_link, v_alphas, v_depths, v_conics, v_colors
        inputs = as_array(means), as_array(quats), as_array(scales), as_array(opacities)
        v_inputs = [*_rust.project_backward(ctx.state, inputs, tuple(map(_optional, cotangents)), needs)]
        if v_inputs[7] is not None:  # computed in f64; stay finite in the dtype of the inputs
            limit = torch.finfo(means.dtype).max
            v_inputs[7].clip(-limit, limit, out=v_inputs[7])
        if v_inputs[4] is not None:
            v_inputs[4] = whole(v_inputs[4].reshape(n, 6))
        shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, 3, 3), *ctx.sh_shapes, (c, 4, 4)]
        *found, pose = (_tensor(v, *shape) for v, shape in zip(v_inputs, shapes, strict=True))
        return *found, None if pose is None else pose.to(ctx.pose), None, None, None


class _Composite(torch.autograd.Function):
    """Splats to pixels. Of `means2d`, [C, N, 2], no value is looked at, for the frame has them: it gets the
    gradient, or once the meta data are asked for them, `packed` does, [M, 2] of the pairs of `which`."""

    @staticmethod
    def forward(
        ctx: Any, frame, means2d, packed, link, alphas_in, colors, depths, backgrounds, mode, absgrad, which
    ):
        c, n = link.shape[:2]
        channels, behind = as_array(colors), None if backgrounds is None else as_array(backgrounds).copy()
        if mode != "RGB":
            last = as_array(depths)[..., None]
            channels = (
                np.broadcast_to(channels, (c, n, channels.shape[-1])) if "RGB" in mode else last[..., :0]
            )
            channels = np.concatenate([channels, last], -1)
            behind = None if behind is None or "RGB" not in mode else np.pad(behind, ((0, 0), (0, 1)))
        state, image, alphas = _rust.composite_forward(frame, channels, behind, channels.shape[-1])
        image = image.reshape(c, frame.height, frame.width, channels.shape[-1])
        alphas = alphas.reshape(c, frame.height, frame.width, 1)
        expected = None  # depth, with the alphas
        if mode.endswith("ED"):
            with np.errstate(all="ignore"):
                image[..., -1:] /= np.maximum(alphas, LEAST_ALPHA)
            expected = image[..., -1:].copy(), alphas.copy()
        ctx.state, ctx.mode, ctx.absgrad, ctx.which = (state, behind, expected), mode, absgrad, which
        ctx.shape = c, n, channels.shape[-1]
        if absgrad:
            ctx.save_for_backward(means2d if packed is None else packed)
        ctx.image_shape, ctx.dtype, ctx.of_each = image.shape, image.dtype, colors.dim() == 3
        ctx.set_materialize_grads(False)
        return torch.from_numpy(image), torch.from_numpy(alphas), state.work

    @staticmethod
    @first_derivative
    def backward(ctx: Any, *grads):
        v_image, v_alphas, _ = grads
        _, *needs = ctx.needs_input_grad[:8]
        need_means2d, _, need_link, need_alphas, need_colors, need_depths, need_backgrounds = needs
        geometry = need_means2d or need_link or need_alphas
        if v_image is None and v_alphas is None:
            return (None,) * 11
        (c, n, channels), (state, behind, expected) = ctx.shape, ctx.state
        v_image = np.zeros(ctx.image_shape, ctx.dtype) if v_image is None else as_array(v_image)
        v_alphas = _optional(v_alphas)
        if expected is not None:
            v_image, v_alphas = _of_accumulated(expected, v_image, v_alphas)
        need_colors, need_depths = need_colors and "RGB" in ctx.mode, need_depths and ctx.mode != "RGB"
        need_backgrounds = need_backgrounds and behind is not None
        wanted = [geometry, ctx.absgrad, need_colors or need_depths, need_backgrounds]
        v_inputs = _rust.composite_backward(state, behind, v_image, v_alphas, wanted)
        v_means2d, v_link, v_alphas_in, v_abs, v_colors, v_backgrounds = v_inputs
        v_means2d, v_packed = _tensor(v_means2d, c, n, 2), None
        v_abs = _tensor(v_abs, c, n, 2)
        if ctx.which is not None and ctx.which.asked:
            v_packed, v_means2d = ctx.which.of(v_means2d), None
            v_abs = ctx.which.of(v_abs)
        if v_abs is not None:
            (positions,) = ctx.saved_tensors
            positions.absgrad = v_abs
        v_color, v_depths = _tensor(v_colors, c, n, channels), None
        v_background = _tensor(v_backgrounds, c, channels)
        if v_background is not None and ctx.mode != "RGB":
            v_background = v_background[:, :-1]
        if v_color is not None and ctx.mode != "RGB":
            v_depths = v_color[..., -1].contiguous() if need_depths else None
            v_color = v_color[..., :-1].contiguous() if need_colors else None
        if v_color is not None and not ctx.of_each:
            v_color = v_color[0] if c == 1 else v_color.sum(0)
        v_link, v_alphas_in = _tensor(v_link, c, n, 3), _tensor(v_alphas_in, c, n)
        splats = None, v_means2d, v_packed, v_link, v_alphas_in
        return *splats, v_color, v_depths, v_background, None, None, None


def _of_accumulated(expected, v_image, v_alphas):
    """Cotangents of the accumulated depth, the last channel, and of the alphas by which it was divided."""
    depth, alphas = expected
    over, last = np.maximum(alphas, LEAST_ALPHA), v_image[..., -1:]
    with np.errstate(all="ignore"):
        v_divisor = np.where(alphas >= LEAST_ALPHA, -last * (depth / over), 0)
        v_image = np.concatenate([v_image[..., :-1], last / over], -1)
        return v_image, v_divisor if v_alphas is None else v_alphas + v_divisor
