"""More kinds of degradation: what a hand, a camera, a messenger, a phone and an encoder do.

Importing this module adds them to those that hqgs makes:

| step | what happens | where |
|---|---|---|
| `shake[:PX]` | a curved path of its own in each photo, in linear light | `shake.py` |
| `exposure[:EV]` | gain and white balance of its own in each photo, in linear light | here |
| `chat[:SIDE]` | a messenger: shrunk, JPEG, enlarged | here |
| `phone[:EV]` | a phone in low light: mosaic, noise, its processing, JPEG | `phone.py` |
| `video[:CRF]` | H.264 over all photos, sorted by name | `video.py` |

Without a value, shake takes 12 px for a width of 504 px and scales with it, chat half of the longest side,
exposure 1, phone 4, video 36.

Records hold of a shake "extent" and "length" of the path in px, and its four knots, "path"; of an exposure
the "gains" of red, green and blue; of a chat "size" of the
small photo and "quality"; of a phone "electrons" of white; of a video "frame", its type, and "bytes".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes.phone import FULL_WELL, phone_jpeg
from benchmarks.scenes.shake import draw_path, draw_strength, path_length, shake_kernel
from benchmarks.scenes.video import film
from hqgs.photos.degrade import FILES, FILMS, OPERATORS, Own, Record, convolve
from hqgs.photos.formula import KINDS, NOT_MADE, Kind
from hqgs.photos.jpeg import decode_jpeg, encode_jpeg
from hqgs.photos.light import to_linear, to_srgb
from hqgs.photos.pixels import Float32
from hqgs.photos.resize import resize

CHAT_QUALITIES = (40, 70)  # of a messenger's JPEG: the lowest and highest, all equally likely
WHITE_BALANCE = 0.25  # of the range of stops: the range of red's and blue's gains against green's


def draw_gains(rng: np.random.Generator, stops: float) -> NDArray[np.float64]:
    """The gains of red, green and blue, [3]: 2^(e + r), 2^e and 2^(e + b).

    The exposure e is uniform in +-`stops`, the white balance r and b uniform in +-`stops` / 4, drawn in this
    order.
    """
    exposure = rng.uniform(-stops, stops)
    red, blue = rng.uniform(-stops * WHITE_BALANCE, stops * WHITE_BALANCE, 2)
    return 2.0 ** np.array([exposure + red, exposure, exposure + blue])


def expose(image: Float32, gains: NDArray[np.float64]) -> Float32:
    """The photo [H, W, 3] with its linear light times the channels' gains, clipped at the sensor's white."""
    linear = to_linear(image) * gains.astype(np.float32)
    return to_srgb(np.minimum(linear, np.float32(1)))


def shake(image: Float32, knots: NDArray[np.float64]) -> Float32:
    """The mean over the exposure, in linear light, of the photo [H, W, 3] moved along a path in px.

    `knots` [4, 2] (x right, y down) are those of `shake_kernel`: a point of light draws its path into the
    photo. ValueError if the photo is smaller than the path reaches.
    """
    return to_srgb(convolve(to_linear(image), shake_kernel(knots)))


def chat(image: Float32, side: int, quality: int) -> Float32:
    """What a messenger makes of a photo [H, W, 3], at its size.

    Antialiased bicubic shrinking until the longest side has `side` px (a photo that is no larger keeps its
    size), the other side rounded; a JPEG of this quality with 4:2:0 chroma; bicubic enlarging.
    """
    height, width = image.shape[:2]
    small = resize(image, *_chat_size(height, width, side))
    return resize(decode_jpeg(encode_jpeg(small, quality)), height, width)


def _chat_size(height: int, width: int, side: int) -> tuple[int, int]:
    share = min(side / max(height, width), 1)
    return max(round(height * share), 1), max(round(width * share), 1)


def _shake(image: Float32, longest: float, rng: np.random.Generator) -> Own:
    extent = longest * draw_strength(rng)
    knots = draw_path(rng, extent)
    return shake(image, knots), {"extent": extent, "length": path_length(knots), "path": knots.tolist()}


def _exposure(image: Float32, stops: float, rng: np.random.Generator) -> Own:
    gains = draw_gains(rng, stops)
    return expose(image, gains), {"gains": gains.tolist()}


def _chat(image: Float32, side: float, rng: np.random.Generator) -> Own:
    quality = int(rng.integers(CHAT_QUALITIES[0], CHAT_QUALITIES[1] + 1))
    height, width = _chat_size(image.shape[0], image.shape[1], int(side))
    return chat(image, int(side), quality), {"size": [width, height], "quality": quality}


def _phone(image: Float32, stops: float, rng: np.random.Generator) -> tuple[bytes, Record]:
    return phone_jpeg(image, stops, rng), {"electrons": FULL_WELL / 2**stops}


def _video(images: Sequence[Float32], crf: float) -> list[Own]:
    return [(frame.image, {"frame": frame.kind, "bytes": frame.bytes}) for frame in film(images, crf)]


KINDS |= {
    "chat": Kind(
        8, 10000, "the longest side in px", "SIDE", integer=True, at_504=252, formation=False, longest=True
    ),
    "phone": Kind(0, 12, "stops of light that are missing", "EV", default=4, formation=False),
}
OPERATORS |= {"shake": _shake, "exposure": _exposure, "chat": _chat}
FILES |= {"phone": _phone}
FILMS["video"] = _video
for made in ("shake", "exposure", "video"):
    NOT_MADE.pop(made, None)
