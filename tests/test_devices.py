"""What cameras do to all their photos: the model, what is found before training, what is learned."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from run_state import assert_stopped_alike
from test_learned_cameras import learned_config
from tiny_scene import tiny_scene

import hqgs
from hqgs.cli.main import main
from hqgs.diagnosis.colors import (
    LEAST,
    Devices,
    DeviceSigns,
    SharedColors,
    Sign,
    device_findings,
    device_signs,
    grouped,
    log_gains,
    plain_devices,
)
from hqgs.evaluation.held_out import HeldOutViews, look_of, looks_of_devices, measured
from hqgs.evaluation.metrics import psnr
from hqgs.photos.formula import DEVICES
from hqgs.photos.light import to_linear, to_srgb
from hqgs.photos.look import STEEPEST, Look, as_a_lens, darken, falloff, respond, squared_radii
from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.methods.cameras import KEPT, LearnedCameras, LearnedDevices
from hqgs.training.trainer import Trainer

Floats = NDArray[np.float64]
K = np.array([[40.0, 0, 17.5], [0, 40.0, 11.0], [0, 0, 1]])


def response_of(values: Floats, response: Floats) -> Floats:
    """Its integral from 0 of 1 + a P1(u) + b P2(u) by numpy's polynomials, straight beyond 0 and 1."""
    out = np.empty_like(values)
    for c in range(3):
        slope = np.polynomial.Legendre([1, *response[:, c]])(np.polynomial.Polynomial([1, -2]))
        whole = slope.integ(lbnd=0)
        inside = np.clip(values[..., c], 0, 1)
        out[..., c] = whole(inside) + (values[..., c] - inside) * slope(inside)
    return out


def test_a_look_is_its_definition() -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 1, (20, 30, 3))
    look = Look(np.array([0.8, 1.0, 1.2]), np.array([0.3, 0.2]), rng.uniform(-0.4, 0.4, (2, 3)))
    taken = look.of(image, K)
    corner = (20**2 + 30**2) / 4
    for row, column in ((0, 0), (9, 16), (19, 29)):
        square = ((column + 0.5 - 17.5) ** 2 + (row + 0.5 - 11.0) ** 2) / corner
        light = to_linear(image[row, column]) * look.gains * np.exp(-0.3 * square - 0.2 * square**2)
        np.testing.assert_allclose(taken[row, column], response_of(to_srgb(light), look.response), atol=1e-12)


def test_light_is_darkened_as_sRGB_has_it() -> None:  # noqa: N802
    """Exactly on the curve and in its toe; between them by half a level at most."""
    values = torch.linspace(0, 1.2, 5_001, dtype=torch.float64).view(1, -1, 1).expand(3, -1, 1)
    for fall in (-0.4, 0.0, 0.2, 1.1):
        fallen = to_linear(values.numpy()) * np.exp(-fall)
        expected = to_srgb(fallen)
        found = darken(values, torch.full((5_001, 1), fall, dtype=torch.float64)).numpy()
        clear = (np.minimum(values.numpy(), expected) > 0.0405) | (
            np.maximum(values.numpy(), expected) < 0.0404
        )
        np.testing.assert_allclose(found[clear], expected[clear], atol=1e-6)
        assert np.abs(found - expected).max() < 0.55 / 255


def test_gradients_are_those_of_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    values = (torch.rand((3, 3, 4), generator=generator, dtype=torch.float64) * 1.2 - 0.05).requires_grad_()
    vignetting = torch.tensor([0.4, 0.1], dtype=torch.float64, requires_grad=True)
    response = (torch.rand((2, 3), generator=generator, dtype=torch.float64) - 0.5).requires_grad_()
    squares = torch.from_numpy(squared_radii(3, 4, K / 9))

    def taken(values: torch.Tensor, vignetting: torch.Tensor, response: torch.Tensor) -> torch.Tensor:
        return respond(darken(values, falloff(squares, vignetting)), response)

    assert torch.autograd.gradcheck(taken, (values, vignetting, response), eps=1e-7, atol=1e-5)


