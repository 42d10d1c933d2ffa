"""Cameras in files: those of a run, with small photos, and camera paths as nerfstudio has them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import CAMERAS, PHOTOS, atomic_path, read_json, write_json
from hqgs.photos.files import LARGEST
from hqgs.photos.pixels import as_floats, to_uint8, upright
from hqgs.photos.video import FPS
from hqgs.scene.constants import BACKGROUND, KEPT_SIDE
from hqgs.scene.named_split import names_by_any
from hqgs.scene.paths import scene_up, view_matrix
from hqgs.scene.scene import Camera, Scene, View
from hqgs.scene.world import World

_FLIP = np.diag([1.0, -1.0, -1.0])  # OpenGL's camera axes (y up, z back) to OpenCV's


@dataclass(frozen=True)
class KnownCamera:
    """A camera of a run, with its photo; both upright, as the photo's EXIF tells it."""

    name: str
    camera: Camera
    held_out: bool
    photo: Path | None  # as it was trained on, at most 800 px wide and high; None: it is not there
    mask: Path | None = None  # of the photo's size, white where it counts; None: everywhere


@dataclass(frozen=True)
class RunCameras:
    """What cameras.json holds."""

    up: NDArray[np.float64]  # [3], unit, world
    views: list[KnownCamera]  # in the scene's order, held-out ones last
    background: tuple[float, float, float] = BACKGROUND  # R, G, B behind everything
    world: World = field(default_factory=World)  # the frame that its cameras are in

    @property
    def train(self) -> list[Camera]:
        """Of the training views."""
        return [view.camera for view in self.views if not view.held_out]

    @property
    def test(self) -> list[Camera]:
        """Of the held-out views."""
        return [view.camera for view in self.views if view.held_out]


def save_cameras(
    folder: str | Path, scene: Scene, background: tuple[float, float, float] = BACKGROUND
) -> None:
    """Write cameras.json, photos/*.jpg of a scene's views and *.mask.png of their masks, each atomically.

    Photos that lie on their side are turned upright, and their cameras with them.
    """
    folder, entries = Path(folder), list[dict[str, Any]]()
    for number, (view, held_out) in enumerate(
        [*((view, False) for view in scene.train), *((view, True) for view in scene.test)]
    ):
        photo = f"{PHOTOS}/{number:05}.jpg"
        with atomic_path(folder / photo) as tmp:
            picture = Image.fromarray(upright(to_uint8(as_floats(view.image)), view.quarter_turns))
            picture.thumbnail((KEPT_SIDE, KEPT_SIDE), Image.Resampling.LANCZOS)
            picture.save(tmp, quality=88)
        masked = {}
        if view.mask is not None:
            masked["mask"] = f"{PHOTOS}/{number:05}.mask.png"
            with atomic_path(folder / masked["mask"]) as tmp:
                shares = Image.fromarray(upright(255 * view.mask.astype(np.uint8), view.quarter_turns))
                shares.resize(picture.size, Image.Resampling.BOX).point(whole).save(tmp)
        camera = view.upright_camera
        entries.append(
            {
                "name": view.name,
                "held_out": held_out,
                "width": camera.width,
                "height": camera.height,
                "K": camera.K.tolist(),
                "world_to_camera": scene.world.viewmat_out(camera.viewmat).tolist(),
                "photo": photo,
                **masked,
            }
        )
    up = scene_up(scene)
    frame = "OpenCV: x right, y down, z forward; pixels; world units are those of the scene"
    content: dict[str, Any] = {"frame": frame, "up": up.tolist(), "views": entries}
    content |= {} if scene.world == World() else {"world": scene.world.json()}
    content |= {} if background == BACKGROUND else {"background": background}
    write_json(folder / CAMERAS, content)


def whole(level: int) -> int:
    """A pixel of a smaller mask: white where all counts that is in it."""
    return 255 if level == 255 else 0


