"""Renders as files: a picture, a folder of pictures, an MP4 film or a GIF."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from hqgs import _rust
from hqgs._rust import EPS2D, FAR_PLANE
from hqgs.base.evenly import evenly
from hqgs.base.files import atomic_path
from hqgs.base.state import own_state
from hqgs.base.threads import one_torch_thread
from hqgs.model.formats.arrays import curve_order
from hqgs.model.formats.turned import matrices
from hqgs.model.gaussians import Gaussians
from hqgs.photos.look import Look
from hqgs.photos.suffixes import PHOTO_SUFFIXES
from hqgs.photos.video import FPS, pyav
from hqgs.scene.constants import BACKGROUND
from hqgs.scene.names import FILM_SUFFIXES
from hqgs.scene.scene import Camera
from hqgs.show.trust import WORST_SHOWN, Trust

SHOWN = ("color", "depth", "alpha", "trust")
FILMS = (".mp4", ".gif")
_BT709 = 1  # its matrix, primaries and transfer in H.273; as FFmpeg's range: that of video
_EXACT = 0x4 | 0x2000 | 0x40000  # SWS_BICUBIC, SWS_FULL_CHR_H_INT, SWS_ACCURATE_RND
Picture = NDArray[np.uint8]
OnFrame = Callable[[int, int], None]


@own_state(grad=False)
def render_frames(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    out: str | Path,
    *,
    fps: float = FPS,
    show: str = "color",
    background: Sequence[float] = BACKGROUND,
    names: Sequence[str] | None = None,
    progress: OnFrame | None = None,
    trust: Trust | None = None,
    look: Look | None = None,
) -> Path:
    """Render what cameras see into a file, which appears when it is complete, or into a folder of pictures.

    Args:
        gaussians: the scene.
        cameras: at least 1; for a film, all of one size.
        out: ends in .mp4 (H.264, with the extra `video`; odd sides lose a pixel), .gif, or .png for a single
            camera; any other path is a folder, made if it is missing, for one PNG of each camera.
        fps: frames per second of a film.
        show: "color", "depth" (near is red, far is blue; one scale for all), "alpha" (white is opaque) or
            "trust" (the error that 9 of 10 pixels stay below: from blue, none, to red, 64 levels of 255).
        background: R, G, B behind everything, 1 is white.
        names: of the pictures in a folder, without .png; None: 00000, 00001, ...
        progress: is called after each frame with how many are done and how many there are.
        trust: for "trust", of `hqgs.show.trust.learn_trust`.
        look: of a photo, that colours are to have; None: the scene's own.

    Returns:
        `out`.

    Raises:
        ValueError: no camera, a film or picture of another kind, several cameras for a .png, several sizes
            for a film, an unknown `show`, no `trust` where it is shown, a background that is no three
            numbers, or .mp4 without PyAV.
        OSError: a file cannot be written; what was there before stays.
    """
    out = Path(out)
    check_frames(cameras, out, fps, show)
    pictures = _counted(frames(gaussians, cameras, show, background, trust, look), len(cameras), progress)
    suffix = out.suffix.lower()
    if suffix == ".mp4":
        with atomic_path(out) as tmp:
            _write_mp4(_pyav(), tmp, pictures, fps)
    elif suffix == ".gif":
        with atomic_path(out) as tmp:
            _write_gif(tmp, pictures, fps)
    elif suffix == ".png":
        with atomic_path(out) as tmp:
            Image.fromarray(next(pictures)).save(tmp)
    else:
        places = [f"{k:05}" for k in range(len(cameras))] if names is None else names
        for name, picture in zip(places, pictures, strict=True):
            with atomic_path(out / f"{name}.png") as tmp:
                Image.fromarray(picture).save(tmp, compress_level=3)
    return out


def check_frames(cameras: Sequence[Camera], out: Path, fps: float, show: str) -> None:
    """What `render_frames` raises of these, for who has work to do before it."""
    if not cameras:
        raise ValueError("there is no camera to render")
    if show not in SHOWN:
        raise ValueError(f"show is {show!r}, wanted one of: {', '.join(SHOWN)}")
    if not 0 < fps <= 1000:
        raise ValueError(f"fps is {fps}, wanted a number above 0 and at most 1000")
    suffix = out.suffix.lower()
    if suffix in FILMS:
        sizes = sorted({(camera.width, camera.height) for camera in cameras})
        if len(sizes) > 1:
            each = " and ".join(f"{w} x {h}" for w, h in sizes[:2])
            raise ValueError(f"{out}: all frames of a film have one size, these cameras have {each} px")
        if suffix == ".mp4" and min(sizes[0]) < 2:
            raise ValueError(f"a film has sides of at least 2 px, these are {sizes[0][0]} x {sizes[0][1]}")
        if suffix == ".mp4":
            _pyav()
    elif suffix == ".png" and len(cameras) > 1:
        raise ValueError(f"{out} holds one picture, and there are {len(cameras)}: give a folder")
    if suffix in (*FILMS, ".png"):
        if out.is_dir():
            raise ValueError(f"{out} is a folder: name a file, or a folder without {suffix}")
    elif (
        suffix[1:].isalpha() or suffix in (*FILM_SUFFIXES, *PHOTO_SUFFIXES) or out.exists()
    ) and not out.is_dir():
        raise ValueError(f"{out} is not a folder; films are .mp4 or .gif, a single picture is .png")


def frames(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    show: str = "color",
    background: Sequence[float] = BACKGROUND,
    trust: Trust | None = None,
    look: Look | None = None,
) -> Iterator[Picture]:
    """What each camera sees, [H, W, 3], in turn; see `render_frames`."""
    if len(background) != 3:
        raise ValueError(f"background is {background}, wanted three numbers: R, G, B")
    with torch.no_grad():
        prepared = Activated(gaussians)
    if show == "color":
        yield from (prepared.color(camera, background, look) for camera in cameras)
    elif show == "trust":
        if trust is None:
            raise ValueError("show is 'trust', which needs the errors of the Gaussians, measured by photos")
        yield from (trust_picture(trust.bound(camera)) for camera in cameras)
    elif show == "alpha":
        yield from (grey(prepared.depth(camera)[1]) for camera in cameras)
    else:
        places = evenly(len(cameras), 8)
        low_high = depth_range([prepared.depth(cameras[k]) for k in places])
        yield from (depth_picture(*prepared.depth(camera), low_high) for camera in cameras)


class Activated:
    """Gaussians that are rendered many times: activated once, without a gradient history, and neighbours
    together, so that a camera passes over whole groups that it does not see."""

    def __init__(self, gaussians: Gaussians) -> None:
        g = gaussians.detached()
        with one_torch_thread():
            g = g.rows(torch.from_numpy(curve_order(g.means.numpy())))
        self.degree: int = g.sh_degree
        self.gaussians: Gaussians = g
        self._near = g.near_plane()
        tensors = g.means, g.quats, g.activated_scales(), g.activated_opacities(), g.sh0
        rest = g.shN.contiguous().numpy() if g.sh_degree else None
        means, quats, scales, opacities, sh0 = (tensor.contiguous().numpy() for tensor in tensors)
        self._arrays = means, quats, scales, opacities, sh0, rest
        self._options = (self._near, FAR_PLANE, 0.0, EPS2D, g.antialiased, False)

    @torch.no_grad()
    def color(
        self, camera: Camera, background: Sequence[float] = BACKGROUND, look: Look | None = None
    ) -> Picture:
        """[H, W, 3], clipped and rounded to 8 bits."""
        if look is not None:
            with one_torch_thread():
                image, _, _ = self.gaussians.rasterize(
                    camera, sh_degree=self.degree, background=background, near_plane=self._near
                )
                seen = torch.from_numpy(look.of(image[0].numpy(), camera.K))
                return seen.mul_(255).round_().clamp_(0, 255).byte().numpy()
        viewmat, K = (np.ascontiguousarray(m[None], np.float64) for m in (camera.viewmat, camera.K))
        width, height = camera.width, camera.height
        frame, *_, colors = _rust.project_forward(
            *self._arrays, viewmat, K, width, height, self._options, self.degree, all=False
        )
        behind = np.array([[*background]], colors.dtype)
        picture = _rust.composite_picture(frame, colors.reshape(-1, 3), behind)
        return picture.reshape(height, width, 3)

    @torch.no_grad()
    def depth(self, camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Expected depth along the viewing axis, world units, and alpha, both [H, W]."""
        with one_torch_thread():
            image, alpha, _ = self.gaussians.rasterize(
                camera, self.gaussians.sh0[:, 0], render_mode="ED", near_plane=self._near
            )
        return image[0, ..., 0].float().numpy(), alpha[0, ..., 0].float().numpy()

    @torch.no_grad()
    def thickness(self, at: NDArray[np.float64], ahead: NDArray[np.float64]) -> float:
        """Median standard deviation along a direction, unit [3], of eight Gaussians around a point [3]."""
        means, quats, scales, *_ = self._arrays
        rows = np.argsort(np.square(means - at).sum(1), kind="stable")[:8]
        own = ahead @ matrices(quats[rows].astype(np.float64))  # along the Gaussians' axes
        return float(np.median(np.linalg.norm(own * scales[rows], axis=1)))


