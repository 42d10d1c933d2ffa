"""What report.json holds, as types, and its reading."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypedDict, cast

from hqgs.base.files import read_json
from hqgs.base.left_out import LeftOutRecord
from hqgs.base.machine import MachineFacts

if TYPE_CHECKING:
    from typing_extensions import NotRequired  # typing has it from Python 3.11 on

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"


class HistoryEntry(TypedDict):
    """Means over the held-out views, or some of them, at one moment of a run. None: no such value."""

    iteration: int
    seconds: float  # of training until then
    psnr: float | None  # dB
    ssim: float | None
    gaussians: NotRequired[int]  # older runs do not tell
    memory_mb: NotRequired[float | None]  # the most that the process has held so far
    views: NotRequired[int]  # held-out views that were measured, where that is not all of them


def alike(history: Sequence[HistoryEntry]) -> list[list[HistoryEntry]]:
    """The entries in their order, parted where another number of views was measured.

    Their means are not of the same photos there, so that no line leads from one to the other.
    """
    return [list(part) for _, part in groupby(history, lambda entry: entry.get("views"))]


class MetricValues(TypedDict):
    """The metrics of one view, or their means. None: the report's `reasons` say why there is none."""

    psnr: float | None  # dB, up
    ssim: float | None  # up
    haarpsi: float | None  # up
    lpips: float | None  # AlexNet, down
    lpips_vgg: float | None  # VGG-16, down
    psnr_aligned: float | None  # dB, up; brightness and tint of each photo set aside


class ViewMetricValues(MetricValues):
    """The metrics of a held-out view."""

    name: str
    psnr_shown: NotRequired[float]  # dB; as the scene is shown, where the others are in its camera's look
    picture: str | None  # photo, render, difference: a file in the run's folder; None: nothing was written


class MetricsRecord(TypedDict):
    """The held-out views of a run, measured."""

    mean: MetricValues
    psnr_shown: NotRequired[float]  # mean of the views'
    interval: MetricValues  # half of that of each mean; older runs do not tell
    confidence: float  # of the intervals
    views: list[ViewMetricValues]
    reasons: dict[str, str]  # metric -> why the mean is None


class GuardEvent(TypedDict):
    """Something that was not finite. `gaussians` are row numbers at that iteration."""

    iteration: int
    view: str  # the training view of the step
    what: str  # "photo", "loss", "gradient" or "parameter"
    tensors: list[str]  # where it was found: "render", "means", ...; empty for a photo or the loss
    count: int  # pixels' values of a photo, Gaussians elsewhere; 0 where no Gaussian is at fault
    gaussians: list[int]


class GuardRecord(TypedDict):
    """What was not finite in a run."""

    skipped_steps: int
    culled_gaussians: int
    num_events: int
    events: list[GuardEvent]  # the first ones


class PhotoRecord(TypedDict):
    """What a training photo was found to suffer from, `PhotoDiagnosis` in short. None: not told from it."""

    name: str
    width: int
    height: int
    blur: str | None  # beyond a sharp photo's own: gaussian, defocus or motion, and how much of it
    blur_px: float | None  # sigma, radius or length
    noise: float | None  # levels of 1/255
    jpeg_quality: int | None  # None: no JPEG was seen
    enlarged: int  # 1: it was not


class LearnedRecord(TypedDict):
    """What was learned of a training photo's camera."""

    name: str
    shake_px: float  # how far the picture's middle went during the exposure
    trajectory_px: list[list[float]]  # its trajectory, [9, 2], x to the right and y down; of mean 0
    defocus_px: float  # radius of the largest disc that a point becomes
    focus: float | None  # where, 1 at the photo's median depth; None: sharp, or out of focus as a whole
    gains: list[float]  # of red, green and blue in linear light; their logarithms' mean over photos is 0
    vignetting: NotRequired[list[float]]  # [2], as `hqgs.photos.look` has it; older runs do not tell
    response: NotRequired[list[list[float]]]  # [2, 3]


class RankRecord(TypedDict):
    """One process of a run that several have trained."""

    rank: int
    view_seconds: float  # on its share of the views: renders, gradients, and sending them meanwhile
    waiting_seconds: float  # for the others
    sent_bytes: int


class PlanRowRecord(TypedDict):
    """One decision of a run; what is not there does not apply."""

    what: str
    value: str
    why: str
    evidence: NotRequired[str]  # what was measured
    rule: NotRequired[str]  # the rule's name and its source
    iteration: NotRequired[int]  # after which it was decided; none: before the first step


class WorldRecord(TypedDict):
    """The frame of what the run wrote: `World`, but for its place."""

    unit: float  # of coordinates in memory, in those that were written
    shift: list[float]
    metres: float | None  # a written unit is a metre, and one of the files that were read this many
    error: NotRequired[float]  # of metres, half of the 95 % interval, as a share
    up: NotRequired[list[float]]


class RunRecord(TypedDict):
    """A run without its metrics."""

    scene: str
    source: str  # format the scene was read from
    notes: list[str]  # what a reader should know of photos and points
    method: str
    seed: int
    iterations: int
    length: int  # iterations of the whole run; fewer were done where it was stopped
    seconds: float  # training time, without loading and without the report
    gaussians: int
    scene_bytes: int | None  # of scene.ply; None: nothing was written
    culled_in_a_view: float | None  # Gaussians that a held-out view does not show, in the mean
    peak_rss_mb: float | None
    history: list[HistoryEntry]
    left_out: list[LeftOutRecord]
    guard: GuardRecord
    world: WorldRecord | None
    place: dict[str, Json] | None  # `Georeference`, by the photos' GPS; None: it does not tell
    sfm: dict[str, Any] | None  # `SfmReport`; None: poses and points are the scene's own
    photos: list[PhotoRecord]  # those that were looked at; empty where the method does not ask for it
    ranks: list[RankRecord]  # empty where one process did all
    learned: list[LearnedRecord]  # of the photos' cameras; empty where nothing of them is learned
    config: dict[str, Json]  # `TrainConfig`, as the plan has it
    plan: list[PlanRowRecord]  # what was decided, before the first step and since


class Report(RunRecord):
    """report.json."""

    metrics: MetricsRecord
    machine: MachineFacts
    versions: dict[str, str | None]


def read_report(path: str | Path) -> Report:
    """Read a report.json. Raises FileNotFoundError, or ValueError where the file is no report."""
    path = Path(path)
    report = read_json(path)
    if not isinstance(report, dict) or not isinstance(report.get("metrics"), dict):
        raise ValueError(f"{path} is no hqgs report: it has no metrics")
    missing = {"mean", "views", "reasons"} - report["metrics"].keys()
    if missing:
        raise ValueError(f"{path} is no hqgs report: its metrics lack {', '.join(sorted(missing))}")
    return cast(Report, report)
