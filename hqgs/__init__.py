"""hqgs: clear 3D Gaussian Splatting scenes from bad photos, on the CPU."""

from hqgs.rasterize import get_num_threads, rasterization, set_num_threads

__version__ = "0.1.0"

__all__ = ["__version__", "get_num_threads", "rasterization", "set_num_threads"]
