"""What people's folders hold beside the photos of one scene: copies, screenshots, films, bursts."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from datetime import timedelta
from hashlib import sha256
from pathlib import Path

import numpy as np
from PIL import Image

from hqgs.base.text import some
from hqgs.photos.exif import Exif
from hqgs.photos.files import Glance, UnreadableError, decode, open_photo
from hqgs.photos.pixels import grey
from hqgs.scene.names import FILM_SUFFIXES
from hqgs.scene.photo_files import of_maps

_BURST = re.compile(r"(.*?)BURST(\d{8,})?", re.IGNORECASE)  # with the time of a burst, or its photos' numbers
_CAMERAS = {  # files of other programs, by what they are called
    "Metashape": re.compile(r"^(cameras?|doc|agisoft.*|metashape.*)\.xml$|\.psx$", re.IGNORECASE),
    "RealityCapture": re.compile(
        r"\.rcproj$|^(cameras?|registration|internal_?external).*\.csv$", re.IGNORECASE
    ),
    "Bundler": re.compile(r"^bundler?.*\.out$", re.IGNORECASE),
    "VisualSFM": re.compile(r"\.nvm$", re.IGNORECASE),
    "OpenMVG or Meshroom": re.compile(r"^(sfm(_data.*)?\.(json|bin)|cameras\.sfm|.*\.mg)$", re.IGNORECASE),
    "OpenSfM": re.compile(r"^(opensfm|reconstruction\.(json|meshed\.json))$"),
    "Polycam": re.compile(r"^(corrected_)?cameras$|^mesh_info\.json$"),
    "nerfstudio's are called transforms.json": re.compile(r"^transforms\b.*\.json$", re.IGNORECASE),
    "3DGS": re.compile(r"^cameras\.json$"),
    "poses": re.compile(
        r"^(poses?|trajectory|traj|groundtruth|camera_poses)\.(txt|csv|json|log|np[yz])$"
        r"|(\.pose|_cam)\.txt$|^cameras\.np[yz]$|^(poses?|cams)$",
        re.IGNORECASE,
    ),
}
_NOT_HERE = (".icloud", ".crdownload", ".part", ".partial", ".download")
_ALIKE = 4  # of 255, in every cell: what a JPEG read at an eighth of its sides may differ by
_VERSIONS, _SIDE = 0.98, 32  # correlation of versions of one photo, at so many px
_VERSION = re.compile(
    r"(?<=IMG_)E(?=\d{4})|[ _-]*(\(\d+\)|copy|kopie|small|resized|thumb|edited|edit|bearbeitet|\d+x\d+)$",
    re.IGNORECASE,
)
_NUMBERED = re.compile(r"\(\d+\)$")
_OF_ONE_CAMERA = 2 / 3  # of the photos, at least: others are strays then
_LEAST = 3  # photos of that camera
_PAUSE, _SCENES, _NEARLY = timedelta(hours=1), 4, 0.9  # between captures; of them; of the photos in one
_WORDS = re.compile(r"[\W\d_]+")
_SCREEN = re.compile(r"screen.?shot|bildschirmfoto|capture d.{1,2}cran|captura de pantalla", re.IGNORECASE)
_DRAWN = ("PNG", "WEBP", "GIF", "BMP")  # what screens are stored as


def copies(folder: Path, looked: dict[str, Glance], exif: dict[str, Exif]) -> dict[str, str]:
    """Photos that hold the same pixels as another, and which other one is used in their place.

    That is the largest, with EXIF data, highest up, with the shortest name: IMG_1.jpg, not "IMG_1 (1).jpg".
    Only files that a glance could not tell apart are decoded. Versions of a photo by their names (in another
    format, edited, smaller) are copies too, where they look alike.
    """
    by_size: dict[tuple[int, int], list[str]] = {}
    for name, seen in looked.items():
        by_size.setdefault(seen.size, []).append(name)
    alike: dict[bytes, list[str]] = {}
    for names in by_size.values():
        small = np.stack([looked[name].small.ravel().astype(np.int16) for name in names])
        for name, row in zip(names, small, strict=True):
            if (np.abs(small - row).max(1) <= _ALIKE).sum() > 1:
                alike.setdefault(_digest(folder / name), []).append(name)
    versions: dict[str, list[str]] = {}
    stems = {name: name.rpartition(".")[0] for name in looked}
    for name, stem in stems.items():
        folder_of, slash, file = stem.rpartition("/")
        versions.setdefault(f"{folder_of}{slash}{_VERSION.sub('', file)}", []).append(name)
    for key, names in versions.items():
        numbered = [name for name in names if _NUMBERED.search(stems[name])]
        if len(numbered) > 1 or key not in {stems[name] for name in names}:  # a series: vase (1), vase (2)
            versions[key] = [name for name in names if name not in numbered]
    sets = [*alike.values(), *(names for names in versions.values() if _look_alike(folder, names))]
    found: dict[str, str] = {}
    for names in sets:
        largest = {n: -looked[n].size[0] * looked[n].size[1] for n in names}
        best = min(names, key=lambda n: (largest[n], not exif[n].camera, n.count("/"), len(n), n))
        found |= {name: best for name in names if name != best}
    return dict(sorted(found.items()))


def _look_alike(folder: Path, names: list[str]) -> bool:
    """Whether pictures of several files are one but for size, format and brightness."""
    small, shapes = list[np.ndarray](), list[float]()
    for name in names if len(names) > 1 else ():
        with open_photo(folder / name) as photo:
            shapes.append(photo.width / photo.height)
            photo.draft("L", (4 * _SIDE, 4 * _SIDE))
            tiny = grey(photo).resize((_SIDE, _SIDE), Image.Resampling.BOX)
        small.append(np.asarray(tiny, float).ravel())
    if not small or min(map(np.ptp, small)) < _ALIKE or max(shapes) > 1.02 * min(shapes):
        return False
    return float(np.corrcoef(small).min()) > _VERSIONS


def _digest(path: Path) -> bytes:
    """Of the pixels and the mask of a photo; of its bytes where its pixels are of a kind that is not read."""
    try:
        pixels, mask = decode(path)
    except UnreadableError:
        return sha256(path.read_bytes()).digest()
    whole = sha256(repr(pixels.shape).encode())
    whole.update(pixels.tobytes())
    whole.update(b"" if mask is None else mask.tobytes())
    return whole.digest()


def strays(looked: dict[str, Glance], exif: dict[str, Exif]) -> dict[str, str]:
    """Pictures among the photos of one camera that it did not take, by name, and what they look like.

    They say nothing of a camera, and have a size that none of its photos has, upright or turned. Where no
    photo says anything, those that are called screenshots count.
    """
    own = [name for name, tags in exif.items() if any(tags.camera[:2])] or [
        name for name in looked if not _SCREEN.search(name)
    ]
    enough = len(own) >= max(_LEAST, _OF_ONE_CAMERA * len(looked))
    if not enough or len({exif[name].camera[:2] for name in own}) > 1:
        return {}
    sizes = {tuple(sorted(looked[name].size)) for name in own}
    return {
        name: f"a {'screenshot' if seen.format in _DRAWN else 'picture from elsewhere'} "
        f"({seen.format} of {seen.size[0]} x {seen.size[1]} px, no camera in EXIF)"
        for name, seen in looked.items()
        if not exif[name].camera and tuple(sorted(seen.size)) not in sizes
    }


def tell_strays(strays: dict[str, str], placed: set[str]) -> list[str]:
    """What became of them, in sentences."""
    return [
        f"{name} looks like {what}: "
        + ("it fits among the photos all the same, and is used" if name in placed else "it was left out")
        for name, what in strays.items()
    ]


def understood(exif: Sequence[Exif], names: Sequence[str], left_out: int, around: bool) -> str:
    """One line: how many photos of how many cameras, and what else their names and EXIF data tell."""
    cameras = {tags.camera[:2] for tags in exif if any(tags.camera[:2])}
    known = sum(any(tags.camera[:2]) for tags in exif)
    text = _count(len(names), "panorama" if around else "photo") + (" of 360 x 180 degrees" if around else "")
    if known == len(names):
        text += f" of {_count(len(cameras), 'camera')}"
    else:
        text += f", {known} of them of {_count(len(cameras), 'camera')}" if known else ", no camera in EXIF"
    if left_out:
        text += f", {_count(left_out, 'duplicate')} left out"
    if located := sum(tags.gps is not None for tags in exif):
        text += f", GPS in {located}"
    bursts = _bursts(exif, names)
    if bursts:
        text += f", {len(bursts)} in {_count(len(set(bursts)), 'burst')}"
    return text


def _bursts(exif: Sequence[Exif], names: Sequence[str]) -> list[object]:
    """Of each photo of a burst, which: by its name, else by camera and second, if _LEAST have those."""
    seconds = Counter((tags.camera, tags.taken) for tags in exif)
    found = list[object]()
    for tags, name in zip(exif, names, strict=True):
        if (match := _BURST.match(name)) is not None:
            found.append(match.group(2) or match.group(1))
        elif tags.taken is not None and seconds[tags.camera, tags.taken] >= _LEAST:
            found.append((tags.camera, tags.taken))
    return found


def maybe_two(exif: Sequence[Exif], names: Sequence[str]) -> list[str]:
    """That the photos may be of several scenes, in a sentence, by their times, folders or names; or nothing.

    Of each group _LEAST photos and more are wanted, and of all photos nearly all in groups.
    """
    times = sorted((tags.taken, name) for tags, name in zip(exif, names, strict=True) if tags.taken)
    sittings = list[list[str]]()
    for k, (taken, name) in enumerate(times):
        if not k or taken - times[k - 1][0] > _PAUSE:
            sittings.append([])
        sittings[-1].append(name)
    by_folder, by_name = dict[str, list[str]](), dict[str, list[str]]()
    for name in names:
        by_folder.setdefault(name.rpartition("/")[0], []).append(name)
        by_name.setdefault(_WORDS.sub("", name.rpartition("/")[2].rpartition(".")[0]), []).append(name)
    for groups, what in (
        (sittings, f"were taken more than {_PAUSE.seconds // 3600} hour apart"),
        ([*by_folder.values()], "lie in several folders"),
        ([*by_name.values()], "have names of several kinds"),
    ):
        large = [sorted(group) for group in groups if len(group) >= _LEAST]
        if 2 <= len(large) <= _SCENES and sum(map(len, large)) >= _NEARLY * len(names):
            told = "; ".join(f"{len(group)} from {group[0]} to {group[-1]}" for group in large)
            return [f"perhaps {len(large)} scenes, as photos {what}: {told}. If so, give each its own folder"]
    return []


def films_beside(folder: Path, names: Sequence[str]) -> list[str]:
    """What becomes of films that lie beside the photos, in sentences: no film is a second capture."""
    films = sorted(p for p in folder.iterdir() if p.suffix.lower() in FILM_SUFFIXES and p.name[0] != ".")
    stems = {Path(name).stem.casefold() for name in names if "/" not in name}
    live = [p.name for p in films if p.stem.casefold() in stems]
    others = [p.name for p in films if p.name not in live]
    told = []
    if live:
        told.append(f"{_count(len(live), 'film')} of Live Photos, of which the photos are used: {some(live)}")
    if others:
        told.append(
            f"{_count(len(others), 'film')} beside the photos, which are used alone: {some(others)}; give "
            f"{folder / others[0]} in place of the folder to use that"
        )
    return told


def cameras_beside(*folders: Path) -> list[str]:
    """That files of other programs, which may hold cameras, are not read; or nothing."""
    found = [path.name for folder in dict.fromkeys(folders) for path in sorted(folder.iterdir())]
    named = {name: what for name in found for what, known in _CAMERAS.items() if known.search(name)}
    if not named:
        return []
    what = ", ".join(dict.fromkeys(named.values()))
    return [
        f"cameras are found from the photos: those in {some([*named])} ({what}) are not read; an export for "
        "COLMAP or nerfstudio is"
    ]


def not_here(folder: Path) -> list[str]:
    """That photos are in a cloud alone, or not downloaded to their end; or nothing."""
    found = sorted(p.name for p in folder.iterdir() if p.name.lower().endswith(_NOT_HERE))
    if not found:
        return []
    return [f"{_count(len(found), 'file')} not here, or not to the end: download {some(found)} first"]


def photos_and_maps(below: dict[str, list[str]]) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Folders of photos, and those of depth maps, masks or thumbnails by their names, if others are there."""
    maps = {k: v for k, v in below.items() if of_maps(k.rsplit("/", 1)[-1])}
    return (
        ({k: v for k, v in below.items() if k not in maps}, maps) if len(maps) < len(below) else (below, {})
    )


def photos_below(folder: Path, names: Sequence[str], below: dict[str, list[str]]) -> list[str]:
    """That photos in folders further down (`below`, by folder) are not used, and how many are copies."""
    by_size: dict[int, list[Path]] = {}
    for name in names:
        by_size.setdefault((folder / name).stat().st_size, []).append(folder / name)
    told = []
    for inner, inside in below.items():
        paths = [folder / inner / name for name in inside]
        same = sum(_copied(path, by_size.get(path.stat().st_size, [])) for path in paths)
        what = f"{_count(len(paths), 'photo')} in the folder {inner}"
        if same == len(paths):
            told.append(f"{what}: copies, not used")
            continue
        some_same = f", {same} of them copies" if same else ""
        told.append(f"{what}{some_same}: not used; put those of one scene into one folder to use them")
    return told


def _copied(path: Path, others: list[Path]) -> bool:
    return bool(others) and any(path.read_bytes() == other.read_bytes() for other in others)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
