"""Restoration networks: what they see, where their output goes, tiles, and files that must be refused."""

from __future__ import annotations

import copy
import hashlib
import importlib.util
import io
import os
import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from tiny_scene import tiny_scene
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

import hqgs
import hqgs.scene.restore
from hqgs.photos.resize import resize
from hqgs.scene.restore import restore_scene
from hqgs.scene.scene import Camera, Scene, View

pytest.importorskip("spandrel")  # an optional package
import spandrel
from spandrel.architectures.Compact import Compact
from spandrel.architectures.DnCNN import DnCNN

WHOLE = 10_000  # px of a tile


def weights_of(model: torch.nn.Module, seed: int | None = None) -> dict[str, Tensor]:
    """All zero, or drawn from `seed`."""
    generator = torch.Generator().manual_seed(seed or 0)

    def drawn(tensor: Tensor) -> Tensor:
        size = 0.0 if seed is None else 0.5 / max(tensor[0].numel(), 1) ** 0.5
        return size * torch.randn(tensor.shape, generator=generator)

    return {name: drawn(tensor) for name, tensor in model.state_dict().items()}


def compact(scale: int = 1, channels: int = 3, seed: int | None = None) -> dict[str, Tensor]:
    """Sees 4 px around a pixel. Zero weights: the photo, every pixel repeated scale x scale times."""
    model = Compact(num_in_ch=channels, num_out_ch=channels, num_feat=8, num_conv=2, upscale=scale)
    return weights_of(model, seed)


def saved(folder: Path, state: dict[str, Any], name: str = "net.safetensors") -> Path:
    path = folder / name
    if path.suffix == ".safetensors":
        save_file(state, path)
    else:
        torch.save(state, path)
    return path


def scene_of(image: NDArray[Any], **fields: Any) -> Scene:
    scene = tiny_scene()
    view = scene.train[0]
    camera = Camera(image.shape[1], image.shape[0], view.camera.K, view.camera.viewmat)
    return replace(scene, train=[View("photo.png", camera, image, **fields)])


def photo(height: int, width: int, seed: int = 0) -> NDArray[np.float32]:
    return np.random.default_rng(seed).random((height, width, 3), dtype=np.float32)


def test_identity_weights_return_the_photos(tmp_path: Path) -> None:
    scene = tiny_scene()
    path = saved(tmp_path, compact())
    restored = restore_scene(scene, path)
    for before, after in zip(scene.train, restored.train, strict=True):
        assert after.name == before.name
        assert after.camera is before.camera
        assert after.image.dtype == np.uint8
        assert after.image is not before.image
        np.testing.assert_array_equal(after.image, before.image)
    image = photo(16, 24)
    mask = image[..., 0] > 0.5
    (view,) = restore_scene(scene_of(image * 1.4 - 0.2, mask=mask), path).train
    assert view.image.dtype == np.float32
    np.testing.assert_array_equal(view.image, (image * 1.4 - 0.2).clip(0, 1))
    assert view.mask is mask


@pytest.mark.parametrize("name", ["net.safetensors", "net.pth", "NET.PT", "net.ckpt"])
def test_the_training_photos_alone_go_through_the_network(tmp_path: Path, name: str) -> None:
    scene = tiny_scene()
    state = compact()
    state["body.6.bias"] = torch.tensor([0.1, 0.2, -0.1])  # an image that can be computed by hand
    path = saved(tmp_path, state if name == "net.safetensors" else {"params_ema": state}, name)
    restored = restore_scene(scene, path)
    for before, after in zip(scene.train, restored.train, strict=True):
        expected = (before.image / 255 + [0.1, 0.2, -0.1]).clip(0, 1)
        assert np.abs(after.image / 255 - expected).max() < 0.51 / 255
    assert all(a is b for a, b in zip(restored.test, scene.test, strict=True))
    (note,) = restored.notes
    assert "RealESRGAN Compact (scale 1)" in note
    assert f"from {name}, SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()[:12]}, in " in note
    assert scene.notes == []


