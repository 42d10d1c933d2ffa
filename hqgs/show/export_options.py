"""What an export may leave out."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hqgs.model.constants import MAX_SH_DEGREE
from hqgs.model.formats.files import WRITTEN
from hqgs.model.formats.spz import SH_BITS, VERSIONS


@dataclass(frozen=True)
class ExportOptions:
    """What is written of a scene."""

    format: str  # one of `WRITTEN`
    sh_degree: int = MAX_SH_DEGREE  # at most
    band_tolerance: float = 0.004  # of a colour, white at 1: a level of an 8-bit picture; 0: every band stays
    sh_bits: tuple[int, int] = SH_BITS  # SPZ: of the coefficients of degree 1, and of degrees 2 and 3
    spz_version: int = VERSIONS[0]

    def __post_init__(self) -> None:
        if self.format not in WRITTEN:
            raise ValueError(f"format is {self.format!r}, wanted one of: {', '.join(WRITTEN)}")
        if not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise ValueError(f"sh_degree is {self.sh_degree}, wanted 0..{MAX_SH_DEGREE}")
        if not 0 <= self.band_tolerance < math.inf:
            raise ValueError(f"band_tolerance is {self.band_tolerance}, wanted a number that is not negative")
        if not all(1 <= bits <= 8 for bits in self.sh_bits):
            raise ValueError(f"sh_bits is {self.sh_bits}, wanted two numbers in 1..8")
        if self.spz_version not in VERSIONS:
            raise ValueError(
                f"spz_version is {self.spz_version}, wanted one of: {', '.join(map(str, VERSIONS))}"
            )
