"""A flat card of a known sRGB colour keeps it within a level, whichever way it goes out and comes back."""

from __future__ import annotations

import base64
import gzip
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import hqgs
from hqgs.evaluation.held_out import RenderedView
from hqgs.evaluation.metrics import evaluate_view
from hqgs.evaluation.report import comparison_picture
from hqgs.model.constants import SH_C0
from hqgs.model.gaussians import Gaussians
from hqgs.scene.camera_files import load_cameras, save_cameras
from hqgs.scene.scene import Camera, Scene, View
from hqgs.show.frames import Activated
from hqgs.show.page.packing import pack_scene
from hqgs.show.page.page import pair

CARDS = [(200, 60, 40), (40, 180, 60), (13, 13, 13), (250, 250, 250)]
SIDE = 64
CAMERA = Camera(SIDE, SIDE, np.array([[60.0, 0, SIDE / 2], [0, 60, SIDE / 2], [0, 0, 1]]), np.eye(4))


def card(color: tuple[int, ...]) -> Gaussians:
    """A wall of opaque Gaussians that fills the picture."""
    x, y = np.meshgrid(np.linspace(-3, 3, 13), np.linspace(-3, 3, 13))
    layers = [np.stack([x, y, np.full_like(x, 3 + 0.1 * k)], -1).reshape(-1, 3) for k in range(3)]
    means = torch.tensor(np.concatenate(layers), dtype=torch.float32)
    n = len(means)
    sh0 = ((torch.tensor(color) / 255 - 0.5) / SH_C0).expand(n, 1, 3).clone().float()
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    return Gaussians(means, torch.full((n, 3), -0.5), quats, torch.full((n,), 9.0), sh0, torch.zeros(n, 3, 3))


def levels(picture: np.ndarray | Image.Image) -> np.ndarray:
    """The colour in the middle, as a mean over some pixels."""
    pixels = np.asarray(picture)
    middle = np.array(pixels.shape[:2]) // 2
    return pixels[middle[0] - 8 : middle[0] + 8, middle[1] - 8 : middle[1] + 8, :3].mean((0, 1))


def in_file(suffix: str) -> Callable[[Gaussians, Path], np.ndarray]:
    def way(g: Gaussians, folder: Path) -> np.ndarray:
        g.save(folder / f"a.{suffix}")
        return 255 * Gaussians.load(folder / f"a.{suffix}").render(CAMERA).clamp(0, 1).numpy()

    return way


def in_frames(suffix: str) -> Callable[[Gaussians, Path], np.ndarray]:
    def way(g: Gaussians, folder: Path) -> np.ndarray:
        out = folder / f"a.{suffix}"
        hqgs.render_frames(g, [CAMERA] * (1 if suffix == "png" else 3), out)
        if suffix != "mp4":
            return np.asarray(Image.open(out).convert("RGB"))
        with pytest.importorskip("av").open(str(out)) as film:
            frame = next(film.decode(video=0))
            tags = film.streams.video[0].codec_context
            assert (tags.colorspace, tags.color_primaries, tags.color_trc, tags.color_range) == (1, 1, 1, 1)
            luma, blue, red = (
                np.frombuffer(plane, np.uint8).reshape(plane.height, -1)[:, : plane.width].mean()
                for plane in frame.planes
            )
        y, cb, cr = (luma - 16) / 219, (blue - 128) / 224, (red - 128) / 224  # ITU-R BT.709, limited range
        r, b = y + 1.5748 * cr, y + 1.8556 * cb
        return np.tile(255 * np.array([r, (y - 0.2126 * r - 0.0722 * b) / 0.7152, b]), (SIDE, SIDE, 1))

    return way


def view_of(g: Gaussians) -> RenderedView:
    render = g.render(CAMERA).numpy()
    return RenderedView("a.png", np.rint(255 * render).clip(0, 255).astype(np.uint8), render)


def in_report(g: Gaussians, _: Path) -> np.ndarray:
    view = view_of(g)
    drawn = np.asarray(comparison_picture(view, evaluate_view(view.render, view.photo)))
    found = [levels(drawn[-SIDE:, k * drawn.shape[1] // 3 : (k + 1) * drawn.shape[1] // 3]) for k in (0, 1)]
    np.testing.assert_allclose(found[0], found[1], atol=1)
    return np.tile(found[1], (SIDE, SIDE, 1))


def in_page_pictures(g: Gaussians, _: Path) -> np.ndarray:
    shown = pair(view_of(g), None)["render"]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(shown.partition(",")[2]))))


def in_page_viewer(g: Gaussians, _: Path) -> np.ndarray:
    """Bytes of the colours, as the page's script reads them: after means, scales, quats and opacities."""
    head, packed = pack_scene(g)
    n, (low, high) = head["count"], head["colors"]
    data = np.frombuffer(gzip.decompress(base64.b64decode(packed)), np.uint8)
    start = 6 * n + 3 * n + 4 * n + n
    colors = low + data[start : start + 3 * n].reshape(3, n).T / 255 * (high - low)
    return np.tile(255 * colors.mean(0), (SIDE, SIDE, 1))


def in_kept_photos(g: Gaussians, folder: Path) -> np.ndarray:
    view = View("a.png", CAMERA, view_of(g).photo)
    empty = np.zeros((0, 3), np.float32)
    save_cameras(folder, Scene("a", [view], [], empty, np.zeros((0, 3), np.uint8), "test"))
    photo = load_cameras(folder).views[0].photo
    assert photo is not None
    return np.asarray(Image.open(photo))


WAYS = {
    "render": lambda g, _: 255 * g.render(CAMERA).clamp(0, 1).numpy(),
    "viewer": lambda g, _: Activated(g).color(CAMERA),
    "report": in_report,
    "page": in_page_pictures,
    "page viewer": in_page_viewer,
    "kept photos": in_kept_photos,
    **{name: in_file(name) for name in ("ply", "full.ply", "compressed.ply", "spz", "glb", "sog", "splat")},
    **{name: in_frames(name) for name in ("mp4", "gif", "png")},
}


@pytest.mark.parametrize("color", CARDS)
@pytest.mark.parametrize("way", WAYS)
def test_a_card_keeps_its_colour(tmp_path: Path, way: str, color: tuple[int, ...]) -> None:
    np.testing.assert_allclose(levels(WAYS[way](card(color), tmp_path)), color, atol=1.01)
