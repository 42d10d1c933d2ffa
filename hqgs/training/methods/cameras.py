"""What each photo's camera did, learned with the scene: its trajectory in the exposure time, lens and gains;
and what cameras do to all of their photos, vignetting and response.

One render, warped along the trajectory and over the lens (`take_photo`), stands for the whole exposure. What
photos cannot tell is fixed by construction: the mean of a trajectory is the photo's pose, the mean of the log
gains is that which they start with, that of the responses is 0. Nor can they tell how bright the scene is
where lenses are dark: it is shown as the mean camera has it (`hqgs.photos.look`), with bright
corners, and as bright as the photos are in the mean.

A thin lens is two numbers (slope, offset), px: a point of nearness n, which is its inverse depth with 1 at
the photo's median, becomes a disc of radius |slope n + offset|. In focus is n = -offset / slope; the sign of
both says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs import _rust
from hqgs.base.elementary import exp
from hqgs.diagnosis.colors import Devices
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import nearness_map
from hqgs.photos.formation import GOLDEN
from hqgs.photos.look import MOST_GAIN, Look, as_a_lens, as_responses, darken, falloff, respond, squared_radii
from hqgs.scene.geometry import median_depth
from hqgs.scene.scene import Camera, Scene, View


def take_photo(
    image: Tensor, size: tuple[int, int], nearness: Tensor | None, warps: Tensor, gains: Tensor
) -> Tensor:
    """The photo [H, W, 3] of a render [H + 2 m, W + 2 m, 3] with a margin of m px; sRGB values, white at 1.

    `gains` times the mean over `warps` of the render's light. Each warp [3, 4] is a matrix less the identity
    that takes a pixel of the photo (x, y, 1, nearness) to where the render shows it, (x, y, 1) times w > 0;
    pixels' centres lie at halves. Beyond its border the render goes on as it ends.

    Args:
        image: float32 or float64.
        size: (H, W).
        nearness: [H, W], the inverse depth that the warps refer to, of the image's dtype; gets no gradient.
            None: 0.
        warps: [K, 3, 4], float64; with K = 0 the picture stands still.
        gains: [3], float64, of red, green and blue in linear light.

    Raises:
        ValueError: a wrong shape, dtype or value, with its name.
    """
    return _TakePhoto.apply(image, size, nearness, warps, gains)


class _TakePhoto(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, size, nearness, warps: Tensor, gains: Tensor) -> Tensor:
        near = None if nearness is None else nearness.detach().contiguous().numpy()
        state, photo = _rust.exposure_forward(
            image.detach().contiguous().numpy(),
            list(size),
            near,
            warps.detach().contiguous().numpy(),
            gains.detach().tolist(),
        )
        ctx.state, ctx.shape = state, image.shape
        return torch.from_numpy(photo).view(*size, 3)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's own is too general)
        ctx: Any, v_photo: Tensor
    ) -> tuple[Tensor, None, None, Tensor, Tensor]:
        v_image, v_warps, v_gains = _rust.exposure_backward(ctx.state, v_photo.contiguous().numpy())
        return (
            torch.from_numpy(v_image).view(ctx.shape),
            None,
            None,
            torch.from_numpy(v_warps).view(-1, 3, 4),
            torch.tensor(v_gains, dtype=torch.float64),
        )


SHORTEST_TRAJECTORY = 0.7  # px, of the picture's middle, and the widest disc: a photo with less is sharp
TRAJECTORY_POINTS = 9  # that stand for a trajectory
KEPT = 8  # maps of squared radii; photos may each have a camera of their own
LENS_NEAREST, LENS_FARTHEST = 2.0, 0.3  # nearness of what photos show, as far as sizes of discs go


@dataclass(frozen=True)
class Shot:
    """How a view is rendered, and what makes the render a photo."""

    camera: Camera
    develop: Callable[[Tensor], Tensor]  # [H + 2 margin, W + 2 margin, 3] to [H, W, 3]


@dataclass(frozen=True)
class LearnedCamera:
    """What was found of a photo's camera."""

    name: str
    trajectory: NDArray[np.float64]  # [9, 2], px: of the picture's middle during the exposure; of mean 0
    gains: NDArray[np.float64]  # [3], of red, green and blue in linear light
    lens: NDArray[np.float64]  # [2], px: of a thin lens: slope and offset
    vignetting: NDArray[np.float64]  # [2] and
    response: NDArray[np.float64]  # [2, 3], as `hqgs.photos.look` has them

    @property
    def look(self) -> Look:
        return Look(self.gains, self.vignetting, self.response)

    @property
    def defocus(self) -> float:
        """Radius of the largest disc that a point becomes, px."""
        return widest(*self.lens)

    @property
    def focus(self) -> float | None:
        """Where the photo is sharp, 1 at its median depth; None: nowhere, or all of it."""
        return sharp_at(*self.lens)

    @property
    def extent(self) -> float:
        """The longest distance of two points of the trajectory, px."""
        return float(np.linalg.norm(self.trajectory[:, None] - self.trajectory, axis=-1).max())


