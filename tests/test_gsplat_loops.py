"""Training loops written for gsplat: packed meta data, and its own strategies from PyPI."""

from __future__ import annotations

import copy
import math
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scenes import GaussianScene, random_scene
from torch import Tensor

import hqgs
from hqgs.base.threads import one_torch_thread
from hqgs.model.gsplat_kernels import relocation
from hqgs.model.meta import RasterizationMeta

F32, F64 = torch.float32, torch.float64
PER_SPLAT = ("means2d", "radii", "depths", "conics", "opacities")


@pytest.mark.parametrize("batch", [(), (2,)])
def test_packed_holds_what_is_not_culled(batch: tuple[int, ...]) -> None:
    scenes = [random_scene(60, 24, 17, 3, seed=seed, dtype=F64).with_grad("means") for seed in range(2)]
    options: dict[str, Any] = scenes[0].arguments()
    if batch:
        for name, value in options.items():
            if isinstance(value, Tensor):
                options[name] = torch.stack([getattr(scene, name) for scene in scenes])
    image, alphas, meta = hqgs.rasterization(**{**options, "packed": True})
    plain_image, plain_alphas, plain = hqgs.rasterization(**{**options, "packed": False})
    assert torch.equal(image, plain_image)
    assert torch.equal(alphas, plain_alphas)
    seen = (plain["radii"] > 0).all(-1)
    assert 0 < int(seen.sum()) < seen.numel()
    for name in PER_SPLAT:
        assert torch.equal(meta[name], plain[name][seen]), name
    where = (meta["batch_ids"], meta["camera_ids"], meta["gaussian_ids"])[0 if batch else 1 :]
    assert torch.equal(torch.stack(where, -1), seen.nonzero())  # pyright: ignore
    assert (meta["n_batches"], meta["n_cameras"]) == (math.prod(batch), 3)
    assert (meta["tile_width"], meta["tile_height"]) == (2, 2)
    for each, picture in ((meta, image), (plain, plain_image)):
        each["means2d"].retain_grad()
        picture.square().sum().backward()
    assert plain["means2d"].grad is not None
    assert meta["means2d"].grad is not None
    assert meta["means2d"].grad.abs().max() > 0
    assert torch.equal(meta["means2d"].grad, plain["means2d"].grad[seen])


def test_packed_gradients_and_absgrad_are_those_of_the_plain() -> None:
    found = []
    for packed in (True, False):
        scene = random_scene(60, 24, 17, 3, seed=1, dtype=F64).with_grad("means", "colors")
        image, _, meta = hqgs.rasterization(**scene.arguments(packed=packed), absgrad=True)
        image.square().sum().backward()
        found.append((scene.means.grad, scene.colors.grad, meta["means2d"].absgrad, meta["radii"]))  # pyright: ignore
    (means, colors, absgrad, _), (plain_means, plain_colors, plain_absgrad, radii) = found
    assert torch.equal(means, plain_means)
    assert torch.equal(colors, plain_colors)
    assert torch.equal(absgrad, plain_absgrad[(radii > 0).all(-1)])


def packed_scene() -> tuple[Tensor, RasterizationMeta, GaussianScene]:
    scene = random_scene(60, 24, 17, 3, seed=1, dtype=F64).with_grad("means")
    image, _, meta = hqgs.rasterization(**scene.arguments(packed=True))
    return image, meta, scene


@pytest.mark.parametrize(
    "copied",
    [
        dict,
        lambda meta: {**meta},
        lambda meta: dict(**meta),
        lambda meta: dict(meta.items()),
        lambda meta: dict(zip(meta.keys(), meta.values(), strict=True)),
        lambda meta: {key: meta.get(key) for key in meta},
        lambda meta: meta | {},
        lambda meta: {} | meta,
        lambda meta: meta.copy(),
        copy.copy,
        lambda meta: pickle.loads(pickle.dumps(meta)),
        lambda meta: {key: meta.pop(key) for key in [*meta]},
    ],
)
def test_packed_meta_data_are_a_dictionary(copied: Callable[[Any], dict[str, Any]]) -> None:
    plain = hqgs.rasterization(**packed_scene()[2].arguments())[2]
    seen, lazy = (plain["radii"] > 0).all(-1), packed_scene()[1]
    assert (len(lazy), "radii" in lazy, "ids" in lazy) == (len(plain), True, False)
    found = copied(lazy)
    assert [*found] == [*plain]
    for name in PER_SPLAT:
        assert torch.equal(found[name], plain[name][seen]), name
    assert torch.equal(torch.stack([found["camera_ids"], found["gaussian_ids"]], 1), seen.nonzero())
    assert "torch" not in repr(found["width"])
    assert "tensor" in repr(packed_scene()[1])


