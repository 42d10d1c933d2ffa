"""Frames of films as sRGB photos: by the matrix, range, primaries and transfer that the film names.

FFmpeg converts. Where a film names no matrix, it is BT.709 in HD and BT.601 below, as players have it. Films
of a high dynamic range are brought to BT.709's primaries, with the reference white of 203 cd/m2 (ITU-R
BT.2408) at 1, kept up to KNEE and bent to reach 1 at infinite light:
x -> KNEE + (1 - KNEE) (1 - exp((KNEE - x) / (1 - KNEE))).
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.photos.light import to_srgb
from hqgs.photos.profiles import HDR, Colors, colors_of_codes, in_srgb, to_709

KNEE = 0.75
_MATRICES = {1: "bt709", 4: "fcc", 7: "smpte240m", 9: "bt2020", 10: "bt2020"}  # FFmpeg's, by H.273; or bt601
_UNNAMED, _FULL = 2, 2  # AVColorSpace, AVColorRange
_SD = 1279, 576  # px: the most that films of standard definition have, as mpv has it
# FFmpeg's quick way makes frames a level darker.
_EXACT = "flags=bicubic+full_chroma_int+accurate_rnd"
_BT2020 = 9
_LARGE = (_BT2020, 11, 12)  # primaries that are converted: those of SD and HD differ little, and few are true
_WHITE_PQ, _MOST_PQ = 203.0, 10_000.0  # cd/m2
_WHITE_HLG = 0.75  # the signal of reference white
_HLG_GAMMA = 1.2  # of a display of 1,000 cd/m2

Floats = NDArray[np.float64]


def film_colors(frame: Any, film_transfer: int = 0) -> Colors | None:
    """The colours of a frame, where they are not those of ordinary films.

    `film_transfer`: of its film, where the frame does not tell.
    """
    curve, primaries = (int(getattr(frame, name, 0) or 0) for name in ("color_trc", "color_primaries"))
    curve = curve if curve in HDR else film_transfer
    if curve in HDR:
        return colors_of_codes(primaries if primaries in _LARGE else _BT2020, curve)
    return colors_of_codes(primaries, 1) if primaries in _LARGE else None


def as_photo(frame: Any, film_transfer: int = 0) -> NDArray[np.uint8]:
    """The frame as sRGB, [H, W, 3]. `film_transfer`: as `film_colors` has it."""
    from av.filter import Graph  # of an extra

    colors = film_colors(frame, film_transfer)
    full = frame.color_range == _FULL or frame.format.name.startswith("yuvj")
    large = frame.width > _SD[0] or frame.height > _SD[1]
    matrix = 1 if int(frame.colorspace) == _UNNAMED and large and not full else int(frame.colorspace)
    graph = Graph()
    steps = [
        graph.add_buffer(
            width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 1000)
        ),
        graph.add(
            "scale",
            f"in_color_matrix={_MATRICES.get(matrix, 'bt601')}:out_range=full:"
            f"in_range={'full' if full else 'limited'}:{_EXACT}",
        ),
        graph.add("format", "rgb48le" if colors is not None and colors.hdr != (0, 0) else "rgb24"),
        graph.add("buffersink"),
    ]
    graph.link_nodes(*steps).configure()
    graph.push(frame)
    rgb: NDArray[Any] = graph.pull().to_ndarray()
    if rgb.dtype == np.uint16:
        assert colors is not None
        return np.rint(255 * toned(rgb / 65535, colors.hdr[1], colors.hdr[0])).astype(np.uint8)
    return rgb if colors is None else np.array(in_srgb(Image.fromarray(rgb), colors))


def toned(signal: Floats, transfer: int, primaries: int = _BT2020) -> Floats:
    """Values [..., 3] of a high dynamic range, PQ or HLG, as sRGB, 0..1; see above."""
    light = _from_pq(signal) if HDR[transfer] == "PQ" else _from_hlg(signal)
    light = (light @ to_709(primaries).T).clip(0, None)
    bent = KNEE + (1 - KNEE) * -np.expm1((KNEE - light) / (1 - KNEE))
    return to_srgb(np.where(light > KNEE, bent, light)).clip(0, 1)


def _from_pq(signal: Floats) -> Floats:
    """Light, reference white at 1 (SMPTE ST 2084)."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    power = signal.clip(0, 1) ** (1 / m2)
    return _MOST_PQ / _WHITE_PQ * ((power - c1).clip(0, None) / (c2 - c3 * power)) ** (1 / m1)


def _from_hlg(signal: Floats) -> Floats:
    """Light, reference white at 1 (ITU-R BT.2100)."""
    scene = _hlg_scene(signal.clip(0, 1))
    luminance = (scene @ np.array([0.2627, 0.6780, 0.0593]))[..., None]  # of BT.2020
    white = float(_hlg_scene(np.array([_WHITE_HLG]))[0])
    return scene * luminance ** (_HLG_GAMMA - 1) / white**_HLG_GAMMA


def _hlg_scene(signal: Floats) -> Floats:
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
