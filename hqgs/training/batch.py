"""Several views in one step: what each gives to it, as rows that can be sent, and their sum in their order.

The bits depend on the views alone: each one's gradients are taken by themselves, by whichever rank, and every
rank adds up the same rows. A view's rows travel while the next view is rendered.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor

from hqgs import _rust
from hqgs.base.ranks import Ranks
from hqgs.model.gaussians import Gaussians
from hqgs.training import checkpoint
from hqgs.training.adam import Adam
from hqgs.training.forward import ForwardPass, Gradients, Step, TrainingViews
from hqgs.training.guard import Fault
from hqgs.training.schedule import StepPlan
from hqgs.training.state import TrainState

WIDTHS = {"means": 3, "scales": 3, "quats": 4, "opacities": 1}  # of a row of the rest, in its order
OBSERVED = sum(WIDTHS.values())  # the column after them: what growth goes by
UNSEEN = -1.0  # there: the Gaussian has a gradient, but the view does not show it
SENT = ("measured", "center", "rows", "colors", "values", "higher")  # of a `Part`


@dataclass(frozen=True)
class Part:
    """What one view gives to its step."""

    loss: float
    degree: int  # of the harmonics
    measured: Tensor  # what the method goes by after the step, float64 [K]
    fault: Fault | None  # with one there are no gradients: M = 0
    center: Tensor  # of the camera, float64 [3]
    rows: Tensor  # int32 [M], ascending: the Gaussians that the view shows, or that have a gradient
    colors: Tensor  # float32 [M, 3]: sh0's gradient
    values: Tensor  # float32 [M, OBSERVED + 1]: WIDTHS, and the norm of the 2D mean's gradient
    higher: Tensor | None = None  # [M, L, 3]: that of the higher harmonics; None: it follows from sh0's
    own: dict[str, Tensor] = field(default_factory=dict)  # of the method's tensors, by `_own` names

    @property
    def seen(self) -> Tensor:
        """Which of the rows the view shows, bool [M]."""
        return self.values[:, OBSERVED] != UNSEEN

    def packed(self) -> bytes:
        """As bytes; `unpacked` gives the same bits back."""
        tensors = {name: getattr(self, name) for name in SENT if getattr(self, name) is not None}
        tensors |= {f"own.{name}": gradient.contiguous() for name, gradient in self.own.items()}
        meta: dict[str, Any] = {"loss": self.loss, "degree": self.degree, "fault": None}
        if (fault := self.fault) is not None:
            meta["fault"] = [fault.what, fault.tensors, fault.values]
            tensors["culled"] = fault.rows
        tensors["meta"] = torch.frombuffer(bytearray(json.dumps(meta).encode()), dtype=torch.uint8)
        return save(tensors)

    @staticmethod
    def unpacked(data: bytes) -> Part:
        tensors = load(data)
        meta: dict[str, Any] = json.loads(tensors["meta"].numpy().tobytes())
        if (fault := meta["fault"]) is not None:
            meta["fault"] = Fault(fault[0], fault[1], tensors["culled"], fault[2])
        sent: dict[str, Any] = {name: tensors.get(name) for name in SENT}
        return Part(**meta, **sent, own=checkpoint.part("own.", tensors))


def gradients_of_several(
    plans: Sequence[StepPlan], training: TrainingViews, state: TrainState, ranks: Ranks
) -> Gradients:
    """Those of the views that a step takes, added up as rows, so that the bits do not depend on which
    process rendered what."""
    method, steps = training.method, list[Step]()

    def make(k: int) -> Part:
        shown = to_rasterize(state.gaussians, method.modulate(state.gaussians))
        forward = training.at(plans[k], shown, state.densifier.seed)
        fault = forward.backward(state)
        steps.append(forward.step)
        return part_of(forward, fault, state.gaussians, state.optimizer)

    parts = exchanged(ranks, len(plans), make)
    steps.append(Step(parts[0].loss, torch.zeros(0, 0, 3), training.views[plans[0].view]))

    def apply() -> None:
        with torch.no_grad():
            modulated = method.modulate(state.gaussians)
        state.optimizer.zero_grad()
        sound = [part for part in parts if part.fault is None]
        give_harmonics(sound, state.gaussians, modulated)
        # A step along the mean of the gradients of the parts without a fault, added in their order.
        state.optimizer.step(views=give_others(sound, state.gaussians, state.optimizer))
        for plan, part in zip(plans, parts, strict=True):
            if plan.observes and part.fault is None:
                state.densifier.note(part.rows[part.seen].long(), part.values[part.seen, OBSERVED])

    return Gradients(steps[0], [part.fault for part in parts], [part.measured for part in parts], apply)


def to_rasterize(trained: Gaussians, modulated: Gaussians) -> Gaussians:
    """`modulated`, with harmonics that get no gradient where theirs is a product of the basis and sh0's."""
    follows = modulated.sh0 is trained.sh0 and modulated.shN is trained.shN
    return replace(modulated, shN=modulated.shN.detach()) if follows else modulated


