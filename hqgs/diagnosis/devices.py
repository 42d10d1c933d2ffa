"""Whether the cameras that took the photos darken corners, and answer to light each in its own way.

Told from the colours in which photos show the same points, as gains are: what a camera does to all its photos
must make the colours of photos agree that had no part in finding it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hqgs.base.evenly import evenly
from hqgs.diagnosis.constants import (
    DEVICE_PHOTOS,
    DEVICE_RIDGE,
    DEVICE_ROUNDS,
    DEVICE_VALUES,
    DEVICE_WEIGHTED,
    DEVICES_MOST,
)
from hqgs.diagnosis.gains import SharedColors
from hqgs.photos.light import EXPONENT, OFFSET, to_srgb
from hqgs.photos.look import as_a_lens, as_responses
from hqgs.scene.scene import View

Floats = NDArray[np.float64]
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
    corner: float  # the most that a lens keeps from a corner


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
    corner = 1 - np.exp(-vignetting.sum(1)).min()
    darker, bent = (
        tuple((errors[one, bound] - errors[other, bound]) / base for bound in (True, False))
        for one, other in (("", "v"), ("v", last))
    )
    devices = Devices(of_photo, vignetting, response)
    return DeviceSigns(devices, darker[0], bent[0], (darker[1], bent[1]), float(corner))


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
        most = max(DEVICE_VALUES * len(points) // max(int(told[:, points].sum()), 1), 1)
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
                normal[np.diag_indices_from(normal)] += DEVICE_RIDGE * weights.sum()
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
