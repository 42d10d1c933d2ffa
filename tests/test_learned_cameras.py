"""What photos' cameras did: the operator, what is found before training, what is learned with the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from planned import run_config
from run_state import assert_stopped_alike, run_until
from tiny_scene import tiny_config, tiny_scene

import hqgs
from hqgs.diagnosis import colors as gains
from hqgs.diagnosis import scene as scene_diagnosis
from hqgs.diagnosis.colors import UNLIKE_GAINS, log_gains
from hqgs.diagnosis.differences import TURNED, UNLIKE, unlike_sharpness
from hqgs.diagnosis.scene import Inspector
from hqgs.photos.light import to_linear, to_srgb
from hqgs.scene.geometry import most_shown, project
from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.config import HQGSConfig
from hqgs.training.methods.cameras import LearnedCameras, take_photo
from hqgs.training.trainer import Trainer

SIZE, MARGIN = (14, 17), 3


def tensors(warps: int = 4, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, ...]:
    """A render, inverse depths, warps and gains."""
    generator = torch.Generator().manual_seed(3)
    shape = SIZE[0] + 2 * MARGIN, SIZE[1] + 2 * MARGIN, 3
    image = torch.rand(shape, generator=generator, dtype=dtype)
    near = torch.rand(SIZE, generator=generator, dtype=dtype)
    sizes = torch.tensor([[0.01, 0.02, 1, 1], [0.02, 0.01, 1, 1], [1e-4, 1e-4, 1e-3, 1e-2]])
    drawn = torch.randn((warps, 3, 4), generator=generator, dtype=torch.float64) * sizes
    return image, near, drawn, torch.tensor([0.8, 1.0, 1.3], dtype=torch.float64)


def by_definition(
    image: torch.Tensor, near: torch.Tensor, warps: torch.Tensor, gains: torch.Tensor
) -> NDArray[np.float64]:
    """The photo, pixel by pixel."""
    light, photo = to_linear(image.numpy()), np.zeros((*SIZE, 3))
    for row, column in np.ndindex(*SIZE):
        point = np.array([column + 0.5, row + 0.5, 1, float(near[row, column])])
        for warp in warps.numpy():
            x, y, w = point[:3] + warp @ point
            u, v = np.clip([x / w + MARGIN - 0.5, y / w + MARGIN - 0.5], 0, np.array(light.shape[1::-1]) - 1)
            i, j = min(int(u), light.shape[1] - 2), min(int(v), light.shape[0] - 2)
            f, g = u - i, v - j
            top = (1 - f) * light[j, i] + f * light[j, i + 1]
            bottom = (1 - f) * light[j + 1, i] + f * light[j + 1, i + 1]
            photo[row, column] += ((1 - g) * top + g * bottom) / len(warps)
    return to_srgb(photo * gains.numpy())


def test_a_photo_is_the_mean_of_the_warped_light() -> None:
    given = tensors()
    taken = take_photo(given[0], SIZE, given[1], given[2], given[3])
    np.testing.assert_allclose(taken.numpy(), by_definition(*given), atol=1e-12)
    single = take_photo(given[0].float(), SIZE, given[1].float(), given[2], given[3])
    np.testing.assert_allclose(single.numpy(), taken.numpy(), atol=2e-6)


def test_without_warps_it_is_the_middle_of_the_render() -> None:
    image, *_ = tensors()
    middle = image[MARGIN:-MARGIN, MARGIN:-MARGIN]
    ones = torch.ones(3, dtype=torch.float64)
    for warps in (torch.zeros(0, 3, 4, dtype=torch.float64), torch.zeros(2, 3, 4, dtype=torch.float64)):
        np.testing.assert_allclose(take_photo(image, SIZE, None, warps, ones), middle, atol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 4])
def test_gradients_are_those_of_differences(count: int) -> None:
    image, near, warps, gains = tensors(count)
    weights = torch.randn((*SIZE, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    given = [t.clone().requires_grad_() for t in (image, warps, gains)]

    def loss(image: torch.Tensor, warps: torch.Tensor, gains: torch.Tensor) -> torch.Tensor:
        return (take_photo(image, SIZE, near, warps, gains) * weights).sum()

    loss(*given).backward()
    for k, (tensor, step) in enumerate(zip(given, (1e-6, 1e-8, 1e-6), strict=True)):
        if not tensor.numel():
            continue
        gradient = tensor.grad
        assert gradient is not None
        for place in np.linspace(0, tensor.numel() - 1, 60).astype(int):
            sides = []
            for sign in (1, -1):
                moved = [t.detach().clone() for t in given]
                moved[k].view(-1)[place] += sign * step
                sides.append(float(loss(*moved)))
            expected = (sides[0] - sides[1]) / (2 * step)
            assert abs(expected - float(gradient.view(-1)[place])) < 1e-4 * max(abs(expected), 1)


def test_bad_tensors_are_named() -> None:
    image, near, warps, gains = tensors()
    with pytest.raises(ValueError, match="image"):
        take_photo(image[:, 1:], SIZE, near, warps, gains)
    with pytest.raises(ValueError, match="nearness"):
        take_photo(image, SIZE, near[1:], warps, gains)
    with pytest.raises(ValueError, match="nearness"):
        take_photo(image, SIZE, near * torch.nan, warps, gains)
    with pytest.raises(ValueError, match="warps"):
        take_photo(image, SIZE, near, warps[:, :2], gains)
    with pytest.raises(ValueError, match="gains"):
        take_photo(image, SIZE, near, warps, gains * torch.inf)


def textured_scene(num_views: int = 12, side: int = 96) -> Scene:
    """Cameras in a row before a plane with texture of all sizes, and points that they all see."""
    rng = np.random.default_rng(0)
    K = np.array([[float(side), 0, side / 2], [0, float(side), side / 2], [0, 0, 1]])
    big = 3 * side
    spectrum = np.fft.rfft2(rng.normal(size=(big, big, 3)), axes=(0, 1))
    frequency = np.hypot(np.fft.fftfreq(big)[:, None], np.fft.rfftfreq(big)[None])
    picture = np.fft.irfft2(spectrum / np.maximum(frequency, 1 / big)[..., None], axes=(0, 1))
    picture = np.clip(0.5 + 0.15 * picture / picture.std(), 0.05, 0.9)
    points = np.concatenate([rng.uniform(-0.4, 0.4, (400, 2)), np.ones((400, 1))], 1).astype(np.float32)
    views = []
    for k in range(num_views):
        viewmat = np.eye(4)
        viewmat[0, 3] = -k / side  # a whole pixel of the plane at depth 1
        left, top = big // 2 - side // 2 + k, big // 2 - side // 2
        photo = np.rint(255 * picture[top : top + side, left : left + side]).astype(np.uint8)
        views.append(View(f"{k:02}.png", Camera(side, side, K, viewmat), photo))
    seen = {}
    for view in views:
        where = project(view.camera, points.astype(np.float64))[0]
        seen[view.name] = np.flatnonzero(((where > 3) & (where < side - 3)).all(1))
    colors = np.full((400, 3), 128, np.uint8)
    return Scene("textured", views[1:], views[:1], points, colors, "test", seen=seen)


def with_gains(scene: Scene, logs: NDArray[np.float64]) -> Scene:
    train = [
        replace(view, image=to_srgb(to_linear(view.image / np.float32(255)) * np.exp(g, dtype=np.float32)))
        for view, g in zip(scene.train, logs.astype(np.float32), strict=True)
    ]
    return replace(scene, train=train)


def test_gains_are_found() -> None:
    scene = textured_scene()
    clean = log_gains(scene)
    assert clean is not None
    assert clean.std(axis=0).max() < UNLIKE_GAINS / 3
    logs = np.random.default_rng(1).normal(0, 0.3, (len(scene.train), 3))
    logs -= logs.mean(0)
    found = log_gains(with_gains(scene, logs))
    assert found is not None
    assert np.abs(found - logs).max() < 0.05


def test_gains_are_looked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The diagnosis and the method share what was found."""
    found: list[Any] = []
    monkeypatch.setattr(
        scene_diagnosis, "log_gains", lambda *given: found.append(log_gains(*given)) or found[-1]
    )
    scene = textured_scene()
    scene = with_gains(scene, np.random.default_rng(1).normal(0, 0.3, (len(scene.train), 3)))
    trainer = Trainer(scene, learned_config("auto", leave_out=()), Inspector())
    (logs,) = found
    begun = [camera.gains for camera in trainer.method.learned()]
    np.testing.assert_allclose(begun, np.exp(logs))