def view(number: int, device: str) -> View:
    camera = Camera(36, 24, K, np.eye(4))
    return View(f"{number:02}.png", camera, np.zeros((24, 36, 3), np.uint8), device=device)


def test_photos_are_those_of_their_cameras() -> None:
    views = [view(k, "b" if k % 3 else "a") for k in range(12)] + [view(12, "rare"), view(13, "")]
    views.append(replace(view(14, "a"), face="front"))
    assert grouped(views).tolist() == [1, 0, 0] * 4 + [-1, -1, -1]


def colors(rng: np.random.Generator, looks: list[Look], scatter: float) -> SharedColors:
    """Of points that each photo shows somewhere, by the definition of a look."""
    count, points = len(looks), 400
    own = rng.uniform(0.05, 0.6, (points, 3))
    squares = rng.uniform(0, 1, (count, points))
    logs = np.empty((count, points, 3))
    for k, look in enumerate(looks):
        fall = look.vignetting[0] * squares[k] + look.vignetting[1] * squares[k] ** 2
        value = response_of(to_srgb(own * look.gains * np.exp(-fall)[:, None]), look.response)
        logs[k] = np.log(to_linear(value)) + rng.normal(0, scatter, (points, 3))
    hidden = rng.random((count, points)) < 0.5
    logs[hidden], squares[hidden] = np.nan, np.nan
    return SharedColors(logs, squares, rng.normal(0, 0.1, squares.shape))


def test_vignetting_and_response_are_found() -> None:
    rng = np.random.default_rng(5)
    views = [view(k, "ab"[k % 2]) for k in range(16)]
    gains = np.exp(rng.normal(0, 0.2, (16, 3)))
    vignetting, response = np.array([[0.5, 0.2], [0.0, 0.1]]), rng.uniform(-0.25, 0.25, (2, 3))
    bends = np.stack([response, -response])
    looks = [Look(gains[k], vignetting[k % 2], bends[k % 2]) for k in range(16)]
    shared = colors(rng, looks, 0.03)
    signs = device_signs(views, shared)
    assert signs is not None
    assert [finding.step for finding in device_findings(signs)] == ["vignetting", "response"]
    assert abs(signs.vignetting.size - 0.7) < 4 * signs.vignetting.error < 0.01
    np.testing.assert_allclose(signs.devices.vignetting.sum(1), vignetting.sum(1), atol=0.03)
    np.testing.assert_allclose(signs.devices.response, bends, atol=0.045)
    np.testing.assert_allclose(signs.devices.response.mean(0), 0, atol=1e-12)
    scene = Scene("s", views, [], np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), "photos")
    own = np.log(gains) - np.log(gains).mean(0)
    off = [
        log_gains(scene, of) for of in (shared, signs.undone(shared, DEVICES))
    ]  # told apart from what cameras do
    with_them, without = (np.abs(found - own).mean() for found in off if found is not None)
    assert without < 0.4 * with_them


def test_light_that_falls_off_with_depth_is_no_lens() -> None:
    """On a walk, where points come to the rim as they come nearer: with a lens and without."""
    rng, views = np.random.default_rng(2), [view(k, "a") for k in range(16)]
    for fall in (0.0, 0.5):
        plain = colors(rng, [Look(np.ones(3), np.array([fall, 0.0]), np.zeros((2, 3)))] * 16, 0.05)
        depths = rng.normal(-0.4 * np.log(plain.squares + 0.05), 0.05)
        walk = SharedColors(plain.logs + 0.3 * depths[..., None], plain.squares, depths)
        signs, unaware = (device_signs(views, one) for one in (walk, replace(walk, depths=0 * depths)))
        assert signs is not None
        assert unaware is not None
        assert unaware.vignetting.needed
        assert signs.vignetting.needed == (fall > 0)
        assert abs(signs.vignetting.size - fall) < 0.1


