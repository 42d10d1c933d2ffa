"""Films as cameras and other programs write them: what FFmpeg's own player shows becomes photos."""

from __future__ import annotations

import os
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from test_film import encoded

from hqgs.photos.film_colors import as_photo
from hqgs.photos.video import pyav
from hqgs.scene.film import film_frames
from hqgs.show.frames import _write_mp4

av: Any = pytest.importorskip("av")
RED, WIDTH, HEIGHT = (200, 60, 40), 128, 96


def pictures(count: int, width: int = WIDTH, height: int = HEIGHT) -> list[NDArray[np.uint8]]:
    """Waves that drift by 3 px a frame; red in the upper left corner."""
    x = np.arange(width)[None, :, None]
    made = []
    for k in range(count):
        wave = (127 + 60 * np.sin((x - 3 * k) / 6)).astype(np.uint8)
        picture = np.broadcast_to(wave, (height, width, 3)).copy()
        picture[: height // 3, : width // 4] = (250, 0, 0)
        made.append(picture)
    return made


def written(path: Path, streams: list[tuple[list[NDArray[np.uint8]], str, int]], **options: str) -> Path:
    """A film of several streams of pictures, each with its codec and FFmpeg's disposition."""
    with av.open(str(path), "w") as film:
        made = []
        for images, codec, disposition in streams:
            stream = film.add_stream(codec, rate=25)
            stream.height, stream.width = images[0].shape[:2]
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            stream.options = {"crf": "10", **options} if codec == "libx264" else {}
            stream.disposition = disposition
            made.append(stream)
        for stream, (images, _, _) in zip(made, streams, strict=True):
            for image in images:
                for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                    film.mux(packet)
            for packet in stream.encode():
                film.mux(packet)
    return path


def frames_of(path: Path, folder: Path, count: int = 4) -> tuple[list[NDArray[np.int64]], str]:
    found, note = film_frames(path, folder / "frames", count)
    return [np.asarray(Image.open(p)).astype(np.int64) for p in sorted(found.glob("*.jpg"))], note


@pytest.mark.parametrize("order", ["tff", "bff"])
def test_two_fields_a_frame_are_deinterlaced(tmp_path: Path, order: str) -> None:
    """Rows differ by what the wave drifts between two fields; each is one time again."""
    fields = pictures(24)
    woven = list[NDArray[np.uint8]]()
    for first, second in zip(fields[::2], fields[1::2], strict=True):
        frame, late = first.copy(), 1 if order == "tff" else 0
        frame[late::2] = second[late::2]
        woven.append(frame)
    path = written(tmp_path / "a.mp4", [(woven, "libx264", 1)], **{"x264-params": f"{order}=1"})
    frames, note = frames_of(path, tmp_path)
    assert "interlaced, and deinterlaced by FFmpeg's yadif" in note
    for frame in frames:
        assert np.abs(np.diff(frame[40:, 40:], axis=0)).mean() < 3
    assert np.abs(np.diff(woven[3][40:, 40:].astype(np.int64), axis=0)).mean() > 15
    plain, told = frames_of(written(tmp_path / "b.mp4", [(fields, "libx264", 1)]), tmp_path)
    assert len(plain) == 4
    assert told.endswith("one for each interval")


def turned(path: Path, matrix: tuple[int, int, int, int]) -> Path:
    """The film with a, b, c, d of its display matrix (ISO 14496-12): (x, y) goes to (ax + cy, bx + dy)."""
    content = bytearray(path.read_bytes())
    at = content.index(b"tkhd") + 44
    a, b, c, d = (value << 16 for value in matrix)
    struct.pack_into(">9i", content, at, a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("a", [1, -1])
@pytest.mark.parametrize("b", [1, -1])
@pytest.mark.parametrize("across", [False, True])
def test_every_display_matrix(tmp_path: Path, a: int, b: int, across: bool) -> None:
    """A corner of the picture goes where the matrix takes it."""
    matrix = (0, a, b, 0) if across else (a, 0, 0, b)
    path = turned(written(tmp_path / "a.mp4", [(pictures(8), "libx264", 1)]), matrix)
    frames, note = frames_of(path, tmp_path)
    m = np.array([[matrix[0], matrix[2]], [matrix[1], matrix[3]]])
    corner = m @ np.array([WIDTH / 8 - WIDTH / 2, HEIGHT / 6 - HEIGHT / 2])
    shape = (WIDTH, HEIGHT) if across else (HEIGHT, WIDTH)
    assert frames[0].shape == (*shape, 3)
    x, y = (corner + np.array(shape[::-1]) / 2).astype(int)
    assert frames[0][y, x, 0] > 200 > 60 > frames[0][y, x, 1]
    assert ("mirrored" in note) == (np.linalg.det(m) < 0)


def test_the_film_is_taken_not_its_cover_thumbnail_or_proxy(tmp_path: Path) -> None:
    cover = [np.full((240, 320, 3), RED, np.uint8)]
    small = pictures(20, 32, 24)
    covered = written(tmp_path / "a.mp4", [(cover, "mjpeg", 0x400), (pictures(20), "libx264", 0)])
    plain = written(
        tmp_path / "b.mkv", [(cover, "mjpeg", 0), (small, "libx264", 1), (pictures(20), "libx264", 0)]
    )
    shown = written(tmp_path / "c.mp4", [(cover * 2, "mjpeg", 0), (pictures(20), "libx264", 0)])
    for path in (covered, plain, shown):
        frames, note = frames_of(path, tmp_path)
        assert len(frames) == 4
        assert frames[0].shape == (HEIGHT, WIDTH, 3)
        assert f"the one of {WIDTH} x {HEIGHT} px" in note


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_damaged_pieces_are_left_out(tmp_path: Path, codec: str) -> None:
    rng = np.random.default_rng(0)
    images = [np.clip(p + rng.normal(0, 20, p.shape), 0, 255).astype(np.uint8) for p in pictures(150)]
    path = written(tmp_path / "a.mp4", [(images, codec, 1)])
    whole = path.read_bytes()
    start, end = whole.index(b"mdat") + 64, whole.rindex(b"moov") if b"moov" in whole else len(whole)
    lost = 0
    for seed in range(6):
        broken = bytearray(whole)
        at = start + int(np.random.default_rng(seed).integers(0, end - start - 400))
        broken[at : at + 192] = np.random.default_rng(seed).bytes(192)
        (tmp_path / f"{seed}.mp4").write_bytes(broken)
        frames, note = frames_of(tmp_path / f"{seed}.mp4", tmp_path, 10)
        assert len(frames) >= 9
        lost += "damaged parts were left out" in note
    cut = tmp_path / "cut.mp4"  # a card that was pulled: its table first, its end missing
    cut.write_bytes(whole if whole.index(b"mdat") < whole.index(b"moov") else whole[: len(whole) // 2])
    assert codec == "mpeg4" or lost


@pytest.mark.parametrize("name", ["12:30.mp4", "-.mp4", "concat:a|b.mp4", "caf\udce9.mp4", "a%03d.mp4"])
def test_a_film_of_any_name_by_a_relative_path(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = written(tmp_path / "plain.mp4", [(pictures(8), "libx264", 1)])
    os.rename(made, name)
    frames, note = frames_of(Path(name), tmp_path)
    assert len(frames) == 4
    note.encode()


def test_our_films_say_their_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the definition of BT.709 (ITU-R BT.709, 8 bits): Y, Cb and Cr of the colour."""
    monkeypatch.chdir(tmp_path)
    _write_mp4(pyav(""), Path("walk:1.mp4"), iter([np.full((720, 1280, 3), RED, np.uint8)] * 3), 30)
    with av.open(str(tmp_path / "walk:1.mp4")) as film:
        coded = film.streams.video[0].codec_context
        assert (coded.colorspace, coded.color_primaries, coded.color_trc, coded.color_range) == (1, 1, 1, 1)
        frame = next(film.decode(video=0))
    r, g, b = np.array(RED) / 255
    y = 0.2126 * r + 0.7152 * g + 0.0722 * b
    wanted = 16 + 219 * y, 128 + 224 * (b - y) / 1.8556, 128 + 224 * (r - y) / 1.5748
    for plane, value in zip(frame.planes, wanted, strict=True):
        assert abs(np.frombuffer(plane, np.uint8)[0] - value) <= 1
    assert np.abs(as_photo(frame)[300, 300] - np.array(RED, float)).max() <= 2


@pytest.mark.parametrize(
    ("primaries", "stored"), [(12, (88, 177, 77)), (1, (40, 180, 60)), (2, (40, 180, 60))]
)
def test_wide_primaries_become_srgb(primaries: int, stored: tuple[int, int, int]) -> None:
    """sRGB's (40, 180, 60) in Display P3, by LittleCMS, as BT.709's Y'CbCr."""
    frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), stored, np.uint8), format="rgb24")
    frame = frame.reformat(format="yuv444p", dst_colorspace=1)
    frame.colorspace, frame.color_range, frame.color_primaries = 1, 1, primaries
    assert np.abs(as_photo(frame).mean((0, 1)) - (40, 180, 60)).max() <= 2.5


def test_pixels_of_a_camera_are_squares_and_upright_at_once(tmp_path: Path) -> None:
    path = encoded(tmp_path / "a.mp4", pictures(8), 10, wide=Fraction(3, 2))
    frames, _ = frames_of(turned(path, (0, 1, -1, 0)), tmp_path)
    assert frames[0].shape == (192, HEIGHT, 3)
