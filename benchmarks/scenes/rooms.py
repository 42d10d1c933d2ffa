"""The scenes of the benchmarks by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from benchmarks.scenes.sparse import PHOTOS, beyond_room
from benchmarks.scenes.wild import TRUE_KINDS, wild_room
from hqgs.scene.constants import PATH_SIZE
from hqgs.scene.scene import Scene

BEYOND = "beyond"


def is_room(name: str | Path) -> bool:
    """Whether this names one of these scenes."""
    return str(name).partition(":")[0] in (BEYOND, *TRUE_KINDS)


def room(name: str | Path, cache: Path | None = None, downscale: float = 1.0, seed: int = 0) -> Scene:
    """A scene with photos of 504 x 378 px, divided by `downscale`.

    "beyond[:N]": N photos (12), judged between and beyond their cameras (`beyond_room`); "true-shake[:PX]",
    "true-defocus[:R]": training photos that cameras have truly taken so, held-out ones clean (`wild_room`,
    with `seed`). `cache` keeps what was made. ValueError for an unknown name or a value out of range.
    """
    text = str(name)
    kind, _, value = text.partition(":")
    width, height = (round(side / downscale) for side in PATH_SIZE)
    if kind != BEYOND:
        scene = wild_room(text, seed, cache, width, height).scene  # its errors name the kinds there are
    elif value and not value.isdecimal():
        raise ValueError(f"{text}: wanted {BEYOND}:N with the number of photos, got {value!r}")
    else:
        scene = beyond_room(int(value or PHOTOS), cache, width, height)
    return replace(scene, name=text.replace(":", "-"))
