"""What the colours in which photos show the same points tell: the gain of each photo, and what cameras do.

What a camera does to all its photos, vignetting and response, must make the colours of photos agree that had
no part in finding it.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, uniform_filter
from scipy.special import logsumexp

from hqgs.base.elementary import on_grid
from hqgs.base.evenly import evenly
from hqgs.diagnosis.photo import Finding, PhotoDiagnosis
from hqgs.photos.formula import DEVICES
from hqgs.photos.light import EXPONENT, OFFSET, to_linear, to_srgb
from hqgs.photos.look import as_a_lens, as_responses
from hqgs.photos.pixels import as_floats
from hqgs.scene.geometry import most_shown, project
from hqgs.scene.scene import Scene, View
from hqgs.scene.sfm.refine.agree import JOINT

Floats = NDArray[np.float64]
# of white in linear light: beyond them noise and the sensor's white tell nothing
GAINS_DARK, BRIGHT = 0.02, 0.9
MOST_VALUES = 8_000_000  # photos times points that are looked at: 200 MB a table
GAINS_LENGTHS = (0.1, 0.2, 0.4, 0.8, 1.6)  # over which gains may go together, see `_apart`
SHARES = (0.25, 0.5, 0.75, 0.9, 0.97, 0.99)  # of their variance that does
OPPONENTS = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])  # of red, green and blue

# Of the error of held-back photos' colours: from so much less on, it is learned. Photos of one camera reach
# 0.3 % and, taken for two, 7 % (a film, every second frame of it coarser); the room's 9 to 20 and 24 to 30.
PAYS = {"vignetting": 0.05, "response": 0.1}
DEVICE_PHOTOS, DEVICES_MOST = 4, 16  # that a camera must have taken; cameras that are told apart
DEVICE_ROUNDS, DEVICE_WEIGHTED = (8, 4)  # of means over photos and points in turn; of weights


UNLIKE_GAINS = 0.05  # of the log gains: what is learned
NO_CAMERA = {
    "vignetting": "brightens the corners, or darkens them by more than two stops, which no lens does",
    "response": "does not rise everywhere, as the response of a sensor does",
}


ROUNDS = 30  # of means and medians of photos and points in turn


@dataclass(frozen=True)
class SharedColors:
    """The light in which the training photos show points, where at least two of them tell it."""

    logs: Floats  # [N, P, 3], of the light of red, green and blue; NaN where a photo does not tell
    squares: Floats  # [N, P], r^2 where it shows them, see `hqgs.photos.look`; NaN too


def shared_colors(scene: Scene) -> SharedColors | None:
    """None where the scene does not tell which photos show which points, or a photo shares fewer than
    JOINT with others (dark and saturated ones do not count)."""
    if scene.seen is None or len(scene.train) < 3:
        return None
    chosen = _chosen_points(scene, scene.seen)
    colors = np.full((len(scene.train), len(chosen), 3), np.nan)
    squares = np.full(colors.shape[:2], np.nan)
    for k, view in enumerate(scene.train):
        rows = np.flatnonzero(np.isin(chosen, scene.seen.get(view.name, [])))
        if len(rows):
            points = scene.points[chosen[rows]].astype(np.float64)
            _note_colors(view, points, rows, colors[k], squares[k])
    told = np.isfinite(colors).all(2)
    told &= told.sum(0) >= 2
    if told.sum(1).min() < JOINT:
        return None
    with np.errstate(invalid="ignore"):
        logs = np.log(np.where(told[..., None], colors, np.nan))
    return SharedColors(logs, np.where(told, squares, np.nan))


def log_gains(scene: Scene, shared: SharedColors | None = None) -> Floats | None:
    """The logarithms of the training photos' gains of red, green and blue in linear light, [N, 3], of mean 0.

    Only what a photo does not share with those taken beside it: where the light changes along the way, or a
    film's exposure follows the picture, neighbours go together, and colours that depend on the direction
    hold that, and held-out photos have it too. It is told apart by the likelihood of a Gaussian process over
    places and directions with independent gains on top. `shared`: the scene's, where it is known; None where
    there are none.
    """
    shared = shared or shared_colors(scene)
    if shared is None:
        return None
    logs = shared.logs
    gains: Floats = np.zeros((len(scene.train), 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of points that no photo tells
        for _ in range(ROUNDS):
            own = np.nanmean(logs - gains[:, None], axis=0)
            gains = np.nanmedian(logs - own, axis=1)
            gains -= gains.mean(0)
    return _apart(scene.train, gains)


def _chosen_points(scene: Scene, seen: Mapping[str, NDArray[np.intp]]) -> NDArray[np.intp]:
    """Rows of the points to look at, rising: all, or where memory is short those that most photos show."""
    return most_shown(len(scene.points), seen, scene.train, MOST_VALUES // len(scene.train))


def _note_colors(view: View, points: Floats, rows: NDArray[np.intp], colors: Floats, squares: Floats) -> None:
    """Write the light of a photo at `points`, which have these `rows`, and their r^2; NaN where it does not
    tell."""
    camera = view.camera
    where, depths = project(camera, points)
    rows, where = rows[depths > 0], where[depths > 0]
    away = np.square(where - camera.K[:2, 2]).sum(1)
    squares[rows] = away * (4 / (camera.height**2 + camera.width**2))
    if view.image.dtype == np.uint8:  # 256 powers, not one for each value
        table = to_linear(as_floats(np.arange(256, dtype=np.uint8)).astype(np.float64))
        light = table[view.image.astype(np.uint8, copy=False)]
    else:
        light = to_linear(np.clip(view.image, 0, 1).astype(np.float64))
    for c in range(3):
        # px around a point, whose mean is its colour there
        smooth = uniform_filter(light[..., c], 5, mode="nearest")
        found = map_coordinates(smooth, (where - 0.5).T[::-1], order=1, mode="nearest")
        colors[rows, c] = np.where((found > GAINS_DARK) & (found < BRIGHT), found, np.nan)


def _apart(views: Sequence[View], gains: Floats) -> Floats:
    """`gains` [N, 3] of mean 0 without what neighbours share: its mean over GAINS_LENGTHS and SHARES.

    Brightness and the two differences of colour are looked at apart, since a tint may drift where the
    exposure does not; the length is one for all three.
    """
    centers = np.stack([view.camera.center for view in views])
    ahead = np.stack([view.camera.viewmat[2, :3] for view in views])
    reach = float(np.linalg.norm(centers - centers.mean(0), axis=1).max()) or 1.0
    squares = np.square((centers[:, None] - centers) / reach).sum(-1)
    squares += np.square(ahead[:, None] - ahead).sum(-1)
    parts = gains @ OPPONENTS.T
    apart = -0.5 * len(views) * np.log(np.square(parts).mean(0) + 1e-12)
    # of the log-likelihood: less does not tell neighbours that go together from chance
    evidence, shared = [apart.sum() + 3.0], [np.zeros_like(gains)]
    for length in GAINS_LENGTHS:
        together = np.exp(-squares / (2 * length**2))
        likely, means = [apart], [np.zeros_like(gains)]
        for share in SHARES:
            covariance = share * together + (1 - share + 1e-4) * np.eye(len(views))
            values, vectors = np.linalg.eigh(covariance)
            seen = vectors.T @ parts
            energy = np.square(seen) / values[:, None]
            likely.append(-0.5 * (len(views) * np.log(energy.mean(0) + 1e-12) + np.log(values).sum()))
            means.append(share * together @ (vectors @ (seen / values[:, None])))
        total = np.asarray(logsumexp(likely, axis=0))
        evidence.append(total.sum() - 3 * math.log(len(likely)) - math.log(len(GAINS_LENGTHS)))
        shared.append((np.exp(likely - total)[:, None] * means).sum(0))
    weights = np.exp(np.array(evidence) - logsumexp(evidence))
    rest = gains - np.tensordot(weights, shared, 1) @ OPPONENTS
    rest = on_grid(rest, (2.0**-24))  # of the logarithms of gains
    return rest - rest.mean(0)


Numbers = NDArray[np.intp]


@dataclass(frozen=True)
class Devices:
    """The cameras of the training photos, and what is believed of them at first; see `hqgs.photos.look`."""

    of_photo: Numbers  # [N], the number of the photo's camera; -1: it took too few, or nothing tells
    vignetting: Floats  # [D, 2]
    response: Floats  # [D, 2, 3], of mean 0 over photos

    def __len__(self) -> int:
        return len(self.vignetting)


@dataclass(frozen=True)
class DeviceSigns:
    """What cameras explain of how far photos are off each other's colours.

    Shares of the error of held-back photos: what each camera's vignetting takes, and its response beside it.
    """

    devices: Devices
    vignetting: float
    response: float
    unbounded: tuple[float, float]  # of both, where they may be what no lens and no sensor does


def grouped(views: Sequence[View]) -> Numbers:
    """The number of each view's camera, [N], those of most photos first; -1 where it took too few."""
    counts = Counter(view.device for view in views if view.device and not view.face)
    names = [name for name, count in counts.most_common(DEVICES_MOST) if count >= DEVICE_PHOTOS]
    return np.array(
        [names.index(v.device) if v.device in names and not v.face else -1 for v in views], np.intp
    )


