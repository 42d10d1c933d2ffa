"""The folder of a run: what it was made of, split and measured with, read in one place for every command."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hqgs.base.files import CAMERAS, CONFIG, PHOTOS, PICTURES, REPORT, RUN_FILES, read_json
from hqgs.base.left_out import PHOTO
from hqgs.base.stages import OnStage, silent
from hqgs.base.text import some
from hqgs.evaluation.records import Report, read_report
from hqgs.scene.constants import BACKGROUND
from hqgs.scene.options import LoadOptions
from hqgs.scene.photo_files import is_run

if TYPE_CHECKING:
    import numpy as np

    from hqgs.scene.camera_files import RunCameras
    from hqgs.scene.scene import Camera, Scene


@dataclass(frozen=True)
class RunFolder:
    """The folder that a run wrote, or that a scene file lies in: what is there of a run.

    Files of other programs that are called as a run's (3DGS has a cameras.json) are passed by where the
    folder is no run's.
    """

    folder: Path

    @classmethod
    def open(cls, source: str | Path) -> RunFolder:
        """The folder itself, or that of a scene file."""
        source = Path(source)
        return cls(source if source.is_dir() else source.parent)

    @property
    def is_run(self) -> bool:
        """Whether `hqgs train` writes or wrote it."""
        return is_run(self.folder)

    @cached_property
    def config(self) -> dict[str, Any]:
        """What config.json holds; empty where there is none, or another program's."""
        path = self.folder / CONFIG
        config = read_json(path) if path.is_file() else None
        return config if isinstance(config, dict) else {}

    @property
    def loaded(self) -> dict[str, Any]:
        """What `hqgs.load` was asked for; empty where nothing tells, as of a scene made in Python."""
        known = {option.name for option in fields(LoadOptions)}
        return {name: value for name, value in self._part("scene").items() if name in known}

    @cached_property
    def cameras(self) -> RunCameras | None:
        """Its cameras and small photos; None where there are none. ValueError where they are damaged."""
        from hqgs.scene.camera_files import load_cameras  # here: it loads torch

        return load_cameras(self.folder) if self._holds(CAMERAS, "up", "views") else None

    @cached_property
    def report(self) -> Report | None:
        """None where the run has not ended. ValueError where it is damaged."""
        return read_report(self.folder / REPORT) if self._holds(REPORT, "metrics") else None

    @cached_property
    def background(self) -> tuple[float, float, float]:
        """R, G, B behind everything: as the run was trained, else black."""
        told = self._part("train").get("background", ())
        if len(told) == 3 and all(isinstance(value, int | float) for value in told):
            return float(told[0]), float(told[1]), float(told[2])
        return BACKGROUND if self.cameras is None else self.cameras.background

    @property
    def without(self) -> set[str]:
        """Names of the training photos that the run left out."""
        left_out = [] if self.report is None else self.report.get("left_out", [])
        whats = [item.get("what", "") for item in left_out]
        return {what.removeprefix(PHOTO) for what in whats if what.startswith(PHOTO)}

    def photos(self, on_stage: OnStage = silent) -> Scene:
        """The scene that it was trained on, read anew, without the photos that it left out.

        FileNotFoundError where the photos are gone, ValueError where nothing tells which they were, or where
        they have changed since (`check_same`).
        """
        from hqgs.scene.source import load_as  # here: it loads torch

        try:
            asked = LoadOptions(**self.loaded)
        except TypeError as error:
            path = self.folder / CONFIG
            raise ValueError(f"{path} does not say which scene was trained: {error}") from error
        try:
            scene = load_as(asked, self.folder, on_stage=on_stage)
        except FileNotFoundError as error:
            raise FileNotFoundError(f"the photos of the run {self.folder} are unknown: {error}") from error
        without = self.without
        scene = replace(scene, train=[view for view in scene.train if view.name not in without])
        check_same(scene, self, split=True)
        return scene

    def split(self, scene: Scene) -> Scene:
        """A scene of the run's photos, those held out that the run held out, or neither trained on nor left
        out. As it is where it has none of the run's photos."""
        held = {} if self.cameras is None else {view.name: view.held_out for view in self.cameras.views}
        views, without = sorted([*scene.train, *scene.test], key=lambda view: view.name), self.without
        if not any(view.name in held for view in views):
            return scene
        test = [view for view in views if held.get(view.name, view.name not in without)]
        return replace(scene, train=[view for view in views if held.get(view.name) is False], test=test)

    def remove(self) -> None:
        """What a run wrote, before another one writes there; COLMAP's result and a film's frames stay."""
        patterns = (f"{PHOTOS}/?????.jpg", f"{PHOTOS}/?????.mask.png", f"{PICTURES}/*.png")
        pictures = [path for pattern in patterns for path in self.folder.glob(pattern)]
        for name in (*pictures, *RUN_FILES):
            (self.folder / name).unlink(missing_ok=True)
        for folder in sorted({path.parent for path in pictures}, reverse=True):
            with suppress(OSError):  # it holds something else
                folder.rmdir()

    def _part(self, name: str) -> dict[str, Any]:
        part = self.config.get(name)
        return part if isinstance(part, dict) else {}

    def _holds(self, name: str, *keys: str) -> bool:
        """Whether a file is there, and a run's: in a folder of no run, whether it has these keys."""
        path = self.folder / name
        if not path.is_file() or self.is_run:
            return path.is_file()
        with suppress(ValueError):
            value = read_json(path)
            return isinstance(value, dict) and all(key in value for key in keys)
        return False


