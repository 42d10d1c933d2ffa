"""What renders are compared with when it is known how the photos were made: the targets of HQGS."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs import _rust
from hqgs.diagnosis.photo import undo_enlargement
from hqgs.diagnosis.scene import Inspector
from hqgs.photos.formation import Operator, Separable, formation
from hqgs.photos.formula import Degradation, film_alone, parse_formation, small_side
from hqgs.photos.jpeg import Tables, tables_of_quality
from hqgs.photos.pixels import as_floats
from hqgs.scene.scene import Scene, View
from hqgs.training.config import AUTO
from hqgs.training.methods.base import Target

BLOCK = 8
# DCT coefficients on the scale where white is 1: of luma [rows, columns, 1], padded to whole blocks, and of
# chroma [rows, columns, 2], of the channels at half the size.
Coefficients = list[Tensor]


class JpegCells:
    """Distance of a picture to the cells of a JPEG photo with 4:2:0 chroma: what the file leaves open costs
    nothing.

    A JPEG file tells of each DCT coefficient only the nearest multiple of its step. A render whose
    coefficient lies within half a step of it would give the same file, so a pixel loss, which pulls it to the
    decoded photo, paints the codec's blocks. The views fill the cells: each photo is quantised in another
    place.
    """

    def __init__(self, tables: Tables, height: int, width: int) -> None:
        """`height`, `width`: of the photo, px."""
        # R, G, B to Y, Cb, Cr (ITU-T T.871, without the offset of the chroma, which no difference sees).
        to_ycbcr = np.array(
            [[0.299, 0.587, 0.114], [-0.168735892, -0.331264108, 0.5], [0.5, -0.418687589, -0.081312411]]
        )
        self._parts: list[tuple[Separable, Tensor]] = []  # luma and chroma, and the steps of each
        for table, halve, channels in zip(tables, (False, True), (to_ycbcr[:1], to_ycbcr[1:]), strict=True):
            operator = Separable.of(_analysis(height, halve), _analysis(width, halve), channels)
            rows, columns = (side // BLOCK for side in operator.size)
            steps = (torch.tensor(table).reshape(BLOCK, BLOCK) / 255).repeat(rows, columns)[..., None]
            self._parts.append((operator, steps.repeat(1, 1, len(channels))))
        self._pixels = height * width

    def coefficients(self, image: Tensor) -> Coefficients:
        """Of a picture [H, W, 3], white at 1; differentiable."""
        return [operator(image) for operator, _ in self._parts]

    def centres(self, photo: Tensor) -> Coefficients:
        """The centres of the cells of a decoded photo [H, W, 3]: the nearest multiples of the steps.

        Decoding clips, rounds and smooths the chroma, so the coefficients of the decoded pixels are a little
        off the multiples that the file holds.
        """
        return [torch.round(operator(photo) / steps) * steps for operator, steps in self._parts]

    def loss(self, image: Tensor, centres: Coefficients) -> Tensor:
        """Mean distance to the cells per colour value, a scalar; 0 where the file could be this picture's.

        Args:
            image: [H, W, 3], white at 1.
            centres: of the photo, of the image's dtype.
        """
        scale = 1 / (3 * self._pixels)
        luma, chroma = (
            _Distance.apply(operator(image), c, steps, scale)
            for (operator, steps), c in zip(self._parts, centres, strict=True)
        )
        return luma + chroma


class _Distance(torch.autograd.Function):
    """`scale` times the sum of relu(|c - centre| - steps / 2). The gradient comes with the value."""

    @staticmethod
    def forward(ctx: Any, c: Tensor, centres: Tensor, steps: Tensor, scale: float) -> Tensor:
        x, y, widths = (t.detach().contiguous().numpy() for t in (c, centres, steps.to(c)))
        value, grad = _rust.cell_distance(x, y, widths, scale, ctx.needs_input_grad[0])
        if grad is not None:
            ctx.save_for_backward(torch.from_numpy(grad).view(c.shape))
        return c.new_tensor(value)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's own is too general)
        ctx: Any, v_distance: Tensor
    ) -> tuple[Tensor, None, None, None]:
        (grad,) = ctx.saved_tensors
        return v_distance * grad, None, None, None


def _analysis(side: int, halve: bool) -> NDArray[np.float64]:
    """The matrix from pixels to DCT coefficients along one axis, [whole blocks, side].

    The last pixel is repeated to fill the last block, as libjpeg does; `halve` takes means of two first.
    """
    unit = 2 * BLOCK if halve else BLOCK
    padded = -(-side // unit) * unit
    matrix: NDArray[np.float64] = np.eye(side)[np.minimum(np.arange(padded), side - 1)]
    if halve:
        matrix = (matrix[::2] + matrix[1::2]) / 2
    k, x = np.arange(BLOCK)[:, None], np.arange(BLOCK)
    dct = np.cos((2 * x + 1) * k * np.pi / (2 * BLOCK)) * np.sqrt(2 / BLOCK)
    dct[0] /= np.sqrt(2)
    blocks = matrix.reshape(-1, BLOCK, side)
    return (dct @ blocks).reshape(-1, side)


HELD_PIXELS = 50  # one pixel of so many is held back under noise
LEAST_RATE = 1e-12  # share of the learning rates, at which nothing moves
PLATEAU_STEPS = 200  # from one look at them to the next, at least; without a gain the rates are halved


@dataclass(frozen=True)
class HeldPixels:
    """Pixels of one photo that its loss leaves out."""

    places: Tensor  # [P], of the rows of the photo as [H W, 3]
    colors: Tensor  # [P, 3], white at 1

    @classmethod
    def draw(cls, number: int, photo: Tensor, mask: Tensor | None) -> tuple[HeldPixels, Tensor]:
        """One of HELD_PIXELS pixels [H, W, 3] that count, and the mask, bool [H, W], of the others.

        The draw follows from the photo's number alone.
        """
        counts = torch.ones(photo.shape[:2], dtype=torch.bool) if mask is None else mask.clone()
        places = torch.nonzero(counts.ravel())[:, 0].numpy()
        drawn = np.random.default_rng(number).choice(
            places, math.ceil(1 / HELD_PIXELS * len(places)), replace=False
        )
        held = torch.from_numpy(drawn)
        counts.view(-1)[held] = False
        colors = torch.from_numpy(as_floats(photo.reshape(-1, 3)[held].numpy()))
        return cls(held, colors), counts

    def error(self, image: Tensor) -> Tensor:
        """Mean squared error there of `image` [H, W, 3], a float64 scalar."""
        return (image.detach().reshape(-1, 3)[self.places] - self.colors).square().double().mean()


class Plateau:
    """The learning rates that the held pixels ask for.

    White noise in a pixel tells nothing of the noise beside it, so a render comes nearer to these pixels only
    where it comes nearer to the scene. Every PLATEAU_STEPS steps, rounded up to whole epochs, their mean
    squared error is looked at. They are the same pixels each time, so their noise is in each error alike.
    Where it is not smaller than at the best look, the rates are halved, as on a plateau of any held-back
    error.
    """

    def __init__(self, num_photos: int) -> None:
        self.rate_left: float = 1.0  # share of the learning rates
        self._interval = num_photos * math.ceil(PLATEAU_STEPS / num_photos)
        self._steps = 0
        self._sums, self._counts = torch.zeros(2, num_photos, dtype=torch.float64)
        self._best = torch.full((num_photos,), torch.nan, dtype=torch.float64)

    def see(self, photo: int, error: Tensor) -> None:
        """Note a step: the error of the held pixels of the photo of that number."""
        if torch.isfinite(error):  # otherwise the step is skipped, or all of the photo is masked
            self._sums[photo] += error
            self._counts[photo] += 1
        self._steps += 1
        if self._steps % self._interval == 0:
            self._look()

    def state_dict(self) -> dict[str, Tensor]:
        rate, steps = torch.tensor(self.rate_left, dtype=torch.float64), torch.tensor(self._steps)
        errors = {"sums": self._sums, "counts": self._counts, "best": self._best}
        return {"rate_left": rate, "steps": steps} | {name: t.clone() for name, t in errors.items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """KeyError where a part is missing, ValueError where it is of other photos."""
        for name in ("sums", "counts", "best"):
            if state[name].shape != self._best.shape:
                raise ValueError(f"{name} is {list(state[name].shape)}, wanted {list(self._best.shape)}")
        self.rate_left, self._steps = float(state["rate_left"]), int(state["steps"])
        self._sums, self._counts, self._best = (state[name].clone() for name in ("sums", "counts", "best"))

    def _look(self) -> None:
        now = self._sums / self._counts  # NaN for a photo that no step has seen since the last look
        gains = self._best - now
        known = torch.isfinite(gains)
        if known.any() and gains[known].mean() <= 0:
            self.rate_left = max(self.rate_left / 2, LEAST_RATE)
        else:
            self._best = torch.where(torch.isfinite(now), now, self._best)
        self._sums.zero_()
        self._counts.zero_()


# Levels of noise that the codec of a coarse film counts as: +0.4 dB to none on four scenes under `video:36`.
FILM_NOISE = 20.0


@dataclass(frozen=True)
class FormedTarget(Target):
    """The photo as it was taken, and how a render becomes like it."""

    operator: Operator | None  # from the render to the photo
    cells: JpegCells | None  # that the photo's file leaves open
    centres: Coefficients | None  # of these cells
    held: HeldPixels | None = None  # which the mask leaves out too
    noise: float = 0.0  # of this photo: standard deviation, where 1 is white

    @property
    def kept(self) -> int:
        """Luma coefficients that the photo's file holds: those that its codec did not round to zero."""
        return 0 if self.centres is None else int(torch.count_nonzero(self.centres[0]))


