"""Held-out views: the one place that renders them, and their means."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from numpy.typing import NDArray

from hqgs._rust import get_num_threads
from hqgs.base.files import REPORT
from hqgs.base.machine import give_back_memory, peak_rss_mb
from hqgs.base.ranks import ALONE, Ranks
from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.metrics import ViewMetrics, evaluate_view, psnr, ssim
from hqgs.evaluation.records import HistoryEntry, LearnedRecord, read_report
from hqgs.evaluation.run_folder import RunFolder
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.photos.look import Look
from hqgs.scene.constants import BACKGROUND
from hqgs.scene.scene import Scene, View

KEPT_BYTES = 256e6  # of renders that are held; 12 of 1600 x 1067 px


@dataclass(frozen=True)
class RenderedView:
    """A held-out view: the photo it is judged by and the trained scene's render."""

    name: str
    photo: NDArray[np.uint8] | NDArray[np.float32]  # [H, W, 3]
    # [H, W, 3], in the look of the photo's camera where that is known; clamped to [0, 1] by the report, never
    # rounded for the metrics
    render: NDArray[np.float32]
    mask: NDArray[np.bool_] | None = None  # [H, W], True where the photo counts
    quarter_turns: int = 0  # clockwise, that show it upright
    shown: NDArray[np.float32] | None = None  # [H, W, 3], as the scene is shown; None: as `render`


class HeldOutViews(Sequence[RenderedView]):
    """Held-out views as training renders them, not clamped, rendered when they are asked for.

    Only the last renders are kept, KEPT_BYTES of them: all those of a thousand large photos would not fit
    into memory. The Gaussians must stay as they are as long as the views are in use.
    """

    def __init__(
        self,
        views: Sequence[View],
        gaussians: Gaussians,
        sh_degree: int,
        background: tuple[float, float, float] = BACKGROUND,
        looks: Mapping[str, Look] | None = None,
    ) -> None:
        """`looks`: of cameras, by `View.device`."""
        self._looks: Mapping[str, Look] = looks or {}
        self.names: list[str] = [view.name for view in views]
        self._views, self._gaussians = views, gaussians
        self._sh_degree, self._background = sh_degree, background
        self._kept: dict[int, RenderedView] = {}  # the one that was asked for last comes last

    def __len__(self) -> int:
        return len(self._views)

    @overload
    def __getitem__(self, index: int) -> RenderedView: ...
    @overload
    def __getitem__(self, index: slice) -> list[RenderedView]: ...
    def __getitem__(self, index: int | slice) -> RenderedView | list[RenderedView]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        number = range(len(self))[index]
        rendered = self._kept.pop(number, None) or self._render(number)
        self._kept[number] = rendered
        while len(self._kept) > 1 and sum(view.render.nbytes for view in self._kept.values()) > KEPT_BYTES:
            del self._kept[next(iter(self._kept))]
        return rendered

    def _render(self, number: int) -> RenderedView:
        view = self._views[number]
        with one_torch_thread(), torch.no_grad():
            render, _ = render_view(self._gaussians, view.camera, self._sh_degree, self._background)
        shown = render.numpy()
        look = self._looks.get(view.device)
        taken = shown if look is None else look.of(shown.clip(0), view.camera.K).astype(np.float32)
        return RenderedView(
            view.name, view.image, taken, view.mask, view.quarter_turns, shown if self._looks else None
        )


def held_out_renders(
    scene: Scene,
    gaussians: Gaussians,
    sh_degree: int | None = None,
    background: tuple[float, float, float] = BACKGROUND,
    looks: Mapping[str, Look] | None = None,
) -> HeldOutViews:
    """The scene's held-out views; `sh_degree` None: the Gaussians' own. `looks` as in `HeldOutViews`."""
    return HeldOutViews(
        scene.test,
        gaussians.in_world(scene.world),
        gaussians.sh_degree if sh_degree is None else sh_degree,
        background,
        looks,
    )


def history_entry(
    views: HeldOutViews, of: int, iteration: int, seconds: float, gaussians: int, ranks: Ranks
) -> HistoryEntry:
    """The means of some of `of` held-out views at a moment of a run; `ranks` share them."""
    means = held_out_means([psnr, ssim], views, ranks)
    entry: HistoryEntry = {
        "iteration": iteration,
        "seconds": seconds,
        "psnr": means[0],
        "ssim": means[1],
        "gaussians": gaussians,
        "memory_mb": peak_rss_mb(),
    }
    if len(views) < of:
        entry["views"] = len(views)
    return entry