def load_cameras(folder: str | Path) -> RunCameras:
    """Read cameras.json of a run's folder: cameras in the frame that `Gaussians.load` gives the scene.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged, or names a photo outside its folder; the message names the file.
    """
    folder = Path(folder)
    path = folder / CAMERAS
    value = read_json(path)
    try:
        up = np.array(value["up"], np.float64)
        world = World.of_json(value["world"]) if "world" in value else World()
        views = [_known(path, folder, entry, world) for entry in value["views"]]
        background = tuple(float(channel) for channel in value.get("background", BACKGROUND))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path} does not hold the cameras of a run: {error!r}") from error
    if len(background) != 3 or not np.isfinite(background).all():
        raise ValueError(f"{path}: background is not a colour: {value['background']!r:.60}")
    if up.shape != (3,) or not np.isfinite(up).all() or not np.linalg.norm(up) > 0:
        raise ValueError(f"{path}: up is not a direction: {value['up']!r:.60}")
    return RunCameras(up / np.linalg.norm(up), views, background, world)


N = TypeVar("N", KnownCamera, View)


def picked(train: Sequence[N], test: Sequence[N], which: str, whose: str) -> list[N]:
    """Those that `which` means: train, test, all, or names with commas, with suffix and folders or without.

    ValueError, which says `whose` they are, where there is none.
    """
    kinds = {"train": train, "test": test, "all": sorted([*train, *test], key=lambda one: one.name)}
    if which in kinds:
        if not kinds[which]:
            raise ValueError(f"--views {which}: {whose} has no such photo")
        return [*kinds[which]]
    by_name = {one.name: one for one in kinds["all"]}
    named = {called: by_name[name] for called, name in names_by_any([*by_name]).items()}
    wanted = [which] if which in named else [name.strip() for name in which.split(",")]
    if missing := [name for name in wanted if name not in named]:
        known = ", ".join(["train", "test", "all", *[*by_name][:3]])
        raise ValueError(f"--views: {whose} has no photo {missing[0]!r}; there are: {known}, ...")
    return [named[name] for name in wanted]


def first_camera(folder: Path, world: World, by: NDArray[np.float64] | None) -> Camera | None:
    """The first camera of the run in a folder, a held-out one where there is one, as `moved_along` moves it.

    None where none is kept, or where its file is damaged: it is for pictures that can do without.
    """
    try:
        known = moved_along(load_cameras(folder), world, by)
    except (OSError, ValueError):
        return None
    return next(iter([*known.test, *known.train]), None)


def _known(path: Path, folder: Path, entry: Any, world: World) -> KnownCamera:
    name = entry["name"]
    if not isinstance(name, str):
        raise ValueError(f"a name is {name!r:.60}")
    photo, mask = _file(folder, entry["photo"]), _file(folder, entry.get("mask"))
    camera = checked_camera(entry["width"], entry["height"], entry["K"], entry["world_to_camera"])
    return KnownCamera(name, moved(camera, world), bool(entry["held_out"]), photo, mask)


def _file(folder: Path, name: Any) -> Path | None:
    """Where it is; None where there is none. ValueError where it leaves the folder."""
    if name is None:
        return None
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts or "\0" in name:
        raise ValueError(f"photo {name!r:.60} is outside of the folder")
    return folder / parts if (folder / parts).is_file() else None


def moved(camera: Camera, world: World, by: NDArray[np.float64] | None = None) -> Camera:
    """A camera of a file in the frame in which its scene is held.

    `by` [4, 4]: how the scene was moved on reading (`Gaussians.moved`): its cameras, and paths, go with it.
    ValueError for a map that stretches or mirrors, where no camera can follow.
    """
    viewmat = camera.viewmat
    if by is not None:
        size = np.linalg.norm(by[0, :3])
        turn = by[:3, :3] / size
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
            raise ValueError("the scene file stretches or mirrors the scene, which cameras cannot follow")
        viewmat = view_matrix(viewmat[:3, :3] @ turn.T, by[:3, :3] @ camera.center + by[:3, 3])
    return replace(camera, viewmat=world.viewmat_into(viewmat))


def moved_along(known: RunCameras, world: World, by: NDArray[np.float64] | None) -> RunCameras:
    """The cameras of a run with its scene, which is held in `world`, and may have been moved; see `moved`."""
    if by is None and known.world.frame == world.frame:
        return known

    def along(view: KnownCamera) -> KnownCamera:
        files = known.world.viewmat_to(World(metres=world.metres), view.camera.viewmat)
        return replace(view, camera=moved(replace(view.camera, viewmat=files), world, by))

    up = known.up if by is None else by[:3, :3] @ known.up
    return replace(known, up=up / np.linalg.norm(up), views=[*map(along, known.views)], world=world)


