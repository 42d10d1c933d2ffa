"""Differentiable rasterization of 3D Gaussians with gsplat's interface, on the CPU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor

from hqgs._rust import EPS2D, FAR_PLANE, NEAR_PLANE, TILE
from hqgs.base.threads import one_torch_thread
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
from hqgs.model.autograd import _Composite, _Project, quats_and_scales
from hqgs.model.meta import Later, Meta, OfScene, Pairs, RasterizationMeta

__all__ = ["RasterizationMeta", "rasterization"]
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")


@one_torch_thread()
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
        colors: [N, D] or [C, N, D] channels; with `sh_degree` spherical harmonics, [N, K, 3] or [C, N, K, 3],
            or a pair of them, [N, 1, 3] and [N, K - 1, 3], which saves joining what is trained apart.
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
    if covars is not None and activate:
        raise ValueError("activate: not with covars, which are not logarithms")
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    given |= {"covars": covars, "backgrounds": backgrounds, "viewmats": viewmats, "Ks": Ks}
    scenes, batch = _scenes(given, sh_degree)
    if batch and absgrad:
        raise NotImplementedError("absgrad: not with leading batch dimensions; call hqgs for each scene")
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode: must be one of {RENDER_MODES}, got {render_mode!r}")
    if rasterize_mode not in RASTERIZE_MODES:
        raise ValueError(f"rasterize_mode: must be one of {RASTERIZE_MODES}, got {rasterize_mode!r}")
    at_least_0 = {"eps2d": eps2d, "near_plane": near_plane, "radius_clip": radius_clip}
    check_numbers(width, height, tile_size, at_least_0)
    if not far_plane > near_plane:
        raise ValueError(f"far_plane: must be larger than near_plane {near_plane!r}, got {far_plane!r}")
    numbers = (float(near_plane), float(far_plane), float(radius_clip), float(eps2d))
    config = (int(width), int(height), (*numbers, rasterize_mode == "antialiased"), activate, sh_degree)
    images, alphas, meta = _rendered(scenes, batch, config, packed, render_mode, absgrad)
    size = {"width": int(width), "height": int(height), "tile_size": tile_size}
    size |= {"tile_width": -(-int(width) // tile_size), "tile_height": -(-int(height) // tile_size)}
    return images, alphas, cast(RasterizationMeta, Meta(meta | size))


def _scenes(given: dict[str, Any], sh_degree: int | None) -> tuple[list[dict[str, Tensor]], tuple[int, ...]]:
    """The tensors of each scene of a batch, checked, and the batch's dimensions."""
    colors = given["colors"]
    pair = isinstance(colors, tuple | list) and len(colors) == 2
    given["colors"], rest = colors if pair else (colors, None)
    means, viewmats = given["means"], given["viewmats"]
    for name, value in (("means", means), ("viewmats", viewmats)):
        if not isinstance(value, Tensor):
            raise ValueError(f"{name}: expected a torch tensor, got {short(value)}")
    if given["covars"] is not None:
        given["quats"], given["scales"] = quats_and_scales(given["covars"], means)
    names = ["means", "quats", "scales", "opacities", "colors"]
    tensors: dict[str, Any] = {name: given[name] for name in names}
    tensors |= {"colors[1]": rest} if rest is not None else {}
    tensors |= {"covars": given["covars"]} if given["covars"] is not None else {}
    cameras = {"viewmats": viewmats, "Ks": given["Ks"]}
    batch = batch_of(tensors | cameras)
    if given["backgrounds"] is not None:
        c = viewmats.shape[len(batch)] if viewmats.dim() > len(batch) else 0
        tensors["backgrounds"] = as_backgrounds(given["backgrounds"], means, batch, c)
        batch_of(tensors)
    scenes = _each_scene(tensors | cameras, len(batch))
    one = scenes[0]
    check_tensors({name: one[name] for name in tensors}, one["viewmats"], one["Ks"])
    check_colors(one["colors"], one.get("colors[1]"), len(one["means"]), len(one["viewmats"]), sh_degree)
    return scenes, batch


