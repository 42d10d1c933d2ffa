"""Folders that hold photos and nothing else: which of them can be read, and what their cameras may be."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from PIL import Image

from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.text import as_text, some
from hqgs.base.threads import of_each
from hqgs.photos import profiles
from hqgs.photos.exif import Exif, read_exif
from hqgs.photos.files import Glance, UnreadableError, decode, glance, needs_heic
from hqgs.photos.suffixes import PHOTO_SUFFIXES
from hqgs.scene.capture import photo_folder
from hqgs.scene.checks import beside
from hqgs.scene.constants import JPEG_QUALITY, MAX_WORKERS, MOST_SIDE
from hqgs.scene.faces import CUBE, face_name
from hqgs.scene.film import frames_around, of_film
from hqgs.scene.names import KEPT
from hqgs.scene.photo_files import can_be_listed, is_mask_folder, is_run, masks_among, of_maps
from hqgs.scene.sfm.copies import copies
from hqgs.scene.sfm.database import seen_size
from hqgs.scene.sfm.panoramas import all_around, colmap_faces, faces_seen
from hqgs.scene.sfm.run import Guess

FOLDERS_DEEP = 5  # below the one named in which photos are looked for: Takeout/Google Photos/Walk

COLMAP_FORMATS = ("PNG", "JPEG", "MPO", "TIFF", "BMP")  # what files of those suffixes hold
FOR_COLMAP = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")  # other photos are converted for it


@dataclass(frozen=True)
class BarePhotos:
    """The photos of a folder that has no cameras."""

    folder: Path
    downscale: float  # what is left to do
    names: list[str]  # relative to the folder, sorted
    sizes: list[tuple[int, int]] = field(default_factory=list)  # width and height of each
    exif: list[Exif] = field(default_factory=list)  # of each
    unreadable: dict[str, str] = field(default_factory=dict)  # others, and why
    notes: list[str] = field(default_factory=list)
    others: frozenset[str] = frozenset()  # what COLMAP cannot read as it is, by content or colours
    around: bool = False  # each shows 360 x 180 degrees, and is given to COLMAP as the faces of a cube

    @property
    def colmap_names(self) -> dict[str, str]:
        """Each photo's name by the one that COLMAP sees; of panoramas by that of each face, "front" first.

        Those have no blanks: COLMAP reads lists of names word by word.
        """
        found, own = dict[str, str](), {name.casefold() for name in self.names}
        for name in self.names:
            plain = re.sub(r"\s|^#", "_", as_text(name))
            while True:
                jpeg = self.as_it_is(name) or plain.lower().endswith((".jpg", ".jpeg"))
                seen = [plain if jpeg else f"{plain}.jpg"]
                if self.around:
                    seen = [f"{face_name(plain, face)}.jpg" for face in CUBE]
                others = own - {name.casefold()}  # a file system may take names of other case for one
                if not any(one.casefold() in others for one in seen) and not found.keys() & {*seen}:
                    break
                plain = f"_{plain}"
            found |= dict.fromkeys(seen, name)
        return found

    def as_it_is(self, name: str) -> bool:
        """Whether COLMAP reads the photo's file."""
        return name.lower().endswith(FOR_COLMAP) and name not in self.others

    def contents(self) -> Iterator[bytes]:
        """The files' bytes; of panoramas those of the other faces are empty."""
        faces = len(CUBE) if self.around else 1
        return (b"" if k else (self.folder / name).read_bytes() for name in self.names for k in range(faces))

    def guess(self, largest: int = MOST_SIDE) -> Guess:
        """Cameras of the photos, where no side has more than `largest` px.

        Photos of one size by the same make, model and zoom share a camera; EXIF gives its focal length.
        Panoramas of one size share the cameras of their faces, all of which are known.
        """
        if self.around:
            sizes = list(dict.fromkeys(self.sizes))
            front = [colmap_faces(*size)[0] for size in sizes]
            of_photo = [sizes.index(size) for size in self.sizes for _ in CUBE]
            seen = [seen_size((face.width, face.height), largest) for face in front]
            return Guess(
                seen,
                [
                    float(face.K[0, 0]) * side / face.width
                    for face, (side, _) in zip(front, seen, strict=True)
                ],
                of_photo,
                rotations=np.stack([*CUBE.values()]),
            )
        keys = [(*size, *exif.camera) for size, exif in zip(self.sizes, self.exif, strict=True)]
        cameras = list(dict.fromkeys(keys))
        first = [keys.index(camera) for camera in cameras]
        seen = [seen_size(self.sizes[k], largest) for k in first]
        return Guess(
            seen,
            [
                self.exif[k].focal * max(size) / max(self.sizes[k])
                for k, size in zip(first, seen, strict=True)
            ],
            [cameras.index(k) for k in keys],
        )

    def write(self, folder: Path, largest: int = MOST_SIDE) -> None:
        """The photos under COLMAP's names into a folder, no side longer than `largest` px; as links where
        COLMAP can read them as they are."""
        targets: dict[str, list[Path]] = {}
        for target, name in self.colmap_names.items():
            targets.setdefault(name, []).append(folder / target)
            targets[name][-1].parent.mkdir(parents=True, exist_ok=True)
        sizes = dict(zip(self.names, self.sizes, strict=False))  # none, where nothing was looked into

        def write(name: str) -> None:
            source, size = self.folder / name, sizes.get(name, (0, 0))
            if self.around:
                pictures = faces_seen(source, largest)
            elif self.as_it_is(name) and max(size) <= largest:
                return link(source, targets[name][0])
            else:
                pictures = [small_copy(source, seen_size(size, largest))]
            for picture, target in zip(pictures, targets[name], strict=True):
                picture.save(target, quality=JPEG_QUALITY, subsampling=0)

        list(of_each(write, self.names, MAX_WORKERS))


