"""Colours of photos: whatever file and profile say them, they become sRGB, as LittleCMS makes it of them."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fixtures_photos import looked_at
from fixtures_scenes import make_truth, write_colmap
from numpy.typing import NDArray
from PIL import Image, ImageCms

from hqgs.photos.files import decode, glance, told_colors
from hqgs.scene.load import load_scene

COLOURS = np.array(
    [[40, 180, 60], [200, 60, 40], [128, 128, 128], [5, 9, 14], [255, 255, 255], [0, 0, 0], [90, 90, 200]],
    np.uint8,
)
# x and y of red, green and blue times their share of the light of white, as XYZ under D50 (ICC profiles of
# Apple, Adobe and Kodak; BT.709 as in the profile of HP and Microsoft).
XYZ = {
    "p3": ((0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06657, 0.78407)),
    "adobe": ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457)),
    "prophoto": ((0.79767, 0.28804, 0.0), (0.13519, 0.71188, 0.0), (0.03134, 0.00009, 0.82491)),
    "srgb": ((0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.7141)),
}


def table(curve: Callable[[float], float], count: int = 1024) -> bytes:
    values = [round(65535 * curve(k / (count - 1))) for k in range(count)]
    return b"curv" + struct.pack(f">II{count}H", 0, count, *values)


def gamma(power: float) -> bytes:
    return b"curv" + struct.pack(">IIH", 0, 1, round(256 * power))


SRGB_TABLE = table(lambda v: v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4)
SRGB_V4 = b"para" + struct.pack(
    ">IHH5i", 0, 3, 0, *(round(65536 * v) for v in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045))
)


def profile(
    space: bytes, tags: dict[bytes, bytes], name: str, version: int = 2, kind: bytes = b"mntr"
) -> bytes:
    """An ICC profile, after ICC.1:2001-04."""
    described = b"desc" + struct.pack(">II", 0, len(name) + 1) + name.encode() + bytes(1 + 8 + 3 + 67)
    if version == 4:
        described = b"mluc" + struct.pack(">III2s2sII", 0, 1, 12, b"en", b"US", 2 * len(name), 28)
        described += name.encode("utf-16-be")
    tags = {b"desc": described, b"wtpt": xyz(0.9642, 1.0, 0.8249), **tags}
    at, directory, body = 132 + 12 * len(tags), b"", b""
    for tag, data in tags.items():
        data += bytes(-len(data) % 4)
        directory += tag + struct.pack(">II", at + len(body), len(data))
        body += data
    lab = b"Lab " if kind == b"prtr" else b"XYZ "
    head = struct.pack(">II4s4s4s4s12s4s", at + len(body), 0, bytes([version, 0x20, 0, 0]), kind, space, lab,
                       bytes(12), b"acsp")  # fmt: skip
    head = head.ljust(68, b"\0") + struct.pack(">3i", *(round(65536 * v) for v in (0.9642, 1, 0.8249)))
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + directory + body


def xyz(*values: float) -> bytes:
    return b"XYZ " + struct.pack(">I3i", 0, *(round(65536 * v) for v in values))


def rgb(primaries: str, curve: bytes, name: str = "A camera", version: int = 2) -> bytes:
    tags = {tag: xyz(*value) for tag, value in zip((b"rXYZ", b"gXYZ", b"bXYZ"), XYZ[primaries], strict=True)}
    curves = dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    return profile(b"RGB ", {**tags, **curves}, name, version)


def ink() -> bytes:
    """CMYK by a table of two nodes an axis: each ink takes light, black most."""
    nodes = []
    for k in range(16):
        c, m, y, black = (k >> 3) & 1, (k >> 2) & 1, (k >> 1) & 1, k & 1
        light = max(0.0, 100 - 30 * c - 35 * m - 10 * y) * (1 - black)
        nodes += [
            light / 100 * 65280,
            *(32768 + 256 * v * (1 - black) for v in (-30 * c + 60 * m, 60 * y - 35 * c)),
        ]
    ends = struct.pack(">2H", 0, 65535)
    head = b"mft2" + struct.pack(">IBBBx9i2H", 0, 4, 3, 2, *(65536, 0, 0, 0, 65536, 0, 0, 0, 65536), 2, 2)
    lut = head + ends * 4 + struct.pack(">48H", *map(round, nodes)) + ends * 3
    return profile(b"CMYK", {b"A2B0": lut}, "An ink", kind=b"prtr")


RGB_PROFILES = {
    "Display P3, version 4": rgb("p3", SRGB_V4, "Display P3", 4),
    "Display P3, a table": rgb("p3", SRGB_TABLE),
    "Adobe RGB": rgb("adobe", gamma(563 / 256), "Adobe RGB (1998)"),
    "a gamma of 2.2": rgb("srgb", gamma(2.2)),
}
FILES = {
    "png": {},
    "jpg": {"quality": 100, "subsampling": 0},
    "tif": {},
    "webp": {"lossless": True},
    "avif": {"quality": 100, "subsampling": "4:4:4"},
    "heic": {"quality": 100, "chroma": 444},
}


def flat(colours: NDArray[np.uint8]) -> Image.Image:
    """Squares of 16 px of these colours, in a row."""
    return Image.fromarray(np.repeat(np.repeat(colours[None], 16, 0), 16, 1))


def from_srgb(colours: NDArray[np.uint8], icc: bytes, mode: str = "RGB") -> Image.Image:
    srgb = ImageCms.createProfile("sRGB")
    seen = ImageCms.profileToProfile(flat(colours), srgb, io.BytesIO(icc), outputMode=mode)
    assert seen is not None
    return seen


def middles(pixels: NDArray[np.uint8]) -> NDArray[np.int64]:
    return pixels[8, 8::16].astype(np.int64)


@pytest.mark.parametrize("suffix", FILES)
@pytest.mark.parametrize("kind", RGB_PROFILES)
def test_a_profile_is_read_in_every_format(tmp_path: Path, suffix: str, kind: str) -> None:
    if suffix == "heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    path, icc = tmp_path / f"a.{suffix}", RGB_PROFILES[kind]
    stored = from_srgb(COLOURS, icc)
    stored.save(path, icc_profile=icc, **FILES[suffix])
    seen = middles(decode(path)[0])
    with Image.open(path) as file:
        wanted = ImageCms.profileToProfile(
            file.convert("RGB"), io.BytesIO(icc), ImageCms.createProfile("sRGB")
        )
    assert wanted is not None
    assert np.abs(seen - middles(np.asarray(wanted))).max() <= 1
    bound = {"avif": 6, "heic": 8, "jpg": 3}.get(suffix, 1 if kind != "a gamma of 2.2" else 2)
    assert np.abs(seen - COLOURS)[:3].max() <= bound


def test_the_colours_of_two_well_known_spaces(tmp_path: Path) -> None:
    """sRGB's (40, 180, 60) has these values in Display P3 and in Adobe RGB, by LittleCMS."""
    for icc, values in (("Display P3, version 4", (88, 177, 77)), ("Adobe RGB", (106, 179, 72))):
        Image.new("RGB", (8, 8), values).save(tmp_path / "a.png", icc_profile=RGB_PROFILES[icc])
        assert np.abs(decode(tmp_path / "a.png")[0] - np.array([40.0, 180, 60])).max() <= 1


