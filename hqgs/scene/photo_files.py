"""Photos under the names that a file of another machine gives them.

Files name photos as the machine that wrote them did: with backslashes, with a drive or a home that is not
here, with escapes of a URL, in another case or Unicode form, with the suffix of the originals. What is opened
lies in the scene's folder all the same: such names are looked up in a list of it, never followed out of it.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cached_property, partial
from itertools import chain
from pathlib import Path, PurePosixPath
from unicodedata import normalize
from urllib.parse import unquote

from hqgs.base.files import CHECKPOINT, CONFIG, LOCK, PLY, RUN_FILES, RUN_FOLDERS
from hqgs.base.text import as_text, some
from hqgs.photos.suffixes import PHOTO_SUFFIXES
from hqgs.scene.names import FILM_SUFFIXES, KEPT

MASKS = "masks"
_NO_PHOTOS = re.compile(
    r"(depths?|confidence|normals?|masks?|segmentations?|semantics?|labels|thumb(nail)?s)([_-]?(maps?|images?))?",
    re.IGNORECASE,
)
_MARK = r"(?:(?:sam\d?[._ -])?masks?|mattes?|alphas?|msks?)"  # by other programs: SAM, mattes of films
_MARKED = re.compile(rf"^({_MARK}[._ -])(.+)$|^(.+?)([._ -]{_MARK})$", re.IGNORECASE)  # of a mask's stem
_OF_MASKS = re.compile(r"((images?|photos?|frames?|sam\d?)[_ -])?(masks?|mattes?|alphas?)", re.IGNORECASE)
Key = tuple[str, ...]


def is_run(folder: Path) -> bool:
    """Whether a folder is one that `hqgs train` writes or wrote: its pictures are no photos."""
    inside = partial(os.path.join, folder)  # os.path: no error where they cannot be looked at
    wrote = os.path.isfile(inside(CONFIG)) and any(os.path.exists(inside(name)) for name in (PLY, CHECKPOINT))
    return wrote or os.path.isfile(inside(LOCK))


def can_be_listed(folder: Path) -> bool:
    """Not a card's lost+found, nor what a shared disk lets nobody list."""
    return os.access(folder, os.R_OK | os.X_OK)


def of_maps(folder: str) -> bool:
    """Whether a folder is called after depth maps, masks or thumbnails, which have the names of photos."""
    return _NO_PHOTOS.fullmatch(folder) is not None


def masks_among(names: Iterable[str]) -> set[str]:
    """Those of relative paths that are masks of others, by their names or a folder of masks.

    Of photos that are gone too, where more masks than those are marked so.
    """
    names = [*names]
    photos = {key for name in names for key in photo_keys(name)}
    masks = {name for name in names if photos & ({*mask_keys(name)} - {*photo_keys(name)})}
    marks = {name: _MARKED.sub(r"\1*\4", PurePosixPath(name).stem) for name in names}
    own, others = Counter(marks[name] for name in masks), Counter(marks[n] for n in names if n not in masks)
    return masks | {n for n in names if own[marks[n]] > others[marks[n]] and "*" in marks[n]}


def is_mask_folder(name: str) -> bool:
    """Whether a folder is called `masks`, `mask`, `image_masks` or `mattes`, however that is spelt."""
    return _OF_MASKS.fullmatch(name) is not None


def photo_keys(name: str) -> list[Key]:
    """Folders and name of a photo, with and without its suffix."""
    path = PurePosixPath(name.casefold())
    return [(*path.parent.parts, path.name), (*path.parent.parts, path.stem)]


def mask_keys(name: str) -> list[Key]:
    """The same of the photos that a file may be the mask of; none where it is no mask."""
    path = PurePosixPath(name.casefold())
    folders = tuple(part for part in path.parent.parts if not is_mask_folder(part))
    marked = _MARKED.fullmatch(path.stem)
    stems = [] if marked is None else [marked[2] or marked[3]]
    if len(folders) < len(path.parent.parts):
        stems += [path.name, path.stem]
    bare = [stem.rpartition(".")[0] for stem in stems if PurePosixPath(stem).suffix in PHOTO_SUFFIXES]
    return [(*folders, stem) for stem in dict.fromkeys([*stems, *bare])]


def strangers(out: Path) -> list[str]:
    """What lies in the folder of a new run, sorted; nothing where a run, or its COLMAP, began there before.

    FileExistsError where the run would write over some of it.
    """
    if not out.is_dir() or is_run(out) or (out / KEPT).exists():
        return []
    names = sorted(path.name for path in out.iterdir() if path.name[0] != ".")
    held = {name for name in RUN_FOLDERS if name in names and any((out / name).iterdir())}
    taken = [name for name in names if name in RUN_FILES or name in held]
    if taken:
        raise FileExistsError(
            f"{out} holds {some(taken)}, not of a run, which a run would overwrite: name another folder"
        )
    return names


