"""The runs of a scene's parts put together: each cropped to its cell, all in one brightness, one file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from hqgs.base.files import CONFIG
from hqgs.base.stages import OnStage, untold
from hqgs.evaluation.report import REPORT
from hqgs.evaluation.seams import SeamRow, measure_seams
from hqgs.model.constants import SH_C0
from hqgs.model.formats.files import format_of, scene_file
from hqgs.model.gaussians import Gaussians
from hqgs.photos.light import to_linear, to_srgb
from hqgs.scene.camera_files import load_cameras
from hqgs.scene.cells import cell_of
from hqgs.scene.formats.part_json import read_part
from hqgs.scene.listing import some_views
from hqgs.scene.scene import Part, extent_of
from hqgs.show.dome import Dome
from hqgs.training.methods.shared_gains import learned_gains
from hqgs.training.polish import polished
from hqgs.training.veils import veils

POLISH = 300  # steps
STEP = 1e-3  # of a colour, in which its change with the light is measured


@dataclass(frozen=True)
class MergedPart:
    """What a run gave to the merged scene."""

    run: Path
    part: int  # from 1
    gaussians: int  # in its cell
    cropped: int  # outside it
    gains: list[float]  # of red, green and blue in linear light, by which it was made brighter


@dataclass(frozen=True)
class Merged:
    """A merged scene."""

    path: Path
    model: Gaussians  # those of the parts, then those of the dome
    part_of: NDArray[np.uint16]  # [N], the part that each of the parts' Gaussians came from, from 0
    parts: list[MergedPart]
    veils: int  # of the parts' Gaussians that were left out, since a camera stood within them
    dome: int  # Gaussians of the sky behind all
    polished: int  # steps that all of them were polished for
    left_out: int  # Gaussians that are not finite, and not in the file


def merge(
    runs: Sequence[str | Path],
    out: str | Path,
    *,
    scene: str | Path | None = None,
    polish: int = POLISH,
    told: OnStage = untold,
) -> Merged:
    """Put the runs of all parts of a scene together that `hqgs.split` has cut.

    Of each part the Gaussians in its cell are taken, with the harmonics of the part that has most. Parts that
    learned how bright their photos are have each another mean; the photos that they share bring them
    together. Sky that a part had hung outside its cell is gone then; a dome far behind everything has its
    colours (`hqgs/show/dome.py`).

    Args:
        runs: folders of the runs, one of each part, in any order.
        out: the scene file, in a format that `Gaussians.save` writes. It is written whole or not at all.
        scene: folder of the whole scene, whose training photos polish what was merged
            (`hqgs/training/polish.py`); None: it stays as it was merged.
        polish: steps. Runs that made up for degraded photos are not polished: `Merged.polished` is 0 then.
        told: hears of each step.

    Raises:
        FileNotFoundError: a run without a scene.
        ValueError: a run of no part, of another split or of a part that came before, a part that is missing,
            a file that is not a scene, or steps below 0.
    """
    out = Path(out)
    if polish < 0:
        raise ValueError(f"polish is {polish}, wanted at least 0")
    format_of(out)
    given = parts_of(runs)
    for run, _ in given:
        if out.exists() and out.samefile(scene_file(run)):
            raise ValueError(f"{out} is the scene of the run {run}, which would be lost")
    bright = _brightness([run for run, _ in given])
    cropped, part_of, facts = list[Gaussians](), list[NDArray[np.uint16]](), list[MergedPart]()
    for (run, part), gain in zip(given, bright.parts, strict=True):
        whole = Gaussians.load(run)
        own = cell_of(part.cells, whole.means.numpy()) == part.part
        cropped.append(brighter(whole.rows(torch.from_numpy(own)), gain))
        part_of.append(np.full(int(own.sum()), part.part, np.uint16))
        facts.append(MergedPart(run, part.part + 1, int(own.sum()), int((~own).sum()), np.exp(gain).tolist()))
    cameras = [load_cameras(run) for run, _ in given]
    centers = np.stack([camera.center for some in cameras for camera in some.train])
    model, owner = Gaussians.joined(cropped), np.concatenate(part_of)
    del cropped
    veil = veils(model, centers)
    model, owner = model.rows(~veil), owner[~veil.numpy()]
    dome = Dome(model, centers)
    for (run, _), gain, some in zip(given, bright.parts, cameras, strict=True):
        dome.look(brighter(Gaussians.load(run), gain), some.train)
    sky = dome.gaussians(model.sh_degree)
    model = Gaussians.joined([model, sky])
    steps = polish if scene is not None and all(_as_photographed(run) for run, _ in given) else 0
    if scene is not None and steps:
        model = polished(model, scene, bright.photos, _size(given[0][0]), extent_of(centers), steps, told)
    left_out = model.save(out)
    return Merged(out, model, owner, facts, int(veil.sum()), len(sky), steps, left_out)


def _size(run: Path) -> tuple[float, int | None]:
    """`downscale` and `longest` of the photos of a run."""
    asked = json.loads((run / CONFIG).read_text(encoding="utf-8"))["scene"] or {}
    return asked.get("downscale", 1.0), asked.get("longest")


def _as_photographed(run: Path) -> bool:
    """Whether a run took its photos as they are but for their gains: of more, polishing does not know."""
    path = run / REPORT
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        return report["method"] == "3dgs" or report["config"]["hqgs"]["formation"] in ("none", "exposure")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error


def parts_of(runs: Sequence[str | Path]) -> list[tuple[Path, Part]]:
    """The runs with their parts, in the parts' order. ValueError unless they are all parts of one split."""
    given = dict[int, tuple[Path, Part]]()
    first: tuple[Path, Part] | None = None
    for run in map(Path, runs):
        scene_file(run)
        part = read_part(run)
        if part is None:
            raise ValueError(f"{run} is not the run of a part: it has no part.json")
        first = first or (run, part)
        if part.split != first[1].split:
            raise ValueError(f"{run} is {part}, but of another split than {first[0]}, {first[1]}")
        if part.part in given:
            raise ValueError(f"{part} came twice: {given[part.part][0]} and {run}")
        given[part.part] = run, part
    if first is None:
        raise ValueError("there is no run to merge")
    if missing := [k + 1 for k in range(first[1].parts) if k not in given]:
        raise ValueError(
            f"{first[1].scene} has {first[1].parts} parts, and {len(given)} runs were given; missing: part "
            + ", ".join(map(str, missing))
        )
    return [given[k] for k in sorted(given)]


