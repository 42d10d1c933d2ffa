"""The signature of `hqgs.rasterization`, and what it refuses."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scenes import random_scene

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
