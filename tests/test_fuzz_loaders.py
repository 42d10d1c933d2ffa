"""Every loader on damaged and hostile files: it loads them or says which file is wrong, in bounded memory."""

from __future__ import annotations

import base64
import io
import json
import os
import pickle
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
import torch
from fixtures_scenes import Truth, make_truth, subset, write_colmap, write_llff, write_transforms
from forks import forks
from fuzz import Target, judge, mutations, run_in_child
from PIL import Image
from safetensors.torch import save_file
from test_foreign_scenes import ksplat
from test_ply import random_gaussians
from tiny_scene import tiny_config, tiny_scene

from hqgs.evaluation.records import read_report
from hqgs.model.formats.sog import encode_sog
from hqgs.model.formats.spz import write_spz
from hqgs.model.gaussians import Gaussians
from hqgs.scene.camera_files import load_cameras, load_path, save_cameras, save_path
from hqgs.scene.formats.degradation_json import DegradedFolder, write_degraded_folder
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene
from hqgs.training.checkpoint import FORMAT, load_checkpoint, save_checkpoint
from hqgs.training.trainer import Trainer


def check_scene(scene: Scene) -> None:
    for view in (*scene.train, *scene.test):
        assert view.image.shape == (view.camera.height, view.camera.width, 3)
        assert np.isfinite(view.camera.K).all()
        assert np.isfinite(view.camera.viewmat).all()
    assert np.isfinite(scene.points).all()
    assert scene.points.shape == scene.point_colors.shape


def load_folder(root: Path) -> None:
    check_scene(load_scene(root))


def load_gaussians(root: Path, name: str = "scene.ply") -> None:
    gaussians = Gaussians.load(root / name)
    assert all(bool(torch.isfinite(t).all()) for t in gaussians.named().values())


def load_views(root: Path) -> None:
    known = load_cameras(root)
    for view in known.views:
        assert np.isfinite(view.camera.viewmat).all()
        assert view.photo is None or root in view.photo.parents
    assert np.isfinite(known.up).all()


def load_frames(root: Path) -> None:
    cameras, fps = load_path(root / "path.json")
    assert all(np.isfinite(c.viewmat).all() and np.isfinite(c.K).all() for c in cameras)
    assert fps > 0


def load_run(root: Path) -> None:
    path = root / "checkpoint.safetensors"
    trainer = Trainer(tiny_scene(), tiny_config())
    trainer.restore(path)
    trainer.step()


def truth() -> Truth:
    return subset(make_truth(), [0, 1, 2])


def as_colmap(root: Path) -> None:
    write_colmap(truth(), root)


def as_text(root: Path) -> None:
    write_colmap(truth(), root, binary=False)


def as_llff(root: Path) -> None:
    write_llff(truth(), root)


def as_transforms(root: Path, text: bool = False) -> None:
    t = truth()
    write_transforms(t, root, ply_file_path="points.ply", k1=0.01, camera_model="OPENCV")
    dtype = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    rows = np.array([(*p, *c) for p, c in zip(t.points, t.colors, strict=True)], dtype)
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], text=text).write(str(root / "points.ply"))


def as_degraded(root: Path) -> None:
    write_colmap(truth(), root)
    low = root / "low" / "a.png"
    low.parent.mkdir()
    Image.fromarray(np.zeros((18, 24, 3), np.uint8)).save(low)
    folder = DegradedFolder(
        "lowres:2", 0, {"view_01.png": "low/a.png", "view_02.png": None}, ["view_00.png"], []
    )
    write_degraded_folder(root, folder)


