"""What trades accuracy for time in the rasterizer, set for one pass; the defaults are the product's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from unittest.mock import patch

import torch

from benchmarks.speed.inputs import RasterInputs
from benchmarks.speed.rasterizer import RasterPass
from hqgs import _rust

NO_FLOOR = 1e-12  # alpha: what lies below it in all layers together is less than a rounding of the image


@dataclass(frozen=True)
class Knobs:
    """The settings of `AccuracyKnobs` in rust/accuracy_knobs.rs, and the dtype."""

    dtype: str = "float32"
    alpha_min: float = _rust.ALPHA_MIN  # smallest alpha that is blended
    transmittance_min: float = _rust.TRANSMITTANCE_MIN  # compositing stops there
    spans: str = "ellipse"  # the tiles of a Gaussian: of its support, its "box", or a 3-sigma "square"
    skip_blocks: bool = True  # leave out the 4 x 4 blocks that a Gaussian does not reach
    exp2_degree: int = 6  # of the polynomial in float32


DEFINED = Knobs(dtype="float64")  # the definition of docs/conventions.md, without float32's roundings
EXACT = Knobs(dtype="float64", alpha_min=NO_FLOOR, transmittance_min=0.0)  # and without its cutoffs

# (knob, value, settings); the first is what is measured against.
CASES: tuple[tuple[str, str, Knobs], ...] = (
    ("default", "", Knobs()),
    ("dtype", "float64", DEFINED),
    ("cutoffs", "none", Knobs(alpha_min=NO_FLOOR, transmittance_min=0.0)),
    ("cutoffs", "none, float64", EXACT),
    ("alpha floor", "1/1024", Knobs(alpha_min=1 / 1024)),
    ("alpha floor", "1/128", Knobs(alpha_min=1 / 128)),
    ("alpha floor", "1/64", Knobs(alpha_min=1 / 64)),
    ("transmittance stop", "1e-5", Knobs(transmittance_min=1e-5)),
    ("transmittance stop", "1e-3", Knobs(transmittance_min=1e-3)),
    ("transmittance stop", "1e-2", Knobs(transmittance_min=1e-2)),
    ("degree of 2^x", "5", Knobs(exp2_degree=5)),
    ("degree of 2^x", "4", Knobs(exp2_degree=4)),
    ("degree of 2^x", "3", Knobs(exp2_degree=3)),
    ("tiles", "bounding box", Knobs(spans="box")),
    ("tiles", "3-sigma square", Knobs(spans="square")),
    ("block skipping", "off", Knobs(skip_blocks=False)),
    ("tiles, skipping", "square, off", Knobs(spans="square", skip_blocks=False)),
)


@contextmanager
def tuned(knobs: Knobs) -> Iterator[None]:
    """Inside it the rasterizer has these knobs, the dtype aside."""
    values = (knobs.alpha_min, knobs.transmittance_min, knobs.spans, knobs.skip_blocks, knobs.exp2_degree)
    with patch.object(_rust, "project_forward", partial(_rust.project_forward, knobs=values)):
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
        names = ("means", "quats", "scales", "opacities", "sh")
        grads = {n: leaf.grad for n, leaf in zip(names, self.leaves, strict=True) if leaf.grad is not None}
        self.clear()
        return {name: tensor.double() for name, tensor in ({"image": image} | grads).items()}
