"""Scenes that need no download: a ray-cast room, which holds no Gaussian, photographed well and badly."""

from hqgs.scene.builtin.rooms import room
from hqgs.scene.builtin.scene import embedded_cameras, embedded_scene
from hqgs.scene.builtin.shading import render_depth, render_view
from hqgs.scene.builtin.sparse import sparse_room
from hqgs.scene.builtin.wild import TRUE_KINDS, wild_room

__all__ = [
    "TRUE_KINDS",
    "embedded_cameras",
    "embedded_scene",
    "render_depth",
    "render_view",
    "room",
    "sparse_room",
    "wild_room",
]
