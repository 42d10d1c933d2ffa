"""HQGS as it is used by default: the loss knows how the photos were degraded, and only that part is done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hqgs.diagnosis.colors import plain_devices
from hqgs.diagnosis.scene import Inspector
from hqgs.model.gaussians import Gaussians
from hqgs.photos.formula import DEVICES, LEARNED, film_alone
from hqgs.photos.pixels import floats
from hqgs.scene.scene import Scene, View
from hqgs.training.checkpoint import part
from hqgs.training.config import HQGSConfig
from hqgs.training.methods.base import Method
from hqgs.training.methods.cameras import LearnedCamera, LearnedCameras, LearnedDevices, Shot, no_shot
from hqgs.training.methods.formed import Formation, FormedTarget, HeldPixels, Plateau, find_formation
from hqgs.training.methods.photometric import photometric_loss
from hqgs.training.plan import Facts
from hqgs.training.state import TrainState

# Standard deviations of the noise up to which differences count by their square (Huber): half as steep there
# as L1 on average, and growth goes by the gradient, hence STEEPER.
KNEE, STEEPER = 2.0, 2.0


class HQGS(Method[FormedTarget]):
    """The image formation in the loss.

    - Blur of any kind and low resolution: the render is blurred and shrunk as the photo was, and compared
      there. The direction of a motion is each photo's own, as the diagnosis tells it.
    - JPEG: beside the pixels, the render is compared with the cells that the file leaves open (`JpegCells`).
    - Noise or JPEG: no D-SSIM. It is normalised by the local contrast, so that it asks for the noise in flat
      parts.
    - Noise: differences count by their square up to two standard deviations of the noise (Huber's function).
      The mean of Gaussian noise over the views is nearer to the truth than their median, which L1 asks for.
    - Shake, focus and exposure, each photo its own, vignetting and response, each camera its own: what the
      cameras did is learned with the scene (`LearnedCameras`), and the render is taken like that. With
      nothing else, the rest is 3DGS's.
    - Noise, each photo its own (grain): the noisy ones are compared as above, the others as 3DGS does.
      Those show what is noise: a budget or other rates are not needed.
    - None of them: the loss of 3DGS, and the start below.
    - A coarse film's codec (video) and nothing else: as noise of FILM_NOISE levels, without held pixels.
    - Short runs have higher rates than 3DGS (`learning_rates`), but for those of JPEG alone.
    - Growth has a budget, and no resets (`budget` in rules.py).
    - Where the reconstruction has few points for that number, as it has from bad photos, the run starts from
      more: pixels along the photos' edges, at depths that other photos agree on (`points_along_edges`).
      Gaussians are discs and needles then, as their neighbours lie (`as_discs`); but not under noise, blur,
      JPEG or low resolution, where depths are too rough for that.
    - Noise: the learning rates are halved as often as a fiftieth of the pixels, which the loss leaves out,
      finds that nothing is gained any more (`Plateau`). At constant rates the Gaussians learn the noise.
    """

    name = "hqgs"

    def __init__(
        self, scene: Scene, config: HQGSConfig, inspector: Inspector | None = None, seed: int = 0
    ) -> None:
        """`inspector`: what diagnoses the scene's photos where the formation is not given."""
        self.config = config
        inspector = inspector or Inspector()
        self.formation: Formation = find_formation(scene, config.formation, inspector)
        kinds = self.formation.kinds
        self.as_photographed: bool = not kinds
        # A film's photos share what its codec left, so that a scene learns it: it is nothing to expect.
        self.noise: float = 0.0 if film_alone(kinds) else self.formation.noise
        self._views = scene.train
        self._numbers = {view.name: k for k, view in enumerate(scene.train)}
        self._cameras: LearnedCameras | None = None
        if kinds & set(LEARNED):
            gains = None
            if "exposure" in kinds:
                gains = inspector.log_gains(scene, kinds)
                gains = np.zeros((len(scene.train), 3)) if gains is None else gains
            devices = None
            if kinds & set(DEVICES):
                signs = inspector.device_signs(scene)
                first = plain_devices(scene.train) if signs is None else signs.devices
                devices = LearnedDevices(first, "vignetting" in kinds, "response" in kinds)
            self._cameras = LearnedCameras(scene, "shake" in kinds, "focus" in kinds, gains, seed, devices)
        holds = self.noise and config.held_pixels and "jpeg" not in kinds
        self._plateau = Plateau(len(scene.train)) if holds else None

    @property
    def rate_left(self) -> float:
        return 1.0 if self._plateau is None else self._plateau.rate_left

    def prepare(self, view: View) -> FormedTarget:
        target = self.formation.target(view)
        if self._plateau is None:
            return target
        held, mask = HeldPixels.draw(self._numbers[view.name], target.photo, target.mask)
        return replace(target, mask=mask, held=held)

    def facts(self, facts: Facts, targets: Sequence[FormedTarget]) -> Facts:
        formation, kinds = self.formation, self.formation.kinds
        undirected = [view.name for view in self._views if view.name not in formation.directions]
        height_width = [tuple(target.photo.shape[:2]) for target in targets]
        return replace(
            facts,
            as_photographed=self.as_photographed,
            sizes=tuple((int(height), int(width)) for height, width in height_width),
            kept=sum(target.kept for target in targets) if "jpeg" in kinds else None,
            noisy=len(formation.noises),
            undirected=tuple(undirected) if "motion" in kinds else (),
        )

    def start(self, gaussians: Gaussians, iterations: int) -> Gaussians:
        if self._cameras is not None:
            self._cameras.schedule(iterations)
        return gaussians

    def shot(self, view: View, target: FormedTarget) -> Shot:
        return no_shot(view) if self._cameras is None else self._cameras.shot(view, target.photo)

    def compare(self, render: Tensor, target: FormedTarget) -> Tensor:
        return render if target.operator is None else target.operator(render)

    def loss(self, image: Tensor, target: FormedTarget) -> Tensor:
        photo, mask = target.photo, target.mask
        if target.cells is None or target.centres is None:
            if not target.noise:
                return photometric_loss(image, photo, mask)
            return STEEPER * photometric_loss(image, photo, mask, 0.0, KNEE * target.noise)
        pixels = photometric_loss(image, photo, mask, 0.0)
        if mask is not None:
            image = torch.where(mask[..., None], image, floats(photo))
        return target.cells.loss(image, target.centres) + self.config.jpeg_pixels * pixels

    def measured(self, image: Tensor, target: FormedTarget) -> Tensor:
        """The error at the held pixels, if there are any."""
        return super().measured(image, target) if target.held is None else target.held.error(image)[None]

    def after_step(self, state: TrainState, view: View, seen: Tensor) -> None:
        """The cameras' depths age, and the held pixels decide on the rates."""
        if self._plateau is not None and len(seen):
            self._plateau.see(self._numbers[view.name], seen[0])
        if self._cameras is not None:
            self._cameras.after_step(state.iteration, view, state.gaussians)

    def learned(self) -> list[LearnedCamera]:
        return [] if self._cameras is None else self._cameras.learned()

    def param_groups(self) -> list[dict[str, Any]]:
        return [] if self._cameras is None else self._cameras.param_groups()

    def rates(self, part: float) -> dict[str, float]:
        return {} if self._cameras is None else self._cameras.rates(part)

    def state_dict(self) -> dict[str, Tensor]:
        state = {}
        if self._plateau is not None:
            state = {f"held.{name}": tensor for name, tensor in self._plateau.state_dict().items()}
        if self._cameras is not None:
            state |= {f"camera.{name}": tensor for name, tensor in self._cameras.state_dict().items()}
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        if self._plateau is not None:
            self._plateau.load_state_dict(part("held.", state))
        if self._cameras is not None:
            self._cameras.load_state_dict(part("camera.", state))