def save_path(
    path: str | Path,
    cameras: Sequence[Camera],
    fps: float = FPS,
    world: World | None = None,
    by: NDArray[np.float64] | None = None,
) -> None:
    """Write a camera path as JSON, in the style of nerfstudio's camera_path files, atomically.

    Poses are camera to world with OpenGL's axes, in the frame of the scene's file (`world`, and `by` as for
    `moved`); `fov` is vertical, in degrees. Principal points are taken for the middle. ValueError without a
    camera.
    """
    if not cameras:
        raise ValueError("cameras is empty, wanted at least one")
    frames = []
    for camera in cameras:
        if world is not None:
            camera = replace(camera, viewmat=world.viewmat_out(camera.viewmat))
        if by is not None:
            camera = moved(camera, World(), np.asarray(np.linalg.inv(by), np.float64))
        pose = np.eye(4)
        pose[:3, :3] = camera.viewmat[:3, :3].T @ _FLIP
        pose[:3, 3] = camera.center
        fov = math.degrees(2 * math.atan(camera.height / (2 * camera.K[1, 1])))
        aspect = camera.width * camera.K[1, 1] / (camera.height * camera.K[0, 0])
        frames.append({"camera_to_world": pose.ravel().tolist(), "fov": fov, "aspect": aspect})
    head = {
        "camera_type": "perspective",
        "render_width": cameras[0].width,
        "render_height": cameras[0].height,
        "fps": fps,
        "seconds": len(cameras) / fps,
    }
    write_json(path, head | {"camera_path": frames})


def load_path(path: str | Path) -> tuple[list[Camera], float]:
    """Read a camera path: its cameras, in the frame of the scene's file (`moved`), and frames per second.

    Raises FileNotFoundError, or ValueError that names the file: damaged, or not of perspective cameras.
    """
    path = Path(path)
    value = read_json(path)
    try:
        width, height, fps = value["render_width"], value["render_height"], float(value.get("fps", FPS))
        frames = value["camera_path"]
        for one in (value, *frames):
            if (kind := one.get("camera_type", "perspective")) != "perspective":
                raise ValueError(f"camera_type is {kind!r}, only perspective cameras can be rendered")
        if not 0 < len(frames) <= 100_000:
            raise ValueError(f"{len(frames)} frames")
        if not 0 < fps <= 1000:
            raise ValueError(f"fps is {fps}")
        cameras = [_frame(frame, width, height) for frame in frames]
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError(f"{path} is not a camera path: {error!r}") from error
    return cameras, fps


def _frame(frame: Any, width: int, height: int) -> Camera:
    pose = np.array(frame["camera_to_world"], np.float64).reshape(-1, 4)
    fov = float(frame["fov"])
    if pose.shape not in ((4, 4), (3, 4)) or not 0 < fov < 180:
        raise ValueError(f"a pose of shape {list(pose.shape)} with fov {fov}")
    focal = float(height) / (2 * math.tan(math.radians(fov) / 2))
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    axes = _FLIP @ pose[:3, :3].T
    with np.errstate(all="ignore"):
        return checked_camera(width, height, K, view_matrix(axes, pose[:3, 3]))


def checked_camera(width: Any, height: Any, K: Any, viewmat: Any) -> Camera:
    """A pinhole camera of values from a file. ValueError for those that no camera has."""
    if not all(type(side) is int and side > 0 for side in (width, height)) or width * height > LARGEST:
        raise ValueError(f"a picture of {width!r:.20} x {height!r:.20} px")
    K, viewmat = np.array(K, np.float64), np.array(viewmat, np.float64)
    if K.shape != (3, 3) or viewmat.shape != (4, 4) or not (np.isfinite(K).all() and K[0, 0] * K[1, 1] > 0):
        raise ValueError("a camera's K is not a pinhole camera")
    R = viewmat[:3, :3]
    if not np.isfinite(viewmat).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise ValueError("a pose is not a rotation and translation")
    return Camera(width, height, K, viewmat)
