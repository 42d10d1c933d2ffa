"""Several views in one step: what each gives to it, as rows that can be sent, and their sum in their order.

The bits depend on the views alone: each one's gradients are taken by themselves, by whichever rank, and every
rank adds up the same rows. A view is sent in two messages: the colours' gradients first, since the harmonics,
which are most of the work of a step's end, follow from them. The rest travels while that is done.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from safetensors.torch import load, save
from torch import Tensor

from hqgs import _rust
from hqgs.base.ranks import Ranks
from hqgs.model.gaussians import Gaussians
from hqgs.training import checkpoint
from hqgs.training.adam import Adam
from hqgs.training.densify import Densifier, gradient_norms
from hqgs.training.forward import ForwardPass, Gradients, Step, TrainingViews
from hqgs.training.guard import Fault
from hqgs.training.schedule import StepPlan
from hqgs.training.state import TrainState

Answer = Callable[[], list[bytes]]
WIDTHS = {"means": 3, "scales": 3, "quats": 4, "opacities": 1}  # of a row of the rest, in its order
OBSERVED = sum(WIDTHS.values())  # the column after them: what growth goes by
UNSEEN = -1.0  # there: the Gaussian has a gradient, but the view does not show it


@dataclass(frozen=True)
class Part:
    """What one view gives to its step, without the rest."""

    loss: float
    degree: int  # of the harmonics
    measured: Tensor  # what the method goes by after the step, float64 [K]
    fault: Fault | None  # with one there are no gradients
    center: Tensor  # of the camera, float64 [3]
    shown: Tensor  # bool [N]: the M Gaussians that the view shows, or that have a gradient
    colors: Tensor  # float32 [M, 3]: sh0's gradient

    @cached_property
    def rows(self) -> Tensor:
        """int32 [M], ascending."""
        return torch.nonzero(self.shown)[:, 0].int()

    def packed(self) -> bytes:
        """As bytes; `unpacked` gives the same bits back."""
        bits = torch.from_numpy(np.packbits(self.shown.numpy()))
        tensors = {"measured": self.measured, "center": self.center, "bits": bits, "colors": self.colors}
        meta: dict[str, Any] = {"loss": self.loss, "degree": self.degree, "count": len(self.shown)}
        if (fault := self.fault) is not None:
            meta["fault"] = [fault.what, fault.tensors, fault.values]
            tensors["culled"] = fault.rows
        return save(tensors, {"part": json.dumps(meta)})

    @staticmethod
    def unpacked(data: bytes) -> Part:
        length = int.from_bytes(data[:8], "little")  # of the header, which the library keeps to itself
        meta = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["part"])
        tensors, fault = load(data), meta.get("fault")
        bits = np.unpackbits(tensors["bits"].numpy(), count=meta["count"])
        return Part(
            loss=meta["loss"],
            degree=meta["degree"],
            measured=tensors["measured"],
            fault=None if fault is None else Fault(fault[0], fault[1], tensors["culled"], fault[2]),
            center=tensors["center"],
            shown=torch.from_numpy(bits).bool(),
            colors=tensors["colors"],
        )


@dataclass(frozen=True)
class Rest:
    """The rest of what one view gives."""

    values: Tensor  # float32 [M, OBSERVED + 1]: WIDTHS, and the norm of the 2D mean's gradient
    higher: Tensor | None  # [M, L, 3]: the gradient of the higher harmonics; None: it follows from sh0's
    own: dict[str, Tensor]  # gradients of the method's tensors, by `_own_names`

    @property
    def seen(self) -> Tensor:
        """Which of the rows the view shows, bool [M]."""
        return self.values[:, OBSERVED] != UNSEEN

    def packed(self) -> bytes:
        """As bytes; `unpacked` gives the same bits back."""
        tensors = {f"own.{name}": gradient.contiguous() for name, gradient in self.own.items()}
        if self.higher is not None:
            tensors["higher"] = self.higher
        return save(tensors | {"values": self.values})

    @staticmethod
    def unpacked(data: bytes) -> Rest:
        tensors = load(data)
        return Rest(tensors["values"], tensors.get("higher"), checkpoint.part("own.", tensors))


def gradients_of_several(
    plans: Sequence[StepPlan], training: TrainingViews, state: TrainState, ranks: Ranks
) -> Gradients:
    """Those of the views that a step takes, added up as rows, so that the bits do not depend on which
    process rendered what."""
    method, steps = training.method, list[Step]()

    def make(k: int) -> tuple[Part, Callable[[], Rest]]:
        shown = to_rasterize(state.gaussians, method.modulate(state.gaussians))
        forward = training.at(plans[k], shown, state.densifier.seed)
        fault = forward.backward(state)
        steps.append(forward.step)
        return part_of(forward, fault, state.gaussians, state.optimizer)

    parts, others = exchanged(ranks, len(plans), make)
    steps.append(Step(parts[0].loss, torch.zeros(0, 0, 3), training.views[plans[0].view]))

    def apply() -> None:
        with torch.no_grad():
            modulated = method.modulate(state.gaussians)
        rests = descend(parts, others, state.gaussians, modulated, state.optimizer)
        note_views(parts, rests, [plan.observes for plan in plans], state.densifier)

    return Gradients(steps[0], [part.fault for part in parts], [part.measured for part in parts], apply)


def to_rasterize(trained: Gaussians, modulated: Gaussians) -> Gaussians:
    """`modulated`, with harmonics that get no gradient where it follows from sh0's."""
    return replace(modulated, shN=modulated.shN.detach()) if _follows(trained, modulated) else modulated


