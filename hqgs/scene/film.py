"""Photos from a film: the sharpest frame of each interval."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import missing_folders, remove_empty, write_json
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.photos.blocks import fine_detail
from hqgs.photos.constants import FPS
from hqgs.photos.film_colors import HDR, KNEE, as_photo, transfer
from hqgs.photos.spherical import projection
from hqgs.photos.video import pyav
from hqgs.scene.constants import COPY_SIDE, FRAMES_A_SECOND, FRAMES_FEWEST, FRAMES_MOST, JPEG_QUALITY
from hqgs.scene.names import FRAMES, is_room
from hqgs.scene.photo_files import film_at

_WIDEST = 4  # times as wide as high are pixels of a film at most, or as high as wide


def film_frames(
    path: Path, folder: Path, count: int | None = None, on_stage: OnStage = silent
) -> tuple[Path, str]:
    """The sharpest frame of each of `count` intervals of a film, as JPEG files, upright.

    `count` None: two a second, at least 30 and at most 90, as far as the film has them. The files lie in a
    folder below `folder`, where the next call finds them, with the fine detail that each frame had before it
    was stored (`frame_details`). Returns their folder and what was done, in words. ValueError where PyAV
    (the extra `video`) is missing, or the film cannot be read.
    """
    if count is not None and count < 3:
        raise ValueError(f"frames is {count}, wanted at least 3")
    av = pyav(f"{path} is a film, which")
    around = _is_around(path)
    state = path.stat()
    rule = f"{count} {FRAMES_A_SECOND} {FRAMES_FEWEST} {FRAMES_MOST}"
    name = f"8 {path.name} {state.st_size} {state.st_mtime_ns} {rule}"
    target = folder / hashlib.sha256(name.encode()).hexdigest()[:16]
    if not target.is_dir():
        new = folder / f".{target.name}"
        shutil.rmtree(new, ignore_errors=True)
        made = missing_folders(folder)
        new.mkdir(parents=True)
        try:
            details: dict[str, float] = {}
            for number, frame in _sharpest(av, path, count, on_stage):
                file = new / f"{number:06d}.jpg"
                Image.fromarray(frame).save(file, quality=JPEG_QUALITY, subsampling=0)
                details[file.name] = fine_detail(frame.astype(np.float64))
            write_details(new, details, around)
            new.rename(target)
        finally:
            shutil.rmtree(new, ignore_errors=True)
            remove_empty(made)  # nothing is left of a film that cannot be read
    note = f"the sharpest {len(list(target.glob('*.jpg')))} frames of {path.name}, one for each interval"
    if (curve := _transfer(av, path)) in HDR:
        note += (
            f"; its high dynamic range ({HDR[curve]}) is toned down to sRGB: light above {KNEE:g} of the "
            "reference white of 203 cd/m2 is bent to end at white"
        )
    return target, note


def check_film(path: str | Path) -> None:
    """ValueError where a number of frames is asked of something else than a film."""
    if is_room(path) or (Path(path).is_dir() and film_at(path) is None):
        raise ValueError(f"frames is for films, and {path} is none: each of its photos is used")


def _is_around(path: Path) -> bool:
    """Whether the film says that its frames are panoramas of 360 x 180 degrees. ValueError where it says that
    they are something else of a sphere."""
    try:
        told = projection(path)
    except OSError:
        return False  # reading its frames tells why
    if told is None:
        return False
    kind, stereo = told
    if kind == "equirectangular" and stereo == "mono":
        return True
    what = (
        f"frames are {kind}" if stereo == "mono" else f"frames hold two pictures, one for each eye ({stereo})"
    )
    raise ValueError(f"the film {path} is of 360 degrees, but its {what}: export it as equirectangular, mono")


def write_details(folder: Path, details: dict[str, float], around: bool = False) -> None:
    """Say that photos of a folder are frames of a film: the `fine_detail` of each as it was decoded, and
    whether they are panoramas."""
    write_json(folder / FRAMES, {"details": details, "around": around})


def frame_details(folder: Path) -> dict[str, float]:
    """`fine_detail` by photo of a folder of a film's frames; none of another folder.

    ValueError where its file is damaged.
    """
    path = folder / FRAMES
    if not path.is_file():
        return {}
    try:
        details = json.loads(path.read_text(encoding="utf-8"))["details"]
        return {name: float(detail) for name, detail in details.items()}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error


def frames_around(folder: Path) -> bool:
    """Whether the film whose frames a folder holds said that they are panoramas."""
    try:
        told = json.loads((folder / FRAMES).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(told, dict) and told.get("around") is True


def _sharpest(
    av: Any, path: Path, count: int | None, on_stage: OnStage
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Number and pixels [H, W, 3] of the sharpest frame of each interval, as the film is to be shown."""
    try:
        with av.open(str(path), metadata_errors="ignore") as film:
            if not film.streams.video:
                raise ValueError(f"{path} holds no pictures, only sound")
            stream = film.streams.video[0]
            stream.thread_type = "AUTO"
            curve, wide = transfer(stream.codec_context), stream.sample_aspect_ratio
            seconds = _seconds(film, stream) or _seconds_by_packets(av, path)
            wanted = count or int(np.clip(round(FRAMES_A_SECOND * seconds), FRAMES_FEWEST, FRAMES_MOST))
            interval = seconds / wanted if seconds > 0 else 1 / FRAMES_A_SECOND
            best, at, best_sharpness = None, 0, -1.0
            number, start = -1, None
            for number, frame in enumerate(film.decode(stream)):
                time = frame.time if frame.time is not None else number / FPS
                start = time if start is None else start
                now = min(int((time - start) / interval), wanted - 1)
                if now > at and best is not None:
                    yield best[0], _upright(best[1], curve, wide)
                    best, best_sharpness = None, -1.0
                at = max(at, now)
                if (sharpness := _sharpness(frame)) > best_sharpness:
                    best_sharpness = sharpness
                    best = number, frame
                on_stage(Stage("frames of the film looked at", number + 1, stream.frames or 0))
    except (av.error.FFmpegError, OSError) as error:
        known = error.errno is not None and error.errno in errno.errorcode  # FFmpeg has numbers of its own
        why = os.strerror(error.errno or 0) if known else "it is no film, or damaged"
        raise ValueError(f"the film {path} cannot be read: {why}") from error
    if best is None:
        raise ValueError(f"the film {path} holds no frame that can be read")
    yield best[0], _upright(best[1], curve, wide)


