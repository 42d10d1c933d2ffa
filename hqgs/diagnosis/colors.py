"""What the colours in which photos show the same points tell: the gain of each photo, and what cameras do.

What a camera does to all its photos, vignetting and response, is told with its standard error: photos and
points scatter, each in its own way.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, uniform_filter
from scipy.special import logsumexp

from hqgs.base.elementary import on_grid
from hqgs.base.evenly import evenly
from hqgs.diagnosis.photo import Finding, PhotoDiagnosis
from hqgs.photos.formula import DEVICES
from hqgs.photos.light import EXPONENT, OFFSET, to_linear, to_srgb
from hqgs.photos.look import MOST_FALL, STEEPEST, as_a_lens, as_responses
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

# What a look changes at most, from which on, and SURE standard errors more, it is learned. Vignetting: of the
# logarithm of the light in the corner; what nine captures feign differs by 0.16, and a fox's 0.18 +- 0.02
# costs 0.4 dB, which short runs do not see. Response: 4 of 255 levels.
LEAST = {"vignetting": 0.2, "response": 4 / 255}
MOST: dict[str, float] = {
    "vignetting": MOST_FALL,
    "response": STEEPEST / 4,
}  # beyond, no lens and no sensor does so
SURE = 3
DEVICE_PHOTOS, DEVICES_MOST = 4, 16  # that a camera must have taken; cameras that are told apart
ROWS = 12_000  # colours of points in photos that are looked at
# Rounds: of means over photos and points in turn; of weights; of lenses and responses.
DEVICE_ROUNDS, DEVICE_WEIGHTED, BENT = (8, 6, 3)
# Of the weights: what no photo tells stays 0. Points that tell r^2 hardly tell r^4 beside it.
HOLDS_LENS, HOLDS_RESPONSE = (1e-7, 1e-4), 1e-4
UNLIKE_GAINS = 0.05  # of the log gains: what is learned
ROUNDS = 30  # of means and medians of photos and points in turn


@dataclass(frozen=True)
class SharedColors:
    """The light in which the training photos show points, where at least two of them tell it."""

    logs: Floats  # [N, P, 3], of the light of red, green and blue; NaN where a photo does not tell
    squares: Floats  # [N, P], r^2 where it shows them, see `hqgs.photos.look`; NaN too
    depths: Floats  # [N, P], the logarithm of how far ahead of it they are; any where it does not tell


def shared_colors(scene: Scene) -> SharedColors | None:
    """None where the scene does not tell which photos show which points, or a photo shares fewer than
    JOINT with others (dark and saturated ones do not count)."""
    if scene.seen is None or len(scene.train) < 3:
        return None
    # all, or where memory is short those that most photos show
    chosen = most_shown(len(scene.points), scene.seen, scene.train, MOST_VALUES // len(scene.train))
    colors = np.full((len(scene.train), len(chosen), 3), np.nan)
    squares, depths = np.full((2, *colors.shape[:2]), np.nan)
    for k, view in enumerate(scene.train):
        rows = np.flatnonzero(np.isin(chosen, scene.seen.get(view.name, [])))
        if len(rows):
            points = scene.points[chosen[rows]].astype(np.float64)
            _note_colors(view, points, rows, colors[k], squares[k], depths[k])
    told = np.isfinite(colors).all(2)
    told &= told.sum(0) >= 2
    if told.sum(1).min() < JOINT:
        return None
    with np.errstate(invalid="ignore"):
        logs = np.log(np.where(told[..., None], colors, np.nan))
    return SharedColors(logs, np.where(told, squares, np.nan), depths)


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


def _note_colors(
    view: View, points: Floats, rows: NDArray[np.intp], colors: Floats, squares: Floats, depths: Floats
) -> None:
    """Write the light of a photo at `points`, which have these `rows`, their r^2 and the logarithms of their
    depths; NaN where it does not tell."""
    camera = view.camera
    where, ahead = project(camera, points)
    rows, where, ahead = rows[ahead > 0], where[ahead > 0], ahead[ahead > 0]
    depths[rows] = np.log(ahead)
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


class Sign(NamedTuple):
    """What a kind of look changes at most, of the camera of which that is surest.

    Vignetting: of the logarithm of light in the corner, above 0 where it is darker. Response: of a value of
    0 to 1.
    """

    kind: str
    size: float
    error: float  # its standard error

    @property
    def least(self) -> float:
        """The size that is needed."""
        return LEAST[self.kind] + SURE * self.error

    @property
    def possible(self) -> bool:
        """Whether a lens or a sensor does so."""
        return -self.least < self.size <= MOST[self.kind]

    @property
    def needed(self) -> bool:
        return self.size >= self.least and self.possible


@dataclass(frozen=True)
class DeviceSigns:
    """What photos' colours tell of their cameras."""

    devices: Devices
    vignetting: Sign
    response: Sign | None  # None: one camera took the photos

    def undone(self, shared: SharedColors, kinds: Collection[str]) -> SharedColors:
        """The colours without these of what cameras do: gains beside it are told from them."""
        told, devices = shared.logs, self.devices
        of = np.where(devices.of_photo < 0, len(devices), devices.of_photo)  # the last does nothing
        if "response" in kinds:
            told = straightened(told, np.concatenate([devices.response, np.zeros((1, 2, 3))])[of][:, None])
        if "vignetting" in kinds:
            k1, k2 = np.concatenate([devices.vignetting, np.zeros((1, 2))])[of].T[..., None]
            told = told + (shared.squares * (k1 + shared.squares * k2))[..., None]
        return replace(shared, logs=told)


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
    lens, straight = Fit(np.zeros((count, 2)), np.zeros((count, 2, 2))), table.logs
    sensors = [lens] * 3  # of red, green and blue
    for _ in range(BENT if count > 1 else 1):
        lens, straight, sensors = table.cameras(sensors)
    nearer = table.fit(straight.mean(1), table.radii, HOLDS_LENS, [table.depths])  # light may go by depth
    darker = min(map(_corners, (lens, nearer)), key=lambda sign: sign.size - SURE * sign.error)
    bent = _surest([sign for sensor in sensors for sign in _bends(sensor)]) if count > 1 else None
    response = as_responses(np.stack([sensor.found for sensor in sensors], 2))
    return DeviceSigns(Devices(of_photo, as_a_lens(lens.found), response), darker, bent)


