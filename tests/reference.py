"""The reference for the rasterizer: a dense float64 renderer in plain PyTorch.

It has no tiles and no hand-written gradient. Every formula of docs/conventions.md stands here as written
there; gradients come from autograd, with the decisions (cull, sort, skip, cap, stop) taken on detached
values. Meant for up to about 2,000 Gaussians on small images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

ALPHA_FLOOR = 1.0 / 255.0
ALPHA_CAP = 0.99
TRANSMITTANCE_STOP = 0.999e-4
JACOBIAN_CLAMP = 0.3
QUAT_NORM2_MIN = 1e-12
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
PIXEL_CHUNK = 2048  # bounds the [pixels, Gaussians] table that finds who touches a chunk


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotations [V, 3, 3] of quaternions [V, 4] (w, x, y, z) of any non-zero norm."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def sh_basis(dirs: Tensor) -> Tensor:
    """The 16 real SH functions [V, 16] of degrees 0..3 at unit vectors [V, 3], 3DGS order and signs."""
    x, y, z = dirs.unbind(1)
    xx, yy, zz = x * x, y * y, z * z

    def k(numerator: float, denominator: float) -> float:
        return math.sqrt(numerator / (denominator * math.pi))

    columns = [
        torch.full_like(x, k(1, 4)),
        -k(3, 4) * y,
        k(3, 4) * z,
        -k(3, 4) * x,
        k(15, 4) * x * y,
        -k(15, 4) * y * z,
        k(5, 16) * (2 * zz - xx - yy),
        -k(15, 4) * x * z,
        k(15, 16) * (xx - yy),
        -k(35, 32) * y * (3 * xx - yy),
        k(105, 4) * x * y * z,
        -k(21, 32) * y * (4 * zz - xx - yy),
        k(7, 16) * z * (2 * zz - 3 * xx - 3 * yy),
        -k(21, 32) * x * (4 * zz - xx - yy),
        k(105, 16) * z * (xx - yy),
        -k(35, 32) * x * (xx - 3 * yy),
    ]
    return torch.stack(columns, dim=1)


def sh_colors(coefficients: Tensor, means: Tensor, viewmat: Tensor, sh_degree: int) -> Tensor:
    """max(SH + 0.5, 0) [V, 3] of coefficients [V, K, 3] along camera centre -> mean [V, 3]."""
    active = (sh_degree + 1) ** 2
    center = -torch.linalg.solve(viewmat[:3, :3], viewmat[:3, 3])  # [3]
    offset = means - center  # [V, 3]
    at_center = (offset.detach() == 0).all(dim=1, keepdim=True)  # [V, 1], no direction there
    dirs = torch.where(at_center, torch.ones_like(offset), offset)
    dirs = dirs / dirs.norm(dim=1, keepdim=True)
    basis = sh_basis(dirs)[:, :active]  # [V, A]
    basis = torch.cat([basis[:, :1], torch.where(at_center, 0.0, basis[:, 1:])], dim=1)
    values = (basis[:, :, None] * coefficients[:, :active]).sum(dim=1)  # [V, 3]
    return torch.clamp(values + 0.5, min=0.0)


@dataclass(frozen=True)
class Projected:
    """Gaussians of one camera, before culling."""

    means2d: Tensor  # [V, 2] pixels
    depths: Tensor  # [V] view-space z
    variances: Tensor  # [V, 2] diagonal of cov2d
    conics: Tensor  # [V, 3]
    opacities: Tensor  # [V], compensated when antialiased


def project(
    means: Tensor,  # [V, 3]
    quats: Tensor,  # [V, 4]
    scales: Tensor,  # [V, 3]
    opacities: Tensor,  # [V]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    eps2d: float,
    antialiased: bool,
) -> Projected:
    """EWA projection with the determinants in product form, which does not cancel for thin Gaussians."""
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    x, y, z = (means @ R.T + t).unbind(1)  # [V] each
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)  # [V, 2]

    over_x, over_y = JACOBIAN_CLAMP * width / (2 * fx), JACOBIAN_CLAMP * height / (2 * fy)
    ratio_x = torch.clamp(x / z, -(cx / fx + over_x), (width - cx) / fx + over_x)  # [V]
    ratio_y = torch.clamp(y / z, -(cy / fy + over_y), (height - cy) / fy + over_y)
    tx, ty = z * ratio_x, z * ratio_y
    zero = torch.zeros_like(z)
    J = torch.stack(
        [
            torch.stack([fx / z, zero, -fx * tx / z**2], dim=1),
            torch.stack([zero, fy / z, -fy * ty / z**2], dim=1),
        ],
        dim=1,
    )  # [V, 2, 3]
    M = rotation_matrices(quats) * scales[:, None, :]  # [V, 3, 3] = R(q) diag(s)
    A = J @ R @ M  # [V, 2, 3], cov2d = A A^T + eps2d I
    a1, a2 = A[:, 0], A[:, 1]  # [V, 3]
    xx, xy, yy = (a1 * a1).sum(1), (a1 * a2).sum(1), (a2 * a2).sum(1)  # [V]
    cross = torch.linalg.cross(a1, a2)  # [V, 3]
    det_plain = (cross * cross).sum(1)  # det(A A^T) = |a1 x a2|^2
    det = det_plain + eps2d * (xx + yy) + eps2d**2
    conics = torch.stack([(yy + eps2d) / det, -xy / det, (xx + eps2d) / det], dim=1)  # [V, 3]
    if antialiased:
        # sqrt(det_plain / det); the norm has gradient 0 where the cross product is 0
        opacities = opacities * torch.linalg.vector_norm(cross, dim=1) / torch.sqrt(det)
    return Projected(means2d, z, torch.stack([xx, yy], dim=1) + eps2d, conics, opacities)


@dataclass(frozen=True)
class Pixels:
    """What one chunk of pixels sees. A margin is the smallest relative distance to a jump, at most 0.1."""

    color: Tensor  # [P, X], without background
    transmittance: Tensor  # [P]
    min_margin: Tensor  # [P], of any visited alpha to the floor and of any T to the stop
    cap_margin: Tensor  # [P], of any visited alpha to the cap (the gradient jumps there)
    order_margin: Tensor  # [P], depth gap of neighbours in the order, over the depth


def _add_absolute(total: Tensor, grad: Tensor) -> None:
    """total [2] += sum over pixels of |grad| [P, 2]."""
    total += grad.abs().sum(0)


def composite(
    pixels: Tensor,  # [P, 2]
    means2d: Tensor,  # [V, 2], all from here on sorted by (depth, index)
    conics: Tensor,  # [V, 3]
    opacities: Tensor,  # [V]
    features: Tensor,  # [V, X]
    depths: Tensor,  # [V]
    absgrad: list[Tensor] | None,  # V of [2], receive the sums of |per-pixel gradient| during backward
) -> Pixels:
    """Front to back over the Gaussians, all pixels at once."""
    with torch.no_grad():  # who stays clearly below the floor in every pixel would be skipped in every pixel
        d = pixels[:, None] - means2d  # [P, V, 2]
        power = 0.5 * (conics[:, 0] * d[..., 0] ** 2 + conics[:, 2] * d[..., 1] ** 2)
        power = power + conics[:, 1] * d[..., 0] * d[..., 1]  # [P, V]
        reach = torch.log(opacities / (0.9 * ALPHA_FLOOR))  # [V]
        touching = (power.amin(0) <= reach).nonzero()[:, 0].tolist()

    P = pixels.shape[0]
    transmittance = torch.ones(P, dtype=pixels.dtype)
    done = torch.zeros(P, dtype=torch.bool)
    min_margin, cap_margin, order_margin = (torch.full((P,), 0.1, dtype=pixels.dtype) for _ in range(3))
    last_depth = torch.full((P,), -math.inf, dtype=pixels.dtype)
    weights: list[Tensor] = []  # [P] each
    for i in touching:
        center = means2d[i].expand(P, 2)
        if absgrad is not None and center.requires_grad:
            center.register_hook(partial(_add_absolute, absgrad[i]))
        dx, dy = (pixels - center).unbind(1)  # [P]
        a, b, c = conics[i].unbind(0)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        uncapped = opacities[i] * torch.exp(-sigma)
        alpha = torch.where(uncapped.detach() < ALPHA_CAP, uncapped, ALPHA_CAP)
        after = transmittance * (1 - alpha)

        with torch.no_grad():
            visited = ~done
            reaches = visited & (alpha >= ALPHA_FLOOR)
            stops = reaches & (after <= TRANSMITTANCE_STOP)
            blended = reaches & ~stops
            done = done | stops
            floor_gap = torch.where(visited, (alpha / ALPHA_FLOOR - 1).abs(), math.inf)
            stop_gap = torch.where(reaches, (after / TRANSMITTANCE_STOP - 1).abs(), math.inf)
            min_margin = torch.minimum(min_margin, torch.minimum(floor_gap, stop_gap))
            cap_gap = torch.where(visited, (uncapped / ALPHA_CAP - 1).abs(), math.inf)
            cap_margin = torch.minimum(cap_margin, cap_gap)
            order_gap = torch.where(reaches, (depths[i] - last_depth) / depths[i], math.inf)
            order_margin = torch.minimum(order_margin, order_gap)
            last_depth = torch.where(reaches, depths[i], last_depth)

        weights.append(torch.where(blended, transmittance * alpha, 0.0))
        transmittance = torch.where(blended, after, transmittance)

    if weights:
        color = torch.stack(weights, dim=1) @ features[touching]  # [P, X]
    else:
        color = torch.zeros(P, features.shape[1], dtype=pixels.dtype)
    return Pixels(color, transmittance, min_margin, cap_margin, order_margin)


def reference_rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, D], [C, N, D]; with sh_degree [N, K, 3], [C, N, K, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,  # [C, D]
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    absgrad: bool = False,
    packed: bool = False,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render in float64: (render [C, H, W, X], alphas [C, H, W, 1], meta), never packed.

    meta: `means2d` [C, N, 2], `depths` [C, N], `conics` [C, N, 3], `opacities` [C, N], all 0 where culled;
    `radii` [C, N, 2] int32; `extents` [C, N, 2], the radii before rounding, also of off-screen Gaussians;
    `overlaps` [C, N], by how many pixels the box of the extents reaches into the image (negative: outside);
    `min_margin`, `cap_margin`, `order_margin` [C, H, W] (see Pixels). With `absgrad`, backward fills
    `means2d.absgrad` [C, N, 2].
    """
    assert render_mode in RENDER_MODES
    assert not packed
    assert rasterize_mode in ("classic", "antialiased")
    f64 = torch.float64
    means, quats, scales, opacities, colors = (v.to(f64) for v in (means, quats, scales, opacities, colors))
    viewmats, Ks = viewmats.to(f64), Ks.to(f64)
    C, N = viewmats.shape[0], means.shape[0]
    if colors.dim() == (2 if sh_degree is None else 3):
        colors = colors.expand(C, *colors.shape)  # [C, N, D] or [C, N, K, 3]
    with_color, with_depth = render_mode.startswith("RGB"), render_mode.endswith("D")
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).reshape(-1, 2).to(f64) + 0.5  # [H W, 2]

    def camera_projection(c: int, ids: Tensor) -> Projected:
        means_, quats_, scales_, opacities_ = (v[ids] for v in (means, quats, scales, opacities))
        antialiased = rasterize_mode == "antialiased"
        return project(
            means_, quats_, scales_, opacities_, viewmats[c], Ks[c], width, height, eps2d, antialiased
        )

    # Decisions first, on detached values: what is culled takes no part in anything that has a gradient.
    radii = torch.zeros(C, N, 2, dtype=torch.int32)
    extents = torch.zeros(C, N, 2, dtype=f64)
    overlaps = torch.zeros(C, N, dtype=f64)
    visible: list[Tensor] = []  # per camera [V], ascending
    with torch.no_grad():
        for c in range(C):
            p = camera_projection(c, torch.arange(N))
            used = colors[c] if sh_degree is None else colors[c][:, : (sh_degree + 1) ** 2]
            tables = (means, quats, scales, used, p.means2d, p.conics, p.variances, p.opacities, opacities)
            keep = torch.stack([torch.isfinite(v.reshape(N, -1)).all(1) for v in tables]).all(0)
            keep &= (quats * quats).sum(1) >= QUAT_NORM2_MIN
            keep &= (p.depths >= near_plane) & (p.depths <= far_plane) & (p.opacities >= ALPHA_FLOOR)
            r = torch.sqrt(2 * torch.log(255 * p.opacities.clamp(min=ALPHA_FLOOR)).clamp(min=0))  # [N]
            extents[c] = torch.where(keep[:, None], r[:, None] * torch.sqrt(p.variances), 0.0)
            low, high = p.means2d - extents[c], p.means2d + extents[c]
            overlaps[c] = torch.minimum(high, torch.tensor([width, height]) - low).amin(1)
            keep &= overlaps[c] > 0
            rounded = extents[c].ceil().clamp(max=2**31 - 1)
            keep &= (rounded > radius_clip).any(1)
            radii[c] = torch.where(keep[:, None], rounded, 0).to(torch.int32)
            visible.append(keep.nonzero()[:, 0])

    projections = [camera_projection(c, ids) for c, ids in enumerate(visible)]

    def scatter(name: str) -> Tensor:
        """[C, N, ...] with 0 for culled Gaussians."""
        tables = []
        for ids, p in zip(visible, projections, strict=True):
            values = getattr(p, name)
            tables.append(torch.zeros(N, *values.shape[1:], dtype=f64).index_copy(0, ids, values))
        return torch.stack(tables)

    meta: dict[str, Any] = {name: scatter(name) for name in ("means2d", "depths", "conics", "opacities")}
    meta.update(radii=radii, extents=extents, overlaps=overlaps)
    totals = torch.zeros(C, N, 2, dtype=f64) if absgrad else None
    if totals is not None:
        meta["means2d"].absgrad = totals

    renders: list[Tensor] = []
    alphas: list[Tensor] = []
    margins: dict[str, list[Tensor]] = {"min_margin": [], "cap_margin": [], "order_margin": []}
    for c, unsorted in enumerate(visible):
        # A stable sort of ascending ids: (view depth, index).
        ids = unsorted[torch.sort(meta["depths"][c, unsorted].detach(), stable=True).indices]  # [V]
        means2d, depths, conics, compensated = (
            meta[name][c, ids] for name in ("means2d", "depths", "conics", "opacities")
        )
        shown = colors[c, ids]  # [V, D] or [V, K, 3]
        if sh_degree is not None:
            shown = sh_colors(shown, means[ids], viewmats[c], sh_degree)
        columns = ([shown] if with_color else []) + ([depths[:, None]] if with_depth else [])
        features = torch.cat(columns, dim=1)  # [V, X]
        rows = None if totals is None else [totals[c, i] for i in ids.tolist()]
        parts = [
            composite(chunk, means2d, conics, compensated, features, depths.detach(), rows)
            for chunk in pixels.split(PIXEL_CHUNK)
        ]
        transmittance = torch.cat([part.transmittance for part in parts])[:, None]  # [H W, 1]
        alpha = 1 - transmittance
        render = torch.cat([part.color for part in parts])  # [H W, X]
        color, depth = render.split([render.shape[1] - with_depth, int(with_depth)], dim=1)
        if backgrounds is not None and with_color:
            color = color + transmittance * backgrounds[c].to(f64)
        if render_mode.endswith("ED"):
            depth = depth / alpha.clamp(min=1e-10)
        renders.append(torch.cat([color, depth], dim=1).reshape(height, width, -1))
        alphas.append(alpha.reshape(height, width, 1))
        for name, maps in margins.items():
            maps.append(torch.cat([getattr(part, name) for part in parts]).reshape(height, width))
    meta.update({name: torch.stack(maps) for name, maps in margins.items()})
    return torch.stack(renders), torch.stack(alphas), meta


def safe_pixels(meta: dict[str, Any], dtype: torch.dtype, smooth: bool = False) -> Tensor:
    """Pixels [C, H, W] where a computation in `dtype` must take every decision as the reference does.

    `smooth` leaves out the kinks at the alpha cap too, where only the gradient jumps.
    """
    margin = 1e-4 if dtype == torch.float32 else 1e-10
    safe = (meta["min_margin"] > margin) & (meta["order_margin"] > 0.1 * margin)
    return safe & (meta["cap_margin"] > margin) if smooth else safe
