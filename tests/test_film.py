"""Films: the sharpest frame of each interval, colours, traces of codecs, 360 degrees, what is refused."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from test_diagnose import clean_photo, degraded_scene
from test_hqgs import fixed

from hqgs.base.stages import Stage
from hqgs.diagnosis import scene
from hqgs.diagnosis.codec import film_detail
from hqgs.diagnosis.photo import Finding
from hqgs.diagnosis.scene import diagnose_scene
from hqgs.photos.film_colors import KNEE, as_photo, toned
from hqgs.photos.jpeg import decode_jpeg, encode_jpeg, fine_detail
from hqgs.photos.pixels import as_floats
from hqgs.photos.resize import area_downscale
from hqgs.scene.film import film_frames, frame_details, frames_around, projection
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.bare_photos import BarePhotos, readable
from hqgs.scene.sfm.folder import write_colmap_folder
from hqgs.scene.source import degrade, load, pictures
from hqgs.training.methods.formed import FILM_NOISE
from hqgs.training.trainer import Trainer
from tests.tiny_scene import tiny_config, tiny_scene

av = pytest.importorskip("av")
RATE, EVERY = 30, 10  # frames a second; of ten frames one is sharp


def film(path: Path, frames: int) -> Path:
    """Ten frames of a picture, whose red rises with the number; all but the seventh are blurred."""
    rng = np.random.default_rng(0)
    texture = ndimage.gaussian_filter(rng.random((96, 128)), 1.0)
    texture = (texture - texture.min()) / np.ptp(texture)
    images = list[NDArray[np.uint8]]()
    for k in range(frames):
        grey = texture if k % EVERY == 7 else ndimage.gaussian_filter(texture, 3.0)
        images.append((255 * np.stack([grey * 0.5 + 0.5 * k / frames, grey, grey], -1)).astype(np.uint8))
    return encoded(path, images, 10)


def encoded(
    path: Path,
    images: list[NDArray[np.uint8]],
    crf: int,
    times: list[int] | None = None,
    wide: Fraction = Fraction(1),
) -> Path:
    """Pictures [H, W, 3] of one size as a film; `times`: when each is shown, ms, where the rate varies;
    `wide`: a pixel, of its height."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=RATE)
        stream.height, stream.width = images[0].shape[:2]
        if wide != 1:
            stream.codec_context.sample_aspect_ratio = wide
        stream.pix_fmt, stream.options = "yuv420p", {"crf": str(crf)}
        if times is not None:
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
            stream.options |= {"bf": "0"}  # as phones do: frames lie in the file as they are shown
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            if times is not None:
                frame.pts, frame.time_base = times[k], Fraction(1, 1000)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def test_the_sharpest_frame_of_each_interval_is_taken_once(tmp_path: Path) -> None:
    source = film(tmp_path / "walk.mp4", 60)
    stages: list[Stage] = []
    folder, note = film_frames(source, tmp_path / "frames", 6, stages.append)
    names = sorted(path.name for path in folder.glob("*.jpg"))
    assert sorted(frame_details(folder)) == names
    assert names == [f"{k:06d}.jpg" for k in (7, 17, 27, 37, 47, 57)]
    assert "sharpest 6 frames of walk.mp4" in note
    assert stages[-1].done == 60
    with Image.open(folder / names[0]) as picture:
        assert picture.size == (128, 96)
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]

    def other(stage: Stage) -> None:  # another process is faster
        if not (tmp_path / "twice").is_dir():
            film_frames(source, tmp_path / "twice", 6)

    both, _ = film_frames(source, tmp_path / "twice", 6, other)
    assert sorted(path.name for path in both.glob("*.jpg")) == names
    assert [path.name for path in both.parent.iterdir()] == [both.name]
    times = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    again, _ = film_frames(source, tmp_path / "frames", 6)
    assert {path: path.stat().st_mtime_ns for path in again.iterdir()} == times
    few, _ = film_frames(source, tmp_path / "frames")
    assert few != folder
    assert len(list(few.glob("*.jpg"))) == 30  # of 2 s: the fewest that are taken


