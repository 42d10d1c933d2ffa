"""The configuration of a training run: everything but the photos that its result depends on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import tyro

from hqgs.base.options import Number, Seconds, Seed, Unsaid, choice
from hqgs.model.constants import MAX_SH_DEGREE
from hqgs.photos.formula import parse_formation
from hqgs.scene.constants import BACKGROUND

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
LEFT = ("passersby", "weight")  # items of former versions, which configurations may still name
STANDARD = "standard"
FORMATION, PAPER = GUIDANCES = ("formation", "paper")


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
    """ValueError for the first of these fields that is below `least`, or no number."""
    for name in names:
        if not getattr(config, name) >= least:
            raise ValueError(f"{name} is {getattr(config, name)}, wanted at least {least}")


@dataclass(frozen=True)
class DensifyConfig:
    """When and how densely Gaussians are added and removed. The defaults are those of 3DGS at 30,000.

    Pruning by size on the screen (20 px in the paper's code) is left out: there it tests radii that were
    just set to zero, so that no published figure contains it. Pruning by size in the world goes by the
    scene's reach, not its extent: photos taken side by side have a small extent, so that it would remove all
    that is far away, in each round.
    """

    start: int = 500  # iterations before the first round
    stop: int = 15_000  # no round and no reset from this iteration on
    every: int = 100  # iterations between rounds
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

    def scaled(self, iterations: int) -> DensifyConfig:
        """The schedule for a run of another length than 30,000.

        Growth ends after two thirds of the run, at 15,000 at the latest. A short run starts it sooner and has
        its rounds closer together. Resets keep their interval: a run that ends growth before the first one
        has none, since it would have no time to recover (it costs 3 dB at 2,000 iterations).
        """
        return replace(
            self,
            start=min(self.start, iterations // 14),
            stop=min(self.stop, iterations * 2 // 3),
            every=min(self.every, max(1, iterations // 20)),
        )


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
    smallest: float = 0.5  # standard deviation of the smallest Gaussian, in photo pixels
    gaussians_per_pixel: float = 1 / 3  # for each pixel's worth of degraded photos: the most that may grow
    held_pixels: bool = True  # under noise: hold some back, which tell when it is learned (`HeldPixels`)
    first_points: float = 1.0  # share of that number to start from, filled up along edges; 0: no filling up

    def __post_init__(self) -> None:
        if self.guidance not in GUIDANCES:
            raise ValueError(f"guidance is {self.guidance!r}, wanted one of: {', '.join(GUIDANCES)}")
        if self.formation != AUTO:
            parse_formation(self.formation)
        _at_least(self, 0, "jpeg_pixels", "smallest", "gaussians_per_pixel")
        if not 0 <= self.first_points <= 1:
            raise ValueError(f"first_points is {self.first_points}, wanted 0 to 1")


@dataclass(frozen=True)
class TrainConfig:
    """Everything but the photos that a result depends on.

    `scaled()` fits the schedule to a run of another length than 30,000 iterations. `run_config` makes the
    configuration of a run as a user asks for it.
    """

    iterations: int = 30_000  # training views seen
    method: str = AUTO  # one of METHODS
    seed: int = 0  # of everything random
    seconds: float | None = None  # of training that the number of iterations was chosen for
    turn: tuple[int, int] | None = None  # the iteration after which the run gets another length, and that
    timed: bool | None = None  # whether the length is what a number of seconds came to in another run
    batch: int = 1  # views in a step, at most
    sh_degree: int = MAX_SH_DEGREE  # of the spherical harmonics, at most
    sh_interval: int = 1_000  # iterations until the next SH degree is trained
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
    averaged: float | None = (
        None  # share of the steps, the last ones, whose mean is the scene; None: likewise
    )
    adam_eps: float = 1e-15
    leave_out: tuple[str, ...] = AUTOMATIC  # of ITEMS: what the run may do without, where it pays
    background: tuple[float, float, float] = BACKGROUND  # RGB
    eval_every: int = 3_000  # iterations between evaluations on the held-out views
    checkpoint_every: int = 1_000  # iterations; does not change the result
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

    def scaled(self) -> TrainConfig:
        """The same run with the schedule fitted to `iterations`; see `DensifyConfig.scaled` too.

        The SH degrees come in within three sevenths of a short run. Evaluates 10 times; saves every 1,000
        iterations, in short runs 10 times.
        """
        tenth = math.ceil(self.iterations / 10)
        return replace(
            self,
            sh_interval=min(self.sh_interval, max(1, self.iterations // 7)),
            eval_every=tenth,
            checkpoint_every=min(self.checkpoint_every, tenth),
            densify=self.densify.scaled(self.iterations),
        )


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """What a user says of a run, as `hqgs.train` and the command line take it; None: not said."""

    preset: Annotated[str | None, choice(*PRESETS), Unsaid] = None
    """quick: 1,000 iterations on small photos, for a first look. standard (the default): until the scene
    stops improving, photos of at most 1600 px. best: 30,000 iterations, photos at full size."""
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

    def resolved(self, before: TrainConfig | None = None) -> TrainConfig:
        """The configuration that is meant; `before`: of the run that goes on, or is done alike.

        What is not said is as it was before, or as the preset has it. "auto" leaves iterations out where
        nobody has said how many. ValueError for a name that there is not, or a number out of range.
        """
        length = self.iterations
        if before is None and length is None:
            length = PRESETS[self.preset or STANDARD].iterations
        open_end = length is None and (before is None or "iterations" in before.leave_out)
        config = before or scaled(
            TrainConfig(iterations=TrainConfig.iterations if length is None else length)
        )
        if length is not None and before is not None:
            known = "iterations" not in before.leave_out and before.seconds is None
            if length != before.iterations or not known:
                config = replace(with_iterations(before, length), seconds=None, turn=None, timed=None)
        changes: dict[str, Any] = {
            name: value
            for name in ("batch", "seconds", "method", "eval_every", "seed")
            if (value := getattr(self, name)) is not None
        }
        if self.leave_out is not None or before is None:
            items = parse_leave_out(self.leave_out or AUTO)
            open_end = open_end and self.leave_out in (None, AUTO)
            changes["leave_out"] = (*items, "iterations") if open_end else items
        if self.max_gaussians is not None:
            changes["densify"] = replace(config.densify, max_gaussians=self.max_gaussians)
        of_hqgs = {"guidance": self.guidance, "formation": self.formation}
        of_hqgs = {name: value for name, value in of_hqgs.items() if value is not None}
        return replace(config, hqgs=replace(config.hqgs, **of_hqgs), **changes)


def run_config(**said: Any) -> TrainConfig:
    """The configuration of a run of these `TrainOptions`."""
    return TrainOptions(**said).resolved()


def scaled(config: TrainConfig) -> TrainConfig:
    """With its schedule fitted to its length, and evaluations at least 50 iterations apart."""
    config = config.scaled()
    return replace(config, eval_every=max(config.eval_every, 50))


def with_iterations(config: TrainConfig, iterations: int) -> TrainConfig:
    """The configuration for a run of another length; what the user has set of its schedule stays.

    It trains all of that length: the item "iterations" is not left out.
    """
    before, after = (scaled(TrainConfig(iterations=length)) for length in (config.iterations, iterations))

    def fitted(mine: Any, old: Any, new: Any, *names: str) -> dict[str, Any]:
        same = [name for name in names if getattr(mine, name) == getattr(old, name)]
        return {name: getattr(new, name) for name in same}

    growth = fitted(config.densify, before.densify, after.densify, "start", "stop", "every")
    return replace(
        config,
        iterations=iterations,
        leave_out=tuple(item for item in config.leave_out if item != "iterations"),
        densify=replace(config.densify, **growth),
        **fitted(config, before, after, "sh_interval", "eval_every", "checkpoint_every"),
    )
