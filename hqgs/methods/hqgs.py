"""HQGS as it is used by default: the loss knows how the photos were degraded, and only that part is done."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.camera import Scene, View
from hqgs.degradations import Degradation, parse_degradation, shrink
from hqgs.formation import formation
from hqgs.gaussians import Gaussians
from hqgs.jpeg_cells import Coefficients, JpegCells, tables_of_quality
from hqgs.losses import photometric_loss
from hqgs.separable import Separable

LAMBDA_DSSIM = 0.2


@dataclass(frozen=True)
class HQGSConfig:
    """What HQGS assumes and how it weighs its terms. ValueError for a value out of range."""

    formation: str = "none"  # what happened to the photos, in the grammar of `parse_degradation`
    jpeg_pixels: float = 0.2  # weight of the pixel loss beside the loss of the JPEG cells

    def __post_init__(self) -> None:
        parse_degradation(self.formation)
        if not self.jpeg_pixels >= 0:
            raise ValueError(f"jpeg_pixels is {self.jpeg_pixels}, wanted at least 0")


@dataclass(frozen=True)
class Target:
    """What a view's renders are compared with."""

    operator: Separable | None  # from the render to the photo
    photo: Tensor  # [h, w, 3] float32
    mask: Tensor | None  # [h, w] bool, True where it counts
    centres: Coefficients | None  # of the photo's JPEG cells


class HQGS:
    """The image formation in the loss.

    - Blur and low resolution: the render is blurred and shrunk as the photo was, and compared there.
    - JPEG: beside the pixels, the render is compared with the cells that the file leaves open (`JpegCells`).
    - Noise or JPEG: no D-SSIM. It is normalised by the local contrast, so that it asks for the noise in flat
      parts; L1 averages the noise over the views.
    - None of them: the loss of 3DGS.
    """

    def __init__(self, scene: Scene, config: HQGSConfig) -> None:
        """ValueError where the photos do not fit the formation."""
        self.config = config
        self.degradation = parse_degradation(config.formation)
        kinds = {step.kind: step.value for step in self.degradation.steps}
        self._lowres = "lowres" in kinds
        self._jpeg = int(kinds["jpeg"] or 0) if "jpeg" in kinds else None
        self._dssim = 0.0 if "noise" in kinds or self._jpeg else LAMBDA_DSSIM
        self._operators: dict[tuple[int, int], Separable | None] = {}
        self._cells: dict[tuple[int, int], JpegCells] = {}
        self._targets = {view.name: self._target(view) for view in scene.train}

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        return gaussians

    def loss(self, render: Tensor, view: View) -> Tensor:
        target = self._targets[view.name]
        image = render if target.operator is None else target.operator(render)
        pixels = photometric_loss(image, target.photo, target.mask, self._dssim)
        if target.centres is None:
            return pixels
        if target.mask is not None:
            image = torch.where(target.mask[..., None], image, target.photo)
        cells = self._cells[target.photo.shape[0], target.photo.shape[1]]
        return cells.loss(image, target.centres) + self.config.jpeg_pixels * pixels

    def param_groups(self) -> list[dict[str, Any]]:
        return []

    def state_dict(self) -> dict[str, Tensor]:
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        if state:
            raise ValueError(f"hqgs has no state of its own, the checkpoint has {sorted(state)}")

    def _target(self, view: View) -> Target:
        size = view.camera.height, view.camera.width
        if size not in self._operators:
            self._operators[size] = formation(self.degradation, *size)
        operator = self._operators[size]
        photo = torch.from_numpy(_photo(view, self.degradation, self._lowres))
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
            centres = self._cells[height, width].centres(photo)
        return Target(operator, photo, None if mask is None else torch.from_numpy(mask), centres)


def _photo(view: View, degradation: Degradation, lowres: bool) -> NDArray[np.float32]:
    """The photo as it was taken: the small one where it was enlarged."""
    if lowres and view.low is not None:
        return np.ascontiguousarray(view.low)
    image = np.divide(view.image, 255 if view.image.dtype == np.uint8 else 1, dtype=np.float32)
    if lowres:  # enlarged somewhere else: back to the resolution that it really has
        factor = next(int(step.value or 1) for step in degradation.steps if step.kind == "lowres")
        image = shrink(image, factor)
    return np.ascontiguousarray(image)
