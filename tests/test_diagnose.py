"""Diagnosis of degraded photos whose degradation is known: painted pictures of discs ("dead leaves").

Discs of radius distribution r^-3 that cover each other have the edges and the 1/f^2 power spectrum of photos
(Lee, Mumford & Huang 2001). Tolerances are those that the estimators keep on real photos.
"""

from __future__ import annotations

import io
import json
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fixtures_scenes import degrade_image
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, uniform_filter1d
from tiny_scene import tiny_config

import hqgs.diagnosis.scene as module
from hqgs.diagnosis import Diagnosis, PhotoDiagnosis, diagnose_scene
from hqgs.diagnosis.photo import conclude, inspect_photo
from hqgs.diagnosis.scene import Inspector
from hqgs.photos.formula import parse_degradation, parse_formation
from hqgs.photos.jpeg import encode_jpeg
from hqgs.photos.pixels import as_floats
from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.config import TrainConfig
from hqgs.training.methods.formed import find_formation
from hqgs.training.plan import left_out_of
from hqgs.training.prepare import Prepared

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


def diagnose_photo(image: np.ndarray, low: np.ndarray | None = None) -> PhotoDiagnosis:
    return conclude([inspect_photo("photo", image, low)])[0]


def degraded_scene(text: str, photos: int = PHOTOS, keep_low: bool = True) -> Scene:
    """Training views degraded by `text`, each with its own noise and direction of motion."""
    views = []
    for seed in range(photos):
        out = degrade_image(clean_photo(seed), parse_degradation(text), np.random.default_rng(seed))
        camera = Camera(WIDTH, HEIGHT, np.eye(3), np.eye(4))
        views.append(View(f"{seed}.png", camera, out.image, low=out.low if keep_low else None))
    return Scene("leaves", views, [], np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), "test")


def half_noisy_scene() -> Scene:
    """Noise of 25 levels in every second photo of six."""
    clean, noisy = degraded_scene("none", 6), degraded_scene("noise:25", 6)
    return replace(clean, train=[(noisy if k % 2 else clean).train[k] for k in range(6)])


def steps_of(diagnosis: Diagnosis) -> dict[str, float]:
    """The formation as {kind: value}; NaN for what each photo has its own of."""
    steps = parse_formation(diagnosis.formation).steps
    return {step.kind: np.nan if step.value is None else step.value for step in steps}


TRUTH: dict[str, dict[str, tuple[float, float]]] = {  # what is found: kind, value and tolerance
    "none": {},
    "noise:10": {"noise": (10, 1)},
    "noise:50": {"noise": (50, 3)},
    "jpeg:10": {"jpeg": (10, 0)},
    "jpeg:50": {},  # good enough alone
    "lowres:2": {"lowres": (2, 0)},
    "lowres:4": {"lowres": (4, 0)},
    "blur:1.2": {"blur": (1.2, 0.3)},
    "blur:2.5": {"blur": (2.5, 0.3)},
    "blur:4": {"blur": (4, 0.4)},
    "blur:2.5+noise:10": {"blur": (2.5, 0.3), "noise": (10, 1)},
    "defocus:4": {"defocus": (4, 0.3)},
    "motion:9": {"motion": (9, 0.6)},
    "blur:2.5+jpeg:20": {"blur": (2.5, 0.6), "jpeg": (20, 0)},
    "noise:3+jpeg:10": {"jpeg": (10, 0)},  # too weak to come through
    "blur:3+lowres:2+jpeg:20": {"blur": (3, 0.8), "lowres": (2, 0), "jpeg": (20, 0)},
    "blur:3+lowres:2+jpeg:50": {"blur": (3, 0.8), "lowres": (2, 0), "jpeg": (50, 0)},  # not with other faults
}


@pytest.mark.parametrize("text", TRUTH)
def test_formation_is_found(text: str) -> None:
    """Neither a step too many nor one too few, and each value within its tolerance."""
    found = steps_of(diagnose_scene(degraded_scene(text)))
    assert found.keys() == TRUTH[text].keys()
    for kind, (value, tolerance) in TRUTH[text].items():
        assert found[kind] == pytest.approx(value, abs=tolerance + 1e-9), kind


def test_noise_of_some_photos_is_each_photos_own() -> None:
    assert steps_of(diagnose_scene(half_noisy_scene())).keys() == {"grain"}


