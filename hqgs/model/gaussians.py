"""The Gaussians as trainable tensors: how they start, how they look from a camera, and their files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hqgs._rust import EPS2D, NEAR_PLANE
from hqgs.base.elementary import exp
from hqgs.base.files import PLY
from hqgs.base.state import own_state
from hqgs.base.threads import one_torch_thread
from hqgs.model.constants import MAX_SH_DEGREE, SH_C0
from hqgs.model.formats.arrays import TENSORS, Arrays, whole_rows
from hqgs.model.formats.files import format_of, read_scene, scene_file, write_scene
from hqgs.model.rasterization import RasterizationMeta, rasterization
from hqgs.photos.pixels import png
from hqgs.scene.camera_files import RunCameras, first_camera, moved_along
from hqgs.scene.constants import BACKGROUND, SMALLEST, USUAL
from hqgs.scene.paths import UP, circle, orbit_cameras
from hqgs.scene.scene import Camera
from hqgs.scene.world import World

NEAREST = 3  # neighbours whose distances give a point's scale


@dataclass(repr=False)
class Gaussians:
    """N Gaussians before their activations: exp for the scales, the sigmoid for the opacities.

    The tensors are float32 leaves while they are trained. A method may also hand out a set whose tensors
    are functions of trained ones.
    """

    means: Tensor  # [N, 3], world units
    scales: Tensor  # [N, 3], log of the standard deviations
    quats: Tensor  # [N, 4], w x y z, any non-zero norm
    opacities: Tensor  # [N], logits
    sh0: Tensor  # [N, 1, 3], the SH coefficient of degree 0
    shN: Tensor  # noqa: N815  [N, K - 1, 3], the higher coefficients; K = (sh_degree + 1)^2
    look: Camera | None = field(default=None, kw_only=True, compare=False)  # for notebooks; in no file
    world: World = field(default_factory=World, kw_only=True, compare=False)  # the frame of its files
    antialiased: bool = field(default=False, kw_only=True, compare=False)  # rendered with that compensation
    errors: Tensor | None = field(default=None, kw_only=True, compare=False)  # [N], of trust, white is 1
    # Of the file it was read from.
    notes: list[str] = field(default_factory=list, kw_only=True, compare=False)
    # See `moved_along`.
    moved: NDArray[np.float64] | None = field(default=None, kw_only=True, compare=False)

    def __post_init__(self) -> None:
        n = self.means.shape[0] if self.means.ndim else 0
        wanted = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4), "opacities": (n,), "sh0": (n, 1, 3)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {list(getattr(self, name).shape)}, wanted {list(shape)}")
        sizes = [(degree + 1) ** 2 - 1 for degree in range(MAX_SH_DEGREE + 1)]
        if self.shN.ndim != 3 or self.shN.shape[::2] != (n, 3) or self.shN.shape[1] not in sizes:
            raise ValueError(f"shN has shape {list(self.shN.shape)}, wanted [{n}, one of {sizes}, 3]")

    def __repr__(self) -> str:
        return f"Gaussians({len(self)}, sh_degree={self.sh_degree})"

    def _repr_png_(self) -> bytes | None:
        """The picture that a notebook shows: from `look`, or of the whole scene; None where it is empty."""
        try:
            camera = self.look or around(self.means, self.opacities, 4, self.world.up or UP, None)[0]
        except ValueError:
            return None
        with torch.no_grad():
            return png(self.render(camera))

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """The degree that the coefficients reach, 0..3."""
        return math.isqrt(self.shN.shape[1] + 1) - 1

    def finite(self) -> Tensor:
        """Which hold no NaN or Inf in any tensor, bool [N]."""
        return torch.from_numpy(whole_rows(self.arrays()))

    def named(self) -> dict[str, Any]:
        """The tensors by name, in the order of the fields."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.compare}

    def like(self, tensors: dict[str, Any]) -> Gaussians:
        """Others with these tensors, in the same frame and seen in the same way."""
        fits = self.errors is not None and len(self.errors) == len(tensors["means"])
        return replace(self, **tensors, errors=self.errors if fits else None)

    def in_world(self, world: World) -> Gaussians:
        """The same scene, held in another frame, such as that of its photos' cameras (`Scene.world`)."""
        if self.world.frame == world.frame:
            return self
        means = self.world.to(world, self.means.detach().double().numpy())
        grown = math.log(self.world.unlike(world) * self.world.unit / world.unit)
        held: dict[str, Any] = {
            "means": torch.from_numpy(means).to(self.means.dtype),
            "scales": self.scales + grown,
        }
        return replace(self, **held, world=world, look=None)

    def along(self, known: RunCameras | None) -> RunCameras | None:
        """The cameras that lie beside the scene's file, in the frame in which the scene is held.

        A file that says no frame may have lost what lay beside it: cameras stay where they show more of it.
        """
        if known is None:
            return None
        there = moved_along(known, self.world, self.moved)
        if there is known or self.moved is not None or self.world != World():
            return there
        few = self._few()
        from hqgs.scene.geometry import in_frame  # here: it loads SciPy, which rendering needs nowhere else

        return max((there, known), key=lambda one: sum(in_frame(c, few).sum() for c in one.train))

    def near_plane(self) -> float:
        """What is nearer to a camera is not rendered: NEAR_PLANE, or less where its size is not ordinary."""
        few = self._few()
        size = float(np.median(np.linalg.norm(few - np.median(few, axis=0), axis=1))) if len(few) else 0
        return NEAR_PLANE if not 0 < size < SMALLEST else NEAR_PLANE * 2.0 ** round(math.log2(size / USUAL))

    def _few(self) -> NDArray[np.float64]:
        few = self.means.detach()[:: max(1, len(self) // 4096)].double().numpy()
        return few[np.isfinite(few).all(1)]

    def detached(self) -> Gaussians:
        """The same values (shared memory) without a gradient history."""
        return self.like({name: tensor.detach() for name, tensor in self.named().items()})

    def rows(self, chosen: Tensor) -> Gaussians:
        """Some of them: `chosen` bool [N], or the rows' numbers [M]."""
        rows = {name: tensor[chosen] for name, tensor in self.named().items()}
        return replace(self, **rows, errors=None if self.errors is None else self.errors[chosen])

    def arrays(self) -> Arrays:
        """The same values (shared memory) as numpy arrays, by the names of the fields."""
        arrays = cast(Arrays, {name: tensor.detach().numpy() for name, tensor in self.named().items()})
        if self.world != World():
            arrays["world"] = self.world
        if self.antialiased:
            arrays["antialiased"] = True
        if self.errors is not None:
            arrays["errors"] = self.errors.numpy()
        return arrays

    def activated_scales(self) -> Tensor:
        """Standard deviations [N, 3] in world units."""
        return exp(self.scales)

    def activated_opacities(self) -> Tensor:
        """Opacities [N] in (0, 1)."""
        return torch.sigmoid(self.opacities)

    @own_state()
    def render(
        self, camera: Camera, *, background: Sequence[float] = BACKGROUND, sh_degree: int | None = None
    ) -> Tensor:
        """The view of a camera: an image [H, W, 3], a tensor in the Gaussians' dtype that is not clamped.

        Gradients flow to the tensors that ask for one; wrap the call in `torch.no_grad()` to only look.
        `hqgs.rasterization` gives depth, alpha and several cameras at once. Same bits for any number of
        threads.

        Args:
            camera: size and pinhole intrinsics in pixels, world to camera.
            background: R, G, B behind everything.
            sh_degree: of the harmonics in use, 0..3; None: all that there are.

        Raises:
            ValueError: a degree that the Gaussians do not have, or a background that is no three numbers.
        """
        degree = self.sh_degree if sh_degree is None else sh_degree
        if not 0 <= degree <= self.sh_degree:
            raise ValueError(f"sh_degree is {degree}, wanted 0..{self.sh_degree}")
        if len(background) != 3:
            raise ValueError(f"background is {background}, wanted three numbers: R, G, B")
        with one_torch_thread():
            near = self.near_plane()
            return self.rasterize(camera, sh_degree=degree, background=background, near_plane=near)[0][0]

    def rasterize(
        self,
        camera: Camera,
        colors: Tensor | None = None,
        *,
        sh_degree: int | None = None,
        background: Sequence[float] | None = None,
        render_mode: str = "RGB",
        eps2d: float = EPS2D,
        near_plane: float = NEAR_PLANE,
    ) -> tuple[Tensor, Tensor, RasterizationMeta]:
        """`hqgs.rasterization` of these Gaussians for one camera.

        Args:
            camera: size and pinhole intrinsics in pixels, world to camera.
            colors: [N, D] channels, or with `sh_degree` harmonics, [N, K, 3]; None: the Gaussians' own
                harmonics, for which `sh_degree` must be given.
            sh_degree, render_mode, eps2d, near_plane: as `hqgs.rasterization` takes them.
            background: D numbers behind everything; None: 0.

        Returns:
            [1, H, W, X], not clamped; alphas [1, H, W, 1]; and the meta data.
        """
        own: Tensor | tuple[Tensor, Tensor] = self.sh0
        if sh_degree:  # or else the higher harmonics would get a gradient full of zeros
            own = self.sh0, self.shN
        return rasterization(
            self.means,
            self.quats,
            self.scales,
            self.opacities,
            own if colors is None else colors,
            torch.from_numpy(np.array(camera.viewmat[None])),
            torch.from_numpy(np.array(camera.K[None])),
            camera.width,
            camera.height,
            sh_degree=sh_degree,
            backgrounds=None if background is None else [[*background]],
            render_mode=render_mode,
            eps2d=eps2d,
            near_plane=near_plane,
            packed=False,
            rasterize_mode="antialiased" if self.antialiased else "classic",
            activate=True,
        )

    @own_state(grad=False)
    def save(self, path: str | Path, format: str | None = None) -> int:
        """Write a scene file atomically; return how many Gaussians were left out as NaN or Inf.

        Args:
            path: ends in .ply (the layout of 3DGS, exact; .full.ply: all of its columns), .spz (a tenth as
                large), .sog or .compressed.ply (SuperSplat), .splat (no harmonics) or .glb (glTF);
                docs/files.md states the errors.
            format: that suffix without its first dot, for a file with another one.

        Raises:
            ValueError: another suffix or format, or a scene that does not fit the ranges of SPZ.
            OSError: the file cannot be written; what was there before stays.
        """
        path = Path(path)
        return write_scene(path, self.arrays(), format_of(path, format, written=True))

    @classmethod
    @own_state(grad=False)
    def load(cls, path: str | Path, format: str | None = None) -> Gaussians:
        """Read a scene file, float32: ours, or one of 3DGS, gsplat, Brush, SuperSplat.

        Args:
            path: a .ply (compressed or not), .spz, .sog, .splat, .ksplat, .glb or .gltf file, or the folder
                of a run, or of a SOG scene that was unpacked.
            format: as in `save`, for a file with another suffix.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is no such file, or it is damaged; the message names the file and the property.
        """
        file = scene_file(path)
        arrays = read_scene(file, format_of(file, format))
        world, moved = arrays.get("world", World()), arrays.get("moved")
        return cls(
            **{name: torch.from_numpy(np.ascontiguousarray(arrays[name])) for name in TENSORS},
            look=first_camera(file.parent, world, moved) if file.name == PLY else None,
            world=world,
            antialiased=arrays.get("antialiased", False),
            notes=arrays.get("notes", []),
            moved=moved,
            errors=torch.from_numpy(arrays["errors"]) if "errors" in arrays else None,
        )

    @classmethod
    @own_state(grad=False)
    def from_points(
        cls, points: NDArray[np.floating], colors: NDArray[np.uint8], sh_degree: int = MAX_SH_DEGREE
    ) -> Gaussians:
        """One Gaussian for each point, as 3DGS starts (Kerbl et al. 2023, section 5.1).

        Round, with the root of the mean squared distance to the 3 nearest neighbours as its scale, opacity
        0.1, the point's colour from every direction.

        Args:
            points: [P, 3], world units, finite, P >= 4.
            colors: [P, 3], uint8.
            sh_degree: degree of the coefficients that are allocated, 0..3.
        """
        if points.ndim != 2 or points.shape[1] != 3 or len(points) <= NEAREST:
            raise ValueError(f"points has shape {list(points.shape)}, wanted [P, 3] with P > {NEAREST}")
        if colors.shape != points.shape or colors.dtype != np.uint8:
            raise ValueError(
                f"colors is {colors.dtype} {list(colors.shape)}, wanted uint8 {list(points.shape)}"
            )
        if not 0 <= sh_degree <= MAX_SH_DEGREE:
            raise ValueError(f"sh_degree is {sh_degree}, wanted 0..{MAX_SH_DEGREE}")
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if bad.size:
            raise ValueError(
                f"points has {bad.size} rows that are not finite, the first is row {bad[0]}: {points[bad[0]]}"
            )
        n, points = len(points), points.astype(np.float32)
        square = np.maximum(mean_square_distance(points), 1e-7)  # of points that coincide
        log_scale = torch.from_numpy(0.5 * np.log(square)).float()
        sh0 = (torch.from_numpy(colors.astype(np.float32)) / 255.0 - 0.5) / SH_C0
        return cls(
            means=torch.from_numpy(points),
            scales=log_scale[:, None].repeat(1, 3),
            quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            opacities=torch.full((n,), math.log(0.1 / (1.0 - 0.1))),  # 0.1, Kerbl et al. 2023
            sh0=sh0[:, None, :].contiguous(),
            shN=torch.zeros(n, (sh_degree + 1) ** 2 - 1, 3),
        )


def mean_square_distance(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean squared distance of each point [P, 3] to its 3 nearest other points, [P]."""
    from scipy.spatial import KDTree  # here: to render or to read a file needs no scipy

    xyz = points.astype(np.float64)
    distances, _ = KDTree(xyz).query(xyz, k=NEAREST + 1)  # the first is the point itself
    return np.square(distances[:, 1:]).mean(axis=1)


def orbit(
    about: Gaussians | Sequence[Camera],
    frames: int = 120,
    *,
    up: ArrayLike | None = None,
    like: Camera | None = None,
) -> list[Camera]:
    """Cameras on a path around a scene, all of which look at its middle.

    Args:
        about: the Gaussians, or cameras that look at the scene, such as those of the training views. The
            cameras say how far away and how high the path is; if they stand on one side only, it is a small
            ellipse on that side.
        frames: how many, at least 1.
        up: [3], the axis of the orbit; None: up as most of the cameras were held, and of Gaussians 0 -1 0,
            as files of 3DGS have y down.
        like: the camera whose size and intrinsics the orbit of Gaussians has; None: 504 x 378 px, 60 degrees.

    Raises:
        ValueError: no camera, no frame, or no Gaussian that can be seen.
    """
    if not isinstance(about, Gaussians):
        return orbit_cameras(about, frames, up)
    return around(about.means, about.opacities, frames, UP if up is None else up, like)


def content(means: Tensor, opacities: Tensor) -> tuple[NDArray[np.float64], float]:
    """Where most of a scene is: the middle [3] and a radius, world units, of `means` [N, 3].

    Each Gaussian counts by its opacity, of which `opacities` [N] are logits. The middle is the median along
    each axis, and 80 % lie within the radius, so that a few that are far away do not matter.

    Raises ValueError where there is no Gaussian that is finite and can be seen.
    """
    points = means.detach().double().numpy()
    weights = torch.sigmoid(opacities.detach().double()).numpy()
    seen = np.isfinite(points).all(axis=1) & (weights > 0)
    if not seen.any():
        raise ValueError("the scene is empty: it has no Gaussian that can be seen")
    points, weights = points[seen], weights[seen]
    middle = np.array([_quantile(points[:, axis], weights, 0.5) for axis in range(3)])
    radius = _quantile(np.linalg.norm(points - middle, axis=1), weights, 0.8)
    return middle, radius or 1.0


def around(means: Tensor, opacities: Tensor, frames: int, up: ArrayLike, like: Camera | None) -> list[Camera]:
    """Cameras on a circle around the content, a little above it."""
    middle, radius = content(means, opacities)
    away = 2.2 * radius  # from where it fills the picture
    return circle(middle, away, height=0.35 * away, frames=frames, up=up, like=like)


def _quantile(values: NDArray[np.float64], weights: NDArray[np.float64], share: float) -> float:
    order = values.argsort()
    total = weights[order].cumsum()
    return float(values[order][np.searchsorted(total, share * total[-1])])
