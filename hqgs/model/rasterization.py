"""Differentiable rasterization of 3D Gaussians with gsplat's interface, on the CPU."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
import torch
from torch import Tensor

from hqgs._rust import EPS2D, FAR_PLANE, NEAR_PLANE, TILE
from hqgs.model.autograd import _Composite, _Project

__all__ = ["RasterizationMeta", "rasterization"]
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")


class RasterizationMeta(TypedDict):
    """What `rasterization` knows beside its images, of N Gaussians in C cameras."""

    means2d: Tensor  # [C, N, 2], pixels; call `.retain_grad()` on it to get its gradient
    radii: Tensor  # [C, N, 2], int32, pixels; 0 where culled
    depths: Tensor  # [C, N], world units along the viewing axis
    conics: Tensor  # [C, N, 3], 1/px^2: the inverse 2D covariance's xx, xy, yy
    opacities: Tensor  # [C, N], after the compensation of "antialiased"
    width: int
    height: int
    tile_size: int
    n_cameras: int
    camera_ids: None  # gsplat has them where it packs its arrays; nothing is packed here
    gaussian_ids: None
    work: tuple[int, int, int]  # pairs of Gaussian and tile, blocks evaluated, blocks with a change


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
    near_plane: float = NEAR_PLANE,
    far_plane: float = FAR_PLANE,
    radius_clip: float = 0.0,
    eps2d: float = EPS2D,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = TILE,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    **unsupported: object,
) -> tuple[Tensor, Tensor, RasterizationMeta]:
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
        absgrad: also leave the sum over pixels of `|d loss / d means2d|` in `meta["means2d"].absgrad`.
        rasterize_mode: "classic", or "antialiased" (opacities compensated for the low-pass, Mip-Splatting).
        packed, tile_size, sparse_grad, channel_chunk: hints of other implementations; they change nothing.

    Returns:
        render_colors [C, height, width, X], not clamped; render_alphas [C, height, width, 1]; and
        `RasterizationMeta`, the positions, radii and depths of the Gaussians in each camera among it.

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
            raise ValueError(f"{name}: must be an integer of at least {low}, got {_short(value)}")
    for name, value in (("eps2d", eps2d), ("near_plane", near_plane), ("radius_clip", radius_clip)):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name}: must be finite and not negative, got {_short(value)}")
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
        raise ValueError(f"backgrounds: expected shape {[c, channels.shape[-1]]}, got {_shape(backgrounds)}")
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
    meta: RasterizationMeta = {
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
_REASONS = {
    "covars": "hqgs takes the shape of a Gaussian as quats and scales",
    "distributed": "hqgs renders in one process",
    "extra_signals": "hqgs renders what is in colors; append the signals to them",
}


def _refuse(unsupported: dict[str, object]) -> None:
    known = {
        *_NEUTRAL, "covars", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs",
        "lidar_coeffs", "external_distortion_coeffs", "viewmats_rs", "extra_signals", "rays",
    }  # fmt: skip
    for name, value in unsupported.items():
        if name not in known:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        neutral = _NEUTRAL.get(name, (None,))
        absent = not isinstance(value, Tensor) and (
            value in neutral or getattr(value, "name", "") == "GLOBAL"
        )
        if not absent:
            why = _REASONS.get(name, "hqgs renders one image of a pinhole camera at a time")
            raise NotImplementedError(f"{name}: {why}, got {_short(value)}")


def _short(value: object) -> str:
    """A value for a message of one line: of a tensor its shape alone."""
    return f"a tensor {_shape(value)}" if isinstance(value, Tensor) else repr(value)[:60]


def _shape(tensor: Tensor) -> str:
    return str(list(tensor.shape))


def _check_tensors(tensors: dict[str, Tensor], viewmats: Tensor, Ks: Tensor) -> None:
    for name, value in {**tensors, "viewmats": viewmats, "Ks": Ks}.items():
        if not isinstance(value, Tensor):
            like = " such as torch.zeros(C, D)" if name == "backgrounds" else ""
            raise ValueError(f"{name}: expected a torch tensor{like}, got {_short(value)}")
        if value.device.type != "cpu":
            raise ValueError(f"{name}: must be on the CPU, got a tensor on {value.device}")
        if value.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{name}: must be float32 or float64, got {value.dtype}")
    means = tensors["means"]
    for name, value in tensors.items():
        if value.dtype != means.dtype:
            raise ValueError(f"{name}: must have the dtype of means, {means.dtype}, got {value.dtype}")
    _check_shape("means", means, "N", 3)
    n = len(means)
    for name, shape in (("quats", [n, 4]), ("scales", [n, 3]), ("opacities", [n])):
        if list(tensors[name].shape) != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {_shape(tensors[name])}")
    _check_shape("viewmats", viewmats, "C", 4, 4)
    c = len(viewmats)
    if c == 0:
        raise ValueError(f"viewmats: expected shape [C >= 1, 4, 4], got {_shape(viewmats)}")
    if list(Ks.shape) != [c, 3, 3]:
        raise ValueError(f"Ks: expected shape {[c, 3, 3]}, got {_shape(Ks)}")
    if Ks.requires_grad:
        raise NotImplementedError("Ks: no gradient with respect to the intrinsics; pass Ks.detach()")


def _check_shape(name: str, value: Tensor, size: str, *fixed: int) -> None:
    """Check that `value` is [any, *fixed]; its first `size` is what the other shapes are held against."""
    if value.shape[1:] != fixed or value.dim() == 0:
        batched = value.dim() > len(fixed) + 1 and value.shape[-len(fixed) :] == fixed
        hint = "; hqgs takes no leading batch dimensions, call it for each scene" if batched else ""
        expected = f"[{', '.join(map(str, (size, *fixed)))}]"
        raise ValueError(f"{name}: expected shape {expected}, got {_shape(value)}{hint}")


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