@pytest.mark.parametrize("scatter", [0.01, 0.3])
def test_what_cameras_do_not_do_is_not_found(scatter: float) -> None:
    """As far as the standard error says, in 10 draws."""
    sizes = list[float]()
    views, unknown = ([view(k, device[k % 2]) for k in range(16)] for device in ("ab", ("", "")))
    for seed in range(10):
        rng = np.random.default_rng(seed)
        plain = [Look(np.exp(rng.normal(0, 0.2, 3)), np.zeros(2), np.zeros((2, 3))) for _ in views]
        signs = device_signs(views, colors(rng, plain, scatter))
        assert signs is not None
        assert [finding.step for finding in device_findings(signs)] == [None, None]
        assert device_signs(unknown, colors(rng, plain, scatter)) is None
        sizes.append(signs.vignetting.size / signs.vignetting.error)
    assert 0.5 < np.sqrt(np.mean(np.square(sizes))) < 2.5  # of the surer of two cameras


def test_they_are_learned() -> None:
    """Of photos whose scene is known, from nothing."""
    rng = np.random.default_rng(1)
    camera = Camera(36, 24, K, np.eye(4))
    clean = torch.from_numpy(rng.uniform(0.02, 0.98, (24, 36, 3)))
    vignetting = np.array([[0.5, 0.2], [0.1, 0.0]])
    response = rng.uniform(-0.3, 0.3, (2, 3))
    truth = LearnedDevices(Devices(np.array([0, 1]), vignetting, np.stack([response, -response])), True, True)
    devices = LearnedDevices(Devices(np.array([0, 1]), np.zeros((2, 2)), np.zeros((2, 2, 3))), True, True)
    params = [param for params in devices.named().values() for param in params]
    adam = torch.optim.Adam(params, lr=0.02)
    for step in range(200):
        adam.zero_grad()
        photo = truth.develop(step % 2, camera, clean).detach()
        (devices.develop(step % 2, camera, clean) - photo).abs().mean().backward()
        adam.step()
        devices.center()
    for number in (0, 1):
        for found, wanted in zip(devices.learned(number), truth.learned(number), strict=True):
            np.testing.assert_allclose(found, wanted, atol=0.05)


def test_the_scene_is_as_bright_as_its_photos() -> None:
    """Gains and lenses together leave the mean of log light, over photos and pixels, as it is."""
    vignetting = np.array([[0.5, 0.2], [0.1, 0.0]])
    devices = LearnedDevices(Devices(np.array([0, 1, 1, -1]), vignetting, np.zeros((2, 2, 3))), True, False)
    squares = squared_radii(240, 320, np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]))
    kept = [-(squares * (k1 + squares * k2)).mean() for k1, k2 in vignetting[[0, 1, 1]]]
    assert float(devices.level().detach()) == pytest.approx(-np.sum(kept) / 4, rel=0.01)
    scene = by_two()
    cameras = LearnedCameras(scene, False, False, None, 0, LearnedDevices(
        Devices(np.arange(len(scene.train)) % 2, vignetting, np.zeros((2, 2, 3))), True, False
    ))  # fmt: skip
    found = cameras.learned()
    gains = np.unique([photo.gains for photo in found])
    assert gains[0] == pytest.approx(np.exp((0.5 / 3 + 0.16 * 0.2 + 0.1 / 3) / 2), rel=1e-3)
    assert gains[-1] == gains[0]
    view = scene.train[0]
    render = torch.from_numpy(np.random.default_rng(0).uniform(0, 0.6, view.image.shape))
    taken = cameras.shot(view, torch.zeros(1, 1, 3)).develop(render).detach().numpy()
    np.testing.assert_allclose(taken, found[0].look.of(render.numpy(), view.camera.K), atol=0.6 / 255)