@pytest.mark.parametrize("grad", ["retained", "hook", "asked for", "of the copy"])
def test_the_gradient_of_the_positions_is_there_for_whoever_asks(grad: str) -> None:
    image, meta, _ = packed_scene()
    plain_image, _, plain = hqgs.rasterization(**packed_scene()[2].with_grad("means").arguments())
    (wanted,) = torch.autograd.grad(plain_image.square().sum(), plain["means2d"])
    found, loss = list[Tensor](), image.square().sum()
    if grad == "asked for":
        found += torch.autograd.grad(loss, meta["means2d"])
    elif grad == "hook":
        meta["means2d"].register_hook(found.append)
        loss.backward()
    else:
        positions: Any = dict(meta)["means2d"] if grad == "of the copy" else meta["means2d"]
        positions.retain_grad()
        loss.backward()
        found.append(positions.grad)
    assert torch.equal(found[0], wanted[(plain["radii"] > 0).all(-1)])


def test_meta_data_read_late_and_losses_on_them() -> None:
    gradients = []
    for late in (False, True):
        image, meta, scene = packed_scene()
        if late:
            image.square().sum().backward(retain_graph=True)
            with torch.no_grad():
                depths = meta["depths"]
            scene.means.grad = None
        else:
            depths = meta["depths"]
        (image.square().sum() + depths.sum() + meta["means2d"].sum() + meta["conics"].sum()).backward()
        gradients.append(scene.means.grad)
    plain = packed_scene()[2].with_grad("means")
    image, _, meta = hqgs.rasterization(**plain.arguments())
    seen = (meta["radii"] > 0).all(-1)
    losses = [meta[name][seen].sum() for name in ("depths", "means2d", "conics")]
    (image.square().sum() + losses[0] + losses[1] + losses[2]).backward()
    for gradient in gradients:
        torch.testing.assert_close(gradient, plain.means.grad, rtol=1e-12, atol=1e-12)


NO_THREADS_OF_TORCH = """
import os, sys, torch, hqgs
import numpy as np
torch.set_num_threads(1)
sys.path.insert(0, "tests")
from scenes import GaussianScene, random_scene

def threads():
    return len(os.listdir("/proc/self/task"))

scene = random_scene(40_000, 300, 200, 2, dtype=torch.float32).with_grad("means", "colors", "opacities")
covars = torch.eye(3).repeat(40_000, 1, 1).mul_(1e-4).requires_grad_()
modes = [{"render_mode": mode} for mode in ("D", "ED", "RGB+ED")]
before = 1 << 20
torch.set_num_threads(3)
for options in [{"covars": covars}, {"covars": covars}, {}, {"absgrad": True}, *modes]:
    image, alphas, meta = hqgs.rasterization(**scene.arguments(packed=True, **options))
    [*meta.values()]
    nothing = [torch.from_numpy(np.zeros(t.shape, np.float32)) for t in (image, alphas)]
    torch.autograd.backward([image, alphas], nothing)
    scene.means.grad = scene.colors.grad = scene.opacities.grad = covars.grad = None
    assert threads() <= before, options
    before = threads()  # after the first call those of the crate and of SciPy are there
torch.zeros(1 << 20).exp()
assert threads() > before  # what would be seen
assert torch.get_num_threads() == 3
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="no list of threads")
def test_no_thread_of_torch_wakes_up() -> None:
    """They spin for milliseconds after their work, on the cores of the crate's."""
    environment = {k: v for k, v in os.environ.items() if k not in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
    command = [sys.executable, "-c", NO_THREADS_OF_TORCH]
    subprocess.run(command, check=True, cwd=Path(__file__).parent.parent, env=environment, timeout=300)


@pytest.mark.parametrize(("opacity", "count"), [(0.3, 2), (0.9, 7), (0.999, 51), (0.6, 1)])
def test_relocation_keeps_alpha_along_a_line(opacity: float, count: int) -> None:
    """By numerical integration of what is seen of one, and of `count` at one place."""
    binoms = torch.tensor([[math.comb(n, k) for k in range(51)] for n in range(51)], dtype=F32)
    arguments = torch.tensor([opacity], dtype=F64), torch.full((1, 3), 0.7, dtype=F64)
    new, scales = relocation(*arguments, torch.tensor([count], dtype=torch.int32), binoms, 51)
    x = np.linspace(-20, 20, 20_001)
    one = opacity * np.exp(-0.5 * (x / 0.7) ** 2)
    many = 1 - (1 - float(new) * np.exp(-0.5 * (x / float(scales[0, 0])) ** 2)) ** count
    assert many.max() == pytest.approx(opacity)
    assert many.sum() == pytest.approx(one.sum(), rel=1e-6)


@one_torch_thread()
def fit(name: str, packed: bool, steps: int = 240) -> tuple[list[float], list[int], Tensor]:
    """Losses, numbers of Gaussians and last means of a loop as gsplat's example has it."""
    gsplat = pytest.importorskip("gsplat")
    torch.manual_seed(0)
    y, x = torch.meshgrid(torch.linspace(0, 1, 40), torch.linspace(0, 1, 40), indexing="ij")
    target = torch.stack([x, y, 0.5 + 0.5 * torch.sin(25 * x) * torch.sin(20 * y)], -1)[None]
    n, rates = 150, {"means": 5e-3, "scales": 1e-2, "quats": 1e-3, "opacities": 3e-2, "colors": 2e-2}
    values = {
        "means": torch.cat([torch.rand(n, 2) - 0.5, 1 + 0.1 * torch.rand(n, 1)], 1),
        "scales": torch.full((n, 3), math.log(0.05)),
        "quats": torch.randn(n, 4),
        "opacities": torch.zeros(n),
        "colors": torch.rand(n, 3),
    }
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in values.items()})
    optimizers = {key: torch.optim.Adam([params[key]], lr=rate, eps=1e-15) for key, rate in rates.items()}
    every: dict[str, Any] = {"refine_start_iter": 20, "refine_every": 40}
    if name == "MCMCStrategy":
        hqgs.gsplat_on_cpu()
        strategy, how = gsplat.MCMCStrategy(cap_max=220, noise_lr=1.0, **every), {"lr": rates["means"]}
    else:
        strategy, how = gsplat.DefaultStrategy(reset_every=150, **every), {"packed": packed}
    strategy.check_sanity(params, optimizers)
    state, losses, counts = strategy.initialize_state(), [], []
    for step in range(steps):
        image, _, info = hqgs.rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            params["colors"],
            torch.eye(4)[None],
            torch.tensor([[[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]]),
            40,
            40,
            packed=packed,
        )
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (image - target).square().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, **how)
        losses.append(loss.item())
        counts.append(len(params["means"]))
    return losses, counts, params["means"].detach()