def part_of(forward: ForwardPass, fault: Fault | None, trained: Gaussians, optimizer: Adam) -> Part:
    """What a look gives after its backward pass, which left its gradients in the trained tensors."""
    n, own = len(trained), dict[str, Tensor]()
    part = Part(
        loss=float(forward.loss.detach()),
        degree=forward.plan.degree,
        measured=forward.measured,
        fault=fault,
        center=torch.from_numpy(forward.camera.center.copy()).double(),
        rows=torch.zeros(0, dtype=torch.int32),
        colors=torch.zeros(0, 3),
        values=torch.zeros(0, OBSERVED + 1),
        own=own,
    )
    if fault is not None:
        return part
    gradients = {
        name: torch.zeros(tensor.shape) if tensor.grad is None else tensor.grad
        for name, tensor in trained.named().items()
        if name != "shN"
    }
    radii, camera = forward.meta["radii"][0], forward.view.camera
    visible = (radii > 0).all(dim=1)
    shown = visible.clone()
    for gradient in gradients.values():
        shown |= (gradient.reshape(n, -1) != 0).any(dim=1)
    (means2d,), higher = forward.pulls[0], trained.shN.grad
    # A pixel is 2 / width of normalised device coordinates, in which the threshold of growth is published.
    pulls = torch.hypot(means2d[:, 0] * (camera.width / 2), means2d[:, 1] * (camera.height / 2))
    norms = torch.where(visible, pulls, UNSEEN)
    columns = [gradients[name].reshape(n, width) for name, width in WIDTHS.items()]
    own |= {name: param.grad for name, param in _own(optimizer).items() if param.grad is not None}
    return replace(
        part,
        rows=torch.nonzero(shown)[:, 0].int(),
        colors=gradients["sh0"].reshape(n, 3)[shown],
        values=torch.cat([*columns, norms[:, None]], dim=1)[shown],
        higher=None if higher is None else higher[shown],
    )


def exchanged(ranks: Ranks, count: int, make: Callable[[int], Part]) -> list[Part]:
    """The parts of a step's views 0 to `count`, the same on every rank.

    Rank r makes parts r, r + P, ... of P ranks; each is sent while the next one is made.
    """
    if ranks.count == 1:
        return [make(k) for k in range(count)]
    started, answers = time.perf_counter(), list[Callable[[], list[bytes]]]()
    for k in range(ranks.rank, ranks.rank + count, ranks.count):
        answers.append(ranks.begin(make(k).packed() if k < count else b""))
    ranks.worked += time.perf_counter() - started
    return [Part.unpacked(data) for answer in answers for data in answer() if data]


def give_harmonics(parts: Sequence[Part], trained: Gaussians, modulated: Gaussians) -> None:
    """Put the mean of the gradients of the higher harmonics where Adam looks for it, if there is one."""
    if not any(part.degree for part in parts):
        return
    sums = torch.empty_like(trained.shN)
    views = [
        (p.rows.numpy(), p.colors.numpy(), p.center.tolist(), 0 if p.higher is not None else p.degree)
        for p in parts
    ]
    _rust.add_harmonics(views, modulated.means.detach().numpy(), sums.numpy(), 1 / len(parts))
    for part in parts:
        if part.higher is not None:
            sums[part.rows.long()] += 1 / len(parts) * part.higher
    trained.shN.grad = sums


def give_others(parts: Sequence[Part], trained: Gaussians, optimizer: Adam) -> dict[Tensor, int]:
    """Put the means of all other gradients there.

    Returns of how many views each tensor's mean is: those that have a gradient of it.
    """
    n, scale = len(trained), 1 / len(parts)
    low, colors = torch.empty(n, OBSERVED + 1), torch.empty(n, 3)
    rows = [part.rows.numpy() for part in parts]
    values = [part.values.numpy() for part in parts]
    _rust.add_rows(list(zip(rows, values, strict=True)), low.numpy(), scale)
    values = [part.colors.numpy() for part in parts]
    _rust.add_rows(list(zip(rows, values, strict=True)), colors.numpy(), scale)
    columns = low[:, :OBSERVED].split(list(WIDTHS.values()), dim=1)
    for name, gradient in [*zip(WIDTHS, columns, strict=True), ("sh0", colors)]:
        param = getattr(trained, name)
        param.grad = gradient.reshape(param.shape).contiguous()
    views_of = dict.fromkeys(trained.named().values(), len(parts))
    for name, param in _own(optimizer).items():
        if own := [part.own[name] for part in parts if name in part.own]:
            param.grad, views_of[param] = torch.stack(own).sum(0) / len(own), len(own)
    return views_of


def _own(optimizer: Adam) -> dict[str, Tensor]:
    """The method's trained tensors."""
    groups = [group for group in optimizer.param_groups if group.get("own")]
    return {f"{group['name']}.{k}": param for group in groups for k, param in enumerate(group["params"])}
