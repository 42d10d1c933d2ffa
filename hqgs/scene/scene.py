"""Cameras, views and scenes: what every loader produces and every consumer reads."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.base.machine import AT_ONCE
from hqgs.base.text import some
from hqgs.scene.georeference import Georeference
from hqgs.scene.world import World


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the OpenCV frame (x right, y down, z forward; see docs/conventions.md)."""

    width: int
    height: int
    K: NDArray[np.float64]  # [3, 3], pixels, skew 0
    viewmat: NDArray[np.float64]  # [4, 4], world to camera

    @property
    def center(self) -> NDArray[np.float64]:
        """Camera centre in world coordinates, [3]."""
        return np.asarray(-np.linalg.solve(self.viewmat[:3, :3], self.viewmat[:3, 3]), dtype=np.float64)

    def turned(self, quarters: int) -> Camera:
        """The camera whose picture is this one's after so many quarter turns clockwise."""
        if quarters % 4 == 0:
            return self
        pixels = np.array([[0.0, -1, self.height], [1, 0, 0], [0, 0, 1]])
        axes = np.eye(4)
        axes[:2, :2] = pixels[:2, :2]
        K = pixels @ self.K @ axes[:3, :3].T
        return Camera(self.height, self.width, K, axes @ self.viewmat).turned(quarters - 1)


@dataclass(frozen=True)
class View:
    """A photo with its camera.

    A photo from a file stays uint8 in memory. One that was degraded in memory is float32, where 1 is white
    and noise may leave [0, 1].
    """

    name: str
    camera: Camera
    image: NDArray[np.uint8] | NDArray[np.float32]  # [H, W, 3] sRGB, the camera's size
    mask: NDArray[np.bool_] | None = None  # [H, W], True where the photo counts; None: everywhere
    low: NDArray[np.float32] | None = None  # [h, w, 3]: a low-resolution photo before `image` enlarged it
    quarter_turns: int = 0  # clockwise, that show `image` upright, as the photo's EXIF has it: 0..3
    film: float | None = None  # `fine_detail` of the film's frame that `image` is, before it was stored
    device: str = ""  # the camera that took it, and how it was zoomed; "": nothing tells
    face: str = ""  # of a wide photo, which `image` is; as `hqgs.scene.faces` calls it
    empty: NDArray[np.uint8] | None = None  # [H, W], of a cut-out photo: 255 where nothing is, and black

    @property
    def upright_camera(self) -> Camera:
        """That of the photo as people see it: turned as its EXIF says."""
        return self.camera.turned(self.quarter_turns)


@dataclass(frozen=True)
class TrackStatistics:
    """How the photos bear out the points of a COLMAP model."""

    length: float  # photos that see a point, mean
    error: float  # px, mean distance between a point and where the photos see it