def part_of(
    forward: ForwardPass, fault: Fault | None, trained: Gaussians, optimizer: Adam
) -> tuple[Part, Callable[[], Rest]]:
    """What a look gives after its backward pass, which left its gradients in the trained tensors; the rest
    is to be had as long as they are there."""
    n = len(trained)
    center = torch.from_numpy(forward.camera.center.copy()).double()
    part = Part(
        loss=float(forward.loss.detach()),
        degree=forward.plan.degree,
        measured=forward.measured,
        fault=fault,
        center=center,
        shown=torch.zeros(n, dtype=torch.bool),
        colors=torch.zeros(0, 3),
    )
    if fault is not None:
        return part, lambda: Rest(torch.zeros(0, OBSERVED + 1), None, {})
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
    part = replace(part, shown=shown, colors=gradients["sh0"].reshape(n, 3)[shown])

    def rest() -> Rest:
        (means2d,), higher = forward.pulls[0], trained.shN.grad
        norms = torch.where(visible, gradient_norms(means2d, camera.width, camera.height), UNSEEN)
        columns = [gradients[name].reshape(n, width) for name, width in WIDTHS.items()]
        values = torch.cat([*columns, norms[:, None]], dim=1)[part.rows]
        own = {name: param.grad for name, param in _own(optimizer).items() if param.grad is not None}
        return Rest(values, None if higher is None else higher[part.rows], own)

    return part, rest


def exchanged(
    ranks: Ranks, count: int, make: Callable[[int], tuple[Part, Callable[[], Rest]]]
) -> tuple[list[Part], Callable[[], list[Rest]]]:
    """The parts of a step's views 0 to `count`, and what waits for the rest of each; the same on every rank.

    Rank r makes parts r, r + P, ... of P ranks; each is sent while the next one is made.
    """
    if ranks.count == 1:
        made = [(part, rest()) for part, rest in map(make, range(count))]
        return [part for part, _ in made], lambda: [rest for _, rest in made]
    started, firsts, seconds = time.perf_counter(), list[Answer](), list[Answer]()
    for k in range(ranks.rank, ranks.rank + count, ranks.count):
        part, rest = make(k) if k < count else (None, None)
        firsts.append(ranks.begin(b"" if part is None else part.packed()))
        seconds.append(ranks.begin(b"" if rest is None else rest().packed()))
    ranks.worked += time.perf_counter() - started
    parts = [Part.unpacked(data) for answer in firsts for data in answer() if data]
    return parts, lambda: [Rest.unpacked(data) for answer in seconds for data in answer() if data]