def measured(
    views: Sequence[RenderedView], then: Callable[[int, RenderedView, ViewMetrics], None] | None = None
) -> list[ViewMetrics]:
    """All metrics of each view. `then` gets each view's number, the view and its metrics.

    One view after the other is rendered, once; what is done with it runs beside that, on as many threads as
    the rasterizer has, for as many views. Raises ValueError, which names the view, where its render, photo
    and mask do not fit; and what `then` raises.
    """

    def one(number: int, view: RenderedView) -> ViewMetrics:
        try:
            metrics = evaluate_view(view.render, view.photo, view.mask)
            if view.shown is not None:
                metrics = replace(metrics, psnr_shown=psnr(view.shown, view.photo, view.mask))
        except ValueError as error:
            raise ValueError(f"view {view.name!r}: {error}") from error
        if then is not None:
            then(number, view, metrics)
        return metrics

    give_back_memory()  # that the training had: HaarPSI alone takes 200 MB, its imports
    threads = get_num_threads()
    waiting: deque[Future[ViewMetrics]] = deque()
    done: list[ViewMetrics] = []
    with one_torch_thread(), ThreadPoolExecutor(threads) as pool:
        for number in range(len(views)):
            view = views[number]
            if len(waiting) == threads:  # no more renders than that are held
                done.append(waiting.popleft().result())
            waiting.append(pool.submit(one, number, view))
        return done + [future.result() for future in waiting]


def names_of(views: Sequence[RenderedView]) -> list[str]:
    """The views' names, without rendering any."""
    return views.names if isinstance(views, HeldOutViews) else [view.name for view in views]


def held_out_means(
    metrics: Sequence[Callable[..., float | None]], views: Sequence[RenderedView], ranks: Ranks = ALONE
) -> list[float | None]:
    """Mean of each `metric(render, photo, mask)`; None where there is no view, or one without a value.

    `ranks` share the views.
    """

    def row(number: int) -> list[float | None]:
        view = views[number]
        return [metric(view.render, view.photo, view.mask) for metric in metrics]

    rows: list[Any] = ranks.divide(range(len(views)), row)
    columns: list[Any] = [[row[k] for row in rows] for k in range(len(metrics))]
    return [float(np.mean(values)) if values and None not in values else None for values in columns]


def held_out_psnr(scene: Scene, views: Sequence[RenderedView]) -> float:
    """Mean PSNR (dB) of renders of the held-out views. ValueError where a view has none."""
    (mean,) = held_out_means([psnr], views)
    if mean is None:
        raise ValueError(f"scene {scene.name!r} has no held-out view, or one without a PSNR")
    return mean


def looks_of_devices(views: Sequence[View], looks: Mapping[str, Look]) -> dict[str, Look]:
    """By camera (`View.device`), in the mean over its photos, of what was learned of training photos; empty
    where nothing changes a picture. `looks`: by the photos' names."""
    photos: dict[str, list[Look]] = {}
    for view in views:
        if view.device and not view.face and view.name in looks:
            photos.setdefault(view.device, []).append(looks[view.name])
    found = {
        device: Look(
            np.exp(np.mean([np.log(look.gains) for look in own], 0)), own[0].vignetting, own[0].response
        )
        for device, own in photos.items()
    }
    return found if any(look.changes for look in found.values()) else {}


def looks_beside(file: Path, views: Sequence[View]) -> dict[str, Look]:
    """Those of `looks_of_devices` of the run that a scene file lies in; `views`: its training photos."""
    report = RunFolder.open(file).report
    return {} if report is None else looks_of_devices(views, _looks(report.get("learned", [])))


def _looks(learned: Sequence[LearnedRecord]) -> dict[str, Look]:
    return {
        record["name"]: Look(
            np.array(record["gains"], np.float64),
            np.array(record.get("vignetting", np.zeros(2)), np.float64),
            np.array(record.get("response", np.zeros((2, 3))), np.float64),
        )
        for record in learned
    }


def look_of(folder: Path, name: str) -> Look:
    """Of the photo of this name, with its suffix or without, as the run in a folder has learned it.

    Raises:
        FileNotFoundError: the folder has no report.
        ValueError: it is damaged, nothing was learned of the photos' looks, or there is no such photo.
    """
    looks = _looks(read_report(folder / REPORT).get("learned", []))
    if not any(one.changes for one in looks.values()):
        raise ValueError(
            f"{folder}: no exposure, vignetting or response was learned, so all photos are rendered alike"
        )
    stems = {Path(photo).stem: look for photo, look in looks.items()}
    if (found := looks.get(name, stems.get(name))) is None:
        some = ", ".join([*looks][:3])
        raise ValueError(f"no exposure of a photo {name!r} was learned; there are: {some}, ...")
    return found
