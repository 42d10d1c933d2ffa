"""The sharpest frame of each interval of a film, and what is said of films that cannot be read."""

from __future__ import annotations

import os
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from test_diagnose import clean_photo

from hqgs.base.stages import Stage
from hqgs.diagnosis.scene import diagnose_scene
from hqgs.photos.jpeg import fine_detail
from hqgs.scene.film import film_frames, frame_details
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.folder import write_colmap_folder
from hqgs.scene.source import degrade, load, pictures

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
    with pytest.raises(ValueError, match=r"no\.mp4 cannot be read: it is no film, or damaged$"):
        load(tmp_path / "no.mp4")
    with pytest.raises(ValueError, match="frames is 2, wanted at least 3"):
        film_frames(tmp_path / "no.mp4", tmp_path, 2)
    with pytest.raises(ValueError, match=r"it is no film, or damaged$"):
        load(tmp_path / "no.mp4", cache=tmp_path / "runs" / "new")
    assert sorted(os.listdir(tmp_path)) == ["no.mp4"]  # nor the folder of a run, nor the one above it
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"it is no film, or damaged$"):
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
    write_colmap_folder(source, tmp_path / "walk", tmp_path / "work", len(views))
    there = load_scene(tmp_path / "walk")
    assert all(view.film == details[view.name] for view in (*there.train, *there.test))
    (folder / "frames.json").write_text("{}")
    with pytest.raises(ValueError, match=r"frames\.json is damaged: KeyError\('details'\)"):
        load(source, frames=len(views), cache=tmp_path)
