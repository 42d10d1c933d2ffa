"""Running COLMAP in a process of its own (`program.py`), and reading what it found."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs._rust import get_num_threads
from hqgs.base.files import keep_folder, lock_folder
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.scene.formats.colmap import registered
from hqgs.scene.scene import Camera
from hqgs.scene.sfm.database import LEAST_PHOTOS
from hqgs.scene.sfm.failure import Outcome, counts, doubtful, what_to_take, why_doubtful, why_few, why_lost

LEAST_SHARE = 0.5  # of the photos must find their place in a model

_BLOCK = re.compile(r"Processing block \[(\d+)/(\d+)(?:, (\d+)/(\d+))?\]")
PROGRAM = Path(__file__).with_name("program.py")
FORMAT = 4  # of what is kept: raised by hand where other poses or points would be found, or stored otherwise
STAGES = {
    "features": "COLMAP: features",
    "smoothed": "COLMAP: features of smoothed photos",
    "matches": "COLMAP: pairs of photos matched",
    "verify": "COLMAP: matches checked",
    "place": "COLMAP: photos placed",
    "home": "COLMAP: poses of the remaining photos",
    "agree": "COLMAP: places checked",
    "sharpen": "COLMAP: poses refined",
}


@dataclass(frozen=True)
class Guess:
    """What is known of the cameras of photos before COLMAP looks for them."""

    sizes: list[tuple[int, int]]  # width and height of each camera
    focals: list[float]  # px; 0: not known
    camera_of: list[int]  # of each photo, the number of its camera
    rotations: NDArray[np.float64] | None = None  # [F, 3, 3]: of each photo come F faces, whose cameras are
    # known but for their pose; maps the first one's frame into theirs


@dataclass(frozen=True)
class Model:
    """COLMAP's largest model, and what its best pass came to."""

    found: pycolmap.Reconstruction
    outcome: Outcome
    called: Mapping[str, str] = field(default_factory=dict)  # what the user calls photos, by COLMAP's names

    def poses(self) -> dict[str, NDArray[np.float64]]:
        """World-to-camera matrices [4, 4] by photo, sorted; ValueError where too few photos have one, or most
        are no better than chance."""
        poses, photos = registered(self.found), len(self.outcome.features)
        if len(poses) < max(LEAST_PHOTOS, LEAST_SHARE * photos):
            raise ValueError(
                f"COLMAP registered only {len(poses)} of {photos} photos, wanted at least {LEAST_PHOTOS} and "
                f"{LEAST_SHARE:.0%}. {why_few(self.outcome)}. {self._to_take()}".strip()
            )
        if 2 * len(doubtful(self.outcome)) > len(poses):
            raise ValueError(f"most poses of these photos are probably wrong. {self.advice()}")
        return poses

    def lost(self) -> dict[str, str]:
        """Photos that have no place, sorted, and why."""
        placed, one = registered(self.found), self.outcome
        rich = sorted(one.features, key=lambda name: one.features[name])  # of faces the last one tells
        lost = {self._name(name): why_lost(name, one) for name in rich if name not in placed}
        return dict(sorted(lost.items()))

    def advice(self) -> str | None:
        """What to do about photos that have no place, or places in doubt; None: there are none."""
        told = self._to_take()
        told = f"{counts(self.outcome)}. {told}" if told else ""
        return ". ".join(filter(None, (told, why_doubtful(self.outcome, self._name)))) or None

    def _to_take(self) -> str:
        apart = [sorted(map(self._name, group)) for group in self.outcome.apart]
        told = what_to_take(self.lost(), apart)
        return told[:1].upper() + told[1:]

    def _name(self, name: str) -> str:
        return self.called.get(name, name)


def run_colmap(
    names: Sequence[str],
    contents: Iterable[bytes],
    cameras: Sequence[Camera] | Guess,
    write: Callable[[Path], None],
    keep: Path | None = None,
    on_stage: OnStage = silent,
    coarse: bool = False,
    called: Mapping[str, str] | None = None,
) -> Model:
    """COLMAP's largest model of photos.

    Args:
        names: of the photos, as COLMAP shall know them.
        contents: bytes that tell each photo, with its mask, from all others.
        cameras: pinhole intrinsics that stay as they are, or what is known of cameras that COLMAP finds.
        write: puts the photos under their names into a folder that is there and empty, and below `masks`
            beside it either no mask, or `NAME.png` for every photo.
        keep: a folder for models: COLMAP does not run again for the same photos, masks and cameras,
            and goes on with the features and matches of a call that was interrupted.
        on_stage: hears what is being done.
        coarse: photos may be looked at coarsely, which is faster, as long as 95 % of them are placed.
        called: what the user calls the photos of those names.

    Raises ValueError for fewer than 3 photos, where COLMAP fails, or where the photos do not match.
    """
    if len(names) < LEAST_PHOTOS:
        raise ValueError(
            f"finding cameras needs at least {LEAST_PHOTOS} photos, got {len(names)}: 20 to 100 that "
            "overlap make a good scene"
        )
    given: dict[str, NDArray[Any]] = {"names": np.array(names)}
    if isinstance(cameras, Guess):
        given["sizes"] = np.array(cameras.sizes)
        given["focals"] = np.array(cameras.focals, np.float64)
        given["camera_of"] = np.array(cameras.camera_of)
        if cameras.rotations is not None:
            given["rotations"] = cameras.rotations
    else:
        given["sizes"] = np.array([(camera.width, camera.height) for camera in cameras])
        given["Ks"] = np.stack([camera.K for camera in cameras])
    if coarse:
        given["coarse"] = np.array(True)
    kept = None if keep is None else keep / key_of(str(sorted(given)), _pieces(names, contents, given))
    if kept is not None and kept.is_dir():
        return _read(kept, called or {})
    if len(names) > 150:
        note = f"{len(names)} photos take COLMAP long; 100 are enough for most scenes"
        on_stage(Stage("COLMAP", 0, len(names), note))
    with _workplace(kept) as directory:
        photos = directory / "photos"
        if not all((photos / name).exists() for name in names):  # links to what is moved, or gone, are none
            new = directory / "new"
            for old in (new, photos, directory / "masks"):
                shutil.rmtree(old, ignore_errors=True)
            (new / "photos").mkdir(parents=True)
            write(new / "photos")
            if (new / "masks").is_dir():
                (new / "masks").rename(directory / "masks")
            (new / "photos").rename(photos)
        given["photos"] = np.array(str(photos))
        np.savez(directory / "input.npz", **given)  # pyright: ignore[reportArgumentType]
        run_program("reconstruct", directory, on_stage)
        if not (directory / "model" / "images.bin").is_file():
            told = why_few(_outcome(directory / "facts.json"))
            raise ValueError(f"COLMAP found no poses for these {len(names)} photos. {told}")
        if kept is not None:
            keep_folder(directory / "model", kept)
        return _read(directory / "model", called or {})


