"""Differentiable rasterization of 3D Gaussians with gsplat's interface, on the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from hqgs import _rust
from hqgs._rust import get_num_threads, set_num_threads
from hqgs.work import add_counts, add_gradients, is_counting

__all__ = ["get_num_threads", "rasterization", "set_num_threads"]

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor | tuple[Tensor, Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    **unsupported: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into C pinhole cameras; code written for `gsplat.rasterization` runs unchanged.

    Gradients flow to every tensor argument but `Ks`; what does not require one is not computed. Frames,
    units and formulas: docs/conventions.md. Same inputs, same bits, for any number of threads.

    Args:
        means: centres in the world, [N, 3], float32 or float64; all other tensors but `viewmats` and `Ks`,
            which may be either, have the same dtype.
        quats: rotations w, x, y, z, [N, 4], of any norm that is not 0.
        scales: standard deviations, world units, [N, 3].
        opacities: [N].
        colors: [N, D] or [C, N, D] channels; with `sh_degree` spherical harmonics, [N, K, 3], or a pair of
            them, [N, 1, 3] and [N, K - 1, 3], which saves joining what is trained apart.
        viewmats: world to camera, [C, 4, 4].
        Ks: intrinsics in pixels, [C, 3, 3].
        width, height: image size in pixels.
        near_plane, far_plane: Gaussians outside this range of view-space depth are culled.
        radius_clip: Gaussians whose radii are at most this many pixels are culled.
        eps2d: low-pass filter added to the projected covariance, px^2.
        sh_degree: highest degree of the harmonics in use, 0..3; None: `colors` are channels.
        backgrounds: colour behind everything, [C, D]; None is 0.
        render_mode: "RGB", "D" (accumulated depth), "ED" (expected depth), "RGB+D" or "RGB+ED"; depth is
            the last channel.
        absgrad: also leave the sum over pixels of |d loss / d means2d| in `meta["means2d"].absgrad`.
        rasterize_mode: "classic", or "antialiased" (opacities compensated for the low-pass, Mip-Splatting).
        packed, tile_size, sparse_grad, channel_chunk: hints of other implementations; they change nothing.

    Returns:
        render_colors [C, height, width, X], render_alphas [C, height, width, 1], and a dict with means2d
        [C, N, 2] (call `.retain_grad()` on it to get its gradient), radii [C, N, 2] int32 (0 where
        culled), depths [C, N], conics [C, N, 3], opacities [C, N], width, height, n_cameras, tile_size
        and work (pairs, blocks evaluated, blocks with a change; `hqgs.work.work_counts` counts more).

    Raises:
        ValueError: a wrong shape, dtype, device or value, with its name.
        NotImplementedError: an argument of gsplat that hqgs leaves out (other camera models, distortion,
            rolling shutter, distributed rendering, gradients of Ks).
    """
    _refuse({"distributed": distributed, "camera_model": camera_model, **unsupported})
    colors, rest = colors if isinstance(colors, tuple) else (colors, None)
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    if backgrounds is not None:
        tensors["backgrounds"] = backgrounds
    if rest is not None:
        tensors["colors[1]"] = rest
    _check_tensors(tensors, viewmats, Ks)
    n, c = means.shape[0], viewmats.shape[0]
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode: must be one of {RENDER_MODES}, got {render_mode!r}")
    if rasterize_mode not in RASTERIZE_MODES:
        raise ValueError(f"rasterize_mode: must be one of {RASTERIZE_MODES}, got {rasterize_mode!r}")
    for name, value, low in (("width", width, 1), ("height", height, 1)):
        if int(value) != value or value < low:
            raise ValueError(f"{name}: must be an integer of at least {low}, got {value!r}")
    for name, value in (("eps2d", eps2d), ("near_plane", near_plane), ("radius_clip", radius_clip)):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name}: must be finite and not negative, got {value!r}")
    if not far_plane > near_plane:
        raise ValueError(f"far_plane: must be larger than near_plane {near_plane!r}, got {far_plane!r}")
    _check_colors(colors, rest, n, c, sh_degree)

    options = (float(near_plane), float(far_plane), float(radius_clip), float(eps2d))
    frame, means2d, link, depths, conics, radii, alphas_in, sh_colors = _Project.apply(
        means,
        quats,
        scales,
        opacities,
        colors if sh_degree is not None else colors.detach(),
        rest,
        viewmats.to(torch.float64),
        Ks.detach().to(torch.float64),
        (int(width), int(height), (*options, rasterize_mode == "antialiased"), sh_degree),
        torch.is_grad_enabled(),
    )
    channels: Tensor = sh_colors if sh_degree is not None else colors
    if backgrounds is not None and backgrounds.shape != (c, channels.shape[-1]):
        raise ValueError(
            f"backgrounds: expected shape {(c, channels.shape[-1])}, got {tuple(backgrounds.shape)}"
        )
    if render_mode in ("D", "ED"):
        channels, backgrounds = depths[..., None], None
    elif render_mode != "RGB":
        if channels.dim() == 2:
            channels = channels.expand(c, *channels.shape)
        channels = torch.cat([channels, depths[..., None]], dim=-1)
        if backgrounds is not None:
            backgrounds = torch.cat([backgrounds, backgrounds.new_zeros(c, 1)], dim=-1)
    image, alphas, work = _Composite.apply(frame, means2d, link, alphas_in, channels, backgrounds, absgrad)
    if render_mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alphas.clamp(min=1e-10)], dim=-1)
    meta = {
        "means2d": means2d,
        "radii": radii,
        "depths": depths,
        "conics": conics,
        "opacities": alphas_in,
        "width": int(width),
        "height": int(height),
        "tile_size": tile_size,
        "n_cameras": c,
        "camera_ids": None,
        "gaussian_ids": None,
        "work": work,
    }
    return image, alphas, meta