SAME = {
    "HP's and Microsoft's": rgb("srgb", SRGB_TABLE, "sRGB IEC61966-2.1"),
    "version 4": rgb("srgb", SRGB_V4, "sRGB", 4),
    "LittleCMS's": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
    "a small table": rgb(
        "srgb", table(lambda v: v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4, 42), "c2"
    ),
}


@pytest.mark.parametrize("icc", [None, *SAME.values()], ids=["none", *SAME])
@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P"])
def test_srgb_keeps_its_bits(tmp_path: Path, icc: bytes | None, mode: str) -> None:
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 256, (40, 50, 4), dtype=np.uint8)).convert(
        mode
    )
    noise.save(tmp_path / "a.png", icc_profile=icc)
    seen, _ = decode(tmp_path / "a.png")
    np.testing.assert_array_equal(seen, np.asarray(noise.convert("RGB")))
    assert told_colors(tmp_path / "a.png") is None


@pytest.mark.parametrize("mode", ["L", "LA", "RGBA", "P", "I;16", "CMYK", "LAB"])
def test_pixels_of_every_kind(tmp_path: Path, mode: str) -> None:
    """Against LittleCMS's own conversion; alpha stays."""
    path = tmp_path / ("a.tif" if mode in ("CMYK", "LAB") else "a.png")
    if mode in ("L", "LA", "I;16"):
        icc = profile(b"GRAY", {b"kTRC": gamma(1.0)}, "A grey")
        levels = np.repeat(np.repeat(np.array([[0, 1, 5, 40, 128, 255]], np.uint8), 16, 0), 16, 1)
        photo = Image.fromarray(levels)
        wanted = ImageCms.profileToProfile(
            photo, io.BytesIO(icc), ImageCms.createProfile("sRGB"), outputMode="RGB"
        )
        if mode == "I;16":
            photo = Image.fromarray(levels.astype(np.uint16) * 257)
        elif mode == "LA":
            photo.putalpha(200)
    elif mode == "CMYK":
        icc, inks = (
            ink(),
            np.array([[0, 0, 0, 0], [255, 0, 0, 0], [0, 128, 255, 0], [0, 0, 0, 200]], np.uint8),
        )
        photo = Image.fromarray(np.repeat(np.repeat(inks[None], 16, 0), 16, 1), "CMYK")
        wanted = ImageCms.profileToProfile(
            photo, io.BytesIO(icc), ImageCms.createProfile("sRGB"), outputMode="RGB"
        )
    elif mode == "LAB":
        icc, lab = None, ImageCms.createProfile("LAB")
        photo = ImageCms.profileToProfile(
            flat(COLOURS), ImageCms.createProfile("sRGB"), lab, outputMode="LAB"
        )
        wanted = flat(COLOURS)
    else:
        icc = RGB_PROFILES["Display P3, a table"]
        photo, wanted = from_srgb(COLOURS, icc), flat(COLOURS)
        photo = photo.quantize(16) if mode == "P" else photo.convert("RGBA")
        if mode == "RGBA":
            photo.putalpha(100)
    assert photo is not None
    assert wanted is not None
    photo.save(path, icc_profile=icc)
    seen, mask = decode(path)
    assert np.abs(middles(seen) - middles(np.asarray(wanted))).max() <= (2 if mode == "LAB" else 1)
    assert (mask is None) == (mode not in ("LA", "RGBA"))


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_of(pixels: NDArray[np.uint8 | np.uint16], *chunks: bytes) -> bytes:
    """A PNG file of [H, W, 3] with 8 or 16 bits, after its specification."""
    bits = 8 * pixels.itemsize
    head = struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], bits, 2, 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(f">u{pixels.itemsize}").tobytes() for row in pixels)
    parts = [chunk(b"IHDR", head), *chunks, chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def points(*values: float) -> bytes:
    return chunk(b"cHRM", struct.pack(">8I", *(round(100_000 * v) for v in values)))


D65, BT709, P3 = (0.3127, 0.329), (0.64, 0.33, 0.3, 0.6, 0.15, 0.06), (0.68, 0.32, 0.265, 0.69, 0.15, 0.06)
LINEAR = np.array([0.021219, 0.456411, 0.045186])  # sRGB (40, 180, 60) as linear light


@pytest.mark.parametrize(
    ("stored", "chunks"),
    [
        ((88, 177, 77), [chunk(b"cICP", bytes([12, 13, 0, 1]))]),
        ((40, 180, 60), [chunk(b"cICP", bytes([1, 13, 0, 1])), points(*D65, *P3)]),  # cICP comes first
        ((88, 177, 77), [chunk(b"gAMA", struct.pack(">I", 45455)), points(*D65, *P3)]),
        ((40, 180, 60), [chunk(b"gAMA", struct.pack(">I", 45455)), points(*D65, *BT709)]),
        (
            (40, 180, 60),
            [chunk(b"sRGB", b"\0"), chunk(b"gAMA", struct.pack(">I", 100_000))],
        ),  # sRGB before gAMA
        (tuple(np.rint(255 * LINEAR ** (1 / 1.8))), [chunk(b"gAMA", struct.pack(">I", 55556))]),
        ((40, 180, 60), []),
    ],
)
def test_chunks_of_png(tmp_path: Path, stored: tuple[int, int, int], chunks: list[bytes]) -> None:
    (tmp_path / "a.png").write_bytes(png_of(np.full((8, 8, 3), stored, np.uint8), *chunks))
    assert np.abs(decode(tmp_path / "a.png")[0] - np.array([40.0, 180, 60])).max() <= 1


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("curve", [1.0, 1.8])
def test_16_bits_keep_their_steps(tmp_path: Path, suffix: str, curve: float) -> None:
    """Linear light of 8 bits has no steps between 0 and 13 of sRGB's 255."""
    icc = rgb("srgb", gamma(curve))
    levels = np.rint(65535 * LINEAR ** (1 / round(256 * curve) * 256)).astype(np.uint16)
    pixels = np.broadcast_to(levels, (8, 8, 3))
    path = tmp_path / f"a.{suffix}"
    if suffix == "png":
        packed = chunk(b"iCCP", b"a\0\0" + zlib.compress(icc))
        path.write_bytes(png_of(np.ascontiguousarray(pixels), packed))
    else:
        import cv2

        cv2.imwrite(str(path), pixels[..., ::-1], [cv2.IMWRITE_TIFF_COMPRESSION, 1])
        data = bytearray(path.read_bytes())  # its directory once more at the end, with the tag of the profile
        at = struct.unpack_from("<I", data, 4)[0]
        count = struct.unpack_from("<H", data, at)[0]
        entries = [bytes(data[at + 2 + 12 * k : at + 14 + 12 * k]) for k in range(count)]
        entries.append(struct.pack("<HHII", 34675, 7, len(icc), len(data)))
        data += icc + bytes(len(icc) % 2)
        struct.pack_into("<I", data, 4, len(data))
        path.write_bytes(bytes(data) + struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4))
    assert np.abs(decode(path)[0] - np.array([40.0, 180, 60])).max() <= 1


