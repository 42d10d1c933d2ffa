"""HQGS as it is used by default: the loss knows how the photos were degraded, and only that part is done."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.base.text import some
from hqgs.diagnosis import diagnose_scene
from hqgs.diagnosis.resolution import undo_enlargement
from hqgs.model.first_points import Colors, Points, points_along_edges
from hqgs.model.gaussians import Gaussians
from hqgs.model.smoothing import enlarge
from hqgs.photos.formation import Operator, formation
from hqgs.photos.formula import Degradation, parse_degradation, small_side
from hqgs.photos.jpeg import tables_of_quality
from hqgs.photos.pixels import as_floats, floats
from hqgs.scene.geometry import photo_pixels
from hqgs.scene.scene import Scene, View
from hqgs.training.config import AUTO, PAPER, DensifyConfig, HQGSConfig
from hqgs.training.methods.base import Method, Plain, photo_tensors
from hqgs.training.methods.held_pixels import SHARE, HeldPixels
from hqgs.training.methods.jpeg_cells import Coefficients, JpegCells
from hqgs.training.methods.paper import PaperHQGS
from hqgs.training.methods.photometric import photometric_loss

if TYPE_CHECKING:
    from hqgs.training.config import TrainConfig

LAMBDA_DSSIM = 0.2
KNEE = 2.0  # standard deviations of the noise up to which differences count by their square
STEEPER = 2.0  # on average the square is half as steep there as L1, and growth goes by the gradient
HALVING = 6.0  # levels of noise at which two pixels tell what one does without noise
DETERMINED = 600.0  # Gaussians under noise, times the cube root of the pixels' worth of photos
REFRESH = 100  # steps until the sizes of the smallest Gaussians are computed again


@dataclass(frozen=True)
class Target:
    """What a view's renders are compared with."""

    operator: Operator | None  # from the render to the photo
    photo: Tensor  # [h, w, 3], uint8 where the photo is
    mask: Tensor | None  # [h, w] bool, True where it counts
    centres: Coefficients | None  # of the photo's JPEG cells