def test_gains_of_many_photos_come_from_the_points_that_most_of_them_show(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The tables stay small, and the gains are found all the same."""
    scene = textured_scene()
    assert scene.seen is not None
    shown = np.bincount(np.concatenate([scene.seen[view.name] for view in scene.train]))
    most = 200
    monkeypatch.setattr(gains, "MOST_VALUES", most * len(scene.train))
    shared = gains.shared_colors(scene)
    assert shared is not None
    assert shared.squares.shape[1] == most < len(scene.points)
    chosen = most_shown(len(scene.points), scene.seen, scene.train, most)
    assert shown[chosen].min() >= np.delete(shown, chosen).max()
    logs = np.random.default_rng(1).normal(0, 0.3, (len(scene.train), 3))
    logs -= logs.mean(0)
    found = log_gains(with_gains(scene, logs))
    assert found is not None
    assert np.abs(found - logs).max() < 0.05


def test_gains_that_neighbours_share_are_the_scenes_own() -> None:
    scene = textured_scene()
    slow = np.linspace(-0.4, 0.4, len(scene.train))[:, None] * np.ones(3)
    found = log_gains(with_gains(scene, slow))
    assert found is not None
    assert np.abs(found).max() < UNLIKE_GAINS


def test_gains_that_go_together_by_chance_are_the_photos_own() -> None:
    """Brightness that is drawn anew for each photo, all channels alike, is not taken for the scene's."""
    views = textured_scene(20).train
    drawn = np.zeros((len(views), 3))
    for seed in range(100):
        drawn = np.random.default_rng(seed).uniform(-0.7, 0.7, (len(views), 1)) * np.ones(3)
        drawn -= drawn.mean(0)
        kept = gains._apart(views, drawn)  # pyright: ignore[reportPrivateUsage]
        assert np.abs(kept - drawn).max() < 0.3
    # With its tint the light itself gives away that it changes along the way.
    slow = np.linspace(-1, 1, len(views))[:, None] * np.array([0.3, 0.45, 0.6])
    found = gains._apart(views, drawn + slow)  # pyright: ignore[reportPrivateUsage]
    assert np.sqrt(np.square(found - drawn).mean()) < np.sqrt(np.square(slow).mean()) / 2


def test_gains_need_points_that_photos_share() -> None:
    scene = textured_scene()
    assert log_gains(replace(scene, seen=None)) is None
    assert log_gains(replace(scene, seen={v.name: np.arange(5) for v in scene.train})) is None


@pytest.mark.parametrize(
    ("kind", "unlike"),
    [
        ("none", False),
        ("noise:10", False),
        ("blur:1.5", False),
        ("jpeg:20", False),
        ("shake:8", True),
        ("some:defocus:3", False),
        ("some:shake:8", True),
    ],
)
def test_photos_that_were_shaken_differ_in_sharpness(kind: str, unlike: bool) -> None:
    found = unlike_sharpness(hqgs.degrade(textured_scene(), kind))
    assert found is not None
    sharpness, direction = found
    assert (sharpness >= UNLIKE and direction >= TURNED) == unlike
    assert (sharpness >= UNLIKE) == (unlike or kind.startswith("some"))


def test_the_diagnosis_names_both() -> None:
    scene = hqgs.degrade(textured_scene(), "shake:8+exposure")
    diagnosis = hqgs.diagnose(scene)
    assert diagnosis.formation == "exposure+shake"
    clean = {part.name: part.needed for part in hqgs.diagnose(textured_scene()).parts}
    assert not clean["exposure"]
    assert not clean["shake"]
    assert unlike_sharpness(replace(scene, train=scene.train[:3])) is None


def learned_config(formation: str, **changes: Any) -> Any:
    return tiny_config(method="hqgs", hqgs=HQGSConfig(formation=formation), **changes)


def run(scene: Scene, formation: str, **changes: Any) -> Trainer:
    return run_until(Trainer(scene, learned_config(formation, **changes)))


def test_a_resumed_run_is_the_same_bit_for_bit(tmp_path: Path) -> None:
    scene = hqgs.degrade(tiny_scene(), "shake:3+exposure")
    assert_stopped_alike(lambda: Trainer(scene, learned_config("shake+focus+exposure")), tmp_path, 17)


def test_gains_keep_their_mean_and_come_near_the_truth() -> None:
    scene = tiny_scene()
    logs = np.linspace(-0.5, 0.5, len(scene.train))[[0, 3, 1, 4, 2], None] * np.ones(3)
    trainer = run(with_gains(scene, logs), "exposure", iterations=400)
    found = np.log([photo.gains for photo in trainer.method.learned()])
    assert np.abs(found.mean(0)).max() < 1e-9
    assert np.corrcoef(found.ravel(), logs.ravel())[0, 1] > 0.9


def moved_along(scene: Scene, ways: Sequence[NDArray[np.float64]]) -> Scene:
    """Each photo the mean of itself, moved along a straight way in px."""
    train = []
    for view, way in zip(scene.train, ways, strict=True):
        light, total = to_linear(view.image / np.float32(255)), 0.0
        for t in np.linspace(-0.5, 0.5, 9):
            dx, dy = np.rint(t * way).astype(int)
            total = total + np.roll(light, (dy, dx), (0, 1)) / 9
        train.append(replace(view, image=to_srgb(np.asarray(total, np.float32))))
    return replace(scene, train=train)


def trained(scene: Scene, formation: str) -> Trainer:
    config = run_config(iterations=400, method="hqgs", leave_out="none", formation=formation)
    return run_until(Trainer(scene, config))


def test_ways_are_learned_and_the_scene_gets_sharper() -> None:
    clean = textured_scene(10, 64)
    rng = np.random.default_rng(4)
    angles = rng.uniform(0, np.pi, len(clean.train))
    ways = [8 * np.array([np.cos(a), np.sin(a)]) for a in angles]
    shaken = moved_along(clean, ways)
    plain, learned, still = (trained(shaken, "none"), trained(shaken, "shake"), trained(clean, "shake"))
    cosines = []
    for photo, way in zip(learned.method.learned(), ways, strict=True):
        along = photo.trajectory[-1] - photo.trajectory[0]
        cosines.append(abs(along @ way) / (np.linalg.norm(along) * 8 + 1e-9))
    assert np.median(cosines) > 0.9
    moved, rested = ([photo.extent for photo in t.method.learned()] for t in (learned, still))
    assert np.median(rested) < 0.3 * np.median(moved)
    for trainer in (plain, learned):
        trainer.evaluate()
    assert learned.history[-1]["psnr"] > plain.history[-1]["psnr"] + 0.5  # type: ignore[operator]


@pytest.mark.parametrize("formation", ["exposure+lowres:2", "exposure+shake+blur:1+noise:5", "focus+jpeg:30"])
def test_other_steps_come_after_the_camera(formation: str) -> None:
    scene = tiny_scene()
    degraded = hqgs.degrade(scene, formation.replace("focus", "defocus:1"))
    trainer = run(degraded, formation, iterations=20)
    assert trainer.state.guard.skipped == 0
    assert trainer.config.hqgs.formation == formation
    assert len(trainer.method.learned()) == len(scene.train)


def test_without_photos_to_hold_back_a_run_has_a_length() -> None:
    config = replace(learned_config("shake"), leave_out=("photos", "iterations"), iterations=30_000)
    trainer = Trainer(tiny_scene(), config)
    assert trainer.length == 7_000
    assert any("iterations 7001" in item.what for item in trainer.left_out())


def test_cameras_of_other_sizes_stay_still() -> None:
    scene = tiny_scene()
    cameras = LearnedCameras(scene, True, True, None, 0)
    view = replace(scene.train[0], camera=replace(scene.train[0].camera, width=12))
    assert cameras.shot(view, torch.zeros(16, 12, 3)).camera is view.camera


# --- Where the colours are read that tell the gains of photos


@pytest.mark.parametrize(("x", "y"), [(20.5, 9.5), (7.5, 13.5), (16.0, 11.25)])
def test_a_points_colour_is_that_of_its_own_pixels(x: float, y: float) -> None:
    """A photo whose light rises with x and, faster, with y; pixels' centres lie at halves."""
    width, height, focal = 40, 24, 30.0
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    rows, columns = np.mgrid[:height, :width] + 0.5
    light = (0.1 + 0.005 * columns + 0.015 * rows)[..., None] * np.array([1.0, 0.9, 0.8])
    view = View("ramp.png", Camera(width, height, K, np.eye(4)), to_srgb(light.astype(np.float32)))
    depth = 2.0
    points = np.array([[(x - width / 2) * depth / focal, (y - height / 2) * depth / focal, depth]])
    colors = np.full((3, 3), np.nan)
    squares, depths = np.full((2, 3), np.nan)
    gains._note_colors(view, points, np.array([1]), colors, squares, depths)  # pyright: ignore[reportPrivateUsage]
    expected = (0.1 + 0.005 * x + 0.015 * y) * np.array([1.0, 0.9, 0.8])
    np.testing.assert_allclose(colors[1], expected, rtol=1e-4)
    assert np.isnan(colors[[0, 2]]).all()
    away = (x - width / 2) ** 2 + (y - height / 2) ** 2  # half the diagonal is 1
    np.testing.assert_allclose(squares[1], away / (width**2 + height**2) * 4)
    assert depths[1] == np.log(depth)
