"""A part in its surroundings: it starts from the coarse whole, and refines what lies in its cell.

The idea of a coarse prior is CityGaussian's (Liu et al. 2024, arXiv 2404.01133). All parts so see the same
sky and the same neighbours; what none of a part's photos shows stays as all photos of the whole have it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from hqgs.model.gaussians import Gaussians
from hqgs.scene.cells import cell_of
from hqgs.scene.geometry import in_picture
from hqgs.scene.scene import Part, Scene
from hqgs.training.methods.base import Method, Start
from hqgs.training.methods.hqgs import HQGS


def with_surroundings(start: Start, scene: Scene) -> Start:
    """The start of a part with the coarse scene in its cell and around it, where there is one.

    The part's own points outside its cell are left out, and of the coarse scene what lies there and no photo
    of the part sees. Opacities are not reset, and nothing is removed because no photo shows it: photos of
    other parts may. FileNotFoundError or ValueError for what is no scene file.
    """
    if scene.around is None or scene.part is None:
        return start
    own, coarse = start.gaussians, Gaussians.load(scene.around)
    coarse.shN = coarse.shN[:, : own.shN.shape[1]]
    useful, means = ~_outside(scene.part, coarse), coarse.means.double()
    for view in scene.train:
        useful |= in_picture(means, view.camera)[1]
    both = Gaussians.joined([own.rows(~_outside(scene.part, own)), coarse.rows(useful)])
    items = tuple(item for item in start.config.leave_out if item != "weight")
    densify = start.config.densify
    densify = replace(densify, reset_every=max(densify.reset_every, densify.stop))
    return replace(start, config=replace(start.config, leave_out=items, densify=densify), gaussians=both)


def fits_guests(method: Method[Any]) -> bool:
    """Whether small photos are to be compared with renders as they are, but for their exposure."""
    return not isinstance(method, HQGS) or method.formation.kinds <= {"exposure"}


def fixed_in_number(scene: Scene, gaussians: Gaussians) -> Tensor | None:
    """Which Gaussians do not grow, since merging would throw them away, bool [N]; None: all may grow."""
    return None if scene.around is None or scene.part is None else _outside(scene.part, gaussians)


def _outside(part: Part, gaussians: Gaussians) -> Tensor:
    """Which Gaussians lie outside the part's cell, bool [N]."""
    return torch.from_numpy(cell_of(part.cells, gaussians.means.detach().numpy()) != part.part)
