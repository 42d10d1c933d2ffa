"""The length of a run that has so many seconds, from steps timed before it; clock.py corrects it."""

from __future__ import annotations

from dataclasses import replace

from hqgs.base.ranks import ALONE, Ranks
from hqgs.diagnosis.scene import Inspector
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.settings import with_iterations
from hqgs.training.trainer import Trainer

WARM, TIMED = 3, 7  # steps of each size before the run: the first ones start threads and fill caches
# A mean step of a run over one at its start. One that starts from points all over the photos grows little,
# and its Gaussians hide more of each other as they become opaque.
GROWTH, GROWTH_DENSE = 2.0, 1.0
DENSE = 2  # times the scene's own points
FEWEST, MOST = 50, 30_000  # iterations


def fitted(
    scene: Scene, config: TrainConfig, inspector: Inspector | None = None, ranks: Ranks = ALONE
) -> TrainConfig:
    """The configuration with the iterations that fit into its seconds, if it has any, and pay."""
    if config.seconds is None or config.turn is not None:
        return config
    trainer, most = Trainer(scene, config, inspector, ranks), None
    if trainer.method.as_photographed and trainer.config.iterations < config.iterations:
        most = trainer.config.iterations
    planned = ranks.tell(fitting(trainer, config.seconds, most))[0]
    # Where more do not pay, the clock is not to lengthen the run.
    return replace(with_iterations(config, planned), turn=(planned - 1, planned) if planned == most else None)


def fitting(trainer: Trainer, seconds: float, most: int | None = None) -> int:
    """As many iterations as fit into `seconds` of training on this machine, now; `most` of them at most.

    The trainer is a fresh one; it has made steps then, and is of no more use.
    """
    config, schedule = trainer.config, trainer.schedule
    growth = GROWTH_DENSE if trainer.first_points > DENSE * len(trainer.scene.points) else GROWTH
    costs = {coarse: growth * _timed(trainer, coarse) for coarse in (True, False)}

    def needed(iterations: int) -> float:
        coarse = replace(schedule, config=with_iterations(config, iterations)).coarse_end
        return coarse * costs[True] + (iterations - coarse) * costs[False]

    few, many = FEWEST, MOST if most is None else max(most, FEWEST) + 1
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (middle, many) if needed(middle) <= seconds else (few, middle)
    return few


def _timed(trainer: Trainer, coarse: bool) -> float:
    """Mean seconds of a step's view at the smaller or at full size."""
    if coarse and not trainer.schedule.coarse_end:
        return 0.0
    for _ in range(WARM):
        trainer.step(coarse)
    started, before = trainer.seconds, trainer.iteration
    for _ in range(TIMED):
        trainer.step(coarse)
    return (trainer.seconds - started) / (trainer.iteration - before)
