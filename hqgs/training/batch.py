"""Several views in one step: what each gives to it, as rows that can be sent, and their sum in their order.

The bits depend on the views alone: each one's gradients are taken by themselves, by whichever rank, and every
rank adds up the same rows.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor

from hqgs import _rust
from hqgs.base.ranks import Ranks
from hqgs.model.gaussians import Gaussians
from hqgs.training import checkpoint
from hqgs.training.adam import Adam
from hqgs.training.densify import Densifier, gradient_norms
from hqgs.training.guard import Fault
from hqgs.training.looks import Look

WIDTHS = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "sh0": 3}  # of a row, in its order
OBSERVED = sum(WIDTHS.values())  # the column after them: what growth goes by
UNSEEN = -1.0  # there: the Gaussian has a gradient, but the view does not show it
ROW_BYTES = 4 + 4 * (OBSERVED + 1)  # with the number of the Gaussian


@dataclass(frozen=True)
class Part:
    """What one view gives to its step."""

    loss: float
    degree: int  # of the harmonics
    measured: Tensor  # what the method goes by after the step, float64 [K]
    fault: Fault | None  # with one there are no gradients
    center: Tensor  # of the camera, float64 [3]
    rows: Tensor  # int32 [M]: the Gaussians that the view shows, or that have a gradient
    values: Tensor  # float32 [M, OBSERVED + 1]: WIDTHS, and the norm of the 2D mean's gradient
    higher: Tensor | None  # [M, L, 3]: the gradient of the higher harmonics; None: it follows from sh0's
    own: dict[str, Tensor]  # gradients of the method's tensors, by `_own_names`

    def packed(self) -> bytes:
        """As bytes; `unpacked` gives the same bits back."""
        tensors = {"measured": self.measured, "center": self.center, "rows": self.rows, "values": self.values}
        tensors |= {f"own.{name}": gradient.contiguous() for name, gradient in self.own.items()}
        if self.higher is not None:
            tensors["higher"] = self.higher
        meta: dict[str, Any] = {"loss": self.loss, "degree": self.degree, "fault": None}
        if (fault := self.fault) is not None:
            meta["fault"] = [fault.what, fault.tensors, fault.values]
            tensors["culled"] = fault.rows
        return save(tensors, {"part": json.dumps(meta)})

    @staticmethod
    def unpacked(data: bytes) -> Part:
        length = int.from_bytes(data[:8], "little")  # of the header, which the library keeps to itself
        meta = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["part"])
        tensors, fault = load(data), meta["fault"]
        return Part(
            loss=meta["loss"],
            degree=meta["degree"],
            measured=tensors["measured"],
            fault=None if fault is None else Fault(fault[0], fault[1], tensors["culled"], fault[2]),
            center=tensors["center"],
            rows=tensors["rows"],
            values=tensors["values"],
            higher=tensors.get("higher"),
            own=checkpoint.part("own.", tensors),
        )


def to_rasterize(trained: Gaussians, modulated: Gaussians) -> Gaussians:
    """`modulated`, with harmonics that get no gradient where it follows from sh0's."""
    return replace(modulated, shN=modulated.shN.detach()) if _follows(trained, modulated) else modulated


def part_of(look: Look, fault: Fault | None, trained: Gaussians, optimizer: Adam) -> Part:
    """What a look gives after its backward pass, which left its gradients in the trained tensors."""
    empty = torch.zeros(0, dtype=torch.int32), torch.zeros(0, OBSERVED + 1)
    center = torch.from_numpy(look.camera.center.copy()).double()
    part = Part(float(look.loss.detach()), look.plan.degree, look.measured, fault, center, *empty, None, {})
    if fault is not None:
        return part
    n, gradients = len(trained), {name: tensor.grad for name, tensor in trained.named().items()}
    columns = [
        torch.zeros(n, width) if (gradient := gradients[name]) is None else gradient.reshape(n, width)
        for name, width in WIDTHS.items()
    ]
    means2d, camera = look.meta["means2d"].grad, look.view.camera
    assert means2d is not None  # the backward pass was sound
    visible = (look.meta["radii"][0] > 0).all(dim=1)
    norms = torch.where(visible, gradient_norms(means2d[0], camera.width, camera.height), UNSEEN)
    whole = torch.cat([*columns, norms[:, None]], dim=1)
    rows = torch.nonzero(visible | (whole[:, :OBSERVED] != 0).any(dim=1))[:, 0]
    higher = None if gradients["shN"] is None else gradients["shN"][rows]
    own = {name: param.grad for name, param in _own(optimizer).items() if param.grad is not None}
    return replace(part, rows=rows.int(), values=whole[rows], higher=higher, own=own)


