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

# By the names of `METHODS`: scene, configuration, and what inspects photos, of which each knows the others'.
MAKERS: dict[str, Callable[[Scene, TrainConfig, Inspector], Method[Any]]] = {
    "3dgs": lambda scene, config, inspector: ThreeDGS(),
    "srgs": lambda scene, config, inspector: SRGS(config.srgs),
    "hqgs": lambda scene, config, inspector: (
        PaperHQGS(scene, config.seed)
        if config.hqgs.guidance == PAPER
        else HQGS(scene, config.hqgs, inspector, config.seed)
    ),
}
