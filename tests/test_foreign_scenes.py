"""Scene files of others: infinities, flags, nodes, pictures for numbers, and frames that are not ours."""

from __future__ import annotations

import base64
import io
import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from test_covariances import covariances as of_axes
from test_formats import change_gltf, random_gaussians

from hqgs.model.formats import gltf
from hqgs.model.gaussians import Gaussians
from hqgs.scene.paths import look_at
from hqgs.scene.scene import Camera
from hqgs.show.export import export
from hqgs.show.export_options import ExportOptions

CAMERA = look_at([0.3, -0.2, -6.0], [0.0, 0.0, 0.0])


def picture(gaussians: Gaussians, camera: Camera = CAMERA) -> torch.Tensor:
    with torch.no_grad():
        return gaussians.render(camera)


def test_infinite_opacities_and_scales_of_zero_become_the_nearest(tmp_path: Path) -> None:
    g = random_gaussians(30, 1)
    path = tmp_path / "a.ply"
    g.save(path)
    data = bytearray(path.read_bytes())
    start, row = data.index(b"end_header\n") + 11, 4 * (14 + 9)
    opacity, scale = 4 * (6 + 9), 4 * (7 + 9)
    data[start + opacity : start + opacity + 4] = np.float32(np.inf).tobytes()
    data[start + row + opacity : start + row + opacity + 4] = np.float32(-np.inf).tobytes()
    data[start + 2 * row + scale : start + 2 * row + scale + 4] = np.float32(-np.inf).tobytes()
    path.write_bytes(bytes(data) + b"12345")
    read = Gaussians.load(path)
    assert len(read) == 30
    assert read.activated_opacities()[:2].tolist() == pytest.approx([1, 0], abs=1e-7)
    assert 0 < read.activated_scales()[2, 0] < 1e-15
    wanted = ["2 infinite opacities", "1 scales of 0", "5 bytes after its last row"]
    assert [any(note.startswith(w) for note in read.notes) for w in wanted] == [True] * 3
    assert torch.isfinite(picture(read)).all()
    assert torch.equal(read.shN[3:], g.shN[3:])


def test_all_62_columns_of_3dgs(tmp_path: Path) -> None:
    g = random_gaussians(5, 1)
    export(g, tmp_path / "a.ply", ExportOptions("full.ply", band_tolerance=0))
    data = (tmp_path / "a.ply").read_bytes()
    head = data[: data.index(b"end_header\n") + 11]
    names = [line.split()[2] for line in head.decode().splitlines() if line.startswith("property float ")]
    rest = [f"f_rest_{k}" for k in range(45)]
    normals, colours = ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
    shape = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert names == ["x", "y", "z", *normals, *colours, *rest, *shape]
    assert len(data) - len(head) == 248 * 5
    read = Gaussians.load(tmp_path / "a.ply")
    assert torch.equal(read.shN[:, :3], g.shN)
    assert not read.shN[:, 3:].any()
    assert torch.equal(read.means, g.means)


@pytest.mark.parametrize("suffix", ["spz", "ply"])
@pytest.mark.parametrize("version", [3, 4])
def test_the_antialias_flag_is_kept_and_seen(tmp_path: Path, suffix: str, version: int) -> None:
    g = random_gaussians(40, 1)
    g.antialiased = True
    path = tmp_path / f"a.{suffix}"
    export(g, path, ExportOptions(suffix, spz_version=version))
    read = Gaussians.load(path)
    assert read.antialiased
    other = read.like(read.named())
    other.antialiased = False
    with torch.no_grad():
        by_hand = other.rasterize(CAMERA, sh_degree=other.sh_degree, background=(0, 0, 0))[0][0]
    assert torch.equal(picture(other), by_hand)
    assert (picture(read) - by_hand).abs().max() > 1e-4
    again = tmp_path / "b.spz"
    export(read, again, ExportOptions("spz"))
    assert Gaussians.load(again).antialiased


def nodes(content: Any, several: list[dict[str, Any]]) -> None:
    content["nodes"] = [{"mesh": 0} | node for node in several]
    content["scenes"][0]["nodes"] = [*range(len(several))]


HALF = np.sqrt(0.5)