def _rendered(
    scenes: list[dict[str, Tensor]],
    batch: tuple[int, ...],
    config: tuple[Any, ...],
    packed: bool,
    render_mode: str,
    absgrad: bool,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Images, alphas and what the meta data hold of the splats."""
    projected = [_project(scene, config) for scene in scenes]
    pairs = Pairs(projected) if packed else None
    parts: Sequence[Tensor | None] = [None] * len(scenes)

    def together(values: Sequence[Tensor]) -> Tensor:
        return torch.stack([*values]).unflatten(0, batch) if batch else values[0]

    def of_splats(name: str) -> Any:
        values = [splats[name] for splats in projected]
        return together(values) if pairs is None else Later(pairs.packed, *values)

    # What is composited is the one tensor that the caller gets, or a slice of it: so it has its gradient.
    means2d, dense = of_splats("means2d"), [splats["means2d"] for splats in projected]
    if pairs is None and batch:
        dense = means2d.flatten(0, len(batch) - 1).unbind(0)
    elif pairs is not None and dense[0].requires_grad:
        positions = pairs.positions(*dense)
        means2d = Later(pairs.shown, positions, *dense)
        parts = positions.split(pairs.counts) if batch else [positions]
        if absgrad:  # it is left in there
            pairs.shown(positions, *dense)
    shots = zip(scenes, projected, dense, parts, strict=True)
    rendered = (
        _composite(*shot, pairs and OfScene(pairs, k), render_mode, absgrad) for k, shot in enumerate(shots)
    )
    images, alphas, works = zip(*rendered, strict=True)
    meta = {"means2d": means2d} | {
        name: of_splats(name) for name in ("radii", "depths", "conics", "opacities")
    }
    for k, name in enumerate(("batch_ids", "camera_ids", "gaussian_ids")):
        meta[name] = pairs and Later(pairs.ids, k)
    meta |= {"n_batches": len(scenes), "n_cameras": len(scenes[0]["viewmats"])}
    meta["work"] = tuple(sum(work[k] for work in works) for k in range(3))
    return together(images), together(alphas), meta


def _each_scene(tensors: dict[str, Tensor], dims: int) -> list[dict[str, Tensor]]:
    """The tensors of each scene of a batch with that many leading dimensions."""
    if not dims:
        return [tensors]
    parts = {name: tensor.flatten(0, dims - 1).unbind(0) for name, tensor in tensors.items()}
    return [dict(zip(parts, values, strict=True)) for values in zip(*parts.values(), strict=True)]


def _project(scene: dict[str, Tensor], config: tuple[Any, ...]) -> dict[str, Any]:
    """The splats of one scene."""
    colors, sh_degree = scene["colors"], config[-1]
    names = "frame", "means2d", "link", "depths", "conics", "radii", "opacities", "channels"
    splats = _Project.apply(
        scene["means"],
        scene["quats"],
        scene["scales"],
        scene["opacities"],
        scene.get("covars"),
        colors if sh_degree is not None else colors.detach(),
        scene.get("colors[1]"),
        scene["viewmats"],
        scene["Ks"],
        config,
        torch.is_grad_enabled(),
    )
    found: dict[str, Any] = dict(zip(names, splats, strict=True))
    return found if sh_degree is not None else found | {"channels": colors}


def _composite(
    scene: dict[str, Tensor],
    splats: dict[str, Any],
    means2d: Tensor,
    packed: Tensor | None,
    which: OfScene | None,
    render_mode: str,
    absgrad: bool,
) -> tuple[Tensor, Tensor, tuple[int, int, int]]:
    """Images and alphas of one scene's splats, and the work that it was; `means2d` gets the gradient."""
    channels, depths, backgrounds = splats["channels"], splats["depths"], scene.get("backgrounds")
    wanted = [len(depths), channels.shape[-1]]
    if backgrounds is not None and list(backgrounds.shape) != wanted:
        raise ValueError(f"backgrounds: expected shape {wanted}, got {shape_of(backgrounds)}")
    return _Composite.apply(
        splats["frame"],
        means2d,
        packed,
        splats["link"],
        splats["opacities"],
        channels,
        depths,
        backgrounds,
        render_mode,
        absgrad,
        which,
    )
