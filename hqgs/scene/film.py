"""Photos from a film: the sharpest frame of each interval."""

from __future__ import annotations

import errno
import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import new_folder, read_json, write_json
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.text import as_text
from hqgs.photos.film_colors import KNEE, as_photo, film_colors
from hqgs.photos.jpeg import fine_detail
from hqgs.photos.video import FPS, pyav
from hqgs.scene.constants import COPY_SIDE, JPEG_QUALITY
from hqgs.scene.names import FRAMES, is_room
from hqgs.scene.photo_files import film_at

# Frames: what a slow walk needs; matching grows with their square.
FRAMES_A_SECOND, FRAMES_FEWEST, FRAMES_MOST = 2.0, 30, 90

_PICTURES = ("mjpeg", "png", "bmp", "gif", "webp")  # codecs of covers, in films that count no frames
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
    name = f"10 {path.name} {state.st_size} {state.st_mtime_ns} {rule}"
    target = folder.resolve() / hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    if not target.is_dir():
        try:
            with new_folder(target) as new:  # nothing is left of a film that cannot be read
                details, told = dict[str, float](), dict[str, None]()
                for number, frame in _sharpest(av, path, count, on_stage, told):
                    file = new / f"{number:06d}.jpg"
                    Image.fromarray(frame).save(file, quality=JPEG_QUALITY, subsampling=0)
                    details[file.name] = fine_detail(frame.astype(np.float64))
                write_details(new, details, around, [*told])
        except OSError:
            if not target.is_dir():  # another process was first: its frames are the same
                raise
    frames = len(list(target.glob("*.jpg")))
    note = f"the sharpest {frames} frames of {as_text(path.name)}, one for each interval"
    if told := _written(target).get("told"):
        note = "; ".join([note, *told])
        on_stage(Stage("frames of the film read", frames, frames, note))
    return target, note


def check_film(path: str | Path) -> None:
    """ValueError where a number of frames is asked of something else than a film."""
    if is_room(path) or (Path(path).is_dir() and film_at(path) is None):
        raise ValueError(f"frames is for films, and {path} is not a film: all of its photos are used")


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


def write_details(
    folder: Path, details: dict[str, float], around: bool = False, told: Sequence[str] = ()
) -> None:
    """Say that photos of a folder are frames of a film: the `fine_detail` of each as it was decoded, whether
    they are panoramas, and what else was done, in words."""
    write_json(folder / FRAMES, {"details": details, "around": around, "told": [*told]})


