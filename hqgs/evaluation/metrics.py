"""Image metrics of a render against a photo: PSNR, also with aligned colours, SSIM, HaarPSI and LPIPS.

What every metric here shares:

- Images are [H, W, 3] RGB: uint8 (divided by 255), or floats in [0, 1]. Floats outside [0, 1] are clamped
  and are not rounded to 8 bits. NaN and Inf are refused.
- A mask is bool [H, W], True where the photo counts. PSNR leaves the other pixels out. The other metrics
  look at neighbourhoods, so there the photo's pixels are copied into the render before they run.
- A value that does not exist is None, never a stand-in number; `ViewMetrics.reasons` says why.
- The numbers do not depend on the number of threads: torch runs on one, the crate's sums have one order.
"""

from __future__ import annotations

import hashlib
import importlib.util
import math
import sys
import threading
import warnings
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hqgs import _rust
from hqgs.base.state import own_state
from hqgs.base.threads import one_torch_thread

HAARPSI_MIN_SIZE = 16  # px: the coarsest Haar filter
LPIPS_MIN_SIZE = 63  # px: AlexNet's smallest input
_IMPORTING = threading.Lock()

# The files that torchvision keeps its ImageNet weights in; the name ends in the start of the file's SHA-256.
LPIPS_BACKBONES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}


@dataclass(frozen=True)
class ViewMetrics:
    """The metrics of one view, or their means. None: there is no such value, see `reasons`."""

    psnr: float | None  # dB, up
    ssim: float | None  # up
    haarpsi: float | None  # up
    lpips: float | None  # AlexNet, down
    lpips_vgg: float | None  # VGG-16, down
    psnr_aligned: float | None  # dB, up; brightness and tint set aside
    reasons: dict[str, str] = field(default_factory=dict)  # metric -> why it is None
    psnr_shown: float | None = None  # dB; as the scene is shown, where the others are in a camera's look


METRICS = tuple(value.name for value in fields(ViewMetrics) if value.name not in ("reasons", "psnr_shown"))


