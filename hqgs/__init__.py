"""hqgs: clear 3D Gaussian Splatting scenes from bad photos, on the CPU."""

from hqgs._rust import get_num_threads, set_num_threads
from hqgs.model.rasterization import rasterization

__version__ = "0.1.0"

__all__ = ["__version__", "get_num_threads", "rasterization", "set_num_threads"]
