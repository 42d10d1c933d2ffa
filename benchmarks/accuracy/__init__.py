"""Error against run time of the rasterizer's knobs."""
