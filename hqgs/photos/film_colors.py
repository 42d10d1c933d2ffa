"""Frames of films as sRGB photos: by the matrix, the range and the transfer that the film itself names.

What PyAV makes of a tagged frame depends on its version, so all but BT.601 (which an untagged film has too)
is said to it, or computed here: BT.2020, which some versions do not know, and films of a high dynamic range.
Their light is brought to BT.709's primaries, with the reference white of 203 cd/m2 (ITU-R BT.2408) at 1, kept
up to KNEE and bent to reach 1 at infinite light: x -> KNEE + (1 - KNEE) (1 - exp((KNEE - x) / (1 - KNEE))).
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from hqgs.photos.light import to_srgb

KNEE = 0.75
_BT709, _BT2020 = 1, (9, 10)  # libavutil's AVColorSpace
_FULL = 2  # AVColorRange
_PQ, _HLG = 16, 18  # AVColorTransferCharacteristic
HDR = {_PQ: "PQ", _HLG: "HLG"}
_SWS_709, _SWS_RGB = 1, 5
# SWS_BICUBIC, SWS_FULL_CHR_H_INT and SWS_ACCURATE_RND: FFmpeg's quick way makes frames a level darker.
_SWS_EXACT = 0x4 | 0x2000 | 0x40000
_KR, _KB = 0.2627, 0.0593  # of BT.2020
# BT.2020's primaries in BT.709's, both with the white D65 (ITU-R BT.2087).
_TO_709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
_WHITE_PQ, _MOST_PQ = 203.0, 10_000.0  # cd/m2
_WHITE_HLG = 0.75  # the signal of reference white
_HLG_GAMMA = 1.2  # of a display of 1,000 cd/m2

_PLANAR = re.compile(r"yuvj?4(?:20|22|44)p(?:(10|12)le)?")  # 8 bits, or those of the group

Floats = NDArray[np.float64]


def transfer(frame_or_codec: Any) -> int:
    """The number of its transfer function; 0 where this version of PyAV does not tell."""
    return int(getattr(frame_or_codec, "color_trc", 0) or 0)


def as_photo(frame: Any, film_transfer: int = 0) -> NDArray[np.uint8]:
    """The frame as sRGB, [H, W, 3]. `film_transfer`: of its film, where the frame does not tell."""
    matrix, wide = int(frame.colorspace), frame.color_range == _FULL or frame.format.name.startswith("yuvj")
    curve = transfer(frame)
    curve = curve if curve in HDR else film_transfer
    if matrix in _BT2020 or curve in HDR:
        signal = _signal(frame, wide)
        return np.rint(255 * (toned(signal, curve) if curve in HDR else signal).clip(0, 1)).astype(np.uint8)
    named = {"format": "rgb24"}
    if matrix == _BT709:
        named |= {"src_colorspace": _SWS_709, "dst_colorspace": _SWS_RGB}
        named |= {"src_color_range": _FULL if wide else 1, "dst_color_range": _FULL}
    try:
        frame = frame.reformat(**named, interpolation=_SWS_EXACT)
    except KeyError:  # PyAV 13 cannot be asked for it
        frame = frame.reformat(**named)
    return frame.to_ndarray()


def toned(signal: Floats, curve: int) -> Floats:
    """BT.2020 values [..., 3] of a film with that transfer as sRGB, 0..1; see above."""
    light = _from_pq(signal) if curve == _PQ else _from_hlg(signal)
    light = (light @ _TO_709.T).clip(0, None)
    bent = KNEE + (1 - KNEE) * -np.expm1((KNEE - light) / (1 - KNEE))
    light = np.where(light > KNEE, bent, light)
    return to_srgb(light)


def _from_pq(signal: Floats) -> Floats:
    """Light, reference white at 1 (SMPTE ST 2084)."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    power = signal.clip(0, 1) ** (1 / m2)
    return _MOST_PQ / _WHITE_PQ * ((power - c1).clip(0, None) / (c2 - c3 * power)) ** (1 / m1)


def _from_hlg(signal: Floats) -> Floats:
    """Light, reference white at 1 (ITU-R BT.2100)."""
    scene = _hlg_scene(signal.clip(0, 1))
    luminance = (scene @ np.array([_KR, 1 - _KR - _KB, _KB]))[..., None]
    white = float(_hlg_scene(np.array([_WHITE_HLG]))[0])
    return scene * luminance ** (_HLG_GAMMA - 1) / white**_HLG_GAMMA


def _hlg_scene(signal: Floats) -> Floats:
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)


def _signal(frame: Any, wide: bool) -> Floats:
    """R'G'B' [H, W, 3] of a BT.2020 frame, as its planes hold it; its values may leave 0..1."""
    if _PLANAR.fullmatch(frame.format.name) is None:
        frame = frame.reformat(format="yuv420p")
    found = _PLANAR.fullmatch(frame.format.name)
    assert found is not None
    bits, (height, width) = int(found[1] or 8), (frame.height, frame.width)
    luma, *chroma = (_plane(plane, bits) for plane in frame.planes)
    one = float(1 << (bits - 8))  # a step of 8 bits
    y = luma[:height, :width] / one
    cb, cr = (_stretched(plane / one, height, width) for plane in chroma)
    if wide:
        most = ((1 << bits) - 1) / one
        y, cb, cr = y / most, (cb - 128) / most, (cr - 128) / most
    else:
        y, cb, cr = (y - 16) / 219, (cb - 128) / 224, (cr - 128) / 224
    r, b = y + 2 * (1 - _KR) * cr, y + 2 * (1 - _KB) * cb
    return np.stack([r, (y - _KR * r - _KB * b) / (1 - _KR - _KB), b], -1)


def _plane(plane: Any, bits: int) -> Floats:
    kind = np.dtype("u1" if bits == 8 else "<u2")
    rows = np.frombuffer(plane, kind).reshape(-1, plane.line_size // kind.itemsize)
    return rows[: plane.height, : plane.width].astype(np.float64)


def _stretched(chroma: Floats, height: int, width: int) -> Floats:
    """At the size of the luma, linear: between rows of two, on the first column of two, as H.264 has it."""
    rows = np.arange(height) if len(chroma) >= height else (np.arange(height) - 0.5) / 2
    columns = np.arange(width) / (1 if chroma.shape[1] >= width else 2)
    at = np.meshgrid(rows, columns, indexing="ij")
    return np.asarray(map_coordinates(chroma, at, order=1, mode="nearest"), np.float64)
