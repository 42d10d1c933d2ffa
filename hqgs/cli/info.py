"""`hqgs info PATH`: what a run, a scene file or a folder of photos holds."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from hqgs.base.files import CONFIG, PLY, REPORT
from hqgs.cli.progress import duration
from hqgs.evaluation.run_folder import RunFolder
from hqgs.evaluation.verdict import judged_by, verdict
from hqgs.scene.photo_files import is_run


@dataclass(frozen=True, kw_only=True)
class Info:
    """Options of `hqgs info`."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """The folder of a run, a scene file, or a folder with photos."""


OPTIONS = Info


def run(options: Info) -> int:
    """Print what is there; return the exit code (0 done, 1 failed, 2 bad input)."""
    from hqgs.model.formats.files import has_format, scene_file  # here: --help waits for no array

    path = options.path
    if path.is_file() and has_format(path):
        lines = _file(path)
    elif (found := _run(path)) is not None:
        lines = found
    elif (path / "meta.json").is_file() or (is_run(path) and (path / PLY).is_file()):
        lines = _file(scene_file(path))
    elif is_run(path):
        lines = [_not_ended(path)]
    else:
        lines = _photos(path)
    print("\n".join(lines))
    return 0


def _file(path: Path) -> list[str]:
    import numpy as np

    from hqgs.model.formats.files import bytes_of  # here: they load torch
    from hqgs.model.gaussians import Gaussians

    gaussians = Gaussians.load(path)
    means = gaussians.world.out(gaussians.means.numpy())
    lowest, highest = (np.quantile(means, q, axis=0).tolist() for q in (0.05, 0.95))
    box = ", ".join(f"{low:.3g} to {high:.3g}" for low, high in zip(lowest, highest, strict=True))
    errors = "it has an error for each Gaussian: hqgs render --show trust shows them"
    return [
        f"{path}: {len(gaussians):,} Gaussians, harmonics of degree {gaussians.sh_degree}, "
        f"{bytes_of(path) / 1e6:.3g} MB",
        f"90 % of them lie within x, y, z: {box}",
        *([] if gaussians.errors is None else [errors]),
        *(f"read: {note}" for note in gaussians.notes),
    ]


def _run(path: Path) -> list[str] | None:
    """Of a run that has ended; None where the folder has no report, or another program's report.json."""
    run = RunFolder(path)
    try:
        return None if run.report is None else _told(run, run.report)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        if run.is_run:
            raise ValueError(f"{path / REPORT} is damaged: {error!r}") from error
        return None


def _not_ended(path: Path) -> str:
    origin = RunFolder(path).loaded.get("path")
    if origin is None:
        return f"{path}: an unfinished run: hqgs.train(..., resume=True) continues it"
    command = shlex.join(["hqgs", "train", str(origin), "--out", str(path), "--resume"])
    return f"{path}: an unfinished run: {command} continues it"


def _told(run: RunFolder, report: Any) -> list[str]:
    path = run.folder
    mean, steps = report["metrics"]["mean"], f"{report['iterations']:,} of {report['length']:,} iterations"
    word, why = verdict(judged_by(report)[0], report["metrics"])
    numbers = ", ".join(f"{name} {value:.4g}" for name, value in mean.items() if value is not None)
    lines = [
        f"{path}: {report['scene']}, {report['method']}, {steps} in {duration(report['seconds'])}, "
        f"{report['gaussians']:,} Gaussians",
        f"held-out photos: {numbers or 'not measured'}; {word} ({why})",
    ]
    lines += [f"  {note}" for note in report["notes"]]
    if (path / CONFIG).is_file():
        lines.append(f"trained on {run.loaded.get('path', 'a scene made in Python')}")
    lines.append(f"the scene: {path / PLY}; the configuration: {path / CONFIG}")
    return lines


def _photos(path: Path) -> list[str]:
    from hqgs.model.formats.files import FORMATS  # here: they load torch
    from hqgs.scene.load import formats_of, scene_folder
    from hqgs.scene.masks import masks_of
    from hqgs.scene.sfm.bare_photos import bare_photos, readable

    root, inside = scene_folder(path)
    formats = formats_of(root, 1.0)
    found = bare_photos(root, 1.0)
    if found is None:
        raise ValueError(f"{root} holds no photos, no run and no scene file ({', '.join(FORMATS)})")
    photos = readable(found)
    sizes = sorted(set(photos.sizes))
    guess = photos.guess()
    focal = sum(exif.focal > 0 for exif in photos.exif)
    poses = ", ".join(formats) if formats else "none yet; hqgs train and hqgs sfm find them by COLMAP"
    lines = [
        f"{root}: {len(photos.names)} photos of {', '.join(f'{w} x {h}' for w, h in sizes[:4])} px"
        + (" and other sizes" if len(sizes) > 4 else ""),
        f"cameras: {len(guess.sizes)}; EXIF has the focal length of {focal} photos, and rotates "
        f"{sum(exif.quarter_turns > 0 for exif in photos.exif)} of them",
        f"poses: {poses}",
    ]
    lines += inside
    if formats:
        lines += _as_read(root)
    else:
        lines += photos.notes
        if count := len(masks_of(root, photos.folder, photos.names)):
            lines.append(f"masks: of {count} photos")
    lines += [f"cannot be read: {name} ({why})" for name, why in photos.unreadable.items()]
    return lines


def _as_read(root: Path) -> list[str]:
    """What was done with photos, poses and points of a folder that has them, or why it is refused."""
    from hqgs.scene.load import load_scene
    from hqgs.training.config import STANDARD, longest_side

    try:
        scene = load_scene(root, test_every=0, longest=longest_side(STANDARD, None))
        return [f"read: {note}" for note in scene.notes]
    except (OSError, ValueError) as error:
        return [f"hqgs train refuses it: {error}"]