def small_copy(path: Path, size: tuple[int, int]) -> Image.Image:
    """A photo at a smaller size [2], of which no more is decoded than that needs; (0, 0): as it is."""
    picture = Image.fromarray(decode(path, size if any(size) else None)[0])
    return picture.resize(size, Image.Resampling.BOX) if any(size) and picture.size != size else picture


def link(source: Path, target: Path) -> None:
    """A link to a file, or a copy where the file system has no links."""
    try:
        target.symlink_to(source)
    except OSError:
        shutil.copyfile(source, target)


def bare_photos(root: Path, downscale: float) -> BarePhotos | None:
    """The photos of a folder, not looked into yet; None without photos.

    Those of `photo_folder`, or in `root` itself, or, where there are none, in the nearest folders below that
    are not called after depth maps, masks or thumbnails, if others are there.
    """
    everything = {} if is_run(root) else _photos_in_folders(root)
    folder, left, notes = photo_folder(root, downscale) or (root, downscale, [])
    here = {place: names for place, names in everything.items() if place.is_relative_to(folder)}
    if not here:
        folder, left, notes, here = root, downscale, [], everything
    sizes = f"{folder.name}_" if folder != root else "/"  # of folders with the same photos at other sizes
    nearest = min((len(place.parts) for place in here), default=0)
    used = {place: names for place, names in here.items() if len(place.parts) == nearest}
    maps = {place: names for place, names in used.items() if of_maps(place.name)}
    if folder in used or len(maps) == len(used):
        maps = {}
    used = {place: names for place, names in used.items() if place not in maps}
    if folder not in used:
        inner = [place.relative_to(folder).as_posix() for place in used]
        notes = [*notes, f"the photos are those in {some(inner)}, below {root.name}"]
        folder = next(iter(used)) if len(used) == 1 else folder
    rest = {place: len(names) for place, names in everything.items() if place not in used | maps}
    if told := [
        f"{place.relative_to(root).as_posix()} ({count})"
        for place, count in rest.items()
        if not place.name.startswith(sizes)
    ]:
        notes.append(
            f"not used: photos in {some(told)}. Put all photos of one scene into one folder to use them"
        )
    if maps:
        told = some([place.relative_to(root).as_posix() for place in maps])
        notes.append(f"these folders are not read, as their names say that they hold no photos: {told}")
    names = [(place / name).relative_to(folder).as_posix() for place in used for name in used[place]]
    masks = masks_among(names)
    names = [name for name in names if name not in masks]
    return BarePhotos(folder, left, names, notes=[*notes, *beside(root, folder)]) if names else None


def readable(photos: BarePhotos, on_stage: OnStage = silent) -> BarePhotos:
    """The photos that can be decoded, with their sizes and EXIF data; the others are in `unreadable`.

    Of copies one is used, but for frames of a film. The first note says in a line what was understood, as
    `on_stage` hears.

    ValueError where HEIC photos lack the extra that reads them, or less than half can be read.
    """
    looked, unreadable = _looked_at(photos, on_stage)
    tags = {name: read_exif(photos.folder / name) for name in looked}
    film, notes = of_film(photos.folder), list(photos.notes)
    twice = {} if film else copies(photos.folder, looked, tags)
    if twice:
        pairs = some([f"{name} (of {own})" for name, own in twice.items()])
        notes.append(f"{len(twice)} of {len(looked)} photos are duplicates and are not used: {pairs}")
        looked = {name: seen for name, seen in looked.items() if name not in twice}
    if film and frames_around(photos.folder):
        tags = {name: replace(tag, panorama=True) for name, tag in tags.items()}
    sphere, aside = all_around(photos.folder, looked, {name: tags[name] for name in looked})
    if aside:
        kind = "flat, unlike most" if sphere else "panoramas of 360 x 180 degrees, unlike most"
        notes.append(
            f"{len(aside)} of {len(looked)} photos are {kind}, and not used: {some(aside)}. Put them into "
            "a folder of their own"
        )
        looked = {name: seen for name, seen in looked.items() if name not in set(aside)}
    exif = [tags[name] for name in looked]
    if sphere and (untold := [name for name in looked if not tags[name].panorama]):
        notes.append(
            f"{len(untold)} photos look like panoramas of 360 x 180 degrees; their files do not say so "
            f"({some(untold)}). If they are flat photos, cut one row off each, so that they are not 2:1"
        )
    if not film or sphere:
        told = profiles.told({name: seen.colors for name, seen in looked.items()})
        notes = [_understood(exif, len(twice), sphere), *notes, *told]
        for note in (notes[0], *told):
            on_stage(Stage("photos read", len(photos.names), len(photos.names), note))
    return replace(
        photos,
        names=[*looked],
        sizes=[seen.size for seen in looked.values()],
        exif=exif,
        unreadable=unreadable,
        notes=notes,
        others=frozenset(
            name
            for name, seen in looked.items()
            if seen.format not in COLMAP_FORMATS or (seen.colors is not None and seen.colors.known)
        ),
        around=sphere,
    )


