"""HQGS as it is used by default: the loss knows how the photos were degraded, and only that part is done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hqgs.base.left_out import LeftOut
from hqgs.diagnosis.scene import Inspector
from hqgs.model.discs import as_discs
from hqgs.model.gaussians import Gaussians
from hqgs.model.smoothing import enlarge
from hqgs.photos.formula import LEARNED, OWN
from hqgs.photos.pixels import floats
from hqgs.scene.geometry import photo_pixels
from hqgs.scene.scene import Scene, View
from hqgs.training.checkpoint import part
from hqgs.training.config import AUTO, AUTOMATIC, ITEMS, HQGSConfig, TrainConfig
from hqgs.training.methods.base import Plain, Start
from hqgs.training.methods.budget import first_points, start_points, with_budget
from hqgs.training.methods.cameras import Found, LearnedCameras, Shot, no_shot
from hqgs.training.methods.formed import Formation, FormedTarget, find_formation
from hqgs.training.methods.held_pixels import SHARE, HeldPixels, Plateau
from hqgs.training.methods.photometric import photometric_loss
from hqgs.training.settings import with_iterations
from hqgs.training.state import TrainState

LAMBDA_DSSIM = 0.2
KNEE = 2.0  # standard deviations of the noise up to which differences count by their square
STEEPER = 2.0  # on average the square is half as steep there as L1, and growth goes by the gradient
# Where no number of iterations is given, and cameras are learned or photos are as photographed: so many are
# enough; of the latter also so many for each photo. More would learn what no other photo shows.
ENOUGH, LOOKS = 7_000, 150
GROWS_FROM = 140  # the iteration before which a run from points all over the photos does not grow
REFRESH = 100  # steps until the sizes of the smallest Gaussians are computed again


class HQGS(Plain):
    """The image formation in the loss.

    - Blur of any kind and low resolution: the render is blurred and shrunk as the photo was, and compared
      there. The direction of a motion is each photo's own, as the diagnosis tells it.
    - JPEG: beside the pixels, the render is compared with the cells that the file leaves open (`JpegCells`).
    - Noise or JPEG: no D-SSIM. It is normalised by the local contrast, so that it asks for the noise in flat
      parts.
    - Noise: differences count by their square up to two standard deviations of the noise (Huber's function).
      The mean of Gaussian noise over the views is nearer to the truth than their median, which L1 asks for.
    - Shake, focus and exposure, each photo its own: what its camera did is learned with the scene
      (`LearnedCameras`), and the render is taken like that. With nothing else, the rest is 3DGS's.
    - Noise, each photo its own (grain): the noisy ones are compared as above, the others as 3DGS does.
      Those show what is noise: a budget or other rates are not needed.
    - None of them: the loss of 3DGS, and the start below.
    - A film's codec (video): 3DGS's loss and rates.
    - Short runs have higher rates than 3DGS (`learning_rates`), but for those of JPEG or video alone.
    - No Gaussian is smaller than half a pixel of the photos: what is finer, no photo has seen.
    - Growth has a budget, and no resets (`with_budget`).
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
        self._told = inspector.told
        self.formation: Formation
        self._left_out: list[LeftOut]
        self.formation, self._left_out = find_formation(scene, config.formation, inspector)
        kinds = self.formation.kinds
        self.as_photographed: bool = not kinds
        self.noise: float = self.formation.noise
        self._views = scene.train
        self._numbers = {view.name: k for k, view in enumerate(scene.train)}
        self._cameras: LearnedCameras | None = None
        if kinds & set(LEARNED):
            gains = None
            if "exposure" in kinds:
                gains = inspector.log_gains(scene)
                gains = np.zeros((len(scene.train), 3)) if gains is None else gains
            self._cameras = LearnedCameras(scene, "shake" in kinds, "focus" in kinds, gains, seed)
        holds = self.noise and self.formation.white and "jpeg" not in kinds
        self._plateau = Plateau(len(scene.train)) if holds else None
        self._smallest: Tensor | None = None  # [N] world units; None: there is no limit
        self._since = 0  # the iteration after which they were computed

    @property
    def rate_left(self) -> float:
        return 1.0 if self._plateau is None else self._plateau.rate_left

    def prepare(self, view: View) -> FormedTarget:
        target = self.formation.target(view)
        if self._plateau is None:
            return target
        held, mask = HeldPixels.draw(self._numbers[view.name], target.photo, target.mask)
        return replace(target, mask=mask, held=held)

    def start(self, scene: Scene, targets: Sequence[FormedTarget], config: TrainConfig) -> Start:
        """With the formation that was found, and a budget of Gaussians that the photos can determine."""
        degradation, left_out = self.formation.degradation, list(self._left_out)
        if self._plateau is not None:
            what = f"1/{1 / SHARE:.0f} of each photo's pixels in the loss"
            left_out.append(LeftOut(what, "they tell when the scene would start to learn the noise"))
        known = replace(config.hqgs, formation=str(degradation))
        # What a codec leaves open is learned sooner at higher rates, and nothing holds it back.
        coded = self.formation.kinds in ({"jpeg"}, {"video"})
        brisk = not coded if config.brisk is None else config.brisk
        config = replace(config, hqgs=known, brisk=brisk)
        if self._cameras is not None:
            config, why = _without_held_photos(config)
            left_out += why
            self._cameras.schedule(config.iterations)
        if self.formation.kinds <= set(OWN):
            plain = self.as_photographed and config.method == AUTO
            wanted = start_points(scene, min(config.start_points, config.densify.max_gaussians))
            points, colors, _ = first_points(scene, wanted, config.seed, self._told)
            gaussians = Gaussians.from_points(points, colors, config.sh_degree)
            if len(points) > len(scene.points):
                gaussians = as_discs(gaussians)
                config, why = _growing_later(config)
                left_out += why
                config = _coarse_first(config) if self.as_photographed else config
            if self.as_photographed:
                config, why = _long_enough(config, len(scene.train))
                left_out += why
            config = replace(config, method="3dgs") if plain else self.named(config)
            return Start(config, gaussians, left_out)
        least, densify = len(scene.points), config.densify
        budget = with_budget(densify, self.formation, targets, self.config.gaussians_per_pixel, least)
        if densify.reset_every < densify.stop:
            left_out.append(LeftOut("resets of the opacities", "a budget of Gaussians bears none"))
        wanted = int(self.config.first_points * budget.max_gaussians)
        points, colors, why = first_points(scene, wanted, config.seed, self._told)
        gaussians = Gaussians.from_points(points, colors, config.sh_degree)
        self._measure(gaussians, 0)
        return Start(self.named(replace(config, densify=budget)), gaussians, left_out + why)

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        return gaussians if self._smallest is None else enlarge(gaussians, self._smallest)

    def shot(self, view: View, target: FormedTarget) -> Shot:
        return no_shot(view) if self._cameras is None else self._cameras.shot(view, target.photo)

    def compare(self, render: Tensor, target: FormedTarget) -> Tensor:
        return render if target.operator is None else target.operator(render)

    def loss(self, image: Tensor, target: FormedTarget) -> Tensor:
        photo, mask = target.photo, target.mask
        if target.cells is None or target.centres is None:
            if not target.noise:
                return photometric_loss(image, photo, mask, LAMBDA_DSSIM)
            return STEEPER * photometric_loss(image, photo, mask, 0.0, KNEE * target.noise)
        pixels = photometric_loss(image, photo, mask, 0.0)
        if mask is not None:
            image = torch.where(mask[..., None], image, floats(photo))
        return target.cells.loss(image, target.centres) + self.config.jpeg_pixels * pixels

    def rows_changed(self, state: TrainState, parents: Tensor) -> None:
        if self._smallest is not None:
            self._measure(state.gaussians, state.iteration)

    def measured(self, image: Tensor, target: FormedTarget) -> Tensor:
        """The error at the held pixels, if there are any."""
        return super().measured(image, target) if target.held is None else target.held.error(image)[None]

    def after_step(self, state: TrainState, view: View, seen: Tensor) -> None:
        """The smallest sizes and the cameras' depths age, and the held pixels decide on the rates."""
        if self._smallest is not None and state.iteration - self._since >= REFRESH:
            self._measure(state.gaussians, state.iteration)
        if self._plateau is not None and len(seen):
            self._plateau.see(self._numbers[view.name], seen[0])
        if self._cameras is not None:
            self._cameras.after_step(state.iteration, view, self.modulate(state.gaussians))

    def found(self) -> list[Found]:
        return [] if self._cameras is None else self._cameras.found()

    def param_groups(self) -> list[dict[str, Any]]:
        return [] if self._cameras is None else self._cameras.param_groups()

    def rates(self, part: float) -> dict[str, float]:
        return {} if self._cameras is None else self._cameras.rates(part)

    def state_dict(self) -> dict[str, Tensor]:
        state = {}
        if self._plateau is not None:
            state = {f"held.{name}": tensor for name, tensor in self._plateau.state_dict().items()}
        if self._smallest is not None:
            state |= {"smallest": self._smallest, "since": torch.tensor(self._since)}
        if self._cameras is not None:
            state |= {f"camera.{name}": tensor for name, tensor in self._cameras.state_dict().items()}
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        if self._smallest is not None:
            self._smallest, self._since = state["smallest"], int(state["since"])
        if self._plateau is not None:
            self._plateau.load_state_dict(part("held.", state))
        if self._cameras is not None:
            self._cameras.load_state_dict(part("camera.", state))

    def _measure(self, gaussians: Gaussians, iteration: int) -> None:
        """Half a pixel of the photos where each Gaussian is now."""
        if self.config.smallest:
            pixels = photo_pixels(gaussians.means, self._views) * self.formation.factor
            self._smallest, self._since = (self.config.smallest * pixels).float(), iteration


def _without_held_photos(config: TrainConfig) -> tuple[TrainConfig, list[LeftOut]]:
    """The same where no photo can be held back: what its camera did would not be learned."""
    why = "no photo can be held back to tell when to end: its camera would not be learned"
    config, left_out = _no_longer(config, ENOUGH, why)
    return replace(config, leave_out=tuple(item for item in config.leave_out if item == "photos")), left_out


def _long_enough(config: TrainConfig, photos: int) -> tuple[TrainConfig, list[LeftOut]]:
    """As many looks at each of the photos as pay; in a long run held-back photos tell whether fewer do."""
    most = max(ENOUGH, LOOKS * photos)
    shorter, left_out = _no_longer(config, most, "more looks at the same photos do not pay")
    return (shorter if most == ENOUGH else replace(shorter, leave_out=config.leave_out)), left_out


def _no_longer(config: TrainConfig, most: int, why: str) -> tuple[TrainConfig, list[LeftOut]]:
    """With at most so many iterations, if no number is given."""
    if "iterations" not in config.leave_out or config.iterations <= most:
        return config, []
    return with_iterations(config, most), [LeftOut(f"iterations {most + 1} to {config.iterations}", why)]


def _growing_later(config: TrainConfig) -> tuple[TrainConfig, list[LeftOut]]:
    """For a short run that starts from points all over the photos."""
    if config.densify.start >= GROWS_FROM:
        return config, []
    what = f"growth in the first {GROWS_FROM} iterations"
    why = "until sizes and colours are about right, gradients do not tell where something is missing"
    return replace(config, densify=replace(config.densify, start=GROWS_FROM)), [LeftOut(what, why)]


def _coarse_first(config: TrainConfig) -> TrainConfig:
    """For a run that starts from points all over the photos: at the smaller size it loses nothing then."""
    if not set(AUTOMATIC) <= set(config.leave_out):
        return config
    return replace(
        config, leave_out=tuple(item for item in ITEMS if item in {*config.leave_out, "resolution"})
    )