def check_seams(
    merged: Merged,
    scene: str | Path,
    whole: str | Path | None = None,
    downscale: float | None = None,
) -> list[SeamRow]:
    """How good the merged scene is on the held-out photos, beside the seams and elsewhere.

    Args:
        merged: what `merge` gave.
        scene: the folder of the whole scene.
        whole: a run of the whole scene, to be measured in the same pixels.
        downscale: divide the photos' sides by this; None: as the first run did.

    Raises FileNotFoundError or ValueError for what is wrong with the folder, the photos or the run.
    """
    run = merged.parts[0].run
    part = read_part(run)
    assert part is not None  # or it would not have been merged
    if not part.held_out:
        raise ValueError(f"{part.scene} was split without held-out photos: there is nothing to measure with")
    size = _size(run) if downscale is None else (downscale, None)
    scenes = [merged.model] if whole is None else [merged.model, Gaussians.load(whole)]
    return measure_seams(scenes, merged.part_of, some_views(scene, part.held_out, *size))


def brighter(gaussians: Gaussians, gain: NDArray[np.float64]) -> Gaussians:
    """The Gaussians in light exp(`gain`) times as bright, [3], linear.

    The mean colour of each goes through the curve of sRGB; the harmonics change as that does around it, which
    is exact for small ones.
    """
    if not gain.any():
        return gaussians
    colors = 0.5 + SH_C0 * gaussians.sh0.double().numpy()

    def lit(srgb: NDArray[np.float64]) -> NDArray[np.float64]:
        return to_srgb(to_linear(srgb) * np.exp(gain))

    slope = (lit(colors + STEP) - lit(colors - STEP)) / (2 * STEP)
    sh0, higher = (lit(colors) - 0.5) / SH_C0, gaussians.shN.numpy() * slope
    lit_ones = {"sh0": torch.from_numpy(sh0).float(), "shN": torch.from_numpy(higher).float()}
    return Gaussians(**(gaussians.named() | lit_ones))


@dataclass(frozen=True)
class Brightness:
    """What brings the runs of parts to the brightness that the mean photo has in the whole; logarithms."""

    parts: NDArray[np.float64]  # [parts, 3], of each run's light
    photos: dict[str, NDArray[np.float64]]  # [3], how bright the photos are beside the merged scene


def _brightness(runs: list[Path]) -> Brightness:
    """As the photos that two runs share tell it."""
    learned = [_log_gains(run) for run in runs]
    found = np.zeros((len(runs), 3))
    photos: dict[str, list[NDArray[np.float64]]] = {}
    if any(gain.any() for own in learned for gain in own.values()):
        rows, values = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
        for a, b in combinations(range(len(runs)), 2):
            shared = sorted(learned[a].keys() & learned[b].keys())
            if shared:
                row = np.zeros(len(runs))
                row[a], row[b] = len(shared), -len(shared)
                rows.append(row)
                between = np.median([learned[a][name] - learned[b][name] for name in shared], axis=0)
                values.append(len(shared) * between)
        if rows:
            found = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]
    for own, gain in zip(learned, found, strict=True):
        for name, value in own.items():
            photos.setdefault(name, []).append(value - gain)
    means = {name: np.mean(values, axis=0) for name, values in photos.items()}
    mean = np.mean([*means.values()], axis=0)
    return Brightness(found + mean, {name: value - mean for name, value in means.items()})


def _log_gains(run: Path) -> dict[str, NDArray[np.float64]]:
    """How bright the run found each training photo, [3], beside its own scene; 0 where it did not ask."""
    known = (view.name for view in load_cameras(run).views if not view.held_out)
    return learned_gains(run) or {name: np.zeros(3) for name in known}
