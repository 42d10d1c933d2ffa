"""Edges of a photo: the Sobel gradient magnitude, and the photo seen through it."""

from __future__ import annotations

import torch
from torch import Tensor

from hqgs.photos.pixels import floats

# Sobel sums of equal numbers differ by rounding alone up to about this, times the largest |value|. 8-bit
# photos have steps of at least 1/255, far above it.
SOBEL_ROUNDING = 1e-5


def edge_magnitude(image: Tensor, mask: Tensor | None = None) -> Tensor:
    """Sobel gradient magnitude g [H, W, C] in [0, 1] of an image (HQGS, equation of the edge map).

    sqrt(Ix^2 + Iy^2) for each channel, as the method multiplies it with the image element by element; then
    min-max normalised with one minimum and one maximum for the image. The border is repeated outwards by
    one pixel (kornia's choice), so a constant row or column has no edge at the border. An image without
    edges, such as a constant or a one-pixel one, gives 0 everywhere. No gradient flows through it.

    Args:
        image: [H, W, C], float of any range, or uint8 (divided by 255).
        mask: bool [H, W], True where the photo counts. A pixel whose 3 x 3 neighbours do not all count has
            g = 0 and does not take part in the minimum and the maximum.

    Raises:
        ValueError: a wrong shape or dtype, no pixel, or a value that is not finite.
    """
    from kornia.filters import spatial_gradient  # takes seconds to import

    values = _checked(image, mask)
    ix, iy = spatial_gradient(values.permute(2, 0, 1)[None], mode="sobel", normalized=False)[0].unbind(1)
    magnitude = torch.hypot(ix, iy).permute(1, 2, 0)
    if mask is not None:
        uncounted = torch.nn.functional.max_pool2d((~mask)[None, None].float(), 3, stride=1, padding=1)[0, 0]
        inside = uncounted == 0
        if not inside.any():
            return torch.zeros_like(values)
        counted = magnitude[inside]
    else:
        inside, counted = None, magnitude
    low, high = counted.amin(), counted.amax()
    if high - low <= SOBEL_ROUNDING * values.abs().amax():
        return torch.zeros_like(values)
    # A pixel outside the mask may lie outside the range; it gets 0 below.
    g = (magnitude - low) / (high - low)
    return (g if inside is None else torch.where(inside[..., None], g, 0.0)).contiguous()


def edge_aware_map(image: Tensor, mask: Tensor | None = None) -> Tensor:
    """E = g * I [H, W, C] (HQGS, equation of the edge-aware map): bright where the photo has edges.

    Arguments and errors are those of `edge_magnitude`; a uint8 image counts as image / 255.
    """
    return edge_magnitude(image, mask) * _checked(image, mask)


def _checked(image: Tensor, mask: Tensor | None) -> Tensor:
    """The image as floats, detached; ValueError where it is none."""
    if image.ndim != 3 or not image.numel():
        raise ValueError(f"image: must be [H, W, C] with at least one pixel, got {list(image.shape)}")
    if image.dtype not in (torch.uint8, torch.float32, torch.float64):
        raise ValueError(f"image: must be uint8, float32 or float64, got {image.dtype}")
    if mask is not None and (mask.dtype != torch.bool or mask.shape != image.shape[:2]):
        wanted = list(image.shape[:2])
        raise ValueError(f"mask: must be bool {wanted} as the image, got {mask.dtype} {list(mask.shape)}")
    values = floats(image.detach())
    if not torch.isfinite(values).all():
        raise ValueError(f"image: {int((~torch.isfinite(values)).sum())} values are not finite")
    return values
