"""Row `nerf`: a neural radiance field (Mildenhall et al. 2020, arXiv 2003.08934), small enough for a CPU.

Two networks, coarse and fine, each LAYERS layers of WIDTH and a colour layer of half that width, on
encodings of place (10 octaves) and direction (4 octaves). One step for each iteration of the run: RAYS rays
through random pixels, COARSE samples each, then FINE more where the coarse network sees something; the sum
of both squared errors. Rays begin and end where the scene's points do, samples are spread evenly in inverse
depth, and space beyond the points' median distance is contracted (Barron et al. 2022, equation 10). The
paper's own has 8 layers of 256, 4,096 rays, 64 and 128 samples, and 100,000 steps and more. DENSE and the
rate are those that were better on held-back training photos (horns).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benchmarks.measure import Run, reset_peak_rss
from hqgs._rust import NEAR_PLANE
from hqgs.base.machine import peak_rss_mb
from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.held_out import RenderedView, held_out_means
from hqgs.evaluation.metrics import psnr, ssim
from hqgs.photos.pixels import floats
from hqgs.scene.geometry import project, unproject
from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.config import TrainConfig
from hqgs.training.methods.base import photo_tensors
from hqgs.training.schedule import on_the_way

LAYERS, WIDTH = 4, 64
RAYS, COARSE, FINE = 512, 32, 32
PLACES, DIRECTIONS = 10, 4  # octaves of the encodings
RATE, LAST_RATE = 5e-3, 2e-4  # of Adam at the beginning and at the end of the run
BEYOND = 0.005  # of the points' depths lie before the beginning of the rays, and as many behind the end
DENSE = 10  # unit of densities, for each median distance: at 1 walls take longer to become solid
CHUNK = 512  # rays that are rendered together
EVALUATED = 2  # times as rarely as others, on the way by one view: a render takes as long as 30 steps


def encoded(x: Tensor, octaves: int) -> Tensor:
    """x [..., 3] and the sines and cosines of its octaves, [..., 3 + 6 octaves]."""
    angles = (x[..., None, :] * 2.0 ** torch.arange(octaves)[:, None]).flatten(-2)
    return torch.cat([x, angles.sin(), angles.cos()], dim=-1)


class Field(nn.Module):
    """Density and colour at places seen from directions."""

    def __init__(self) -> None:
        super().__init__()
        sizes = [3 + 6 * PLACES, *[WIDTH] * LAYERS]
        layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ReLU())]
        self.trunk = nn.Sequential(*layers)
        self.density = nn.Linear(WIDTH, 1)
        self.color = nn.Sequential(
            nn.Linear(WIDTH + 3 + 6 * DIRECTIONS, WIDTH // 2), nn.ReLU(), nn.Linear(WIDTH // 2, 3)
        )

    def forward(self, places: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """[R, S, 3] and [R, 3] to densities [R, S] and colours [R, S, 3]."""
        features = self.trunk(encoded(places, PLACES))
        seen_from = encoded(directions, DIRECTIONS)[:, None].expand(-1, places.shape[1], -1)
        color = self.color(torch.cat([features, seen_from], dim=-1)).sigmoid()
        return nn.functional.softplus(self.density(features)[..., 0] - 1), color


class NerfTraining:
    """A run, trained to its end, with what `benchmarks.measure.Training` tells of one."""

    def __init__(self, photos: Scene, config: TrainConfig) -> None:
        photos.check_trainable()
        self._resets, started = reset_peak_rss(), time.perf_counter()
        self.scene, self.config = photos, config
        self.history: list[Run] = []
        self._last: list[RenderedView] = []
        self.iteration, self.seconds, self.cpu_seconds, self.render_ms = 0, 0.0, 0.0, 0.0
        self._random = torch.Generator().manual_seed(config.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.coarse, self.fine = Field(), Field()
        middle = np.mean([view.camera.center for view in photos.train], axis=0)
        self._unit = float(np.median(np.linalg.norm(photos.points - middle, axis=1)))
        self._middle = torch.from_numpy(middle).float()
        self._nearest, self._farthest = _ends(photos)
        self.setup_seconds = time.perf_counter() - started
        with one_torch_thread():
            self._train()

    def record(self) -> Run:
        """As that of a run of Gaussians, of which there are none."""
        names = ("seconds", "cpu_seconds", "setup_seconds", "render_ms")
        return {name: getattr(self, name) for name in names} | {"initial_points": 0, "gaussians": 0}

    def peak_rss_mb(self) -> float | None:
        """Of all that the process held; None where the system does not tell."""
        return peak_rss_mb() if self._resets else None

    def held_out(self) -> list[RenderedView]:
        return self._last

    def _views(self, numbers: Sequence[int]) -> list[RenderedView]:
        """The held-out views of these numbers."""
        views, started = [self.scene.test[k] for k in numbers], time.perf_counter()
        renders = [self.render(view.camera) for view in views]
        self.render_ms = 1_000 * (time.perf_counter() - started) / len(views)
        pairs = zip(views, renders, strict=True)
        return [RenderedView(view.name, view.image, render, view.mask) for view, render in pairs]

    @torch.no_grad()
    def render(self, camera: Camera) -> NDArray[np.float32]:
        """[H, W, 3]."""
        seen = torch.cat([self.look(rays)[1] for rays in _rays(camera).split(CHUNK)])
        return seen.view(camera.height, camera.width, 3).numpy()

    def look(self, rays: Tensor, random: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """What the coarse and the fine network see along rays [R, 6], centres and directions: [R, 3] each.

        Directions are as long as depth is 1. `random`: samples lie anywhere in their intervals.
        """
        edges = torch.linspace(self._nearest, self._farthest, COARSE + 1).expand(len(rays), -1)
        place = 0.5 if random is None else torch.rand(len(rays), COARSE, generator=random)
        near = edges[:, :-1] + place * edges.diff(dim=1)
        coarse, weights = self._along(self.coarse, rays, near)
        with torch.no_grad():  # more samples, by the distribution of the weights
            sums = (weights + 1e-5).cumsum(dim=1)
            sums = nn.functional.pad(sums / sums[:, -1:], (1, 0))
            wanted = torch.linspace(0.5 / FINE, 1 - 0.5 / FINE, FINE).expand(len(rays), -1)
            if random is not None:
                wanted = wanted + (torch.rand(wanted.shape, generator=random) - 0.5) / FINE
            above = torch.searchsorted(sums, wanted.contiguous()).clamp(1, COARSE)
            low, high = sums.gather(1, above - 1), sums.gather(1, above)
            start, end = edges.gather(1, above - 1), edges.gather(1, above)
            more = start + (wanted - low) / (high - low) * (end - start)
            near = torch.cat([near, more], dim=1).sort(dim=1, descending=True).values
        return coarse, self._along(self.fine, rays, near)[0]

    def _along(self, field: Field, rays: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
        """Colours [R, 3] and weights [R, S] of a field at samples of falling inverse depth [R, S]."""
        origins, directions = rays[:, :3], rays[:, 3:]
        depths, length = 1 / near, directions.norm(dim=1, keepdim=True)
        places = (origins[:, None] + depths[..., None] * directions[:, None] - self._middle) / self._unit
        norm = places.norm(dim=-1, keepdim=True).clamp(min=1.0)
        density, color = field(places * (2 - 1 / norm) / norm, directions / length)
        # The last sample stands for all that is behind it.
        gaps = nn.functional.pad(depths.diff(dim=1) * length * (DENSE / self._unit), (0, 1), value=1e3)
        passed = torch.exp(-density * gaps)
        light = nn.functional.pad((passed + 1e-10).cumprod(dim=1)[:, :-1], (1, 0), value=1.0)
        weights = light * (1 - passed)
        return (weights[..., None] * color).sum(dim=1), weights

    def _train(self) -> None:
        parameters = [*self.coarse.parameters(), *self.fine.parameters()]
        adam, length = torch.optim.Adam(parameters, RATE), self.config.iterations
        pixels = [_pixels(view) for view in self.scene.train]
        colors, rays = (torch.cat(tensors) for tensors in zip(*pixels, strict=True))
        while self.iteration < length:
            started, clock = time.perf_counter(), time.process_time()
            adam.param_groups[0]["lr"] = RATE * (LAST_RATE / RATE) ** (self.iteration / length)
            chosen = torch.randint(len(colors), (RAYS,), generator=self._random)
            photo = colors[chosen]
            coarse, fine = self.look(rays[chosen], self._random)
            loss = (coarse - photo).square().mean() + (fine - photo).square().mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
            self.iteration += 1
            self.seconds += time.perf_counter() - started
            self.cpu_seconds += time.process_time() - clock
            if self.iteration % (EVALUATED * self.config.eval_every) == 0 or self.iteration == length:
                self._evaluate()

    def _evaluate(self) -> None:
        ended, every = self.iteration == self.config.iterations, self.config.eval_every
        self._last = self._views(range(len(self.scene.test)) if ended else on_the_way(self.scene, every)[:1])
        entry: Run = {"iteration": self.iteration, "seconds": self.seconds, "gaussians": 0}
        entry |= {"views": len(self._last), "memory_mb": peak_rss_mb()}
        means = held_out_means([psnr, ssim], self._last)
        self.history.append(entry | {"psnr": means[0], "ssim": means[1]})


def _rays(camera: Camera) -> Tensor:
    """Centre and direction of the ray through each pixel's centre, [H W, 6]; directions have depth 1."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    directions = unproject(camera, pixels, np.ones(len(pixels))) - camera.center
    origins = np.broadcast_to(camera.center, directions.shape)
    return torch.from_numpy(np.concatenate([origins, directions], axis=1)).float()


def _pixels(view: View) -> tuple[Tensor, Tensor]:
    """Colours [P, 3] and rays [P, 6] of the pixels of a photo that count."""
    photo, mask = photo_tensors(view)
    counted = slice(None) if mask is None else mask.flatten()
    return floats(photo).flatten(0, 1)[counted], _rays(view.camera)[counted]


def _ends(scene: Scene) -> tuple[float, float]:
    """Inverse depths at which rays begin and end: of the points that the training photos show."""
    near = []
    for view in scene.train:
        pixels, depths = project(view.camera, scene.points.astype(np.float64))
        inside = (pixels >= 0) & (pixels < [view.camera.width, view.camera.height])
        shown = inside.all(axis=1) & (depths > NEAR_PLANE)
        near.append(1 / depths[shown])
    nearest, farthest = np.quantile(np.concatenate(near), [1 - BEYOND, BEYOND])
    return 1.1 * float(nearest), 0.9 * float(farthest)