def descend(
    parts: Sequence[Part],
    others: Callable[[], list[Rest]],
    trained: Gaussians,
    modulated: Gaussians,
    optimizer: Adam,
) -> list[Rest]:
    """A step of Adam along the mean of the gradients of the parts without a fault, added in their order.

    `others` waits for the rest of each part, which is returned; until then the harmonics are updated.
    """
    optimizer.zero_grad()
    sound = [part for part in parts if part.fault is None]
    early = _follows(trained, modulated) and any(part.degree for part in sound)
    if early:
        give_harmonics(sound, [None] * len(sound), trained, modulated)
        optimizer.step(views={trained.shN: len(sound)})
        trained.shN.grad = None
    rests = others()
    kept = [rest for part, rest in zip(parts, rests, strict=True) if part.fault is None]
    if not early:
        give_harmonics(sound, [rest.higher for rest in kept], trained, modulated)
    views_of = give_others(sound, kept, trained, optimizer)
    optimizer.step(views=views_of)
    return rests


def give_harmonics(
    parts: Sequence[Part], higher: Sequence[Tensor | None], trained: Gaussians, modulated: Gaussians
) -> None:
    """Put the mean of the gradients of the higher harmonics where Adam looks for it, if there is one."""
    if not any(part.degree for part in parts):
        return
    sums = torch.empty_like(trained.shN)
    views = [
        (p.rows.numpy(), p.colors.numpy(), p.center.tolist(), 0 if sent is not None else p.degree)
        for p, sent in zip(parts, higher, strict=True)
    ]
    _rust.add_harmonics(views, modulated.means.detach().numpy(), sums.numpy(), 1 / len(parts))
    for part, sent in zip(parts, higher, strict=True):
        if sent is not None:
            sums[part.rows.long()] += 1 / len(parts) * sent
    trained.shN.grad = sums


def give_others(
    parts: Sequence[Part], rests: Sequence[Rest], trained: Gaussians, optimizer: Adam
) -> dict[Tensor, int]:
    """Put the means of all other gradients there.

    Returns of how many views each tensor's mean is: those that have a gradient of it.
    """
    n, scale = len(trained), 1 / len(parts)
    low, colors = torch.empty(n, OBSERVED + 1), torch.empty(n, 3)
    rows = [part.rows.numpy() for part in parts]
    values = [rest.values.numpy() for rest in rests]
    _rust.add_rows(list(zip(rows, values, strict=True)), low.numpy(), scale)
    values = [part.colors.numpy() for part in parts]
    _rust.add_rows(list(zip(rows, values, strict=True)), colors.numpy(), scale)
    columns = low[:, :OBSERVED].split(list(WIDTHS.values()), dim=1)
    for name, gradient in [*zip(WIDTHS, columns, strict=True), ("sh0", colors)]:
        param = getattr(trained, name)
        param.grad = gradient.reshape(param.shape).contiguous()
    views_of = dict.fromkeys(trained.named().values(), len(parts))
    for name, param in _own(optimizer).items():
        if own := [rest.own[name] for rest in rests if name in rest.own]:
            param.grad, views_of[param] = torch.stack(own).sum(0) / len(own), len(own)
    return views_of


def note_views(
    parts: Sequence[Part], rests: Sequence[Rest], observe: Sequence[bool], densifier: Densifier
) -> None:
    """What growth goes by; `observe`: whether it goes by each of them."""
    for part, rest, observes in zip(parts, rests, observe, strict=True):
        if observes and part.fault is None:
            densifier.note(part.rows[rest.seen].long(), rest.values[rest.seen, OBSERVED])


def _own(optimizer: Adam) -> dict[str, Tensor]:
    """The method's trained tensors."""
    groups = [group for group in optimizer.param_groups if group.get("own")]
    return {f"{group['name']}.{k}": param for group in groups for k, param in enumerate(group["params"])}


def _follows(trained: Gaussians, modulated: Gaussians) -> bool:
    """Whether the gradient of the higher harmonics is a product of the basis and of sh0's gradient."""
    return modulated.sh0 is trained.sh0 and modulated.shN is trained.shN
