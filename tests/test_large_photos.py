"""Photos that are scaled down: decoded and undistorted at about the size that is wanted, few at a time."""

from __future__ import annotations

import subprocess
import sys
import threading
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from fixtures_scenes import Truth, make_truth, write_colmap
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.stages import Stage
from hqgs.photos.files import decode, shrunk
from hqgs.photos.resize import area_downscale
from hqgs.scene import load, views
from hqgs.scene.load import load_scene
from hqgs.scene.views import to_pinhole

WIDTH, HEIGHT = 1003, 669  # of no whole number of blocks
BENT = ("OPENCV", [900.0, 900, 500, 335, -0.1, 0.03, 0.004, -0.003])


def picture(width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """Waves of many lengths and an edge, [H, W, 3]."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    waves = [np.sin(x / 3 + y / 7), np.sin(y / 4 - x / 11), np.sin(np.hypot(x - 300, y - 200) / 9)]
    grey = 110 + 25 * np.stack(waves, -1) + 60 * (x[..., None] > y[..., None] + 100)
    return grey.clip(0, 255).astype(np.uint8)


def large(suffix: str, count: int = 3, model: tuple[str, list[float]] | None = None) -> Truth:
    truth = make_truth(count, suffix)
    truth = replace(truth, photos=[np.roll(picture(), 17 * k, 1) for k in range(count)])
    kind, params = model or ("PINHOLE", [900.0, 900, 500, 335])
    return replace(truth, width=WIDTH, height=HEIGHT, model=kind, params=params)


def psnr(a: NDArray[Any], b: NDArray[Any]) -> float:
    return float(10 * np.log10(255**2 / np.square(a.astype(np.float64) - b).mean()))


def test_a_jpeg_is_decoded_at_a_fraction_and_looks_the_same(tmp_path: Path) -> None:
    truth = large(".jpg")
    write_colmap(truth, tmp_path / "jpeg")
    path = tmp_path / "jpeg/images/view_00.jpg"
    half, _ = decode(path, (WIDTH // 2, HEIGHT // 2))
    assert half.shape == (335, 502, 3)
    assert (shrunk(WIDTH, 502), shrunk(HEIGHT, 335), shrunk(WIDTH, WIDTH)) == (2, 2, 1)
    whole = replace(
        truth,
        names=[f"view_{k:02d}.png" for k in range(3)],
        photos=[decode(tmp_path / "jpeg/images" / name)[0] for name in truth.names],
    )
    write_colmap(whole, tmp_path / "png")
    for downscale in (4.3, 11.0):
        found, wanted = (load_scene(tmp_path / kind, downscale=downscale) for kind in ("jpeg", "png"))
        for a, b in zip(found.train, wanted.train, strict=True):
            np.testing.assert_array_equal(a.camera.K, b.camera.K)
            assert psnr(a.image, b.image) > 45
    shifted = np.roll(found.train[0].image, 1, 1)  # the measure sees what a wrong size would do
    assert psnr(shifted, found.train[0].image) < 25


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_undistorted_at_twice_the_wanted_size(tmp_path: Path, suffix: str) -> None:
    truth = large(suffix, 2, BENT)
    write_colmap(truth, tmp_path)
    camera = pycolmap.Camera(model=BENT[0], params=BENT[1], width=WIDTH, height=HEIGHT)
    flat = to_pinhole(camera, WIDTH, HEIGHT)
    scene = load_scene(tmp_path, downscale=4.2, test_every=0)
    for view in scene.train:
        full = flat.picture(decode(tmp_path / "images" / view.name)[0])
        wanted, _ = area_downscale(full, None, view.camera.width, view.camera.height)
        assert psnr(view.image, wanted) > 45
        K = np.diag([view.camera.width / flat.width, view.camera.height / flat.height, 1]) @ flat.K
        np.testing.assert_allclose(view.camera.K, K, rtol=1e-12)


def test_the_mask_of_an_undistorted_photo_is_kept(tmp_path: Path) -> None:
    """Hidden colours do not enter, and the mask's border stays where it is."""
    truth = large(".jpg", 1, BENT)
    truth.photos[0][:, :400] = 255
    write_colmap(truth, tmp_path)
    (tmp_path / "masks").mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :400] = 0
    Image.fromarray(mask).save(tmp_path / "masks/view_00.png")
    camera = pycolmap.Camera(model=BENT[0], params=BENT[1], width=WIDTH, height=HEIGHT)
    flat = to_pinhole(camera, WIDTH, HEIGHT)
    (view,) = load_scene(tmp_path, downscale=4.2, test_every=0).train
    assert view.mask is not None
    full = flat.mask(mask > 0)
    wanted = area_downscale(
        flat.picture(decode(tmp_path / "images/view_00.jpg")[0]), full, view.camera.width, view.camera.height
    )
    assert wanted[1] is not None
    assert (view.mask == wanted[1]).mean() > 0.99
    both = view.mask & wanted[1]
    assert psnr(view.image[both], wanted[0][both]) > 40