@pytest.mark.parametrize(
    ("chunks", "told"),
    [
        ([chunk(b"gAMA", bytes(4)), points(*[0.0] * 8)], "which are none"),
        ([chunk(b"gAMA", struct.pack(">I", 1)), points(0.3, 0.3, *[0.5] * 6)], "which are none"),
        ([chunk(b"cICP", bytes([99, 99, 0, 1]))], "unknown primaries (99 of H.273)"),
        ([chunk(b"iCCP", b"a\0\0not packed")], "a damaged profile"),
        ([chunk(b"iCCP", b"a\0\0" + zlib.compress(b"no profile"))], "a damaged profile"),
    ],
)
def test_what_says_nothing_is_said(tmp_path: Path, chunks: list[bytes], told: str) -> None:
    (tmp_path / "a.png").write_bytes(png_of(np.full((8, 8, 3), 100, np.uint8), *chunks))
    colors = told_colors(tmp_path / "a.png")
    assert colors is not None
    assert told in colors.name
    assert not colors.known
    assert (decode(tmp_path / "a.png")[0] == 100).all()


def test_adobe_rgb_of_a_camera_that_writes_no_profile(tmp_path: Path) -> None:
    """DCF 2.0: ColorSpace is "uncalibrated", and InteroperabilityIndex R03."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    Image.new("RGB", (64, 64), (106, 179, 72)).save(tmp_path / "a.jpg", exif=exif, quality=100, subsampling=0)
    assert np.abs(decode(tmp_path / "a.jpg")[0].mean((0, 1)) - (40, 180, 60)).max() <= 1.5


@pytest.mark.parametrize(
    "icc", [b"no profile at all", RGB_PROFILES["Adobe RGB"][:150], SAME["version 4"][:90], ink()]
)
def test_a_damaged_or_strange_profile_is_said(tmp_path: Path, icc: bytes) -> None:
    truth = make_truth(5)
    write_colmap(truth, tmp_path)
    for name in truth.names[:2]:
        with Image.open(tmp_path / "images" / name) as photo:
            photo.save(tmp_path / "images" / name, icc_profile=icc)
    scene = load_scene(tmp_path, test_every=0)
    np.testing.assert_array_equal(scene.train[0].image, truth.photos[0])
    (note,) = [note for note in scene.notes if "profile" in note]
    assert note.startswith("2 of 5 photos are in a ")
    assert "not converted, but read as sRGB: view_00.png, view_01.png" in note


def test_a_high_dynamic_range_is_toned_down(tmp_path: Path) -> None:
    """Reference white (ITU-R BT.2408) is bent like that of films; grey stays grey."""
    level = round(0.5806 * 255)
    white = np.full((8, 8, 3), level, np.uint8)
    (tmp_path / "a.png").write_bytes(png_of(white, chunk(b"cICP", bytes([9, 16, 0, 1]))))
    light = 1 - 0.25 * np.exp(-1)
    assert np.abs(decode(tmp_path / "a.png")[0] - 255 * (1.055 * light ** (1 / 2.4) - 0.055)).max() <= 2
    colors = told_colors(tmp_path / "a.png")
    assert colors is not None
    assert colors.name == "BT.2020 with a high dynamic range (PQ)"


def test_all_who_read_photos_get_srgb(tmp_path: Path) -> None:
    """Training, and the pictures for COLMAP; both say it."""
    truth, icc = make_truth(6, ".jpg"), RGB_PROFILES["Display P3, a table"]
    write_colmap(truth, tmp_path)
    for name in truth.names[:4]:
        Image.new("RGB", (48, 36), (88, 177, 77)).save(
            tmp_path / "images" / name, quality=100, icc_profile=icc
        )
    scene = load_scene(tmp_path, test_every=0)
    assert np.abs(scene.train[0].image - np.array([40.0, 180, 60])).max() <= 2
    assert "4 of 6 photos are in A camera: they are converted to sRGB" in scene.notes
    heard = list[str]()
    photos = looked_at(tmp_path, lambda stage: heard.append(str(stage)))
    assert any("photos are in A camera" in text for text in [*heard, *photos.notes])
    photos.write(tmp_path / "copies")
    assert next(iter(photos.colmap_names)) == "view_00.jpg"
    assert not (tmp_path / "copies" / "view_00.jpg").is_symlink()
    assert (tmp_path / "copies" / "view_05.jpg").is_symlink()
    with Image.open(tmp_path / "copies" / "view_00.jpg") as copy:
        assert "icc_profile" not in copy.info
        assert np.abs(np.asarray(copy) - np.array([40.0, 180, 60])).max() <= 3
    assert glance(tmp_path / "images" / truth.names[5]).colors is None