def test_held_out_photos_are_measured_in_the_look_of_their_camera() -> None:
    scene = by_two()
    looks = {f"camera {k}": Look(np.full(3, 1.1), np.array([0.3 * k, 0.1]), np.zeros((2, 3))) for k in (0, 1)}
    of_photos = {view.name: looks[view.device] for view in scene.train}
    found = looks_of_devices(scene.train, of_photos)
    np.testing.assert_allclose(found["camera 1"].vignetting, [0.3, 0.1])
    np.testing.assert_allclose(found["camera 1"].gains, 1.1)
    plain = Look(np.ones(3), np.zeros(2), np.zeros((2, 3)))
    assert looks_of_devices(scene.train, dict.fromkeys(of_photos, plain)) == {}
    one = scene.test[0]
    test = [replace(one, device="camera 1"), replace(one, name="other", device="unknown")]
    gaussians = hqgs.Gaussians.from_points(scene.points, scene.point_colors)
    views = HeldOutViews(test, gaussians, 0, looks=found)
    seen, other = views
    assert seen.shown is not None
    taken = found["camera 1"].of(seen.shown.clip(0), one.camera.K)
    np.testing.assert_allclose(seen.render, taken, atol=1e-6)
    assert other.shown is other.render
    each = measured(views)
    assert each[0].psnr_shown == psnr(seen.shown, one.image) != each[0].psnr
    assert each[1].psnr_shown == each[1].psnr
    assert all(view.shown is None for view in HeldOutViews(test, gaussians, 0))


def test_responses_rise_and_keep_their_mean() -> None:
    wild = np.array([[[3.0, 0, 1], [-2, 0.5, 1]], [[0, 1.0, 0], [0, -4, 2]]])
    devices = LearnedDevices(Devices(np.array([0, 1, 1, -1]), np.zeros((2, 2)), wild), True, True)
    each = np.stack([devices.learned(k)[1] for k in range(4)])
    np.testing.assert_allclose(each[:3].mean(0), 0, atol=1e-12)
    assert np.abs(each).sum(1).max() <= STEEPEST + 1e-12
    np.testing.assert_array_equal(each[3], 0)


@pytest.mark.parametrize(
    ("found", "kept"),
    [
        ([0.5, 0.2], [0.5, 0.2]),
        ([-1.14, 0.8], [0, 0.23]),  # brighter than on the axis nearly everywhere
        ([-0.5, -0.5], [0, 0]),
        ([1.0, -0.8], [1.0, -0.5]),  # it would rise again from r^2 = 0.625 on
        ([4.0, 2.0], [8 / 6 * np.log(2), 4 / 6 * np.log(2)]),  # 8.7 stops in the corner
    ],
)
def test_vignetting_is_what_a_lens_does(found: list[float], kept: list[float]) -> None:
    """Of 1,001 radii: light falls from the axis to the corner, by two stops at most."""
    lens = as_a_lens(np.array([found, [0.1, 0.0]]))
    np.testing.assert_allclose(lens[0], kept, atol=1e-12)
    fall = falloff(torch.linspace(0, 1, 1_001, dtype=torch.float64), torch.from_numpy(lens[0])).numpy()
    assert (np.diff(fall) > -1e-12).all()
    assert fall[-1] < 2 * np.log(2) + 1e-12
    assert lens[1].tolist() == [0.1, 0.0]  # the bits of what is one
    devices = LearnedDevices(Devices(np.zeros(1, int), np.array([found]), np.zeros((1, 2, 3))), True, False)
    np.testing.assert_allclose(devices.learned(0)[0], kept, atol=1e-12)


def test_what_no_camera_does_is_not_its_look() -> None:
    """Light that goes with the photo, as a flash does: brighter towards the corners."""
    rng = np.random.default_rng(7)
    views = [view(k, "a") for k in range(12)]
    bright = [Look(np.ones(3), np.array([-1.14, 0.8]), np.zeros((2, 3))) for _ in views]
    signs = device_signs(views, colors(rng, bright, 0.05))
    assert signs is not None
    assert signs.vignetting.size < -1.5 * LEAST["vignetting"]
    finding, other = device_findings(signs)
    assert not finding.needed
    assert "which no camera does" in finding.reason
    assert other.reason == "one camera took the photos"