def _looked_at(photos: BarePhotos, on_stage: OnStage) -> tuple[dict[str, Glance], dict[str, str]]:
    """What a glance at each photo tells, and why others cannot be read."""
    if heic := [name for name in photos.names if needs_heic(photos.folder / name)]:
        raise ValueError(
            f"{photos.folder}: {len(heic)} of {len(photos.names)} photos are HEIC ({some(heic)}), which "
            "needs the extra 'heic': pip install 'hqgs[heic]'"
        )
    looked: dict[str, Glance] = {}
    unreadable: dict[str, str] = {}

    def look(name: str) -> Glance | str:
        try:
            return glance(photos.folder / name)
        except UnreadableError as error:
            return str(error)

    for k, found in enumerate(of_each(look, photos.names, MAX_WORKERS)):
        if isinstance(found, str):
            unreadable[as_text(photos.names[k])] = found
        else:
            looked[photos.names[k]] = found
        on_stage(Stage("photos read", k + 1, len(photos.names)))
    if len(looked) < len(unreadable):
        reasons = some([f"{name} ({why})" for name, why in unreadable.items()])
        raise ValueError(
            f"{photos.folder}: {len(unreadable)} of {len(photos.names)} photos cannot be read: {reasons}"
        )
    return looked, unreadable


def _understood(exif: list[Exif], copies: int, around: bool) -> str:
    """One line: how many photos of how many cameras, copies and places."""
    cameras = [tags.camera[:2] for tags in exif if any(tags.camera[:2])]
    located = sum(tags.gps is not None for tags in exif)
    parts = [f"{len(exif)} {'panoramas of 360 x 180 degrees' if around else 'photos'}"]
    of = f"cameras in EXIF: {len(set(cameras))} (of {len(cameras)} photos)"
    parts += [of if cameras else "no camera in EXIF"]
    parts += [f"{copies} duplicates not used"] if copies else []
    parts += [f"GPS in {located}"] if located else []
    return ", ".join(parts)


def ups(exif: Sequence[Exif]) -> np.ndarray:
    """Unit vectors [V, 3] that point up in each photo's camera frame: as it was held, or its gimbal says."""
    held = np.array([[0, -1, 0], [-1, 0, 0], [0, 1, 0], [1, 0, 0]], np.float64)
    found = held[[tags.quarter_turns for tags in exif]]
    for k, tags in enumerate(exif):
        if tags.pitch is not None:
            pitch = np.radians(tags.pitch)
            found[k] = np.cos(pitch) * found[k] + np.sin(pitch) * np.array([0, 0, 1.0])
    return found


def _photos_in_folders(root: Path) -> dict[Path, list[str]]:
    """The photos in a folder and those below, FOLDERS_DEEP levels down; the nearest folders first."""
    level, found = [root], dict[Path, list[str]]()
    seen = {root.resolve(), *root.resolve().parents}  # links lead there again
    for _ in range(FOLDERS_DEEP + 1):
        found |= {place: names for place in level if (names := _photos_in(place))}
        inner = sorted(
            p
            for place in level
            for p in place.iterdir()
            if p.is_dir()
            and not (is_mask_folder(p.name) or p.name == KEPT or p.name[0] == "." or is_run(p))
            and can_be_listed(p)
        )
        once = {p.resolve(): p for p in sorted(inner, key=lambda p: (not p.is_symlink(), p))}
        level = sorted(p for real, p in once.items() if real not in seen)
        seen |= once.keys()
    return found


def _photos_in(folder: Path) -> list[str]:
    return sorted(
        p.name
        for p in folder.iterdir()
        if p.suffix.lower() in PHOTO_SUFFIXES and p.is_file() and not p.name.startswith(".")
    )
