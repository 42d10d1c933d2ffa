"""Differentiable rasterization of 3D Gaussians with gsplat's interface, on the CPU."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor

from hqgs._rust import EPS2D, FAR_PLANE, NEAR_PLANE, TILE
from hqgs.base.threads import one_torch_thread
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
    if not _number(far_plane) > near_plane:
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
    meta["work"] = tuple(sum(work[k] for work in works) for k in range(2))
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
    if sh_degree not in (0, 1, 2, 3) or isinstance(sh_degree, float):
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
