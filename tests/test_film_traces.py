"""Frames of films are told by their luma's levels, and what their codec left of fine details."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from test_diagnose import clean_photo, degraded_scene
from test_hqgs import fixed

from hqgs.diagnosis import scene
from hqgs.diagnosis.codec import film_detail
from hqgs.diagnosis.photo import Finding
from hqgs.diagnosis.scene import diagnose_scene
from hqgs.photos.jpeg import decode_jpeg, encode_jpeg
from hqgs.photos.pixels import as_floats
from hqgs.photos.resize import area_downscale
from hqgs.scene.scene import Scene
from hqgs.training.methods.formed import FILM_NOISE
from hqgs.training.trainer import Trainer
from tests.tiny_scene import tiny_config, tiny_scene

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
    assert why.startswith(
        "3 of 3 photos are told to be frames of a film; as decoded, the finest details are 0."
    )


def test_frames_of_a_coarse_film_differ_by_its_codec(monkeypatch: pytest.MonkeyPatch) -> None:
    shaken = Finding("shake", "photos differ by 0.25 in sharpness", "shake", 0.25)
    monkeypatch.setattr(scene, "shake_finding", lambda _: shaken)
    good, coarse = map(diagnose_scene, films())
    assert (good.formation, coarse.formation) == ("shake", "video")
    assert {name: needed for name, needed, _ in coarse.needs()}["shake"] is False


def test_a_coarse_film_trains_as_noisy_photos() -> None:
    """Alone; where cameras are learned beside it, as photos without a fault."""
    noisy, film, plain, both = (
        Trainer(tiny_scene(), tiny_config(method="hqgs", hqgs=replace(fixed(kind), held_pixels=False)))
        for kind in (f"noise:{FILM_NOISE:g}", "video", "exposure", "video+exposure")
    )
    assert replace(film.config, hqgs=noisy.config.hqgs) == noisy.config
    assert film.config.densify != both.config.densify == plain.config.densify
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
