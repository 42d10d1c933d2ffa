"""Diagnosis of degraded photos whose degradation is known: painted pictures of discs ("dead leaves").

Discs of radius distribution r^-3 that cover each other have the edges and the 1/f^2 power spectrum of photos
(Lee, Mumford & Huang 2001). Tolerances are those that the estimators keep on real photos.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from hqgs.camera import Camera, Scene, View
from hqgs.degradations import degrade_image, encode_jpeg, parse_degradation
from hqgs.diagnosis import Diagnosis, diagnose_photo, diagnose_scene, format_diagnosis

WIDTH, HEIGHT, PHOTOS = 272, 208, 3  # px; multiples of 8 and 16


@lru_cache(maxsize=8)
def clean_photo(seed: int) -> NDArray[np.uint8]:
    """A sharp photo [HEIGHT, WIDTH, 3]: painted at 4 times the size, each pixel the mean of its area."""
    rng = np.random.default_rng(seed)
    over = 4
    picture = Image.new("RGB", (WIDTH * over, HEIGHT * over), "#808080")
    draw = ImageDraw.Draw(picture)
    count = 9_000
    radii = over * (1.2**-2 - rng.random(count) * (1.2**-2 - 90.0**-2)) ** -0.5  # r^-3 between 1.2 and 90 px
    for radius, shade in zip(radii, rng.integers(25, 230, count), strict=True):
        x, y = rng.random(2) * picture.size
        tint = rng.integers(-12, 13, 3)
        fill = tuple(int(v) for v in np.clip(shade + tint, 1, 254))
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=fill)
    return np.asarray(picture.resize((WIDTH, HEIGHT), Image.Resampling.BOX))


def degraded_scene(text: str, photos: int = PHOTOS, keep_low: bool = True) -> Scene:
    """Training views degraded by `text`, each with its own noise and direction of motion."""
    views = []
    for seed in range(photos):
        out = degrade_image(clean_photo(seed), parse_degradation(text), np.random.default_rng(seed))
        camera = Camera(WIDTH, HEIGHT, np.eye(3), np.eye(4))
        views.append(View(f"{seed}.png", camera, out.image, low=out.low if keep_low else None))
    return Scene("leaves", views, [], np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), "test")


def steps_of(diagnosis: Diagnosis) -> dict[str, float]:
    """The formation as {kind: value}."""
    return {step.kind: step.amount(WIDTH) for step in parse_degradation(diagnosis.formation).steps}


TRUTH = {
    "none": {},
    "noise:10": {"noise": (10, 1)},
    "noise:50": {"noise": (50, 3)},
    "jpeg:10": {"jpeg": (10, 0)},
    "jpeg:20": {"jpeg": (20, 0)},
    "lowres:2": {"lowres": (2, 0)},
    "lowres:4": {"lowres": (4, 0)},
    "blur:1.2": {"blur": (1.2, 0.3)},
    "blur:2.5": {"blur": (2.5, 0.3)},
    "blur:4": {"blur": (4, 0.4)},
    "blur:2.5+noise:10": {"blur": (2.5, 0.3), "noise": (10, 1)},
    "defocus:4": {"defocus": (4, 0.3)},
    "motion:9": {"motion": (9, 0.6)},
    "blur:2.5+jpeg:20": {"blur": (2.5, 0.6), "jpeg": (20, 0)},
    "noise:25+jpeg:20": {"noise": (25, 3), "jpeg": (20, 0)},
    "blur:3+lowres:2+noise:10+jpeg:20": {
        "blur": (3, 0.7),
        "lowres": (2, 0),
        "noise": (10, 3),
        "jpeg": (20, 0),
    },
}


@pytest.mark.parametrize("text", TRUTH)
def test_formation_is_found(text: str) -> None:
    """Neither a step too many nor one too few, and each value within its tolerance."""
    found = steps_of(diagnose_scene(degraded_scene(text)))
    assert found.keys() == TRUTH[text].keys()
    for kind, (value, tolerance) in TRUTH[text].items():
        assert found[kind] == pytest.approx(value, abs=tolerance + 1e-9), kind