class LearnedCameras:
    """The cameras of a scene's training photos; `devices`: what those do to all of their photos.

    A trajectory is a polynomial: in t from -1/2 to 1/2, t v + 4 (t^2 - mean t^2) c, where v and c turn and
    move in all six freedoms. Turns are in px of the picture's middle, moves in px at the photo's median
    depth.
    """

    def __init__(
        self,
        scene: Scene,
        shake: bool,
        focus: bool,
        log_gains: NDArray[np.float64] | None,
        seed: int,
        devices: LearnedDevices | None = None,
    ) -> None:
        """`log_gains` [N, 3] of the training photos: to start from, and their mean stays.

        None: all gains are 1 and stay so.
        """
        views = scene.train
        self._numbers = {view.name: k for k, view in enumerate(views)}
        self._depths = [median_depth(scene, view) for view in views]
        self._widths = [max(view.camera.width, 200) for view in views]
        self._sizes = [(view.camera.height, view.camera.width) for view in views]
        rng, count = np.random.default_rng([seed, 6]), len(views)
        # In widths of the photo: from 0 a trajectory has no direction to grow in, nor has a lens.
        first = 1e-3 * rng.normal(size=(count, 2, 6)) * np.array([1, 1, 0.2, 0.2, 0.2, 0.2])
        self._paths = [
            torch.from_numpy(path * width).requires_grad_()
            for path, width in zip(first if shake else [], self._widths, strict=False)
        ]
        self._gains = [
            torch.from_numpy(gains.copy()).requires_grad_()
            for gains in (log_gains if log_gains is not None else [])
        ]
        self._mean = torch.stack([gains.detach() for gains in self._gains] or [torch.zeros(3)]).mean(0)
        self._lenses = [  # all of the photo out of focus alike, by little
            torch.tensor([0.0, 0.0015 * width], dtype=torch.float64, requires_grad=True)
            for width in (self._widths if focus else [])
        ]
        self._nearness: list[Tensor | None] = [None] * count
        self._visits = torch.zeros(count, dtype=torch.int64)
        self._still = torch.full((count,), not shake)
        self._sharp = torch.full((count,), not focus)
        self._active = False
        self._begin, self._looks = 0, (0, 0)
        self._devices = devices

    def schedule(self, iterations: int) -> None:
        """Of a run of this length."""
        self._begin = round(0.1 * iterations)  # before, trajectories would hide what the scene does not show
        self._looks = round(0.5 * iterations), round(0.75 * iterations)  # at which short ones are given up

    def shot(self, view: View, photo: Tensor) -> Shot:
        """Of a training view."""
        number, camera = self._numbers[view.name], view.camera
        size = camera.height, camera.width
        blurs = self._active and self._blurs(number) and self._sizes[number] == size
        if not blurs and not self._gains and self._devices is None:
            return Shot(camera, lambda render: render)
        warps, margin = torch.zeros(0, 3, 4, dtype=torch.float64), 0
        if blurs:
            warps = self._warps(number, camera)
            reach = float(_moved(warps.detach(), camera, nearness=2.0).abs().max())
            margin = min(4 * math.ceil((reach + 1) / 4), 48)
        K = camera.K.copy()
        K[:2, 2] += margin
        wide = Camera(camera.width + 2 * margin, camera.height + 2 * margin, K, camera.viewmat)
        near = self._nearness[number] if blurs else None

        def develop(render: Tensor) -> Tensor:
            gains = self._own_gains(number)
            full = None if near is None else _enlarged(near, size).to(render)
            taken = take_photo(render, size, full, warps, gains)
            if self._devices is not None:
                taken = self._devices.develop(number, camera, taken)
            exposed = self._gains or self._devices is not None
            return as_held(taken, photo) if exposed and photo.shape == taken.shape else taken

        return Shot(wide, develop)

    def after_step(self, iteration: int, view: View, gaussians: Gaussians) -> None:
        """What ages, and which photos stand still from now on."""
        number = self._numbers[view.name]
        if self._gains:
            _center(self._gains, self._mean)
        if self._devices is not None:
            self._devices.center()
        if not self._paths and not self._lenses:
            return
        self._active = iteration >= self._begin
        if not self._active:
            return
        if self._blurs(number):
            if self._visits[number] % 8 == 0:
                near = nearness_map(gaussians, view.camera, coarser=4) * self._depths[number]
                self._nearness[number] = near.clamp(0.05, 10).to(torch.float16)
            self._visits[number] += 1
        if iteration in self._looks:
            for k, path in enumerate(self._paths):
                self._still[k] |= _longest(_middle(path)) < SHORTEST_TRAJECTORY
            for k, lens in enumerate(self._lenses):
                self._sharp[k] |= widest(*lens.tolist()) < SHORTEST_TRAJECTORY / 2
            for k in range(len(self._nearness)):
                if not self._blurs(k):
                    self._nearness[k] = None

    def learned(self) -> list[LearnedCamera]:
        """For each training photo."""
        none = np.zeros(2), np.zeros((2, 3))
        return [
            LearnedCamera(
                name,
                np.zeros((TRAJECTORY_POINTS, 2)) if self._still[k] else _middle(self._paths[k]).numpy(),
                self._own_gains(k).detach().numpy(),
                np.zeros(2) if self._sharp[k] else self._lenses[k].detach().numpy().copy(),
                *(none if self._devices is None else self._devices.learned(k)),
            )
            for name, k in self._numbers.items()
        ]

    def param_groups(self) -> list[dict[str, Any]]:
        names = {"path": "paths", "lens": "lenses"}
        return [
            {"name": names.get(name, name), "params": params, "lr": 0.0, "betas": (0.9, 0.99)}
            for name, params in self._named().items()
            if params
        ]

    def rates(self, part: float) -> dict[str, float]:
        """Learning rates after this part of the run; at its end they are a tenth of the first."""
        width, trained = float(np.mean(self._widths)), {group["name"] for group in self.param_groups()}
        first = {"paths": 8e-4 * width, "lenses": 4e-4 * width, "gains": 0.005}
        # which each photo of a camera moves; a scene takes over some of its lenses' fall where it can
        first |= {"vignetting": 0.0003, "response": 0.001}
        return {name: rate * 0.1**part for name, rate in first.items() if name in trained}

    def state_dict(self) -> dict[str, Tensor]:
        state = {"visits": self._visits, "still": self._still, "sharp": self._sharp}
        state |= {"active": torch.tensor(self._active)}
        state |= {f"{name}.{k}": v.detach() for name, of in self._named().items() for k, v in enumerate(of)}
        return state | {f"near.{k}": near for k, near in enumerate(self._nearness) if near is not None}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._visits = state["visits"].clone()
        self._still, self._sharp = state["still"].clone(), state["sharp"].clone()
        self._active = bool(state["active"])
        with torch.no_grad():
            for name, values in self._named().items():
                for k, value in enumerate(values):
                    value.copy_(state[f"{name}.{k}"])
        self._nearness = [state.get(f"near.{k}") for k in range(len(self._nearness))]

    def _named(self) -> dict[str, list[Tensor]]:
        """What is trained, as a checkpoint names it."""
        own = {"path": self._paths, "lens": self._lenses, "gains": self._gains}
        return own if self._devices is None else own | self._devices.named()

    def _own_gains(self, number: int) -> Tensor:
        """Of the photo of this number, [3]."""
        logs = self._gains[number] if self._gains else torch.zeros(3, dtype=torch.float64)
        return exp(logs if self._devices is None else logs + self._devices.level())

    def _blurs(self, number: int) -> bool:
        """Whether a photo's camera moved or was out of focus."""
        return not (self._still[number] and self._sharp[number])

    def _warps(self, number: int, camera: Camera) -> Tensor:
        """As `take_photo` takes them, [K, 3, 4], as many as it needs; nearness is 1 at the median depth."""
        count, still, sharp = 0, bool(self._still[number]), bool(self._sharp[number])
        if not still:
            with torch.no_grad():
                whole = _trajectory_warps(self._paths[number], camera, TRAJECTORY_POINTS)
                moved = _moved(whole, camera, nearness=1.0)
            extent = max(_longest(moved[:, k]) for k in range(moved.shape[1]))
            count = min(max(3, math.ceil(extent / 1.5) + 1), 17)  # one for 1.5 px
        if not sharp:
            count = max(count, samples(self._lenses[number]))
        warps = torch.zeros(count, 3, 4, dtype=torch.float64)
        if not still:
            warps = warps + _trajectory_warps(self._paths[number], camera, count)
        if not sharp:
            warps = warps + lens_warps(self._lenses[number], count)
        return warps


