"""hqgs: clear 3D Gaussian Splatting scenes from bad photos, on the CPU."""

import os

# The extension's allocator reads this when it is loaded: buffers that are freed are kept for a second, so
# that the next iteration finds them mapped (a quarter of its time otherwise goes into page faults).
os.environ.setdefault("MIMALLOC_PURGE_DELAY", "1000")

from hqgs.rasterize import get_num_threads, rasterization, set_num_threads

__version__ = "0.1.0"

__all__ = ["__version__", "get_num_threads", "rasterization", "set_num_threads"]
