"""degradation.json: what a scene folder with degraded training photos says of itself."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hqgs.base.files import read_json, write_json
from hqgs.base.typed import build
from hqgs.photos.files import decode, stored_size
from hqgs.photos.pixels import as_floats
from hqgs.scene.capture import inside
from hqgs.scene.scene import View

FILE = "degradation.json"
VERSION = 2


@dataclass(frozen=True)
class DegradedFolder:
    """The contents of degradation.json. Photo names are those of the COLMAP model."""

    kind: str  # what parse_degradation reads
    seed: int
    train: dict[str, str | None]  # the degraded photos, each with its small photo's path in the scene folder
    held_out: list[str]  # the clean photos
    notes: list[str]  # for `Scene.notes`
    # of each degraded photo what happened to it, as `degrade_sequence` says
    steps: dict[str, list[dict[str, Any]]] = field(default_factory=dict)


def write_degraded_folder(root: Path, folder: DegradedFolder) -> None:
    """Write degradation.json into the scene folder `root`."""
    write_json(root / FILE, {"version": VERSION, **vars(folder)})


def read_degraded_folder(root: Path) -> DegradedFolder | None:
    """Read degradation.json of the scene folder `root`; None where there is none.

    ValueError if it is damaged or its version is not known.
    """
    path = root / FILE
    if not path.is_file():
        return None
    facts = read_json(path)
    if isinstance(facts, dict) and (version := facts.pop("version", 1)) != VERSION:
        raise ValueError(f"{path} is damaged: the version is {version!r:.80}, and only {VERSION} is known")
    return build(DegradedFolder, facts, f"{path} is damaged")


def with_low(view: View, folder: DegradedFolder, root: Path) -> View:
    """The view with its small photo in `low`, where the folder has one.

    Raises FileNotFoundError for a missing small photo, ValueError for one that is no smaller than the photo.
    """
    file = folder.train.get(view.name)
    if file is None:
        return view
    path = inside(root, file, f"{FILE}: the small photo")
    if not path.is_file():
        raise FileNotFoundError(f"photo {view.name!r} has no small photo {path}")
    width, height = stored_size(path)
    if width > view.camera.width or height > view.camera.height:
        raise ValueError(
            f"the small photo {path} is {width} x {height}, its photo "
            f"{view.camera.width} x {view.camera.height}"
        )
    low = as_floats(decode(path)[0])
    return replace(view, low=low)
