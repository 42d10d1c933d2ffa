"""Whether a scene learns the noise of its photos: told by a few pixels that it is not trained on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hqgs.photos.pixels import as_floats

HELD_PIXELS = 50  # one pixel of so many is held back under noise
PLATEAU_STEPS = 200  # from one look at them to the next, at least; without a gain the rates are halved


@dataclass(frozen=True)
class HeldPixels:
    """Pixels of one photo that its loss leaves out."""

    photo: int  # its number in the scene
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
        return cls(number, held, colors), counts

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
            self.rate_left /= 2
        else:
            self._best = torch.where(torch.isfinite(now), now, self._best)
        self._sums.zero_()
        self._counts.zero_()
