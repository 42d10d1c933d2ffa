"""Errors of the rasterizer in extreme cases, against many digits."""
