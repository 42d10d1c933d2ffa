"""How photos get bad, as pure functions of photos and generators.

Photos are sRGB as stored, scaled to [0, 1]. JPEG, noise, low resolution, blur, defocus and motion happen to
these values and nothing is linearised, as in the field's benchmarks. What else happens to photos, the
benchmarks add to `OPERATORS`, `FILES` and `FILMS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.base.threads import one_torch_thread
from hqgs.photos.formation import KERNEL_REACH, disc_kernel, motion_kernel
from hqgs.photos.formula import KINDS, Degradation, DegradationStep, small_side
from hqgs.photos.jpeg import decode_jpeg, encode_jpeg
from hqgs.photos.pixels import Float32, as_floats
from hqgs.photos.resize import resize

Record = dict[str, Any]  # what one step did to one photo: "kind", "value" and the kind's own values, for JSON


@dataclass(frozen=True)
class Degraded:
    """A degraded photo."""

    image: Float32  # [H, W, 3], the size of the clean photo; may leave [0, 1]
    low: Float32 | None  # [h, w, 3]: with a low-res step, the small photo that `image` was enlarged from
    jpeg: bytes | None  # where JPEG or a phone is the last step: the file that `low`, or else `image`, holds
    records: list[Record] = field(default_factory=list)  # one for each step that happened to this photo


def degrade_sequence(
    images: Sequence[NDArray[np.uint8] | Float32],
    degradation: Degradation,
    rngs: Sequence[np.random.Generator],
    factors: Sequence[float | None],
) -> list[Degraded]:
    """Apply the steps to clean photos [H, W, 3], uint8 or float32 with white at 1.

    Only a film (`FILMS`) lets one photo depend on another. Low-res makes a photo small; later steps then
    happen to the small photo, and at the end bicubic resizing brings it back to H x W. What is random comes
    from the photo's generator, in the order of the steps. A `some` step happens with the photo's factor times
    its value, and not at all without one. ValueError for a photo of another type or shape, one that is not
    finite, a blur too wide for it, or photos of several sizes before a film.

    What the records hold beside "kind" and "value" (the step's, with its factor):
    motion: "direction" (radians from x towards y, which points down).
    """
    photos = [_Photo(image, rng) for image, rng in zip(images, rngs, strict=True)]
    all_steps = [degradation.for_width(*photo.size).steps for photo in photos]
    for k, step in enumerate(degradation.steps):
        if step.kind in FILMS:
            value = all_steps[0][k].value or 0
            value = int(value) if KINDS[step.kind].integer else value
            frames = FILMS[step.kind]([photo.now for photo in photos], value)
            for photo, (image, own) in zip(photos, frames, strict=True):
                photo.now, photo.jpeg = image, None
                photo.records.append({"kind": step.kind, "value": value, **own})
            continue
        for photo, steps, factor in zip(photos, all_steps, factors, strict=True):
            if not step.some:
                photo.apply(steps[k])
            elif factor is not None:
                photo.apply(steps[k].scaled(factor))
    return [photo.degraded() for photo in photos]


class _Photo:
    """A photo on its way through the steps."""

    def __init__(self, image: NDArray[np.uint8] | Float32, rng: np.random.Generator) -> None:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype not in (np.uint8, np.float32):
            raise ValueError(f"image must be [H, W, 3] uint8 or float32, got {image.shape} {image.dtype}")
        if not np.isfinite(image).all():
            raise ValueError("image holds NaN or Inf")
        self.size = (image.shape[1], image.shape[0])
        self.now, self.small, self.jpeg = as_floats(image), False, None
        self.records: list[Record] = []
        self._rng = rng

    def apply(self, step: DegradationStep) -> None:
        """One step that has a value and concerns this photo alone."""
        value, self.jpeg = step.value or 0.0, None
        own: Record = {}
        if step.kind in FILES:
            self.jpeg, own = FILES[step.kind](self.now, value, self._rng)
            self.now = decode_jpeg(self.jpeg)
        elif step.kind == "lowres":
            self.now, self.small = shrink(self.now, int(value)), True
        else:
            self.now, own = OPERATORS[step.kind](self.now, value, self._rng)
        self.records.append({"kind": step.kind, "value": step.value, **own})

    def degraded(self) -> Degraded:
        if self.small:
            width, height = self.size
            return Degraded(resize(self.now, height, width), self.now, self.jpeg, self.records)
        return Degraded(self.now, None, self.jpeg, self.records)


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

    radius = math.ceil(KERNEL_REACH * sigma)
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
    from scipy.signal import fftconvolve  # takes seconds to import

    return fftconvolve(padded, kernel[..., None], mode="valid", axes=(0, 1)).astype(np.float32)


Own = tuple[Float32, Record]  # the photo, and what its record gets


def _noise(image: Float32, sigma: float, rng: np.random.Generator) -> Own:
    """N(0, sigma / 255) is added to every value, independently; neither clipped nor rounded to 8 bits."""
    return image + np.float32(sigma / 255) * rng.standard_normal(image.shape, np.float32), {}


def _motion(image: Float32, length: float, rng: np.random.Generator) -> Own:
    direction = rng.uniform(0, math.pi)
    return convolve(image, motion_kernel(length, direction)), {"direction": direction}


OPERATORS: dict[str, Callable[[Float32, float, np.random.Generator], Own]] = {
    "noise": _noise,
    "blur": lambda image, sigma, rng: (gaussian_blur(image, sigma), {}),
    "defocus": lambda image, radius, rng: (convolve(image, disc_kernel(radius)), {}),
    "motion": _motion,
}  # by the kind: of a photo, the value and the photo's generator
FILES: dict[str, Callable[[Float32, float, np.random.Generator], tuple[bytes, Record]]] = {
    "jpeg": lambda image, quality, rng: (encode_jpeg(image, int(quality)), {})
}  # that make a JPEG file of a photo
FILMS: dict[str, Callable[[Sequence[Float32], float], list[Own]]] = {}  # of all photos at once


def _check_fits(image: Float32, radius: int, what: str) -> None:
    height, width = image.shape[:2]
    if radius >= min(height, width):
        raise ValueError(f"a {what} reaches {radius} px, too far for a photo of {width} x {height} px")