def test_strong_noise_shows_through_jpeg() -> None:
    """Quality 20 cuts off most of it, so that pixels alone would say 0."""
    photos = diagnose_scene(degraded_scene("noise:25+jpeg:20")).photos
    assert all(photo.noise == pytest.approx(25, abs=4) for photo in photos)


@pytest.mark.parametrize("factor", [2, 4])
def test_enlargement_shows_without_the_small_photo(factor: int) -> None:
    """Also when the photo was kept in 8 bits; and the small photo's JPEG is then found in the pixels."""
    scene = degraded_scene(f"lowres:{factor}+jpeg:30", photos=1, keep_low=False)
    image = scene.train[0].image
    found = diagnose_photo(image)
    rounded = diagnose_photo(np.rint(image * 255).clip(0, 255).astype(np.uint8))
    assert found.enlargement.factor == rounded.enlargement.factor == factor
    assert (found.enlargement.height, found.enlargement.width) == (HEIGHT // factor, WIDTH // factor)
    assert found.jpeg.quality == 30


@pytest.mark.parametrize("text", ["blur:4", "noise:25", "jpeg:5", "motion:9", "blur:3+jpeg:10"])
def test_smooth_or_blocky_is_not_enlarged(text: str) -> None:
    assert diagnose_photo(degraded_scene(text, photos=1).train[0].image).enlargement.factor == 1


@pytest.mark.parametrize("quality", [5, 9, 10, 11, 20, 35, 75, 90])
def test_jpeg_quality_and_table(quality: int, tmp_path: Path) -> None:
    """Exact from the decoded pixels alone; the truth is the table in the file."""
    path = tmp_path / "photo.jpg"
    path.write_bytes(encode_jpeg((clean_photo(0) / 255).astype(np.float32), quality))
    with Image.open(path) as photo:
        pixels = np.asarray(photo)
        table = np.array(photo.quantization[0]).reshape(8, 8)  # type: ignore[attr-defined]
    found = diagnose_photo(pixels)
    assert found.jpeg.quality == quality
    assert found.jpeg.phase == (0, 0)
    np.testing.assert_array_equal(found.jpeg.table, table)


def test_jpeg_table_that_libjpeg_does_not_make(tmp_path: Path) -> None:
    """Its low steps show in the pixels."""
    path = tmp_path / "photo.jpg"
    table = np.add.outer(np.arange(8), np.arange(8)) * 3 + 17
    qtables = [table.ravel().tolist(), table.ravel().tolist()]
    Image.fromarray(clean_photo(1)).save(path, qtables=qtables, subsampling="4:2:0")
    with Image.open(path) as photo:
        pixels = np.asarray(photo)
    found = diagnose_photo(pixels).jpeg.table
    assert found is not None
    np.testing.assert_array_equal(np.array(found)[:3, 1:3], table[:3, 1:3])


def test_cropped_jpeg_is_seen_and_left_out() -> None:
    """The blocks no longer begin at the corner, so the step "jpeg" would not describe the photo."""
    whole = degraded_scene("jpeg:20", photos=1)
    view = whole.train[0]
    cut = View(view.name, Camera(WIDTH - 3, HEIGHT - 5, np.eye(3), np.eye(4)), view.image[5:, 3:])
    found = diagnose_scene(Scene("cut", [cut], [], whole.points, whole.point_colors, "test"))
    assert (found.photos[0].jpeg.quality, found.photos[0].jpeg.phase) == (20, (3, 5))
    assert "jpeg" not in steps_of(found)


def test_noise_survives_clipping_to_8_bits() -> None:
    noisy = degraded_scene("noise:25", photos=1).train[0].image
    clipped = np.rint(noisy * 255).clip(0, 255).astype(np.uint8)
    assert diagnose_photo(clipped).noise == pytest.approx(25, rel=0.1)


@pytest.mark.parametrize(("text", "value"), [("none", 0), ("noise:10", 10)])
def test_noise_survives_a_good_jpeg(text: str, value: float) -> None:
    """Half of the colours' resolution is gone, so that only the luma shows it."""
    noisy = degraded_scene(text, photos=1).train[0].image
    with Image.open(io.BytesIO(encode_jpeg(np.asarray(noisy, np.float32), 95))) as photo:
        found = diagnose_photo(np.asarray(photo))
    assert found.noise == pytest.approx(value, abs=2)


def test_direction_of_motion() -> None:
    """From x towards y, which points down: the photo is smeared along rows at 0 degrees."""
    smeared = np.asarray(uniform_filter1d(clean_photo(0) / 255, 9, axis=1), np.float32)
    blur = diagnose_photo(smeared).blur
    assert blur is not None
    assert blur.kind == "motion"
    assert min(blur.direction or 0, 180 - (blur.direction or 0)) < 8
    turned = diagnose_photo(np.ascontiguousarray(smeared.swapaxes(0, 1))).blur
    assert turned is not None
    assert turned.direction == pytest.approx(90, abs=8)


def test_a_few_blurred_photos_do_not_make_a_blurred_scene() -> None:
    sharp, soft = degraded_scene("none"), degraded_scene("blur:3", photos=1)
    views = [*sharp.train, View("soft", soft.train[0].camera, soft.train[0].image)]
    found = diagnose_scene(Scene("mostly", views, [], sharp.points, sharp.point_colors, "test"))
    assert found.formation == "none"
    assert "1 of 4 photos are blurred" in dict((name, why) for name, _, why in found.needs())["blur"]


@pytest.mark.parametrize("size", [(1, 1), (7, 20), (20, 16), (40, 36), (33, 300)])
def test_small_or_empty_photos_say_none(size: tuple[int, int]) -> None:
    """No estimate is better than a wrong one; nothing divides by zero."""
    views = [
        View(str(value), Camera(size[1], size[0], np.eye(3), np.eye(4)), np.full((*size, 3), value, np.uint8))
        for value in (0, 128, 255)
    ]
    points = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8)
    with np.errstate(all="raise", under="ignore"):
        assert diagnose_scene(Scene("flat", views, [], *points, "test")).formation == "none"


