"""Faults seeded by other code than imitates them are named, and right renders are right."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from reference import project, sh_colors

import hqgs
from hqgs.cli.main import main
from hqgs.evaluation.viewers import kit as viewers_kit
from hqgs.evaluation.viewers.faults import RIGHT, Imitations
from hqgs.evaluation.viewers.kit import kit_cameras, kit_scene
from hqgs.evaluation.viewers.plain import Ways, render
from hqgs.model.formats.arrays import Arrays
from hqgs.model.gaussians import Gaussians
from hqgs.photos.pixels import to_uint8
from hqgs.scene.geometry import resized_camera
from hqgs.scene.scene import Camera

SMALL = 120, 90
FAULTS = {
    "low-pass": "missing low-pass",
    "antialias": "antialias flag ignored",
    "cut": "harmonics cut",
    "clamped": "harmonics clamped",
    "linear": "blended in linear light",
    "bits": "8-bit accumulation",
    "order": "wrong order",
    "far": "far clip",
    "positions": "quantised positions",
    "axes": "flipped axes",
    "view": "another field of view",
}


def cameras() -> list[Camera]:
    return [resized_camera(camera, *SMALL) for camera in kit_cameras()]


def held(scene: Arrays) -> Gaussians:
    made = Gaussians(
        **{
            name: torch.tensor(scene[name])
            for name in ("means", "scales", "quats", "opacities", "sh0", "shN")
        }  # type: ignore[literal-required]
    )
    made.antialiased = scene.get("antialiased", False)
    return made


def drawn(scene: Arrays, camera: Camera, **ways: object) -> NDArray[np.float64]:
    """By the rasterizer, float32, as other programs do."""
    g = held(scene)
    mode = "antialiased" if g.antialiased else "classic"
    images, _, _ = hqgs.rasterization(
        g.means,
        g.quats,
        g.activated_scales(),
        g.activated_opacities(),
        torch.cat([g.sh0, g.shN], 1),
        torch.tensor(camera.viewmat[None]),
        torch.tensor(camera.K[None]),
        camera.width,
        camera.height,
        **({"sh_degree": 3, "rasterize_mode": mode} | ways),  # type: ignore[arg-type]
    )
    return images[0].double().numpy()


def composited(scene: Arrays, camera: Camera, how: str) -> NDArray[np.float64]:
    """By the tests' reference, with one thing done otherwise: clamped, linear, bits or order."""
    g = {
        name: torch.tensor(scene[name]).double()
        for name in ("means", "scales", "quats", "opacities", "sh0", "shN")
    }  # type: ignore[literal-required]
    viewmat, K = torch.tensor(camera.viewmat), torch.tensor(camera.K)
    size = camera.width, camera.height
    depths = g["means"] @ viewmat[2, :3] + viewmat[2, 3]
    g = {name: tensor[depths > 0.01] for name, tensor in g.items()}
    opacities = g["opacities"].sigmoid()
    aa = scene.get("antialiased", False)
    p = project(g["means"], g["quats"], g["scales"].exp(), opacities, viewmat, K, *size, 0.3, aa)
    colors = sh_colors(torch.cat([g["sh0"], g["shN"]], 1), g["means"], viewmat, 3)
    if how == "clamped":
        colors = colors.clamp(max=1)
    if how == "linear":
        colors = torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    y, x = torch.meshgrid(torch.arange(size[1]) + 0.5, torch.arange(size[0]) + 0.5, indexing="ij")
    image = torch.zeros(size[1], size[0], 3, dtype=torch.float64)
    nearest_last = torch.argsort(p.depths, descending=True)
    for k in (torch.argsort(p.depths) if how == "order" else nearest_last).tolist():
        dx, dy = x - p.means2d[k, 0], y - p.means2d[k, 1]
        a, b, c = p.conics[k]
        alpha = (p.opacities[k] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(max=0.99)
        alpha = torch.where(alpha < 1 / 255, 0.0, alpha)[..., None]
        image = image * (1 - alpha) + alpha * colors[k]
        if how == "bits":
            image = (image.clamp(0, 1) * 255).round() / 255
    if how == "linear":
        image = torch.where(
            image <= 0.0031308, 12.92 * image, 1.055 * image.clamp(min=1e-9) ** (1 / 2.4) - 0.055
        )
    return image.numpy()


def seeded(scene: Arrays, camera: Camera, fault: str) -> NDArray[np.uint8]:
    """What a viewer with that fault shows."""
    flagged: Arrays = {**scene, "antialiased": True}
    if fault == "low-pass":
        image = drawn(scene, camera, eps2d=0.0)
    elif fault == "antialias":
        image = drawn(flagged, camera, rasterize_mode="classic")
    elif fault == "cut":
        image = drawn(scene, camera, sh_degree=1)
    elif fault == "far":
        image = drawn(scene, camera, far_plane=50.0)
    elif fault == "positions":
        coarse: Arrays = {**scene, "means": scene["means"].astype(np.float16).astype(np.float32)}
        image = drawn(coarse, camera)
    elif fault == "view":
        K = camera.K.copy()
        K[:2, :2] *= 0.6
        image = drawn(scene, replace(camera, K=K))
    elif fault == "axes":
        image = drawn(scene, camera)[::-1]
    else:
        image = composited(scene, camera, fault)
    return to_uint8(image.astype(np.float32))


def test_the_plain_renderer_is_right() -> None:
    scene, camera = kit_scene(), kit_cameras()[0]
    flagged: Arrays = {**scene, "antialiased": True}
    for arrays, ways in ((scene, {}), (flagged, {"rasterize_mode": "antialiased"})):
        exact = {
            name: torch.tensor(arrays[name]).double()
            for name in ("means", "scales", "quats", "opacities", "sh0", "shN")
        }  # type: ignore[literal-required]
        model = replace(held(arrays), **exact)
        model.antialiased = bool(ways)
        with torch.no_grad():
            seen = model.rasterize(camera, sh_degree=3, background=(0.0, 0.0, 0.0))[0][0].clamp(0, 1).numpy()
        np.testing.assert_allclose(render(arrays, camera), seen, atol=1e-9)
    cut = np.abs(render(scene, camera, Ways(sh_degree=0)) - render(scene, camera)).max()
    assert cut > 0.05


@cache
def imitated(seed: int, views: int, flagged: bool = False) -> Imitations:
    scene: Arrays = {**kit_scene(seed), "antialiased": flagged}
    return Imitations(scene, cameras()[:views])


def verdicts(seed: int, faults: list[str], views: int) -> dict[str, str | None]:
    scene, seen = kit_scene(seed), cameras()[:views]
    flagged: Arrays = {**scene, "antialiased": True}
    plain, compensated = imitated(seed, views), imitated(seed, views, flagged=True)
    found = {}
    for fault in faults:
        known = compensated if fault == "antialias" else plain
        shots = {k: seeded(scene, camera, fault) for k, camera in enumerate(seen)}
        found[fault] = known.verdict(shots).fault
    for name, known, arrays in (("right", plain, scene), ("right, flagged", compensated, flagged)):
        if name == "right" or "antialias" in faults:
            shots = {k: to_uint8(drawn(arrays, camera).astype(np.float32)) for k, camera in enumerate(seen)}
            found[name] = known.verdict(shots).fault
    return found


def wanted(faults: list[str]) -> dict[str, str | None]:
    found: dict[str, str | None] = {fault: FAULTS[fault] for fault in faults}
    found["right"] = RIGHT
    return found | ({"right, flagged": RIGHT} if "antialias" in faults else {})


def test_seeded_faults_are_named_in_one_picture() -> None:
    faults = ["low-pass", "cut", "axes"]  # the rest, in more pictures and scenes: the slow test below
    assert verdicts(0, faults, 1) == wanted(faults)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_seeded_faults_are_named_in_five_scenes(seed: int) -> None:
    assert verdicts(seed, [*FAULTS], 2) == wanted([*FAULTS])


def test_what_is_none_of_them_is_said() -> None:
    scene, camera = kit_scene(), cameras()[0]
    shot = to_uint8((0.8 * drawn(scene, camera)).astype(np.float32))  # darker: in no list
    found = imitated(0, 1).verdict({0: shot})
    assert found.fault is None
    assert "by none of the known faults" in str(found)


def test_the_kit_and_its_judge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kit, shots = tmp_path / "kit", tmp_path / "shots"
    assert main(["judge", "--kit", str(kit)]) == 0
    assert sum(path.stat().st_size for path in kit.iterdir()) < 2e6
    for name, side in {"WIDTH": SMALL[0], "HEIGHT": SMALL[1], "FOCAL": 97.5}.items():
        monkeypatch.setattr(viewers_kit, name, side)  # a smaller one takes seconds less to judge
    kit = tmp_path / "small"
    assert main(["judge", "--kit", str(kit)]) == 0
    shots.mkdir()
    right = Image.open(kit / "plain_1.png")
    right.convert("RGBA").save(shots / "plain_1.PNG")
    Image.fromarray(np.asarray(right)[:, ::-1]).save(tmp_path / "plain_0.png")
    capsys.readouterr()
    assert main(["judge", "--viewer", str(shots), "--kit", str(kit)]) == 0
    assert "plain, 1 of 3 pictures: right (0.00 levels off)" in capsys.readouterr().out
    (tmp_path / "other").mkdir()
    right.save(tmp_path / "other" / "shot.png")
    right.resize((640, 480)).save(tmp_path / "plain_2.png")
    (tmp_path / "antialiased_0.png").write_bytes(b"none")
    cases = [
        (["--viewer", tmp_path / "other", "--kit", kit], "no screenshot under the name of one of the kit's"),
        (["--viewer", tmp_path / "plain_2.png", "--kit", kit], "picture 2 is 640 x 480 px, its camera wants"),
        (["--viewer", tmp_path / "antialiased_0.png", "--kit", kit], "is no picture"),
        (["--viewer", tmp_path / "nowhere", "--kit", kit], "there is no"),
        (["--viewer", shots], "--viewer needs --kit DIR"),
        (["--kit", kit], "exists and is not an empty folder"),
        ([kit / "plain.ply", "--kit", tmp_path / "k2"], "take no scene of your own"),
        (["--kit", tmp_path / "k2", "--out", tmp_path / "o"], "--kit takes no other option than --viewer"),
    ]
    for arguments, words in cases:
        assert main(["judge", *map(str, arguments)]) == 2
        assert words in capsys.readouterr().err