def _corners(lens: Fit) -> Sign:
    """How much darker the corners are, of the camera of which that is surest."""
    corners = zip(lens.found.sum(1), np.sqrt(lens.covariance.sum((1, 2))), strict=True)
    return _surest([Sign("vignetting", *corner) for corner in corners])


def _bends(sensor: Fit) -> Iterator[Sign]:
    """How far the response of each camera is off, where it is farthest."""
    v = np.linspace(0, 1, 33)
    changes = np.stack([v * (1 - v), v * (1 - v) * (1 - 2 * v)])  # of a value, by a and b
    for each, errors in zip(sensor.found, sensor.covariance, strict=True):
        change = np.abs(each @ changes)
        at = changes[:, change.argmax()]
        yield Sign("response", float(change.max()), float(np.sqrt(at @ errors @ at)))


def _surest(signs: Sequence[Sign]) -> Sign:
    return max(signs, key=lambda sign: (sign.needed, abs(sign.size) - SURE * sign.error))


def straightened(logs: Floats, response: Floats) -> Floats:
    """The logarithms of light [..., 3] of what cameras of these responses [..., 2, 3] have written."""
    with np.errstate(invalid="ignore"):
        written = to_srgb(np.exp(logs))
    value, a, b = written, response[..., 0, :], response[..., 1, :]
    if not response.any():
        return logs
    for _ in range(12):  # it rises, so they come nearer each time
        value = written - value * (1 - value) * (a + b * (1 - 2 * value))
    return np.log(to_linear(value))


class Fit(NamedTuple):
    """Parameters of each camera [D, K], and their covariances [D, K, K]."""

    found: Floats
    covariance: Floats