@pytest.mark.parametrize(
    "model", [BENT, ("OPENCV_FISHEYE", [300.0, 300, 500, 335, 0.05, -0.01, 0.004, -0.001])]
)
def test_a_coarser_grid_takes_the_same_positions(model: tuple[str, list[float]]) -> None:
    camera = pycolmap.Camera(model=model[0], params=model[1], width=WIDTH, height=HEIGHT)
    flat = to_pinhole(camera, WIDTH, HEIGHT, 3.0)
    assert flat.grid is not None
    rows, columns = flat.grid.shape[1:3]
    assert (rows, columns) == (round(flat.height / 3), round(flat.width / 3))
    x, y = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    pixels = np.stack([x * flat.width, y * flat.height, np.ones_like(x)], -1)
    true = np.asarray(camera.img_from_cam((pixels @ np.linalg.inv(flat.K).T).reshape(-1, 3)))
    found = (flat.grid[0].numpy().reshape(-1, 2) + 1) / 2 * (WIDTH, HEIGHT)
    inside = ((true > 0) & (true < (WIDTH, HEIGHT))).all(1)
    assert np.abs(found - true)[inside].max() < 3 * 0.03  # px of the photo


def test_a_picture_that_ends_within_its_last_pixels() -> None:
    """The mean over each new pixel's area, with the last old column and row counted by their share."""
    image = picture(40, 31)
    small, _ = area_downscale(image, None, 7, 6, (39.5, 30.25))
    fine = image[:31, :40].repeat(4, 0).repeat(4, 1).astype(np.float64)[:121, :158]
    wanted = area_downscale(fine.astype(np.float32), None, 7, 6)[0]
    assert np.abs(small - wanted).max() <= 0.5 + 1e-4


def test_so_many_photos_are_made_smaller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(large(".jpg"), tmp_path)
    assert load_scene(tmp_path, longest=500).train[0].image.shape == (333, 500, 3)
    monkeypatch.setattr(load, "MOST_BYTES", 3e5)
    scene = load_scene(tmp_path, longest=500)
    kept = sum(view.image.nbytes for view in [*scene.train, *scene.test])
    assert 2.9e5 < kept < 3.1e5
    (note,) = [note for note in scene.notes if "are used at" in note]
    width, height = scene.train[0].camera.width, scene.train[0].camera.height
    assert note.startswith(f"3 photos of {WIDTH} x {HEIGHT} px are used at {width} x {height} px ")
    assert "so many photos" in note
    assert load_scene(tmp_path, downscale=1.0).train[0].image.shape == (
        HEIGHT,
        WIDTH,
        3,
    )  # asked for by its user


def test_few_photos_are_large_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is kept of a photo is its small picture alone, whatever the number of threads; all are told of."""
    write_colmap(large(".png", 12), tmp_path)
    lock, alive, most = threading.Lock(), set[int](), [0]
    real = views.decode

    def watched(path: Path, *rest: Any) -> Any:
        image, mask = real(path, *rest)
        with lock:
            alive.add(id(image))
            most[0] = max(most[0], len(alive))
        weakref.finalize(image, alive.discard, id(image))
        return image, mask

    monkeypatch.setattr(views, "decode", watched)
    stages: list[Stage] = []
    scene = load_scene(tmp_path, downscale=4.0, on_stage=stages.append)
    assert 1 <= most[0] <= views.MAX_WORKERS
    assert [stage.done for stage in stages if stage.what == "photos read"] == list(range(1, 13))
    for view in [*scene.train, *scene.test]:
        image: Any = view.image
        while image.base is not None:
            image = image.base
        assert image.nbytes == 3 * view.camera.width * view.camera.height
    monkeypatch.setattr(views, "MAX_WORKERS", 1)
    for a, b in zip(scene.train, load_scene(tmp_path, downscale=4.0).train, strict=True):
        np.testing.assert_array_equal(a.image, b.image)


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="the system does not tell the memory in use"
)
def test_what_was_made_on_the_way_is_given_back(tmp_path: Path) -> None:
    """In a process of its own: after loading, memory holds the photos and little else."""
    write_colmap(large(".png", 24, BENT), tmp_path)
    code = """
import sys
from pathlib import Path
from hqgs.scene.load import load_scene
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096
load_scene(sys.argv[1], downscale=4.0)
before = resident()
scene = load_scene(sys.argv[1], downscale=1.1)
print(resident() - before, sum(view.image.nbytes for view in [*scene.train, *scene.test]))
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True)
    more, photos = map(int, done.stdout.split())
    assert photos > 3e7
    assert more < photos + 6e7
