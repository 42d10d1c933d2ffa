"""How photos get bad: JPEG, noise, low resolution and blur, as pure functions of a photo and a generator.

Photos are sRGB as stored, scaled to [0, 1]; nothing is linearised, as in the field's benchmarks.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.signal import fftconvolve

from hqgs.camera import as_floats
from hqgs.resize import resize
from hqgs.torch_threads import one_torch_thread

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Kind:
    """The values that one kind of step takes."""

    lowest: float
    highest: float
    unit: str
    integer: bool = False
    at_504: float | None = None  # the value where none is written, in px of a photo 504 px wide


KINDS = {
    "jpeg": Kind(1, 95, "a quality", integer=True),
    "noise": Kind(0.01, 255, "a standard deviation, where white is 255"),
    "lowres": Kind(2, 16, "a factor", integer=True),
    "blur": Kind(0.1, 50, "sigma in px", at_504=2.5),
    "defocus": Kind(0.5, 50, "a radius in px", at_504=5.0),
    "motion": Kind(1, 200, "a length in px", at_504=15.0),
}
NONE, MIXED = "none", "mixed"
REACH = 4  # sigmas at which the Gaussian kernel ends


@dataclass(frozen=True)
class Step:
    """One step. ValueError for an unknown kind, or a value outside the kind's range."""

    kind: str
    value: float | None = None  # None: the default, which scales with the photo's width

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(
                f"unknown degradation {self.kind!r}; there are: {', '.join([*KINDS, MIXED, NONE])}, and "
                "steps joined by +"
            )
        kind = KINDS[self.kind]
        wanted = f"{kind.unit}, {'an integer in ' if kind.integer else ''}{kind.lowest:g}..{kind.highest:g}"
        if self.value is None:
            if kind.at_504 is None:
                raise ValueError(f"{self.kind} needs a value: {self.kind}:VALUE with {wanted}")
        elif not kind.lowest <= self.value <= kind.highest or (kind.integer and self.value % 1):
            raise ValueError(f"{self.kind} is {self.value:g}, wanted {wanted}")

    def __str__(self) -> str:
        return self.kind if self.value is None else f"{self.kind}:{_shortest(self.value)}"


@dataclass(frozen=True)
class Degradation:
    """Steps in the order in which they happen; none for a clean photo. `str()` is what the parser reads."""

    steps: tuple[Step, ...]

    def for_width(self, width: int) -> Degradation:
        """The same with a value in every step, for photos `width` px wide.

        A default scales with the width of the picture that its step meets, within the kind's range.
        """
        steps = []
        for step in self.steps:
            if step.value is None:
                kind = KINDS[step.kind]
                value = (kind.at_504 or 0.0) * width / 504
                step = replace(step, value=min(max(value, kind.lowest), kind.highest))
            elif step.kind == "lowres":
                width = small_side(width, int(step.value))
            steps.append(step)
        return Degradation(tuple(steps))

    def __str__(self) -> str:
        if self.steps == MIXED_STEPS:
            return MIXED
        return "+".join(str(step) for step in self.steps) or NONE


MIXED_STEPS = (Step("blur"), Step("lowres", 2), Step("noise", 10), Step("jpeg", 20))


@dataclass(frozen=True)
class Degraded:
    """A degraded photo."""

    image: Float32  # [H, W, 3], the size of the clean photo; may leave [0, 1]
    low: Float32 | None  # [h, w, 3]: with a low-res step, the small photo that `image` was enlarged from
    jpeg: bytes | None  # where JPEG is the last step: the file whose pixels `low`, or else `image`, holds


def parse_degradation(text: str) -> Degradation:
    """Read `jpeg:Q`, `noise:S`, `lowres:N`, `blur[:SIGMA]`, `defocus[:R]`, `motion[:LENGTH]` or `none`.

    Steps joined by `+` happen in the written order: `blur:2+jpeg:20`. `mixed` stands for
    `blur+lowres:2+noise:10+jpeg:20`. Without a value, blur, defocus and motion take 2.5, 5 and 15 px for a
    width of 504 px and scale with the photo's width. ValueError names what is wrong and the values there are.
    """
    if text == NONE:
        return Degradation(())
    steps: list[Step] = []
    for part in text.split("+"):
        if part == MIXED:
            steps.extend(MIXED_STEPS)
        elif part == NONE:
            raise ValueError(f"{NONE!r} stands alone, got the degradation {text!r}")
        else:
            kind, colon, value = part.partition(":")
            steps.append(Step(kind, _number(value, part) if colon else None))
    return Degradation(tuple(steps))


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


