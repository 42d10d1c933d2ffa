"""The frame of a scene file in a file beside it, for formats that have no place for it."""

from __future__ import annotations

import json
from pathlib import Path

from hqgs.base.files import write_json
from hqgs.scene.world import World

SUFFIX = ".world.json"


def keep_world(path: Path, world: World) -> None:
    """Write the frame of the scene file at `path` beside it, or remove an old one where it is its own."""
    beside = path.with_name(path.name + SUFFIX)
    if world == World():
        beside.unlink(missing_ok=True)
    else:
        whose = "file coordinates of the photos' cameras" if world.metres is None else "metres"
        says = f"{whose} are unit * x + shift of those in the scene file"
        write_json(beside, {"frame": says, **world.json()})


def read_world(path: Path) -> World:
    """The frame beside a scene file; its own where there is none. ValueError where it is damaged."""
    beside = path.with_name(path.name + SUFFIX)
    if not beside.is_file():
        return World()
    try:
        return World.of_json(json.loads(beside.read_text(encoding="utf-8")))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{beside} is damaged: {error}") from error
