"""The colours that a file says its pixels are in, and the way from there to sRGB, by LittleCMS.

A file says it by an ICC profile, by code points of ITU-T H.273 (PNG's cICP, the colr box of AVIF and HEIC,
the tags of films), by PNG's gAMA and cHRM, or by the EXIF data of cameras set to Adobe RGB. All but the first
become a profile here, so that one way leads to sRGB. Where nothing is said, pixels are sRGB.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from hqgs.base.text import some

_D65 = (0.3127, 0.3290)
# x and y of white, red, green and blue, by the code points of H.273; -1: Adobe RGB (1998).
_WIDE = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060)
_PRIMARIES = {
    1: ("BT.709", (*_D65, 0.640, 0.330, 0.300, 0.600, 0.150, 0.060)),
    4: ("BT.470 M", (0.310, 0.316, 0.67, 0.33, 0.21, 0.71, 0.14, 0.08)),
    5: ("BT.601 (625 lines)", (*_D65, 0.64, 0.33, 0.29, 0.60, 0.15, 0.06)),
    6: ("BT.601 (525 lines)", (*_D65, 0.630, 0.340, 0.310, 0.595, 0.155, 0.070)),
    9: ("BT.2020", (*_D65, 0.708, 0.292, 0.170, 0.797, 0.131, 0.046)),
    11: ("DCI-P3", (0.314, 0.351, *_WIDE)),
    12: ("Display P3", (*_D65, *_WIDE)),
    -1: ("Adobe RGB", (*_D65, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06)),
}
_SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)  # of ICC's parametric type 3
_ADOBE_GAMMA = 563 / 256
_GAMMAS = {4: 2.2, 5: 2.8, 8: 1.0, 17: 2.6}  # by H.273's transfer; the others, but HDR, are shown as sRGB is
HDR = {16: "PQ", 18: "HLG"}
_SRGB_GAMMA = 1 / 2.2  # PNG's gAMA of files that are sRGB
# Bradford's cone responses, and the white of ICC's connection space.
_CONES = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_D50 = np.array([0.9642, 1.0, 0.8249])
_MODES = {"RGB ": "RGB", "GRAY": "L", "CMYK": "CMYK", "Lab ": "LAB"}  # Pillow's, by the space of a profile
_SAME, _ALIKE = 1, 24  # of 255: what sRGB may be off; and a profile that is called so
_HEAD = 1 << 16  # bytes in which a box of AVIF or JPEG 2000 names its colours


@dataclass(frozen=True)
class Colors:
    """Colours that are not sRGB's."""

    name: str  # for people
    profile: bytes = b""  # that leads to sRGB; empty where none does
    hdr: tuple[int, int] = (0, 0)  # primaries and transfer of a high dynamic range, which is toned down

    @property
    def known(self) -> bool:
        """Whether pixels become sRGB; else they stay as they are stored."""
        return bool(self.profile) or self.hdr != (0, 0)


def colors_of(photo: Image.Image, path: Path) -> Colors | None:
    """What a photo, just opened, says of its colours. None: they are sRGB, or nothing is said."""
    info, codes = photo.info, None
    if photo.format == "PNG":
        codes = _of_png(path)
    elif not info.get("icc_profile") and photo.format in ("AVIF", "JPEG2000"):
        with path.open("rb") as file:
            codes = _of_boxes(file.read(_HEAD))
    if isinstance(codes, tuple):
        return colors_of_codes(*codes)
    if profile := codes or info.get("icc_profile", b""):
        mode, name, same = _looked_into(profile)
        own = photo.mode if photo.mode in ("LAB", "CMYK") else "RGB"
        grey = photo.mode in ("1", "L", "LA", "La") or photo.mode.startswith("I")
        if mode and (mode not in (own, "L") or (mode == "L" and not grey)):
            return Colors(f"a profile of another kind of pixels ({name})")
        return None if same else Colors(name, profile if mode else b"")
    if profile is None:  # Pillow found one that it could not unpack
        return Colors("a damaged profile")
    if nclx := info.get("nclx_profile"):
        return colors_of_codes(nclx["color_primaries"], nclx["transfer_characteristics"])
    if photo.format == "PNG" and "srgb" not in info and ("gamma" in info or "chromaticity" in info):
        gamma = info.get("gamma") or _SRGB_GAMMA
        points = info.get("chromaticity") or _PRIMARIES[1][1]
        curve = _SRGB_CURVE if abs(gamma / _SRGB_GAMMA - 1) < 0.01 else (1 / gamma,)
        return _made(f"PNG's gamma of {gamma:.4g} and its primaries", tuple(points), curve)
    if "exif" in info and photo.mode == "RGB":
        exif = photo.getexif()
        more = exif.get_ifd(0x8769)
        rule = exif.get_ifd(0xA005).get(1, "") if 0xA005 in more else ""  # of interoperability
        if more.get(0xA001) == 2 or (more.get(0xA001) == 0xFFFF and str(rule).startswith("R03")):
            return _made("Adobe RGB (EXIF)", _PRIMARIES[-1][1], (_ADOBE_GAMMA,))
    return None