@pytest.mark.parametrize(
    ("node", "linear"),
    [
        ({"rotation": [0, HALF, 0, HALF]}, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
        ({"scale": [2, 2, 2]}, [[2, 0, 0], [0, 2, 0], [0, 0, 2]]),
        ({"scale": [1.5, 1, 0.5]}, [[1.5, 0, 0], [0, 1, 0], [0, 0, 0.5]]),
        ({"scale": [-1, 1, 1]}, [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ({"matrix": [0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1]}, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    ],
)
def test_nodes_turn_stretch_and_move(tmp_path: Path, node: dict[str, Any], linear: list[list[float]]) -> None:
    """Positions and covariances by their definition, colours as the old ones from the old directions."""
    g = random_gaussians(20, 3)
    g.save(tmp_path / "a.glb")
    moved = node if "matrix" in node else node | {"translation": [1.0, 2.0, 3.0]}
    shift = np.zeros(3) if "matrix" in node else np.array([1.0, 2.0, 3.0])
    change_gltf(tmp_path / "a.glb", lambda content: nodes(content, [moved]))
    read = Gaussians.load(tmp_path / "a.glb")
    flip = np.diag([1.0, -1.0, -1.0])
    A, t = flip @ np.array(linear) @ flip, flip @ shift
    np.testing.assert_allclose(read.means, g.means.numpy() @ A.T + t, atol=1e-5)
    np.testing.assert_allclose(covariances(read), A @ covariances(g) @ A.T, rtol=1e-3, atol=1e-6)
    if abs(abs(np.linalg.det(A)) ** (1 / 3) - np.linalg.norm(A[0])) > 1e-9:
        return  # a stretch has no one rotation for colours
    unit = A / np.linalg.norm(A[0])
    for k in range(5):
        direction = np.array([0.3, -0.5, 0.8 + k])
        np.testing.assert_allclose(
            colours(read, k, direction), colours(g, k, unit.T @ direction), rtol=1e-4, atol=1e-4
        )


def covariances(g: Gaussians) -> np.ndarray:
    return of_axes(g.quats.double(), g.activated_scales().double()).numpy()


def colours(g: Gaussians, k: int, direction: np.ndarray) -> np.ndarray:
    """Of one Gaussian as the rasterizer shows it from a direction: large, opaque, before the camera."""
    one = g.rows(torch.tensor([k])).like(g.rows(torch.tensor([k])).named())
    one.means[:], one.scales[:], one.opacities[:] = 0, 1.0, 20.0
    one.sh0 += 2.0  # so that nothing is cut at 0
    eye = -5 * direction / np.linalg.norm(direction)
    image = picture(one, look_at(eye, [0.0, 0.0, 0.0]))
    return image[image.shape[0] // 2, image.shape[1] // 2].numpy()


def test_several_primitives_and_nodes_are_joined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    g = random_gaussians(6, 1)
    g.save(tmp_path / "a.glb")

    def change(content: Any) -> None:
        nodes(content, [{}, {"translation": [10.0, 0.0, 0.0]}])
        primitives = content["meshes"][0]["primitives"]
        fewer = json.loads(json.dumps(primitives[0]))
        for k in range(3):
            fewer["attributes"].pop(f"KHR_gaussian_splatting:SH_DEGREE_1_COEF_{k}")
        primitives.append(fewer)

    change_gltf(tmp_path / "a.glb", change)
    read = Gaussians.load(tmp_path / "a.glb")
    assert len(read) == 24
    torch.testing.assert_close(read.means[:6], g.means)
    torch.testing.assert_close(read.means[18:, 0], g.means[:, 0] + 10)
    assert read.shN[:6].any()
    assert not read.shN[6:12].any()
    change_gltf(tmp_path / "a.glb", lambda content: nodes(content, 40 * [{}]))
    monkeypatch.setattr(gltf, "MAX_GAUSSIANS", 20)
    with pytest.raises(ValueError, match="show more than 20 Gaussians, many again"):
        Gaussians.load(tmp_path / "a.glb")


@pytest.mark.parametrize("embedded", [True, False])
def test_the_text_form_of_gltf(tmp_path: Path, embedded: bool) -> None:
    g = random_gaussians(6, 1)
    g.save(tmp_path / "a.glb")
    file = (tmp_path / "a.glb").read_bytes()
    (size,) = struct.unpack_from("<I", file, 12)
    content, data = json.loads(file[20 : 20 + size]), file[28 + size :]
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    content["buffers"][0]["uri"] = uri if embedded else "a%20b.bin"
    if not embedded:
        (tmp_path / "a b.bin").write_bytes(data)
    (tmp_path / "b.gltf").write_text(json.dumps(content))
    read, binary = Gaussians.load(tmp_path / "b.gltf"), Gaussians.load(tmp_path / "a.glb")
    for name, tensor in read.named().items():
        assert torch.equal(tensor, binary.named()[name])
    if not embedded:
        (tmp_path / "a b.bin").unlink()
        with pytest.raises(ValueError, match="belongs beside the file"):
            Gaussians.load(tmp_path / "b.gltf")
    content["buffers"][0]["uri"] = "../secret.bin"
    (tmp_path / "b.gltf").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="is outside of the folder"):
        Gaussians.load(tmp_path / "b.gltf")


def sog(g: Gaussians, bands: int) -> dict[str, bytes]:
    """The files of a SOG scene of version 2, written after the format's description."""
    n, side = len(g), 8
    codebook = np.linspace(-4, 4, 256)

    def webp(values: np.ndarray, width: int = side) -> bytes:
        flat = np.zeros((-(-len(values) // width) * width, 4), np.uint8)
        flat[:, 3] = 255
        flat[: len(values), : values.shape[1]] = values
        out = io.BytesIO()
        Image.fromarray(flat.reshape(-1, width, 4)).save(out, "webp", lossless=True, exact=True)
        return out.getvalue()

    def coded(values: torch.Tensor) -> np.ndarray:
        return np.abs(values.double().numpy()[..., None] - codebook).argmin(-1).astype(np.uint8)

    means = g.means.double().numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    fixed = np.rint((logs - low) / (high - low) * 65535).astype(np.int64)
    quats = torch.nn.functional.normalize(g.quats, dim=1).double().numpy()
    packed = np.zeros((n, 4), np.uint8)
    for row, q in zip(packed, quats, strict=True):
        place = int(np.abs(q).argmax())
        q = q * np.sign(q[place])
        row[:3] = np.rint((np.delete(q, place) / np.sqrt(2) + 0.5) * 255)
        row[3] = 252 + place
    opacities = np.rint(255 * g.activated_opacities().numpy()).astype(np.uint8)
    files = {
        "means_l.webp": webp(fixed % 256),
        "means_u.webp": webp(fixed // 256),
        "scales.webp": webp(coded(g.scales)),
        "quats.webp": webp(packed),
        "sh0.webp": webp(np.concatenate([coded(g.sh0[:, 0]), opacities[:, None]], 1)),
    }
    book = codebook.tolist()
    meta: dict[str, Any] = {"version": 2, "count": n, "antialias": True}
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    meta["scales"] = {"codebook": book, "files": ["scales.webp"]}
    meta["quats"] = {"files": ["quats.webp"]}
    meta["sh0"] = {"codebook": book, "files": ["sh0.webp"]}
    if bands:
        count = (bands + 1) ** 2 - 1
        table = np.zeros((64, count, 3), np.uint8)
        table[:n] = coded(g.shN[:, :count])
        files["centroids.webp"] = webp(table.reshape(-1, 3), 64 * count)
        labels = np.arange(n)
        files["labels.webp"] = webp(np.stack([labels % 256, labels // 256], 1))
        meta["shN"] = {"count": 64, "bands": bands, "codebook": book}
        meta["shN"]["files"] = ["centroids.webp", "labels.webp"]
    return files | {"meta.json": json.dumps(meta).encode()}


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("bands", [0, 1, 3])
def test_sog(tmp_path: Path, packed: bool, bands: int) -> None:
    g = random_gaussians(40, 3)
    files = sog(g, bands)
    source = tmp_path / "a.sog"
    if packed:
        with zipfile.ZipFile(source, "w") as out:
            for name, content in files.items():
                out.writestr(f"scene/{name}", content)
    else:
        source = tmp_path / "unpacked"
        source.mkdir()
        for name, content in files.items():
            (source / name).write_bytes(content)
    read = Gaussians.load(source)
    assert read.antialiased
    assert read.sh_degree == bands
    np.testing.assert_allclose(read.means, g.means, atol=1e-3)
    inside = g.scales.abs() < 4
    np.testing.assert_allclose(read.scales[inside], g.scales[inside], atol=0.017)
    dots = (torch.nn.functional.normalize(g.quats, dim=1) * read.quats).sum(1).abs()
    assert dots.min() > 0.9999
    np.testing.assert_allclose(read.activated_opacities(), g.activated_opacities(), atol=0.003)
    if bands:
        wanted = g.shN[:, : (bands + 1) ** 2 - 1].clamp(-4, 4)
        np.testing.assert_allclose(read.shN, wanted, atol=0.017)
    meta = json.loads(files["meta.json"]) | {"count": 10**6}
    with zipfile.ZipFile(tmp_path / "many.sog", "w") as out:
        for name, content in (files | {"meta.json": json.dumps(meta).encode()}).items():
            out.writestr(name, content)
    with pytest.raises(ValueError, match=r"1000000 Gaussians, in \d+ bytes"):
        Gaussians.load(tmp_path / "many.sog")
    broken = tmp_path / "broken.sog"
    broken.write_bytes(b"PK\3\4nothing")
    with pytest.raises(ValueError, match=r"broken\.sog: not a readable SOG scene"):
        Gaussians.load(broken)


def ksplat(g: Gaussians, level: int, degree: int) -> bytes:
    """Six Gaussians in one section: a full bucket of four, and one that holds two."""
    block, scale = 8.0, 32767
    head, section = bytearray(4096), bytearray(1024)
    head[1] = 1
    struct.pack_into("<IIII", head, 4, 1, 1, 6, 6)
    struct.pack_into("<H", head, 20, level)
    struct.pack_into("<ff", head, 36, -4.0, 4.0)
    struct.pack_into("<IIII", section, 0, 6, 6, 4, 2 if level else 0)
    struct.pack_into("<fHxxI", section, 16, block, 12, scale)
    struct.pack_into("<IIH", section, 32, 1 if level else 0, 1 if level else 0, degree)
    middles = np.array([[0.5, 0.0, 0.0], [0.0, -0.5, 0.25]], "<f4")
    body = bytearray()
    if level:
        body += struct.pack("<I", 2) + middles.tobytes()
    sizes = (("<f4", "<f4"), ("<f2", "<f2"), ("<f2", "u1"))[level]
    quats = torch.nn.functional.normalize(g.quats, dim=1).numpy()
    for k in range(6):
        mean = g.means[k].numpy().astype(np.float64)
        if level:
            mean = np.rint((mean - middles[0 if k < 4 else 1]) / (block / 2) * scale + scale)
        body += mean.astype("<u2" if level else "<f4").tobytes()
        body += g.activated_scales()[k].numpy().astype(sizes[0]).tobytes()
        body += quats[k].astype(sizes[0]).tobytes()
        rgb = 0.5 + 0.28209479177387814 * g.sh0[k, 0].numpy()
        opacity = float(g.activated_opacities()[k])
        body += np.rint(255 * np.append(rgb, opacity).clip(0, 1)).astype(np.uint8).tobytes()
        for band in range(1, degree + 1):
            values = g.shN[k, band**2 - 1 : (band + 1) ** 2 - 1].T.numpy().astype(np.float64)
            stored = np.rint((values + 4) / 8 * 255) if level == 2 else values
            body += stored.astype(sizes[1]).tobytes()
    return bytes(head + section + body)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_ksplat(tmp_path: Path, level: int, degree: int) -> None:
    g = random_gaussians(6, 3)
    quats = torch.nn.functional.normalize(g.quats, dim=1).numpy()
    content = ksplat(g, level, degree)
    (tmp_path / "a.ksplat").write_bytes(content)
    read = Gaussians.load(tmp_path / "a.ksplat")
    assert read.sh_degree == degree
    np.testing.assert_allclose(read.means, g.means, atol=2e-4 if level else 1e-6)
    np.testing.assert_allclose(read.scales, g.scales, atol=2e-3)
    np.testing.assert_allclose(read.quats, quats, atol=2e-3)
    wanted = g.shN[:, : (degree + 1) ** 2 - 1]
    np.testing.assert_allclose(read.shN, wanted, atol=(1e-6, 4e-3, 0.02)[level])
    many = content[: 4096 + 32] + b"\xff" * 4 + content[4096 + 36 :]  # full buckets
    for damaged in (content[:-10], *([many] if level else [])):
        (tmp_path / "a.ksplat").write_bytes(damaged)
        with pytest.raises(ValueError, match="reaches beyond its end"):
            Gaussians.load(tmp_path / "a.ksplat")