class Formation:
    """How a scene's photos were made."""

    def __init__(
        self, degradation: Degradation, directions: Mapping[str, float], noises: Mapping[str, float]
    ) -> None:
        """`directions`: of each photo's motion, radians from x towards y (down), where it is known.

        `noises`: of the photos that have noise of their own, where 1 is white.
        """
        self.degradation = degradation
        kinds = {step.kind: step.value for step in degradation.steps}
        self.kinds: frozenset[str] = frozenset(kinds)
        self.noise: float = noise_of(degradation)  # standard deviation, where 1 is white
        self.factor: int = int(kinds.get("lowres") or 1)  # by which the photos were enlarged
        self._quality = int(kinds["jpeg"] or 0) if "jpeg" in kinds else None
        self.directions: Mapping[str, float] = directions
        self.noises: Mapping[str, float] = noises
        self._operators: dict[tuple[int, int, float | None], Operator | None] = {}
        self._cells: dict[tuple[int, int], JpegCells] = {}

    def target(self, view: View) -> FormedTarget:
        """Of a training view. ValueError, which names it, where the photo does not fit the formation."""
        size, direction = (view.camera.height, view.camera.width), self.directions.get(view.name)
        key = (*size, direction)
        if key not in self._operators:
            self._operators[key] = formation(self.degradation, *size, direction)
        operator = self._operators[key]
        array = np.require(_photo(view, self.factor), requirements=["C", "W"])
        if operator is not None and operator.size != array.shape[:2]:
            raise ValueError(
                f"view {view.name!r}: the photo is {list(array.shape[:2])}, but {self.degradation} of its "
                f"camera's {list(size)} px gives {list(operator.size)}"
            )
        mask = view.mask
        if mask is not None and operator is not None:
            mask = operator.mask(mask)
        cells = centres = None
        if self._quality is not None:
            height, width = array.shape[:2]
            if (height, width) not in self._cells:
                self._cells[height, width] = JpegCells(tables_of_quality(self._quality), height, width)
            cells = self._cells[height, width]
            centres = cells.centres(torch.from_numpy(as_floats(array)))
        return FormedTarget(
            torch.from_numpy(array),
            None if mask is None else torch.from_numpy(mask),
            operator,
            cells,
            centres,
            noise=self.noises.get(view.name, self.noise),
        )


