"""Differentiable rasterization of 3D Gaussians with gsplat's interface, on the CPU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypedDict, cast

import numpy as np
import torch
from torch import Tensor

from hqgs._rust import EPS2D, FAR_PLANE, NEAR_PLANE, TILE
from hqgs.model.arguments import (
    as_backgrounds,
    batch_of,
    check_colors,
    check_tensors,
    refuse,
    shape_of,
    short,
)
from hqgs.model.autograd import _Composite, _Project
from hqgs.model.covariances import quats_and_scales, upper_entries

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
    camera_ids: None  # gsplat has them where it packs its arrays; nothing is packed here, see `rasterization`
    gaussian_ids: None
    work: tuple[int, int, int]  # pairs of Gaussian and tile, blocks evaluated, blocks with a change


_TILE_LISTS = ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets")


class _Meta(dict[str, Any]):
    """A dictionary that says of what gsplat has besides that it is not there."""

    def __missing__(self, key: str) -> Any:
        if key in _TILE_LISTS:
            raise KeyError(f"{key}: hqgs hands out no tile lists")
        raise KeyError(key)


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
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
    backgrounds: Tensor | Sequence[float] | Sequence[Sequence[float]] | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    *,
    covars: Tensor | None = None,
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
        backgrounds: colour behind everything, [C, D], or [D] for all cameras, numbers of any kind; None is 0.
        render_mode: "RGB", "D" (accumulated depth), "ED" (expected depth), "RGB+D" or "RGB+ED"; depth is
            the last channel.
        absgrad: also leave the sum over pixels of `|d loss / d means2d|` in `meta["means2d"].absgrad`.
        rasterize_mode: "classic", or "antialiased" (opacities compensated for the low-pass, Mip-Splatting).
        covars: covariances [N, 3, 3] in place of `quats` and `scales`, which are not looked at then. As for
            gsplat, the entries on and above the diagonal count, those above it for two, and get the gradient.
        packed, tile_size, sparse_grad, channel_chunk: hints of other implementations; they change nothing.
            Arrays are never packed, so that `meta` has no `gaussian_ids` and `camera_ids` (they are None) and
            no tile lists (`tiles_per_gauss`, `isect_ids`, `flatten_ids`, `isect_offsets`: a KeyError that
            says so). A strategy of gsplat works with `packed=False`, its own default, which has these shapes.

    Any number of leading batch dimensions, the same for all tensors (but a `backgrounds` [D]), gives as many
    scenes, one after the other: outputs and the tensors of the meta data have them too.

    Returns:
        render_colors [C, height, width, X], not clamped; render_alphas [C, height, width, 1]; and
        `RasterizationMeta`, the positions, radii and depths of the Gaussians in each camera among it.

    Raises:
        ValueError: a wrong shape, dtype, device or value, with its name.
        RuntimeError: a gradient that was taken with `create_graph=True` is differentiated again.
        NotImplementedError: an argument of gsplat that hqgs leaves out (other camera models, distortion,
            rolling shutter, distributed rendering, gradients of Ks, absgrad of a batch).
    """
    refuse({"distributed": distributed, "camera_model": camera_model, **unsupported})
    colors, rest = colors if isinstance(colors, tuple) else (colors, None)
    upper = None if covars is None else upper_entries(covars, means)
    if upper is not None:
        quats, scales = quats_and_scales(upper)
    tensors: dict[str, Any] = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    tensors["colors"] = colors
    if rest is not None:
        tensors["colors[1]"] = rest
    if upper is not None:
        tensors["covars"] = upper
    batch = batch_of({**tensors, "viewmats": viewmats, "Ks": Ks})
    if backgrounds is not None:
        c = viewmats.shape[len(batch)] if viewmats.dim() > len(batch) else 0
        tensors["backgrounds"] = as_backgrounds(backgrounds, means, batch, c)
        batch_of(tensors)
    if batch and absgrad:
        raise NotImplementedError("absgrad: not with leading batch dimensions; call hqgs for each scene")
    scenes = _each_scene({**tensors, "viewmats": viewmats, "Ks": Ks}, len(batch))
    one = scenes[0]
    check_tensors({name: one[name] for name in tensors}, one["viewmats"], one["Ks"])
    n, c = one["means"].shape[0], one["viewmats"].shape[0]
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode: must be one of {RENDER_MODES}, got {render_mode!r}")
    if rasterize_mode not in RASTERIZE_MODES:
        raise ValueError(f"rasterize_mode: must be one of {RASTERIZE_MODES}, got {rasterize_mode!r}")
    for name, value in (("width", width), ("height", height)):
        if int(value) != value or value < 1:
            raise ValueError(f"{name}: must be an integer of at least 1, got {short(value)}")
    for name, value in (("eps2d", eps2d), ("near_plane", near_plane), ("radius_clip", radius_clip)):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name}: must be finite and not negative, got {short(value)}")
    if not far_plane > near_plane:
        raise ValueError(f"far_plane: must be larger than near_plane {near_plane!r}, got {far_plane!r}")
    check_colors(one["colors"], one.get("colors[1]"), n, c, sh_degree)

    numbers = (float(near_plane), float(far_plane), float(radius_clip), float(eps2d))
    config = (int(width), int(height), (*numbers, rasterize_mode == "antialiased"), sh_degree)
    projected = [_project(scene, config) for scene in scenes]
    joined = projected[0]["means2d"]
    if batch:  # what is composited are slices of the one tensor that the caller gets, with its gradient
        joined = torch.stack([splats["means2d"] for splats in projected]).unflatten(0, batch)
        for splats, means2d in zip(projected, joined.flatten(0, len(batch) - 1).unbind(0), strict=True):
            splats["means2d"] = means2d
    pairs = zip(scenes, projected, strict=True)
    images, alphas, works = zip(*(_composite(a, b, render_mode, absgrad) for a, b in pairs), strict=True)

    def together(values: Sequence[Tensor]) -> Tensor:
        return torch.stack([*values]).unflatten(0, batch) if batch else values[0]

    meta: RasterizationMeta = {
        "means2d": joined,
        "radii": together([splats["radii"] for splats in projected]),
        "depths": together([splats["depths"] for splats in projected]),
        "conics": together([splats["conics"] for splats in projected]),
        "opacities": together([splats["opacities"] for splats in projected]),
        "width": int(width),
        "height": int(height),
        "tile_size": tile_size,
        "n_cameras": c,
        "camera_ids": None,
        "gaussian_ids": None,
        "work": (sum(w[0] for w in works), sum(w[1] for w in works), sum(w[2] for w in works)),
    }
    return together(images), together(alphas), cast(RasterizationMeta, _Meta(meta))