def as_held(taken: Tensor, photo: Tensor) -> Tensor:
    """What was taken, [H, W, 3], where the photo is not saturated: what its sensor could not hold may be
    brighter."""
    saturated = photo >= (254 / 255 if photo.is_floating_point() else 254)
    return torch.where(saturated & (taken > 1), 1.0, taken)


def no_shot(view: View) -> Shot:
    """That of a still camera with gains of 1."""
    return Shot(view.camera, lambda render: render)


def _steps(path: Tensor, count: int) -> Tensor:
    """Where a trajectory is in the middles of `count` equal parts of the exposure, [count, 6]; of mean 0."""
    t = (torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5
    square = t.square()
    return t[:, None] * path[0] + 4 * (square - square.mean())[:, None] * path[1]


def _trajectory_warps(path: Tensor, camera: Camera, count: int) -> Tensor:
    """Warps of a camera that goes along a trajectory, [count, 3, 4]."""
    steps, focal, K = _steps(path, count), float(camera.K[0, 0]), torch.from_numpy(camera.K)
    turned = K @ _turns(steps[:, :3] / focal) @ torch.linalg.inv(K)
    moved = steps[:, 3:] @ (K / focal).T
    return torch.cat([turned, moved[:, :, None]], dim=2)


@torch.no_grad()
def _center(tensors: Sequence[Tensor], wanted: Tensor) -> None:
    """Give these log gains this mean; none is more than MOST_GAIN."""
    shift = torch.stack([*tensors]).mean(0) - wanted
    for tensor in tensors:
        tensor -= shift
        tensor.clamp_(-MOST_GAIN, MOST_GAIN)


def _middle(path: Tensor) -> Tensor:
    """The trajectory of the picture's middle at the median depth, px, [9, 2]."""
    steps = _steps(path.detach(), TRAJECTORY_POINTS)
    return torch.stack([steps[:, 1] + steps[:, 3], steps[:, 4] - steps[:, 0]], dim=1)


def _longest(points: Tensor) -> float:
    """Distance of two of the points [K, 2]."""
    return float((points[:, None] - points).norm(dim=-1).max())


def _turns(vectors: Tensor) -> Tensor:
    """Rotations less the identity by small vectors [K, 3], to third order, [K, 3, 3]."""
    x, y, z = vectors.unbind(1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
    square = cross @ cross
    return cross + square / 2 + square @ cross / 6


def _moved(warps: Tensor, camera: Camera, nearness: float) -> Tensor:
    """How far warps take the corners and the middle of a picture, px, [K, 5, 2]."""
    w, h = camera.width, camera.height
    corners = [[x, y, 1.0, nearness] for x, y in ((0, 0), (w, 0), (0, h), (w, h), (w / 2, h / 2))]
    points = torch.tensor(corners, dtype=torch.float64)
    e = points @ warps.transpose(1, 2)  # [K, 5, 3]
    return (e[..., :2] - points[:, :2] * e[..., 2:]) / (1 + e[..., 2:])


def _enlarged(near: Tensor, size: tuple[int, int]) -> Tensor:
    """A map [h, w] at the photo's size."""
    return torch.nn.functional.interpolate(near.float()[None, None], size, mode="bilinear")[0, 0]


class LearnedDevices:
    """The cameras of a scene's training photos."""

    def __init__(self, first: Devices, vignetting: bool, response: bool) -> None:
        """`vignetting` and `response`: which of them is learned; what is not does nothing."""
        self._of_photo = first.of_photo
        self._vignetting = _trained(first.vignetting if vignetting else [])
        self._response = _trained(first.response if response else [])
        counts = np.bincount(first.of_photo[first.of_photo >= 0], minlength=len(first))
        self._shares = torch.from_numpy(counts / max(counts.sum(), 1))
        self._told = counts.sum() / max(len(first.of_photo), 1)  # share of the photos that have a camera
        self._squares = lru_cache(KEPT)(_squares)
        self.center()

    def level(self) -> Tensor:
        """The mean of the logarithm of what lenses keep from photos: gains beside it leave their mean."""
        if not self._vignetting:
            return torch.zeros((), dtype=torch.float64)
        # Means of r^2 and r^4 over a picture, the latter 0.156 (a square) to 0.168 (16:9).
        means = torch.stack([*self._vignetting]) @ torch.tensor([1 / 3, 0.16], dtype=torch.float64)
        return self._told * (self._shares * means).sum()

    def develop(self, number: int, camera: Camera, taken: Tensor) -> Tensor:
        """The photo of this number of what was taken without its camera's faults, [H, W, 3]."""
        device = int(self._of_photo[number])
        if device < 0:
            return taken
        planes = taken.permute(2, 0, 1).contiguous()  # a factor of a channel, or of a pixel, is quicker so
        if self._vignetting:
            height, width = taken.shape[:2]
            center = float(camera.K[0, 2]), float(camera.K[1, 2])
            squares = self._squares(height, width, center, taken.dtype)
            planes = darken(planes, falloff(squares, self._vignetting[device].to(taken.dtype)))
        if self._response:
            planes = respond(planes, self._response[device])
        return planes.permute(1, 2, 0).contiguous()

    @torch.no_grad()
    def center(self) -> None:
        """What photos cannot tell stays, light falls towards corners, and responses rise: after each step."""
        for vignetting in self._vignetting:
            vignetting.copy_(torch.from_numpy(as_a_lens(vignetting.numpy())))
        if not self._response:
            return
        each = torch.stack([*self._response])
        each -= (self._shares[:, None, None] * each).sum(0)
        for response, value in zip(self._response, as_responses(each.numpy()), strict=True):
            response.copy_(torch.from_numpy(value))

    def learned(self, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Vignetting [2] and response [2, 3] of the photo's camera."""
        device = int(self._of_photo[number])
        vignetting, response = np.zeros(2), np.zeros((2, 3))
        if device >= 0 and self._vignetting:
            vignetting = self._vignetting[device].detach().numpy().copy()
        if device >= 0 and self._response:
            response = self._response[device].detach().numpy().copy()
        return vignetting, response

    def named(self) -> dict[str, list[Tensor]]:
        """What is trained."""
        return {"vignetting": self._vignetting, "response": self._response}


def _squares(height: int, width: int, center: tuple[float, float], dtype: torch.dtype) -> Tensor:
    """r^2 of each pixel of photos with this principal point, [H, W]."""
    K = np.eye(3)
    K[:2, 2] = center
    return torch.from_numpy(squared_radii(height, width, K)).to(dtype)


def _trained(values: Iterable[NDArray[np.float64]]) -> list[Tensor]:
    return [torch.from_numpy(value.copy()).requires_grad_() for value in values]


def widest(slope: float, offset: float) -> float:
    """The largest radius, px."""
    return max(abs(slope * n + offset) for n in (LENS_NEAREST, LENS_FARTHEST))


def sharp_at(slope: float, offset: float) -> float | None:
    """The depth in focus, 1 at the photo's median; None: all that photos show is in focus, or nothing."""
    near = -offset / slope if slope else 0.0
    return 1 / near if LENS_FARTHEST <= near <= LENS_NEAREST else None


def samples(lens: Tensor) -> int:
    """How many points of the lens stand for all of it: one for 2.5 px of the largest disc."""
    return min(max(6, math.ceil(math.pi * widest(*lens.tolist()) ** 2 / 2.5)), 24)


def lens_warps(lens: Tensor, count: int) -> Tensor:
    """Warps for `take_photo` of `count` points of the lens, [count, 3, 4]: shifts that go with nearness."""
    shifts = _sunflower(count)
    warps = torch.zeros(count, 3, 4, dtype=torch.float64)
    warps[:, :2, 2] = shifts * lens[1]
    warps[:, :2, 3] = shifts * lens[0]
    return warps


def _sunflower(count: int) -> Tensor:
    """Points spread evenly over the unit disc, [count, 2], of mean 0.

    Neighbours in the list lie far apart: the same warps may stand for a trajectory, one moment after another.
    """
    k = torch.arange(count, dtype=torch.float64)
    order = (k * (GOLDEN / (2 * math.pi)) % 1).argsort().double()
    radii, angles = ((order + 0.5) / count).sqrt(), GOLDEN * order
    points = torch.stack([radii * angles.cos(), radii * angles.sin()], 1)
    points -= points.mean(0)
    return points * (0.5 / points.square().sum(1).mean()).sqrt()  # the second moment of a disc