@dataclass(frozen=True)
class _Table:
    """Colours of points in photos, one row each: M rows, N photos, P points, D cameras."""

    of_photo: Numbers  # [N]
    photo: Numbers  # [M]
    point: Numbers  # [M]
    device: Numbers  # [M]
    logs: Floats  # [M, 3]
    radii: Floats  # [M, 2], -r^2 and -r^4
    depths: Floats  # [M]

    @staticmethod
    def of(shared: SharedColors, of_photo: Numbers) -> _Table:
        told = np.isfinite(shared.squares)
        points = np.flatnonzero(told.sum(0) >= 2)
        most = max(ROWS * len(points) // max(int(told[:, points].sum()), 1), 1)
        points = points[evenly(len(points), most)]
        photo, point = np.nonzero(told[:, points])
        at = photo, points[point]
        squares = shared.squares[at]
        radii = -np.stack([squares, squares**2], 1)
        return _Table(of_photo, photo, point, of_photo[photo], shared.logs[at], radii, shared.depths[at])

    def means(self, logs: Floats) -> tuple[Floats, Floats]:
        """A colour of each point [P, 3] and a level of each photo [N, 3] whose sums are these rows' best."""
        colors, level = np.zeros((self.point.max() + 1, 3)), np.zeros((len(self.of_photo), 3))
        for _ in range(DEVICE_ROUNDS):
            colors = _mean(logs - level[self.photo], self.point, len(colors))
            level = _mean(logs - colors[self.point], self.photo, len(level))
        return colors, level

    def cameras(self, sensors: Sequence[Fit]) -> tuple[Fit, Floats, list[Fit]]:
        """What lenses (k1, k2) do, the logarithms of light that tell it, and what sensors (a, b; of mean 0
        over photos) do, told from first guesses."""
        taken = self.device >= 0
        response = np.stack([sensor.found for sensor in sensors], 2)
        own = np.where(taken[:, None, None], response[self.device], 0)
        straight = straightened(self.logs, own)
        lens = self.fit(straight.mean(1), self.radii, HOLDS_LENS)
        fall = np.where(taken, (self.radii * as_a_lens(lens.found)[self.device]).sum(1), 0)[:, None]
        counts = np.bincount(self.of_photo[self.of_photo >= 0])
        if len(counts) == 1:
            return lens, straight, [*sensors]
        # at what the other photos let expect: a photo's own noise would be taken for a response
        colors, level = self.means(straight - fall)
        value = to_srgb(np.exp(colors[self.point] + level[self.photo] + fall))
        slope = EXPONENT / (value + OFFSET) * value * (1 - value)  # d log(light) / d value, times the bend
        basis = np.stack([slope, slope * (1 - 2 * value)], 1)  # [M, 2, 3]
        logs = straight - fall + (basis * own).sum(1)
        fits = [self.fit(logs[:, c], basis[..., c], (HOLDS_RESPONSE,) * 2) for c in range(3)]
        sensors = [fit._replace(found=fit.found - counts @ fit.found / counts.sum()) for fit in fits]
        return lens, straight, sensors

    def fit(self, logs: Floats, basis: Floats, holds: Sequence[float], beside: Sequence[Floats] = ()) -> Fit:
        """What each camera adds to `logs` [M], by parameters of `basis` [M, K].

        Beside a gain of each photo, a colour of each point and multiples of `beside`, each [M]. Least
        absolute errors, each point's in shares of its own; `holds` [K], of the weights, keep parameters
        small, the first those of `beside` too. Covariances are those of errors that go together within photos
        and within points (Cameron, Gelbach and Miller 2011).
        """
        count, photo, point = int(self.of_photo.max()) + 1, self.photo, self.point
        own = self.device[:, None] == np.arange(count)
        both = np.column_stack([logs, (own[..., None] * basis[:, None]).reshape(len(logs), -1), *beside])
        weights, found = np.ones(len(logs)), np.zeros(both.shape[1] - 1)
        small, covariance = np.ones(len(logs), bool), np.zeros((len(found), len(found)))
        for _ in range(DEVICE_WEIGHTED):
            left = _within(both, photo, point, weights)
            y, X = left[:, 0], left[:, 1:]
            held = np.diag(np.resize(holds, len(found))) * weights.sum()
            found = np.linalg.solve(X.T @ (weights[:, None] * X) + held, X.T @ (weights * y))
            rest = y - X @ found
            scores = (weights * rest)[:, None] * X
            together = _products(scores, photo) + _products(scores, point) - scores.T @ scores
            # of an absolute error only the rounded tip has a curvature
            inverse = np.linalg.inv(X.T @ ((weights * small)[:, None] * X) + held)
            covariance = inverse @ together @ inverse
            rest = np.abs(rest)
            median = np.median(rest) + 1e-6
            of_point = ((np.bincount(point, rest) + 2 * median) / (np.bincount(point) + 2))[point]
            small = rest < of_point / 2
            weights = 1 / (np.maximum(rest, of_point / 2) * of_point)
            weights /= weights.mean()
        rows = np.arange(count * len(holds)).reshape(count, -1)
        return Fit(found[rows], np.stack([covariance[np.ix_(at, at)] for at in rows]))


def _sums(values: Floats, at: Numbers, count: int) -> Floats:
    """Of the rows of `values` [M, K] at each of `count` places, [count, K]."""
    return np.stack([np.bincount(at, column, minlength=count) for column in values.T], 1).astype(np.float64)


def _mean(values: Floats, at: Numbers, count: int) -> Floats:
    return _sums(values, at, count) / np.maximum(np.bincount(at, minlength=count), 1)[:, None]


def _products(scores: Floats, at: Numbers) -> Floats:
    """Of the sums of `scores` [M, K] within each group, [K, K]."""
    sums, groups = _sums(scores, at, int(at.max()) + 1), len(np.unique(at))
    return sums.T @ sums * groups / max(groups - 1, 1)


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
    lens, sensor = signs.vignetting, signs.response
    way, size = ("darker", lens.size) if lens.size > 0 else ("brighter", -lens.size)
    shares = [1 - np.exp(-value) for value in (size, lens.error, lens.least)]
    reason = f"corners are {shares[0]:.0%} {way} than the middle (standard error {shares[1]:.0%})"
    vignetting = _device_finding(lens, reason, f"{shares[2]:.0%} darker")
    if sensor is None:
        return vignetting, Finding("response", "one camera took the photos")
    levels = [255 * value for value in (sensor.size, sensor.error, sensor.least)]
    reason = f"cameras write the same light {levels[0]:.0f} levels off their mean"
    reason += f" (standard error {levels[1]:.0f})"
    return vignetting, _device_finding(sensor, reason, f"{levels[2]:.0f}")


def _device_finding(sign: Sign, reason: str, least: str) -> Finding:
    if sign.needed:
        return Finding(sign.kind, reason, sign.kind, sign.size)
    if not sign.possible:
        return Finding(sign.kind, f"{reason}, which no camera does: the light changed (flash, reflections)")
    return Finding(sign.kind, f"{reason} (needed from {least})", None, sign.size)
