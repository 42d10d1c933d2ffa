"""The embedded scene: a ray-cast room that needs no download and holds no Gaussian."""

from hqgs.scene.builtin.scene import embedded_cameras, embedded_scene
from hqgs.scene.builtin.shading import render_depth, render_view

__all__ = ["embedded_cameras", "embedded_scene", "render_depth", "render_view"]
