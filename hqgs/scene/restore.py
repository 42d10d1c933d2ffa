"""Restore the training photos with an existing image network before anything is reconstructed."""

from __future__ import annotations

import copy
import hashlib
import importlib.util
import io
import pickle
import struct
import threading
import time
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from torch import Tensor
from tqdm import tqdm

from hqgs.base.threads import of_each, one_torch_thread
from hqgs.photos.pixels import as_floats
from hqgs.photos.resize import resize
from hqgs.scene.scene import Scene, View

if TYPE_CHECKING:
    from spandrel import ImageModelDescriptor

    _Network = ImageModelDescriptor[torch.nn.Module]

RANDOM = ("AuraSR",)  # these networks draw other detail in every view and every run
PICKLED = (".pth", ".pt", ".ckpt")
# What weights or a photo that do not fit raise inside a network of somebody else's, lack of memory included.
NETWORK_ERRORS = (
    RuntimeError, ValueError, TypeError, LookupError, AttributeError, AssertionError, ArithmeticError,
    MemoryError,
)  # fmt: skip


def restore_scene(scene: Scene, weights: str | Path, tile: int = 256, overlap: int = 32) -> Scene:
    """The scene with its training photos as a restoration network gives them back.

    The network, of RGB or grey (which sees each channel), is any that the optional package spandrel knows for
    denoising, deblurring, JPEG or super-resolution. It sees a photo as it was taken: `View.low` where there
    is one, else `View.image`, clipped to [0, 1]. Its output becomes `image`, in that one's type, resized by
    antialiased bicubic where its size is not the camera's. `low`, masks and held-out views stay.

    Photos run in parallel, each on one thread of torch, so that no number of threads changes a bit. The
    result is that of the whole photo where `overlap` covers the network's field of view.

    Args:
        weights: .safetensors, or .pth, .pt, .ckpt, which are read as tensors only: one that holds anything
            that could run is refused.
        tile: px at the network's input; larger photos go through it in tiles. Four times as many where it
            advises against tiles; it makes its own where it says so.
        overlap: px around a tile that it sees too, and whose output is dropped.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: spandrel is missing, the file holds no network that fits, or the network fails on a
            photo, which the message names.
    """
    weights = Path(weights)
    started = time.perf_counter()
    network, digest = _load(weights)
    local = threading.local()

    def restored(view: View) -> View:
        if not hasattr(local, "network"):
            local.network = copy.deepcopy(network)  # some networks keep values of a call in their modules
        try:
            return replace(
                view, image=_restored_image(local.network, view, tile, overlap), film=None, empty=None
            )
        except NETWORK_ERRORS as error:
            height, width = _as_taken(view).shape[:2]
            raise ValueError(
                f"{weights} cannot restore the photo {view.name!r} ({width} x {height} px): {error}"
            ) from error

    with one_torch_thread():
        photos = of_each(restored, scene.train)
        train = list(tqdm(photos, "restore", len(scene.train), unit="photo", disable=None))
    note = (
        f"training photos restored by {network.architecture.name} (scale {network.scale}) from "
        f"{weights.name}, SHA-256 {digest[:12]}, in {time.perf_counter() - started:.1f} s"
    )
    return replace(scene, train=train, notes=[*scene.notes, note])


def check_weights(weights: str | Path) -> None:
    """Tell at once of what would fail after minutes: ValueError without spandrel, FileNotFoundError."""
    if importlib.util.find_spec("spandrel") is None:
        raise ValueError(
            "restoring photos needs the optional package spandrel, which is not installed "
            "(pip install 'hqgs[restore]')"
        )
    if not Path(weights).is_file():
        raise FileNotFoundError(f"there is no file of weights {weights}")


def _load(weights: Path) -> tuple[_Network, str]:
    """The network of a file and the file's SHA-256."""
    check_weights(weights)
    import spandrel  # takes a second, and is optional

    data = weights.read_bytes()
    state = _state_dict(weights, data)
    try:
        network = spandrel.ModelLoader().load_from_state_dict(state)
    except spandrel.UnsupportedModelError as error:
        raise ValueError(f"{weights}: spandrel knows no network with these tensors") from error
    except NETWORK_ERRORS as error:
        raise ValueError(f"{weights}: the tensors do not make up a network: {error}") from error
    invents = network.purpose == "FaceSR" or network.architecture.id in RANDOM
    if not isinstance(network, spandrel.ImageModelDescriptor) or invents:
        raise ValueError(
            f"{weights}: {network.architecture.name} ({network.purpose}) invents detail; wanted "
            "a network for denoising, deblurring, JPEG or super-resolution"
        )
    channels = network.input_channels, network.output_channels
    if channels not in ((3, 3), (1, 1)):
        raise ValueError(
            f"{weights}: {network.architecture.name} turns {channels[0]} channels into {channels[1]}, wanted "
            "3 into 3 or 1 into 1"
        )
    return network.float().eval(), hashlib.sha256(data).hexdigest()