def plain_devices(views: Sequence[View]) -> Devices:
    """Cameras that do nothing to their photos, as far as one knows."""
    of_photo = grouped(views)
    count = int(of_photo.max(initial=-1)) + 1
    return Devices(of_photo, np.zeros((count, 2)), np.zeros((count, 2, 3)))


def device_signs(views: Sequence[View], shared: SharedColors) -> DeviceSigns | None:
    """None where no camera has taken enough of the photos."""
    of_photo = grouped(views)
    count = int(of_photo.max()) + 1
    if not count:
        return None
    table = _Table.of(shared, of_photo)
    kinds = ("v", "vr") if count > 1 else ("v",)
    place = np.zeros(len(views), np.intp)  # of each photo among its camera's
    for device in range(-1, count):
        rows = np.flatnonzero(of_photo == device)
        place[rows] = np.arange(len(rows))
    counts = np.bincount(of_photo[of_photo >= 0], minlength=count)
    errors = {(kind, bound): 0.0 for kind in ("", *kinds) for bound in (True, False)}
    for part in (0, 1):
        held = (place % 2 == part)[table.photo]
        for kind in ("", *kinds):
            found = table.fit(~held, kind)
            for bound in (True, False):
                looks = _as_cameras(found, counts) if bound else found
                errors[kind, bound] += table.held_error(looks, held)
    base, last = errors["", True] or 1.0, kinds[-1]
    every = np.ones(len(table.photo), bool)
    vignetting = as_a_lens(table.fit(every, "v")[:, :2].mean(2))
    found = _as_cameras(table.fit(every, last), counts)
    response = found[:, 2:] - (counts[:, None, None] * found[:, 2:]).sum(0) / counts.sum()
    darker, bent = (
        tuple((errors[one, bound] - errors[other, bound]) / base for bound in (True, False))
        for one, other in (("", "v"), ("v", last))
    )
    devices = Devices(of_photo, vignetting, response)
    return DeviceSigns(devices, darker[0], bent[0], (darker[1], bent[1]))