def encode_jpeg(image: Float32, quality: int) -> bytes:
    """A colour JPEG file with 4:2:0 chroma of `image` [H, W, 3], which is clipped and rounded to 8 bits.

    By Pillow's libjpeg: the codec's quality scale is the one that benchmarks mean.
    """
    file = io.BytesIO()
    Image.fromarray(to_uint8(image)).save(file, "JPEG", quality=quality, subsampling="4:2:0")
    return file.getvalue()


def to_uint8(image: Float32) -> NDArray[np.uint8]:
    """The picture with 8 bits: clipped to [0, 1], 255 levels, rounded."""
    return np.rint(image.clip(0, 1) * 255).astype(np.uint8)


def decode_jpeg(data: bytes) -> Float32:
    """The pixels of a JPEG file, [H, W, 3], multiples of 1/255."""
    with Image.open(io.BytesIO(data)) as photo:
        return as_floats(np.asarray(photo.convert("RGB")))


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


def disc_kernel(radius: float) -> NDArray[np.float64]:
    """A filled disc of `radius` px (defocus), square and of odd size, sum 1. kornia has none.

    The rim is antialiased: each pixel counts with the share of its area that lies in the disc, to 1e-3.
    """
    reach = math.ceil(radius + 0.5) - 1
    columns = np.arange(-reach, reach + 1)
    heights = columns[:, None] + (np.arange(64) + 0.5) / 64 - 0.5  # 64 lines through each row of pixels
    half_chords = np.sqrt(np.maximum(radius**2 - heights**2, 0))[..., None]
    left, right = (np.clip(end, columns - 0.5, columns + 0.5) for end in (-half_chords, half_chords))
    kernel = (right - left).mean(axis=1)
    kernel += kernel.T
    return kernel / kernel.sum()


def motion_kernel(length: float, angle: float) -> NDArray[np.float64]:
    """A straight line of `length` px through the centre, square and of odd size, sum 1.

    Convolving with it is the mean of the photo over shifts, by bilinear interpolation, along `length` px in
    the direction `angle` (radians from x towards y, which points down). The integral is exact. Not kornia's
    motion kernel: that one takes odd whole lengths only, and turns a row of pixels, which thins the line.
    """
    along = np.array([math.cos(angle), math.sin(angle)]) * length / 2
    reach = math.ceil(np.abs(along).max()) + 1
    # Between the places where the line crosses a row or column of pixel centres, the bilinear weights are
    # quadratic in the position, for which two Gauss points per stretch are exact.
    ends = [np.array([-1.0, 1.0])]
    ends += [np.arange(-reach, reach + 1) / half for half in along if abs(half) > 1e-9]
    breaks = np.unique(np.concatenate(ends).clip(-1, 1))
    middles, halves = (breaks[1:] + breaks[:-1]) / 2, np.diff(breaks) / 2
    at = np.concatenate([middles - halves / math.sqrt(3), middles + halves / math.sqrt(3)])
    weights = np.concatenate([halves, halves]) / 2

    x, y = at * along[0], at * along[1]
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for row in (0, 1):
        for column in (0, 1):
            share = (1 - np.abs(x - left - column)) * (1 - np.abs(y - top - row))
            np.add.at(kernel, (top + row + reach, left + column + reach), weights * share)
    return kernel / kernel.sum()


def _motion(image: Float32, length: float, rng: np.random.Generator) -> Float32:
    return convolve(image, motion_kernel(length, rng.uniform(0, math.pi)))


_OPERATORS: dict[str, Callable[[Float32, float, np.random.Generator], Float32]] = {
    "noise": add_noise,
    "blur": lambda image, sigma, rng: gaussian_blur(image, sigma),
    "defocus": lambda image, radius, rng: convolve(image, disc_kernel(radius)),
    "motion": _motion,
}


def small_side(side: int, factor: int) -> int:
    """The side of a photo that was shrunk by `factor`, px."""
    return math.ceil(side / factor)


def _check_fits(image: Float32, radius: int, what: str) -> None:
    height, width = image.shape[:2]
    if radius >= min(height, width):
        raise ValueError(f"a {what} reaches {radius} px, too far for a photo of {width} x {height} px")


def _number(text: str, part: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{text!r} in the degradation {part!r} is no number")
    return value


def _shortest(value: float) -> str:
    """The shortest text that reads back as `value`."""
    return repr(int(value)) if value == int(value) else repr(float(value))