def exchanged(ranks: Ranks, count: int, make: Callable[[int], Part]) -> list[Part]:
    """The parts of a step's views 0 to `count`, the same on every rank.

    Rank r makes parts r, r + P, ... of P ranks; each is sent while the next one is made.
    """
    if ranks.count == 1:
        return [make(k) for k in range(count)]
    answers, started = [], time.perf_counter()
    for first in range(ranks.rank, ranks.rank + count, ranks.count):
        answers.append(ranks.begin(make(first).packed() if first < count else b""))
    ranks.worked += time.perf_counter() - started
    return [Part.unpacked(data) for answer in answers for data in answer() if data]


def give_mean(
    parts: Sequence[Part], trained: Gaussians, modulated: Gaussians, optimizer: Adam
) -> dict[Tensor, int]:
    """Put the mean of the parts' gradients, added in their order, where Adam looks for it.

    Returns of how many views each tensor's mean is: those that have a gradient of it.
    """
    n = len(trained)
    low, high = torch.empty(n, OBSERVED), torch.empty(n, *trained.shN.shape[1:])
    views = [
        (p.rows.numpy(), p.values.numpy(), p.center.tolist(), 0 if p.higher is not None else p.degree)
        for p in parts
    ]
    scale = 1 / len(parts)
    _rust.add_rows(views, modulated.means.detach().numpy(), low.numpy(), high.numpy(), scale)
    for part in parts:
        if part.higher is not None:
            high[part.rows.long()] += scale * part.higher
    gradients = dict(zip(WIDTHS, low.split(list(WIDTHS.values()), dim=1), strict=True))
    if any(part.degree for part in parts):
        gradients["shN"] = high
    optimizer.zero_grad()
    views_of = dict[Tensor, int]()
    for name, gradient in gradients.items():
        param = getattr(trained, name)
        param.grad, views_of[param] = gradient.reshape(param.shape).contiguous(), len(parts)
    for name, param in _own(optimizer).items():
        if own := [part.own[name] for part in parts if name in part.own]:
            param.grad, views_of[param] = torch.stack(own).sum(0) / len(own), len(own)
    return views_of


def note_views(parts: Sequence[Part], densifier: Densifier) -> None:
    """What growth goes by."""
    for part in parts:
        seen = part.values[:, OBSERVED] != UNSEEN
        densifier.note(part.rows[seen].long(), part.values[seen, OBSERVED])


def visible_in(parts: Sequence[Part], count: int) -> Tensor:
    """Which of `count` Gaussians any of the views shows, bool."""
    visible = torch.zeros(count, dtype=torch.bool)
    for part in parts:
        visible[part.rows[part.values[:, OBSERVED] != UNSEEN].long()] = True
    return visible


def _own(optimizer: Adam) -> dict[str, Tensor]:
    """The method's trained tensors."""
    groups = [group for group in optimizer.param_groups if group.get("every_row")]
    return {f"{group['name']}.{k}": param for group in groups for k, param in enumerate(group["params"])}


def _follows(trained: Gaussians, modulated: Gaussians) -> bool:
    """Whether the gradient of the higher harmonics is a product of the basis and of sh0's gradient."""
    return modulated.sh0 is trained.sh0 and modulated.shN is trained.shN
