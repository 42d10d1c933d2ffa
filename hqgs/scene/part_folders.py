"""The folders of parts: each with its share of the whole scene's model, and the photos by link or copy."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from hqgs.base.files import FRAMES
from hqgs.base.stages import OnStage, Stage
from hqgs.scene.capture import find_mask, inside
from hqgs.scene.formats.colmap import match_files
from hqgs.scene.formats.colmap_stream import (
    Points,
    put_count,
    read_images,
    read_points,
    stored_count,
    write_cameras,
    write_image,
    write_points,
)
from hqgs.scene.formats.degradation_json import read_degraded_folder, write_degraded_folder
from hqgs.scene.listing import Listed

MODEL = Path("sparse", "0")
DENSE = 4  # ids up to so many times their number are looked up in a table; others are sought
LEAST_SEEN = 2  # photos of a part that show a point outside its cell: then the part has it too


class Rows:
    """Which row has which id; `ids` [P], all different."""

    def __init__(self, ids: NDArray[np.int64]) -> None:
        self._table: NDArray[np.int32] | None = None
        if len(ids) and ids.min() >= 0 and ids.max() < DENSE * len(ids) + 1000:
            table = np.full(ids.max() + 1, -1, np.int32)
            table[ids] = np.arange(len(ids), dtype=np.int32)
            self._table = table
        else:
            self._order = np.argsort(ids).astype(np.int32)
            self._ids = ids[self._order]

    def __call__(self, wanted: NDArray[np.integer]) -> NDArray[np.int32]:
        """Rows of these ids, -1 for those that are not there."""
        if self._table is not None:
            there = (wanted >= 0) & (wanted < len(self._table))
            return np.where(there, self._table[np.where(there, wanted, 0)], np.int32(-1))
        if not len(self._ids):
            return np.full(len(wanted), -1, np.int32)
        at = np.minimum(np.searchsorted(self._ids, wanted), len(self._ids) - 1)
        return np.where(self._ids[at] == wanted, self._order[at], np.int32(-1))


def read_positions(path: Path, told: OnStage) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Ids [P] and positions [P, 3] of a model's points, in the file's order."""
    total = stored_count(path)
    ids, xyz, at = np.empty(0, np.int64), np.empty((0, 3), np.float32), 0
    for points in read_points(path):
        if not at:  # its first piece has shown that the file can hold so many
            ids, xyz = np.empty(total, np.int64), np.empty((total, 3), np.float32)
        rows = slice(at, at + len(points.heads))
        ids[rows] = points.heads["id"]
        with np.errstate(over="ignore"):
            xyz[rows] = points.heads["xyz"]
        at = rows.stop
        told(Stage("points read", at, total))
    return ids, xyz


