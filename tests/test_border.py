"""What the border between Python and the crate refuses, and what must not shake it: memory that is shared or
changes under its hands, processes that fork, scenes that do not fit into memory."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import random_scene

from hqgs import _rust

OPTIONS = (0.01, 1e10, 0.0, 0.3, False, True)


def project(n: int = 40, width: int = 36, height: int = 20, cameras: int = 1, seed: int = 0, **changed):
    """`_rust.project_forward` of a scene of channels: its keywords, and what it returns."""
    scene = random_scene(n, width, height, cameras=cameras, seed=seed, dtype=torch.float64)
    names = "means", "quats", "scales", "opacities", "colors", "viewmats"
    arrays = {name: getattr(scene, name).contiguous().numpy() for name in names}
    arguments = {
        **arrays, "rest": None, "ks": scene.Ks.double().numpy(), "width": width, "height": height,
        "options": OPTIONS, "sh_degree": None, **changed,
    }  # fmt: skip
    return arguments, _rust.project_forward(**arguments)


def test_any_byte_of_a_mask_but_0_counts() -> None:
    """As bool, the bytes 2..255 would be undefined behaviour."""
    _, (frame, *_) = project()
    some = np.random.default_rng(0).integers(0, 2, (1, 20, 36), dtype=np.uint8)
    expected = _rust.blending_weights(frame, some, True)
    assert (expected > 0).any()
    assert not np.array_equal(expected, _rust.blending_weights(frame, None, True))
    for byte in (2, 254, 255):
        assert np.array_equal(_rust.blending_weights(frame, some * np.uint8(byte), True), expected)


def test_a_composite_goes_back_through_its_own_frame() -> None:
    """Its tile lists belong to no other one: what is composited later changes nothing."""
    arguments, (frame, *_) = project(40)
    composite, image, _ = _rust.composite_forward(frame, arguments["colors"], None, 3)
    v_image = np.random.default_rng(0).standard_normal((1, 20, 36, 3))
    expected = _rust.composite_backward(composite, None, v_image, None, [True] * 4)
    _, (other, *_) = project(7, width=100, height=90)
    del frame
    again = _rust.composite_backward(composite, None, v_image, None, [True] * 4)
    for a, b in zip(again[:-1], expected[:-1], strict=True):
        assert a is not None
        assert np.array_equal(a, b)
    assert np.abs(again[0]).max() > 0
    with pytest.raises(TypeError):
        _rust.composite_backward(other, composite, None, v_image, None, [True] * 4)  # type: ignore[call-arg]


def test_gradients_of_another_frame_are_refused() -> None:
    arguments, (_, *arrays) = project(40)
    _, (other, *_) = project(7)
    inputs = tuple(arguments[name] for name in ("means", "quats", "scales", "opacities"))
    v_means2d = np.zeros_like(arrays[0]).reshape(1, 40, 2)
    with pytest.raises(ValueError, match=r"^means: expected shape \[7, 3\], got \[40, 3\]$"):
        _rust.project_backward(other, inputs, (v_means2d, *[None] * 5), [True] * 7)