def test_a_variable_rate_counts_by_time(tmp_path: Path) -> None:
    """30 frames in the first second, 5 then: an interval is a length of time, not of frames."""
    times = [*range(0, 1000, 34), *range(1000, 3000, 400)]
    images = [clean_photo(0)[:96, :128]] * len(times)
    folder, _ = film_frames(encoded(tmp_path / "phone.mp4", images, 20, times), tmp_path / "frames", 6)
    chosen = [times[int(path.stem)] for path in sorted(folder.glob("*.jpg"))]
    assert [int(6 * time / (times[-1] + 1000 / RATE)) for time in chosen] == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("wide", "width"), [(Fraction(4, 3), 171), (Fraction(1, 2), 64), (Fraction(1000), 128)]
)
def test_pixels_that_are_no_squares_become_squares(tmp_path: Path, wide: Fraction, width: int) -> None:
    """As a player shows them; a width that none can have says nothing."""
    picture = np.zeros((96, 128, 3), np.uint8)
    picture[:, 96:, 0] = 250
    path = encoded(tmp_path / "anamorphic.mkv", [picture] * 4, 12, wide=wide)
    folder, _ = film_frames(path, tmp_path / "frames", 3)
    for frame in folder.glob("*.jpg"):
        shown = np.asarray(Image.open(frame)).astype(int)
        assert shown.shape == (96, width, 3)
        edge = round(0.75 * width)
        assert shown[:, edge + 4 :, 0].min() > 200 > 60 > shown[:, : edge - 4, 0].max()


@pytest.mark.parametrize("suffix", ["mp4", "avi"])
def test_a_title_that_is_no_text_is_passed_by(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"titled.{suffix}"
    with av.open(str(path), "w") as container:
        container.metadata["title"] = "Schoene AAAA"
        stream = container.add_stream("mpeg4", rate=RATE)
        stream.height, stream.width, stream.pix_fmt = 96, 128, "yuv420p"
        for packet in (*stream.encode(av.VideoFrame(128, 96, "yuv420p")), *stream.encode()):
            container.mux(packet)
    content = path.read_bytes()
    assert b"Schoene AAAA" in content
    path.write_bytes(content.replace(b"Schoene AAAA", b"Sch\xf6\xf6ne AAAA"))
    folder, note = film_frames(path, tmp_path / "frames", 3)
    assert len(list(folder.glob("*.jpg"))) == 1
    assert "titled" in note


def test_a_film_that_cannot_be_read_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "no.mp4").write_text("a text")
    with pytest.raises(ValueError, match=r"no\.mp4 cannot be read: it is not a film, or damaged$"):
        load(tmp_path / "no.mp4")
    with pytest.raises(ValueError, match="frames is 2, wanted at least 3"):
        film_frames(tmp_path / "no.mp4", tmp_path, 2)
    with pytest.raises(ValueError, match=r"it is not a film, or damaged$"):
        load(tmp_path / "no.mp4", cache=tmp_path / "runs" / "new")
    assert sorted(os.listdir(tmp_path)) == ["no.mp4"]  # nor the folder of a run, nor the one above it
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"it is not a film, or damaged$"):
        load(tmp_path / "no.mp4", cache=tmp_path / "empty")
    assert list((tmp_path / "empty").iterdir()) == []  # the user's own folder stays
    (tmp_path / "empty").rmdir()
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(
        ValueError, match=r"is a film, which needs PyAV, the extra 'video': pip install 'hqgs\[video\]'"
    ):
        load(tmp_path / "no.mp4")


def test_frames_tell_what_the_codec_left_of_fine_details(tmp_path: Path) -> None:
    """A coarse film is a part of the formation although its frames are stored; a good one is not."""
    photos = [clean_photo(k) for k in range(3)]
    found = {crf: diagnose_scene(pictures(encoded(tmp_path / f"{crf}.mp4", photos, crf))) for crf in (12, 40)}
    assert {crf: one.formation for crf, one in found.items()} == {12: "none", 40: "video"}
    assert found[40].scene == "40"
    details = [photo.film for photo in found[12].photos]
    assert details == pytest.approx([fine_detail(photo.astype(np.float64)) for photo in photos], abs=0.05)


