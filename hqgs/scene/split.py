"""A scene cut into parts, each a folder that trains on its own; for scenes that no machine holds."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hqgs.base.files import check_new_folder, existing_folder, new_folder, write_json
from hqgs.base.stages import OnStage, Stage, untold
from hqgs.scene.capture import Photo
from hqgs.scene.cells import Cells, cell_of, cut_space, sight_shares
from hqgs.scene.formats.degradation_json import read_degraded_folder
from hqgs.scene.formats.part_json import VERSION, keep_part, read_part
from hqgs.scene.geometry import project
from hqgs.scene.listing import Listed, binary_model, listed
from hqgs.scene.load import held_out_names
from hqgs.scene.part_folders import Rows, bring_photos, read_positions, write_models
from hqgs.scene.scene import Camera, Part

PLAN = "parts.json"  # beside the parts' folders
MOST_PARTS = 256
COARSE = "coarse"  # beside them, the whole with few photos and points
COARSE_PHOTOS, COARSE_POINTS = 512, 1 << 18  # at most
SHARE = 0.15  # of a photo's lines of sight that end in a cell or run through it: then its part has the photo
LEAST_POINTS = 4  # fewer start no Gaussians
SAMPLED = 1 << 20  # points that the cuts are balanced by
SPARE = 1 << 14  # points that stand for all others where the model does not tell what photos show


@dataclass(frozen=True)
class PartFacts:
    """What a part holds."""

    folder: str  # below the split's own
    train: int  # photos
    held_out: int  # of the whole scene's held-out photos, those that the part sees
    own_points: int  # in its cell
    points: int  # with those around it that its photos show


@dataclass(frozen=True)
class Split:
    """A scene that was split."""

    folder: Path
    scene: str
    train: int  # photos of the whole scene
    held_out: int
    points: int
    parts: list[PartFacts]
    coarse: PartFacts | None  # the whole with few points and photos, to start from; None: one part


def split(
    path: str | Path,
    out: str | Path,
    parts: int,
    *,
    test_every: int = 8,
    copy: bool = False,
    told: OnStage = untold,
) -> Split:
    """Cut a COLMAP folder into parts that are trained each for itself, and put together by `hqgs.merge`.

    Each part is a folder that `hqgs.load` takes: the points of its cell, the photos that see enough of it,
    whatever else these show, all in the whole scene's frame. Beside them lies `coarse`, the whole with few
    photos and points, for any machine: a run of it is what the parts start from (`around`). The cells tile
    space, so that each Gaussian belongs to one part. The same scene gives the same parts. Photos are never
    decoded, and points never held with their tracks.

    Args:
        path: a folder with a COLMAP model, binary or text.
        out: a new folder, for part1, part2, ... and parts.json. It is moved there when it is complete.
        parts: 1..256.
        test_every: hold out every Nth photo of the whole scene, in all parts; 0: none. A folder that names
            its held-out photos itself keeps them.
        copy: copy the photos, so that a part can be taken elsewhere; else they are linked.
        told: hears where it is.

    Raises:
        FileExistsError: `out` is neither missing nor an empty folder.
        FileNotFoundError: a missing folder or photo.
        ValueError: a value out of range, a damaged model, or one that cannot be cut into so many parts.
    """
    root, out = existing_folder(path), Path(out).resolve()
    check_new_folder(out)
    if not 1 <= parts <= MOST_PARTS:
        raise ValueError(f"parts is {parts}, wanted 1..{MOST_PARTS}")
    if test_every < 0:
        raise ValueError(f"test_every must be at least 0, got {test_every}")
    if (already := read_part(root)) is not None:
        raise ValueError(f"{root} is {already}; split the whole scene into more parts instead")
    with binary_model(root) as model:
        told(Stage("photos listed", 0, 0))
        scene = listed(root, model)
        held_out = held_out_names(root, scene.capture, test_every, [], read_degraded_folder(root))
        names = [photo.name for photo in scene.capture.photos]
        train = np.array([name not in held_out for name in names])
        if parts > train.sum():
            raise ValueError(f"parts is {parts}, and {root} has {train.sum()} photos to train on")
        ids, xyz = read_positions(model / "points3D.bin", told)
        rows_of = Rows(ids)
        del ids
        tracked = any(len(sample) for sample in scene.sample)
        spare = None if tracked else len(xyz) // SPARE + 1
        shown = _shown(scene, rows_of, xyz, spare)
        cells = _cells(root, shown, xyz, parts)
        member = members(cells, scene.centers, shown)
        own = np.concatenate([cell_of(cells, xyz[k : k + SAMPLED]) for k in range(0, len(xyz), SAMPLED)])
        _check(root, parts, member[train], own)
        del shown, xyz
        of_all = Part(
            root.name, _fingerprint(cells, names, member, sorted(held_out)), 0, parts, cells, sorted(held_out)
        )
        with new_folder(out) as folder:
            width = len(str(parts))
            whose = [replace(of_all, part=k) for k in range(parts)]
            folders = [folder / f"part{k + 1:0{width}}" for k in range(parts)]
            thin = None
            if parts > 1:
                thin = -(-len(own) // COARSE_POINTS)
                member = np.column_stack([member, _spread(len(names), COARSE_PHOTOS)])
                whose.append(replace(of_all, split=f"{of_all.split}-{COARSE}", parts=1, cells=0))
                folders.append(folder / COARSE)
            counts = write_models(model, folders, scene, member, rows_of, own, spare, thin, told)
            facts = []
            for k, part in enumerate(folders):
                rows = np.flatnonzero(member[:, k])
                bring_photos(root, part, out / part.name, [names[row] for row in rows], copy)
                keep_part(part, whose[k])
                photos, trained = len(rows), int(train[rows].sum())
                facts.append(
                    PartFacts(part.name, trained, photos - trained, int((own == k).sum()), counts[k])
                )
                told(Stage("parts written", k + 1, len(folders)))
            summary = {"version": VERSION, "scene": root.name, "split": of_all.split}
            write_json(folder / PLAN, summary | {"parts": [asdict(one) for one in facts[:parts]]})
    trained, coarse = int(train.sum()), next(iter(facts[parts:]), None)
    return Split(out, root.name, trained, len(names) - trained, len(own), facts[:parts], coarse)


def _cells(root: Path, shown: list[NDArray[np.float64]], xyz: NDArray[np.float32], parts: int) -> Cells:
    """The parts' cells, from the middles of what photos show, and from points."""
    places = np.array([np.median(points, axis=0) for points in shown if len(points)]).reshape(-1, 3)
    points = xyz[:: len(xyz) // SAMPLED + 1]
    try:
        return cut_space(places, points[np.isfinite(points).all(1)], parts)
    except ValueError as error:
        raise ValueError(f"{root} cannot be cut into {parts} parts: {error}") from error


def members(
    cells: Cells, centers: NDArray[np.float64], shown: list[NDArray[np.float64]]
) -> NDArray[np.bool_]:
    """Which parts have each photo, [N, parts]: those whose cells SHARE of its lines of sight reach, or most.

    `centers` [N, 3] of the cameras, `shown` the points that each sees [M, 3].
    """
    shares = np.stack([sight_shares(cells, *one) for one in zip(centers, shown, strict=True)])
    member = shares >= SHARE
    member[np.arange(len(shares)), shares.argmax(1)] = True
    return member


def _spread(total: int, most: int) -> NDArray[np.bool_]:
    """Which of so many photos stand for all, evenly spread, [N]."""
    chosen = np.zeros(total, np.bool_)
    chosen[np.linspace(0, total - 1, min(total, most)).round().astype(int)] = True
    return chosen


def _shown(
    scene: Listed, rows_of: Rows, xyz: NDArray[np.float32], spare: int | None
) -> list[NDArray[np.float64]]:
    """A sample of the points that each photo shows, [M, 3]; without tracks, of those in its frame."""
    if spare is None:
        found = [xyz[at[at >= 0]].astype(np.float64) for at in map(rows_of, scene.sample)]
    else:
        few = xyz[::spare].astype(np.float64)
        found = [few[_in_frame(photo, few)] for photo in scene.capture.photos]
    return [points[np.isfinite(points).all(1)] for points in found]


def _in_frame(photo: Photo, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points [M, 3] lie within the photo's frame, its lens taken for a straight one; [M]."""
    width, height = photo.camera.width, photo.camera.height
    camera = Camera(width, height, photo.camera.calibration_matrix(), photo.viewmat)
    pixels, depths = project(camera, points)
    with np.errstate(invalid="ignore"):
        return (depths > 0) & ((pixels >= 0) & (pixels < (width, height))).all(1)


def _check(root: Path, parts: int, member: NDArray[np.bool_], own: NDArray[np.uint16]) -> None:
    """ValueError for a part that could not be trained; `member` of the training photos."""
    photos, points = member.sum(0), np.bincount(own, minlength=parts)
    for k in range(parts):
        if not photos[k] or points[k] < LEAST_POINTS:
            raise ValueError(
                f"{root} cannot be cut into {parts} parts: part {k + 1} would have {photos[k]} photos to "
                f"train on and {points[k]} points; ask for fewer"
            )


def _fingerprint(cells: Cells, names: list[str], member: NDArray[np.bool_], held_out: list[str]) -> str:
    """The same for equal splits alone."""
    plane = cells if isinstance(cells, int) else asdict(cells)
    facts = json.dumps([plane, names, held_out]).encode() + np.packbits(member).tobytes()
    return hashlib.sha256(facts).hexdigest()[:16]
