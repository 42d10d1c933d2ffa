"""What stands in one photo while others contradict it: people who walk through, cars, a shadow.

A small scene is trained from small copies of the photos, from points that photos agree on, for so few steps
that it never comes to show what a single photo does (RobustSplat, Fu et al. 2025, lets growth begin late for
that). Where a photo differs from it, in a region as a whole, other photos are asked: patches around the
scene's depth either look as in the scene, and then somebody was passing by, or as in the photo, and then the
scene is wrong there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.threads import one_torch_thread
from hqgs.diagnosis.constants import GAINS_DARK
from hqgs.model.consistency import Agreement
from hqgs.model.constants import AGREE_SMOOTH, AGREEING
from hqgs.model.first_points import points_along_edges
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import nearness_map, render_view
from hqgs.model.shapes import as_discs
from hqgs.photos.pixels import as_floats
from hqgs.scene.constants import BACKGROUND
from hqgs.scene.geometry import shrunk
from hqgs.scene.scene import Scene, View
from hqgs.training.adam import Adam
from hqgs.training.config import TrainConfig
from hqgs.training.constants import (
    BORNE_OUT,
    CONTRADICTED,
    DEPTHS_ASKED,
    DIFFERS,
    DIFFERS_MUCH,
    SCOUT_CELL,
    SCOUT_DEGREE,
    SCOUT_PIXELS,
    SCOUT_SIDE,
    SCOUT_STEPS,
    SCOUT_STEPS_EACH,
    SMALLEST_PASSING,
)
from hqgs.training.methods.base import photo_tensors
from hqgs.training.methods.photometric import photometric_loss
from hqgs.training.schedule import learning_rates

NEIGHBOURS = np.ones((3, 3))  # a cell's, the corners among them

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def without_passersby(scene: Scene, seed: int, on_stage: OnStage = silent) -> tuple[Scene, dict[str, Mask]]:
    """The scene with masks that leave out who passes by, and by the photo's name where that is, [H, W].

    Photos in which nobody does are not named, and stay as they are. Nothing is found in fewer than 3 photos,
    or where the scene does not tell which points they see.
    """
    if len(scene.train) <= AGREEING or scene.seen is None:
        return scene, {}
    on_stage(Stage("passers-by", 0, 0, "looking for what other photos contradict"))
    views = [shrunk(view, SCOUT_SIDE) for view in scene.train]
    agreement = Agreement(views, scene.seen)
    gaussians = _trained(scene, views, agreement, seed)
    train, found = [], dict[str, Mask]()
    for k, (small, view) in enumerate(zip(views, scene.train, strict=True)):
        with one_torch_thread(), torch.no_grad():
            render = render_view(gaussians, small.camera, SCOUT_DEGREE, BACKGROUND)[0].numpy()
            near = nearness_map(gaussians, small.camera, SCOUT_CELL).numpy().astype(np.float64)
        cells = _contradicted(agreement, k, render, near, _regions(_unlike(small, render)))
        if cells.any():
            found[view.name] = passing = _enlarged(cells, *view.image.shape[:2])
            view = replace(view, mask=~passing if view.mask is None else view.mask & ~passing)
        train.append(view)
    return replace(scene, train=train), found


def _trained(scene: Scene, views: Sequence[View], agreement: Agreement, seed: int) -> Gaussians:
    """The small scene, without a gradient history."""
    wanted = sum(view.camera.width * view.camera.height for view in views) // SCOUT_PIXELS
    more = points_along_edges(views, scene.points, scene.seen or {}, wanted, seed, agreement)
    points, colors = np.concatenate([scene.points, more[0]]), np.concatenate([scene.point_colors, more[1]])
    gaussians = as_discs(Gaussians.from_points(points, colors, SCOUT_DEGREE))
    named = gaussians.named().items()
    groups = [{"name": name, "params": [tensor.requires_grad_()]} for name, tensor in named]
    steps = max(SCOUT_STEPS, SCOUT_STEPS_EACH * len(views))
    config = TrainConfig(iterations=steps, faster_rates=True)
    optimizer = Adam(groups, lr=0.0, eps=config.adam_eps)
    targets, rng = [photo_tensors(view) for view in views], np.random.default_rng(seed)
    order, extent, reach = list[int](), scene.extent, scene.reach  # these two look at all points and photos
    with one_torch_thread():
        for step in range(steps):
            if not order:
                order = rng.permutation(len(views)).tolist()
            k = order.pop()
            rates = learning_rates(config, extent, step / steps, reach)
            for group in optimizer.param_groups:
                group["lr"] = rates[group["name"]]
            image, _ = render_view(gaussians, views[k].camera, SCOUT_DEGREE, BACKGROUND)
            optimizer.zero_grad()
            photometric_loss(image, *targets[k]).backward()
            optimizer.step()
    return gaussians.detached()


def _unlike(view: View, render: NDArray[np.float32]) -> Floats:
    """How far each cell of a photo is from what the render shows there or one cell aside, in the worst
    channel; 0 where the photo does not count. Gains of the whole photo do not count either.
    """
    photo, own = _cells(as_floats(view.image)), _cells(render)
    own *= np.median(photo / np.maximum(own, GAINS_DARK), axis=(0, 1))
    low, high = (f(own, size=(3, 3, 1)) for f in (ndimage.minimum_filter, ndimage.maximum_filter))
    unlike = np.maximum(np.maximum(low - photo, photo - high), 0).max(-1)
    return unlike if view.mask is None else np.where(_cells(view.mask[..., None])[..., 0] == 1, unlike, 0)


def _cells(image: NDArray[np.floating] | Mask) -> Floats:
    """The means over cells, [ceil(H / SCOUT_CELL), ceil(W / SCOUT_CELL), C]."""
    height, width, channels = image.shape
    padded = np.pad(image, ((0, -height % SCOUT_CELL), (0, -width % SCOUT_CELL), (0, 0)), mode="edge").astype(
        np.float64
    )
    return padded.reshape(
        -(-height // SCOUT_CELL), SCOUT_CELL, -(-width // SCOUT_CELL), SCOUT_CELL, channels
    ).mean((1, 3))


def _regions(unlike: Floats) -> NDArray[np.intp]:
    """Connected cells that differ, numbered from 1, where a region differs much somewhere; without holes."""
    weak = unlike > DIFFERS
    weak |= np.asarray(ndimage.binary_closing(np.pad(weak, 2), NEIGHBOURS), bool)[2:-2, 2:-2]
    labels = _numbered(weak)
    numbers = np.arange(1, labels.max() + 1)
    hearts = np.asarray(ndimage.maximum(ndimage.uniform_filter(unlike, 3), labels, numbers))
    large = np.bincount(labels.ravel())[1:] >= SMALLEST_PASSING
    kept = np.isin(labels, numbers[(hearts > DIFFERS_MUCH) & large])
    return _numbered(np.asarray(ndimage.binary_fill_holes(kept), bool))


def _numbered(cells: Mask) -> NDArray[np.intp]:
    labels = np.zeros(cells.shape, np.intp)
    ndimage.label(cells, NEIGHBOURS, output=labels)
    return labels


def _contradicted(
    agreement: Agreement, number: int, render: NDArray[np.float32], near: Floats, regions: NDArray[np.intp]
) -> Mask:
    """The cells of those regions of a photo in which other photos show what the scene does."""
    lines, columns = np.nonzero(regions)
    if not len(lines):
        return np.zeros(regions.shape, bool)
    pixels = (np.stack([columns, lines], -1).astype(np.float64) + 0.5) * SCOUT_CELL
    ranges = 1 / np.maximum(near[lines, columns, None], np.finfo(float).tiny) * DEPTHS_ASKED
    grey = np.ascontiguousarray(ndimage.gaussian_filter(render.mean(2), AGREE_SMOOTH), np.float32)
    _, of_photo = agreement.depths(number, pixels, ranges)
    _, of_scene = agreement.depths(number, pixels, ranges, grey=grey)
    numbers = np.arange(1, regions.max() + 1)
    scene, photo = (
        np.asarray(ndimage.mean(agreed, regions[lines, columns], numbers)) for agreed in (of_scene, of_photo)
    )
    return np.isin(regions, numbers[(scene - photo >= CONTRADICTED) & (scene >= BORNE_OUT)])


def _enlarged(cells: Mask, height: int, width: int) -> Mask:
    """The cells as pixels of the photo."""
    rows, columns = (
        ((np.arange(side) + 0.5) * count / side).astype(np.intp)
        for side, count in zip((height, width), cells.shape, strict=True)
    )
    return cells[rows[:, None], columns]
