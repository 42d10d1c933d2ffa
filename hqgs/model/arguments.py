"""The arguments of the rasterizer: what is refused, and with which words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

MOST_PIXELS = 1 << 32  # of a picture: 64 GB and more
# What gsplat's function takes beyond the above, with the value that asks for nothing.
_NEUTRAL = {
    "distributed": (False,),
    "camera_model": ("pinhole",),
    "segmented": (False,),
    "with_ut": (False,),
    "with_eval3d": (False,),
    "rolling_shutter": (None, 0),
}
_KNOWN = {
    *_NEUTRAL, "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs",
    "lidar_coeffs", "external_distortion_coeffs", "viewmats_rs", "extra_signals", "rays",
}  # fmt: skip
_REASONS = {
    "distributed": "hqgs renders in one process",
    "extra_signals": "hqgs renders what is in colors; append the signals to them",
}


def refuse(unsupported: dict[str, object]) -> None:
    """NotImplementedError for what hqgs leaves out, TypeError for what gsplat has not either."""
    for name, value in unsupported.items():
        if name not in _KNOWN:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        neutral = _NEUTRAL.get(name, (None,))
        plain = isinstance(value, bool | int | float | str | None)
        absent = (plain and value in neutral) or getattr(value, "name", "") == "GLOBAL"
        if not absent:
            why = _REASONS.get(name, "hqgs renders one image of a pinhole camera at a time")
            raise NotImplementedError(f"{name}: {why}, got {short(value)}")


def check_numbers(width: object, height: object, tile_size: object, at_least_0: Mapping[str, object]) -> None:
    """ValueError for sizes that are no integers of at least 1, and numbers below 0 or not finite."""
    for name, value in (("width", width), ("height", height), ("tile_size", tile_size)):
        if not (_number(value) >= 1 and _number(value).is_integer()):
            raise ValueError(f"{name}: must be an integer of at least 1, got {short(value)}")
    if (pixels := _number(width) * _number(height)) > MOST_PIXELS:
        raise ValueError(f"width, height: at most {MOST_PIXELS:,} pixels, got {pixels:,.0f}")
    for name, value in at_least_0.items():
        if not (math.isfinite(_number(value)) and _number(value) >= 0):
            raise ValueError(f"{name}: must be finite and not negative, got {short(value)}")


def _number(value: Any) -> float:
    """Of whatever is one; NaN of anything else."""
    try:
        return math.nan if isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return math.nan


def short(value: object) -> str:
    """A value for a message of one line: of a tensor its shape alone."""
    return f"a tensor {shape_of(value)}" if isinstance(value, Tensor) else repr(value)[:60]


def shape_of(tensor: Tensor) -> str:
    """For a message."""
    return str(list(tensor.shape))


def check_tensors(tensors: dict[str, Tensor], viewmats: Tensor, Ks: Tensor) -> None:
    """Types, devices and shapes of one scene's tensors but `colors`, of which the shape is left."""
    for name, value in {**tensors, "viewmats": viewmats, "Ks": Ks}.items():
        if not isinstance(value, Tensor):
            raise ValueError(f"{name}: expected a torch tensor, got {short(value)}")
        if not value.is_cpu:
            raise ValueError(f"{name}: must be on the CPU, got a tensor on {value.device}")
        if value.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{name}: must be float32 or float64, got {value.dtype}")
    means = tensors["means"]
    for name, value in tensors.items():
        if value.dtype != means.dtype:
            raise ValueError(f"{name}: must have the dtype of means, {means.dtype}, got {value.dtype}")
    _check_shape("means", means, "N", 3)
    n = means.shape[0]
    for name, shape in (("quats", (n, 4)), ("scales", (n, 3)), ("opacities", (n,))):
        if tensors[name].shape != shape:
            raise ValueError(f"{name}: expected shape {list(shape)}, got {shape_of(tensors[name])}")
    _check_shape("viewmats", viewmats, "C", 4, 4)
    c = viewmats.shape[0]
    if c == 0:
        raise ValueError(f"viewmats: expected shape [C >= 1, 4, 4], got {shape_of(viewmats)}")
    if list(Ks.shape) != [c, 3, 3]:
        raise ValueError(f"Ks: expected shape {[c, 3, 3]}, got {shape_of(Ks)}")
    if Ks.requires_grad:
        raise NotImplementedError("Ks: no gradient with respect to the intrinsics; pass Ks.detach()")


def _check_shape(name: str, value: Tensor, size: str, *fixed: int) -> None:
    """Check that `value` is [any, *fixed]; its first `size` is what the other shapes are held against."""
    if value.shape[1:] != fixed or value.dim() == 0:
        batched = value.dim() > len(fixed) + 1 and value.shape[-len(fixed) :] == fixed
        hint = "; leading batch dimensions must be those of means" if batched else ""
        expected = f"[{', '.join(map(str, (size, *fixed)))}]"
        raise ValueError(f"{name}: expected shape {expected}, got {shape_of(value)}{hint}")


def check_colors(colors: Tensor, rest: Tensor | None, n: int, c: int, sh_degree: int | None) -> None:
    """The shape of `colors`, or of the pair that it is."""
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
    elif shape[:-2] not in ([n], [c, n]) or shape[-2] < needed or shape[-1] != 3:
        wanted = f"[{n}, K >= {needed}, 3] or [{c}, {n}, K, 3] for sh_degree {sh_degree}"
        raise ValueError(f"colors: expected shape {wanted}, got {shape}")


def as_backgrounds(value: Tensor | Sequence[object], means: Tensor, batch: Sequence[int], c: int) -> Tensor:
    """Backgrounds as [..., C, D] in the dtype of the means: also from a single colour, or from integers."""
    if not isinstance(value, Tensor):
        try:
            value = torch.tensor(value, dtype=means.dtype, device="cpu")
        except (TypeError, ValueError, RuntimeError):
            raise ValueError(f"backgrounds: expected colours [C, D], or one, got {short(value)}") from None
    if not (value.is_floating_point() or value.is_complex() or value.dtype == torch.bool):
        value = value.to(means.dtype)
    return value.expand(*batch, c, -1) if value.dim() == 1 else value


def batch_of(tensors: dict[str, Tensor]) -> tuple[int, ...]:
    """The leading dimensions of `means` [..., N, 3], which the other tensors must share."""
    means = tensors["means"]
    batch = tuple(means.shape[:-2]) if isinstance(means, Tensor) else ()
    if not batch:
        return ()
    if math.prod(batch) == 0:
        raise ValueError(f"means: no scene in a batch of shape {list(batch)}")
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            raise ValueError(f"{name}: expected a torch tensor, got {short(value)}")
        if tuple(value.shape[: len(batch)]) != batch:
            wanted = f"[{', '.join(map(str, batch))}, ...]"
            raise ValueError(f"{name}: expected shape {wanted}, as means has, got {shape_of(value)}")
    return batch