def test_a_scene_from_a_film_knows_it_at_about_its_size(cards: Scene, tmp_path: Path) -> None:
    views = sorted([*cards.train, *cards.test], key=lambda view: view.name)
    source = encoded(tmp_path / "walk.mp4", [view.image.astype(np.uint8) for view in views], 20)
    scene = load(source, frames=len(views), cache=tmp_path)
    (folder,) = (tmp_path / "frames").iterdir()
    details = frame_details(folder)
    for view in (*scene.train, *scene.test):
        assert view.film == details[view.name] > 0
    smaller = load(source, frames=len(views), cache=tmp_path, downscale=2)
    noisy = degrade(scene, "noise:5")
    assert {view.film for view in (*smaller.train, *noisy.train)} == {None}
    write_colmap_folder(source, tmp_path / "walk", tmp_path / "sfm", len(views))  # where cameras are kept
    there = load_scene(tmp_path / "walk")
    assert all(view.film == details[view.name] for view in (*there.train, *there.test))
    for damage, words in (('{"details": 1}', "is damaged: AttributeError"), ("{", "is not valid JSON")):
        (folder / "frames.json").write_text(damage)
        with pytest.raises(ValueError, match=rf"frames\.json {words}"):
            load(source, frames=len(views), cache=tmp_path)


# --- Colours of films: matrix, range and transfer are those that the film names


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


def coloured(path: Path, rgb: NDArray[np.float64], matrix: str, full: bool, trc: str = "bt709") -> Path:
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
    source = coloured(tmp_path / "a.mp4", np.array(RGB) / 255, matrix, full)
    assert np.abs(mean_colour(source, tmp_path / "frames") - RGB).max() <= 3


