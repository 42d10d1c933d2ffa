"""A phone's camera in low light: from linear light to the JPEG file that it stores."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve, gaussian_filter

from hqgs.photos.jpeg import encode_jpeg
from hqgs.photos.light import to_linear, to_srgb
from hqgs.photos.pixels import LUMA, Float32

# Typical values, chosen by hand; no one phone was measured.
FULL_WELL = 6000.0  # photoelectrons of white in green where no light is missing
READ_NOISE = 2.5  # electrons, standard deviation
# Gains of red, green and blue: the sensor sees white as 1/1.9, 1, 1/1.6.
WHITE_BALANCE = (1.9, 1.0, 1.6)
# A bilateral filter over 5 x 5 pixels; its sigma in px, in deviations of the noise, and of the chroma's blur.
DENOISE_RADIUS, DENOISE_SIGMA = 2, 1.5
SHARPEN_SIGMA, SHARPEN_AMOUNT = 1.0, 0.8  # px and gain of the unsharp mask
QUALITY = 70  # of the JPEG file, 4:2:0

Floats = NDArray[np.float64]


# Demosaicing filters of Malvar, He and Cutler, "High-quality linear interpolation for demosaicing of
# Bayer-patterned color images", ICASSP 2004, figure 2, in eighths.
_GREEN = np.array(  # green at red or blue
    [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]
)
_BESIDE = np.array(  # red (blue) at green, where its neighbours to the left and right are red (blue)
    [[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]]
)
_ACROSS = np.array(  # red at blue, blue at red
    [[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]]
)


def phone_jpeg(image: Float32, stops: float, rng: np.random.Generator) -> bytes:
    """The JPEG file of a photo [H, W, 3] that is taken again with `stops` less light.

    sRGB is decoded to linear light in [0, 1] and the channels divided by WHITE_BALANCE;
    `bayer_mosaic` takes one of them per pixel; a pixel of 1 holds N = FULL_WELL / 2^stops electrons. Each
    value becomes (Poisson(N v) + N(0, READ_NOISE)) / N, clipped at 1; values below 0 stay. Then: white
    balance, clipped at 1; `demosaic`; `denoise`; clipped to [0, 1]; the sRGB curve and no other tone curve,
    so that the clean photo is what a phone in good light would give; an unsharp mask on the luma, y + 0.8
    (y - G y) with a Gaussian of 1 px; a JPEG of quality 70 with 4:2:0 chroma.
    """
    white = FULL_WELL / 2**stops
    gains = np.array(WHITE_BALANCE)
    light = to_linear(image.astype(np.float64).clip(0, 1))
    electrons = bayer_mosaic(light / gains) * white
    raw = rng.poisson(electrons) + READ_NOISE * rng.standard_normal(electrons.shape)
    balance = bayer_mosaic(np.broadcast_to(gains, light.shape))
    balanced = np.minimum(np.minimum(raw / white, 1) * balance, 1)
    srgb = to_srgb(denoise(demosaic(balanced), white).clip(0, 1))
    luma = srgb @ LUMA
    detail = luma - gaussian_filter(luma, SHARPEN_SIGMA, mode="mirror")
    return encode_jpeg((srgb + SHARPEN_AMOUNT * detail[..., None]).astype(np.float32), QUALITY)


def bayer_mosaic(image: Floats) -> Floats:
    """One channel per pixel, [H, W] from [H, W, 3]: R G / G B, red at row 0, column 0."""
    mosaic = image[..., 1].copy()
    mosaic[::2, ::2] = image[::2, ::2, 0]
    mosaic[1::2, 1::2] = image[1::2, 1::2, 2]
    return mosaic


def demosaic(mosaic: Floats) -> Floats:
    """All channels [H, W, 3] from a mosaic [H, W] by Malvar, He and Cutler's linear filters.

    The border mirrors the mosaic without repeating the edge, which keeps the pattern.
    """
    green, beside, above, across = (
        convolve(mosaic, kernel / 8, mode="mirror") for kernel in (_GREEN, _BESIDE, _BESIDE.T, _ACROSS)
    )
    out = np.repeat(mosaic[..., None], 3, axis=-1)
    for row, column in ((0, 0), (1, 1)):
        own = 2 * row  # red at (0, 0), blue at (1, 1)
        here = np.s_[row::2, column::2]
        beside_own, above_own = np.s_[row::2, 1 - column :: 2], np.s_[1 - row :: 2, column::2]
        out[..., 1][here], out[..., 2 - own][here] = green[here], across[here]
        out[..., own][beside_own], out[..., own][above_own] = beside[beside_own], above[above_own]
    return out


def denoise(linear: Floats, white: float) -> Floats:
    """A mild filter for linear light [H, W, 3] whose 1 stands for `white` electrons.

    First a bilateral filter over 5 x 5 pixels: the weight of a neighbour at distance r, which differs by d_c
    in channel c, is exp(-r^2 / (2 1.5^2)) exp(-mean_c(d_c^2 / s_c^2) / (2 1.5^2)); s_c is the noise that
    photons and reading leave at the local brightness (a Gaussian mean of 2 px). Then the chroma (what is
    left of R, G, B without their luma) is blurred by a Gaussian of 1.5 px.
    """
    gains = np.array(WHITE_BALANCE)
    level = gaussian_filter(linear, (2, 2, 0), mode="mirror").clip(0)
    variance = gains * level / white + (gains * READ_NOISE / white) ** 2
    reach = DENOISE_RADIUS
    padded = np.pad(linear, ((reach, reach), (reach, reach), (0, 0)), mode="reflect")
    total, weights = np.zeros_like(linear), np.zeros(linear.shape[:2])
    height, width = linear.shape[:2]
    for dy in range(2 * reach + 1):
        for dx in range(2 * reach + 1):
            other = padded[dy : dy + height, dx : dx + width]
            far = ((dy - reach) ** 2 + (dx - reach) ** 2) / (2 * DENOISE_SIGMA**2)
            unlike = (np.square(other - linear) / variance).mean(-1) / (2 * DENOISE_SIGMA**2)
            weight = np.exp(-far - unlike)
            total += weight[..., None] * other
            weights += weight
    smooth = total / weights[..., None]
    luma = (smooth @ LUMA)[..., None]
    return luma + gaussian_filter(smooth - luma, (DENOISE_SIGMA, DENOISE_SIGMA, 0), mode="mirror")
