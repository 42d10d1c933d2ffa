"""The methods by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from hqgs.camera import Scene
from hqgs.methods.base import AUTO, Method
from hqgs.methods.hqgs import make_hqgs
from hqgs.methods.srgs import SRGS
from hqgs.methods.three_dgs import ThreeDGS

if TYPE_CHECKING:
    from hqgs.config import TrainConfig  # which itself checks its method here

METHODS: dict[str, Callable[[Scene, TrainConfig], Method]] = {
    "3dgs": lambda scene, config: ThreeDGS(),
    "srgs": lambda scene, config: SRGS(scene, config.srgs),
    "hqgs": lambda scene, config: make_hqgs(scene, config.hqgs, config.seed),
    AUTO: lambda scene, config: make_hqgs(scene, config.hqgs, config.seed),  # named after what it comes to
}


def check_method(name: str) -> None:
    """ValueError, which lists the methods there are, for an unknown name."""
    if name not in METHODS:
        raise ValueError(f"unknown method {name!r}; the methods are: {', '.join(METHODS)}")


def make_method(scene: Scene, config: TrainConfig) -> Method:
    """The method that `config` names, for this scene."""
    return METHODS[config.method](scene, config)