@own_state(grad=False)
def psnr(render: NDArray[Any], photo: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float | None:
    """-10 log10(MSE) in dB over all channels of the pixels that count.

    None where the images are identical there (the value would be infinite) or where no pixel counts.
    """
    x, y = _pair(render, photo, mask)
    error = (x - y) ** 2 if mask is None else (x - y)[mask] ** 2
    mse = float(error.mean()) if error.size else 0.0
    return -10 * math.log10(mse) if mse > 0 else None


@own_state(grad=False)
def psnr_aligned(
    render: NDArray[Any], photo: NDArray[Any], mask: NDArray[np.bool_] | None = None
) -> float | None:
    """`psnr` of the render times a factor for each channel, the one that brings it nearest to the photo.

    For photos that were each exposed in their own way, also those that a scene is judged by. A gain in linear
    light is nearly a factor of the sRGB values. Never below `psnr`.
    """
    x, y = _pair(render, photo, mask)
    factors = color_factors(x, y, mask)
    return psnr(factors * x, y, mask)


def color_factors(
    render: NDArray[np.float64], photo: NDArray[np.float64], mask: NDArray[np.bool_] | None
) -> NDArray[np.float64]:
    """The factor of each channel [3] that brings a render nearest to its photo, both [H, W, 3] in [0, 1]."""
    told = (render, photo) if mask is None else (render[mask], photo[mask])
    first, second = (image.reshape(-1, 3) for image in told)
    squares, products = (first**2).sum(0), (first * second).sum(0)
    return np.divide(products, squares, out=np.ones(3), where=squares > 0)


@own_state(grad=False)
def ssim(render: NDArray[Any], photo: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float:
    """Structural similarity (Wang et al. 2004), per channel, mean over all pixels and channels.

    The crate's, as in the loss: Gaussian window of 11 x 11 with sigma 1.5, zero padding to the image's own
    size, the convention of the 3D Gaussian Splatting literature. Libraries treat the border differently
    (scikit-image leaves it out or mirrors it, kornia mirrors it), so their values differ a little.
    """
    x, y = _masked_pair(render, photo, mask)
    first, second = (image[0].permute(1, 2, 0).contiguous().numpy() for image in (x, y))
    value = _rust.photometric(first, second, None, 1.0, 0.0, False)[2]
    assert value is not None  # as where the loss has no part of it
    return value


@own_state(grad=False)
def haarpsi(render: NDArray[Any], photo: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float | None:
    """Haar wavelet perceptual similarity (Reisenhofer et al. 2018) in colour; 1 for identical images.

    None where a side is shorter than 16 pixels.
    """
    x, y = _masked_pair(render, photo, mask)
    if min(x.shape[2:]) < HAARPSI_MIN_SIZE:
        return None
    if torch.equal(x, y):
        return 1.0  # the limit; the formula divides 0 by 0 for two black images
    with one_torch_thread(), torch.no_grad():
        return float(_piq_haarpsi()(x, y, data_range=1.0))


@cache
def _piq_haarpsi() -> Any:
    """piq's function without the rest of piq, which imports torchvision: that takes seconds and 200 MB."""
    with _IMPORTING:
        given, spec = sys.modules.get("piq"), importlib.util.find_spec("piq")
        assert spec is not None
        sys.modules["piq"] = given or importlib.util.module_from_spec(spec)  # not executed: a folder alone
        try:
            return importlib.import_module("piq.haarpsi").haarpsi
        finally:
            if given is None:
                del sys.modules["piq"]


@own_state(grad=False)
def lpips(
    render: NDArray[Any], photo: NDArray[Any], mask: NDArray[np.bool_] | None = None, net: str = "alex"
) -> float | None:
    """LPIPS v0.1 (Zhang et al. 2018) with the backbone "alex" or "vgg", inputs scaled to [-1, 1].

    None where `lpips_missing(net)` gives a reason, or where a side is shorter than 63 pixels.
    """
    x, y = _masked_pair(render, photo, mask)
    network = _lpips_network(net)
    if isinstance(network, str) or min(x.shape[2:]) < LPIPS_MIN_SIZE:
        return None
    with one_torch_thread(), torch.no_grad():
        return float(network(2 * x.float() - 1, 2 * y.float() - 1))


def lpips_missing(net: str = "alex") -> str | None:
    """Why LPIPS with this backbone cannot be computed here, or None if it can. Settled once per process."""
    network = _lpips_network(net)
    return network if isinstance(network, str) else None


@own_state(grad=False)
def evaluate_view(
    render: NDArray[Any], photo: NDArray[Any], mask: NDArray[np.bool_] | None = None
) -> ViewMetrics:
    """All metrics of one view; the module's docstring says how images and masks are read."""
    if mask is not None and mask.dtype == np.bool_ and not mask.any():
        _pair(render, photo, mask)
        return _without_values("the mask hides every pixel")
    values = {
        "psnr": psnr(render, photo, mask),
        "ssim": ssim(render, photo, mask),
        "haarpsi": haarpsi(render, photo, mask),
        "lpips": lpips(render, photo, mask, "alex"),
        "lpips_vgg": lpips(render, photo, mask, "vgg"),
        "psnr_aligned": psnr_aligned(render, photo, mask),
    }
    too_small = "the view is shorter than {} pixels on a side"
    reasons = {
        "psnr": "render and photo are identical (infinite PSNR)",
        "haarpsi": too_small.format(HAARPSI_MIN_SIZE),
        "lpips": lpips_missing("alex") or too_small.format(LPIPS_MIN_SIZE),
        "lpips_vgg": lpips_missing("vgg") or too_small.format(LPIPS_MIN_SIZE),
        "psnr_aligned": "render and photo differ only in brightness",
    }
    return ViewMetrics(**values, reasons={m: reasons[m] for m, value in values.items() if value is None})


def mean_metrics(views: list[ViewMetrics]) -> ViewMetrics:
    """The mean of each metric over the views.

    A mean is None if one view lacks the value: a mean over fewer views could not be compared with others.
    """
    if not views:
        return _without_values("there is no held-out photo")
    means: dict[str, float | None] = {}
    reasons: dict[str, str] = {}
    for metric in METRICS:
        values = [getattr(view, metric) for view in views]
        missing = [view.reasons[metric] for view, value in zip(views, values, strict=True) if value is None]
        means[metric] = None if missing else float(np.mean(values))
        if len(missing) == len(views) and len(set(missing)) == 1:
            reasons[metric] = missing[0]
        elif missing:
            counted = [f"{missing.count(why)} of {len(views)} views: {why}" for why in sorted(set(missing))]
            reasons[metric] = "; ".join(counted)
    shown = [view.psnr_shown for view in views if view.psnr_shown is not None]
    as_shown = float(np.mean(shown)) if len(shown) == len(views) else None
    return ViewMetrics(**means, reasons=reasons, psnr_shown=as_shown)


def _without_values(reason: str) -> ViewMetrics:
    return ViewMetrics(None, None, None, None, None, None, dict.fromkeys(METRICS, reason))


def _pair(
    render: NDArray[Any], photo: NDArray[Any], mask: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both images as float64 in [0, 1], [H, W, 3], after the checks."""
    x, y = _unit("render", render), _unit("photo", photo)
    if x.shape != y.shape:
        raise ValueError(f"render has shape {list(x.shape)}, but photo has shape {list(y.shape)}")
    if mask is not None and (mask.dtype != np.bool_ or mask.shape != y.shape[:2]):
        raise ValueError(
            f"mask must be bool of shape {list(y.shape[:2])}, got {mask.dtype} of {list(mask.shape)}"
        )
    return x, y


def _unit(name: str, image: NDArray[Any]) -> NDArray[np.float64]:
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"{name} must have shape [H, W, 3], got {list(image.shape)}")
    if image.dtype == np.uint8:
        return image / 255.0
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(f"{name} must be uint8 or floating point, got {image.dtype}")
    bad = image.size - int(np.isfinite(image).sum())
    if bad:
        raise ValueError(f"{name} has {bad} values that are NaN or Inf (of {image.size})")
    return np.clip(image.astype(np.float64), 0.0, 1.0)


def _masked_pair(
    render: NDArray[Any], photo: NDArray[Any], mask: NDArray[np.bool_] | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Both images as float64 [1, 3, H, W], the render equal to the photo where the mask is False."""
    x, y = _pair(render, photo, mask)
    if mask is not None:
        x = np.where(mask[..., None], x, y)
    as_batch = [torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None] for image in (x, y)]
    return as_batch[0], as_batch[1]


@cache
def _lpips_network(net: str) -> torch.nn.Module | str:
    """The LPIPS network, or why there is none. Only weights that are already on this machine are used."""
    if net not in LPIPS_BACKBONES:
        raise ValueError(f'net must be "alex" or "vgg", got {net!r}')
    if importlib.util.find_spec("lpips") is None:
        return "the optional package lpips is not installed (pip install 'hqgs[lpips]')"
    backbone = LPIPS_BACKBONES[net]
    path = Path(torch.hub.get_dir()) / "checkpoints" / backbone
    if not path.is_file():
        return f"the backbone weights {backbone} are not in torch's checkpoint folder"
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    if not digest.hexdigest().startswith(path.stem.rsplit("-", 1)[1]):
        return f"the backbone weights {backbone} are damaged (SHA-256 starts with {digest.hexdigest()[:8]})"
    try:
        lpips_package = importlib.import_module("lpips")
    except ImportError as error:
        return f"the optional package lpips cannot be imported ({error})"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # lpips 0.1.4 uses torchvision's older arguments
        return lpips_package.LPIPS(net=net, verbose=False).eval()
