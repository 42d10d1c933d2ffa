"""Gaussians as training makes them: the built-in scene after a short run, seen by a training view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from benchmarks.protocol import Row
from benchmarks.speed.inputs import RasterInputs
from hqgs.base.threads import one_torch_thread
from hqgs.model.render import render_view
from hqgs.scene.builtin import embedded_scene
from hqgs.training.methods.base import photo_tensors
from hqgs.training.methods.photometric import photometric_loss
from hqgs.training.trainer import Trainer


def trained_inputs(
    size: tuple[int, int], views: int, steps: int, most: int, seed: int, cache: Path | None = None
) -> RasterInputs:
    """At most `most` Gaussians after `steps` of 3DGS; `v_image` is the gradient of the loss there."""
    scene = embedded_scene(cache, *size, num_views=views)
    changes = {"densify": {"max_gaussians": most}, "sh_interval": 1}
    config = Row("3dgs").train_config(seed, steps, changes)
    trainer = Trainer(scene, config)
    for _ in range(steps):
        trainer.step()
    g, view = trainer.gaussians.detached(), scene.train[0]
    with one_torch_thread():
        image, _ = render_view(g, view.camera, 3, config.background)
        image.requires_grad_()
        photo, mask = photo_tensors(view)
        photometric_loss(image, photo, mask).backward()
    assert image.grad is not None
    return RasterInputs(
        means=g.means.numpy(),
        quats=g.quats.numpy(),
        scales=g.activated_scales().numpy(),
        opacities=g.activated_opacities().numpy(),
        sh=torch.cat([g.sh0, g.shN], dim=1).numpy(),
        v_image=image.grad.numpy(),
        viewmat=view.camera.viewmat,
        K=view.camera.K,
        background=np.array(config.background, np.float32),
    )