def below(folder: Path, suffixes: Iterable[str]) -> list[Path]:
    """Files below a folder that end so, sorted; nothing hidden, and nothing of a run.

    Folders that are links count where they lead out of it, once each: not to one above, nor to one seen.
    """
    found, wanted, seen, waiting = list[Path](), tuple(suffixes), set[str](), [folder]
    home = os.path.join(os.path.realpath(folder), "")
    while waiting:
        links = list[Path]()
        for place, folders, files in chain.from_iterable(map(os.walk, sorted(waiting))):
            real = os.path.realpath(place)
            if real in seen or (seen and home.startswith(os.path.join(real, ""))):
                folders.clear()
                continue
            seen.add(real)
            inner = (name for name in folders if name[0] != "." and name != KEPT)
            folders[:] = [name for name in inner if not is_run(Path(place, name))]
            links += [path for name in folders if (path := Path(place, name)).is_symlink()]
            found += [
                path
                for name in files
                if name[0] != "." and name.lower().endswith(wanted) and (path := Path(place, name)).is_file()
            ]
        waiting = links
    return sorted(found)


def film_at(path: str | Path) -> Path | None:
    """The film that a path names: its file, by its suffix, or a folder with that one film and no photo."""
    path = Path(path).expanduser()
    if path.is_file():
        return path if path.name.lower().endswith(FILM_SUFFIXES) else None
    if not path.is_dir() or is_run(path) or below(path, PHOTO_SUFFIXES):
        return None
    films = below(path, FILM_SUFFIXES)
    return films[0] if len(films) == 1 else None


class Named:
    """The files below a folder, to be found by what other machines call them."""

    def __init__(self, root: Path, suffixes: Iterable[str] = PHOTO_SUFFIXES) -> None:
        self._root, self._suffixes = root, tuple(suffixes)
        self.by_name: dict[str, Path] = {}  # what was found elsewhere than its name says

    @cached_property
    def _files(self) -> dict[str, list[tuple[Key, Path]]]:
        files: dict[str, list[tuple[Key, Path]]] = {}
        for path in below(self._root, self._suffixes):
            key = _parts(path.relative_to(self._root).as_posix())
            files.setdefault(without_suffix(key[-1], self._suffixes), []).append((key, path))
        return files

    @cached_property
    def _stems(self) -> dict[str, list[Path]]:
        stems: dict[str, list[Path]] = {}
        for path in below(self._root, self._suffixes):
            name = path.relative_to(self._root).as_posix()
            for called in {name, as_text(name), of_windows(name)}:
                stems.setdefault(without_suffix(called, self._suffixes), []).append(path)
        return stems

    def up_to_suffix(self, written: str) -> Path | None:
        """The one file there with another suffix, or with one; None: none, or several."""
        plain = os.path.normpath(written.replace("\\", "/"))
        alike = self._stems.get(without_suffix(plain, self._suffixes)) or self._stems.get(plain, [])
        return alike[0] if len(alike) == 1 else None

    def find(self, written: str, taken: Callable[[Path], bool] = lambda _: False) -> Path | None:
        """The one file that the name can mean and that is not taken; None where there is none, or several.

        The more of the written folders a file's own agree with, from the last one up, the better it fits;
        of those that fit alike the name with the same suffix is taken, and the one in `images`. A map or mask
        is meant only by a name with its folder: it has that of its photo, which may be gone.
        """
        for name in dict.fromkeys((written, unquote(written))):
            key = _parts(name)
            if not key:
                continue
            fitting = [
                (_fit(key, own), own, path)
                for stem in dict.fromkeys((without_suffix(key[-1], self._suffixes), key[-1]))
                for own, path in self._files.get(stem, [])
                if not taken(path) and not any(map(of_maps, own[: len(own) - 1 - _fit(key, own)[0]]))
            ]
            if not fitting:
                continue
            best = max(fit for fit, _, _ in fitting)
            paths = dict.fromkeys(path for fit, _, path in fitting if fit == best)
            if len(paths) > 1:
                exact = [path for path in paths if path.name == _posix(name).rsplit("/", 1)[-1]]
                inside = [path for path in paths if path.parent == self._root / "images"]
                paths = dict.fromkeys(exact if len(exact) == 1 else inside)
            if len(paths) == 1:
                found = next(iter(paths))
                self.by_name[written] = found
                return found
        return None

    def note(self, what: str = "photos") -> list[str]:
        """That some were found by name, in words; nothing where none was."""
        if not self.by_name:
            return []
        pairs = [
            f"{file.relative_to(self._root).as_posix()} for {name}" for name, file in self.by_name.items()
        ]
        return [f"{len(pairs)} {what} were found by name, not at the given paths: {some(pairs)}"]


def _posix(name: str) -> str:
    return name.removeprefix("file://").replace("\\", "/")


def _parts(name: str) -> Key:
    plain = normalize("NFC", _posix(name)).casefold()
    return tuple(part.strip() for part in plain.split("/") if part not in ("", ".", ".."))


def without_suffix(name: str, suffixes: tuple[str, ...]) -> str:
    """A name without a suffix of those that count."""
    return next((name[: -len(s)] for s in suffixes if name.lower().endswith(s) and len(name) > len(s)), name)


def of_windows(name: str) -> str:
    """A name as text: what is no UTF-8 was written by an older Windows, or is escaped."""
    raw = name.encode("utf-8", "surrogateescape")
    for code in ("utf-8", "cp1252"):
        with suppress(UnicodeDecodeError):
            return raw.decode(code)
    return as_text(name)


def _fit(wanted: Key, own: Key) -> tuple[int, bool]:
    """How many folders agree, from the last one up, and whether the suffix does."""
    folders = 0
    for a, b in zip(reversed(wanted[:-1]), reversed(own[:-1]), strict=False):
        if a != b:
            break
        folders += 1
    return folders, wanted[-1] == own[-1]
