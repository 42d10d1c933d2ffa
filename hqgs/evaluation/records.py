"""What report.json holds, as types, and its reading."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypedDict, cast

from hqgs.base.files import read_json

if TYPE_CHECKING:
    from typing_extensions import NotRequired  # typing has it from Python 3.11 on

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"
# Objects of which another class says what they hold, the values that are known: a photo that was looked at
# (`photo_record`), what was learned of a camera (`learned_record`), what was not finite and its events
# (`Guard`), a process (`Ranks.record`), a decision (`PlanRow`), the frame (`World`, but for its place).
PhotoRecord: TypeAlias = dict[str, Any]
LearnedRecord = RankRecord = PlanRowRecord = WorldRecord = GuardEvent = GuardRecord = PhotoRecord
# `ViewMetrics`, but for its reasons: of a view, or means. None: the report's `reasons` say why there is none.
MetricValues: TypeAlias = dict[str, float | None]
# The same of a held-out view, with its `name` and its `picture`: photo, render and difference, a file in the
# folder of the run; None: nothing was written.
ViewMetricValues: TypeAlias = dict[str, Any]


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


class MetricsRecord(TypedDict):
    """The held-out views of a run, measured."""

    mean: MetricValues
    psnr_shown: NotRequired[float]  # mean of the views'
    interval: MetricValues  # half of that of each mean; older runs do not tell
    confidence: float  # of the intervals
    views: list[ViewMetricValues]
    reasons: dict[str, str]  # metric -> why the mean is None


class RunRecord(TypedDict):
    """A run without its metrics."""

    scene: str
    source: str  # format the scene was read from
    notes: list[str]  # what a reader should know of photos and points
    fallen: NotRequired[str]  # that it ends far below where it began, and the likely cause
    method: str
    seed: int
    iterations: int
    length: int  # iterations of the whole run; fewer were done where it was stopped
    seconds: float  # training time, without loading and without the report
    gaussians: int
    scene_bytes: int | None  # of scene.ply; None: nothing was written
    peak_rss_mb: float | None
    history: list[HistoryEntry]
    left_out: list[dict[str, str]]  # `LeftOut`, what is known of each
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
    machine: dict[str, Any]  # `machine_facts`
    versions: dict[str, str | None]


def read_report(path: str | Path) -> Report:
    """Read a report.json. Raises FileNotFoundError, or ValueError where the file is no report."""
    path = Path(path)
    report = read_json(path)
    if not isinstance(report, dict) or not isinstance(report.get("metrics"), dict):
        raise ValueError(f"{path} is not an hqgs report: it has no metrics")
    missing = {"mean", "views", "reasons"} - report["metrics"].keys()
    if missing:
        raise ValueError(f"{path} is not an hqgs report: its metrics lack {', '.join(sorted(missing))}")
    return cast(Report, report)
