"""Where on Earth a scene is, and how large: from the places that GPS gave its photos.

The similarity from camera centres to metres east, north and up is fitted to all photos, or with twelve and
more to those that agree (`robust`, from threes). How sure its scale is follows from what is left over, per
axis, as errors of GPS are larger upwards; errors that all photos share cannot be seen and do not count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hqgs.scene.constants import GPS_LEAST, OUTLIER
from hqgs.scene.similarity import robust, similarity

Array = NDArray[np.float64]
Gps = tuple[float, float, float]  # degrees north and east, metres above the ellipsoid or the sea, or nan


@dataclass(frozen=True)
class Georeference:
    """A similarity from the frame of a scene's files to metres east, north and up. JSON values only."""

    scale: float  # metres of a unit of the files
    interval: list[float]  # two values: the true scale lies between in 95 % of cases
    rotation: list[list[float]]  # [3, 3], from the axes of the files to east, north, up
    up: list[float]  # [3], up in the frame of the files
    origin: list[float]  # degrees north and east, m: where the origin of the files lies; two: no altitude
    photos: int  # that have a place
    used: int  # of them
    residual: float  # m, root of the mean square of what is left over
    spread: float  # m, root of the mean square distance of the photos' places from their middle
    tilt: float | None = None  # degrees: up is no farther off in 95 % of cases

    def of_units(self, metres: float) -> Georeference:
        """The same place, of a frame whose unit is so many of this one's metres."""
        scale, interval = self.scale / metres, [value / metres for value in self.interval]
        return replace(self, scale=scale, interval=interval)

    def __str__(self) -> str:
        north, east, *above = self.origin
        lower, upper = self.interval
        place = f"{north:.6f}, {east:.6f}" + "".join(f", {value:.1f} m" for value in above)
        up = ", ".join(f"{value:.3f}" for value in self.up)
        sure = "" if self.tilt is None else f", 95 % of it within {self.tilt:.2g} degrees"
        return (
            f"GPS of {self.used} of {self.photos} photos: a unit is {self.scale:.4g} m (95 % interval "
            f"{lower:.4g} to {upper:.4g}), up is ({up}){sure}, the origin is at {place}; GPS "
            f"positions are off by {self.residual:.2g} m (they spread over {self.spread:.3g} m)"
        )


def georeference(centers: Array, places: Sequence[Gps]) -> Georeference | None:
    """The place of a scene with camera centres [N, 3] in the frame of its files, and GPS of each.

    None where that does not tell: fewer than GPS_LEAST photos or different places, or places that spread less
    than OUTLIER times as far as they are off. Fewer than GPS_LEAST altitudes: all count as equally high.
    """
    gps = np.asarray(places, np.float64).reshape(-1, 3)
    high = np.isfinite(gps[:, 2])
    level = int(high.sum()) < GPS_LEAST
    if level:
        gps = np.column_stack([gps[:, :2], np.zeros(len(gps))])
    else:
        gps, centers = gps[high], centers[high]
    if len(np.unique(gps, axis=0)) < GPS_LEAST:
        return None
    if np.ptp(gps[:, 1]) > 180:  # on both sides of the date line
        gps = np.column_stack([gps[:, 0], gps[:, 1] % 360, gps[:, 2]])
    start = np.median(gps, axis=0)
    from pycolmap import GPSTransform  # here: to read a scene does not need it

    earth = GPSTransform()
    target = np.asarray(earth.ellipsoid_to_enu(gps, *start))
    if len(target) < 3 * GPS_LEAST:  # so few that every one counts
        found = similarity(centers, target), np.ones(len(target), bool)
    else:
        found = robust(
            len(target),
            3,
            lambda rows: similarity(centers[rows], target[rows]),
            lambda one: np.linalg.norm(target - (one[0] * centers @ one[1].T + one[2]), axis=1),
        )
    if found is None or found[0] is None or found[1].sum() < max(GPS_LEAST, len(target) / 2):
        return None
    (scale, R, shift), used = found[0], found[1]
    off = target[used] - (scale * centers[used] @ R.T + shift)
    count = int(used.sum())
    axes = (off**2).sum(0) / max(count - 7 / 3, 1)  # variance along each; 7 values were fitted to 3 N
    spread = math.sqrt(float(((target[used] - target[used].mean(0)) ** 2).sum() / count))
    residual = math.sqrt(float(axes.sum()))
    if not spread > OUTLIER * residual:
        return None
    from scipy.special import fdtri, stdtrit  # here: to read a scene does not need it

    turned = (centers[used] - centers[used].mean(0)) @ R.T
    power = float((turned**2).sum())
    error = math.sqrt(float((turned**2 @ axes).sum())) / power
    sure = float(stdtrit(3 * count - 7, 0.975)) * error
    flat, free = scale * turned[:, :2], count - 7 / 3
    tilt = math.sqrt(2 * fdtri(2, free, 0.95) * axes[2] * np.trace(np.linalg.pinv(flat.T @ flat)) / 2)
    north, east, above = np.asarray(earth.enu_to_ellipsoid(shift[None], *start))[0].tolist()
    return Georeference(
        scale=scale,
        interval=[max(scale - sure, 0.0), scale + sure],
        rotation=R.tolist(),
        up=R[2].tolist(),
        origin=[north, east] if level else [north, east, above],
        photos=len(places),
        used=count,
        residual=residual,
        spread=spread,
        tilt=math.degrees(tilt),
    )