def _each_scene(tensors: dict[str, Tensor], dims: int) -> list[dict[str, Tensor]]:
    """The tensors of each scene of a batch with that many leading dimensions."""
    if not dims:
        return [tensors]
    parts = {name: tensor.flatten(0, dims - 1).unbind(0) for name, tensor in tensors.items()}
    return [dict(zip(parts, values, strict=True)) for values in zip(*parts.values(), strict=True)]


def _project(scene: dict[str, Tensor], config: tuple[Any, ...]) -> dict[str, Any]:
    """The splats of one scene."""
    colors, sh_degree = scene["colors"], config[-1]
    frame, means2d, link, depths, conics, radii, alphas, sh_colors = _Project.apply(
        scene["means"],
        scene["quats"],
        scene["scales"],
        scene["opacities"],
        scene.get("covars"),
        colors if sh_degree is not None else colors.detach(),
        scene.get("colors[1]"),
        scene["viewmats"].to(torch.float64),
        scene["Ks"].detach().to(torch.float64),
        config,
        torch.is_grad_enabled(),
    )
    return {
        "frame": frame,
        "means2d": means2d,
        "link": link,
        "depths": depths,
        "conics": conics,
        "radii": radii,
        "opacities": alphas,
        "channels": sh_colors if sh_degree is not None else colors,
    }


def _composite(
    scene: dict[str, Tensor], splats: dict[str, Any], render_mode: str, absgrad: bool
) -> tuple[Tensor, Tensor, tuple[int, int, int]]:
    """Images and alphas of one scene's splats, and the work that it was."""
    channels, depths, backgrounds = splats["channels"], splats["depths"], scene.get("backgrounds")
    c = len(depths)
    if backgrounds is not None and backgrounds.shape != (c, channels.shape[-1]):
        wanted = [c, channels.shape[-1]]
        raise ValueError(f"backgrounds: expected shape {wanted}, got {shape_of(backgrounds)}")
    if render_mode in ("D", "ED"):
        channels, backgrounds = depths[..., None], None
    elif render_mode != "RGB":
        if channels.dim() == 2:
            channels = channels.expand(c, *channels.shape)
        channels = torch.cat([channels, depths[..., None]], dim=-1)
        if backgrounds is not None:
            backgrounds = torch.cat([backgrounds, backgrounds.new_zeros(c, 1)], dim=-1)
    image, alphas, work = _Composite.apply(
        splats["frame"],
        splats["means2d"],
        splats["link"],
        splats["opacities"],
        channels,
        backgrounds,
        absgrad,
    )
    if render_mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alphas.clamp(min=1e-10)], dim=-1)
    return image, alphas, work
