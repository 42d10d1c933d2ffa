"""Differentiable rasterization of 3D Gaussians with gsplat's interface, on the CPU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypedDict, cast

import torch
from torch import Tensor

from hqgs._rust import EPS2D, FAR_PLANE, NEAR_PLANE, TILE
from hqgs.model.arguments import (
    as_backgrounds,
    batch_of,
    check_colors,
    check_numbers,
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
    """What `rasterization` knows beside its images, of N Gaussians in C cameras.

    Packed, [C, N] is [M]: the pairs of camera and Gaussian that are not culled, by camera, then Gaussian.
    """

    means2d: Tensor  # [C, N, 2], pixels; call `.retain_grad()` on it to get its gradient
    radii: Tensor  # [C, N, 2], int32, pixels; 0 where culled
    depths: Tensor  # [C, N], world units along the viewing axis
    conics: Tensor  # [C, N, 3], 1/px^2: the inverse 2D covariance's xx, xy, yy
    opacities: Tensor  # [C, N], after the compensation of "antialiased"
    batch_ids: Tensor | None  # [M], int64, the scene of each pair, all three None where nothing is packed
    camera_ids: Tensor | None  # [M], the camera
    gaussian_ids: Tensor | None  # [M], the Gaussian
    width: int
    height: int
    tile_size: int
    tile_width: int  # tiles in a row of the image
    tile_height: int
    n_batches: int
    n_cameras: int
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
    activate: bool = False,
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
        activate: `scales` and `opacities` are what training holds, logarithms and logits; so are gradients.
        packed: whether the meta data hold only what is not culled. Images and gradients are the same.
        tile_size, sparse_grad, channel_chunk: hints of other implementations; they change no image. There are
            no tile lists (`tiles_per_gauss`, `isect_ids`, `flatten_ids`, `isect_offsets`: a KeyError that
            says so).

    Any number of leading batch dimensions, the same for all tensors (but a `backgrounds` [D]), gives as many
    scenes, one after the other: outputs and, unless packed, the tensors of the meta data have them too.

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
    colors, rest = colors if isinstance(colors, tuple | list) and len(colors) == 2 else (colors, None)
    for name, value in (("means", means), ("viewmats", viewmats)):
        if not isinstance(value, Tensor):
            raise ValueError(f"{name}: expected a torch tensor, got {short(value)}")
    upper = None if covars is None else upper_entries(covars, means)
    if upper is not None and activate:
        raise ValueError("activate: not with covars, which are no logarithms")
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
    at_least_0 = {"eps2d": eps2d, "near_plane": near_plane, "radius_clip": radius_clip}
    check_numbers(width, height, tile_size, at_least_0)
    if not far_plane > near_plane:
        raise ValueError(f"far_plane: must be larger than near_plane {near_plane!r}, got {far_plane!r}")
    check_colors(one["colors"], one.get("colors[1]"), n, c, sh_degree)

    numbers = (float(near_plane), float(far_plane), float(radius_clip), float(eps2d))
    config = (int(width), int(height), (*numbers, rasterize_mode == "antialiased"), activate, sh_degree)
    projected = [_project(scene, config) for scene in scenes]
    ids = [(s["radii"] > 0).all(-1).nonzero(as_tuple=True) for s in projected] if packed else None

    def together(values: Sequence[Tensor]) -> Tensor:
        return torch.stack([*values]).unflatten(0, batch) if batch else values[0]

    def of_splats(name: str) -> Tensor:
        values = [splats[name] for splats in projected]
        if ids is None:
            return together(values)
        return torch.cat([value[pair] for value, pair in zip(values, ids, strict=True)])

    means2d = of_splats("means2d")
    parts = [means2d]
    if ids is not None:
        parts = means2d.split([len(cameras) for cameras, _ in ids])
    elif batch:
        parts = means2d.flatten(0, len(batch) - 1).unbind(0)
    # What is composited is the one tensor that the caller gets, or a slice of it: so it has its gradient.
    shots = zip(scenes, projected, parts if batch else [means2d], ids or [None] * len(scenes), strict=True)
    images, alphas, works = zip(*(_composite(*shot, render_mode, absgrad) for shot in shots), strict=True)
    meta: RasterizationMeta = {
        "means2d": means2d,
        "radii": of_splats("radii"),
        "depths": of_splats("depths"),
        "conics": of_splats("conics"),
        "opacities": of_splats("opacities"),
        "batch_ids": None
        if ids is None
        else torch.cat([torch.full_like(k, b) for b, (k, _) in enumerate(ids)]),
        "camera_ids": None if ids is None else torch.cat([cameras for cameras, _ in ids]),
        "gaussian_ids": None if ids is None else torch.cat([gaussians for _, gaussians in ids]),
        "width": int(width),
        "height": int(height),
        "tile_size": tile_size,
        "tile_width": -(-int(width) // tile_size),
        "tile_height": -(-int(height) // tile_size),
        "n_batches": len(scenes),
        "n_cameras": c,
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
    scene: dict[str, Tensor],
    splats: dict[str, Any],
    means2d: Tensor,
    ids: tuple[Tensor, ...] | None,
    render_mode: str,
    absgrad: bool,
) -> tuple[Tensor, Tensor, tuple[int, int, int]]:
    """Images and alphas of one scene's splats, and the work that it was; `means2d` gets the gradient."""
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
        splats["frame"], means2d, splats["link"], splats["opacities"], channels, backgrounds, absgrad, ids
    )
    if render_mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alphas.clamp(min=1e-10)], dim=-1)
    return image, alphas, work