# What gsplat's function takes beyond the above, with the value that asks for nothing.
_NEUTRAL = {
    "distributed": (False,),
    "camera_model": ("pinhole",),
    "segmented": (False,),
    "with_ut": (False,),
    "with_eval3d": (False,),
    "rolling_shutter": (None, 0),
}


def _refuse(unsupported: dict[str, Any]) -> None:
    known = {
        *_NEUTRAL, "covars", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs",
        "lidar_coeffs", "external_distortion_coeffs", "viewmats_rs", "extra_signals", "rays",
    }  # fmt: skip
    for name, value in unsupported.items():
        if name not in known:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        neutral = getattr(value, "name", None) == "GLOBAL" or value in _NEUTRAL.get(name, (None,))
        if not neutral:
            raise NotImplementedError(f"{name}: hqgs renders pinhole cameras only, got {value!r}")


def _check_tensors(tensors: dict[str, Tensor], viewmats: Tensor, Ks: Tensor) -> None:
    for name, value in {**tensors, "viewmats": viewmats, "Ks": Ks}.items():
        if not isinstance(value, Tensor):
            raise ValueError(f"{name}: expected a torch tensor, got {type(value).__name__}")
        if value.device.type != "cpu":
            raise ValueError(f"{name}: must be on the CPU, got a tensor on {value.device}")
        if value.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{name}: must be float32 or float64, got {value.dtype}")
    means = tensors["means"]
    for name, value in tensors.items():
        if value.dtype != means.dtype:
            raise ValueError(f"{name}: must have the dtype of means, {means.dtype}, got {value.dtype}")
    n = means.shape[0] if means.dim() else 0
    for name, shape in (("means", (n, 3)), ("quats", (n, 4)), ("scales", (n, 3)), ("opacities", (n,))):
        if tensors[name].shape != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {tuple(tensors[name].shape)}")
    c = viewmats.shape[0] if viewmats.dim() else 0
    for name, value, shape in (("viewmats", viewmats, (c, 4, 4)), ("Ks", Ks, (c, 3, 3))):
        if value.shape != shape or c == 0:
            raise ValueError(f"{name}: expected shape {('C >= 1', *shape[1:])}, got {tuple(value.shape)}")
    if Ks.requires_grad:
        raise NotImplementedError("Ks: no gradient with respect to the intrinsics; pass Ks.detach()")


def _check_colors(colors: Tensor, rest: Tensor | None, n: int, c: int, sh_degree: int | None) -> None:
    shape = list(colors.shape)
    if sh_degree is None:
        if rest is not None:
            raise ValueError("colors: a pair of tensors is for spherical harmonics, which need sh_degree")
        if shape[:-1] not in ([n], [c, n]) or shape[-1] == 0:
            raise ValueError(f"colors: expected shape [{n}, D] or [{c}, {n}, D], got {shape}")
        return
    if sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree: must be 0, 1, 2 or 3, got {sh_degree!r}")
    needed = (sh_degree + 1) ** 2
    if rest is not None:
        if shape != [n, 1, 3]:
            raise ValueError(f"colors[0]: expected shape [{n}, 1, 3], got {shape}")
        shape = list(rest.shape)
        if len(shape) != 3 or shape[0] != n or shape[1] < needed - 1 or shape[2] != 3:
            wanted = f"[{n}, K >= {needed - 1}, 3] for sh_degree {sh_degree}"
            raise ValueError(f"colors[1]: expected shape {wanted}, got {shape}")
    elif len(shape) != 3 or shape[0] != n or shape[1] < needed or shape[2] != 3:
        wanted = f"[{n}, K >= {needed}, 3] for sh_degree {sh_degree}"
        raise ValueError(f"colors: expected shape {wanted}, got {shape}")


def _numpy(tensor: Tensor) -> np.ndarray[Any, Any]:
    """The tensor's memory as a C-contiguous array; copied only if it is not contiguous."""
    return tensor.detach().contiguous().numpy()


