"""A merged scene polished: a few steps on photos of all parts, which are read while they are needed.

Each part was trained beside coarse neighbours, and meets them as they have become only when it is merged.
Nothing grows here, and never more than a few photos are in memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.base.stages import OnStage, Stage, untold
from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.photos.exposure import take_photo
from hqgs.scene.listing import some_views
from hqgs.training.adam import Adam
from hqgs.training.config import TrainConfig
from hqgs.training.guard import gradient_fault
from hqgs.training.methods.base import ThreeDGS
from hqgs.training.methods.cameras import as_held
from hqgs.training.schedule import learning_rates

FIRST = 0.5  # of a run is done, as far as the means' rate goes, when polishing begins
LAST = 0.1  # of their first rates, what the others end at


def polished(
    gaussians: Gaussians,
    scene: str | Path,
    photos: Mapping[str, NDArray[np.float64]],
    size: tuple[float, int | None],
    extent: float,
    steps: int,
    told: OnStage = untold,
) -> Gaussians:
    """The Gaussians after so many steps on these photos, each of which comes equally often.

    Args:
        scene: folder of the whole scene.
        photos: their names, and the log gains [3] of their exposures. Otherwise they are as taken.
        size: `downscale` and `longest` of the photos, as `hqgs.load` takes them.
        extent: of the cameras, world units.
        told: hears of each step.

    Raises FileNotFoundError or ValueError for what is wrong with the folder or a photo.
    """
    method, config, rng = ThreeDGS(), TrainConfig(), np.random.default_rng(0)
    leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in gaussians.named().items()}
    gaussians = Gaussians(**leaves)
    optimizer = Adam([{"name": n, "params": [t]} for n, t in leaves.items()], lr=0.0, eps=config.adam_eps)
    names, rounds = sorted(photos), range(-(-steps // len(photos)))
    order = [names[k] for _ in rounds for k in rng.permutation(len(names))]
    with one_torch_thread():
        for k, view in enumerate(some_views(scene, order[:steps], *size)):
            rates = learning_rates(config, extent, FIRST + (1 - FIRST) * k / steps)
            for group in optimizer.param_groups:
                left = 1.0 if group["name"] == "means" else LAST ** (k / steps)
                group["lr"] = left * rates[group["name"]]
            render, _ = render_view(gaussians, view.camera, gaussians.sh_degree, config.background)
            render.retain_grad()
            optimizer.zero_grad()
            target = method.prepare(view)
            method.loss(_taken(render, target.photo, photos[view.name]), target).backward()
            if gradient_fault(gaussians, optimizer, render) is None:
                optimizer.step()
            told(Stage("steps of polishing", k + 1, steps))
    return gaussians.detached()


def _taken(render: Tensor, photo: Tensor, log_gains: NDArray[np.float64]) -> Tensor:
    """The render [H, W, 3] as the photo's exposure shows it."""
    if not log_gains.any():
        return render
    still = torch.zeros(0, 3, 4, dtype=torch.float64)
    size = render.shape[0], render.shape[1]
    return as_held(take_photo(render, size, None, still, torch.from_numpy(np.exp(log_gains))), photo)
