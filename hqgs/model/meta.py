"""What the rasterizer knows beside its images: packed as gsplat has it, and made when it is asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.base.state import own_state
from hqgs.model.autograd import as_array, first_derivative

_TILE_LISTS = ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets")


class RasterizationMeta(TypedDict):
    """What `rasterization` knows beside its images, of N Gaussians in C cameras.

    Packed, [C, N] is [M]: the pairs of camera and Gaussian that are not culled, by camera, then Gaussian.
    """

    means2d: Tensor  # [C, N, 2], pixels; call `.retain_grad()` on it to get its gradient
    radii: Tensor  # [C, N, 2], int32, pixels; 0 where culled
    depths: Tensor  # [C, N], world units along the viewing axis
    conics: Tensor  # [C, N, 3], 1/px^2: the inverse 2D covariance's xx, xy, yy
    opacities: Tensor  # [C, N], after the compensation of "antialiased"
    batch_ids: Tensor | None  # [M], int64, the scene of each pair, all three None where nothing is packed
    camera_ids: Tensor | None  # [M], the camera
    gaussian_ids: Tensor | None  # [M], the Gaussian
    width: int
    height: int
    tile_size: int
    tile_width: int  # tiles in a row of the image
    tile_height: int
    n_batches: int
    n_cameras: int
    work: tuple[int, int]  # pairs of Gaussian and tile, blocks evaluated


class Later:
    """A value of the meta data that is made when somebody asks for it."""

    def __init__(self, make: Callable[..., Tensor], *arguments: Any) -> None:
        self.make: Callable[..., Tensor] = make
        self.arguments: tuple[Any, ...] = arguments


class Meta(dict[str, Any]):
    """A dictionary whose values may be `Later`, and that says of gsplat's other keys that they are not there.

    Its copies are plain dictionaries.
    """

    def __missing__(self, key: str) -> Any:
        if key in _TILE_LISTS:
            raise KeyError(f"{key}: hqgs returns no tile lists")
        raise KeyError(key)

    def __getitem__(self, key: str) -> Any:
        value = super().__getitem__(key)
        if isinstance(value, Later):
            with own_state(grad=True):
                self[key] = value = value.make(*value.arguments)
        return value

    def __iter__(self) -> Iterator[str]:  # as it is; but `dict(meta)` and `**meta` then ask for each value
        return super().__iter__()

    def get(self, key: str, default: Any = None) -> Any:
        return self[key] if key in self else default  # noqa: SIM401  (it is `get`)

    def pop(self, key: str, *default: Any) -> Any:
        self.get(key)
        return super().pop(key, *default)

    def copy(self) -> dict[str, Any]:
        return {key: self[key] for key in self}

    def items(self) -> Any:
        return self.copy().items()

    def values(self) -> Any:
        return self.copy().values()

    def __or__(self, other: Any) -> Any:
        return self.copy() | other

    def __ror__(self, other: Any) -> Any:
        return other | self.copy()

    def __repr__(self) -> str:
        return repr(self.copy())

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (self.copy(),)


class Pairs:
    """The pairs of scene, camera and Gaussian that are not culled, in this order; of the splats of each scene
    the `radii` [C, N, 2] are 0 where culled, and the `frame` has counted the others.

    Nothing is gathered until the meta data are read: the gradient of the positions goes past `means2d`.
    """

    def __init__(self, scenes: Sequence[dict[str, Any]]) -> None:
        self._radii: list[Tensor] = [splats["radii"] for splats in scenes]
        self.shape: torch.Size = self._radii[0].shape[:2]
        self.counts: list[int] = [splats["frame"].projected for splats in scenes]
        self.asked: bool = False  # for `means2d`

    @cached_property
    def where(self) -> list[NDArray[np.intp]]:
        """Of each scene, as numbers of the C * N."""
        # Both radii of a pair at once.
        return [np.flatnonzero(as_array(radii).view(np.int64)) for radii in self._radii]

    def ids(self, kind: int) -> Tensor:
        """The scene, the camera or the Gaussian of each pair, [M]."""
        found = [(np.full(len(k), b), *divmod(k, max(self.shape[1], 1))) for b, k in enumerate(self.where)]
        return torch.from_numpy(np.concatenate([each[kind] for each in found]).astype(np.int64, copy=False))

    def take(self, arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Of arrays [C, N, ...], one of each scene, the values of the pairs, [M, ...]."""
        found = [a.reshape(-1, *a.shape[2:])[k] for a, k in zip(arrays, self.where, strict=True)]
        return found[0] if len(found) == 1 else np.concatenate(found)

    def packed(self, *tensors: Tensor) -> Tensor:
        """The same with gradients."""
        return _Packed.apply(self, True, *tensors)

    def positions(self, *tensors: Tensor) -> Tensor:
        """Such a tensor of `means2d` that holds no numbers yet."""
        return _Packed.apply(self, False, *tensors)

    def shown(self, positions: Tensor, *tensors: Tensor) -> Tensor:
        """`positions` with its numbers. From now on the gradient comes by way of it: it can be kept."""
        if not self.asked:
            self.asked = True
            positions.detach().numpy()[...] = self.take([as_array(tensor) for tensor in tensors])
        return positions


class OfScene:
    """The pairs of one scene."""

    def __init__(self, pairs: Pairs, scene: int) -> None:
        self._pairs, self._scene = pairs, scene

    @property
    def asked(self) -> bool:
        return self._pairs.asked

    def of(self, tensor: Tensor | None) -> Tensor | None:
        """Rows of the pairs of a tensor [C, N, 2]."""
        if tensor is None:
            return None
        return torch.from_numpy(as_array(tensor).reshape(-1, 2)[self._pairs.where[self._scene]])


class _Packed(torch.autograd.Function):
    """Rows of the pairs."""

    @staticmethod
    def forward(ctx: Any, pairs: Pairs, filled: bool, *tensors):
        ctx.state, ctx.shape = pairs, tensors[0].shape
        ctx.set_materialize_grads(False)
        if filled:
            return torch.from_numpy(pairs.take([as_array(tensor) for tensor in tensors]))
        rest = tensors[0].shape[2:]
        return torch.from_numpy(np.empty((sum(pairs.counts), *rest), as_array(tensors[0]).dtype))

    @staticmethod
    @first_derivative
    def backward(ctx: Any, *grads):
        if grads[0] is None:
            return None, None, *[None] * len(ctx.state.counts)
        array, found, begin = as_array(grads[0]), [], 0
        for where in ctx.state.where:
            dense = np.zeros((ctx.shape[0] * ctx.shape[1], *ctx.shape[2:]), array.dtype)
            dense[where] = array[begin : begin + len(where)]
            begin += len(where)
            found.append(torch.from_numpy(dense).view(ctx.shape))
        return None, None, *found
