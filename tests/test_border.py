"""What the border between Python and the crate refuses, and what must not shake it: memory that is shared or
changes under its hands, processes that fork, scenes that do not fit into memory."""

from __future__ import annotations

import numpy as np
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