def _upright(frame: Any, curve: int, wide: Fraction | None) -> NDArray[np.uint8]:
    """A frame of a film with this transfer function as it is to be shown, [H, W, 3].

    `wide`: how wide a pixel is, of its height; None or 0, where the film does not tell, and what no camera
    writes count as 1.
    """
    photo = as_photo(frame, curve)
    if wide and 1 / _WIDEST <= wide <= _WIDEST and (width := round(frame.width * wide)) != frame.width:
        photo = np.asarray(Image.fromarray(photo).resize((width, frame.height), Image.Resampling.LANCZOS))
    turns = round(getattr(frame, "rotation", 0) / 90)  # counter-clockwise, as rot90 does
    return np.ascontiguousarray(np.rot90(photo, turns))


def _transfer(av: Any, path: Path) -> int:
    """The number of the film's transfer function."""
    with av.open(str(path), metadata_errors="ignore") as film:
        return transfer(film.streams.video[0].codec_context)


def _seconds(film: Any, stream: Any) -> float:
    """Of the film; 0 where it does not tell."""
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    return film.duration / 1e6 if film.duration else 0.0


def _seconds_by_packets(av: Any, path: Path) -> float:
    """Of a film that does not tell, as browsers record them: between its first picture and its last."""
    with av.open(str(path), metadata_errors="ignore") as film:
        stream = film.streams.video[0]
        times = [
            float(packet.pts * stream.time_base) for packet in film.demux(stream) if packet.pts is not None
        ]
    return max(times) - min(times) if times else 0.0


def _sharpness(frame: Any) -> float:
    """Mean square of the Laplacian of the luma, at a size that any film has."""
    scale = min(1.0, COPY_SIDE / max(frame.width, frame.height))
    small = frame.reformat(
        width=max(8, round(frame.width * scale)), height=max(8, round(frame.height * scale)), format="gray"
    )
    luma = small.to_ndarray().astype(np.float32)
    inner = luma[1:-1, 1:-1]
    laplacian = luma[:-2, 1:-1] + luma[2:, 1:-1] + luma[1:-1, :-2] + luma[1:-1, 2:] - 4 * inner
    return float(np.square(laplacian).mean())
