"""What a scene file changes: renders of what was written, read back, against those of its source."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from hqgs.base.evenly import evenly
from hqgs.model.gaussians import Gaussians
from hqgs.model.orbit import orbit
from hqgs.scene.camera_files import RunCameras
from hqgs.scene.constants import KEPT_SIDE
from hqgs.scene.geometry import shrunk_camera
from hqgs.scene.scene import Camera
from hqgs.show.constants import CHANGE_VIEWS


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
        chosen = [views[k] for k in evenly(len(views), CHANGE_VIEWS)]
        cameras = [(view.name, shrunk_camera(view.camera, KEPT_SIDE)) for view in chosen]
        return f"renders of {len(chosen)} {kind}", cameras
    return f"renders of {CHANGE_VIEWS} cameras around the scene", [
        (f"camera {k + 1}", camera) for k, camera in enumerate(orbit(gaussians, CHANGE_VIEWS))
    ]
