"""Photos as a film: through a real H.264 encoder and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

from hqgs.photos.pixels import Float32, as_floats, to_uint8
from hqgs.photos.video import FPS, pyav

ENCODER, DECODER = "libx264", "h264"
# The vector code of x264 gives other bits from call to call; without it a film takes 2.5 times as long.
OPTIONS = {"x264-params": "asm=0", "preset": "medium"}
# Luma and chroma of 8 bits, ITU-R BT.601 with limited range: Y in 16..235, Cb and Cr in 16..240.
_TO_YUV = np.array(
    [
        [65.481, 128.553, 24.966],
        [-112 * 0.299 / 0.886, -112 * 0.587 / 0.886, 112.0],
        [112.0, -112 * 0.587 / 0.701, -112 * 0.114 / 0.701],
    ]
)
_OFFSET = np.array([16.0, 128.0, 128.0])
_FRAME_KINDS = {1: "I", 2: "P", 3: "B"}  # libavutil's AVPictureType


@dataclass(frozen=True)
class FilmFrame:
    """A photo that came out of a film."""

    image: Float32  # [H, W, 3], multiples of 1/255
    kind: str  # "I", "P" or "B"
    bytes: int  # of the compressed frame, in the first one with the headers


def film(images: Sequence[Float32], value: float) -> list[FilmFrame]:
    """Encode photos [H, W, 3] of one size, clipped and rounded to 8 bits, as one film, and decode it.

    x264 at a constant rate factor; preset medium, 30 frames per second, on one thread; otherwise the
    encoder's own defaults. Photos are BT.601 with limited range and 4:2:0 chroma, the mean of each 2 x 2
    pixels; the way back interpolates the chroma bilinearly. Odd sides get their last row or column once more,
    which is cut off again. The same photos give the same bits with the same build of PyAV. ValueError without
    PyAV (the extra `video`) or its encoder, or for photos of several sizes.
    """
    av = pyav("video")
    sizes = sorted({image.shape[1::-1] for image in images})
    if len(sizes) > 1:
        each = " and ".join(f"{w} x {h}" for w, h in sizes[:2])
        raise ValueError(f"a film has frames of one size, but there are photos of {each} px")
    (width, height), (odd_columns, odd_rows) = sizes[0], (side % 2 for side in sizes[0])
    try:
        out = av.CodecContext.create(ENCODER, "w")
    except (ValueError, av.error.FFmpegError) as error:  # a PyAV that was built without the encoder
        raise ValueError(f"video needs PyAV with the encoder {ENCODER}: {error}") from error
    out.width, out.height, out.pix_fmt = width + odd_columns, height + odd_rows, "yuv420p"
    out.time_base, out.framerate = Fraction(1, FPS), Fraction(FPS)
    out.thread_count = 1
    out.options = {"crf": str(value), **OPTIONS}
    back = av.CodecContext.create(DECODER, "r")
    back.thread_count = 1

    sizes_by_time: dict[int, int] = {}
    frames: dict[int, tuple[NDArray[np.uint8], str]] = {}

    def decode(packet: Any) -> None:
        if packet is not None:
            sizes_by_time[packet.pts] = packet.size
        for frame in back.decode(packet):
            frames[frame.pts] = frame.to_ndarray(), _FRAME_KINDS[int(frame.pict_type)]

    try:
        for time, image in enumerate(images):
            pixels = np.pad(to_uint8(image), ((0, odd_rows), (0, odd_columns), (0, 0)), mode="edge")
            frame = av.VideoFrame.from_ndarray(_to_planes(pixels), format="yuv420p")
            frame.pts, frame.time_base = time, out.time_base
            for packet in out.encode(frame):
                decode(packet)
        for packet in out.encode(None):
            decode(packet)
        decode(None)
    except av.error.FFmpegError as error:
        raise ValueError(f"video:{value:g} of photos of {width} x {height} px: {ENCODER}: {error}") from error
    return [
        FilmFrame(
            as_floats(_from_planes(planes, out.width)[:height, :width]), frame_kind, sizes_by_time[time]
        )
        for time, (planes, frame_kind) in sorted(frames.items())
    ]


def _to_planes(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W, 3] with even sides as planes, [1.5 H, W] as PyAV has them: Y, then Cb and Cr of half size."""
    height, width = pixels.shape[:2]
    yuv = pixels / 255 @ _TO_YUV.T + _OFFSET
    chroma = yuv[..., 1:].reshape(height // 2, 2, width // 2, 2, 2).mean(axis=(1, 3))
    parts = [yuv[..., 0], chroma[..., 0], chroma[..., 1]]
    flat = np.concatenate([np.rint(part).clip(0, 255).astype(np.uint8).ravel() for part in parts])
    return flat.reshape(height * 3 // 2, width)


def _from_planes(planes: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """The inverse of `_to_planes`."""
    height = planes.shape[0] * 2 // 3
    chroma = planes[height:].reshape(2, height // 2, width // 2).astype(np.float64)
    wide = np.asarray(zoom(chroma, (1, 2, 2), order=1, mode="nearest", grid_mode=True), np.float64)
    yuv = np.stack([planes[:height], *wide], -1)
    rgb = (yuv - _OFFSET) @ np.linalg.inv(_TO_YUV).T
    return np.rint(255 * rgb).clip(0, 255).astype(np.uint8)
