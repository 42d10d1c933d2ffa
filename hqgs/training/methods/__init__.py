"""What can be trained, a file for each method; base.py says what a method is and how to add one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hqgs.diagnosis.scene import Inspector
from hqgs.scene.scene import Scene
from hqgs.training.config import PAPER, TrainConfig
from hqgs.training.methods.base import Method, ThreeDGS
from hqgs.training.methods.hqgs import HQGS
from hqgs.training.methods.paper import PaperHQGS
from hqgs.training.methods.srgs import SRGS


def make_hqgs(scene: Scene, config: TrainConfig, inspector: Inspector) -> Method[Any]:
    """HQGS with the guidance that the configuration names."""
    if config.hqgs.guidance == PAPER:
        return PaperHQGS(scene, config.seed)
    return HQGS(scene, config.hqgs, inspector, config.seed)


# By the names of `METHODS`: scene, configuration, and what inspects photos, of which each knows the others'.
MAKERS: dict[str, Callable[[Scene, TrainConfig, Inspector], Method[Any]]] = {
    "3dgs": lambda scene, config, inspector: ThreeDGS(),
    "srgs": lambda scene, config, inspector: SRGS(config.srgs),
    "hqgs": make_hqgs,
}


def make_method(scene: Scene, config: TrainConfig, inspector: Inspector) -> Method[Any]:
    """The method that `config` names, for this scene; `inspector` diagnoses its photos where it asks."""
    return MAKERS[config.method](scene, config, inspector)