def test_an_untagged_frame_is_bt601() -> None:
    frame = av.VideoFrame.from_ndarray(
        planes(np.array(RGB) / 255, "smpte170m", False, 8).reshape(-1, WIDTH), format="yuv420p"
    )
    assert np.abs(as_photo(frame).reshape(-1, 3).mean(0) - RGB).max() <= 2


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (720, 1280)])
def test_an_untagged_frame_of_hd_is_bt709(width: int, height: int) -> None:
    """Y', Cb and Cr by the definition in ITU-R BT.709."""
    red, green, blue = np.array(RGB) / 255
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    flat = 16 + 219 * luma, 128 + 224 * (blue - luma) / 1.8556, 128 + 224 * (red - luma) / 1.5748
    sides = [(height, width), *[(height // 2, width // 2)] * 2]
    levels = [np.full(side, round(value), np.uint8).ravel() for side, value in zip(sides, flat, strict=True)]
    frame = av.VideoFrame.from_ndarray(np.concatenate(levels).reshape(-1, width), format="yuv420p")
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
    source = coloured(tmp_path / "a.mp4", np.full(3, white), "bt2020nc", False, trc)
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


# --- Frames of films are told by their luma's levels, and what their codec left of fine details


Levels = NDArray[np.float64]
BT601, BT709 = (0.299, 0.114), (0.2126, 0.0722)  # red's and blue's share of the luma


def decoded(photo: NDArray[np.uint8], red: float, blue: float) -> Levels:
    """A frame whose luma and chroma a film held with 8 bits, by the definition of ITU-R BT.601 and BT.709."""
    r, g, b = np.moveaxis(photo / 255, -1, 0)
    y = red * r + (1 - red - blue) * g + blue * b
    luma = np.rint(16 + 219 * y)
    cb, cr = np.rint(112 * (b - y) / (1 - blue)), np.rint(112 * (r - y) / (1 - red))
    y = (luma - 16) / 219
    r, b = y + cr / 112 * (1 - red), y + cb / 112 * (1 - blue)
    g = (y - red * r - blue * b) / (1 - red - blue)
    return np.rint(255 * np.stack([r, g, b], -1)).clip(0, 255)


@pytest.mark.parametrize("weights", [BT601, BT709])
def test_a_decoded_frame_is_told(weights: tuple[float, float]) -> None:
    assert film_detail(decoded(clean_photo(0), *weights)) is not None


def test_what_is_no_frame_or_was_changed_since_is_not() -> None:
    frame = decoded(clean_photo(0), *BT601)
    photo = as_floats(frame.astype(np.uint8))
    smaller = area_downscale(photo, None, 136, 104)[0]
    drawing = np.repeat(np.random.default_rng(0).choice([16.0, 93.0, 220.0], (200, 200, 1)), 3, axis=2)
    for levels in (
        clean_photo(0).astype(np.float64),
        np.rint(255 * smaller).astype(np.float64),
        decode_jpeg(encode_jpeg(photo, 90)).astype(np.float64) * 255,
        drawing,
        frame + np.random.default_rng(0).normal(0, 2, frame.shape),
    ):
        assert film_detail(levels) is None


@cache
def films() -> list[Scene]:
    """A good one and a coarse one."""
    return [degraded_scene(f"video:{crf}") for crf in (12, 40)]


def test_the_codec_decides_what_is_left_of_fine_details() -> None:
    """A good film is told and left alone; a coarse one is a part of the formation."""
    good, coarse = map(diagnose_scene, films())
    assert (good.formation, coarse.formation) == ("none", "video")
    details = [[photo.film for photo in found.photos] for found in (good, coarse)]
    assert all(a is not None and b is not None and a > 1.2 * b for a, b in zip(*details, strict=True))
    why = {name: reason for name, _, reason in good.needs()}["video"]
    assert why.startswith("3 of 3 photos are frames of a film; their finest details are 0.")


def test_frames_of_a_coarse_film_differ_by_its_codec(monkeypatch: pytest.MonkeyPatch) -> None:
    shaken = Finding("shake", "photos differ by 0.25 in sharpness", "shake", 0.25)
    monkeypatch.setattr(scene, "shake_finding", lambda _: shaken)
    good, coarse = map(diagnose_scene, films())
    assert (good.formation, coarse.formation) == ("shake", "video")
    assert {name: needed for name, needed, _ in coarse.needs()}["shake"] is False


def test_a_coarse_film_trains_as_noisy_photos() -> None:
    """Alone or in the look of its lens; where cameras are learned beside it, as photos without a fault."""
    noisy, film, dark, plain, both = (
        Trainer(tiny_scene(), tiny_config(method="hqgs", hqgs=replace(fixed(kind), held_pixels=False)))
        for kind in (f"noise:{FILM_NOISE:g}", "video", "vignetting+video", "exposure", "video+exposure")
    )
    assert replace(film.config, hqgs=noisy.config.hqgs) == noisy.config
    assert dark.config.densify == film.config.densify != both.config.densify == plain.config.densify
    film.step()
    noisy.step()
    assert (film.gaussians.means == noisy.gaussians.means).all()


def test_the_errors_of_a_codec_hold_no_pixels_back() -> None:
    """They go together from pixel to pixel, so that one tells of the next."""
    film = Trainer(tiny_scene(), tiny_config(method="hqgs", hqgs=fixed("video")))
    assert not any("held" in name for name in film.method.state_dict())


def test_a_shaken_film_trains_as_shaken_photos() -> None:
    shaken, both = (
        Trainer(tiny_scene(), tiny_config(method="hqgs", hqgs=fixed(kind)))
        for kind in ("shake", "shake+video")
    )
    assert both.config.hqgs.formation == "shake+video"
    assert replace(both.config, hqgs=shaken.config.hqgs) == shaken.config
    assert (both.gaussians.means == shaken.gaussians.means).all()
    assert both.left_out() == shaken.left_out()


# --- Films of 360 degrees, by what their files say


UUID = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")  # of the XML, by the specification


def box(kind: bytes, inside: bytes) -> bytes:
    return (8 + len(inside)).to_bytes(4, "big") + kind + inside


def xml(kind: str, stereo: str = "") -> bytes:
    text = f"<GSpherical:ProjectionType>{kind}</GSpherical:ProjectionType>"
    text += f"<GSpherical:StereoMode>{stereo}</GSpherical:StereoMode>" if stereo else ""
    return box(b"uuid", UUID + f"<rdf:SphericalVideo>{text}</rdf:SphericalVideo>".encode())


def cropped(width: int) -> bytes:
    sides = {"FullPanoWidthPixels": 8000, "CroppedAreaImageWidthPixels": width}
    return "".join(f"<GSpherical:{k}>{v}</GSpherical:{k}>" for k, v in sides.items()).encode()


def second(kind: bytes, mode: int, bounds: tuple[int, ...] = (0, 0, 0, 0)) -> bytes:
    st3d = box(b"st3d", bytes(4) + bytes([mode]))
    sides = b"".join(bound.to_bytes(4, "big") for bound in bounds)  # top, bottom, left, right; of 2^32
    proj = box(b"proj", box(b"prhd", bytes(16)) + box(kind, bytes(4) + sides))
    return st3d + box(b"sv3d", box(b"svhd", bytes(5)) + proj)


@pytest.mark.parametrize(
    ("inside", "told"),
    [
        (xml("equirectangular"), ("equirectangular", "mono")),
        (xml("equirectangular", "top-bottom"), ("equirectangular", "top-bottom")),
        (second(b"equi", 0), ("equirectangular", "mono")),
        (second(b"equi", 2), ("equirectangular", "left-right")),
        (second(b"cbmp", 0), ("cubemap", "mono")),
        (second(b"equi", 0, (0, 0, 2**30, 2**30)), ("a part of the sphere", "mono")),  # 180 degrees
        (
            xml("equirectangular").replace(b"</rdf", cropped(4000) + b"</rdf"),
            ("a part of the sphere", "mono"),
        ),
        (xml("equirectangular").replace(b"</rdf", cropped(8000) + b"</rdf"), ("equirectangular", "mono")),
        (box(b"mvhd", bytes(100)), None),
    ],
)
def test_what_a_file_says(inside: bytes, told: tuple[str, str] | None, tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    long = (1).to_bytes(4, "big") + b"mdat" + (16 + 40).to_bytes(8, "big") + bytes(40)  # of 64 bits
    path.write_bytes(box(b"ftyp", b"isom") + long + box(b"moov", inside))
    assert projection(path) == told
    for broken in (b"", b"no box", box(b"ftyp", b"isom")[:9], bytes(8) + b"moov"):
        path.write_bytes(broken)
        assert projection(path) is None


def told_film(path: Path, inside: bytes) -> Path:
    """A film of 128 x 64 px that says so: its last box is the one that describes it."""
    encoded(path, [clean_photo(k)[:64, :128] for k in range(4)], 20)
    data = path.read_bytes()
    at = data.rindex(b"moov") - 4
    size = int.from_bytes(data[at : at + 4], "big")
    assert at + size == len(data)
    path.write_bytes(data[:at] + (size + len(inside)).to_bytes(4, "big") + data[at + 4 :] + inside)
    return path


def test_frames_of_a_film_of_the_whole_sphere_are_panoramas(tmp_path: Path) -> None:
    """Whatever they show: these do not close."""
    folder, _ = film_frames(told_film(tmp_path / "a.mp4", xml("equirectangular")), tmp_path / "frames", 4)
    assert frames_around(folder)
    assert len(json.loads((folder / "frames.json").read_text())["details"]) == 4
    assert readable(BarePhotos(folder, 1.0, [p.name for p in sorted(folder.glob("*.jpg"))])).around
    plain, _ = film_frames(encoded(tmp_path / "b.mp4", [clean_photo(0)] * 4, 20), tmp_path / "frames", 4)
    assert not frames_around(plain)


@pytest.mark.parametrize(
    ("inside", "why"),
    [
        (second(b"cbmp", 0), "its frames are cubemap: export it as equirectangular, mono"),
        (xml("equirectangular", "top-bottom"), r"two pictures, one for each eye \(top-bottom\): export it"),
    ],
)
def test_other_films_of_a_sphere_are_refused_by_name(inside: bytes, why: str, tmp_path: Path) -> None:
    path = told_film(tmp_path / "a.mp4", inside)
    with pytest.raises(ValueError, match=rf"a\.mp4 is of 360 degrees, but .*{why}"):
        film_frames(path, tmp_path / "frames", 4)
