"""The built-in scenes by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hqgs.scene.builtin.panorama import WIDTH, panorama_room
from hqgs.scene.builtin.scene import embedded_scene
from hqgs.scene.builtin.sparse import PHOTOS, beyond_room, sparse_room
from hqgs.scene.builtin.wild import parse_true_kind, wild_room
from hqgs.scene.constants import PATH_SIZE
from hqgs.scene.names import BEYOND, EMBEDDED, PANORAMA, SPARSE
from hqgs.scene.scene import Scene


def room(name: str | Path, cache: Path | None = None, downscale: float = 1.0, seed: int = 0) -> Scene:
    """A built-in scene with photos of 504 x 378 px, divided by `downscale`.

    "embedded": `embedded_scene`; "sparse": few photos from far apart (`sparse_room`); "beyond[:N]": N
    photos (12), judged between and beyond their cameras (`beyond_room`); "true-panorama": faces of panoramas
    of 1008 px (`panorama_room`); "true-shake[:PX]", "true-defocus[:R]", "true-exposure[:EV]",
    "true-devices[:N]", "true-crowd[:N]": training photos that cameras have truly taken so, held-out ones
    clean (`wild_room`, with `seed`). `cache` keeps what was made. ValueError for an unknown name or a value
    out of range.
    """
    text = str(name)
    width, height = (round(side / downscale) for side in PATH_SIZE)
    if text == EMBEDDED:
        return embedded_scene(cache, width, height)
    if text == SPARSE:
        return sparse_room(cache, width, height)
    if text == PANORAMA:
        return panorama_room(cache, 2 * round(WIDTH / downscale / 2)).scene
    kind, _, value = text.partition(":")
    if kind == BEYOND:
        if value and not value.isdecimal():
            raise ValueError(f"{text}: wanted {BEYOND}:N with the number of photos, got {value!r}")
        scene = beyond_room(int(value or PHOTOS), cache, width, height)
        return replace(scene, name=text.replace(":", "-"))
    parse_true_kind(text, width)  # its errors name the kinds and values there are
    return replace(wild_room(text, seed, cache, width, height).scene, name=text.replace(":", "-"))