def test_the_default_strategy_of_gsplat_runs_unchanged() -> None:
    losses, counts, means = fit("DefaultStrategy", packed=False, steps=170)
    assert np.mean(losses[100:140]) < 0.3 * losses[0]
    assert max(counts) > 150  # it grows
    packed_losses, packed_counts, packed_means = fit("DefaultStrategy", packed=True, steps=170)
    assert (packed_losses, packed_counts) == (losses, counts)
    assert torch.equal(packed_means, means)


def test_the_mcmc_strategy_of_gsplat_runs_unchanged() -> None:
    losses, counts, means = fit("MCMCStrategy", packed=True)
    assert np.mean(losses[-40:]) < 0.3 * losses[0]
    assert counts[-1] == 189  # 5 % more at steps 40, 80, ... 200, each rounded down
    assert means.isfinite().all()


# --- What code written for gsplat meets where hqgs ends: an error that names it


def shot(**options: object) -> tuple[Tensor, Tensor, RasterizationMeta, Tensor]:
    generator = torch.Generator().manual_seed(0)
    means = (torch.randn(20, 3, generator=generator) + torch.tensor([0.0, 0.0, 5.0])).requires_grad_()
    image, alpha, meta = hqgs.rasterization(
        means,
        torch.randn(20, 4, generator=generator),
        torch.full((20, 3), 0.1),
        torch.full((20,), 0.5),
        torch.rand(20, 3, generator=generator),
        torch.eye(4)[None],
        torch.tensor([[[40.0, 0, 24], [0, 40, 18], [0, 0, 1]]]),
        48,
        36,
        **options,  # pyright: ignore[reportArgumentType]
    )
    return image, alpha, meta, means


@pytest.mark.parametrize("power", [1, 2])
def test_second_derivatives_are_refused(power: int) -> None:
    """Of a loss whose own derivative is constant too: there a penalty on the gradient did nothing."""
    image, _, _, means = shot()
    loss = image.pow(power).mean()
    (gradient,) = torch.autograd.grad(loss, means, create_graph=True)
    assert gradient.requires_grad
    with pytest.raises(RuntimeError, match="only first derivatives"):
        (loss + gradient.square().sum()).backward()


def test_a_gradient_with_a_graph_is_that_without() -> None:
    image, _, _, means = shot()
    loss = image.square().mean()
    (without,) = torch.autograd.grad(loss, means, retain_graph=True)
    (with_graph,) = torch.autograd.grad(loss, means, create_graph=True)
    assert without.abs().max() > 0
    assert torch.equal(with_graph.detach(), without)
    assert not without.requires_grad


@pytest.mark.parametrize("packed", [True, False])
def test_tile_lists_are_refused_by_name(packed: bool) -> None:
    _, _, meta, _ = shot(packed=packed)
    for name in ("isect_offsets", "flatten_ids", "tiles_per_gauss", "isect_ids"):
        assert name in (hqgs.rasterization.__doc__ or "")
        with pytest.raises(KeyError, match=f"{name}: hqgs returns no tile lists"):
            meta[name]  # pyright: ignore
    assert meta.get("isect_offsets") is None