class HQGS(Plain):
    """The image formation in the loss.

    - Blur of any kind and low resolution: the render is blurred and shrunk as the photo was, and compared
      there. The direction of a motion is each photo's own, as the diagnosis tells it.
    - JPEG: beside the pixels, the render is compared with the cells that the file leaves open (`JpegCells`).
    - Noise or JPEG: no D-SSIM. It is normalised by the local contrast, so that it asks for the noise in flat
      parts.
    - Noise: differences count by their square up to two standard deviations of the noise (Huber's function).
      The mean of Gaussian noise over the views is nearer to the truth than their median, which L1 asks for.
    - None of them: the loss of 3DGS.
    - No Gaussian is smaller than half a pixel of the photos: what is finer, no photo has seen.
    - The less the photos tell, the fewer Gaussians they determine: growth ends at a share of the pixels.
      Blur makes a pixel count less, and a photo tells no more than the coefficients that its codec kept. More
      Gaussians paint the ringing of deblurring.
    - Noise: growth ends at a multiple of E^(1/3), where E counts a pixel less for its noise. With M
      anisotropic atoms the error of a picture with edges falls as M^-2 (Candes and Donoho 2004), and that by
      the noise grows as M / E: their sum is least at an M that goes with E^(1/3).
    - Where the reconstruction has few points for that number, as it has from bad photos, the run starts from
      more: pixels along the photos' edges, at the depth of the points around them (`points_along_edges`).
    - Noise: the learning rates are halved as often as a fiftieth of the pixels, which the loss leaves out,
      finds that nothing is gained any more (`HeldPixels`). At constant rates the Gaussians learn the noise.
    - No resets of the opacities: with growth at its budget, what a reset takes away seldom comes back where
      it was.
    - JPEG without noise: growth asks for less gradient, since within the cells there is none. A share k of
      coefficients outside their cells, of any sign, adds up to sqrt(k) of the gradient of all; the share that
      the codec kept stands for it.
    """

    name = "hqgs"

    def __init__(self, scene: Scene, config: HQGSConfig) -> None:
        """ValueError where the photos do not fit the formation."""
        self.config = config
        self._left_out: list[tuple[str, str]] = []
        self.degradation = (
            self._diagnose(scene) if config.formation == AUTO else parse_degradation(config.formation)
        )
        self._least = len(scene.points)
        kinds = {step.kind: step.value for step in self.degradation.steps}
        self.noise = float(kinds.get("noise") or 0.0) / 255
        self._factor = int(kinds.get("lowres") or 1)
        self._jpeg = int(kinds["jpeg"] or 0) if "jpeg" in kinds else None
        self._knee = KNEE * self.noise if self._jpeg is None else 0.0
        self._dssim = 0.0 if "noise" in kinds or self._jpeg else LAMBDA_DSSIM
        self._directions = self._motion_directions(scene) if "motion" in kinds else {}
        self._operators: dict[tuple[int, int, float | None], Operator | None] = {}
        self._cells: dict[tuple[int, int], JpegCells] = {}
        self._views = scene.train
        self._smallest: Tensor | None = None  # [N] world units; None: to be computed
        self._age = 0  # steps since it was
        self._targets = {view.name: self._target(view) for view in scene.train}
        self._held: HeldPixels | None = None
        if self._knee:
            self._held = HeldPixels({name: (t.photo, t.mask) for name, t in self._targets.items()})
            what = f"1/{1 / SHARE:.0f} of each photo's pixels in the loss"
            self._left_out.append((what, "they tell when the scene would start to learn the noise"))
            masks = self._held.masks
            self._targets = {name: replace(t, mask=masks[name]) for name, t in self._targets.items()}

    @property
    def as_photographed(self) -> bool:
        return not self.degradation.steps

    @property
    def rate_left(self) -> float:
        return 1.0 if self._held is None else self._held.rate_left

    def compared(self, render: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor | None]:
        if self.as_photographed:
            return super().compared(render, view)
        target = self._targets[view.name]
        image = render if target.operator is None else target.operator(render)
        return image, floats(target.photo), target.mask

    def adapt(self, config: TrainConfig) -> TrainConfig:
        """The formation that was found, and a budget of Gaussians that the photos can determine."""
        hqgs = replace(config.hqgs, formation=str(self.degradation))
        kinds = {step.kind for step in self.degradation.steps}
        densify = config.densify
        budget, threshold = densify.max_gaussians, densify.grad_threshold
        if self.degradation.steps:
            targets = self._targets.values()
            told = sum(self._sharp_pixels(target) for target in targets)
            if "jpeg" in kinds and "noise" not in kinds:
                kept = sum(self._kept(target) for target in targets)
                pixels = sum(target.photo[..., 0].numel() for target in targets)
                threshold = min(threshold, DensifyConfig.grad_threshold * math.sqrt(min(kept / pixels, 1.0)))
                told = min(told, kept)
            most = self.config.gaussians_per_pixel * told
            if self.noise:
                told = sum(self._sharp_pixels(target, self.noise) for target in targets)
                most = min(most, DETERMINED * told ** (1 / 3))
            budget = min(budget, max(int(most), self._least))
            if densify.reset_every < densify.stop:
                self._left_out.append(("resets of the opacities", "a budget of Gaussians bears none"))
            densify = replace(
                densify,
                max_gaussians=budget,
                grad_threshold=threshold,
                reset_every=max(densify.reset_every, densify.stop),
            )
        method = config.method
        if method == AUTO:
            method = "hqgs" if self.degradation.steps else "3dgs"
        return replace(config, method=method, hqgs=hqgs, densify=densify)

    def first_points(self, scene: Scene, config: TrainConfig) -> tuple[Points, Colors]:
        what, points, colors = "first points along edges", scene.points, scene.point_colors
        wanted = int(self.config.first_points * config.densify.max_gaussians)
        if self.as_photographed or not wanted:
            return points, colors
        if scene.seen is None:
            self._left_out.append((what, "the scene does not tell which photos see which of its points"))
        elif len(points) >= wanted:
            self._left_out.append((what, f"it has {len(points)} points for {wanted} that are called for"))
        else:
            count = wanted - len(points)
            more = points_along_edges(scene.train, points, scene.seen, count, config.seed)
            points, colors = np.concatenate([points, more[0]]), np.concatenate([colors, more[1]])
        return points, colors

    def left_out(self) -> list[tuple[str, str]]:
        return self._left_out

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        if not self.degradation.steps or not self.config.smallest:
            return gaussians
        if self._smallest is None:
            pixels = photo_pixels(gaussians.means, self._views) * self._factor
            self._smallest = (self.config.smallest * pixels).float()
            self._age = 0
        return enlarge(gaussians, self._smallest)

    def rows_changed(self) -> None:
        self._smallest = None

    def state_dict(self) -> dict[str, Tensor]:
        state = {}
        if self._held is not None:
            state = {f"held.{name}": tensor for name, tensor in self._held.state_dict().items()}
        if self._smallest is not None:
            state |= {"smallest": self._smallest, "age": torch.tensor(self._age)}
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._smallest = state.get("smallest")
        self._age = int(state.get("age", 0))
        if self._held is not None:
            own = {n.removeprefix("held."): t for n, t in state.items() if n.startswith("held.")}
            self._held.load_state_dict(own)

    def loss(self, render: Tensor, view: View) -> Tensor:
        if self.as_photographed:
            photo, mask = photo_tensors(view)
            return photometric_loss(render, photo, mask, self._dssim)
        self._age += 1
        if self._age >= REFRESH:
            self._smallest = None
        target = self._targets[view.name]
        image = render if target.operator is None else target.operator(render)
        if self._held is not None:
            self._held.see(view.name, image)
        pixels = photometric_loss(image, target.photo, target.mask, self._dssim, self._knee)
        if target.centres is None:
            return STEEPER * pixels if self._knee else pixels
        if target.mask is not None:
            image = torch.where(target.mask[..., None], image, floats(target.photo))
        cells = self._cells[target.photo.shape[0], target.photo.shape[1]]
        return cells.loss(image, target.centres) + self.config.jpeg_pixels * pixels

    def _sharp_pixels(self, target: Target, noise: float = 0.0) -> float:
        """How many sharp pixels without noise would tell as much as this photo does, roughly.

        A blur of sigma px spreads a point over 4 pi sigma^2 pixels, a disc or a line over its own. Noise (its
        standard deviation, where 1 is white) of s levels asks for the mean of (s / HALVING)^2 more pixels
        until it is below what one pixel may be off.
        """
        height, width = target.photo.shape[:2]
        share = 1.0 + (255 * noise / HALVING) ** 2
        for step in self.degradation.for_width(width * self._factor).steps:
            value = step.value or 0.0
            value_in_photo = value / self._factor
            if step.kind == "blur":
                share += 4 * math.pi * value_in_photo**2
            elif step.kind == "defocus":
                share += math.pi * value_in_photo**2
            elif step.kind == "motion":
                share += value_in_photo
        return height * width / share

    @staticmethod
    def _kept(target: Target) -> int:
        """How many luma coefficients the photo's file holds: those that its codec did not round to zero."""
        return 0 if target.centres is None else int(torch.count_nonzero(target.centres.luma))

    def _diagnose(self, scene: Scene) -> Degradation:
        diagnosis = diagnose_scene(scene)
        self._left_out = [
            (f"{part} in the loss", why) for part, needed, why in diagnosis.needs() if not needed
        ]
        return parse_degradation(diagnosis.formation)

    def _motion_directions(self, scene: Scene) -> dict[str, float]:
        """Radians by photo, for those that tell one; the others are listed as left out."""
        found = {
            photo.name: math.radians(photo.blur.direction)
            for photo in diagnose_scene(scene, max_photos=len(scene.train)).photos
            if photo.blur is not None and photo.blur.direction is not None
        }
        if unknown := [view.name for view in scene.train if view.name not in found]:
            what = f"motion in the loss of {len(unknown)} of {len(scene.train)} photos"
            self._left_out.append((what, f"no direction is told from {some(unknown)}"))
        return found

    def _target(self, view: View) -> Target:
        size, direction = (view.camera.height, view.camera.width), self._directions.get(view.name)
        key = (*size, direction)
        if key not in self._operators:
            self._operators[key] = formation(self.degradation, *size, direction)
        operator = self._operators[key]
        array = np.require(_photo(view, self._factor), requirements=["C", "W"])
        photo = torch.from_numpy(array)
        if operator is not None and operator.size != photo.shape[:2]:
            raise ValueError(
                f"view {view.name!r}: the photo is {list(photo.shape[:2])}, but {self.config.formation} of "
                f"its camera's {list(size)} px gives {list(operator.size)}"
            )
        mask = view.mask
        if mask is not None and operator is not None:
            mask = operator.mask(mask)
        centres = None
        if self._jpeg is not None:
            height, width = photo.shape[:2]
            if (height, width) not in self._cells:
                self._cells[height, width] = JpegCells(tables_of_quality(self._jpeg), height, width)
            centres = self._cells[height, width].centres(torch.from_numpy(as_floats(array)))
        return Target(operator, photo, None if mask is None else torch.from_numpy(mask), centres)


def _photo(view: View, factor: int) -> NDArray[np.uint8] | NDArray[np.float32]:
    """The photo as it was taken: the small one where it was enlarged by `factor`."""
    if factor == 1:
        return view.image
    if view.low is not None:
        return view.low
    size = (small_side(side, factor) for side in view.image.shape[:2])
    return undo_enlargement(as_floats(view.image).astype(np.float64), *size).astype(np.float32)


def make_hqgs(scene: Scene, config: HQGSConfig, seed: int) -> Method:
    """HQGS with the guidance that `config` names."""
    if config.guidance == PAPER:
        return PaperHQGS(scene, seed, config.paper)
    return HQGS(scene, config)