@contextmanager
def _workplace(kept: Path | None) -> Iterator[Path]:
    """A folder for COLMAP's files: beside `kept`, where it stays until the work is done, or a new one."""
    if kept is None:
        with tempfile.TemporaryDirectory(prefix="hqgs-sfm-") as name:
            yield Path(name)
        return
    directory = kept.with_name(f".{kept.name}")
    with lock_folder(directory):
        try:
            yield directory
        except KeyboardInterrupt:
            raise  # the next call goes on from here
        except BaseException:
            shutil.rmtree(directory, ignore_errors=True)
            raise
        shutil.rmtree(directory, ignore_errors=True)


def run_program(
    command: str, directory: Path, on_stage: OnStage = silent, time_limit: float = math.inf
) -> None:
    """Run a command of PROGRAM in `directory` to its end, at most so many seconds. Whatever ends this process
    ends it too; it finds hqgs, whatever hqgs was started from, and sums of linear algebra have one order.
    """
    program = [sys.executable, str(PROGRAM), command, str(directory), str(get_num_threads())]
    paths = [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")]
    one = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1")
    own = os.environ | one | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    end = time.monotonic() + time_limit
    with (directory / "log.txt").open("wb") as log:
        process = subprocess.Popen(
            program, stdin=subprocess.PIPE, stdout=log, stderr=log, start_new_session=True, env=own
        )
        try:
            while True:
                try:
                    status = process.wait(max(0, min(0.25, end - time.monotonic())))
                    break
                except subprocess.TimeoutExpired:
                    if time.monotonic() >= end:
                        raise ValueError(f"COLMAP took more than {time_limit:g} s") from None
                    _tell(directory, on_stage)
        finally:
            process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
    if status != 0:
        lines = (directory / "log.txt").read_text(errors="replace").strip().splitlines()
        last = [line for line in lines if not line.startswith((" ", "***"))][-1:]  # not of its stack trace
        raise ValueError(f"COLMAP ended with status {status} {' '.join(last)}".strip())


def _tell(directory: Path, on_stage: OnStage) -> None:
    """Not by COLMAP's database: two libraries of SQLite take each other's locks away."""
    try:
        now: dict[str, Any] = json.loads((directory / "stage.json").read_text(encoding="utf-8"))
    except FileNotFoundError:  # it has only begun
        return
    done, total = now["done"], now["total"]
    text = (directory / "log.txt").read_bytes()[now["log"] :].decode(errors="replace")
    if now["stage"] == "matches" and (blocks := _BLOCK.findall(text)):
        row, rows, column, columns = (int(part or 1) for part in blocks[-1])
        done = round(total * ((row - 1) * columns + column - 1) / (rows * columns))
    elif now["stage"] in ("features", "smoothed"):
        done = text.count("Processed file [")
    on_stage(Stage(STAGES[now["stage"]], done, total))


def _read(folder: Path, called: Mapping[str, str]) -> Model:
    return Model(pycolmap.Reconstruction(folder), _outcome(folder / "facts.json"), called)


def _outcome(facts: Path) -> Outcome:
    return Outcome(**json.loads(facts.read_text(encoding="utf-8")))


def key_of(what: str, pieces: Iterable[bytes]) -> str:
    """A name for what is made of the pieces: another for each FORMAT, but not for each version of COLMAP."""
    digest = hashlib.sha256(f"{FORMAT} {what}".encode())
    for piece in pieces:
        digest.update(piece)
    return digest.hexdigest()[:16]


def _pieces(names: Sequence[str], contents: Iterable[bytes], given: dict[str, Any]) -> Iterator[bytes]:
    """Everything that the model depends on; where the photos lie is not part of it."""
    for name, content in zip(names, contents, strict=True):
        yield f"{name} {len(content)} ".encode() + content
    for part in ("sizes", "Ks", "focals", "camera_of", "rotations"):
        if part in given:
            yield given[part].tobytes()
