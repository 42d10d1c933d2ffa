"""The rasterizer's and a training step's time."""