def as_photo(root: Path, suffix: str) -> None:
    """Small photos, so that mutations hit their headers."""
    write_colmap(truth(), root, images=None)
    (root / "images").mkdir()
    rng = np.random.default_rng(1)
    for name in truth().names:
        pixels = rng.integers(0, 256, (36, 48, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(root / "images" / Path(name).with_suffix(suffix))


def some_gaussians() -> Gaussians:
    points = np.random.default_rng(0).uniform(-1, 1, (6, 3)).astype(np.float32)
    return Gaussians.from_points(points, np.full((6, 3), 90, np.uint8), sh_degree=1)


def as_ply(root: Path, text: bool = False) -> None:
    some_gaussians().save(root / "scene.ply")
    if text:
        ply = plyfile.PlyData.read(io.BytesIO((root / "scene.ply").read_bytes()))
        ply.text = True
        ply.write(str(root / "scene.ply"))


def as_format(root: Path, name: str) -> None:
    some_gaussians().save(root / f"scene.{name}")


def as_gltf(root: Path) -> None:
    """The text form, with its numbers inside."""
    some_gaussians().save(root / "a.glb")
    data = (root / "a.glb").read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    content = json.loads(data[20 : 20 + length])
    numbers = base64.b64encode(data[28 + length :]).decode()
    content["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{numbers}"
    (root / "scene.gltf").write_text(json.dumps(content))


def as_unpacked_sog(root: Path) -> None:
    for name, content in encode_sog(some_gaussians().arrays(), False).items():
        (root / name).write_bytes(content)


def as_ksplat(root: Path) -> None:
    (root / "scene.ksplat").write_bytes(ksplat(random_gaussians(6, 3), 1, 2))


def as_spz_4(root: Path) -> None:
    write_spz(root / "scene.spz", some_gaussians().arrays(), version=4)


def as_path(root: Path) -> None:
    save_path(root / "path.json", [view.camera for view in tiny_scene().train])


def as_checkpoint(root: Path) -> None:
    trainer = Trainer(tiny_scene(), tiny_config())
    trainer.step()
    trainer.save(root / "checkpoint.safetensors")


SUFFIXES = (".png", ".jpg", ".tif", ".bmp", ".webp")
TARGETS: dict[str, tuple[Callable[[Path], None], str, Callable[[Path], None], bool]] = {
    **{f"colmap {n}": (as_colmap, f"sparse/0/{n}.bin", load_folder, False) for n in (
        "cameras", "images", "points3D", "rigs", "frames")},
    **{f"colmap text {n}": (as_text, f"sparse/0/{n}.txt", load_folder, True) for n in (
        "cameras", "images", "points3D")},
    "llff": (as_llff, "poses_bounds.npy", load_folder, False),
    "transforms": (as_transforms, "transforms.json", load_folder, True),
    "points": (as_transforms, "points.ply", load_folder, False),
    "points text": (lambda root: as_transforms(root, True), "points.ply", load_folder, True),
    "degradation": (as_degraded, "degradation.json", load_folder, True),
    **{f"photo {s}": (lambda root, s=s: as_photo(root, s), f"images/view_01{s}", load_folder, False)
       for s in SUFFIXES},
    **{name: (lambda root, name=name: as_format(root, name), f"scene.{name}",
              partial(load_gaussians, name=f"scene.{name}"), False)
       for name in ("spz", "splat", "compressed.ply", "glb", "sog")},
    "ksplat": (as_ksplat, "scene.ksplat", partial(load_gaussians, name="scene.ksplat"), False),
    "gltf": (as_gltf, "scene.gltf", partial(load_gaussians, name="scene.gltf"), True),
    "sog unpacked": (as_unpacked_sog, "meta.json", partial(load_gaussians, name="meta.json"), True),
    "spz 4": (as_spz_4, "scene.spz", partial(load_gaussians, name="scene.spz"), False),
    "ply": (as_ply, "scene.ply", load_gaussians, False),
    "ply text": (lambda root: as_ply(root, True), "scene.ply", load_gaussians, True),
    "cameras": (lambda root: save_cameras(root, tiny_scene()), "cameras.json", load_views, True),
    "path": (as_path, "path.json", load_frames, True),
    "checkpoint": (as_checkpoint, "checkpoint.safetensors", load_run, False),
}  # fmt: skip


def make(name: str, folder: Path) -> Target:
    write, file, load, text = TARGETS[name]
    root = folder / "scene"
    root.mkdir()
    write(root)
    return Target(name.replace(" ", "_"), root.resolve(), file, load, text)


@pytest.fixture(scope="module")
def processes() -> ForkServerContext:
    return forks()


@pytest.mark.parametrize("count", [50, pytest.param(1_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", TARGETS)
def test_mutations(name: str, count: int, processes: ForkServerContext, tmp_path: Path) -> None:
    target = make(name, tmp_path)
    target.load(target.root)
    whole = (target.root / target.file).read_bytes()
    cases = mutations(whole, target.text, count, zlib.crc32(name.encode()))
    wrong = run_in_child(processes, target, cases)
    assert not wrong, "\n".join(wrong[:20])


@pytest.mark.parametrize("name", TARGETS)
def test_a_folder_or_nothing_in_the_place_of_the_file(name: str, tmp_path: Path) -> None:
    target = make(name, tmp_path)
    path = target.root / target.file
    path.write_bytes(b"")
    assert judge(target) is None
    path.unlink()
    assert judge(target) is None
    path.mkdir()
    assert judge(target) is None


# --- files made to do harm


class Bomb:
    """Unpickling it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[[str], object], tuple[str]]:
        return os.mkdir, (str(self.path),)


def test_a_pickle_is_not_run_in_the_place_of_any_file(tmp_path: Path) -> None:
    struck = tmp_path / "struck"
    pickled = pickle.dumps(Bomb(struck))
    pickle.loads(pickled)
    struck.rmdir()  # it works
    torch.save({"a": Bomb(struck)}, tmp_path / "bomb.pt")
    array = io.BytesIO()
    np.save(array, np.array([[Bomb(struck)] * 17], object), allow_pickle=True)
    for number, name in enumerate(TARGETS):
        folder = tmp_path / str(number)
        folder.mkdir()
        target = make(name, folder)
        for content in (pickled, (tmp_path / "bomb.pt").read_bytes(), array.getvalue()):
            (target.root / target.file).write_bytes(content)
            assert judge(target) is None, name
            assert not struck.exists(), name


def png(width: int, height: int, pixels: bytes = b"") -> bytes:
    """A PNG whose header promises this size."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


HOSTILE = {
    "colmap cameras": [struct.pack("<QIiQQ", 10**12, 1, 1, 48, 36)],
    "colmap images": [struct.pack("<Q", 10**12) + bytes(200)],
    "colmap points3D": [struct.pack("<Q", 10**12) + bytes(200)],
    "colmap text points3D": [b"1 0 0 0 255 255 255 0.5 " + b"1 2 " * 100_000, b"9" * 1_000_000],
    "llff": [
        b"\x93NUMPY\x01\x00v\x00"
        + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 17), }".ljust(117)
        + b"\n",
        b"\x93NUMPY\x01\x00v\x00"
        + b"{'descr': '<f(', 'fortran_order': False, 'shape': (5, 17), }".ljust(117)
        + b"\n",
        b"\x93NUMPY\x01\x00v\x00"
        + b"{'descr': ',<f8', 'fortran_order': False, 'shape': (5, 17), }".ljust(117)
        + b"\n",
    ],
    "transforms": [
        b"[" * 1_000_000,
        b'{"frames": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
        b'{"frames": [' + b"{}," * 100_000 + b"{}]}",
        b"\xff\xfe{\x00}\x00",
        b"[1]",
        b'{"frames": 3}',
    ],
    "degradation": [b"[" * 1_000_000, b'{"kind": ' * 100_000],
    "points": [
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uint uint x\nend_header\n4000000000 1\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uint uint x\nend_header\n"
        + b"\xff\xff\xff\xff",
        b"ply\n" + b"comment x\n" * 100_000,
    ],
    "ply": [
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uint uint x\nend_header\n"
        + b"\xff\xff\xff\xff",
    ],
    "photo .png": [
        png(60_000, 60_000),
        png(2**31 - 1, 2**31 - 1),
        png(48, 36)[:33] + b"\x7f\x7f\x7f\x7fIDAT" + bytes(100),  # a chunk that says it has 2 GB
        png(13_000, 13_000, bytes(39_013_000 * 13)),  # 0.5 GB of pixels in 0.5 MB, below Pillow's own limit
    ],
    "checkpoint": [
        struct.pack("<Q", 10**12) + b"{}",
        struct.pack("<Q", 60)
        + b'{"a":{"dtype":"F32","shape":[1000000000000],"data_offsets":[0,4]}}'.ljust(60),
        struct.pack("<Q", 100_000) + b"[" * 100_000,
    ],
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_bounded_memory(
    name: str, processes: ForkServerContext, tmp_path: Path
) -> None:
    target = make(name, tmp_path)
    whole = (target.root / target.file).read_bytes()
    cases = [(f"number {k}", content) for k, content in enumerate(HOSTILE[name])]
    limited = replace(target, memory=300 << 20)
    wrong = run_in_child(processes, limited, cases)
    assert not wrong, "\n".join(wrong)
    for _, content in cases:
        (target.root / target.file).write_bytes(content)
        with pytest.raises((ValueError, OSError)):
            target.load(target.root)
    (target.root / target.file).write_bytes(whole)
    target.load(target.root)


OUTSIDE = ["../secret.png", "/etc/hostname", "images/../../secret.png", "a\0b"]


@pytest.mark.parametrize("path", OUTSIDE)
def test_no_path_in_a_file_leaves_the_folder(tmp_path: Path, path: str) -> None:
    secret = tmp_path / "secret.png"
    Image.fromarray(np.zeros((36, 48, 3), np.uint8)).save(secret)
    root = tmp_path / "scene"
    for key in ("file_path", "mask_path", "ply_file_path"):
        as_transforms(root)
        meta = json.loads((root / "transforms.json").read_text())
        (meta if key == "ply_file_path" else meta["frames"][1])[key] = path
        (root / "transforms.json").write_text(json.dumps(meta))
        with pytest.raises(ValueError, match=f"{key} .* (is outside of the folder|is not a file)"):
            load_scene(root)
    degraded = tmp_path / "degraded"
    as_degraded(degraded)
    content = (degraded / "degradation.json").read_text()
    (degraded / "degradation.json").write_text(content.replace("low/a.png", json.dumps(path)[1:-1]))
    with pytest.raises(ValueError, match=r"small photo .* (is outside of the folder|is not a file)"):
        load_scene(degraded)
    colmap = tmp_path / "colmap"
    as_text(colmap)
    images = colmap / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace("view_01.png", path))
    with pytest.raises(ValueError, match=r"photo .* (is outside of the folder|is not a file in) .*colmap"):
        load_scene(colmap)


def test_a_link_to_a_device_or_a_loop_is_refused(tmp_path: Path) -> None:
    root = tmp_path / "scene"
    as_transforms(root)
    photo = root / "images" / "view_01.png"
    for goal in ("/dev/zero", "view_01.png", "/no/such/file"):
        photo.unlink()
        photo.symlink_to(goal)
        if goal == "/dev/zero":
            with pytest.raises((ValueError, OSError), match="view_01"):
                load_scene(root)
        else:
            assert any("view_01.png" in note for note in load_scene(root).notes)


@pytest.mark.parametrize(
    "change",
    [
        {"meta": {}},
        {"meta": {"config": 3}},
        {"meta": {"config": None, "scene": []}},
        {"drop": "iteration"},
        {"drop": "guard"},
        {"drop": "decisions"},
        {"set": {"decisions": {"length": 30}}},
        {"set": {"guard": {"rude": 1}}},
        {"set": {"guard": []}},
        {"tensor": ("gaussians.means", None)},
        {"tensor": ("gaussians.means", torch.zeros(40, 4))},
        {"tensor": ("gaussians.means", torch.zeros(39, 3)), "told": "scales"},
        {"tensor": ("gaussians.means", torch.zeros(())), "told": "is incomplete"},
        {"tensor": ("gaussians.sh0", torch.zeros(40, 1, 3, dtype=torch.float64))},
        {"tensor": ("adam.quats.0.exp_avg_sq", torch.zeros(40, 4, dtype=torch.float64))},
        {"tensor": ("gaussians.quats", torch.zeros(40, 4, dtype=torch.int64))},
        {"tensor": ("gaussians.shN", torch.zeros(40, 3, 3))},
        {"tensor": ("densify.count", torch.zeros(7))},
        {"tensor": ("densify.grad_sum", None)},
        {"tensor": ("adam.means.0.exp_avg", torch.zeros(2))},
        {"tensor": ("adam.means.0.exp_avg_sq", None)},
        {"tensor": ("adam.means.0.step", torch.zeros(3))},
        {"tensor": ("method.rude", torch.zeros(3)), "told": "'rude'"},
        {"tensor": ("gaussians.rude", torch.zeros(3))},
    ],
    ids=str,
)
def test_a_checkpoint_with_a_right_checksum_and_wrong_content_is_refused(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    as_checkpoint(tmp_path)
    path = tmp_path / "checkpoint.safetensors"
    tensors, meta = load_checkpoint(path)
    meta = change.get("meta", meta) | change.get("set", {})
    meta.pop(change.get("drop"), None)
    name, tensor = change.get("tensor", ("", None))
    tensors.pop(name, None)
    save_checkpoint(path, tensors | ({} if tensor is None else {name: tensor}), meta)
    told = change.get("told", name.removeprefix("gaussians.") if tensor is not None else "")
    with pytest.raises(ValueError, match=rf"checkpoint(?s:.*){re.escape(told)}"):
        Trainer(tiny_scene(), tiny_config()).restore(path)


def test_deep_json_in_a_checkpoint_or_a_report_is_refused(tmp_path: Path) -> None:
    deep = "[" * 100_000 + "]" * 100_000
    header = {"format": str(FORMAT), "meta": deep, "crc32": str(zlib.crc32(deep.encode()))}
    save_file({}, tmp_path / "a.safetensors", metadata=header)
    with pytest.raises(ValueError, match=r"a\.safetensors is damaged"):
        load_checkpoint(tmp_path / "a.safetensors")
    (tmp_path / "report.json").write_text(deep)
    with pytest.raises(ValueError, match=r"report\.json is not valid JSON"):
        read_report(tmp_path / "report.json")