@dataclass(frozen=True)
class Scene:
    """Training views, held-out views and the sparse points that initialise the Gaussians."""

    name: str
    train: list[View]
    test: list[View]
    points: NDArray[np.floating]  # [P, 3], world; float64 from files
    point_colors: NDArray[np.uint8]  # [P, 3]
    source: str  # the format it was read from: "colmap", "llff", "transforms", "photos", "embedded"
    notes: list[str] = field(default_factory=list)  # what a reader of the report should know
    tracks: TrackStatistics | None = None  # of the points, px of the views; None: its files do not tell
    seen: dict[str, NDArray[np.intp]] | None = None  # rows of the points that each photo shows; None as above
    sfm: SfmReport | None = None  # of poses and points from the photos; None: they are its files'
    origin: dict[str, Any] | None = None  # what `hqgs.load` was asked for, JSON values; None: made otherwise
    world: World = field(default_factory=World)  # the frame of its files, where that is another
    guessed: bool = False  # whether its points lie at random depths
    of: int | None = None  # training photos that those here were chosen from; None: they are all

    @property
    def place(self) -> Georeference | None:
        """Where on Earth what is written of it is; None: nothing tells."""
        return self.world.place

    def check_trainable(self) -> None:
        """ValueError where it cannot be trained on."""
        if not self.train:
            raise ValueError(f"scene {self.name!r} has no training views")
        names = Counter(view.name for view in self.train)
        name, count = names.most_common(1)[0]
        if count > 1:  # what is learned of a photo's camera, and which points it sees, goes by its name
            raise ValueError(f"{count} training views of scene {self.name!r} are named {name!r}")
        for view in [*self.train, *self.test]:
            wanted = (view.camera.height, view.camera.width, 3)
            if view.image.dtype not in (np.uint8, np.float32) or view.image.shape != wanted:
                raise ValueError(
                    f"view {view.name!r}: the image is {view.image.dtype} {list(view.image.shape)}, "
                    f"its camera wants uint8 or float32 {list(wanted)}"
                )

    @property
    def extent(self) -> float:
        """Radius of the camera positions: `1.1 max |c - mean(c)|`, or 1 for a single camera.

        Cameras that lie more than ten median distances from the others' middle do not count.
        """
        centers = np.stack([v.camera.center for v in self.train])
        centers = centers[~strays(centers, 10.0)]
        radius = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
        return 1.1 * radius if radius > 0 else 1.0

    @property
    def reach(self) -> float:
        """The extent, or the median depth of the points before the training views where that is larger.

        Photos taken side by side may show things that are many times farther away than the cameras are apart.
        Of AT_ONCE views times points and more, every k-th point stands for the others.
        """
        step = -(-len(self.train) * len(self.points) // AT_ONCE) or 1
        points, depths = self.points[::step].astype(np.float64), []
        for view in self.train:
            depth = points @ view.camera.viewmat[2, :3] + view.camera.viewmat[2, 3]
            depths.append(depth[depth > 0])
        seen = np.concatenate(depths)
        return max(self.extent, float(np.median(seen))) if seen.size else self.extent


def strays(centers: NDArray[np.float64], most: float) -> NDArray[np.bool_]:
    """Which cameras at `centers` [C, 3] lie over `most` times as far from the middle as half of them, [C]."""
    apart = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    usual = float(np.median(apart))
    return apart > most * usual if usual > 0 else np.zeros(len(centers), np.bool_)


@dataclass(frozen=True)
class SfmReport:
    """Poses and points from the photos, and how they differ from the scene's own. JSON values only.

    Distances are in units of the scene's extent, after the alignment of the two frames. What compares the two
    is None where the scene has no poses but these.
    """

    photos: int  # that were given
    not_registered: list[str]  # those that COLMAP found no place for
    points: int
    track_length: float  # photos that see a point, mean
    reprojection_error_px: float  # mean
    outliers: list[str] = field(default_factory=list)  # photos that the alignment of the frames left out
    rotation_error_deg: dict[str, float] | None = None  # of the cameras: "median", "max"
    translation_error: dict[str, float] | None = None
    # Median distance from where the scene's own cameras see the new points to the photos; None: most are
    # behind them.
    own_cameras_px: float | None = None
    own_points: int | None = None  # the scene's
    unreadable: dict[str, str] = field(default_factory=dict)  # files that were left out before, and why
    advice: str | None = None  # where photos are missing: what was found, and what to do
    lost: dict[str, str] = field(default_factory=dict)  # photos without a place, and why
    auc: dict[str, float] | None = None  # of pairs' pose errors up to "1", "3", "5" degrees; see `pose_auc`

    def __str__(self) -> str:
        text = self._found() if self.rotation_error_deg is None else self._compared()
        if self.not_registered:
            names = [
                f"{name} ({self.lost[name]})" if name in self.lost else name for name in self.not_registered
            ]
            text += f"; {len(names)} left out, as COLMAP found no pose for them: {some(names)}"
        if self.unreadable:
            files = ", ".join(f"{name} ({why})" for name, why in self.unreadable.items())
            text += f"; {len(self.unreadable)} left out, as they cannot be read: {files}"
        if self.advice is not None:
            text += f". {self.advice}"
        return text

    def _found(self) -> str:
        registered = self.photos - len(self.not_registered)
        return (
            f"cameras and points by COLMAP from all photos, held-out ones too ({registered} of {self.photos} "
            f"registered); {self.points} points, {self.track_length:.1f} photos per point, mean error "
            f"{self.reprojection_error_px:.2f} px of the stored photos"
        )

    def _compared(self) -> str:
        rotation, translation = self.rotation_error_deg, self.translation_error
        assert rotation is not None
        assert translation is not None
        found = self.photos - len(self.not_registered)
        seen = "behind them: the files may use another convention of camera axes"
        if self.own_cameras_px is not None:
            seen = f"{self.own_cameras_px:.2f} px off the photos (median)"
        text = (
            f"poses and points by COLMAP from the training photos: {found} of {self.photos} registered; "
            f"rotations differ from the scene's own by {rotation['median']:.3f} deg (median) and "
            f"{rotation['max']:.3f} deg (max), camera centres by {translation['median']:.2%} and "
            f"{translation['max']:.2%} of the extent; the scene's own cameras see the new points "
            f"{seen}; {self.points} points (own: {self.own_points}), "
            f"{self.track_length:.1f} photos per point, mean error {self.reprojection_error_px:.2f} px"
        )
        if self.auc is not None:
            within = ", ".join(f"{value:.2f} at {limit} deg" for limit, value in self.auc.items())
            text += f"; AUC {within}"
        return text
