"""The configuration of a training run: everything but the photos that its result depends on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from hqgs.densify import DensifyConfig
from hqgs.gaussians import MAX_SH_DEGREE
from hqgs.left_out import check_items
from hqgs.methods import check_method
from hqgs.methods.hqgs import HQGSConfig
from hqgs.methods.srgs import SRGSConfig


@dataclass(frozen=True)
class TrainConfig:
    """Everything but the photos that a result depends on. The defaults are those of 3DGS.

    `scaled()` fits the schedule to a run of another length than 30,000 iterations.
    """

    iterations: int = 30_000
    method: str = "3dgs"
    seed: int = 0
    sh_degree: int = MAX_SH_DEGREE
    sh_interval: int = 1_000  # iterations until the next SH degree is trained
    lr_means: float = 1.6e-4  # times the scene extent; falls exponentially to
    lr_means_final: float = 1.6e-6  # this at the end of the run
    lr_scales: float = 5e-3
    lr_quats: float = 1e-3
    lr_opacities: float = 5e-2
    lr_sh0: float = 2.5e-3
    lr_shN: float = 2.5e-3 / 20  # noqa: N815
    adam_eps: float = 1e-15
    selective_adam: bool = False  # leave the Gaussians that a view does not show as they are (Taming 3DGS)
    leave_out: tuple[str, ...] = ()  # of `hqgs.left_out.ITEMS`: what the run may do without, where it pays
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # RGB
    eval_every: int = 3_000  # iterations between evaluations on the held-out views
    checkpoint_every: int = 1_000  # iterations; does not change the result
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    srgs: SRGSConfig = field(default_factory=SRGSConfig)  # of the method of that name, as the next
    hqgs: HQGSConfig = field(default_factory=HQGSConfig)

    def __post_init__(self) -> None:
        check_method(self.method)
        check_items(set(self.leave_out))
        for name in ("iterations", "sh_interval", "eval_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, wanted at least 1")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}, wanted at least 0")
        if not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise ValueError(f"sh_degree is {self.sh_degree}, wanted 0..{MAX_SH_DEGREE}")
        for name, value in vars(self).items():
            if name.startswith("lr_") and not 0 < value < math.inf:
                raise ValueError(f"{name} is {value}, wanted a positive number")

    def scaled(self) -> TrainConfig:
        """The same run with the schedule fitted to `iterations`; see `DensifyConfig.scaled` too.

        The SH degrees come in within three sevenths of a short run. Evaluates 10 times; saves every 1,000
        iterations, in short runs 10 times.
        """
        tenth = math.ceil(self.iterations / 10)
        return replace(
            self,
            sh_interval=min(self.sh_interval, max(1, self.iterations // 7)),
            eval_every=tenth,
            checkpoint_every=min(self.checkpoint_every, tenth),
            densify=self.densify.scaled(self.iterations),
        )