def noise_of(degradation: Degradation) -> float:
    """Standard deviation of the photos' noise, where 1 is white; of a coarse film what its codec left."""
    if film_alone({step.kind for step in degradation.steps}):
        return FILM_NOISE / 255
    return next((step.value or 0.0 for step in degradation.steps if step.kind == "noise"), 0.0) / 255


def find_formation(scene: Scene, text: str, inspector: Inspector) -> Formation:
    """The formation that `text` names, with "auto" the diagnosed one."""
    degradation = parse_formation(inspector.diagnose(scene).formation if text == AUTO else text)
    kinds = {step.kind for step in degradation.steps}
    directions, noises = dict[str, float](), dict[str, float]()  # of photos that tell one
    if kinds & {"motion", "grain"}:
        for photo in inspector.diagnose(scene, max_photos=len(scene.train)).photos:
            if "motion" in kinds and photo.blur is not None and photo.blur.direction is not None:
                directions[photo.name] = math.radians(photo.blur.direction)
            if "grain" in kinds and photo.told_noise is not None:
                noises[photo.name] = photo.told_noise / 255
    return Formation(degradation, directions, noises)


def _photo(view: View, factor: int) -> NDArray[np.uint8] | NDArray[np.float32]:
    """The photo as it was taken: the small one where it was enlarged by `factor`."""
    if factor == 1:
        return view.image
    if view.low is not None:
        return view.low
    size = (small_side(side, factor) for side in view.image.shape[:2])
    return undo_enlargement(as_floats(view.image).astype(np.float64), *size).astype(np.float32)
