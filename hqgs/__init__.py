"""hqgs: clear 3D Gaussian Splatting scenes from bad photos, on the CPU.

scene = hqgs.load("photos/")
print(hqgs.diagnose(scene))
run = hqgs.train(scene, out="run")
run.model.save("scene.ply")
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hqgs._rust import get_num_threads as get_num_threads
    from hqgs._rust import set_num_threads as set_num_threads
    from hqgs.base.files import FolderBusyError as FolderBusyError
    from hqgs.diagnosis.scene import Diagnosis as Diagnosis
    from hqgs.diagnosis.scene import diagnose_scene
    from hqgs.model.gaussians import Gaussians as Gaussians
    from hqgs.model.gaussians import orbit as orbit
    from hqgs.model.gsplat_kernels import gsplat_on_cpu as gsplat_on_cpu
    from hqgs.model.rasterization import RasterizationMeta as RasterizationMeta
    from hqgs.model.rasterization import rasterization as rasterization
    from hqgs.photos.pixels import picture as picture
    from hqgs.pipeline import Progress as Progress
    from hqgs.pipeline import Run as Run
    from hqgs.pipeline import train as train
    from hqgs.scene.camera_files import load_cameras as load_cameras
    from hqgs.scene.paths import camera_path as camera_path
    from hqgs.scene.paths import look_at as look_at
    from hqgs.scene.scene import Camera as Camera
    from hqgs.scene.scene import Scene as Scene
    from hqgs.scene.scene import View as View
    from hqgs.scene.source import degrade as degrade
    from hqgs.scene.source import load as load
    from hqgs.show.frames import render_frames as render_frames
    from hqgs.training.config import TrainConfig as TrainConfig
    from hqgs.training.config import TrainingError as TrainingError

    diagnose = diagnose_scene

__version__ = "0.1.0"

# Each name is loaded when it is first used: torch, COLMAP and the rest take seconds.
_HOMES = {
    "hqgs._rust": "get_num_threads set_num_threads",
    "hqgs.base.files": "FolderBusyError",
    "hqgs.diagnosis.scene": "Diagnosis diagnose:diagnose_scene",
    "hqgs.model.gaussians": "Gaussians orbit",
    "hqgs.model.gsplat_kernels": "gsplat_on_cpu",
    "hqgs.model.rasterization": "RasterizationMeta rasterization",
    "hqgs.photos.pixels": "picture",
    "hqgs.pipeline": "Progress Run train",
    "hqgs.scene.camera_files": "load_cameras",
    "hqgs.scene.paths": "camera_path look_at",
    "hqgs.scene.scene": "Camera Scene View",
    "hqgs.scene.source": "degrade load",
    "hqgs.show.frames": "render_frames",
    "hqgs.training.config": "TrainConfig TrainingError",
}
_NAMES = {name.partition(":")[0]: (home, name) for home, names in _HOMES.items() for name in names.split()}
__all__ = ["__version__", *sorted(_NAMES)]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home, written = _NAMES[name]
    value = getattr(import_module(home), written.rpartition(":")[2])
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
