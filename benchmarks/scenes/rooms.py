"""The scenes of the benchmarks by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from benchmarks.scenes.panorama import WIDTH, panorama_room
from benchmarks.scenes.room.scene import embedded_scene
from benchmarks.scenes.sparse import PHOTOS, beyond_room
from benchmarks.scenes.wild import TRUE_KINDS, wild_room
from hqgs.scene.constants import PATH_SIZE
from hqgs.scene.names import EMBEDDED
from hqgs.scene.scene import Scene

BEYOND, PANORAMA = "beyond", "true-panorama"
NAMES = (EMBEDDED, BEYOND, PANORAMA, *TRUE_KINDS)


def is_room(name: str | Path) -> bool:
    """Whether this names one of these scenes."""
    return str(name).partition(":")[0] in NAMES


def room(name: str | Path, cache: Path | None = None, downscale: float = 1.0, seed: int = 0) -> Scene:
    """A scene with photos of 504 x 378 px, divided by `downscale`.

    "embedded": `embedded_scene`; "beyond[:N]": N photos (12), judged between and beyond their cameras
    (`beyond_room`); "true-panorama": faces of panoramas of 1008 px (`panorama_room`); "true-shake[:PX]",
    "true-defocus[:R]": training photos that cameras have truly taken so, held-out ones clean (`wild_room`,
    with `seed`). `cache` keeps what was made. ValueError for an unknown name or a value out of range.
    """
    text = str(name)
    kind, _, value = text.partition(":")
    width, height = (round(side / downscale) for side in PATH_SIZE)
    plain: dict[str, Callable[[], Scene]] = {
        EMBEDDED: lambda: embedded_scene(cache, width, height),
        PANORAMA: lambda: panorama_room(cache, 2 * round(WIDTH / downscale / 2)).scene,
    }
    if text in plain:
        return plain[text]()
    if kind != BEYOND:
        scene = wild_room(text, seed, cache, width, height).scene  # its errors name the kinds there are
    elif value and not value.isdecimal():
        raise ValueError(f"{text}: wanted {BEYOND}:N with the number of photos, got {value!r}")
    else:
        scene = beyond_room(int(value or PHOTOS), cache, width, height)
    return replace(scene, name=text.replace(":", "-"))
