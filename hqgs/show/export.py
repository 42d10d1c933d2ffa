"""Scene files with no more than a scene needs: fewer Gaussians, fewer SH bands, fewer bits.

A Gaussian is left out where no pixel can show it. It loses its highest SH bands where they cannot change the
colour that it adds to a pixel by more than a tolerance, and the file loses a band that (next to) no Gaussian
uses. The bound: by Unsöld's theorem the functions of degree l have the norm sqrt((2 l + 1) / (4 pi)) in every
direction, so the band adds at most that times the norm of its coefficients to a channel, in any view; the
Gaussian's opacity bounds its weight in a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from hqgs._rust import ALPHA_MIN, QUAT_NORM2_MIN
from hqgs.base.left_out import LeftOut
from hqgs.model.formats.arrays import curve_order
from hqgs.model.formats.beside import keep_world
from hqgs.model.formats.files import FORMATS
from hqgs.model.formats.sog import encode_sog
from hqgs.model.formats.spz import encode_spz, write_spz
from hqgs.model.gaussians import Gaussians
from hqgs.show.constants import BAND_SHARE
from hqgs.show.export_options import ExportOptions


@dataclass(frozen=True)
class Export:
    """A file that was written."""

    path: Path
    bytes: int
    gaussians: int
    sh_degree: int
    left_out: list[LeftOut]
    clipped: dict[str, int]  # SPZ: values outside its ranges, by name


def export(gaussians: Gaussians, path: str | Path, options: ExportOptions) -> Export:
    """Write what the options leave of the Gaussians, atomically.

    The Gaussians of a PLY file keep their order, those of an SPZ or SOG file get one that packs well.

    Raises ValueError where SPZ cannot hold the scene (see `hqgs.model.formats.spz.encode_spz`).
    """
    path = Path(path)
    steps = reduce_gaussians(gaussians, options)
    reduced = steps[-1].gaussians if steps else gaussians
    clipped: dict[str, int] = {}
    if options.format != "spz":
        reduced.save(path, options.format)
    else:
        arrays = along_a_curve(reduced).arrays()
        clipped = write_spz(path, arrays, options.sh_bits, options.spz_version).clipped
        keep_world(path, reduced.world)
    written = path.stat().st_size
    sizes = [_size(g, options) for g in (gaussians, *(step.gaussians for step in steps[:-1])) if steps]
    sizes.append(written if options.format == "spz" else _size(reduced, options))
    left_out = []
    for step, (before, after) in zip(steps, pairwise(sizes), strict=True):
        saved = None if before is None or after is None else before - after
        left_out.append(LeftOut(step.what, step.why, step.evidence, bytes=saved))
    if gaussians.antialiased and not FORMATS[options.format].antialiased:
        why = f"a .{options.format} file has no place for it: what is finer than a pixel is shown too opaque"
        left_out.append(LeftOut("the antialias flag", why))
    if gaussians.errors is not None and not FORMATS[options.format].errors:
        left_out.append(LeftOut("trust of the Gaussians", f"a .{options.format} file has no place for it"))
    return Export(path, written, len(reduced), reduced.sh_degree, left_out, clipped)


@dataclass(frozen=True)
class Reduction:
    """A part that was left out, and the Gaussians after that."""

    gaussians: Gaussians
    what: str
    why: str
    evidence: str | None = None


def reduce_gaussians(gaussians: Gaussians, options: ExportOptions) -> list[Reduction]:
    """What is left out in turn; nothing: an empty list. The Gaussians given stay what they are."""
    steps: list[Reduction] = []
    g = gaussians.detached()
    n = len(g)
    finite = g.finite()
    visible = (g.activated_opacities() >= ALPHA_MIN) & (g.quats.square().sum(dim=1) >= QUAT_NORM2_MIN)
    for keep, others, why in (
        (finite, n, "they hold NaN or Inf"),
        (finite & visible, int(finite.sum()), "no pixel can show them: opacity below 1/255 or no rotation"),
    ):
        if (gone := others - int(keep.sum())) > 0:
            steps.append(Reduction(gaussians.detached().rows(keep), f"{gone:,} Gaussians", why))
    g = steps[-1].gaussians if steps else g

    degrees = needed_degrees(g, options.band_tolerance)
    most = min(options.sh_degree, g.sh_degree) if options.format != "splat" else 0
    degree = file_degree(degrees, most)
    if degree < g.sh_degree:
        cut = int((degrees > degree).sum())
        asked = degree == options.sh_degree
        why = (
            "a .splat file holds none"
            if options.format == "splat"
            else "--sh-degree asks for it"
            if asked
            else f"at most 1 in {1 / BAND_SHARE:,.0f} Gaussians needs them"
        )
        evidence = f"{cut:,} of {len(g):,} Gaussians change a colour by over {options.band_tolerance:g} there"
        bands = (
            f"degree {degree + 1}" if degree + 1 == g.sh_degree else f"degrees {degree + 1} to {g.sh_degree}"
        )
        g = _cut(g, degree)
        steps.append(Reduction(g, f"harmonics of {bands}", why, evidence))
    if options.format == "spz":  # zeros save nothing in the others, and in SOG little: 4 % of a file for 6 dB
        fewer = _without_bands(g, degrees)
        if changed := int((fewer.shN != g.shN).flatten(1).any(dim=1).sum()):
            why = f"they change a colour by at most {options.band_tolerance:g}"
            steps.append(Reduction(fewer, f"the highest harmonics of {changed:,} Gaussians", why))
    return steps


def needed_degrees(gaussians: Gaussians, tolerance: float) -> Tensor:
    """[N] int64: the lowest degree at which a Gaussian's harmonics may end.

    What lies above changes no channel of the colour that it adds to a pixel by more than the tolerance (white
    is 1), from any direction: opacity times the sum of the bounds of the bands that go.
    """
    n, rest = len(gaussians), gaussians.shN.double()
    opacities = gaussians.activated_opacities().double()
    degrees = torch.zeros(n, dtype=torch.int64)
    change = torch.zeros(n, 3, dtype=torch.float64)
    for degree in range(gaussians.sh_degree, 0, -1):
        band = rest[:, degree**2 - 1 : (degree + 1) ** 2 - 1]
        change += band.square().sum(dim=1).sqrt() * math.sqrt((2 * degree + 1) / (4 * math.pi))
        needed = opacities * change.amax(dim=1) > tolerance
        degrees = torch.where((degrees == 0) & needed, degree, degrees)
    return degrees


def file_degree(degrees: Tensor, most: int) -> int:
    """The degree of a file: that which all but a share of BAND_SHARE of the Gaussians do with."""
    allowed = BAND_SHARE * len(degrees)
    return next((d for d in range(most) if int((degrees > d).sum()) <= allowed), most)


def along_a_curve(gaussians: Gaussians) -> Gaussians:
    """The Gaussians along a Morton curve: neighbours in the file are neighbours in space, and pack better."""
    order = curve_order(gaussians.means.detach().numpy())
    return gaussians.rows(torch.from_numpy(order))


def _cut(gaussians: Gaussians, degree: int) -> Gaussians:
    return gaussians.like(gaussians.named() | {"shN": gaussians.shN[:, : (degree + 1) ** 2 - 1]})


def _without_bands(gaussians: Gaussians, degrees: Tensor) -> Gaussians:
    """With zeros for the coefficients above each Gaussian's degree."""
    places = torch.arange(gaussians.shN.shape[1])
    keep = places < ((degrees + 1).square() - 1)[:, None]
    return gaussians.like(gaussians.named() | {"shN": gaussians.shN * keep[:, :, None]})


def _size(gaussians: Gaussians, options: ExportOptions) -> int | None:
    """Bytes of the file without the text of a header; None where SPZ cannot hold them."""
    n, higher = len(gaussians), 3 * gaussians.shN.shape[1]
    if options.format in ("ply", "glb"):
        return 4 * n * (3 + 3 + higher + 1 + 3 + 4 + (gaussians.errors is not None))
    if options.format == "full.ply":
        return 4 * n * 62
    if options.format == "splat":
        return 32 * n
    if options.format == "compressed.ply":
        return n * (16 + higher) + -(-n // 256) * 72
    if options.format == "sog":
        return sum(map(len, encode_sog(along_a_curve(gaussians).arrays(), gaussians.antialiased).values()))
    try:
        return len(encode_spz(along_a_curve(gaussians).arrays(), options.sh_bits, options.spz_version).data)
    except ValueError:
        return None
