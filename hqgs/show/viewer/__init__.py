"""A page on this machine to look at a scene: the rasterizer's own pictures, streamed."""
