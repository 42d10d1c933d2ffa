"""How photos get bad: JPEG, noise, low resolution and blur, as pure functions of a photo and a generator.

Photos are sRGB as stored, scaled to [0, 1]; nothing is linearised, as in the field's benchmarks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from hqgs.base.threads import one_torch_thread
from hqgs.photos.formula import Degradation, small_side
from hqgs.photos.jpeg import decode_jpeg, encode_jpeg
from hqgs.photos.kernels import REACH, disc_kernel, motion_kernel
from hqgs.photos.pixels import Float32, as_floats
from hqgs.photos.resize import resize


@dataclass(frozen=True)
class Degraded:
    """A degraded photo."""

    image: Float32  # [H, W, 3], the size of the clean photo; may leave [0, 1]
    low: Float32 | None  # [h, w, 3]: with a low-res step, the small photo that `image` was enlarged from
    jpeg: bytes | None  # where JPEG is the last step: the file whose pixels `low`, or else `image`, holds


def degrade_image(
    image: NDArray[np.uint8] | Float32, degradation: Degradation, rng: np.random.Generator
) -> Degraded:
    """Apply the steps to a clean photo [H, W, 3], uint8 or float32 with white at 1.

    Low-res makes the photo small; later steps then happen to the small photo, and at the end bicubic
    resizing brings it back to H x W. Noise and the motion's direction come from `rng`, in the order of the
    steps. ValueError for a photo of another type or shape, one that is not finite, or a blur too wide for it.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype not in (np.uint8, np.float32):
        raise ValueError(f"image must be [H, W, 3] uint8 or float32, got {image.shape} {image.dtype}")
    if not np.isfinite(image).all():
        raise ValueError("image holds NaN or Inf")
    now = as_floats(image)
    small, jpeg = False, None
    for step in degradation.for_width(image.shape[1]).steps:
        amount, jpeg = step.value or 0.0, None
        if step.kind == "jpeg":
            jpeg = encode_jpeg(now, int(amount))
            now = decode_jpeg(jpeg)
        elif step.kind == "lowres":
            now, small = shrink(now, int(amount)), True
        else:
            now = _OPERATORS[step.kind](now, amount, rng)
    if small:
        return Degraded(resize(now, image.shape[0], image.shape[1]), now, jpeg)
    return Degraded(now, None, jpeg)


def add_noise(image: Float32, sigma: float, rng: np.random.Generator) -> Float32:
    """Add N(0, sigma / 255) to every value, independently; neither clipped nor rounded to 8 bits."""
    return image + np.float32(sigma / 255) * rng.standard_normal(image.shape, np.float32)


def shrink(image: Float32, factor: int) -> Float32:
    """The photo [H, W, 3] at [ceil(H / factor), ceil(W / factor), 3] by antialiased bicubic resizing.

    Sizes as imresize rounds them. Where a side is no multiple of the factor, its true ratio of sizes sets
    the step and the kernel, so that both borders stay where they are and the way back moves nothing.
    """
    height, width = image.shape[:2]
    return resize(image, small_side(height, factor), small_side(width, factor))


def gaussian_blur(image: Float32, sigma: float) -> Float32:
    """Convolve [H, W, 3] with a sampled Gaussian of `sigma` px that ends at 4 sigma and sums to 1.

    By kornia, in float64; the border mirrors the picture without repeating the edge pixel (c b | a b c).
    ValueError if the photo is smaller than the kernel's radius allows.
    """
    import torch  # with kornia, which takes seconds to import
    from kornia.filters import gaussian_blur2d

    radius = math.ceil(REACH * sigma)
    _check_fits(image, radius, f"blur of sigma {sigma:g} px")
    channels = torch.from_numpy(image.astype(np.float64)).permute(2, 0, 1)[None]
    with one_torch_thread():
        blurred = gaussian_blur2d(channels, 2 * radius + 1, (sigma, sigma), border_type="reflect")
    return np.ascontiguousarray(blurred[0].permute(1, 2, 0).numpy(), dtype=np.float32)


def convolve(image: Float32, kernel: NDArray[np.float64]) -> Float32:
    """Convolve [H, W, 3] with a kernel of odd size, in float64; the border as in `gaussian_blur`.

    By scipy's FFT: kornia's filter2d takes seconds and gigabytes in float64 for a kernel of 50 px.
    ValueError if the photo is smaller than the kernel's radius allows.
    """
    rows, columns = kernel.shape[0] // 2, kernel.shape[1] // 2
    _check_fits(image, max(rows, columns), f"kernel of {kernel.shape[1]} x {kernel.shape[0]} px")
    padded = np.pad(image.astype(np.float64), ((rows, rows), (columns, columns), (0, 0)), mode="reflect")
    return fftconvolve(padded, kernel[..., None], mode="valid", axes=(0, 1)).astype(np.float32)


def _motion(image: Float32, length: float, rng: np.random.Generator) -> Float32:
    return convolve(image, motion_kernel(length, rng.uniform(0, math.pi)))


_OPERATORS: dict[str, Callable[[Float32, float, np.random.Generator], Float32]] = {
    "noise": add_noise,
    "blur": lambda image, sigma, rng: gaussian_blur(image, sigma),
    "defocus": lambda image, radius, rng: convolve(image, disc_kernel(radius)),
    "motion": _motion,
}


def _check_fits(image: Float32, radius: int, what: str) -> None:
    height, width = image.shape[:2]
    if radius >= min(height, width):
        raise ValueError(f"a {what} reaches {radius} px, too far for a photo of {width} x {height} px")
