"""Colours of films: matrix, range and transfer are those that the film names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from hqgs.photos.film_colors import KNEE, as_photo, toned
from hqgs.scene.film import film_frames

av: Any = pytest.importorskip("av")
RGB = (200, 60, 40)
WIDTH, HEIGHT = 64, 48
MATRICES = {"smpte170m": (6, 0.299, 0.114), "bt709": (1, 0.2126, 0.0722), "bt2020nc": (9, 0.2627, 0.0593)}


def planes(rgb: NDArray[np.float64], matrix: str, full: bool, bits: int) -> NDArray[Any]:
    """A flat colour (R'G'B', 0..1) as 4:2:0 planes, after the definition of each matrix."""
    _, kr, kb = MATRICES[matrix]
    r, g, b = rgb
    y = kr * r + (1 - kr - kb) * g + kb * b
    cb, cr = (b - y) / (2 * (1 - kb)), (r - y) / (2 * (1 - kr))
    one, most = 1 << (bits - 8), (1 << bits) - 1
    spread = (most, most) if full else (219 * one, 224 * one)
    low = 0 if full else 16 * one
    values = [low + spread[0] * y, 128 * one + spread[1] * cb, 128 * one + spread[1] * cr]
    area = WIDTH * HEIGHT
    flat = [np.full(n, round(v)) for n, v in zip((area, area // 4, area // 4), values, strict=True)]
    return np.concatenate(flat).astype(np.uint8 if bits == 8 else np.uint16)


def film(path: Path, rgb: NDArray[np.float64], matrix: str, full: bool, trc: str = "bt709") -> Path:
    """Four frames of it, tagged in the stream; with 10 bits where the transfer is of a high range."""
    bits = 8 if trc == "bt709" else 10
    kind = "yuv420p" if bits == 8 else "yuv420p10le"
    flat = planes(rgb, matrix, full, bits)
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, kind
        tags = f"colormatrix={matrix}:range={'pc' if full else 'tv'}:transfer={trc}"
        stream.options = {"crf": "2", "x264-params": tags}
        stream.codec_context.colorspace = MATRICES[matrix][0]
        stream.codec_context.color_range = 2 if full else 1
        for _ in range(4):
            frame = av.VideoFrame(WIDTH, HEIGHT, kind)
            at = 0
            for plane, (w, h) in zip(
                frame.planes, [(WIDTH, HEIGHT), *[(WIDTH // 2, HEIGHT // 2)] * 2], strict=True
            ):
                rows = np.zeros((plane.height, plane.line_size // flat.itemsize), flat.dtype)
                rows[:h, :w] = flat[at : at + w * h].reshape(h, w)
                plane.update(rows.tobytes())
                at += w * h
            frame.colorspace, frame.color_range = MATRICES[matrix][0], 2 if full else 1
            for packet in stream.encode(frame):
                out.mux(packet)
        for packet in stream.encode():
            out.mux(packet)
    return path


def mean_colour(source: Path, folder: Path) -> NDArray[np.float64]:
    frames, _ = film_frames(source, folder)
    with Image.open(min(frames.glob("*.jpg"))) as photo:
        return np.asarray(photo.convert("RGB")).reshape(-1, 3).mean(0)


@pytest.mark.parametrize("matrix", MATRICES)
@pytest.mark.parametrize("full", [False, True])
def test_a_film_has_its_own_matrix_and_range(tmp_path: Path, matrix: str, full: bool) -> None:
    source = film(tmp_path / "a.mp4", np.array(RGB) / 255, matrix, full)
    assert np.abs(mean_colour(source, tmp_path / "frames") - RGB).max() <= 3


def test_an_untagged_frame_is_bt601() -> None:
    frame = av.VideoFrame.from_ndarray(
        planes(np.array(RGB) / 255, "smpte170m", False, 8).reshape(-1, WIDTH), format="yuv420p"
    )
    assert np.abs(as_photo(frame).reshape(-1, 3).mean(0) - RGB).max() <= 2


@pytest.mark.parametrize("matrix", ["bt709", "smpte170m"])
def test_no_frame_gets_darker(matrix: str) -> None:
    """Colours all over the range: FFmpeg's quick way is 0.9 to 1.4 levels below them."""
    found, wanted = [], np.random.default_rng(0).uniform(0.1, 0.9, (60, 3))
    for colour in wanted:
        flat = planes(colour, matrix, False, 8).reshape(-1, WIDTH)
        frame = av.VideoFrame.from_ndarray(flat, format="yuv420p")
        frame.colorspace, frame.color_range = MATRICES[matrix][0], 1
        found.append(as_photo(frame).reshape(-1, 3).mean(0))
    assert np.abs((np.array(found) - 255 * wanted).mean(0)).max() < 0.4


@pytest.mark.parametrize(("trc", "white"), [("arib-std-b67", 0.75), ("smpte2084", 0.5806)])
def test_a_high_dynamic_range_is_toned_down_and_said(tmp_path: Path, trc: str, white: float) -> None:
    """The signals of reference white (ITU-R BT.2408): grey stays grey, white is the curve at 1."""
    source = film(tmp_path / "a.mp4", np.full(3, white), "bt2020nc", False, trc)
    folder, note = film_frames(source, tmp_path / "frames")
    assert "high dynamic range" in note
    with Image.open(min(folder.glob("*.jpg"))) as photo:
        colour = np.asarray(photo.convert("RGB")).reshape(-1, 3).mean(0)
    light = KNEE + (1 - KNEE) * (1 - np.exp(-1))
    assert np.abs(colour - 255 * (1.055 * light ** (1 / 2.4) - 0.055)).max() <= 2


@pytest.mark.parametrize("curve", [16, 18])
def test_the_curve_rises_and_ends_at_white(curve: int) -> None:
    values = toned(np.repeat(np.linspace(0, 1, 1000)[:, None], 3, 1), curve)
    assert (np.diff(values, axis=0) >= 0).all()
    assert values[0] == pytest.approx(0, abs=1e-6)
    assert 0.99 < values[-1].max() <= 1.0001
    assert np.ptp(values, axis=1).max() < 1e-3
