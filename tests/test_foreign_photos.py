"""Photos and masks that are not what they seem: suffixes, lossy masks, orientations, pictures of runs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures_photos import exif, looked_at
from fixtures_scenes import make_truth, write_colmap
from PIL import Image, ImageDraw

from hqgs.photos.exif import read_exif
from hqgs.photos.files import decode, decode_mask, glance
from hqgs.scene.load import load_scene

RED = Image.fromarray(np.full((64, 96, 3), (200, 60, 90), np.uint8))


def test_a_jpeg_called_heic_is_a_jpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the extra too, which it does not need."""
    for k in range(3):
        RED.resize((96, 64 + 8 * k)).save(tmp_path / f"{k}.HEIC", "jpeg")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    assert looked_at(tmp_path).names == ["0.HEIC", "1.HEIC", "2.HEIC"]
    assert np.abs(decode(tmp_path / "0.HEIC")[0].mean((0, 1)) - (200, 60, 90)).max() < 4


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".JPEG"])
def test_a_heic_of_another_suffix_is_read_in_a_new_process(tmp_path: Path, suffix: str) -> None:
    """Where nothing has opened a .heic before."""
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    path = tmp_path / f"a{suffix}"
    RED.save(path, "heif")
    code = f"from hqgs.photos.files import *; print(glance(Path({str(path)!r})).size)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "(96, 64)"
    assert glance(path).format == "HEIF"


def test_colmap_is_given_what_it_reads(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    RED.save(tmp_path / "a.jpg", "heif")
    RED.save(tmp_path / "b.jpg", "webp")
    RED.save(tmp_path / "c.jpg", "png")
    RED.save(tmp_path / "d.HEIC", "jpeg")
    photos = looked_at(tmp_path)
    names = ["a.jpg", "b.jpg", "c.jpg", "d.HEIC.jpg"]
    assert list(photos.colmap_names) == names
    (tmp_path / "out").mkdir()
    photos.write(tmp_path / "out")
    assert [glance(tmp_path / "out" / name).format for name in names] == ["JPEG", "JPEG", "PNG", "JPEG"]


def disc(width: int = 96, height: int = 72) -> Image.Image:
    picture = Image.new("L", (width, height))
    ImageDraw.Draw(picture).ellipse((30, 20, 60, 50), fill=255)
    return picture


@pytest.mark.parametrize(
    ("suffix", "options"),
    [(".jpg", {"quality": 40}), (".png", {}), (".webp", {"quality": 40}), (".webp", {"lossless": True})],
)
def test_masks_show_their_true_share(tmp_path: Path, suffix: str, options: dict[str, Any]) -> None:
    """A lossy file blurs the edge into its blocks: half of white counts there."""
    true = np.asarray(disc()) > 0
    path = tmp_path / f"mask{suffix}"
    disc().convert("RGB" if suffix == ".webp" else "L").save(path, **options)
    read = decode_mask(path, 96, 72)
    lossless = suffix == ".png" or "lossless" in options
    assert (read != true).mean() <= (0 if lossless else 0.01)


def test_a_jpeg_mask_is_known_by_its_content(tmp_path: Path) -> None:
    disc().save(tmp_path / "mask.png", "jpeg", quality=40)
    assert (decode_mask(tmp_path / "mask.png", 96, 72) != (np.asarray(disc()) > 0)).mean() < 0.01


def test_masks_of_zero_and_one_labels_and_alpha(tmp_path: Path) -> None:
    true = np.asarray(disc()) > 0
    for name, values in (("ones", true.astype(np.uint8)), ("labels", true * np.uint8(3))):
        Image.fromarray(values).save(tmp_path / f"{name}.png")
        np.testing.assert_array_equal(decode_mask(tmp_path / f"{name}.png", 96, 72), true)
    rgba = np.dstack([np.full((72, 96, 3), 255, np.uint8), true * np.uint8(255)])
    Image.fromarray(rgba).save(tmp_path / "alpha.png")
    np.testing.assert_array_equal(decode_mask(tmp_path / "alpha.png", 96, 72), true)


@pytest.mark.parametrize(("orientation", "turn"), [(0, 0), (1, 0), (6, 1), (8, 3), (9, 0), (255, 0)])
def test_orientations_that_there_are_none_of(tmp_path: Path, orientation: int, turn: int) -> None:
    RED.save(tmp_path / "a.jpg", exif=exif(orientation))
    assert read_exif(tmp_path / "a.jpg").quarter_turns == turn
    assert glance(tmp_path / "a.jpg").size == (96, 64)


def test_the_pictures_of_a_run_are_no_photos(tmp_path: Path) -> None:
    """Of a finished one, of one that has just begun, and of what COLMAP keeps in it."""
    for k in range(3):
        (tmp_path / "photos").mkdir(exist_ok=True)
        RED.resize((96, 64 + 8 * k)).save(tmp_path / f"photos/{k}.jpg")
    for run, files in {"run": ("config.json", "scene.ply"), "begun": (".lock",)}.items():
        (tmp_path / run / "comparison").mkdir(parents=True)
        for name in files:
            (tmp_path / run / name).write_text("{}")
        RED.save(tmp_path / run / "comparison/a.png")
    assert looked_at(tmp_path).names == ["0.jpg", "1.jpg", "2.jpg"]
    with pytest.raises(ValueError, match="run that hqgs wrote"):
        load_scene(tmp_path / "run")


def test_colmap_bears_orientations_that_there_are_none_of(tmp_path: Path) -> None:
    """In a process of its own: some versions abort."""
    for k, orientation in enumerate((0, 9, 6)):
        RED.save(tmp_path / f"{k}.jpg", exif=exif(orientation))
    code = (
        "import pycolmap; from pathlib import Path; root = Path(" + repr(str(tmp_path)) + ");"
        "pycolmap.extract_features(root / 'a.db', root);"
        "print(sum(1 for _ in pycolmap.Database.open(root / 'a.db').read_all_images()))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.split()[-1] == "3"


def test_alpha_of_some_photos_stays_a_mask(tmp_path: Path) -> None:
    """A set is of cut-out objects where all its photos can be transparent, and none has a mask."""
    truth = make_truth(4)
    write_colmap(truth, tmp_path)
    alpha = np.full((36, 48), 255, np.uint8)
    alpha[:, :24] = 0
    rgba = np.dstack([truth.photos[1], alpha])
    Image.fromarray(rgba).save(tmp_path / "images/view_01.png")
    view = load_scene(tmp_path, test_every=0).train[1]
    assert view.mask is not None
    assert view.mask.mean() == 0.5
    for k in (0, 2, 3):
        Image.fromarray(np.dstack([truth.photos[k], alpha])).save(tmp_path / f"images/view_{k:02d}.png")
    scene = load_scene(tmp_path, test_every=0)
    assert all(view.mask is None and not view.image[:, :24].any() for view in scene.train)
    np.testing.assert_array_equal(scene.train[2].image[:, 24:], truth.photos[2][:, 24:])