def _optional(tensor: Tensor | None) -> np.ndarray[Any, Any] | None:
    return None if tensor is None else _numpy(tensor)


def _tensor(array: np.ndarray[Any, Any] | None, *shape: int) -> Tensor | None:
    return None if array is None else torch.from_numpy(array).view(shape)


class _Project(torch.autograd.Function):
    """Gaussians to splats. `link` has no values of interest: its cotangent carries the gradient of the 2D
    covariance in whitened form, which stays of order 1 however thin a Gaussian is."""

    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, colors, rest, viewmats, Ks, config, enabled):
        width, height, options, sh_degree = config
        needs_means, *geometry, needs_harmonics, needs_rest, needs_viewmats = ctx.needs_input_grad[:7]
        colors_vary = needs_means or needs_viewmats or needs_harmonics or needs_rest
        options = (*options, enabled and colors_vary)
        inputs = _numpy(means), _numpy(quats), _numpy(scales), _numpy(opacities), _numpy(colors)
        frame, *arrays = _rust.project_forward(
            *inputs, _optional(rest), _numpy(viewmats), _numpy(Ks), width, height, options, sh_degree
        )
        n, c = means.shape[0], viewmats.shape[0]
        means2d, depths, conics, radii, alphas, sh_colors = map(torch.from_numpy, arrays)
        if is_counting():
            add_counts(frame.counts)
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
    def backward(ctx: Any, *grads):
        _, v_means2d, v_link, v_depths, v_conics, _, v_alphas, v_colors = grads
        means, quats, scales, opacities = ctx.saved_tensors
        n, c = ctx.shapes
        needs = list(ctx.needs_input_grad[:7])
        if not ctx.has_harmonics:
            v_colors = None
        *v_inputs, counts = _rust.project_backward(
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
        if is_counting():
            add_gradients(v_inputs, counts)
        if v_inputs[6] is not None:  # computed in f64; stay finite in the dtype of the inputs
            limit = torch.finfo(means.dtype).max
            v_inputs[6].clip(-limit, limit, out=v_inputs[6])
        shapes = [(n, 3), (n, 4), (n, 3), (n,), *ctx.sh_shapes, (c, 4, 4)]
        return (*(_tensor(v, *shape) for v, shape in zip(v_inputs, shapes, strict=True)), None, None, None)


class _Composite(torch.autograd.Function):
    """Splats to pixels."""

    @staticmethod
    def forward(ctx: Any, frame, means2d, link, alphas_in, colors, backgrounds, absgrad):
        channels = colors.shape[-1]
        state, image, alphas = _rust.composite_forward(
            frame, _numpy(colors), _optional(backgrounds), channels
        )
        if is_counting():
            add_counts(state.counts)
        c = means2d.shape[0]
        width, height = frame.width, frame.height
        image = torch.from_numpy(image).view(c, height, width, channels)
        alphas = torch.from_numpy(alphas).view(c, height, width, 1)
        ctx.frame, ctx.state, ctx.absgrad = frame, state, absgrad
        ctx.save_for_backward(means2d, colors, backgrounds)
        ctx.image_shape = image.shape
        ctx.set_materialize_grads(False)
        return image, alphas, state.work

    @staticmethod
    def backward(ctx: Any, *grads):
        v_image, v_alphas, _ = grads
        means2d, colors, backgrounds = ctx.saved_tensors
        _, need_means2d, need_link, need_alphas, need_colors, need_backgrounds, _ = ctx.needs_input_grad
        geometry = need_means2d or need_link or need_alphas
        if v_image is None and v_alphas is None:
            return (None,) * 7
        c, n, channels = means2d.shape[0], means2d.shape[1], colors.shape[-1]
        v_image = means2d.new_zeros(ctx.image_shape) if v_image is None else v_image
        *v_inputs, counts = _rust.composite_backward(
            ctx.frame, ctx.state, _numpy(colors), _optional(backgrounds), _numpy(v_image),
            _optional(v_alphas), channels, [geometry, ctx.absgrad, need_colors, need_backgrounds],
        )  # fmt: skip
        if is_counting():
            add_gradients(v_inputs, counts)
        v_means2d, v_link, v_alphas_in, v_abs, v_colors, v_backgrounds = v_inputs
        if v_abs is not None:
            means2d.absgrad = _tensor(v_abs, c, n, 2)
        v_color = _tensor(v_colors, c, n, channels)
        if v_color is not None and colors.dim() == 2:
            v_color = v_color[0] if c == 1 else v_color.sum(0)
        return (
            None,
            _tensor(v_means2d, c, n, 2),
            _tensor(v_link, c, n, 3),
            _tensor(v_alphas_in, c, n),
            v_color,
            _tensor(v_backgrounds, c, channels),
            None,
        )
