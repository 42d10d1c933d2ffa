"""Whether photos, read again, are those that a run was trained on, and have its cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hqgs.base.text import some
from hqgs.scene.camera_files import CAMERAS, RunCameras, load_cameras
from hqgs.scene.constants import SAME_POSE
from hqgs.scene.scene import Camera, Scene


def check_same(scene: Scene, run: Path, split: bool) -> None:
    """ValueError where photos have other cameras than in the run of a folder, which cameras.json tells.

    Measured with others a scene would look bad, and be fitted to them. With `split` they must be the same
    photos as well, those held out that were. A run without cameras.json is believed.
    """
    if not (run / CAMERAS).is_file():
        return
    known = load_cameras(run)
    before = {view.name: view.held_out for view in known.views}
    now = {view.name: False for view in scene.train} | {view.name: True for view in scene.test}
    changes = {"gone": sorted({*before} - {*now}), "new": sorted({*now} - {*before})}
    told = "; ".join(f"{what}: {some(names)}" for what, names in changes.items() if names)
    if split and before != now:
        raise ValueError(
            f"{scene.name}: these are not the photos that the run {run} was trained and measured with "
            f"({told or 'others are held out'}); put them back as they were, or train anew"
        )
    px = moved_px(scene, known)
    if px is None or px > SAME_POSE:
        by = "none is one of the run's" if px is None else f"photos are off by {px:.1f} px"
        told = told or "none is gone or new, so some are not as they were"
        raise ValueError(
            f"{scene.name}: its cameras are not those of the run {run}: {by}. The photos have changed since "
            f"({told}), and cameras found anew are in another frame; put them back as they were, or train "
            "anew"
        )


def moved_px(scene: Scene, known: RunCameras) -> float | None:
    """How far what the photos of a run show moves in them by the poses that a scene has, px: the median over
    the photos that both have; None: there are none."""
    views = {view.name: view for view in [*scene.train, *scene.test]}
    points = scene.world.to(known.world, scene.points)
    off = list[float]()
    for one in known.views:
        if (view := views.get(one.name)) is not None:
            # Runs of old have cameras as photos are stored.
            both = [
                scene.world.viewmat_to(known.world, c.viewmat) for c in (view.upright_camera, view.camera)
            ]
            off.append(_least_off(one.camera, both, points))
    return float(np.median(off)) if off else None


def _least_off(camera: Camera, viewmats: Sequence[np.ndarray], points: np.ndarray) -> float:
    """Px between where a camera and one at another pose show points of a grid across its picture, at the
    median depth of `points` [P, 3] before it: the mean; the least of several poses."""
    depths = points @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    depth = float(np.median(depths[depths > 0])) if (depths > 0).any() else 1.0
    x, y = np.meshgrid(*(np.linspace(0.1, 0.9, 3) * side for side in (camera.width, camera.height)))
    pixels = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    seen = np.vstack([depth * np.linalg.solve(camera.K, pixels), np.ones(x.size)])
    shown = np.linalg.solve(camera.viewmat, seen)
    off = list[float]()
    for viewmat in viewmats:
        there = camera.K @ (viewmat @ shown)[:3]
        apart = np.linalg.norm(there[:2] / np.maximum(there[2], 1e-9 * depth) - pixels[:2], axis=0)
        off.append(float(np.minimum(apart, camera.width).mean()))
    return min(off)
