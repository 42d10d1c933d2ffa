"""COLMAP models as other programs write them, in the form that COLMAP reads."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from hqgs.base.text import some

NEEDED, POINTS = ("cameras", "images"), "points3D"
_RIGGED = ("frames", "rigs")  # from COLMAP 3.12 on, of no use without each other
HEAD = 9  # id, rotation, translation and camera of a photo in images.txt, before its name
_COMMA = re.compile(rb"(?<!\S)(-?\d+),(\d+(?:[eE][-+]?\d+)?)(?!\S)")  # a number as some languages write it
_BOM = b"\xef\xbb\xbf"  # that Windows puts before a text


def kind_of(folder: Path) -> str:
    """ "bin", "txt" or "" (no model), of a folder. A whole model comes first, then COLMAP's own choice.

    A model without its points is one: some programs write those as PLY, or none.
    """
    for names in ((*NEEDED, POINTS), NEEDED):
        for kind in ("bin", "txt"):
            if all((folder / f"{name}.{kind}").is_file() for name in names):
                return kind
    return ""


@contextmanager
def mended(folder: Path, notes: list[str]) -> Iterator[Path]:
    """The folder of a model, or of a copy of it that COLMAP reads as it was meant.

    Texts lose byte order marks, numbers their decimal commas. In images.txt COLMAP takes every other line for
    a photo: where the lines that list what photos show are missing, it would lose half of them without a
    word. Photos without a pose (nan) are left out, and missing points are none; `notes` tells what was done.
    """
    kind = kind_of(folder)
    texts = {path.name: path.read_bytes() for path in folder.glob("*.txt")} if kind == "txt" else {}
    plain = {name: text.removeprefix(_BOM) for name, text in texts.items()}
    if kind == "txt":
        if _COMMA.search(plain["cameras.txt"]):
            plain = {name: _COMMA.sub(rb"\1.\2", text) for name, text in plain.items()}
            notes.append("the model's numbers have decimal commas, which were read as decimal points")
        plain["images.txt"] = _photo_lines(plain["images.txt"], notes)
    points = f"{POINTS}.{kind}"
    bare = not (folder / points).is_file()
    pair = {f"{name}.{kind}" for name in _RIGGED}
    lone = {name for name in pair if (folder / name).is_file()}
    if len(lone) == 1:
        notes.append(
            f"the model has {some([*lone])} but no {some([*(pair - lone)])}: the photos' own poses are used"
        )
    elif plain == texts and not bare:
        yield folder
        return
    with TemporaryDirectory(prefix="hqgs-colmap-") as name:
        copy = Path(name)
        if kind == "txt":
            for file, text in plain.items():
                (copy / file).write_bytes(text)
        else:
            for path in folder.glob("*.bin"):
                shutil.copyfile(path, copy / path.name)
        if len(lone) == 1:
            (copy / lone.pop()).unlink()
        if bare:
            (copy / points).write_bytes(bytes(8) if kind == "bin" else b"")
        try:
            yield copy
        except ValueError as error:
            raise ValueError(str(error).replace(str(copy), str(folder))) from error


def whole_names(path: Path) -> dict[int, str]:
    """The photos' names in an images.txt by their ids, as far as the line goes: with their spaces."""
    words = (line.strip().split(None, HEAD) for line in _decoded(path.read_bytes()) if _is_photo(line))
    return {int(found[0]): found[HEAD] for found in words}


def _decoded(text: bytes) -> list[str]:
    return text.decode("utf-8", "surrogateescape").split("\n")


def _is_photo(line: str) -> bool:
    """Whether a line of images.txt tells of a photo; one that lists points has triples of numbers."""
    words = line.strip().split(None, HEAD)
    if len(words) <= HEAD or not words[0].isdigit():
        return False
    return len(line.split()) % 3 != 0 or not all(map(_is_number, words[HEAD].split()))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _photo_lines(text: bytes, notes: list[str]) -> bytes:
    """images.txt with a line of points after each photo's; the same where nothing had to be changed."""
    lines, lost, whole = list[str](), list[str](), True
    found = _decoded(text)
    for k, line in enumerate(found):
        if not _is_photo(line):
            continue
        shown = found[k + 1] if k + 1 < len(found) else ""
        if _is_photo(shown) or shown.startswith("#") or (not shown and k + 2 >= len(found)):
            whole, shown = False, ""
        words = line.strip().split(None, HEAD)
        if all(_is_number(word) and math.isfinite(float(word)) for word in words[1 : HEAD - 1]):
            lines += [line, shown]
        elif all(map(_is_number, words[1 : HEAD - 1])):
            lost.append(words[HEAD])
        else:
            return text  # COLMAP says what is wrong with it
    if lost:
        notes.append(f"{len(lost)} photos of the model have no pose (nan) and were left out: {some(lost)}")
    if whole and not lost:
        return text
    return "\n".join([*lines, ""]).encode("utf-8", "surrogateescape")
