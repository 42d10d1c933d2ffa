"""Guests: small photos of other parts that see into a part's cell, from the run of the coarse whole.

A part's own photos leave much of the air in its cell untold, and cameras of other parts look through it.
"""

from __future__ import annotations

from pathlib import Path

from hqgs.photos.files import decode
from hqgs.scene.camera_files import CAMERAS, load_cameras
from hqgs.scene.cells import cell_of
from hqgs.scene.geometry import project, resized_camera
from hqgs.scene.scene import Camera, Scene, View

SEEN = 0.01  # of the points in a part's cell that lie in a photo's frame: then it is a guest


def guests_of(scene: Scene, around: Path) -> list[View]:
    """The training photos of the run `around`, at most 800 px wide, that a part does not have itself.

    Those that see into its cell, in the order of their names. Empty where `around` is a file without a run.
    ValueError or FileNotFoundError for damaged cameras or a photo that is missing.
    """
    run = around if around.is_dir() else around.parent
    part = scene.part
    if part is None or not (run / CAMERAS).is_file():
        return []
    own = scene.points[cell_of(part.cells, scene.points) == part.part].astype(float)
    names = {view.name for view in [*scene.train, *scene.test]}
    found = list[View]()
    for known in sorted(load_cameras(run).views, key=lambda known: known.name):
        if known.held_out or known.photo is None or known.name in names | {*part.held_out}:
            continue
        pixels, depths = project(known.camera, own)
        size = known.camera.width, known.camera.height
        inside = (depths > 0) & ((pixels >= 0) & (pixels < size)).all(1)
        here = cell_of(part.cells, known.camera.center[None])[0] == part.part
        if here or (len(own) and inside.mean() >= SEEN):
            found.append(_view(known.name, known.camera, known.photo))
    return found


def _view(name: str, camera: Camera, photo: Path) -> View:
    image = decode(photo)[0]
    height, width = image.shape[:2]
    return View(name, resized_camera(camera, width, height), image)
