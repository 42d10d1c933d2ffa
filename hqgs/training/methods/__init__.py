"""What can be trained: what is rasterized and how it is judged. `make_method` finds a method by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from hqgs.scene.scene import Scene
from hqgs.training.config import AUTO
from hqgs.training.methods.base import Method, ThreeDGS
from hqgs.training.methods.hqgs import make_hqgs
from hqgs.training.methods.srgs import SRGS

if TYPE_CHECKING:
    from hqgs.training.config import TrainConfig

MAKERS: dict[str, Callable[[Scene, TrainConfig], Method]] = {
    "3dgs": lambda scene, config: ThreeDGS(),
    "srgs": lambda scene, config: SRGS(scene, config.srgs),
    "hqgs": lambda scene, config: make_hqgs(scene, config.hqgs, config.seed),
    AUTO: lambda scene, config: make_hqgs(scene, config.hqgs, config.seed),  # named after what it comes to
}


def make_method(scene: Scene, config: TrainConfig) -> Method:
    """The method that `config` names, for this scene."""
    return MAKERS[config.method](scene, config)
