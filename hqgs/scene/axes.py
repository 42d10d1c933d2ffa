"""Whether cameras and points are in the frame that their format states: points and photos tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations, product

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.base.evenly import evenly
from hqgs.base.machine import AT_ONCE
from hqgs.base.text import some
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.capture import Capture, Photo
from hqgs.scene.constants import COPY_SIDE
from hqgs.scene.geometry import in_frame, project, shrunk, within
from hqgs.scene.place import LOOKED_AT, in_one_place
from hqgs.scene.scene import View
from hqgs.scene.sfm.facts import EPIPOLAR
from hqgs.scene.sfm.likely import LOWE_RATIO

_PAIRS = 6  # of neighbours, spread over the photos
# More matches that must fit than otherwise; times as many of them, or as few of the others: of fern and horns
# 2 % do not fit, and with inverse poses, whose epipolar lines are much the same, 53 % and 15 %.
_FEWEST, _CLEAR = 30, 3
_MORE = 1.5  # times as alike, or as many: what differs by less is no better, and the simpler way is taken
_ASKED = 16  # photos that other frames are tried with
# By how much colours of points differ less from a photo where the points are than a little aside. Of fox,
# fern, horns, tea, drinks and can it is 0.19 to 0.52, under strong blur and noise 0.07 to 0.25; of points or
# poses that are shifted, scaled or mixed up -0.02 to 0.12.
_ASIDE = 0.04  # of the longer side
_ALIKE, _BY_CHANCE = 0.1, 3  # standard deviations of what points of any colours have, at places that differ
_GREY = 2.0  # levels, standard deviation: points of one colour tell nothing
_MANY = 0.5  # of the points, that no photo shows: worth a word
_CORNERS = np.array([[0, 0], [-1, -1], [-1, 1], [1, -1], [1, 1]]) / np.sqrt(2)
Floats = NDArray[np.float64]
TURNED = np.diag([1.0, -1.0, -1.0, 1.0])  # y down and z forward for y up and z back, and the other way round
_UNITS = (1e-3, 1e-2, 1e2, 1e3)  # millimetres and centimetres for metres, and the other way round
_WORLDS = [
    np.array([s * row for s, row in zip(signs, order, strict=True)])
    for order in permutations(np.eye(3))
    for signs in product((1.0, -1.0), repeat=3)
] + [unit * np.eye(3) for unit in _UNITS]  # the first one is the identity


@dataclass(frozen=True)
class Way:
    """How poses and points of a file may be meant."""

    inverse: bool = False  # poses lead the other way: camera to world, or world to camera
    turned: bool = False  # cameras' y and z point the other way round
    after: Floats = field(default_factory=lambda: np.eye(4))  # of an inverse: the format's own turn
    world: Floats = field(default_factory=lambda: np.eye(3))  # takes points to the frame of the cameras

    @property
    def moves_points(self) -> bool:
        """Whether points are turned or scaled."""
        return not np.array_equal(self.world, np.eye(3))

    def viewmat(self, photo: Photo) -> Floats:
        """World to camera, [4, 4]."""
        face = np.eye(4)
        face[:3, :3] = np.eye(3) if photo.face is None else photo.face.rotation
        pose = face.T @ photo.viewmat
        pose = np.linalg.inv(pose) @ self.after if self.inverse else pose
        return np.asarray(face @ (TURNED if self.turned else np.eye(4)) @ pose, np.float64)

    def told(self, source: str) -> str:
        """What is otherwise than the format states."""
        ways, axes = ("camera to world", "world to camera"), ("OpenCV", "OpenGL")
        if source == "colmap":
            ways, axes = ways[::-1], axes[::-1]
        parts = []
        if self.inverse:
            parts.append(f"poses are read as {ways[1]}, though the format has {ways[0]}")
        if self.turned:
            held = f"the file has {axes[0]}'s axes; its format wants {axes[1]}'s"
            parts.append("the cameras' y and z axes were flipped" + ("" if self.inverse else f" ({held})"))
        scale = float(np.abs(self.world).max())
        if scale != 1:
            parts.append(f"the points were scaled by {scale:g} to the unit of the cameras")
        elif self.moves_points:
            axis = [("-" if row.sum() < 0 else "") + "xyz"[int(np.abs(row).argmax())] for row in self.world]
            parts.append(f"the points' x, y, z are {', '.join(axis)} in the frame of the cameras")
        return " and ".join(parts)


@dataclass(frozen=True)
class _Fit:
    """How points fit photos."""

    shown: NDArray[np.bool_]  # [P], by one photo at least
    places: int  # of photos, _ASIDE apart, that show points
    share: float  # of the points that a photo shows, mean
    alike: float  # by how much colours differ less than a little aside, of 1; 0: they tell nothing

    @property
    def clear(self) -> bool:
        """Whether colours alone say that the frame is right."""
        least = max(_ALIKE, _BY_CHANCE / np.sqrt(max(self.places, 1)))
        return bool(self.alike >= least and self.shown.mean() >= _MANY)

    @property
    def by_chance(self) -> bool:
        """Whether colours of many points are about as far from the photos' as a little aside."""
        return self.alike != 0 and self.shown.sum() > 100 and self.alike < _ALIKE


