"""Writing files so that a reader sees the old one or the new one, never half of one."""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from hqgs.base.text import as_text

LOCK = ".lock"
SAFETENSORS_TMP = ".tmp??????"  # a file of such a name is what safetensors writes before it renames it
CHECKPOINT, PLY, CONFIG, PAGE = "checkpoint.safetensors", "scene.ply", "config.json", "report.html"
REPORT, PICTURES = "report.json", "comparison"
CAMERAS, PHOTOS = "cameras.json", "photos"
_LACKING = {errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL, errno.EPERM}
PLAN = "plan.json"  # what a number of seconds came to
RUN_FILES = (PLY, PAGE, REPORT, CAMERAS, PLAN, CONFIG, CHECKPOINT)  # what a run writes,
RUN_FOLDERS = (PHOTOS, PICTURES)  # and where its pictures are


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success flush it to disk and rename it over `path`.

    On any exception (disk full and Ctrl-C included) the temporary file is removed and `path` is untouched.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    fd, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    os.close(fd)
    tmp = Path(name)
    try:
        yield tmp
        _flush(tmp)
        umask = os.umask(0)
        os.umask(umask)
        with _where_there_is(f"permissions of files, in {path.parent}"):
            tmp.chmod(0o666 & ~umask)  # mkstemp makes it private; give it the usual permissions
        tmp.replace(path)
    finally:
        tmp.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    with path.open("rb+") as file, _where_there_is(f"flushing of files to disk, in {path.parent}"):
        os.fsync(file.fileno())


@contextmanager
def _where_there_is(what: str) -> Iterator[None]:
    """Go on where a file system (of a network, a phone, a container) does not have what is asked of it."""
    try:
        yield
    except OSError as error:
        if error.errno not in _LACKING:
            raise
        _say_once(f"the file system has no {what} ({error.strerror}): hqgs continues without")


@lru_cache
def _say_once(text: str) -> None:
    logging.getLogger("hqgs").warning("%s", as_text(text))


def check_new_folder(out: Path) -> None:
    """FileExistsError unless `out` is missing or an empty folder."""
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise FileExistsError(f"{out} exists and is not an empty folder")


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Yield a folder that is moved to `out`, a resolved path, at the end; after an error it is gone, and the
    folders above it that were made for it."""
    check_new_folder(out)
    made = missing_folders(out.parent)
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as name:
            folder = Path(name) / out.name  # with the usual permissions; those around it are private
            folder.mkdir()
            yield folder.resolve()
            folder.replace(out)
    finally:
        remove_empty(made)


def keep_folder(source: Path, target: Path) -> None:
    """Copy a folder of files, flushed to disk, under a name that it gets when it is complete.

    A `target` that is there by then stays.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".") as name:
        copy = Path(name) / target.name
        shutil.copytree(source, copy)
        for file in copy.iterdir():
            _flush(file)
        if not target.exists():
            copy.rename(target)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` (UTF-8) atomically; what of a name on disk is none is escaped, as `as_text` does."""
    with atomic_path(path) as tmp:
        tmp.write_text(as_text(text), encoding="utf-8")


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as indented JSON atomically; NaN and Inf are refused (JSON has no such numbers)."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_json(path: str | Path) -> Any:
    """The value of a JSON file: UTF-8, with or without a byte order mark, or UTF-16, which PowerShell writes.

    ValueError, which names the file, where it is damaged.
    """
    try:
        return json.loads(Path(path).read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from error


class FolderBusyError(RuntimeError):
    """Another run writes into the same folder."""


@contextmanager
def lock_folder(folder: str | Path) -> Iterator[None]:
    """Hold the folder (made if it is missing) for one run; FolderBusyError if another run holds it.

    The system frees the lock when its process ends, however it ends, so a lock never outlives its run.
    """
    from filelock import FileLock, Timeout  # here: it takes as long as all that answers --help

    folder = Path(folder)
    made = missing_folders(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise FileExistsError(
            f"{folder} is a file, not a folder: choose another folder for the run"
        ) from None
    except PermissionError as error:
        raise PermissionError(
            f"no permission to write into {error.filename}: choose another folder"
        ) from None
    lock = FileLock(folder / LOCK)
    try:
        with _where_there_is(f"file locks in {folder}: do not let another run write there"):
            lock.acquire(timeout=0)
    except Timeout:
        raise FolderBusyError(f"another run is writing into {folder}") from None
    except PermissionError:
        raise PermissionError(f"no permission to write into {folder}: choose another folder") from None
    try:
        yield
    finally:
        lock.release()
        remove_empty(made)


def missing_folders(folder: Path) -> list[Path]:
    """Those that making `folder` makes, itself first."""
    return [path for path in (folder, *folder.parents) if not path.exists()]


def remove_empty(made: list[Path]) -> None:
    """Remove the folders of a failed start, the innermost first; what holds more than a lock stays."""
    for path in made:
        with suppress(OSError):
            if {entry.name for entry in path.iterdir()} <= {LOCK}:
                (path / LOCK).unlink(missing_ok=True)
                path.rmdir()


def remove_leftovers(path: str | Path) -> None:
    """Delete the temporary files that a killed run left beside this one. Call it under the lock."""
    path = Path(path)
    for pattern in (f".{path.stem}.*{path.suffix}", SAFETENSORS_TMP):
        for leftover in path.parent.glob(pattern):
            leftover.unlink()
