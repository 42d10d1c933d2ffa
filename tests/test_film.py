"""The sharpest frame of each interval of a film, and what is said of films that cannot be read."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from hqgs.base.stages import Stage
from hqgs.scene.film import film_frames
from hqgs.scene.source import load

av = pytest.importorskip("av")
RATE, EVERY = 30, 10  # frames a second; of ten frames one is sharp


def film(path: Path, frames: int) -> Path:
    """Ten frames of a picture, whose red rises with the number; all but the seventh are blurred."""
    rng = np.random.default_rng(0)
    texture = ndimage.gaussian_filter(rng.random((96, 128)), 1.0)
    texture = (texture - texture.min()) / np.ptp(texture)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        stream.options = {"crf": "10"}
        for k in range(frames):
            grey = texture if k % EVERY == 7 else ndimage.gaussian_filter(texture, 3.0)
            image = np.stack([grey * 0.5 + 0.5 * k / frames, grey, grey], -1)
            frame = av.VideoFrame.from_ndarray((255 * image).astype(np.uint8), format="rgb24")
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
    assert json.loads((folder / "frames.json").read_text()) == {"film": "walk.mp4"}
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
        ValueError, match=r"is a film, which needs the extra 'video': pip install 'hqgs\[video\]'"
    ):
        load(tmp_path / "no.mp4")