def write_models(
    model: Path,
    folders: Sequence[Path],
    scene: Listed,
    member: NDArray[np.bool_],
    rows_of: Rows,
    own: NDArray[np.uint16],
    spare: int | None,
    thin: int | None,
    told: OnStage,
) -> list[int]:
    """Write `sparse/0` of each part, and tell how many points it has.

    Args:
        model: folder of the whole scene's binary model.
        folders: of the parts; they are made.
        scene: what the model lists.
        member: [N, parts], which photos each part has.
        rows_of: rows of the points by their ids.
        own: [P], the part in whose cell each point lies.
        spare: of a model without tracks, every point whose row is a multiple of it is in all parts.
        thin: the last folder is no part's, and has the points whose row is a multiple of this; None: it is.
        told: hears where it is.
    """
    with ExitStack() as stack:
        for folder in folders:
            (folder / MODEL).mkdir(parents=True)
        points = [stack.enter_context((folder / MODEL / "points3D.bin").open("wb")) for folder in folders]
        images = [stack.enter_context((folder / MODEL / "images.bin").open("wb")) for folder in folders]
        counts = [0] * len(folders)
        for file in (*points, *images):
            put_count(file, 0)
        row_of_photo = Rows(scene.image_ids)
        has = np.zeros((len(own), -(-len(folders) // 8)), np.uint8)  # a bit for each part
        at = 0
        for piece in read_points(model / "points3D.bin"):
            rows = slice(at, at + len(piece.heads))
            at = rows.stop
            owner, photo = piece.owner, row_of_photo(piece.track[:, 0])
            parts_of = member[photo] & (photo >= 0)[:, None]
            for k, file in enumerate(points):
                shown = parts_of[:, k]
                kept = (own[rows] == k) | (
                    np.bincount(owner[shown], minlength=len(piece.heads)) >= LEAST_SEEN
                )
                if spare is not None:
                    kept |= np.arange(rows.start, rows.stop) % spare == 0
                if thin is not None and file is points[-1]:
                    kept = np.arange(rows.start, rows.stop) % thin == 0
                has[rows, k // 8] |= (kept << (k % 8)).astype(np.uint8)
                counts[k] += int(kept.sum())
                write_points(file, _kept(piece, owner, kept, shown))
            told(Stage("points shared out", at, len(own)))
        photos = [0] * len(folders)
        for number, image in enumerate(read_images(model / "images.bin")):
            point = image.pixels["point"]
            rows = rows_of(point)
            for k in np.flatnonzero(member[row_of_photo(np.array([image.image_id]))[0]]):
                there = (rows >= 0) & (has[rows, k // 8] >> (k % 8) & 1 == 1)
                write_image(images[k], image, np.where(there, point, -1))
                photos[k] += 1
            told(Stage("photos shared out", number + 1, len(member)))
        for k, folder in enumerate(folders):
            put_count(points[k], counts[k])
            put_count(images[k], photos[k])
            used = sorted({*scene.camera_ids[member[:, k]].tolist()})
            write_cameras(folder / MODEL / "cameras.bin", {number: scene.cameras[number] for number in used})
    return counts


def _kept(
    piece: Points, owner: NDArray[np.intp], kept: NDArray[np.bool_], shown: NDArray[np.bool_]
) -> Points:
    """Some of the points, with those photos in their tracks that are shown."""
    of_track = shown & kept[owner]
    heads = piece.heads[kept]
    heads["length"] = np.bincount(owner[of_track], minlength=len(kept))[kept]
    return Points(heads, piece.track[of_track])


def bring_photos(root: Path, folder: Path, final: Path, names: list[str], copy: bool) -> None:
    """Give a part its photos, masks and small photos of the scene in `root`, by link or copy.

    Args:
        root: the whole scene's folder.
        folder: the part's, as long as it is written.
        final: where it will lie, which relative links start from.
        names: of the part's photos.
        copy: copy them; else link.

    Raises OSError where the system has no links; FileNotFoundError for a missing photo.
    """

    def bring(source: Path, below: str, name: str) -> None:
        target = inside(folder, f"{below}/{name}", "the photo's name")
        target.parent.mkdir(parents=True, exist_ok=True)
        if copy:
            shutil.copyfile(source, target)
            return
        there = (final / target.relative_to(folder)).parent
        try:
            target.symlink_to(os.path.relpath(source, there))
        except OSError as error:
            raise OSError(f"cannot link {target} to {source} ({error}); --copy copies the photos") from error

    for images in sorted(root.iterdir()):
        if not (images.is_dir() and re.fullmatch(r"images(_[\d.]+)?", images.name)):
            continue
        try:
            files = match_files(names, root, images, [])
        except FileNotFoundError:
            if images.name in ("images", "images_1"):
                raise
            continue  # scaled photos that do not belong to these cameras
        for name, file in files.items():
            bring(file, images.name, str(PurePosixPath(name).with_suffix(file.suffix)))
        if (images / FRAMES).is_file():
            bring(images / FRAMES, images.name, FRAMES)
    for name in names:
        if (mask := find_mask(root, name)) is not None:
            bring(mask, "masks", mask.relative_to(root / "masks").as_posix())
    degraded = read_degraded_folder(root)
    if degraded is not None:
        kept = set(names)
        train = {name: low for name, low in degraded.train.items() if name in kept}
        for low in train.values():
            if low is not None:
                bring(inside(root, low, "the small photo"), ".", low)
        steps = {name: done for name, done in degraded.steps.items() if name in kept}
        write_degraded_folder(folder, replace(degraded, train=train, steps=steps))
