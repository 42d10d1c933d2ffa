"""What scene files hold by their first bytes, whatever their suffix says."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

from hqgs.model.formats.spz_container import GZIP, MAGIC
from hqgs.photos.files import DECODE_ERRORS

_HEAD = 512  # bytes
_SPZ = MAGIC.to_bytes(4, "little")
_PAGES = (b"<!doctype", b"<html", b"<?xml")


def format_held(path: Path) -> str | None:
    """The format of a file; None: its first bytes tell none, as those of .splat.

    ValueError for what people have in place of a scene file: nothing, a web page, a pointer, a packed file.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if not head:
        raise ValueError(f"{path}: not a scene file, but empty: its download did not succeed")
    if head.startswith(b"version https://git-lfs"):
        raise ValueError(
            f"{path}: not a scene file, but a pointer of Git LFS: `git lfs pull` fetches the file"
        )
    if head.lstrip().lower().startswith(_PAGES):
        raise ValueError(f"{path}: not a scene file, but a web page: download the file itself")
    if head.startswith((b"ply\n", b"ply\r")):
        return "ply"
    if head.startswith(b"glTF"):
        return "glb"
    if head.startswith(_SPZ):
        return "spz"
    if head.startswith(b"\x1f\x8b"):
        return _of_gzip(path, head)
    return _of_zip(path) if head.startswith(b"PK\3\4") and zipfile.is_zipfile(path) else None


def _of_gzip(path: Path, head: bytes) -> str | None:
    try:
        inner = zlib.decompressobj(GZIP).decompress(head, 4)
    except zlib.error:
        return None
    if inner.startswith(b"ply"):
        raise ValueError(f"{path}: not a scene file, but one packed by gzip: unpack it")
    return "spz" if inner == _SPZ else None


def _of_zip(path: Path) -> str | None:
    try:
        with zipfile.ZipFile(path) as packed:
            names = [Path(name).name for name in packed.namelist()]
    except (*DECODE_ERRORS, zipfile.BadZipFile, RuntimeError):  # damaged; the last of a version to come
        return None
    if "data.pkl" in names:
        raise ValueError(f"{path}: not a scene file, but a checkpoint of PyTorch: export the scene as .ply")
    if "meta.json" not in names:
        raise ValueError(f"{path}: not a scene file, but an archive: unpack it")
    return "sog"
