"""The state of a run: what its next step starts from, and what a checkpoint keeps of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hqgs.base.typed import build
from hqgs.evaluation.records import HistoryEntry
from hqgs.model.gaussians import Gaussians
from hqgs.training.adam import Adam
from hqgs.training.checkpoint import part
from hqgs.training.densify import Densifier
from hqgs.training.guard import Guard
from hqgs.training.plan import PlanRow
from hqgs.training.schedule import Decisions


@dataclass
class Average:
    """The mean of the Gaussians over the last steps of a run: what is shown and written at the end.

    Each step serves one photo, and moves the scene a little away from the others; the mean over many steps
    serves them all (Polyak and Juditsky 1992, SIAM J. Control Optim. 30(4)). It changes no step, and no row
    comes or goes in between.
    """

    count: int = 0  # steps
    means: dict[str, Tensor] = field(default_factory=dict)  # of each tensor of the Gaussians, by its name

    @torch.no_grad()
    def add(self, gaussians: Gaussians) -> None:
        """Count them in as they are after a step."""
        self.count += 1
        for name, tensor in gaussians.named().items():
            if self.count == 1:
                self.means[name] = tensor.detach().clone()
            else:
                self.means[name].lerp_(tensor, 1 / self.count)

    def clear(self) -> None:
        """Forget all steps."""
        self.count, self.means = 0, {}

    def of(self, gaussians: Gaussians) -> Gaussians:
        """The mean, or `gaussians` themselves where no step has been counted in."""
        return gaussians.like(self.means) if self.count else gaussians


@dataclass
class TrainState:
    """After `iteration` steps. What a method has beside it, the method keeps."""

    gaussians: Gaussians  # leaves
    optimizer: Adam
    densifier: Densifier
    decisions: Decisions
    iteration: int = 0  # steps done
    seconds: float = 0.0  # spent in steps
    average: Average = field(default_factory=Average)
    guard: Guard = field(default_factory=Guard)
    history: list[HistoryEntry] = field(default_factory=list)  # of the held-out means
    rows: list[PlanRow] = field(default_factory=list)  # what was decided after the plan was made
    refused: int = 0  # splits and clones of Gaussians that are too fine
    best: float = -1e3  # dB, of the held-back photos
    best_at: int = 0
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=50))  # seconds of the last steps

    @property
    def step_seconds(self) -> float:
        """Of a view of a step now, the mean of the last ones; 0 before the first."""
        return sum(self.recent) / len(self.recent) if self.recent else 0.0

    def none_left(self) -> str:
        """What is wrong where no Gaussian is left."""
        return (
            f"no Gaussians are left at iteration {self.iteration}: all were pruned as transparent, too "
            f"large (scene's reach {self.densifier.reach:.3g}) or not finite ({self.guard.culled}); are the "
            "cameras and points in one frame?"
        )

    def tensors(self) -> dict[str, Tensor]:
        """All of its tensors by name, for a checkpoint."""
        tensors = {f"gaussians.{name}": tensor for name, tensor in self.gaussians.named().items()}
        tensors |= {f"average.{name}": tensor for name, tensor in self.average.means.items()}
        tensors |= {"densify.grad_sum": self.densifier.grad_sum, "densify.count": self.densifier.count}
        for prefix, param in _moments(self.optimizer):
            for key, value in self.optimizer.state.get(param, {}).items():
                tensors[prefix + key] = torch.as_tensor(value)
        return tensors

    def values(self) -> dict[str, Any]:
        """All that is no tensor, as JSON values, for a checkpoint."""
        return {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "averaged": self.average.count,
            "history": self.history,
            "guard": asdict(self.guard),
            "decisions": asdict(self.decisions),
            "rows": [asdict(row) for row in self.rows],
            "refused": self.refused,
            "best": [self.best, self.best_at],
        }

    def restored(
        self,
        path: str | Path,
        tensors: dict[str, Tensor],
        values: dict[str, Any],
        optimizer_of: Callable[[Gaussians], Adam],
    ) -> TrainState:
        """The state that `tensors` and `values` of the checkpoint `path` hold; this one is of the same run.

        ValueError names a tensor of another shape or type.
        """
        n = len(tensors["gaussians.means"])
        decisions = build(Decisions, values["decisions"], f"{path}: decisions")

        def check(name: str, tensor: Tensor, like: Tensor) -> None:
            if tensor.shape != like.shape or tensor.dtype != like.dtype:
                raise ValueError(
                    f"{path} is damaged: {name} is {tensor.dtype} {list(tensor.shape)}, "
                    f"wanted {like.dtype} {list(like.shape)}"
                )

        average = Average(values["averaged"], part("average.", tensors))
        for name, tensor in self.gaussians.named().items():
            like = tensor.new_empty((n, *tensor.shape[1:]))
            check(name, tensors[f"gaussians.{name}"], like)
            if average.count:
                check(f"average.{name}", average.means[name], like)
        gaussians = Gaussians(**part("gaussians.", tensors))
        optimizer = optimizer_of(gaussians)
        for prefix, param in _moments(optimizer):
            if state := part(prefix, tensors):
                for key in ("exp_avg", "exp_avg_sq"):
                    check(prefix + key, state[key], param)
                check(f"{prefix}step", state["step"], torch.tensor(0.0))
                optimizer.state[param] = state
        for name in ("grad_sum", "count"):
            check(f"densify.{name}", tensors[f"densify.{name}"], torch.empty(n))
            setattr(self.densifier, name, tensors[f"densify.{name}"])
        return TrainState(
            gaussians,
            optimizer,
            self.densifier,
            decisions,
            values["iteration"],
            values["seconds"],
            average,
            Guard(**values["guard"]),
            values["history"],
            [PlanRow(**row) for row in values["rows"]],
            values["refused"],
            *values["best"],
        )


def _moments(optimizer: Adam) -> list[tuple[str, Tensor]]:
    """Each trained tensor, with the prefix that its moments have in a checkpoint."""
    return [
        (f"adam.{group['name']}.{i}.", param)
        for group in optimizer.param_groups
        for i, param in enumerate(group["params"])
    ]