def colors_of_codes(primaries: int, transfer: int) -> Colors | None:
    """The same of code points of H.273, of which 2 says nothing."""
    if primaries not in (0, 2, *_PRIMARIES):
        return Colors(f"unknown primaries ({primaries} of H.273)")
    name, points = _PRIMARIES.get(primaries, _PRIMARIES[1])
    if transfer in HDR:
        return Colors(f"{name} with a high dynamic range ({HDR[transfer]})", hdr=(primaries, transfer))
    curve = (_GAMMAS[transfer],) if transfer in _GAMMAS else _SRGB_CURVE
    return _made(name if len(curve) > 1 else f"{name} with a gamma of {curve[0]:g}", points, curve)


def in_srgb(photo: Image.Image, colors: Colors | None) -> Image.Image:
    """The photo as sRGB of 8 bits a channel, "RGB", without its transparency."""
    if colors is None or not colors.profile:
        return photo.convert("RGB")
    mode = _looked_into(colors.profile)[0]
    photo = photo if photo.mode == mode else photo.convert(mode)
    return ImageCms.applyTransform(photo, _transform(colors.profile, mode)) or photo


def in_srgb_of_16(levels: NDArray[np.int64], colors: Colors) -> NDArray[np.uint8]:
    """The same, [H, W, 3], of 16 bits: [H, W] of grey, or [H, W, 3].

    LittleCMS is asked for 8 bits around each value, and what lies between them is linear.
    """
    coarse, part = levels // 257, (levels % 257 / 257)[..., None]
    below = np.asarray(in_srgb(Image.fromarray(coarse.astype(np.uint8)), colors)).astype(np.float64)
    found = below.copy()
    for channel in range(part.shape[-2] if levels.ndim == 3 else 1):
        up = coarse.copy()
        at = (..., channel) if levels.ndim == 3 else ...
        up[at] = np.minimum(up[at] + 1, 255)
        above = np.asarray(in_srgb(Image.fromarray(up.astype(np.uint8)), colors))
        found += (above - below) * (part[..., channel, :] if levels.ndim == 3 else part)
    return np.rint(found).clip(0, 255).astype(np.uint8)


@lru_cache(maxsize=64)
def _looked_into(profile: bytes) -> tuple[str, str, bool]:
    """Pillow's mode of the pixels that a profile is for, its name, and whether it is sRGB's.

    The mode is "" where the profile is damaged, or of no use for pictures.
    """
    try:
        mode = _MODES[profile[16:20].decode("latin-1")]
        name = ImageCms.getProfileDescription(io.BytesIO(profile)).strip() or "a profile without a name"
        steps = np.linspace(0, 255, 18).astype(np.uint8)
        nodes = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(18, -1, 3)
        probe = Image.fromarray(nodes) if mode == "RGB" else Image.new(mode, (1, 1))
        seen = ImageCms.applyTransform(probe, _transform(profile, mode))
    except (ImageCms.PyCMSError, OSError, KeyError, ValueError, TypeError):
        return "", "a damaged profile", False
    off = np.abs(np.asarray(seen).astype(np.int64) - nodes).max() if mode == "RGB" else 255
    return mode, name, bool(off <= (_ALIKE if "srgb" in name.lower() else _SAME))