def with_true_axes(capture: Capture, views: Sequence[View]) -> tuple[Capture, str | None]:
    """The capture with poses, or points, turned where they are meant otherwise than its format states; and
    what to say.

    Half of the programs that write transforms.json take OpenCV's axes for OpenGL's; others write camera to
    world for world to camera, or turn cameras and leave points. Points decide, by their colours, and by where
    they lie; without them matches of photos, which lie on epipolar lines with one choice alone.
    """
    if capture.source == "photos" or len(views) < 2:
        return capture, None
    step = max(1, len(capture.points) // LOOKED_AT)
    points, colors = capture.points[::step].astype(np.float64), capture.point_colors[::step]
    stated = _fit(views, [view.camera.viewmat for view in views], points, colors)
    if stated.clear:
        return capture, None
    after = np.eye(4) if capture.source == "colmap" else TURNED
    ways = [Way(inverse, turned, after) for inverse in (False, True) for turned in (False, True)]
    fits = _fits(capture, views, ways, points, colors, stated)
    few = not len(points) or stated.shown.mean() < _MANY or in_one_place(capture)
    if (found := _by_colors(fits, stated)) is None and (few or not stated.alike):
        found, told = _by_matches(capture, views, ways)
        found = found if told or not few else _by_counts(fits, stated) or found
    if isinstance(found, tuple):
        way, why = found
    elif not few and stated.by_chance:
        note = "photos show other colours where the points are"
        return capture, f"{note}: do points, poses and focal lengths belong together, in one frame and unit?"
    elif found is None and not few and not stated.alike:
        return capture, "the points have one colour: whether photos show them where they are was not checked"
    else:
        return capture, found
    photos = [replace(photo, viewmat=way.viewmat(photo)) for photo in capture.photos]
    seen = None if any(photo.face for photo in photos) else capture.seen
    moved = replace(capture, photos=photos, points=capture.points @ way.world.T, seen=seen)
    return moved, f"{way.told(capture.source)}: {why}"


def _fits(
    capture: Capture,
    views: Sequence[View],
    ways: Sequence[Way],
    points: Floats,
    colors: NDArray[np.uint8],
    stated: _Fit,
) -> list[tuple[Way, _Fit]]:
    """How points fit some of the photos in each of the ways; where colours tell, also turned or scaled."""
    photos = {photo.name: photo for photo in capture.photos}
    asked, found = [views[k] for k in evenly(len(views), _ASKED)], list[tuple[Way, _Fit]]()
    for way in ways if len(points) else ():
        viewmats = [way.viewmat(photos[view.name]) for view in asked]
        for world in _WORLDS if colors.std(0).max() > _GREY else _WORLDS[:1]:
            found.append((replace(way, world=world), _fit(asked, viewmats, points @ world.T, colors)))
    return found


def _by_colors(fits: Sequence[tuple[Way, _Fit]], stated: _Fit) -> tuple[Way, str] | None:
    """The way in which points have the colours of the photos, and why."""
    clear = [(way, fit) for way, fit in fits if fit.clear and fit.alike > _MORE * stated.alike]
    if not clear:
        return None
    way, fit = max(clear, key=lambda one: one[1].alike)
    then, now = (f"{max(one.alike, 0):.0%}" for one in (fit, stated))
    how = f"differences {then} below those a little aside; {now} as the files have them"
    return way, f"then the points have the colours of the photos ({how})"


def _by_counts(fits: Sequence[tuple[Way, _Fit]], stated: _Fit) -> tuple[Way, str] | None:
    """The way in which photos show far more points than in any other."""
    plain = [one for one in fits if not one[0].moves_points]  # the simplest comes first
    most = max((fit.share for _, fit in plain), default=0.0)
    if most <= _MORE * stated.share:
        return None
    way, best = next(one for one in plain if _MORE * one[1].share >= most)
    if best.shown.mean() < _MANY or best.by_chance:
        return None
    shown = f"{best.shown.mean():.0%} of the points then, {stated.shown.mean():.0%} as the files have them"
    return way, f"photos show {shown}"


def _fit(
    views: Sequence[View], viewmats: Sequence[Floats], points: Floats, colors: NDArray[np.uint8]
) -> _Fit:
    shown, errors, shares, cells = np.zeros(len(points), bool), [np.zeros((5, 0))], [0.0], 0
    for view, viewmat in zip(views if len(points) else (), viewmats, strict=False):
        pixels, depths = project(replace(view.camera, viewmat=viewmat), points)
        inside = within(view.camera, pixels, depths)
        aside = _ASIDE * max(view.camera.width, view.camera.height)
        places = pixels + aside * _CORNERS[:, None]
        asked = np.all([within(view.camera, place, depths) for place in places], 0)
        columns, rows = np.moveaxis(places[:, asked].astype(np.intp), 2, 0)
        errors.append(np.abs(as_floats(view.image[rows, columns]) - as_floats(colors[asked])).mean(2))
        cells += len(np.unique(pixels[inside] // aside, axis=0))
        shown |= inside
        shares.append(float(inside.mean()))
    here, *beside = np.concatenate(errors, 1)
    told = len(here) and colors[shown].std(0).max() > _GREY and np.mean(beside)
    alike = 1 - float(here.mean() / np.mean(beside)) if told else 0.0
    return _Fit(shown, cells, float(np.mean(shares[1:] or shares)), alike)


def _by_matches(
    capture: Capture, views: Sequence[View], ways: Sequence[Way]
) -> tuple[tuple[Way, str] | str | None, bool]:
    """The same by matches between neighbours, or what to say where they fit no way; and whether they tell."""
    photos = {photo.name: photo for photo in capture.photos}
    counts, told = np.zeros(len(ways) + 1, int), pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING.value)
    try:
        for k in evenly(max(len(views) - 1, 0), _PAIRS):
            counts += _fitting(views[k], views[k + 1], photos, ways)
    finally:
        pycolmap.logging.minloglevel = told
    *fitting, matches = counts.tolist()

    def beats(count: int, other: int) -> bool:
        more = count >= _CLEAR * other or matches - other >= _CLEAR * (matches - count)
        return count >= other + _FEWEST and more

    if 2 * max(fitting) < matches and matches > 2 * _FEWEST:
        note = f"{fitting[0]} of {matches} matches between neighbouring photos fit their poses"
        return f"{note}: do poses, focal lengths and photos belong together?", False
    best = next(k for k, count in enumerate(fitting) if not beats(max(fitting), count))
    if best == 0:
        return None, all(beats(fitting[0], count) for count in fitting[1:])
    why = f"{fitting[best]} of {matches} matches between photos fit then, {fitting[0]} as the files have them"
    return (ways[best], why), True


def _fitting(first: View, second: View, photos: Mapping[str, Photo], ways: Sequence[Way]) -> NDArray[np.int_]:
    """Matches of two photos that fit the cameras in each of the ways; and how many there are."""
    one, two = (shrunk(view, COPY_SIDE) for view in (first, second))
    points, others = _matches(one, two)
    found = []
    for way in ways:
        relative = way.viewmat(photos[second.name]) @ np.linalg.inv(way.viewmat(photos[first.name]))
        fits = _distances(one, two, relative, points, others) < EPIPOLAR
        found.append(int((fits & _in_front(one, two, relative, points, others)).sum()))
    return np.array([*found, len(points)])


def unseen(name: object, views: Sequence[View], points: NDArray[np.floating]) -> list[str]:
    """What to say of points [P, 3] of the scene `name` that no photo shows, and of photos that show none.

    ValueError where no photo shows any: nothing could be trained on.
    """
    step = -(-len(views) * len(points) // AT_ONCE) or 1
    shown, empty, before = np.zeros(len(points[::step]), bool), list[str](), False
    for view in views if len(points) else ():
        pixels, depths = project(view.camera, points[::step].astype(np.float64))
        inside = within(view.camera, pixels, depths)
        shown |= inside
        before |= bool((depths > 0).any())
        if not (inside.any() or view.face or in_frame(view.camera, points.astype(np.float64)).any()):
            empty.append(view.name)
    if len(points) and views and len(empty) == len(views):
        where = "outside of all photos: do they belong to another scene, frame or unit?"
        if not before:
            where = "behind all cameras: do the poses have the axes and the direction of their format?"
        raise ValueError(
            f"{name}: no photo shows any of the {len(points)} points, which lie {where} `--sfm` finds "
            "cameras and points from the photos instead"
        )
    notes = []
    if (share := 1 - shown.mean() if len(shown) else 0) > _MANY:
        notes.append(f"{share:.0%} of the points are in no photo: are points and poses in the same frame?")
    if empty:
        which = f"{len(empty)} of {len(views)} photos show none of the points: {some(empty)}"
        notes.append(f"{which}; are their poses right?")
    return notes


def _matches(first: View, second: View) -> tuple[Floats, Floats]:
    """Pixels [M, 2] of each photo that are each other's nearest by their SIFT descriptors."""
    (points, a), (others, b) = (_features(view) for view in (first, second))
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    alike = a @ b.T  # of unit vectors, up to a factor
    alike /= np.linalg.norm(a, axis=1)[:, None] * np.linalg.norm(b, axis=1)
    far = np.sqrt(np.maximum(2 - 2 * alike, 0))
    nearest = far.argmin(1)
    best, second_best = np.partition(far, 1, axis=1)[:, :2].T
    kept = (best < LOWE_RATIO * second_best) & (far.argmin(0)[nearest] == np.arange(len(a)))
    return points[kept], others[nearest[kept]]


def _features(view: View) -> tuple[Floats, NDArray[np.float32]]:
    """SIFT features of a photo: pixels [F, 2] and descriptors [F, 128]."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    grey = to_uint8(as_floats(view.image).mean(2))
    keys, rows = pycolmap.FeatureExtractor.create(options).extract(pycolmap.Bitmap.from_array(grey))
    points = np.array([[key.x, key.y] for key in keys], float).reshape(-1, 2)
    return points, np.asarray(rows.data, np.float32).reshape(len(points), rows.data.shape[1])


def _distances(first: View, second: View, relative: Floats, points: Floats, others: Floats) -> Floats:
    """Of the pixels of the second photo from the epipolar lines of those of the first, px, [M]."""
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    essential = cross @ relative[:3, :3]
    fundamental = np.linalg.inv(second.camera.K).T @ essential @ np.linalg.inv(first.camera.K)
    lines = np.concatenate([points, np.ones((len(points), 1))], 1) @ fundamental.T
    offsets = np.abs((lines[:, :2] * others).sum(1) + lines[:, 2])
    return offsets / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-12)


def _in_front(
    first: View, second: View, relative: Floats, points: Floats, others: Floats
) -> NDArray[np.bool_]:
    """Whether what both pixels [M, 2] show lies before both cameras, [M].

    Of photos side by side a pose and its inverse have one epipolar line, and depths of unlike signs.
    """
    one, two = (
        np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(view.camera.K).T
        for view, pixels in ((first, points), (second, others))
    )
    one, shift = one @ relative[:3, :3].T, relative[:3, 3]
    depths = [(np.cross(ray, shift) * np.cross(one, two)).sum(1) for ray in (one, two)]  # up to a factor
    return (depths[0] >= 0) & (depths[1] >= 0)