def _as_cameras(found: Floats, counts: Numbers) -> Floats:
    """Parameters [D, 4, 3] as lenses and sensors may have them: vignetting is of all colours; how far a
    response is off the mean over photos, of which each camera took `counts`, keeps it rising."""
    lens = as_a_lens(found[:, :2].mean(2))
    mean = (counts[:, None, None] * found[:, 2:]).sum(0) / counts.sum()
    response = mean + as_responses(found[:, 2:] - mean)
    return np.concatenate([np.repeat(lens[..., None], 3, 2), response], 1)


@dataclass(frozen=True)
class _Table:
    """Colours of points in photos, one row each: M rows, N photos, P points, D cameras."""

    photo: Numbers  # [M]
    point: Numbers  # [M]
    device: Numbers  # [M]
    logs: Floats  # [M, 3]
    basis: Floats  # [M, 4, 3], what each parameter of a camera adds to the logarithm: k1, k2, a, b
    devices: int

    @staticmethod
    def of(shared: SharedColors, of_photo: Numbers) -> _Table:
        told = np.isfinite(shared.squares)
        points = np.flatnonzero(told.sum(0) >= 2)
        # colours of points in photos that are looked at
        most = max(12_000 * len(points) // max(int(told[:, points].sum()), 1), 1)
        points = points[evenly(len(points), most)]
        photo, point = np.nonzero(told[:, points])
        logs, square = shared.logs[photo, points[point]], shared.squares[photo, points[point]]
        squares = np.repeat(square[:, None], 3, 1)
        basis = np.stack([-squares, -squares * squares, *2 * [np.zeros_like(squares)]], 1)
        table = _Table(photo, point, of_photo[photo], logs, basis, int(of_photo.max()) + 1)
        value = to_srgb(np.exp(table.expected()))
        # d log(light) / d value, times the bend of the response there
        bend = EXPONENT / (value + OFFSET) * value * (1 - value)
        basis[:, 2:] = np.stack([bend, bend * (1 - 2 * value)], 1)
        return table

    def expected(self) -> Floats:
        """The logarithms [M, 3] that a point's colour, a photo's gains and vignetting let expect.

        Not what the photo shows there: its noise would be taken for a response.
        """
        every = np.ones(len(self.photo), bool)
        added = self.added(self.fit(every, "v"))
        colors, level = self.means(self.logs - added, every)
        return colors[self.point] + level[self.photo] + added

    def added(self, found: Floats) -> Floats:
        """What cameras of these parameters add to each row, [M, 3]."""
        each = np.where(self.device[:, None, None] >= 0, found[self.device], 0)
        return (self.basis * each).sum(1)

    def means(self, logs: Floats, rows: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """A colour of each point [P, 3] and a level of each photo [N, 3] whose sums are these rows' best."""
        photo, point, logs = self.photo[rows], self.point[rows], logs[rows]
        colors, level = np.zeros((self.point.max() + 1, 3)), np.zeros((self.photo.max() + 1, 3))
        seen = np.maximum(np.bincount(point, minlength=len(colors)), 1)[:, None]
        of_photo = np.maximum(np.bincount(photo, minlength=len(level)), 1)[:, None]
        for _ in range(DEVICE_ROUNDS):
            colors = _sums(logs - level[photo], point, len(colors)) / seen
            level = _sums(logs - colors[point], photo, len(level)) / of_photo
        return colors, level

    def fit(self, rows: NDArray[np.bool_], kind: str) -> Floats:
        """Parameters [D, 4, 3] from these rows, each channel by itself: least absolute errors, beside a gain
        of each photo and a colour of each point. `kind`: "" for none, "v" and "vr"."""
        found = np.zeros((self.devices, 4, 3))
        columns = {"": 0, "v": 2, "vr": 4}[kind]
        chosen = np.flatnonzero(rows)
        if not columns or not len(chosen):
            return found
        photo, point, device = self.photo[chosen], self.point[chosen], self.device[chosen]
        own = device[:, None] == np.arange(self.devices)
        for c in range(3):
            design = (own[:, :, None] * self.basis[chosen, None, :columns, c]).reshape(len(chosen), -1)
            both = np.column_stack([self.logs[chosen, c], design])
            weights, theta = np.ones(len(chosen)), np.zeros(design.shape[1])
            for _ in range(DEVICE_WEIGHTED):
                left = _within(both, photo, point, weights)
                y, X = left[:, 0], left[:, 1:]
                normal = X.T @ (weights[:, None] * X)
                # of the weights: what no photo tells stays 0
                normal[np.diag_indices_from(normal)] += (1e-4) * weights.sum()
                theta = np.linalg.solve(normal, X.T @ (weights * y))
                rest = np.abs(y - X @ theta)
                weights = 1 / np.maximum(rest, np.median(rest) + 1e-6)
                weights /= weights.mean()
            found[:, :columns, c] = theta.reshape(self.devices, columns)
        return found

    def held_error(self, found: Floats, held: NDArray[np.bool_]) -> float:
        """How far held-back photos, each with its best gain, are off the points' colours in the others: the
        mean of absolute logarithms."""
        logs = self.logs - self.added(found)
        colors, _ = self.means(logs, ~held)
        count = np.bincount(self.point[~held], minlength=len(colors))
        rows = held & (count[self.point] > 0)
        off, photo = logs[rows] - colors[self.point[rows]], self.photo[rows]
        for one in np.unique(photo):
            off[photo == one] -= np.median(off[photo == one], axis=0)
        return float(np.abs(off).sum())


def _sums(values: Floats, at: Numbers, count: int) -> Floats:
    """Of the rows of `values` [M, K] at each of `count` places, [count, K]."""
    return np.stack([np.bincount(at, column, minlength=count) for column in values.T], 1).astype(np.float64)


def _within(values: Floats, photo: Numbers, point: Numbers, weights: Floats) -> Floats:
    """`values` [M, K] less what a constant of each photo and one of each point explain of them."""
    left = values.copy()
    for _ in range(DEVICE_ROUNDS):
        for at in (point, photo):
            total = np.bincount(at, weights)
            left -= (_sums(left * weights[:, None], at, len(total)) / np.maximum(total, 1e-12)[:, None])[at]
    return left


def exposure_finding(log_gains: NDArray[np.float64] | None, photos: Sequence[PhotoDiagnosis]) -> Finding:
    """`log_gains` [N, 3], as `hqgs.diagnosis.colors` tells them."""
    if log_gains is None:
        return Finding("exposure", "not measured: the photos share too few points")
    spread = float(np.std(log_gains, axis=0).max())
    reason = f"the brightness of the same points differs by {spread:.1%} from photo to photo"
    # Noise that black and white cut off brightens the dark parts of a photo, and darkens the bright ones.
    noises = [noise for photo in photos if (noise := photo.told_noise) is not None]
    least = UNLIKE_GAINS + (0.5 * max(noises) / 255 if noises else 0.0)
    if spread < least:
        return Finding("exposure", f"{reason} (needed from {least:.0%})", None, spread)
    return Finding("exposure", reason, "exposure", spread)


def device_findings(signs: DeviceSigns | None) -> tuple[Finding, Finding]:
    """Vignetting and response."""
    if signs is None:
        why = f"not measured: no camera is known to have taken {DEVICE_PHOTOS} photos or more"
        vignetting, response = (Finding(name, why) for name in DEVICES)
        return vignetting, response
    found: list[Finding] = []
    for name, less, more in zip(DEVICES, (signs.vignetting, signs.response), signs.unbounded, strict=True):
        needed = less >= PAYS[name]
        reason = f"with a {name} for each camera photos would agree better by {less:.1%}"
        reason += "" if needed else f" (needed from {PAYS[name]:.0%})"
        if more >= PAYS[name] and less < more / 2:
            needed = False
            reason = f"the {name} that makes photos agree better by {more:.1%} {NO_CAMERA[name]}: the light "
            reason += "changed (flash, reflections)"
        found.append(Finding(name, reason, name if needed else None, less))
    return found[0], found[1]
