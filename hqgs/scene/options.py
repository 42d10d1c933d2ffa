"""What is asked of the photos of a scene, said once: for `hqgs.load`, `hqgs train` and config.json."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from hqgs.base.options import Apart, Factor, Flag, Number, Unsaid, Vector, values
from hqgs.photos.formula import grammar

KINDS = f"{grammar()}, some:KIND (only half of the photos), several steps joined by +, mixed, or none"


@dataclass(frozen=True, kw_only=True)
class PhotoOptions:
    """As users give them; None: not said. `hqgs.load` says more of each."""

    downscale: Factor = None
    """Divide width and height of the photos by F (as the preset says)."""
    test_every: Number = None
    """Hold out every N-th photo to measure with (8, unless the scene has a split); 0: train on all photos."""
    sfm: Flag = False
    """Find cameras and points from the training photos by COLMAP, even if the scene has some."""
    frames: Number = None
    """Number of frames to take from a film (two per second, from 30 to 90)."""
    distance: Apart = None
    """Metres between the cameras of the photos A and B, or points x,y,z: the scene is written in metres."""
    up: Vector = None
    """Up direction in the frame of the photos' cameras (from upright edges, GPS or EXIF)."""
    degrade: Annotated[
        str | None,
        tyro.conf.arg(metavar="KIND", help=f"Degrade the training photos, for experiments: {KINDS}."),
        Unsaid,
    ] = None
    restore: Annotated[str | Path | None, values("WEIGHTS", "", str), Unsaid] = None
    """Restore the training photos with this network first (a file of weights)."""


@dataclass(frozen=True, kw_only=True)
class LoadOptions(PhotoOptions):
    """All arguments of `hqgs.load`, as config.json keeps them; None: not given."""

    path: str | Path = field(kw_only=False)  # kept: absolute, or the name of a built-in scene
    seed: int | None = None
    skip_unreadable: bool | None = None
    longest: int | None = None
    coarse: bool | None = None
