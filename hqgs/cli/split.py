"""`hqgs split SCENE --parts K --out DIR`: parts of a scene that no machine holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from hqgs.base.files import check_new_folder, existing_folder
from hqgs.base.text import markdown_table
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import Flag, Folder, ready


@dataclass(frozen=True, kw_only=True)
class SplitScene:
    """Options of `hqgs split`."""

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """A folder with photos and a COLMAP model."""
    parts: Annotated[int, tyro.conf.arg(metavar="K")]
    """How many."""
    out: Folder
    """Folder for the parts; missing or empty."""
    test_every: Annotated[int, tyro.conf.arg(metavar="N")] = 8
    """Hold out every Nth photo of the whole scene, in all parts; 0: none."""
    copy: Flag = False
    """Copy the photos, so that a part can be taken to another machine; else they are linked."""


OPTIONS = SplitScene


def run(options: SplitScene) -> int:
    """Write the parts; return the exit code (0 done, 1 failed, 2 bad input)."""
    try:
        check_new_folder(options.out)
        existing_folder(options.scene)
        ready(str(options.scene))
        from hqgs.scene.split import split  # here: it loads torch

        with LoadingScreen() as screen:
            made = split(
                options.scene,
                options.out,
                options.parts,
                test_every=options.test_every,
                copy=options.copy,
                told=screen.stage,
            )
    except BAD_INPUT as error:
        return fail(2, error)
    except OSError as error:
        return fail(1, f"{options.out}: {error}")
    head = ["part", "photos", "held out", "points of its own", "points"]
    rows = [
        [
            str(options.out / part.folder),
            f"{part.train:,}",
            f"{part.held_out:,}",
            f"{part.own_points:,}",
            f"{part.points:,}",
        ]
        for part in [*made.parts, *([] if made.coarse is None else [made.coarse])]
    ]
    rows.append([made.scene, f"{made.train:,}", f"{made.held_out:,}", f"{made.points:,}", f"{made.points:,}"])
    print(markdown_table(f"{made.scene} in {len(made.parts)} parts", head, rows))
    around = ""
    if made.coarse is not None:
        print(f"\nfirst: hqgs train {options.out / made.coarse.folder} --out COARSE --preset quick")
        around = " --around COARSE"
    print(f"now, each on any machine: hqgs train {options.out / made.parts[0].folder} --out RUN1{around}")
    print(f"then: hqgs merge RUN1 RUN2 ... --out scene.ply --scene {options.scene}")
    return 0
