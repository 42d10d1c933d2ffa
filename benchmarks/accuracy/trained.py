"""Gaussians as training makes them: the built-in scene after a short run, seen by a training view."""

from __future__ import annotations

import numpy as np
import torch

from benchmarks.measure import Training
from benchmarks.protocol import Row
from benchmarks.speed.inputs import RasterInputs
from hqgs.base.threads import one_torch_thread
from hqgs.model.render import render_view
from hqgs.scene.scene import Scene
from hqgs.training.methods.base import photo_tensors
from hqgs.training.methods.photometric import photometric_loss


def trained_inputs(scene: Scene, steps: int, most: int, seed: int) -> RasterInputs:
    """At most `most` Gaussians after `steps` of 3DGS; `v_image` is the gradient of the loss there."""
    config = Row("3dgs").train_config(seed, steps, {"densify": {"max_gaussians": most}, "sh_interval": 1})
    done = Training(scene, config)
    done.steps(steps)
    g, view = done.trainer.gaussians.detached(), scene.train[0]
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