def _state_dict(weights: Path, data: bytes) -> dict[str, Any]:
    """The tensors of a file by name. Nothing in the file is run."""
    suffix = weights.suffix.lower()
    if suffix not in (".safetensors", *PICKLED):
        raise ValueError(f"{weights}: wanted a file that ends in .safetensors, {', '.join(PICKLED)}")
    try:
        if suffix == ".safetensors":
            state = safetensors.torch.load(data)
        else:
            # spandrel's own reader is avoided: it turns torch's restricted unpickler off in favour of its
            # own, and runs TorchScript archives through torch's loader for programs.
            state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except SafetensorError as error:
        raise ValueError(f"{weights} is damaged or no safetensors file: {error}") from error
    except (pickle.UnpicklingError, struct.error, EOFError, *NETWORK_ERRORS) as error:
        raise ValueError(
            f"{weights} is refused: it is damaged, or holds more than tensors, which could run code "
            "(convert weights that you trust to .safetensors)"
        ) from error
    if not isinstance(state, dict):
        raise ValueError(f"{weights} holds a {type(state).__name__}, wanted a dictionary of tensors")
    return state


def _as_taken(view: View) -> NDArray[np.uint8] | NDArray[np.float32]:
    return view.image if view.low is None else view.low


def _restored_image(
    network: _Network, view: View, tile: int, overlap: int
) -> NDArray[np.uint8] | NDArray[np.float32]:
    channels = torch.from_numpy(as_floats(_as_taken(view)).clip(0, 1)).permute(2, 0, 1)[
        :, None
    ]  # [3, 1, h, w]
    images = [channels.transpose(0, 1)] if network.input_channels == 3 else list(channels.split(1))
    restored = torch.cat([_in_tiles(network, image, tile, overlap) for image in images], dim=1)
    out = restored[0].permute(1, 2, 0).numpy()
    if not np.isfinite(out).all():
        raise ValueError("its output holds NaN or Inf")
    if out.shape != view.image.shape:
        out = resize(out, *view.image.shape[:2]).clip(0, 1)
    return np.rint(out * 255).astype(np.uint8) if view.image.dtype == np.uint8 else np.ascontiguousarray(out)


def _in_tiles(network: _Network, image: Tensor, tile: int, overlap: int) -> Tensor:
    """[1, C, h, w] to [1, C, h scale, w scale], tile by tile.

    Tiles start at multiples of what the network wants, so that its windows lie as in the whole photo.
    """
    scale, multiple = network.scale, network.size_requirements.multiple_of
    overlap = -(-overlap // multiple) * multiple
    tile *= 1 if network.tiling.name == "SUPPORTED" else 4
    whole = network.tiling.name == "INTERNAL"
    counts = [1 if whole else -(-length // tile) for length in image.shape[2:]]
    sides = [
        -(-length // (n * multiple)) * multiple for length, n in zip(image.shape[2:], counts, strict=True)
    ]
    out = torch.empty(1, image.shape[1], *(length * scale for length in image.shape[2:]))
    for top, left in product(*(range(0, n, side) for n, side in zip(image.shape[2:], sides, strict=True))):
        y, x = max(top - overlap, 0), max(left - overlap, 0)
        seen = image[:, :, y : top + sides[0] + overlap, x : left + sides[1] + overlap]
        made = network(seen.contiguous())
        wanted = [1, seen.shape[1], seen.shape[2] * scale, seen.shape[3] * scale]
        if [*made.shape] != wanted:
            raise ValueError(f"its output is {[*made.shape]}, wanted {wanted}")
        into = out[:, :, top * scale :, left * scale :][:, :, : sides[0] * scale, : sides[1] * scale]
        inner = made[:, :, (top - y) * scale :, (left - x) * scale :]
        into.copy_(inner[:, :, : into.shape[2], : into.shape[3]])
    return out
