"""The signature of `hqgs.rasterization`, what it refuses, backgrounds and leading batch dimensions."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scenes import GaussianScene, random_scene

import hqgs

F32, F64 = torch.float32, torch.float64

GSPLAT_DEFAULTS: dict[str, Any] = {
    "near_plane": 0.01,
    "far_plane": 1e10,
    "radius_clip": 0.0,
    "eps2d": 0.3,
    "sh_degree": None,
    "packed": True,
    "tile_size": 16,
    "backgrounds": None,
    "render_mode": "RGB",
    "sparse_grad": False,
    "absgrad": False,
    "rasterize_mode": "classic",
    "channel_chunk": 32,
    "distributed": False,
    "camera_model": "pinhole",
}


def test_signature_is_that_of_gsplat() -> None:
    parameters = inspect.signature(hqgs.rasterization).parameters
    required = ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height"]
    names = required + list(GSPLAT_DEFAULTS)
    assert list(parameters)[: len(names)] == names
    assert all(parameters[name].kind is inspect.Parameter.POSITIONAL_OR_KEYWORD for name in names)
    assert all(parameters[name].default is inspect.Parameter.empty for name in required)
    assert {name: parameters[name].default for name in GSPLAT_DEFAULTS} == GSPLAT_DEFAULTS


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("distributed", True),
        ("camera_model", "fisheye"),
        ("camera_model", "ortho"),
        ("camera_model", "ftheta"),
        ("with_ut", True),
        ("with_eval3d", True),
        ("radial_coeffs", torch.zeros(1, 4)),
        ("radial_coeffs", np.zeros((1, 4))),
        ("tangential_coeffs", torch.zeros(1, 2)),
        ("thin_prism_coeffs", torch.zeros(1, 4)),
        ("ftheta_coeffs", object()),
        ("rolling_shutter", 1),
        ("viewmats_rs", torch.eye(4)[None]),
        ("Ks", torch.eye(3)[None].requires_grad_()),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_unsupported_arguments_say_so(name: str, value: object) -> None:
    scene = random_scene(8, 10, 7, seed=0, dtype=F32)
    with pytest.raises(NotImplementedError, match=name):
        hqgs.rasterization(**scene.arguments(**{name: value}))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"viewmats": np.eye(4)[None], "backgrounds": torch.ones(1, 3)}, "viewmats: expected a torch tensor"),
        ({"means": [[0, 0, 0]], "covars": torch.eye(3)[None]}, "means: expected a torch tensor"),
        ({"tile_size": 0}, "tile_size: must be an integer of at least 1, got 0"),
        ({"eps2d": None}, "eps2d: must be finite and not negative, got None"),
        ({"near_plane": "a"}, "near_plane: must be finite and not negative, got 'a'"),
        ({"width": float("nan")}, "width: must be an integer of at least 1, got nan"),
        ({"height": None}, "height: must be an integer of at least 1, got None"),
        (
            {"width": 2**19, "height": 2**19},
            "width, height: at most 4,294,967,296 pixels, got 274,877,906,944",
        ),
        ({"colors": (1, 2, 3)}, "colors: expected a torch tensor"),
    ],
)
def test_arguments_are_named(given: dict[str, Any], words: str) -> None:
    scene = random_scene(1, 8, 8, seed=0, dtype=F32)
    with pytest.raises(ValueError, match=words):
        hqgs.rasterization(**scene.arguments(**given))


def test_unsupported_arguments_may_be_passed_as_absent() -> None:
    scene = random_scene(8, 10, 7, seed=0, dtype=F32)
    absent = {
        "covars": None,
        "with_ut": False,
        "with_eval3d": False,
        "radial_coeffs": None,
        "viewmats_rs": None,
    }
    render = hqgs.rasterization(**scene.arguments(), **absent)[0]
    assert torch.equal(render, hqgs.rasterization(**scene.arguments())[0])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("backgrounds", "red", "backgrounds: expected colours [C, D], or one, got 'red'"),
        ("backgrounds", (0, 0), "backgrounds: expected shape [1, 3], got [1, 2]"),
        ("backgrounds", torch.zeros(2, 3), "backgrounds: expected shape [1, 3], got [2, 3]"),
        ("covars", torch.eye(3).expand(7, 3, 3), "covars: expected shape [8, 3, 3], got [7, 3, 3]"),
        ("quats", None, "quats: expected a torch tensor, got None"),
        (
            "rolling_shutter",
            torch.zeros(500),
            "rolling_shutter: hqgs renders one image of a pinhole camera at a time, got a tensor [500]",
        ),
        ("means", torch.zeros(2, 8, 3), "quats: expected shape [2, ...], as means has, got [8, 4]"),
        (
            "viewmats",
            torch.zeros(2, 1, 4, 4),
            "viewmats: expected shape [C, 4, 4], got [2, 1, 4, 4]; leading batch dimensions must be those of "
            "means",
        ),
        ("means", torch.zeros(8, 4), "means: expected shape [N, 3], got [8, 4]"),
        ("means", torch.zeros(()), "means: expected shape [N, 3], got []"),
    ],
)  # fmt: skip
def test_messages_are_short_and_right(name: str, value: object, message: str) -> None:
    scene = random_scene(8, 10, 7, seed=0, dtype=F32)
    with pytest.raises((ValueError, NotImplementedError)) as error:
        hqgs.rasterization(**scene.arguments(**{name: value}))
    assert str(error.value) == message


def numbers(shape: tuple[int, ...]) -> str:
    """A pattern for a shape in any brackets."""
    return ",? ?".join(str(size) for size in shape)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (8, 2)),
        ("quats", (8, 3)),
        ("quats", (7, 4)),
        ("scales", (8, 1)),
        ("opacities", (8, 1)),
        ("opacities", (9,)),
        ("colors", (7, 3)),
        ("colors", (8,)),
        ("colors", (3, 8, 3)),
        ("viewmats", (4, 4)),
        ("viewmats", (2, 3, 4)),
        ("Ks", (1, 3, 3)),
        ("Ks", (2, 4, 4)),
        ("backgrounds", (2,)),
        ("backgrounds", (2, 4)),
        ("backgrounds", (1, 3)),
    ],
)
def test_wrong_shapes(name: str, shape: tuple[int, ...]) -> None:
    scene = random_scene(8, 10, 7, cameras=2, seed=0)
    with pytest.raises(ValueError, match=rf"(?s){name}.*{numbers(shape)}"):
        hqgs.rasterization(**scene.arguments(**{name: torch.ones(shape, dtype=F64)}))


@pytest.mark.parametrize("shape", [(8, 8, 3), (8, 9, 4), (8, 9), (7, 9, 3)])
def test_wrong_sh_shapes(shape: tuple[int, ...]) -> None:
    """Degree 2 needs [8, K >= 9, 3]."""
    scene = random_scene(8, 10, 7, seed=0, sh_degree=2)
    with pytest.raises(ValueError, match=rf"(?s)colors.*{numbers(shape)}"):
        hqgs.rasterization(**scene.arguments(colors=torch.ones(shape, dtype=F64)))


@pytest.mark.parametrize("name", ["viewmats", "Ks"])
def test_cameras_of_either_dtype(name: str) -> None:
    scene = random_scene(8, 10, 7, seed=0)
    rounded = getattr(scene, name).float()
    expected, _, _ = hqgs.rasterization(**scene.arguments(**{name: rounded.double()}))
    render, _, _ = hqgs.rasterization(**scene.arguments(**{name: rounded}))
    assert torch.equal(render, expected)


@pytest.mark.parametrize("name", ["quats", "scales", "opacities", "colors", "backgrounds"])
def test_mixed_dtypes(name: str) -> None:
    scene = random_scene(8, 10, 7, seed=0)
    with pytest.raises(ValueError, match=rf"(?s){name}.*float32"):
        hqgs.rasterization(**scene.arguments(**{name: getattr(scene, name).float()}))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64])
def test_unsupported_dtypes(dtype: torch.dtype) -> None:
    scene = random_scene(8, 10, 7, seed=0).to(dtype)
    with pytest.raises(ValueError, match=rf"(?s)means.*{str(dtype).removeprefix('torch.')}"):
        hqgs.rasterization(**scene.arguments())


@pytest.mark.parametrize("name", ["means", "colors", "Ks", "backgrounds"])
def test_other_devices(name: str) -> None:
    scene = random_scene(8, 10, 7, seed=0)
    with pytest.raises(ValueError, match=rf"(?s){name}.*meta"):
        hqgs.rasterization(**scene.arguments(**{name: getattr(scene, name).to("meta")}))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width", 0),
        ("height", -3),
        ("sh_degree", 4),
        ("sh_degree", -1),
        ("eps2d", -0.5),
        ("render_mode", "depth"),
        ("rasterize_mode", "smooth"),
    ],
)
def test_wrong_values(name: str, value: object) -> None:
    scene = random_scene(8, 10, 7, seed=0, sh_degree=3)
    with pytest.raises(ValueError, match=rf"(?s){name}.*{value}"):
        hqgs.rasterization(**scene.arguments(**{name: value}))


def test_skew_is_refused() -> None:
    scene = random_scene(8, 10, 7, seed=0)
    Ks = scene.Ks.clone()
    Ks[0, 0, 1] = 0.5
    with pytest.raises(ValueError, match=r"(?s)Ks.*0\.5"):
        hqgs.rasterization(**replace(scene, Ks=Ks).arguments())


# --- Backgrounds of any kind and leading batch dimensions: what the plain call gives


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
    works = [0, 0]
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
