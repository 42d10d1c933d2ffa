"""Backgrounds of any kind and leading batch dimensions: what the plain call gives."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from scenes import GaussianScene, random_scene

import hqgs

F32, F64 = torch.float32, torch.float64


def batch_of(scenes: list[GaussianScene], shape: tuple[int, ...]) -> dict[str, Any]:
    """The arguments of scenes of one size, stacked."""
    names = scenes[0].tensors()
    joined = {name: torch.stack([getattr(s, name) for s in scenes]).unflatten(0, shape) for name in names}
    return scenes[0].arguments(**{name: t.clone().requires_grad_(name != "Ks") for name, t in joined.items()})


@pytest.mark.parametrize("shape", [(2,), (2, 1), (1, 3), (1,)])
@pytest.mark.parametrize(("sh_degree", "mode"), [(None, "RGB+ED"), (2, "RGB")])
def test_a_batch_is_its_scenes_one_by_one(shape: tuple[int, ...], sh_degree: int | None, mode: str) -> None:
    count = int(torch.tensor(shape).prod())
    scenes = [
        random_scene(
            30, 20, 14, cameras=2, seed=k, dtype=F64, sh_degree=sh_degree, per_camera_colors=not sh_degree
        )
        for k in range(count)
    ]
    joined = batch_of(scenes, shape)
    images, alphas, meta = hqgs.rasterization(**joined, render_mode=mode)
    assert images.shape[: len(shape) + 1] == (*shape, 2)
    for name in ("means2d", "radii", "depths", "conics", "opacities"):
        assert meta[name].shape[: len(shape) + 2] == (*shape, 2, 30), name  # type: ignore[literal-required]
    meta["means2d"].retain_grad()
    weights = torch.linspace(-1, 1, images.numel(), dtype=F64).view(images.shape)
    ((images * weights).sum() + 0.3 * alphas.square().sum() + 0.01 * meta["depths"].sum()).backward()
    works = [0, 0, 0]
    for k, scene in enumerate(scenes):
        one = scene.with_grad(*(name for name in scene.tensors() if name != "Ks"))
        image, alpha, known = hqgs.rasterization(**one.arguments(), render_mode=mode)
        assert torch.equal(images.flatten(0, len(shape) - 1)[k], image)
        assert torch.equal(alphas.flatten(0, len(shape) - 1)[k], alpha)
        known["means2d"].retain_grad()
        part = weights.flatten(0, len(shape) - 1)[k]
        ((image * part).sum() + 0.3 * alpha.square().sum() + 0.01 * known["depths"].sum()).backward()
        for name, leaf in one.tensors().items():
            if name != "Ks":
                gradient = joined[name].grad.flatten(0, len(shape) - 1)[k]
                assert leaf.grad is not None
                assert torch.equal(gradient, leaf.grad), name
        assert meta["means2d"].grad is not None
        assert known["means2d"].grad is not None
        assert torch.equal(meta["means2d"].grad.flatten(0, len(shape) - 1)[k], known["means2d"].grad)
        works = [a + b for a, b in zip(works, known["work"], strict=True)]
    assert list(meta["work"]) == works


def test_a_batch_of_pairs_of_harmonics_and_one_background() -> None:
    scenes = [random_scene(20, 16, 12, seed=k, dtype=F32, sh_degree=1) for k in range(2)]
    joined = batch_of(scenes, (2,))
    colors = joined.pop("colors")
    joined["colors"] = colors[:, :, :1], colors[:, :, 1:]
    joined["backgrounds"] = (0, 0.5, 1)
    images = hqgs.rasterization(**joined)[0]
    for k, scene in enumerate(scenes):
        alone = scene.arguments(backgrounds=torch.tensor([[0, 0.5, 1]]))
        assert torch.equal(images[k], hqgs.rasterization(**alone)[0])


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("batch", [False, True])
def test_harmonics_of_each_camera_are_those_of_a_camera_alone(batch: bool, packed: bool) -> None:
    """[C, N, K, 3], as gsplat has them."""
    scene = random_scene(40, 24, 17, cameras=3, seed=4, dtype=F64, sh_degree=2).with_grad("means", "viewmats")
    others = [random_scene(40, 24, 17, seed=k, dtype=F64, sh_degree=2).colors for k in range(3)]
    colors = torch.stack(others).requires_grad_()
    arguments = scene.arguments(colors=colors, packed=packed)
    if batch:
        arguments |= {k: v[None] for k, v in arguments.items() if isinstance(v, torch.Tensor)}
    images = hqgs.rasterization(**arguments)[0]
    weights = torch.linspace(-1, 1, images.numel(), dtype=F64).view(images.shape)
    (images * weights).sum().backward()
    images, weights, means = (
        images.view(3, 17, 24, 3),
        weights.view(3, 17, 24, 3),
        torch.zeros(40, 3, dtype=F64),
    )
    for k, own in enumerate(others):
        one = scene.with_grad("means", "viewmats")
        own = own.clone().requires_grad_()
        camera = {name: getattr(one, name)[k : k + 1] for name in ("viewmats", "Ks", "backgrounds")}
        image = hqgs.rasterization(**one.arguments(colors=own, **camera))[0]
        assert torch.equal(images[k], image[0])
        (image[0] * weights[k]).sum().backward()
        assert torch.equal(colors.grad[k], own.grad)  # pyright: ignore
        means += one.means.grad  # pyright: ignore[reportOperatorIssue]
        torch.testing.assert_close(scene.viewmats.grad[k], one.viewmats.grad[k])  # pyright: ignore
    torch.testing.assert_close(scene.means.grad, means, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quats": torch.ones(3, 8, 4)}, "quats: expected shape [2, ...], as means has, got [3, 8, 4]"),
        ({"opacities": torch.ones(2, 9)}, "opacities: expected shape [8], got [9]"),
        ({"backgrounds": torch.ones(1, 3)}, "backgrounds: expected shape [2, ...], as means has, got [1, 3]"),
        ({"Ks": torch.ones(2, 3, 3)}, "Ks: expected shape [1, 3, 3], got [3, 3]"),
        ({"means": torch.ones(0, 8, 3)}, "means: no scene in a batch of shape [0]"),
        ({"absgrad": True}, "absgrad: not with leading batch dimensions; call hqgs for each scene"),
    ],
)
def test_wrong_batches_are_refused(change: dict[str, Any], message: str) -> None:
    scenes = [random_scene(8, 10, 7, seed=k, dtype=F32) for k in range(2)]
    with pytest.raises((ValueError, NotImplementedError)) as error:
        hqgs.rasterization(**{**batch_of(scenes, (2,)), **change})
    assert str(error.value) == message


@pytest.mark.parametrize("value", [(0, 0, 0), [[0, 0, 0]], torch.tensor([0, 0, 0]), torch.zeros(1, 3).long()])
def test_black_is_black_however_it_is_written(value: Any) -> None:
    scene = random_scene(8, 10, 7, seed=0, dtype=F32)
    black = hqgs.rasterization(**scene.arguments(backgrounds=torch.zeros(1, 3)))[0]
    assert torch.equal(hqgs.rasterization(**scene.arguments(backgrounds=value))[0], black)
    white = hqgs.rasterization(**scene.arguments(backgrounds=(1, 1, 1)))[0]
    assert not torch.equal(white, black)
