"""The paper's method: ESFG by its equations, the rows of the Gaussians, its runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from example_method import install, loss_of
from numpy.typing import NDArray
from run_state import assert_stopped_alike, run_until
from tiny_scene import HEIGHT, WIDTH, tiny_config, tiny_scene
from torch import Tensor

import hqgs.training.densify as densify_module
from hqgs.base.files import PLY
from hqgs.model.gaussians import Gaussians
from hqgs.pipeline import open_run, run_to_end
from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.adam import Adam
from hqgs.training.config import DensifyConfig
from hqgs.training.densify import Densifier
from hqgs.training.methods import paper as esfg_module
from hqgs.training.methods import paper as paper_module
from hqgs.training.methods.paper import (
    ESFG,
    SCS_CACHE_BYTES,
    PaperHQGS,
    edge_magnitude,
    scs_loss,
    scs_weights,
)
from hqgs.training.methods.photometric import photometric_loss
from hqgs.training.trainer import Trainer

SMALL = 20  # F: more than once in the 40 points of the tiny scene


class Fast(PaperHQGS):
    """Whose F' moves fast enough to be seen."""

    def param_groups(self) -> list[dict[str, Any]]:
        return [group | {"lr": 1e-2} for group in super().param_groups()]


@pytest.fixture(autouse=True)
def methods(monkeypatch: pytest.MonkeyPatch) -> None:
    """The method with a small F, and the fast one."""
    features(monkeypatch, SMALL)
    for name, kind in (("paper", PaperHQGS), ("fast", Fast)):
        install(monkeypatch, name, maker(kind))