def test_photos_that_each_have_a_camera_of_their_own_take_no_more_memory() -> None:
    count = KEPT + 4
    devices = LearnedDevices(
        Devices(np.zeros(count, int), np.full((1, 2), 0.3), np.zeros((1, 2, 3))), True, False
    )
    clean = torch.full((24, 36, 3), 0.5)
    for number in range(count):
        own = K.copy()
        own[:2, 2] += 0.1 * number
        squares = torch.from_numpy(squared_radii(24, 36, own)).float()
        wanted = darken(clean.permute(2, 0, 1), falloff(squares, torch.full((2,), 0.3)))
        found = devices.develop(number, Camera(36, 24, own, np.eye(4)), clean).detach()
        assert torch.equal(found, wanted.permute(1, 2, 0))
    assert devices._squares.cache_info().currsize == KEPT


def by_two() -> Scene:
    scene = tiny_scene()
    train = [replace(v, device=f"camera {k % 2}") for k, v in enumerate(scene.train)]
    train += [replace(v, name=f"again_{v.name}") for v in train]
    seen = None if scene.seen is None else scene.seen | {f"again_{n}": rows for n, rows in scene.seen.items()}
    return replace(scene, train=train, seen=seen)


@pytest.mark.parametrize("formation", ["vignetting+response", "exposure+vignetting+response+shake"])
def test_a_run_learns_them_bit_for_bit(formation: str, tmp_path: Path) -> None:
    whole = assert_stopped_alike(lambda: Trainer(by_two(), learned_config(formation)), tmp_path, 17)
    learned = whole.method.learned()
    assert any(np.abs(photo.response).max() > 1e-3 for photo in learned)
    np.testing.assert_allclose(np.mean([photo.response for photo in learned], 0), 0, atol=1e-9)


def test_a_new_view_in_the_look_of_a_photo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = by_two(), tmp_path / "run"
    formation = "exposure+vignetting+response"
    hqgs.train(scene, out=out, leave_out="none", method="hqgs", formation=formation, iterations=5)
    report = json.loads((out / "report.json").read_text())
    assert report["learned"][0]["name"] == "view1.png"
    own = {"gains": [0.7, 0.8, 0.9], "vignetting": [0.5, 0.1], "response": [[0.1, 0, -0.1], [0, 0.2, 0]]}
    report["learned"][0] |= own
    (out / "report.json").write_text(json.dumps(report))
    for name in ("plain", "dark"):
        look = [] if name == "plain" else ["--look", "view1"]
        arguments = ["render", str(out), "--views", "view0.png", "--out", str(tmp_path / name), *look]
        assert main(arguments) == 0
    plain, dark = (
        np.asarray(Image.open(next((tmp_path / name).iterdir()))) / 255 for name in ("plain", "dark")
    )
    look, K = look_of(out, "view1.png"), scene.test[0].camera.K
    assert look.gains.tolist() == own["gains"]
    np.testing.assert_allclose(dark, look.of(plain, K), atol=1.6 / 255)
    capsys.readouterr()
    assert main(["render", str(out), "--out", str(tmp_path / "x"), "--look", "view9"]) == 2
    assert "no exposure of a photo 'view9' was learned; there are: view1.png, " in capsys.readouterr().err
    assert main(["render", str(out / "scene.ply"), "--out", str(tmp_path / "x.png"), "--look", "view1"]) == 0
    for record in report["learned"]:
        record |= {"gains": [1.0] * 3, "vignetting": [0.0] * 2, "response": [[0.1] * 3, [0.0] * 3]}
    (out / "report.json").write_text(json.dumps(report))
    assert look_of(out, "view1").response.any()  # alone
    (out / "report.json").unlink()
    assert main(["render", str(out), "--out", str(tmp_path / "x"), "--look", "view1"]) == 2


@pytest.mark.parametrize(
    ("size", "error", "found"),
    [(0.3, 0.03, True), (0.18, 0.001, False), (0.4, 0.08, False), (9.0, 0.1, False)],
)
def test_a_lens_is_learned_that_light_does_not_feign(size: float, error: float, found: bool) -> None:
    sign = Sign("vignetting", size, error)
    finding, _ = device_findings(DeviceSigns(plain_devices([]), sign, None))
    assert finding.needed == found
