"""hqgs: clear 3D Gaussian Splatting scenes from bad photos, on the CPU.

scene = hqgs.load("photos/")
print(hqgs.diagnose(scene))
run = hqgs.train(scene, out="run")
run.model.save("scene.ply")
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hqgs._rust import get_num_threads, set_num_threads
    from hqgs.base.files import FolderBusyError
    from hqgs.diagnosis.scene import Diagnosis
    from hqgs.diagnosis.scene import diagnose_scene as diagnose
    from hqgs.model.gaussians import Gaussians
    from hqgs.model.gsplat_kernels import gsplat_on_cpu
    from hqgs.model.orbit import orbit
    from hqgs.model.rasterization import RasterizationMeta, rasterization
    from hqgs.photos.pixels import picture
    from hqgs.pipeline import Run, train
    from hqgs.scene.camera_files import load_cameras
    from hqgs.scene.paths import camera_path, look_at
    from hqgs.scene.scene import Camera, Scene, View
    from hqgs.scene.source import degrade, load
    from hqgs.show.frames import render_frames
    from hqgs.training.config import TrainConfig
    from hqgs.training.progress import Progress
    from hqgs.training.trainer import TrainingError

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Diagnosis",
    "FolderBusyError",
    "Gaussians",
    "Progress",
    "RasterizationMeta",
    "Run",
    "Scene",
    "TrainConfig",
    "TrainingError",
    "View",
    "__version__",
    "camera_path",
    "degrade",
    "diagnose",
    "get_num_threads",
    "gsplat_on_cpu",
    "load",
    "load_cameras",
    "look_at",
    "orbit",
    "picture",
    "rasterization",
    "render_frames",
    "set_num_threads",
    "train",
]

# Each name is loaded when it is first used: torch, COLMAP and the rest take seconds.
_HOMES = {
    "Camera": "hqgs.scene.scene",
    "Diagnosis": "hqgs.diagnosis.scene",
    "FolderBusyError": "hqgs.base.files",
    "Gaussians": "hqgs.model.gaussians",
    "Progress": "hqgs.training.progress",
    "RasterizationMeta": "hqgs.model.rasterization",
    "Run": "hqgs.pipeline",
    "Scene": "hqgs.scene.scene",
    "TrainConfig": "hqgs.training.config",
    "TrainingError": "hqgs.training.trainer",
    "View": "hqgs.scene.scene",
    "camera_path": "hqgs.scene.paths",
    "degrade": "hqgs.scene.source",
    "diagnose": "hqgs.diagnosis.scene:diagnose_scene",
    "get_num_threads": "hqgs._rust",
    "gsplat_on_cpu": "hqgs.model.gsplat_kernels",
    "load": "hqgs.scene.source",
    "load_cameras": "hqgs.scene.camera_files",
    "look_at": "hqgs.scene.paths",
    "orbit": "hqgs.model.orbit",
    "picture": "hqgs.photos.pixels",
    "rasterization": "hqgs.model.rasterization",
    "render_frames": "hqgs.show.frames",
    "set_num_threads": "hqgs._rust",
    "train": "hqgs.pipeline",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, own_name = _HOMES[name].partition(":")
    value = getattr(import_module(module), own_name or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