def features(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    for module in (esfg_module, paper_module):
        monkeypatch.setattr(module, "FEATURES", count)


def maker(kind: type[PaperHQGS]) -> Any:
    return lambda scene, config, inspector: kind(scene, config.seed)


def view(image: NDArray[Any], mask: NDArray[np.bool_] | None = None, name: str = "a.png") -> View:
    height, width = image.shape[:2]
    return View(name, Camera(width, height, np.diag([9.0, 9.0, 1.0]), np.eye(4)), image, mask)


def noisy(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def paper(trainer: Trainer) -> PaperHQGS:
    assert isinstance(trainer.method, PaperHQGS)
    return trainer.method


def bits(trainer: Trainer) -> dict[str, bytes]:
    tensors = trainer.gaussians.named() | trainer.method.state_dict()
    return {name: t.detach().numpy().tobytes() for name, t in tensors.items()}


def run(method: str = "paper", count: int = 30, scene: Scene | None = None, **changes: Any) -> Trainer:
    trainer = run_until(Trainer(scene or tiny_scene(), tiny_config(method=method, **changes)), count)
    return trainer


# --- F' ---


@pytest.mark.parametrize("sizes", [[(1, 1)], [(3, 5), (40, 7)], [(16, 24)] * 3, [(1, 50), (37, 1), (33, 65)]])
def test_any_views_of_any_size(sizes: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch) -> None:
    features(monkeypatch, 50)
    views = [view(noisy(h, w, i)) for i, (h, w) in enumerate(sizes)]
    esfg = ESFG(views, 0)
    feature = esfg()
    assert feature.shape == (50, 3)
    assert torch.isfinite(feature).all()


def test_tokens_are_runs_of_averaged_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    features(monkeypatch, 24)
    image = noisy(8, 12)
    esfg = ESFG([view(image)], 0)
    for tokens, photo in (
        (esfg.photo_tokens, image / 255),
        (esfg.edge_tokens, edge_magnitude(torch.from_numpy(image)).numpy() * (image / np.float32(255))),
    ):
        blocks = photo.reshape(4, 2, 6, 2, 3).mean(axis=(1, 3))  # 24 pixels for 12 tokens
        np.testing.assert_allclose(tokens, blocks.reshape(12, 2, 3).mean(axis=1), atol=1e-6)


def test_a_photo_of_one_colour_has_no_edge_tokens() -> None:
    image = np.full((9, 7, 3), [10, 200, 30], dtype=np.uint8)
    esfg = ESFG([view(image)], 0)
    np.testing.assert_allclose(esfg.photo_tokens, np.broadcast_to(image[0, 0] / 255, (10, 3)), atol=1e-6)
    assert esfg.edge_tokens.abs().max() == 0


def test_masked_pixels_play_no_part() -> None:
    mask = np.ones((20, 22), dtype=bool)
    mask[3:12, 5:15] = False
    image, other = noisy(20, 22), noisy(20, 22)
    other[~mask] = 0
    whole, empty = noisy(11, 9, 1), np.zeros((11, 9), dtype=bool)
    one, two = (ESFG([view(i, mask), view(whole)], 0) for i in (image, other))
    assert torch.equal(one.photo_tokens, two.photo_tokens)
    assert torch.equal(one.edge_tokens, two.edge_tokens)
    skipped = ESFG([view(image, mask), view(whole), view(whole, empty)], 0)
    assert torch.equal(one(), skipped())
    with pytest.raises(ValueError, match="the masks of all 1 views are empty"):
        ESFG([view(whole, empty)], 0)


def mlp(layers: Any, x: NDArray[np.float64]) -> NDArray[np.float64]:
    (w0, b0), (w1, b1) = ((layer.weight, layer.bias) for layer in (layers[0], layers[2]))
    w0, b0, w1, b1 = (t.detach().numpy() for t in (w0, b0, w1, b1))
    return np.maximum(x @ w0.T + b0, 0) @ w1.T + b1


def test_the_feature() -> None:
    esfg = ESFG([view(noisy(13, 17, i)) for i in range(3)], 3).double()
    saf, eaf = mlp(esfg.saf, esfg.photo_tokens.numpy()), mlp(esfg.eaf, esfg.edge_tokens.numpy())
    wq, wk, wv = (p.weight.detach().numpy() for p in (esfg.query, esfg.key, esfg.value))
    weight = np.exp((eaf @ wq.T) @ (saf @ wk.T).T / np.sqrt(3))
    attended = weight / weight.sum(axis=1, keepdims=True) @ (saf @ wv.T)
    np.testing.assert_allclose(esfg().detach().numpy(), np.concatenate([attended, eaf]), atol=1e-12)
    esfg().square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in esfg.parameters())


def test_the_seed_alone_decides() -> None:
    views = [view(noisy(9, 9))]
    torch.manual_seed(1)
    before = torch.get_rng_state()
    one, two, other = (ESFG(views, seed)() for seed in (5, 5, 6))
    assert torch.equal(one, two)
    assert not torch.equal(one, other)
    assert torch.equal(torch.get_rng_state(), before)


# --- the modulation ---


def test_the_modulation_and_its_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene()
    features(monkeypatch, 8)
    esfg = ESFG(scene.train, 0).double()
    means = torch.from_numpy(scene.points[:11].astype(np.float64)).requires_grad_()
    rows = torch.arange(11) * 3 % 8
    out = esfg.modulate(means, rows)
    center = np.mean([v.camera.center for v in scene.train], axis=0)
    s = 1 / (1 + np.exp(-esfg().detach().numpy()[rows]))
    mu = means.detach().numpy() - center
    np.testing.assert_allclose(out.detach().numpy() - center, mu + s * mu, atol=1e-6)  # center is float32
    back = esfg.unmodulate(out.detach(), rows)
    torch.testing.assert_close(back, means.detach(), rtol=0, atol=1e-12)

    names = [name for name, _ in esfg.named_parameters()]

    def modulated(means: Tensor, *parameters: Tensor) -> Tensor:
        class Modulate(torch.nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.esfg = esfg

            def forward(self, means: Tensor) -> Tensor:
                return self.esfg.modulate(means, rows)

        values = {f"esfg.{name}": p for name, p in zip(names, parameters, strict=True)}
        return torch.func.functional_call(Modulate(), values, (means,))

    inputs = (means, *(p.detach().clone().requires_grad_() for p in esfg.parameters()))
    assert torch.autograd.gradcheck(modulated, inputs, eps=1e-6, atol=1e-7, fast_mode=True)


def test_training_starts_from_the_cloud_that_colmap_gave() -> None:
    scene = tiny_scene()
    trainer = Trainer(scene, tiny_config(method="paper"))
    first = trainer.method.modulate(trainer.gaussians)
    np.testing.assert_allclose(first.means.detach().numpy(), scene.points, atol=2e-6)
    again = trainer.method.modulate(trainer.gaussians)
    assert torch.equal(first.means, again.means)
    # About two thirds of the way from the frame's origin.
    center = np.mean([v.camera.center for v in scene.train], axis=0)
    ratio = (trainer.gaussians.means.detach().numpy() - center) / (scene.points - center)
    assert np.all((ratio > 0.5) & (ratio < 0.9))
    plain = Trainer(scene, tiny_config()).gaussians
    for name in ("scales", "quats", "opacities", "sh0", "shN"):
        assert getattr(first, name) is getattr(trainer.gaussians, name)
        assert torch.equal(getattr(first, name), getattr(plain, name))


def moved(scene: Scene, shift: NDArray[np.float64], scale: float) -> Scene:
    """The same scene where a point X has become scale X + shift."""

    def camera(c: Camera) -> Camera:
        viewmat = c.viewmat.copy()
        viewmat[:3, 3] = scale * viewmat[:3, 3] - viewmat[:3, :3] @ shift
        return replace(c, viewmat=viewmat)

    train, test = (
        [replace(v, camera=camera(v.camera)) for v in views] for views in (scene.train, scene.test)
    )
    points = (scale * scene.points.astype(np.float64) + shift).astype(np.float32)
    return Scene(scene.name, train, test, points, scene.point_colors, scene.source)


@pytest.mark.parametrize(
    ("shift", "scale"), [([30.0, -7.0, 11.0], 1.0), ([0.0, 0.0, 0.0], 50.0), ([-9.0, 4.0, 2.0], 0.1)]
)
def test_the_origin_and_the_unit_of_the_world_change_nothing(shift: list[float], scale: float) -> None:
    renders = []
    rng = np.random.default_rng(0)
    plane = tiny_scene()  # on which rounding decides which point is in front
    depths = np.linspace(0, 0.5, len(plane.points), dtype=np.float32)
    solid = replace(plane, points=plane.points + rng.permutation(depths)[:, None] * np.array([0, 0, 1], "f4"))
    for scene in (solid, moved(solid, np.array(shift, dtype=np.float64), scale)):
        # Without split or clone: which Gaussian passes a threshold may hang on a rounding.
        trainer = Trainer(scene, tiny_config(method="fast", densify=DensifyConfig(stop=0)))
        at_start = trainer.held_out()[0].render
        method = paper(trainer)
        before = method.esfg().detach()
        for _ in range(12):
            trainer.step()
        assert (method.esfg() - before).abs().max() > 0.05  # the modulation itself has moved
        renders.append((at_start, trainer.held_out()[0].render))
    (start, trained), (start_moved, trained_moved) = renders
    np.testing.assert_allclose(start_moved, start, atol=2e-4)
    np.testing.assert_allclose(trained_moved, trained, atol=5e-3)
    assert np.abs(trained - start).max() > 0.1


# --- which row a Gaussian reads ---


def gaussians(count: int) -> Gaussians:
    rng = np.random.default_rng(7)
    points = rng.normal(size=(count, 3)).astype(np.float32)
    made = Gaussians.from_points(points, np.zeros((count, 3), dtype=np.uint8), 1)
    made.sh0[:, 0, 0] = torch.arange(count) + 0.5  # tells who stems from whom
    made.scales += torch.from_numpy(rng.normal(0, 0.7, (count, 3))).float()
    made.opacities = torch.from_numpy(rng.normal(-3, 2, count)).float()
    return made


def test_f_is_replicated_over_the_first_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    features(monkeypatch, 8)
    for points, expected in ((18, [*range(8), *range(8), 0, 1]), (4, [0, 1, 2, 3])):
        scene = tiny_scene(num_points=points)
        method = PaperHQGS(scene, 0)
        method.start(Gaussians.from_points(scene.points, scene.point_colors, 3), 30)
        assert method.rows.tolist() == expected


def test_growth_tells_whom_each_gaussian_stems_from() -> None:
    scene = gaussians(200)
    optimizer = Adam(
        [{"name": n, "params": [t.requires_grad_()], "lr": 0.1} for n, t in scene.named().items()]
    )
    config = DensifyConfig(start=0, every=1, percent_dense=0.1, grad_threshold=0.5, prune_opacity=0.02)
    densifier = Densifier(config, 1.0, 1.0, 0, len(scene))
    origin = torch.arange(200)
    lost = grown = 0
    for iteration in range(1, 5):
        densifier.grad_sum = torch.from_numpy(np.random.default_rng(iteration).random(len(scene))).float()
        densifier.count = torch.ones(len(scene))
        growth = densifier.update(iteration, scene, optimizer)
        lost, grown = lost + growth.pruned, grown + min(growth.cloned, growth.split)
        assert growth.parents is not None
        origin = origin[growth.parents]
        assert torch.equal(origin, scene.sh0.detach()[:, 0, 0].long())
    bad = torch.from_numpy(np.random.default_rng(9).random(len(scene)) < 0.5)
    origin = origin[densifier.remove(bad, scene, optimizer)]
    assert torch.equal(origin, scene.sh0.detach()[:, 0, 0].long())
    assert lost > 20
    assert grown > 20
    densifier.grad_sum = torch.zeros(len(scene))
    assert densifier.update(5, scene, optimizer).parents is None  # the round before took all that goes


@pytest.mark.parametrize("same_colour", [False, True])
def test_rows_in_a_run_that_grows_and_prunes(monkeypatch: pytest.MonkeyPatch, same_colour: bool) -> None:
    expected = torch.arange(40) % SMALL
    split = pruned = 0
    real = densify_module.select_rows

    def spy(gaussians: Gaussians, optimizer: Any, rows: Tensor, old: int) -> None:
        nonlocal expected, split, pruned
        split += len(rows) > old < len(gaussians)
        pruned += len(rows) < len(gaussians)
        expected = expected[rows]
        real(gaussians, optimizer, rows, old)

    monkeypatch.setattr(densify_module, "select_rows", spy)
    scene = tiny_scene()
    if same_colour:  # as random points have
        scene = replace(scene, point_colors=np.full_like(scene.point_colors, 128))
    config = tiny_config(method="fast")
    trainer = Trainer(scene, replace(config, densify=replace(config.densify, prune_opacity=0.09)))
    for _ in range(11):  # a round, and on
        trainer.step()
        assert torch.equal(paper(trainer).rows, expected)
    assert split == pruned == 1


# --- runs ---


def test_a_resumed_run_has_the_same_bits(tmp_path: Path) -> None:
    """16 and 24 end with a change of the set of Gaussians."""
    assert_stopped_alike(lambda: Trainer(tiny_scene(), tiny_config(method="fast")), tmp_path, 0, 5, 16, 24)


def test_the_ply_holds_what_is_rasterized(tmp_path: Path) -> None:
    with open_run(tiny_scene(), tiny_config(6, method="paper"), tmp_path) as trainer:
        run_to_end(trainer, tmp_path)
        shown = trainer.shown().means
        assert torch.equal(Gaussians.load(tmp_path / PLY).means, trainer.model().means)
    assert (shown - trainer.gaussians.means).abs().max() > 0.5


def test_held_out_views_get_better() -> None:
    trainer = Trainer(
        tiny_scene(num_points=80), tiny_config(150, method="paper", densify=DensifyConfig(stop=0))
    )
    trainer.evaluate()
    for _ in range(150):
        trainer.step()
    trainer.evaluate()
    first, last = trainer.history
    assert (last["psnr"] or 0) > (first["psnr"] or np.inf) + 5
    assert trainer.state.guard.skipped == 0


def test_the_features_are_trained_at_their_own_rate() -> None:
    trainer = run("paper", 1)
    group = trainer.state.optimizer.param_groups[-1]
    assert (group["name"], group["lr"]) == ("esfg", 1e-6)
    fresh = ESFG(tiny_scene().train, 0)
    for (name, new), old in zip(fresh.named_parameters(), group["params"], strict=True):
        step = (old - new).abs()
        assert 5e-7 < step.max() < 1.5e-6, name  # Adam's first step is the rate


def test_the_loss() -> None:
    mask = np.random.default_rng(0).random((HEIGHT, WIDTH)) < 0.8
    photo = tiny_scene().train[0]
    render = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    for found in (
        photo,
        replace(photo, mask=mask),
        replace(photo, image=(photo.image / 255).astype(np.float32)),
    ):
        image = torch.from_numpy(found.image)
        counted = None if found.mask is None else torch.from_numpy(found.mask)
        scs = scs_loss(render, image, scs_weights(image, counted)).item()
        assert scs > 0.01
        wanted = photometric_loss(render, image, counted, 0.0).item() + 5 * scs
        method = PaperHQGS(tiny_scene(), 0)
        for _ in range(2):  # the second time from the cache
            assert loss_of(method, render, found).item() == pytest.approx(wanted, rel=1e-6)


def test_views_of_one_name_are_not_confused() -> None:
    method = PaperHQGS(tiny_scene(), 0)
    a, b = view(noisy(9, 8, 0)), view(noisy(9, 8, 1))
    render = torch.rand(9, 8, 3, generator=torch.Generator().manual_seed(0))
    for v in (a, b, a, b):
        alone = PaperHQGS(tiny_scene(), 0)
        assert loss_of(method, render, v).item() == loss_of(alone, render, v).item()


def test_weights_beyond_the_memory_for_them_are_computed_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for room in (SCS_CACHE_BYTES, 0):
        monkeypatch.setattr("hqgs.training.methods.paper.SCS_CACHE_BYTES", room)
        found.append(bits(run("paper", 8)))
    assert found[0] == found[1]