def check_same(scene: Scene, run: RunFolder, split: bool) -> None:
    """ValueError where photos have other cameras than in a run, which its cameras.json tells.

    Measured with others a scene would look bad, and be fitted to them. With `split` they must be the same
    photos as well, those held out that were. A run without cameras.json is believed.
    """
    if (known := run.cameras) is None:
        return
    before = {view.name: view.held_out for view in known.views}
    now = {view.name: False for view in scene.train} | {view.name: True for view in scene.test}
    changes = {"gone": sorted({*before} - {*now}), "new": sorted({*now} - {*before})}
    told = "; ".join(f"{what}: {some(names)}" for what, names in changes.items() if names)
    if split and before != now:
        raise ValueError(
            f"{scene.name}: the photos differ from those of the run {run.folder} "
            f"({told or 'others are held out'}): restore them, or train again"
        )
    px = moved_px(scene, known)
    if px is None or px > 0.5:  # COLMAP moves them by far more where one of the photos is gone
        by = "no photo is in both" if px is None else f"points move by {px:.1f} px in the photos"
        told = told or "none is gone or new, but some have other pixels"
        raise ValueError(
            f"{scene.name}: its cameras differ from those of the run {run.folder}: {by}. The photos have "
            f"changed since ({told}), and newly found cameras are in another frame: restore the photos, or "
            "train again"
        )


def moved_px(scene: Scene, known: RunCameras) -> float | None:
    """How far what the photos of a run show moves in them by the poses that a scene has, px: the median over
    the photos that both have; None: there are none."""
    import numpy as np  # here: a command's options wait for nothing

    views = {view.name: view for view in [*scene.train, *scene.test]}
    points = scene.world.to(known.world, scene.points)
    off = list[float]()
    for one in known.views:
        if (view := views.get(one.name)) is not None:
            there = scene.world.viewmat_to(known.world, view.upright_camera.viewmat)
            off.append(_off(one.camera, there, points))
    return float(np.median(off)) if off else None


def _off(camera: Camera, viewmat: np.ndarray, points: np.ndarray) -> float:
    """Px between where a camera and one at another pose show points of a grid across its picture, at the
    median depth of `points` [P, 3] before it: the mean."""
    import numpy as np

    depths = points @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    depth = float(np.median(depths[depths > 0])) if (depths > 0).any() else 1.0
    x, y = np.meshgrid(*(np.linspace(0.1, 0.9, 3) * side for side in (camera.width, camera.height)))
    pixels = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    seen = np.vstack([depth * np.linalg.solve(camera.K, pixels), np.ones(x.size)])
    shown = np.linalg.solve(camera.viewmat, seen)
    there = camera.K @ (viewmat @ shown)[:3]
    apart = np.linalg.norm(there[:2] / np.maximum(there[2], 1e-9 * depth) - pixels[:2], axis=0)
    return float(np.minimum(apart, camera.width).mean())