def test_report_is_json_and_names_every_part() -> None:
    """Also the reasons of what was left out; and the same photos give the same numbers."""
    scene = degraded_scene("lowres:2")
    found = diagnose_scene(scene)
    assert json.loads(json.dumps(asdict(found), allow_nan=False))["formation"] == found.formation
    assert [(name, needed) for name, needed, _ in found.needs()] == [
        ("exposure", False),
        ("vignetting", False),
        ("response", False),
        ("shake", False),
        ("focus", False),
        ("blur", False),
        ("lowres", True),
        ("noise", False),
        ("jpeg", False),
        ("video", False),
    ]
    text = str(found)
    assert all(view.name in text for view in scene.train)
    assert all(reason in text for _, _, reason in found.needs())
    assert diagnose_scene(scene) == found


def test_photos_are_spread_over_the_scene() -> None:
    scene = degraded_scene("none", photos=5)
    assert [photo.name for photo in diagnose_scene(scene, max_photos=3).photos] == ["0.png", "2.png", "4.png"]


def inspected(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Gets the name of each photo that is inspected from now on."""
    seen: list[str] = []
    real = module.inspect_photo

    def spy(name: str, *arguments: Any, **options: Any) -> Any:
        seen.append(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(module, "inspect_photo", spy)
    return seen


def test_a_run_looks_at_each_photo_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The choice of photos, the formation and the motion's directions share what was seen."""
    seen = inspected(monkeypatch)
    scene = degraded_scene("motion:9", photos=4)
    inspector = Inspector()
    find_formation(scene, "auto", inspector)
    assert sorted(seen) == [view.name for view in scene.train]
    again = find_formation(scene, "motion:9", inspector)
    assert inspector.inspect(scene.train[2]).diagnosis.name == "2.png"
    assert len(seen) == 4
    twin = replace(scene.train[2])  # another photo that is equal
    assert inspector.inspect(twin) is not inspector.inspect(scene.train[2])
    assert len(seen) == 5
    alone = find_formation(scene, "motion:9", Inspector())
    targets = [formation.target(scene.train[0]).operator for formation in (again, alone)]
    image = torch.rand(208, 272, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(*(operator(image) for operator in targets if operator is not None))


def test_an_inspected_photo_is_held_in_few_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hqgs.diagnosis.photo.LARGEST", 128)
    photo, middle = clean_photo(0), np.s_[40:168, 72:200]
    found = inspect_photo("photo", photo)
    assert (found.kept.dtype, found.kept.nbytes, found.kept.base) == (np.uint8, 3 * 128**2, None)
    assert np.array_equal(found.levels, photo[middle])
    brighter = as_floats(photo) * np.float32(1.2)  # white goes beyond 255 levels
    found = inspect_photo("photo", brighter)
    assert found.kept.base is None  # which would be the whole photo
    assert np.array_equal(found.levels, brighter[middle].astype(np.float64) * 255)


def test_bad_input_is_named() -> None:
    photo = clean_photo(0)
    with pytest.raises(ValueError, match=r"\[H, W, 3\] uint8 or float32, got \(208, 272\)"):
        diagnose_photo(photo[..., 0])
    with pytest.raises(ValueError, match="NaN"):
        diagnose_photo(np.full((64, 64, 3), np.nan, np.float32))
    with pytest.raises(ValueError, match="272 x 208 px, larger than its photo, 136 x 104 px"):
        diagnose_photo(photo[::2, ::2], low=photo)
    with pytest.raises(ValueError, match="max_photos is 0"):
        diagnose_scene(degraded_scene("none", photos=1), max_photos=0)


def blurred_noise(sigma: float, level: float) -> Scene:
    """Noise of this level whose neighbours go together, by a Gaussian of `sigma` px."""
    clean, rng = degraded_scene("none"), np.random.default_rng(3)
    views = []
    for view in clean.train:
        noise = gaussian_filter(rng.standard_normal(view.image.shape), (sigma, sigma, 0))
        noise *= level / 255 / noise.std()
        views.append(replace(view, image=as_floats(view.image) + noise.astype(np.float32)))
    return replace(clean, train=views)


def test_noise_whose_neighbours_go_together_is_not_white() -> None:
    """Then no pixels tell when the noise is learned. A Gaussian of 0.6 px is 1 to 0.25 to 0.004 in pixels."""
    white, soft = degraded_scene("noise:25"), blurred_noise(0.6, 40)
    config = tiny_config(method="hqgs", hqgs=TrainConfig().hqgs)
    runs = [Prepared(scene, config) for scene in (white, soft)]
    found = runs[1].diagnosis
    assert found is not None
    assert found.together == pytest.approx(2 * 0.249 / (1 + 2 * 0.249**2), abs=0.08)
    assert all(run.method.noise for run in runs)
    what = "validation pixels, which warn when noise is learned"
    assert [what in {item.what for item in left_out_of(run.plan().rows)} for run in runs] == [False, True]
    assert "correlated between neighbouring pixels" in str(found)
    for run, told in zip(runs, (True, False), strict=True):
        assert (run.method.prepare(run.scene.train[0]).held is not None) == told


def test_photos_that_were_not_looked_at_are_told() -> None:
    """On the screen of `diagnose`."""
    scene, inspector = degraded_scene("none", photos=5), Inspector()
    found = inspector.diagnose(scene, max_photos=3)
    (spared,) = found.passed_over
    assert spared.what == "diagnosis of 2 of 5 photos"
    assert f"left out: {spared.what}: the 3 measured photos are spread over the scene" in str(found)
    assert not inspector.diagnose(scene).passed_over


def test_what_is_diagnosed_can_be_trained_with() -> None:
    """Photos that were enlarged and blurred by more than a formation may say; small ones in any ratio."""
    scene = degraded_scene("lowres:8+defocus:8", keep_low=False)
    photos = Inspector().diagnose(scene).photos
    assert photos[0].blur is not None
    wide = [replace(photo, blur=replace(photos[0].blur, kind="gaussian", sigma=124.5)) for photo in photos]
    step = module._blur(wide).step
    assert step == "blur:50"
    parse_formation(step)
    for factor in (12, 16):
        width, height = 200, 130  # a 16th of it, rounded up, is nearer to a 14th
        views = []
        for seed in range(PHOTOS):
            clean = np.ascontiguousarray(clean_photo(seed)[:height, :width])
            out = degrade_image(clean, parse_degradation(f"lowres:{factor}"), np.random.default_rng(seed))
            camera = Camera(width, height, np.eye(3), np.eye(4))
            views.append(View(f"{seed}.png", camera, out.image, low=out.low))
        formation = find_formation(replace(scene, train=views), "auto", Inspector())
        for view in views:
            formation.target(view)
