"""The configuration of a training run: everything but the photos that its result depends on."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeAlias

import tyro

from hqgs.base.files import CONFIG, PLAN, read_json
from hqgs.base.options import Number, Seconds, Seed, Unsaid, choice
from hqgs.base.typed import build
from hqgs.model.constants import MAX_SH_DEGREE
from hqgs.photos.formula import parse_formation
from hqgs.scene.constants import BACKGROUND
from hqgs.scene.photo_files import is_run

AUTO, NONE = "auto", "none"
METHODS = {
    "3dgs": "3D Gaussian Splatting",
    "srgs": "for low-resolution photos: renders are compared at their size and at full size",
    "hqgs": "renders get the degradation of the photos before they are compared",
    AUTO: "hqgs",
}
ITEMS = {
    "photos": "training photos that are broken, empty or very blurred",
    "growth": "splitting Gaussians that are smaller than the photos' pixels",
    "resolution": "full resolution in the first part of the run",
    "iterations": "iterations after which nothing improves",
}
ASKED_FOR = ("resolution", "iterations")  # automatic only where a run's start, or no number, asks for it
AUTOMATIC = tuple(item for item in ITEMS if item not in ASKED_FOR)
STANDARD = "standard"
FORMATION, PAPER = GUIDANCES = ("formation", "paper")
Said: TypeAlias = dict[str, Any]  # fields of `TrainConfig` that somebody has said, parts as such, and preset
PART = {"max_gaussians": "densify", "guidance": "hqgs", "formation": "hqgs"}  # where options are fields
LENGTHS = {"iterations", "seconds", "turn", "timed"}  # each says how long a run is, in place of the others


class TrainingError(RuntimeError):
    """The training cannot go on; the message says why and at which iteration."""


@dataclass(frozen=True)
class Preset:
    """How long to train, and on photos of which size."""

    iterations: int | None  # None: as many as pay, 30,000 at most
    longest: int | None  # px: photos with a longer side are scaled down; None: as they are


PRESETS = {"quick": Preset(1_000, 480), STANDARD: Preset(None, 1600), "best": Preset(30_000, None)}


def longest_side(preset: str | None, downscale: float | None) -> int | None:
    """Px that a side of the photos may have: as the preset says, where no `downscale` is asked for."""
    return PRESETS[preset or STANDARD].longest if downscale is None else None


def parse_leave_out(text: str) -> tuple[str, ...]:
    """The items of "auto" (all but ASKED_FOR), "none" or a list with commas, in the order of ITEMS."""
    if text == AUTO:
        return AUTOMATIC
    names = set() if text == NONE else {name.strip() for name in text.split(",")}
    check_items(names)
    return tuple(item for item in ITEMS if item in names)


def check_items(names: set[str]) -> None:
    """ValueError, which lists the items there are, for an unknown one."""
    if unknown := sorted(names - ITEMS.keys()):
        raise ValueError(
            f"leave out: unknown {unknown[0]!r}; wanted {AUTO}, {NONE}, or some of {', '.join(ITEMS)}"
        )


def check_method(name: str) -> None:
    """ValueError, which lists the methods there are, for an unknown name."""
    if name not in METHODS:
        raise ValueError(f"unknown method {name!r}; the methods are: {', '.join(METHODS)}")


def _at_least(config: object, least: int, *names: str) -> None:
    """ValueError for the first of these fields that is said and below `least`, or no number."""
    for name in names:
        if (value := getattr(config, name)) is not None and not value >= least:
            raise ValueError(f"{name} is {value}, wanted at least {least}")


@dataclass(frozen=True)
class DensifyConfig:
    """When and how densely Gaussians are added and removed; None: by the run's length (`TrainConfig.due`).

    Pruning by size on the screen (20 px in the paper's code) is left out: there it tests radii that were
    just set to zero, so that no published figure contains it. Pruning by size in the world goes by the
    scene's reach, not its extent: photos taken side by side have a small extent, so that it would remove all
    that is far away, in each round.
    """

    start: int | None = None  # iterations before the first round
    stop: int | None = None  # no round and no reset from this iteration on
    every: int | None = None  # iterations between rounds
    grad_threshold: float = 2e-4  # mean gradient norm of the 2D mean, in half images, that calls for growth
    percent_dense: float = 0.01  # of the scene extent: smaller Gaussians are cloned, larger ones split
    prune_opacity: float = 0.005  # more transparent Gaussians are removed
    prune_scale: float = 0.1  # of the scene's reach: larger Gaussians are removed, after the first reset
    reset_every: int = 3_000  # iterations between opacity resets
    reset_opacity: float = 0.01  # opacities are cut to this
    max_gaussians: int = 1_000_000  # growth stops here, the highest gradients go first; bounds the memory

    def __post_init__(self) -> None:
        _at_least(self, 1, "every", "reset_every", "max_gaussians")
        _at_least(self, 0, "start", "stop", "grad_threshold", "percent_dense", "prune_scale")
        for name in ("prune_opacity", "reset_opacity"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, wanted a value between 0 and 1")


@dataclass(frozen=True)
class SRGSConfig:
    """The options of SRGS. ValueError for a value out of range."""

    texture_weight: float = 0.4  # of the texture term; the sub-pixel term gets the rest
    own_factor: int = 2  # a photo without `low` is tied at 1 / own_factor of its own size

    def __post_init__(self) -> None:
        if not 0 <= self.texture_weight <= 1:
            raise ValueError(f"texture_weight is {self.texture_weight}, wanted 0..1")
        _at_least(self, 1, "own_factor")


@dataclass(frozen=True)
class HQGSConfig:
    """What HQGS assumes and how it weighs its terms. ValueError for a value out of range."""

    guidance: str = FORMATION  # or "paper": `PaperHQGS` instead of everything below
    formation: str = AUTO  # what happened to the photos, as `parse_formation` reads it; "auto": diagnosed
    jpeg_pixels: float = 0.2  # weight of the pixel loss beside the loss of the JPEG cells
    gaussians_per_pixel: float = 1 / 3  # for each pixel's worth of degraded photos: the most that may grow
    held_pixels: bool = True  # under noise: hold some back, which tell when it is learned (`HeldPixels`)
    first_points: float = 1.0  # share of that number to start from, filled up along edges; 0: no filling up

    def __post_init__(self) -> None:
        if self.guidance not in GUIDANCES:
            raise ValueError(f"guidance is {self.guidance!r}, wanted one of: {', '.join(GUIDANCES)}")
        if self.formation != AUTO:
            parse_formation(self.formation)
        _at_least(self, 0, "jpeg_pixels", "gaussians_per_pixel")
        if not 0 <= self.first_points <= 1:
            raise ValueError(f"first_points is {self.first_points}, wanted 0 to 1")


class Due(NamedTuple):
    """When things are due in a run, iterations: what was said of them, and the rest by its length."""

    sh_interval: int
    eval_every: int
    checkpoint_every: int
    start: int  # of growth, as the next two
    stop: int
    every: int


@dataclass(frozen=True)
class TrainConfig:
    """Everything but the photos that a result depends on. None: not said, so that the plan decides."""

    iterations: int = 30_000  # training views seen
    method: str = AUTO  # one of METHODS
    seed: int = 0  # of everything random
    seconds: float | None = None  # of training that the number of iterations was chosen for
    turn: tuple[int, int] | None = None  # the iteration after which the run gets another length, and that
    timed: bool | None = None  # whether the length is what a number of seconds came to in another run
    batch: int = 1  # views in a step, at most
    sh_degree: int = MAX_SH_DEGREE  # of the spherical harmonics, at most
    sh_interval: int | None = None  # iterations until the next SH degree is trained
    lr_means: float = 1.6e-4  # times the scene extent (`learning_rates`: or more); falls exponentially to
    lr_means_final: float = 1.6e-6  # this at the end of the run
    lr_scales: float = 5e-3
    lr_quats: float = 1e-3
    lr_opacities: float = 5e-2
    lr_sh0: float = 2.5e-3
    lr_shN: float = 2.5e-3 / 20  # noqa: N815
    faster_rates: bool | None = None  # in short runs (`learning_rates`); None: if the method has them
    start_points: int = 100_000  # to start from at most (twice that in short runs) where photos agree on more
    opacity_decay: float | None = None  # share of the opacities that each view takes away; None: by the plan
    dropout: float | None = None  # share of Gaussians left out of a step, at the end; None: likewise
    averaged: float | None = None  # share of the steps, the last ones, whose mean is shown; None: likewise
    adam_eps: float = 1e-15
    leave_out: tuple[str, ...] = AUTOMATIC  # of ITEMS: what the run may do without, where it pays
    background: tuple[float, float, float] = BACKGROUND  # RGB
    eval_every: int | None = None  # iterations between evaluations on the held-out views
    checkpoint_every: int | None = None  # iterations; does not change the result
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    srgs: SRGSConfig = field(default_factory=SRGSConfig)  # of the method of that name, as the next
    hqgs: HQGSConfig = field(default_factory=HQGSConfig)

    def __post_init__(self) -> None:
        check_method(self.method)
        check_items(set(self.leave_out))
        _at_least(self, 1, "iterations", "batch", "sh_interval", "eval_every", "checkpoint_every")
        _at_least(self, 0, "seed", "start_points")
        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise ValueError(f"seconds is {self.seconds}, wanted a positive number")
        if self.turn is not None and not (len(self.turn) == 2 and 0 < self.turn[0] < self.turn[1]):
            raise ValueError(f"turn is {self.turn}, wanted an iteration and a larger length")
        for name in ("opacity_decay", "dropout", "averaged"):
            if (share := getattr(self, name)) is not None and not 0 <= share < 1:
                raise ValueError(f"{name} is {share}, wanted at least 0 and below 1")
        if not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise ValueError(f"sh_degree is {self.sh_degree}, wanted 0..{MAX_SH_DEGREE}")
        for name, value in vars(self).items():
            if name.startswith("lr_") and not 0 < value < math.inf:
                raise ValueError(f"{name} is {value}, wanted a positive number")

    @cached_property
    def due(self) -> Due:
        """When things are due: as 3DGS has it in 30,000 iterations, sooner in a shorter run.

        The SH degrees come in within three sevenths of it. Growth ends after two thirds, begins sooner and
        has its rounds closer together; opacity resets keep their interval: a run that ends growth before the
        first one has none, since it would have no time to recover (it costs 3 dB at 2,000 iterations).
        """
        length, tenth = self.iterations, math.ceil(self.iterations / 10)
        fitted = Due(
            sh_interval=min(1_000, max(1, length // 7)),
            eval_every=max(tenth, 50),
            checkpoint_every=min(1_000, tenth),
            start=min(500, length // 14),
            stop=min(15_000, length * 2 // 3),
            every=min(100, max(1, length // 20)),
        )
        said = {name: (vars(self) | vars(self.densify))[name] for name in Due._fields}
        return fitted._replace(**{name: value for name, value in said.items() if value is not None})

    def fitted(self) -> TrainConfig:
        """With the numbers of `due` written out."""
        due = self.due._asdict()
        growth = {name: due.pop(name) for name in ("start", "stop", "every")}
        return replace(self, **due, densify=replace(self.densify, **growth))


@dataclass(frozen=True, kw_only=True)
class PresetOption:
    """What the command line has beside `TrainOptions`: it is of the photos' size, too."""

    preset: Annotated[str | None, choice(*PRESETS), Unsaid] = None
    """quick: 1,000 iterations on small photos, for a first look. standard (the default): until the scene
    stops improving, photos of at most 1600 px. best: 30,000 iterations, photos at full size."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """What a user says of a run, as `hqgs.train` and the command line take it; None: not said."""

    iterations: Number = None
    """Number of training views to render (standard: 150 for each photo, from 4,000 to 30,000; fewer if the
    scene stops improving)."""
    batch: Number = None
    """Views in a step (1). Several processes of torchrun share them: docs/machines.md."""
    seconds: Seconds = None
    """Train for S seconds, instead of --iterations: the best scene that this machine can make in them."""
    method: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help=f"One of {', '.join(METHODS)} (auto)."), Unsaid
    ] = None
    formation: Annotated[str | None, tyro.conf.arg(metavar="KIND"), Unsaid] = None
    """What degraded the photos, such as blur:1.3+noise:10 (auto: measured in the photos)."""
    guidance: Annotated[str | None, choice(*GUIDANCES), Unsaid] = None
    """For the method hqgs: formation, or paper, the published method (formation)."""
    leave_out: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="LIST",
            help=f"What may be left out to save time, if the scene does not need it: {AUTO}, {NONE}, or some "
            f"of {','.join(ITEMS)} ({AUTO}). A list without iterations trains all iterations.",
        ),
        Unsaid,
    ] = None
    max_gaussians: Number = None
    """The most Gaussians; limits the memory (1,000,000)."""
    eval_every: Number = None
    """Iterations between measurements on held-out photos (a tenth of the run, at least 50)."""
    seed: Seed = None
    """Seed of all random numbers (0)."""

    def said(self) -> Said:
        """What was said, by the names that it has in `TrainConfig`."""
        found: Said = {}
        for option in fields(TrainOptions):
            if (value := getattr(self, option.name)) is not None:
                part = PART.get(option.name)
                (found if part is None else found.setdefault(part, {}))[option.name] = value
        return found


def merged(before: Said, now: Said) -> Said:
    """What was said before, and what is said now, which goes over it."""
    if LENGTHS & now.keys():
        before = {name: value for name, value in before.items() if name not in LENGTHS}
    within = {
        name: before[name] | value
        for name, value in now.items()
        if isinstance(value, dict) and isinstance(before.get(name), dict)
    }
    return before | now | within


def decided(said: Said, where: str = "") -> TrainConfig:
    """The configuration of what was said, `where`. ValueError that names what cannot be.

    What is not said is as the preset has it. "auto" leaves iterations out where nobody has said how many.
    """
    values = {"preset": STANDARD, "leave_out": AUTO} | said
    if (preset := PRESETS.get(str(values.pop("preset")))) is None:
        raise ValueError(f"{where}: preset is {said['preset']!r}, wanted one of: {', '.join(PRESETS)}")
    values.setdefault("iterations", preset.iterations)
    if open_end := values["iterations"] is None:
        values["iterations"] = TrainConfig.iterations
    if isinstance(items := values["leave_out"], str):
        values["leave_out"] = parse_leave_out(items) + (("iterations",) if items == AUTO and open_end else ())
    if values.get("timed"):  # nothing but the recorded length ends it
        values["leave_out"] = tuple(item for item in values["leave_out"] if item != "iterations")
    return build(TrainConfig, values, where)


def with_iterations(config: TrainConfig, iterations: int) -> TrainConfig:
    """The configuration for a run of another length, all of which is trained: "iterations" is no item."""
    items = tuple(item for item in config.leave_out if item != "iterations")
    return replace(config, iterations=iterations, leave_out=items)


def config_values(config: TrainConfig) -> dict[str, Any]:
    """A configuration as JSON values, whole: with the numbers of `TrainConfig.due`."""
    return json.loads(json.dumps(asdict(config.fitted())))


def said_by(config: TrainConfig) -> Said:
    """A configuration as what somebody has said: all of it, but for what it leaves to the plan."""
    known = {name: value for name, value in vars(config).items() if value is not None and name != "due"}
    parts = ("densify", "srgs", "hqgs")
    return known | {p: {k: v for k, v in vars(known[p]).items() if v is not None} for p in parts}


def read_said(path: str | Path) -> Said:
    """What a file says: config.json of a run, or some fields of `TrainConfig`.

    FileNotFoundError, or ValueError that names the field.
    """
    path = Path(path) / CONFIG if Path(path).is_dir() else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no configuration {path}")
    values = read_json(path)
    if not isinstance(values, dict):
        raise ValueError(f"{path}: wanted an object with fields, got {values!r:.60}")
    said = values.get("said", values)
    if "train" in said:
        raise ValueError(f"{path} is of an older version of hqgs, which did not tell what was asked for")
    decided(said, str(path))
    return said


def resumed(folder: Path, now: Said) -> Said:
    """What is said of the run in a folder, before and now. ValueError where it would be shorter."""
    before = read_said(folder) if is_run(folder) and (folder / CONFIG).is_file() else {}
    said = merged(before, now)
    if "iterations" in before and "iterations" in now and said["iterations"] < before["iterations"]:
        raise ValueError(
            f"iterations is {said['iterations']}, and the run in {folder} has {before['iterations']}: "
            "--resume can make a run longer, not shorter"
        )
    return said


def plan_values(config: TrainConfig, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How long the run of these settings was, as JSON values, which `read_plan` reads; and its rows."""
    turn = None if config.turn is None else list(config.turn)
    return {"iterations": config.iterations, "turn": turn, "rows": list(rows)}


def read_plan(path: str | Path) -> Said:
    """The length that a run with a number of seconds came to, as what somebody has said: of plan.json, or of
    the run's folder. FileNotFoundError, or ValueError that says what is wrong with it."""
    path = Path(path) / PLAN if Path(path).is_dir() else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no plan {path}; runs with a number of seconds write one")
    try:
        plan = json.loads(path.read_text(encoding="utf-8"))
        said: Said = {"iterations": int(plan["iterations"]), "turn": plan["turn"], "timed": True}
        decided(said)
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise ValueError(f"{path} is not a plan: {error!r}") from error
    return said