def test_random_weights_against_the_model_itself(tmp_path: Path) -> None:
    image = photo(20, 30)
    state = compact(seed=1)
    model = Compact(num_feat=8, num_conv=2, upscale=1)
    model.load_state_dict(state)
    with torch.no_grad():
        expected = model(torch.from_numpy(image).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy()
    (view,) = restore_scene(scene_of(image), saved(tmp_path, state)).train
    np.testing.assert_allclose(view.image, expected.clip(0, 1), rtol=0, atol=1e-6)
    assert np.abs(expected - image).max() > 0.05
    half = {name: tensor.half() for name, tensor in state.items()}
    (coarse,) = restore_scene(scene_of(image), saved(tmp_path, half, "half.pth")).train
    np.testing.assert_allclose(coarse.image, view.image, rtol=0, atol=5e-3)


def test_a_low_resolution_photo_goes_in_and_its_enlargement_out(tmp_path: Path) -> None:
    low = photo(8, 12)
    (view,) = restore_scene(scene_of(photo(16, 24, 1), low=low), saved(tmp_path, compact(2))).train
    np.testing.assert_array_equal(view.image, low.repeat(2, 0).repeat(2, 1))
    assert view.low is low


@pytest.mark.parametrize(("scale", "height", "width"), [(2, 4, 6), (4, 8, 12), (1, 8, 12), (2, 8, 11)])
def test_any_other_size_is_resized_to_the_camera(tmp_path: Path, scale: int, height: int, width: int) -> None:
    low = photo(height, width)
    path = saved(tmp_path, compact(scale))
    (view,) = restore_scene(scene_of(photo(16, 24, 1), low=low), path).train
    out = low.repeat(scale, 0).repeat(scale, 1)
    np.testing.assert_array_equal(view.image, resize(out, 16, 24).clip(0, 1))


def test_super_resolution_without_a_low_photo_comes_back_in_size(tmp_path: Path) -> None:
    scene = tiny_scene()
    restored = restore_scene(scene, saved(tmp_path, compact(2)))
    for before, after in zip(scene.train, restored.train, strict=True):
        out = np.divide(before.image, 255, dtype=np.float32).repeat(2, 0).repeat(2, 1)
        expected = resize(out, *before.image.shape[:2]).clip(0, 1)
        assert after.low is None
        np.testing.assert_array_equal(after.image, np.rint(expected * 255).astype(np.uint8))


def test_a_grey_network_sees_each_channel(tmp_path: Path) -> None:
    model = DnCNN(in_nc=1, out_nc=1, nc=4, nb=9, act_mode="R")
    image = photo(12, 15)
    (same,) = restore_scene(scene_of(image), saved(tmp_path, weights_of(model))).train
    np.testing.assert_array_equal(same.image, image)
    state = weights_of(model, seed=2)
    state["model.0.bias"] += 0.5  # so that not all of its activations are 0
    model.load_state_dict(state)
    with torch.no_grad():
        expected = model(torch.from_numpy(image).permute(2, 0, 1)[:, None])[:, 0].permute(1, 2, 0).numpy()
    assert np.abs(expected - image).max() > 1e-3
    (view,) = restore_scene(scene_of(image), saved(tmp_path, state)).train
    np.testing.assert_allclose(view.image, expected.clip(0, 1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("scale", [1, 3])
def test_tiles_leave_no_seam(tmp_path: Path, scale: int) -> None:
    scene = scene_of(photo(61 * scale, 90 * scale, 1), low=photo(61, 90))
    path = saved(tmp_path, compact(scale, seed=3))
    (whole,) = restore_scene(scene, path, WHOLE).train
    (tiles,) = restore_scene(scene, path, 16, 4).train
    np.testing.assert_allclose(tiles.image, whole.image, rtol=0, atol=1e-6)
    (narrow,) = restore_scene(scene, path, 16, 0).train
    assert np.abs(narrow.image - whole.image).max() > 1e-3  # the network does look beyond a tile


class Blocks(torch.nn.Module):
    """The mean of each block of 8 x 8 px, so that it matters where a tile starts."""

    def __init__(self) -> None:
        super().__init__()
        self.blocks = torch.nn.Parameter(torch.zeros(1))
        self.sizes: list[tuple[int, ...]] = []

    def forward(self, x: Tensor) -> Tensor:
        self.sizes.append(tuple(x.shape[2:]))
        return interpolate(avg_pool2d(x, 8), scale_factor=8.0)


def know_blocks(monkeypatch: pytest.MonkeyPatch, **changes: Any) -> Blocks:
    """Make spandrel know `Blocks` and nothing else, described with `changes`."""
    model = Blocks()
    settings: dict[str, Any] = {
        "purpose": "Restoration",
        "tags": [],
        "supports_half": False,
        "supports_bfloat16": False,
        "scale": 1,
        "input_channels": 3,
        "output_channels": 3,
        "size_requirements": spandrel.SizeRequirements(multiple_of=8),
    }

    class Architecture(spandrel.Architecture[Blocks]):
        def load(self, state_dict: dict[str, Any]) -> spandrel.ImageModelDescriptor[Blocks]:
            return spandrel.ImageModelDescriptor(model, state_dict, self, **(settings | changes))

    known = Architecture(id="Blocks", detect=lambda state: "blocks" in state)
    registry = spandrel.ArchRegistry()
    registry.add(spandrel.ArchSupport.from_architecture(known))
    monkeypatch.setattr(spandrel, "ModelLoader", partial(spandrel.ModelLoader, registry=registry))
    monkeypatch.setattr(copy, "deepcopy", lambda network: network)  # so that `sizes` is seen
    return model


BLOCKS = {"blocks": torch.zeros(1)}


def test_tiles_start_where_the_network_wants_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = know_blocks(monkeypatch)
    image = photo(40, 112) * 1.6 - 0.3  # clipped before the network sees it
    scene = scene_of(image)
    (view,) = restore_scene(scene, saved(tmp_path, BLOCKS), 21, 3).train
    assert len(model.sizes) == 2 * 5  # 40 = 24 + 16, 112 = 4 x 24 + 16
    expected = image.clip(0, 1).reshape(5, 8, 14, 8, 3).mean((1, 3)).repeat(8, 0).repeat(8, 1)
    np.testing.assert_allclose(view.image, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("tiling", "tiles"),
    [
        (spandrel.ModelTiling.SUPPORTED, 2 * 5),
        (spandrel.ModelTiling.DISCOURAGED, 1 * 2),
        (spandrel.ModelTiling.INTERNAL, 1),
    ],
)
def test_what_a_network_says_of_tiles_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiling: spandrel.ModelTiling, tiles: int
) -> None:
    model = know_blocks(monkeypatch, tiling=tiling)
    restore_scene(scene_of(photo(40, 112)), saved(tmp_path, BLOCKS), 21, 3)
    assert len(model.sizes) == tiles


def test_networks_of_another_kind_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path, BLOCKS)
    know_blocks(monkeypatch, purpose="FaceSR")
    with pytest.raises(ValueError, match=r"net\.safetensors: Blocks \(FaceSR\) invents detail"):
        restore_scene(tiny_scene(), path)
    monkeypatch.setattr(hqgs.scene.restore, "RANDOM", ("Blocks",))
    know_blocks(monkeypatch)
    with pytest.raises(ValueError, match=r"Blocks \(Restoration\) invents detail"):
        restore_scene(tiny_scene(), path)
    monkeypatch.undo()
    know_blocks(monkeypatch, scale=2, purpose="SR")  # it says so, and does not do it
    with pytest.raises(
        ValueError, match=r"photo 'view1\.png' .*output is \[1, 3, 16, 24\], wanted \[1, 3, 32, 48\]"
    ):
        restore_scene(tiny_scene(), path)


def test_no_tile_is_larger_than_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[tuple[int, ...]] = []
    forward = Compact.forward

    def spy(self: Any, x: Tensor) -> Tensor:
        sizes.append(tuple(x.shape))
        return forward(self, x)

    monkeypatch.setattr(Compact, "forward", spy)
    restore_scene(scene_of(photo(50, 70)), saved(tmp_path, compact()), 20, 3)
    assert len(sizes) == 3 * 4
    assert max(h for _, _, h, _ in sizes) <= 26
    assert max(w for _, _, _, w in sizes) <= 26


def test_threads_change_no_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inner: list[int] = []
    forward = Compact.forward

    def spy(self: Any, x: Tensor) -> Tensor:
        inner.append(torch.get_num_threads())
        return forward(self, x)

    monkeypatch.setattr(Compact, "forward", spy)
    scene = tiny_scene()
    path = saved(tmp_path, compact(seed=5))
    inside = torch.get_num_threads()
    images = []
    for count in (1, 3):
        hqgs.set_num_threads(count)
        images.append([view.image.tobytes() for view in restore_scene(scene, path).train])
    assert images[0] == images[1]
    assert set(inner) == {1}
    assert len(inner) == 2 * len(scene.train)
    assert torch.get_num_threads() == inside


class Evil:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("suffix", [".pth", ".pt", ".ckpt", ".safetensors"])
@pytest.mark.parametrize("archive", [True, False])
def test_a_file_that_would_run_code_is_refused(
    tmp_path: Path, suffix: str, archive: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")  # a user's setting must not open the door
    trap, path = tmp_path / "trap", tmp_path / f"evil{suffix}"
    state = {**compact(), "extra": Evil(trap)}
    if archive:
        torch.save(state, path)
        torch.load(io.BytesIO(path.read_bytes()), weights_only=False)
    else:
        path.write_bytes(pickle.dumps(state, protocol=2))
        pickle.loads(path.read_bytes())
    trap.rmdir()  # the trap works
    with pytest.raises(ValueError, match=f"evil{suffix} is (refused|damaged)"):
        restore_scene(tiny_scene(), path)
    assert not trap.exists()


def test_wrong_files_are_named(tmp_path: Path) -> None:
    scene = tiny_scene()

    def message(path: Path, wanted: str) -> None:
        with pytest.raises(ValueError, match=wanted) as info:
            restore_scene(scene, path)
        assert str(path) in str(info.value)

    with pytest.raises(FileNotFoundError, match=r"none\.pth"):
        restore_scene(scene, tmp_path / "none.pth")
    good = saved(tmp_path, compact(), "good.pth").read_bytes()
    for name, data in {
        "empty.pth": b"",
        "cut.pth": good[: len(good) // 2],
        "text.pth": b"hello\n" * 9,
        "byte.pth": b"\x80",
        "page.pt": b"<html>not found</html>",
        "empty.safetensors": b"",
        "cut.safetensors": saved(tmp_path, compact()).read_bytes()[:-9],
    }.items():
        (tmp_path / name).write_bytes(data)
        message(tmp_path / name, "is refused: it is damaged|is damaged or no safetensors file")
    (tmp_path / "net.onnx").write_bytes(b"x")
    message(tmp_path / "net.onnx", r"wanted a file that ends in \.safetensors, \.pth")
    message(saved(tmp_path, [torch.zeros(2)], "list.pth"), "holds a list")  # type: ignore[arg-type]
    message(saved(tmp_path, {"x": torch.zeros(2)}, "other.pth"), "knows no network")
    message(saved(tmp_path, {"params": 3}, "number.pth"), "knows no network|do not make up a network")
    partial = compact()
    del partial["body.2.weight"]
    message(saved(tmp_path, partial, "partial.pth"), "do not make up a network")
    message(saved(tmp_path, compact(channels=4), "rgba.pth"), "4 channels into 4")


def test_a_photo_that_fails_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene()
    state = compact()
    state["body.6.bias"][1] = float("nan")
    with pytest.raises(
        ValueError, match=r"net\.safetensors cannot restore the photo 'view1\.png' \(24 x 16 px\).*NaN"
    ):
        restore_scene(scene, saved(tmp_path, state))

    def fail(self: Any, x: Tensor) -> Tensor:
        raise RuntimeError("can't allocate memory")

    monkeypatch.setattr(Compact, "forward", fail)
    with pytest.raises(ValueError, match=r"photo 'view1\.png' .*can't allocate memory"):
        restore_scene(scene, saved(tmp_path, compact()))


def test_without_spandrel_it_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'hqgs\[restore\]'"):
        restore_scene(tiny_scene(), saved(tmp_path, compact()))