def depth_range(samples: Iterable[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> tuple[float, float]:
    """The nearest and farthest depth that pictures of these depths and alphas tell apart."""
    seen = np.concatenate([depth[alpha > 0.5] for depth, alpha in samples])
    if not seen.size:
        return 1.0, 2.0
    low, high = (max(float(value), 1e-6) for value in np.percentile(seen, (2, 98)))
    return low, max(high, low * 1.001)


def depth_picture(
    depth: NDArray[np.float32], alpha: NDArray[np.float32], low_high: tuple[float, float]
) -> Picture:
    """Depths [H, W] as colours: 1 / depth from red (near) to blue (far), black where nothing is."""
    low, high = low_high
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (1 / depth - 1 / high) / (1 / low - 1 / high)
    return _colored(np.nan_to_num(near, nan=0.0), alpha[..., None].clip(0, 1))


def trust_picture(bound: NDArray[np.float32]) -> Picture:
    """Levels of error [H, W] as colours: from blue, none, to red, WORST_SHOWN."""
    return _colored(bound / WORST_SHOWN, 1.0)


def _colored(share: NDArray[np.floating], light: NDArray[np.float32] | float) -> Picture:
    """Shares [H, W] as colours from blue, 0, to red, 1, each channel times `light`."""
    from matplotlib import colormaps  # here: it takes a while to load

    table = np.asarray(colormaps["turbo"](np.arange(256)))[:, :3]
    return np.rint(255 * table[np.rint(share.clip(0, 1) * 255).astype(np.intp)] * light).astype(np.uint8)


def grey(alpha: NDArray[np.float32]) -> Picture:
    level = np.rint(255 * alpha.clip(0, 1)).astype(np.uint8)
    return np.repeat(level[..., None], 3, axis=2)


def _counted(pictures: Iterator[Picture], total: int, progress: OnFrame | None) -> Iterator[Picture]:
    for done, picture in enumerate(pictures, 1):
        yield picture
        if progress is not None:
            progress(done, total)


def _pyav() -> Any:
    return pyav(".mp4 (.gif does not)")


def written_size(out: Path, width: int, height: int) -> tuple[int, int]:
    """Width and height of pictures of that size in a file: a film has even sides."""
    odd = 1 if out.suffix.lower() == ".mp4" else 0
    return width - odd * (width % 2), height - odd * (height % 2)


def _write_mp4(av: Any, path: Path, pictures: Iterator[Picture], fps: float) -> None:
    first = next(pictures)
    width, height = written_size(path, first.shape[1], first.shape[0])
    # Absolute: FFmpeg takes "walk:1.mp4" for an address.
    with av.open(str(path.absolute()), "w", options={"movflags": "+faststart"}) as film:
        stream = film.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "18", "preset": "veryfast"}  # no difference that an eye finds
        # Players take films without tags for BT.601 or BT.709, by their size.
        coded = stream.codec_context
        coded.colorspace = coded.color_primaries = coded.color_trc = coded.color_range = _BT709

        def encode(picture: Picture) -> None:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture[:height, :width]), format="rgb24")
            frame = frame.reformat(
                format="yuv420p", dst_colorspace=_BT709, dst_color_range=_BT709, interpolation=_EXACT
            )
            for packet in stream.encode(frame):
                film.mux(packet)

        # The encoder works on a frame while the next one is rendered.
        with ThreadPoolExecutor(1) as pool:
            waiting = None
            for picture in chain([first], pictures):
                if waiting is not None:
                    waiting.result()
                waiting = pool.submit(encode, picture)
            if waiting is not None:
                waiting.result()
        for packet in stream.encode():
            film.mux(packet)


def _write_gif(path: Path, pictures: Iterator[Picture], fps: float) -> None:
    """GIF counts hundredths of a second; players are slow below two of them."""
    first, *rest = (Image.fromarray(picture).quantize(256, dither=Image.Dither.NONE) for picture in pictures)
    length = max(round(100 / fps), 2) * 10
    first.save(path, save_all=True, append_images=rest, duration=length, loop=0)
