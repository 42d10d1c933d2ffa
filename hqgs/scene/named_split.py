"""Splits that a scene's files name: which photos are trained on, and which are held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from hqgs.base.files import read_json
from hqgs.base.text import some

TRAIN, TEST, VAL = "train", "test", "val"
LISTS = ("train_test_lists.json", "train_test_split.json", "split.json", "splits.json")
_OTHER_NAMES = {"train": TRAIN, "test": TEST, "val": VAL, "valid": VAL, "validation": VAL, "eval": VAL}


@dataclass(frozen=True)
class Split:
    """Names of photos as a file lists them; None: it has no such list."""

    source: str  # the file, for people
    train: Sequence[str] | None = None
    test: Sequence[str] | None = None
    val: Sequence[str] | None = None

    def names_any(self, known: Mapping[str, str]) -> bool:
        """Whether a list has a photo; `known`: names of photos by what files call them."""
        listed = [*(self.train or []), *(self.test or []), *(self.val or [])]
        return any(_photo(name, known) is not None for name in listed)


def listed_split(folders: Sequence[Path], root: Path) -> Split | None:
    """The split that a file beside a COLMAP model names, in the first folder that has one; else None.

    `test.txt` and `train.txt`, a name on each line, or a JSON file of LISTS with such lists. ValueError
    where it is damaged.
    """
    for folder in dict.fromkeys(folders):
        for name in LISTS:
            meta = read_json(path) if (path := folder / name).is_file() else None
            if isinstance(meta, dict) and (split := lists_in(meta, path.relative_to(root).as_posix())):
                return split
        found = {key: folder / f"{key}.txt" for key in (TRAIN, TEST, VAL)}
        lists = {key: _lines(path) for key, path in found.items() if path.is_file()}
        if TEST in lists or VAL in lists:
            files = " and ".join(found[key].relative_to(root).as_posix() for key in lists)
            return Split(files, **lists)
    return None


def lists_in(meta: Mapping[str, Any], source: str, ending: str = "") -> Split | None:
    """The lists of names in an object, under `train`, `test` and `val` with this ending; None without."""
    lists: dict[str, list[str]] = {}
    for key, kind in _OTHER_NAMES.items():
        names = meta.get(key + ending)
        if names is None:
            continue
        if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise ValueError(f"{source}: {key + ending} must be a list of names, got {names!r:.80}")
        lists[kind] = [*lists.get(kind, []), *names]
    return Split(source, **lists) if lists else None


def held_out(
    split: Split, names: Sequence[str], known: Mapping[str, str], notes: list[str]
) -> tuple[frozenset[str], frozenset[str]]:
    """The photos to train on and those to hold out, of `names`; `notes` hears the rule.

    Held out are those of `test`, or of `val` where there is no `test`, or else what is not in `train`. What
    is in no list that counts is left out. `known`: names of photos by what files call them.

    Raises ValueError where the lists leave no photo to train on, or one is in both.
    """

    def of(listed: Sequence[str] | None) -> set[str]:
        return {found for name in listed or [] if (found := _photo(name, known)) is not None}

    train, test, val = of(split.train), of(split.test), of(split.val)
    kind = TEST if split.test else VAL if split.val else TRAIN
    held = test if kind == TEST else val if kind == VAL else set(names) - train
    chosen = train if split.train else set(names) - held - val
    if both := sorted(chosen & held):
        raise ValueError(f"{split.source}: photos are in both lists, training and held out: {some(both)}")
    if not chosen:
        raise ValueError(f"{split.source} names none of the photos to train on")
    if not held and kind != TRAIN:
        raise ValueError(f"{split.source} names none of the photos to hold out")
    rest = sorted(set(names) - chosen - held)
    rule = f"split by {split.source}: {len(chosen)} photos to train on, {len(held)} held out"
    notes.append(f"{rule}; test_every is not used")
    if rest:
        notes.append(f"{len(rest)} photos are in no list of {split.source} and are not used: {some(rest)}")
    listed = [*(split.train or []), *(split.test or []), *(split.val or [])]
    if missing := [name for name in listed if _photo(name, known) is None]:
        notes.append(f"{len(missing)} names in {split.source} match no photo: {some(missing)}")
    return frozenset(chosen), frozenset(held)


def _photo(name: str, known: Mapping[str, str]) -> str | None:
    """The photo that a list calls so; None: there is none."""
    plain = unquote(name).replace("\\", "/").strip()
    folder, _, last = plain.rpartition("/")
    for option in (name, plain, last, last.rsplit(".", 1)[0]):
        if (found := known.get(option)) is not None:
            other = found.rpartition("/")[0]
            if option in (name, plain) or not (folder and other) or _last(folder) == _last(other):
                return found
    return None


def _last(folder: str) -> str:
    return folder.rsplit("/", 1)[-1]


def names_by_any(names: Sequence[str]) -> dict[str, str]:
    """Photos by their names, with or without suffix and folders, where that is only one."""
    known: dict[str, str] = {}
    doubtful = set[str]()
    for name in names:
        last = name.rsplit("/", 1)[-1]
        for other in dict.fromkeys((name.rsplit(".", 1)[0], last, last.rsplit(".", 1)[0])):
            doubtful |= {other} if known.setdefault(other, name) != name else set()
    return {k: v for k, v in known.items() if k not in doubtful} | {name: name for name in names}


def _lines(path: Path) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a list of names: {error}") from error
    return [line.strip().replace("\\", "/") for line in text.splitlines() if line.strip()]