def frame_details(folder: Path) -> dict[str, float]:
    """`fine_detail` by photo of a folder of a film's frames; none of another folder.

    ValueError where its file is damaged.
    """
    try:
        return {name: float(detail) for name, detail in _written(folder).get("details", {}).items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{folder / FRAMES} is damaged: {error!r}") from error


def of_film(folder: Path) -> bool:
    """Whether a folder says that it holds frames of a film."""
    return bool(_written(folder))


def frames_around(folder: Path) -> bool:
    """Whether the film whose frames a folder holds said that they are panoramas."""
    return _written(folder).get("around") is True


def _written(folder: Path) -> dict[str, Any]:
    """What `write_details` wrote; nothing where that is not there: other programs' files have this name, too.

    ValueError where it is damaged.
    """
    path = folder / FRAMES
    written = read_json(path) if path.is_file() else None
    return written if isinstance(written, dict) and "details" in written else {}


def _sharpest(
    av: Any, path: Path, count: int | None, on_stage: OnStage, told: dict[str, None]
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Number and pixels [H, W, 3] of the sharpest frame of each interval, as the film is to be shown.

    `told` gets what was done to them, in words.
    """
    best, at, best_sharpness = None, 0, -2.0
    curve, wide, start = 0, None, None
    try:
        with _opened(av, path) as film:
            stream = _best_stream(film, path, told)
            stream.thread_type = "AUTO"
            curve = int(getattr(stream.codec_context, "color_trc", 0) or 0)
            seconds = _seconds(film, stream) or _seconds_by_packets(av, path)
            wanted = count or int(np.clip(round(FRAMES_A_SECOND * seconds), FRAMES_FEWEST, FRAMES_MOST))
            interval = seconds / wanted if seconds > 0 else 1 / FRAMES_A_SECOND
            wide = stream.sample_aspect_ratio
            for number, (time, frame) in enumerate(_progressive(av, _decoded(av, film, stream, told), told)):
                time = time if time is not None else number / FPS
                start = time if start is None else start
                now = min(int((time - start) / interval), wanted - 1)
                if now > at and best is not None:
                    yield best[0], _shown(best[1], curve, wide, told)
                    best, best_sharpness = None, -2.0
                at = max(at, now)
                # What a decoder had to make up looks sharp: only where an interval has nothing else.
                sharpness = -1.0 if frame.is_corrupt else _sharpness(frame)
                if sharpness > best_sharpness:
                    best_sharpness, best = sharpness, (number, frame)
                on_stage(Stage("frames of the film read", number + 1, stream.frames or 0))
    except (av.error.FFmpegError, OSError) as error:
        known = error.errno is not None and error.errno in errno.errorcode  # FFmpeg has numbers of its own
        why = os.strerror(error.errno or 0) if known else "it is not a film, or damaged"
        if best is None:
            raise ValueError(f"the film {path} cannot be read: {why}") from error
        told[f"frames after number {best[0]} cannot be read ({why})"] = None
    if best is None:
        raise ValueError(f"the film {path} holds no frame that can be read")
    yield best[0], _shown(best[1], curve, wide, told)


def _opened(av: Any, path: Path) -> Any:
    """The film in a file: by a path that FFmpeg takes for no address, as it does `12:30.mp4`."""
    return av.open(str(path.absolute()), metadata_errors="ignore")


def _best_stream(film: Any, path: Path, told: dict[str, None]) -> Any:
    """The largest pictures that move, of several the default ones: no cover, thumbnail or proxy."""
    aside = 0x400 | 0x800 | 0x100000  # AV_DISPOSITION_ATTACHED_PIC, TIMED_THUMBNAILS, STILL_IMAGE
    streams = film.streams.video
    if not streams:
        raise ValueError(f"{path} holds no pictures, only sound")
    ranks, most = [], max(stream.frames for stream in streams)
    for stream in streams:
        flags = int(getattr(stream, "disposition", 0))
        few = 4 * stream.frames < most if stream.frames else stream.codec_context.name in _PICTURES
        ranks.append((not flags & aside, not few, stream.width * stream.height, flags & 1))
    best = streams[max(range(len(ranks)), key=lambda k: (ranks[k], -k))]
    if len(streams) > 1:
        told[f"of its {len(streams)} streams of pictures, the one of {best.width} x {best.height} px"] = None
    return best


def _decoded(av: Any, film: Any, stream: Any, told: dict[str, None]) -> Iterator[Any]:
    """The frames of the packets that can be decoded."""
    lost = 0
    for packet in film.demux(stream):
        try:
            frames = packet.decode()
        except av.error.FFmpegError:
            lost += 1
            continue
        yield from frames
    if lost:
        told[f"{lost} damaged parts were left out"] = None


def _progressive(av: Any, frames: Iterator[Any], told: dict[str, None]) -> Iterator[tuple[float | None, Any]]:
    """Time and picture of each frame; from the first one of two fields on through FFmpeg's yadif."""
    graph, times = None, list[float | None]()

    def out() -> Iterator[tuple[float | None, Any]]:
        with suppress(BlockingIOError, EOFError):
            while graph is not None:
                frame = graph.pull()
                yield times.pop(0), frame

    for frame in frames:
        if graph is None and not frame.interlaced_frame:
            yield frame.time, frame
            continue
        if graph is None:
            told["interlaced, and deinterlaced by FFmpeg's yadif"] = None
            graph = av.filter.Graph()
            size = {"width": frame.width, "height": frame.height, "format": frame.format}
            source = graph.add_buffer(**size, time_base=frame.time_base or Fraction(1, 1000))
            graph.link_nodes(source, graph.add("yadif", "deint=interlaced"), graph.add("buffersink"))
            graph.configure()
        times.append(frame.time)
        graph.push(frame)
        yield from out()
    if graph is not None:
        graph.push(None)
        yield from out()


def _shown(frame: Any, curve: int, wide: Fraction | None, told: dict[str, None]) -> NDArray[np.uint8]:
    """A frame of a film with this transfer function as a player shows it, [H, W, 3].

    `wide`: how wide a pixel is, of its height; None or 0, where the film does not tell, and what no camera
    writes count as 1.
    """
    photo = as_photo(frame, curve)
    if (colors := film_colors(frame, curve)) is not None:
        text = f"its colours, {colors.name}, were converted to sRGB"
        if colors.hdr != (0, 0):
            text += f": light above {KNEE:g} of the reference white of 203 cd/m2 is bent to end at white"
        told[text] = None
    if wide and 1 / _WIDEST <= wide <= _WIDEST and (width := round(frame.width * wide)) != frame.width:
        photo = np.asarray(Image.fromarray(photo).resize((width, frame.height), Image.Resampling.LANCZOS))
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return photo
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[:5].tolist()  # (x, y) goes to (ax + cy, bx + dy)
    across = abs(a) + abs(d) < abs(b) + abs(c)
    x, y = (c, b) if across else (a, d)
    if x * y * (-1 if across else 1) < 0:
        told["mirrored, as the file says"] = None
    photo = photo.swapaxes(0, 1) if across else photo
    return np.ascontiguousarray(photo[:: -1 if y < 0 else 1, :: -1 if x < 0 else 1])


def _seconds(film: Any, stream: Any) -> float:
    """Of the film; 0 where it does not tell."""
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    return film.duration / 1e6 if film.duration else 0.0


def _seconds_by_packets(av: Any, path: Path) -> float:
    """Of a film that does not tell, as browsers record them: between its first picture and its last."""
    with _opened(av, path) as film:
        stream = _best_stream(film, path, {})
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


_TOP = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"uuid", b"moof")
_LARGEST = 64 * 2**20  # bytes of the box that is looked at: longer films keep a table of frames there
_SIDES = (b"WidthPixels", b"HeightPixels")
_XML = re.compile(
    rb"<GSpherical:(ProjectionType|StereoMode|(?:FullPano|CroppedAreaImage)(?:Width|Height)Pixels)>"
    rb"\s*([a-z\d-]+)\s*</"
)
_PROJECTIONS = {b"equi": "equirectangular", b"cbmp": "cubemap", b"mshp": "mesh"}
_PART = "a part of the sphere"
_STEREO = {1: "top-bottom", 2: "left-right"}


def projection(path: Path) -> tuple[str, str] | None:
    """What an MP4 film says of its sphere (Google's spherical video metadata, version 1, XML, and 2, boxes):
    projection ("equirectangular", "cubemap", "mesh", or that frames show a part of the sphere) and stereo
    mode ("mono", "top-bottom", "left-right").

    None where the film says nothing, or is no MP4. OSError where it cannot be read.
    """
    box = _moov(path)
    told = dict(_XML.findall(box))
    if b"ProjectionType" in told:
        sides = ((told.get(b"FullPano" + side), told.get(b"CroppedAreaImage" + side)) for side in _SIDES)
        cut = any(None not in side and side[0] != side[1] for side in sides)
        return _PART if cut else told[b"ProjectionType"].decode(), told.get(b"StereoMode", b"mono").decode()
    at = box.find(b"sv3d")
    if at < 0:
        return None
    kinds = [name for kind, name in _PROJECTIONS.items() if kind in box[at : at + 256]]
    if not kinds:
        return None
    bounds = box.find(b"equi", at) + 8  # after version and flags
    if kinds[0] == "equirectangular" and any(box[bounds : bounds + 16]):
        kinds = [_PART]
    stereo = box.find(b"st3d")
    mode = box[stereo + 8] if 0 <= stereo < len(box) - 8 else 0  # after version and flags
    return kinds[0], _STEREO.get(mode, "mono")


def _moov(path: Path) -> bytes:
    """The box that describes the film; empty where there is none."""
    end = path.stat().st_size
    with path.open("rb") as file:
        while file.tell() + 8 <= end:
            start, head = file.tell(), file.read(8)
            size, kind = int.from_bytes(head[:4], "big"), head[4:]
            if kind not in _TOP:
                return b""
            if size == 1:
                size = int.from_bytes(file.read(8), "big")
            size = size or end - start
            if kind == b"moov":
                file.seek(start)
                return file.read(min(size, _LARGEST))
            if size < 8:
                return b""
            file.seek(start + size)
    return b""
