"""What trades accuracy for time in the rasterizer, set for one pass; the defaults are the product's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unittest.mock import patch

import torch

from benchmarks import places
from benchmarks.data import build, read_toml
from benchmarks.speed.inputs import LEAVES, RasterInputs
from benchmarks.speed.rasterizer import RasterPass
from hqgs._rust import ALPHA_MIN, TRANSMITTANCE_MIN

FILE = Path(__file__).with_name("accuracy.toml")


@dataclass(frozen=True)
class Knobs:
    """The settings of `AccuracyKnobs` in rust/accuracy_knobs.rs, and the dtype."""

    dtype: str = "float32"
    alpha_min: float = ALPHA_MIN  # smallest alpha that is blended
    transmittance_min: float = TRANSMITTANCE_MIN  # compositing stops there
    spans: str = "ellipse"  # the tiles of a Gaussian: of its support, its "box", or a 3-sigma "square"
    skip_blocks: bool = True  # leave out the 4 x 4 blocks that a Gaussian does not reach
    exp2_degree: int = 6  # of the polynomial in float32


# (knob, value, settings); the first is what is measured against.
CASES = [
    (knob, value, build(Knobs, settings, f"{FILE.name}, {knob} {value}"))
    for knob, values in read_toml(FILE)["cases"].items()
    for value, settings in values.items()
]
ORACLES = {  # the definition of docs/conventions.md without float32's roundings, and without its cutoffs
    "exact": next(knobs for knob, value, knobs in CASES if (knob, value) == ("cutoffs", "none, float64")),
    "defined": next(knobs for knob, value, knobs in CASES if (knob, value) == ("dtype", "float64")),
}


@contextmanager
def tuned(knobs: Knobs) -> Iterator[None]:
    """Inside it the rasterizer has these knobs, the dtype aside."""
    values = (knobs.alpha_min, knobs.transmittance_min, knobs.spans, knobs.skip_blocks, knobs.exp2_degree)
    with patch.object(*places.PROJECT, partial(getattr(*places.PROJECT), knobs=values)):
        yield


class TunedPass(RasterPass):
    """A pass with other settings than the default."""

    def __init__(self, inputs: RasterInputs, knobs: Knobs) -> None:
        super().__init__(inputs, dtype=getattr(torch, knobs.dtype))
        self.knobs = knobs

    def run(self) -> torch.Tensor:
        with tuned(self.knobs):
            return super().run()

    def outputs(self) -> dict[str, torch.Tensor]:
        """The image, and the gradient of each input by its name, all in float64."""
        image = self.run()
        grads = {n: leaf.grad for n, leaf in zip(LEAVES, self.leaves, strict=True) if leaf.grad is not None}
        self.clear()
        return {name: tensor.double() for name, tensor in ({"image": image} | grads).items()}
