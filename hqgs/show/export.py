"""Scene files with no more than a scene needs: fewer Gaussians, fewer SH bands, fewer bits.

A Gaussian is left out where no pixel can show it. It loses its highest SH bands where they cannot change the
colour that it adds to a pixel by more than a tolerance, and the file loses a band that (next to) no Gaussian
uses. The bound: by Unsöld's theorem the functions of degree l have the norm sqrt((2 l + 1) / (4 pi)) in every
direction, so the band adds at most that times the norm of its coefficients to a channel, in any view; the
Gaussian's opacity bounds its weight in a pixel. Renders of what was written, read back, tell what it changed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from hqgs._rust import ALPHA_MIN, QUAT_NORM2_MIN
from hqgs.base.evenly import evenly
from hqgs.base.left_out import LeftOut
from hqgs.model.formats.arrays import curve_order
from hqgs.model.formats.beside import keep_world
from hqgs.model.formats.files import FORMATS
from hqgs.model.formats.spz import write_spz
from hqgs.model.gaussians import Gaussians, orbit
from hqgs.scene.camera_files import RunCameras
from hqgs.scene.constants import KEPT_SIDE
from hqgs.scene.geometry import shrunk_camera
from hqgs.scene.scene import Camera
from hqgs.show.export_options import ExportOptions

BAND_SHARE = 1e-3  # of the Gaussians: a band that no more of them use is left out for all
VIEWS = 4  # renders that tell what a file changes, as large as photos beside cameras.json


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
    reduced, left_out = reduce_gaussians(gaussians, options)
    clipped = _write(reduced, path, options)
    if gaussians.antialiased and not FORMATS[options.format].antialiased:
        why = f"a .{options.format} file cannot store it; detail finer than a pixel is shown too opaque"
        left_out.append(LeftOut("the antialias flag", why))
    if gaussians.errors is not None and not FORMATS[options.format].errors:
        left_out.append(LeftOut("trust of the Gaussians", f"a .{options.format} file cannot store it"))
    return Export(path, path.stat().st_size, len(reduced), reduced.sh_degree, left_out, clipped)


def reduce_gaussians(gaussians: Gaussians, options: ExportOptions) -> tuple[Gaussians, list[LeftOut]]:
    """What the options leave of them, and what is left out in turn. Those given stay as they are."""
    left_out = list[LeftOut]()
    g = gaussians.detached()
    n = len(g)
    finite = g.finite()
    visible = (g.activated_opacities() >= ALPHA_MIN) & (g.quats.square().sum(dim=1) >= QUAT_NORM2_MIN)
    for gone, why in (
        (n - int(finite.sum()), "their values are NaN or Inf"),
        (int((finite & ~visible).sum()), "invisible (opacity below 1/255, or no rotation)"),
    ):
        left_out += [LeftOut(f"{gone:,} Gaussians", why)] if gone else []
    if left_out:
        g = g.rows(finite & visible)

    degrees = needed_degrees(g, options.band_tolerance)
    most = min(options.sh_degree, g.sh_degree) if FORMATS[options.format].harmonics else 0
    degree = file_degree(degrees, most)
    if degree < g.sh_degree:
        cut = int((degrees > degree).sum())
        asked = degree == options.sh_degree
        why = (
            f"a .{options.format} file cannot store them"
            if not FORMATS[options.format].harmonics
            else "by --sh-degree"
            if asked
            else f"at most 1 in {1 / BAND_SHARE:,.0f} Gaussians needs them"
        )
        evidence = f"{cut:,} of {len(g):,} Gaussians change a colour by over {options.band_tolerance:g} there"
        bands = (
            f"degree {degree + 1}" if degree + 1 == g.sh_degree else f"degrees {degree + 1} to {g.sh_degree}"
        )
        g = g.like(g.named() | {"shN": g.shN[:, : (degree + 1) ** 2 - 1]})
        left_out.append(LeftOut(f"harmonics of {bands}", why, evidence))
    if options.format == "spz":  # zeros save nothing in the others, and in SOG little: 4 % of a file for 6 dB
        keep = torch.arange(g.shN.shape[1]) < ((degrees + 1).square() - 1)[:, None]
        fewer = g.shN * keep[:, :, None]
        if changed := int((fewer != g.shN).flatten(1).any(dim=1).sum()):
            why = f"they change colours by at most {options.band_tolerance:g}"
            left_out.append(LeftOut(f"the highest harmonics of {changed:,} Gaussians", why))
            g = g.like(g.named() | {"shN": fewer})
    return g, left_out


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


def _write(gaussians: Gaussians, path: Path, options: ExportOptions) -> dict[str, int]:
    """Write them as they are; how many values SPZ has no place for, by name."""
    if options.format != "spz":
        gaussians.save(path, options.format)
        return {}
    arrays = along_a_curve(gaussians).arrays()
    clipped = write_spz(path, arrays, options.sh_bits, options.spz_version).clipped
    keep_world(path, gaussians.world)
    return clipped


@dataclass(frozen=True)
class Change:
    """Between two scenes in the same cameras; levels are those of pictures with 8 bits, from 0 to 255."""

    cameras: str  # which those were
    psnr: float  # dB, over all pixels of all of them; inf where none changes
    mean: float  # levels, absolute
    worst: float  # levels, of one channel of one pixel
    where: tuple[str, int, int]  # the camera, row and column of that pixel

    def __str__(self) -> str:
        if not self.worst:
            return f"no pixel of {self.cameras} changes"
        camera, row, column = self.where
        return (
            f"{self.cameras} change by {self.mean:.2f} levels of 255 in the mean ({self.psnr:.1f} dB), by "
            f"{self.worst:.0f} at the worst pixel (row {row}, column {column} of {camera})"
        )


def measure(before: Gaussians, after: Gaussians, known: RunCameras | None) -> Change:
    """Renders of both by a few cameras of a run, held-out ones where there are some.

    Without any by some around the scene. ValueError for a scene of which nothing can be seen.
    """
    said, cameras = _cameras(before, known)
    after = after.in_world(before.world)
    squares, total, count, worst = 0.0, 0.0, 0, (0.0, ("", 0, 0))
    with torch.no_grad():
        for name, camera in cameras:
            pictures = [255 * g.render(camera).clamp(0, 1).double() for g in (before, after)]
            away = (pictures[0] - pictures[1]).abs()
            squares += float(away.square().sum())
            total += float(away.sum())
            count += away.numel()
            at = int(away.amax(-1).argmax())
            worst = max(worst, (float(away.max()), (name, at // camera.width, at % camera.width)))
    psnr = 10 * math.log10(255**2 * count / squares) if squares else math.inf
    return Change(said, psnr, total / count, *worst)


def _cameras(gaussians: Gaussians, known: RunCameras | None) -> tuple[str, list[tuple[str, Camera]]]:
    if known is not None:
        views = known.views
        kind = "held-out views" if any(view.held_out for view in views) else "training views"
        views = [view for view in views if view.held_out] or views
        chosen = [views[k] for k in evenly(len(views), VIEWS)]
        cameras = [(view.name, shrunk_camera(view.camera, KEPT_SIDE)) for view in chosen]
        return f"renders of {len(chosen)} {kind}", cameras
    return f"renders of {VIEWS} cameras around the scene", [
        (f"camera {k + 1}", camera) for k, camera in enumerate(orbit(gaussians, VIEWS))
    ]