@lru_cache(maxsize=64)
def _transform(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform:
    return ImageCms.buildTransform(io.BytesIO(profile), ImageCms.createProfile("sRGB"), mode, "RGB")


def told(found: Mapping[str, Colors | None]) -> list[str]:
    """What became of photos whose colours are not sRGB's, in sentences; `found`: by their names."""
    named = dict[tuple[str, bool], list[str]]()
    for name, colors in found.items():
        if colors is not None:
            named.setdefault((colors.name, colors.known), []).append(name)
    return [
        f"{len(names)} of {len(found)} photos are in {colors}: "
        + ("they are converted to sRGB" if known else f"not converted, but read as sRGB: {some(names)}")
        for (colors, known), names in named.items()
    ]


def to_xyz(points: Sequence[float]) -> NDArray[np.floating]:
    """The matrix [3, 3] from linear RGB of these primaries to XYZ with the white of ICC's profiles, D50.

    `points`: x and y of white, red, green and blue.
    """
    white, *rgb = (np.array([x / y, 1, (1 - x - y) / y]) for x, y in np.reshape(points, (4, 2)))
    columns = np.stack(rgb, 1)
    columns = columns * np.linalg.solve(columns, white)
    adapted = np.linalg.solve(_CONES, np.diag(_CONES @ _D50 / (_CONES @ white)) @ _CONES)
    return adapted @ columns


def to_709(primaries: int) -> NDArray[np.floating]:
    """The matrix [3, 3] from linear RGB of primaries of H.273 to that of BT.709, which are sRGB's."""
    return np.linalg.solve(to_xyz(_PRIMARIES[1][1]), to_xyz(_PRIMARIES.get(primaries, _PRIMARIES[1])[1]))


@lru_cache(maxsize=64)
def _made(name: str, points: tuple[float, ...], curve: tuple[float, ...]) -> Colors | None:
    """Colours of these primaries, and of a gamma or ICC's parametric curve of type 3; None: sRGB's.

    The profile is one of ICC.1:2010, version 4, with what LittleCMS reads of it.
    """
    try:
        matrix = to_xyz(points) if min(points[1::2]) > 0 else None
    except np.linalg.LinAlgError:
        matrix = None
    if matrix is None or not np.isfinite(matrix).all():
        return Colors(f"{name}, which are none")
    fixed = [round(value * 65536) for value in (*_D50, *matrix.T.ravel(), *curve)]
    if max(map(abs, fixed)) >= 1 << 31:
        return Colors(f"{name}, which are none")
    data = [b"XYZ \0\0\0\0" + struct.pack(">3i", *fixed[k : k + 3]) for k in (0, 3, 6, 9)]
    kind = 3 if len(curve) > 1 else 0
    data.append(b"para\0\0\0\0" + struct.pack(f">HH{len(curve)}i", kind, 0, *fixed[12:]))
    tags = {b"wtpt": 0, b"rXYZ": 1, b"gXYZ": 2, b"bXYZ": 3, b"rTRC": 4, b"gTRC": 4, b"bTRC": 4}
    start, table, body = 128 + 4 + 12 * len(tags), b"", b"".join(data)
    for tag, k in tags.items():
        table += tag + struct.pack(">II", start + sum(map(len, data[:k])), len(data[k]))
    head = struct.pack(">I4xI", start + len(body), 0x04200000) + b"mntrRGB XYZ ".ljust(24, b"\0") + b"acsp"
    head = head.ljust(68, b"\0") + struct.pack(">3i", *fixed[:3])
    profile = head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body
    mode, _, same = _looked_into(profile)
    return None if same else Colors(name, profile) if mode else Colors(f"{name}, which are none")


def _of_png(path: Path) -> tuple[int, int] | None:
    """Primaries and transfer of a PNG file's cICP chunk, which Pillow passes by."""
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8 and head[4:] not in (b"IDAT", b"IEND"):
            if head[4:] == b"cICP":
                codes = file.read(2)
                return (codes[0], codes[1]) if len(codes) == 2 else None
            file.seek(int.from_bytes(head[:4], "big") + 4, 1)
    return None


def _of_boxes(head: bytes) -> tuple[int, int] | bytes | None:
    """What a colr box of ISO's base media format says: primaries and transfer, or a profile."""
    at = head.find(b"colr")
    if at < 4:
        return None
    box = head[at + 4 : at - 4 + int.from_bytes(head[at - 4 : at], "big")]
    if box[:4] == b"nclx" and len(box) >= 8:
        return struct.unpack_from(">HH", box, 4)
    return box[3:] if box[:1] == b"\2" else None  # JPEG 2000's restricted profile
