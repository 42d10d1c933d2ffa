"""part.json: what the folder of a part, and the run of one, say of the whole scene."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hqgs.base.files import write_json
from hqgs.scene.cells import Cells, Cut, count
from hqgs.scene.scene import Part

FILE = "part.json"
VERSION = 1


def keep_part(folder: Path, part: Part | None) -> None:
    """Write part.json, or remove an old one where there is no part."""
    if part is None:
        (folder / FILE).unlink(missing_ok=True)
    else:
        write_json(folder / FILE, {"version": VERSION, **asdict(part)})


def read_part(folder: Path) -> Part | None:
    """Read part.json; None where there is none. ValueError where it is damaged or its version is unknown."""
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        if (version := facts.pop("version")) != VERSION:
            raise ValueError(f"the version is {version!r:.80}, and only {VERSION} is known")
        part = Part(**(facts | {"cells": _cells(facts["cells"])}))
        _check(part)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    return part


def _cells(value: Any) -> Cells:
    if isinstance(value, int):
        return value
    x, y, z, offset = (float(number) for number in (*value["normal"], value["offset"]))
    if not all(math.isfinite(number) for number in (x, y, z, offset)):
        raise ValueError("a plane is not finite")
    return Cut((x, y, z), offset, _cells(value["below"]), _cells(value["above"]))


def _check(part: Part) -> None:
    if not (isinstance(part.scene, str) and isinstance(part.split, str)):
        raise ValueError("scene and split must be text")
    if not (isinstance(part.part, int) and isinstance(part.parts, int) and 0 <= part.part < part.parts):
        raise ValueError(f"part is {part.part!r:.80} of {part.parts!r:.80}")
    if count(part.cells) != part.parts or sorted(_leaves(part.cells)) != [*range(part.parts)]:
        raise ValueError(f"the cells are not those of {part.parts} parts")
    if not (isinstance(part.held_out, list) and all(isinstance(name, str) for name in part.held_out)):
        raise ValueError("held_out must be a list of text")


def _leaves(cells: Cells) -> list[int]:
    return [cells] if isinstance(cells, int) else [*_leaves(cells.below), *_leaves(cells.above)]
