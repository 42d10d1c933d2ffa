"""The configuration of a training run: everything but the photos that its result depends on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

from hqgs.model.constants import MAX_SH_DEGREE
from hqgs.photos.formula import parse_formation
from hqgs.scene.constants import BACKGROUND
from hqgs.training.constants import EVALUATIONS_APART

AUTO, NONE = "auto", "none"
METHODS = {
    "3dgs": "3D Gaussian Splatting",
    "srgs": "renders are judged at the size of low-resolution photos as well",
    "hqgs": "renders are degraded as the photos were before they are compared",
    AUTO: "hqgs",
}
ITEMS = {
    "photos": "training photos that are broken, empty or far too blurred",
    "passersby": "what stands in one photo while others contradict it",
    "growth": "Gaussians finer than the photos' pixels",
    "weight": "Gaussians that no photo shows",
    "resolution": "full resolution in the first part of the run",
    "iterations": "steps that no longer pay",
}
ASKED_FOR = ("resolution", "iterations")  # automatic only where a run's start, or no number, asks for it
AUTOMATIC = tuple(item for item in ITEMS if item not in ASKED_FOR)
OF_PHOTOS = ("photos", "passersby")  # what is left out before a run starts; the rest is left out of the run
FORMATION, PAPER = GUIDANCES = ("formation", "paper")
Loss = Literal["l1", "l1+dssim", "l1+scs"]


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
            f"leave out: there is no {unknown[0]!r}; there are: {AUTO}, {NONE}, or some of {', '.join(ITEMS)}"
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
class ESFGConfig:
    """The parts of ESFG, which the ablation switches, and its sizes."""

    saf: bool = True  # semantic-aware feature, from the photos I
    eaf: bool = True  # edge-aware feature, from the maps E
    cross_attention: bool = True  # queries from the EAF, keys and values from the SAF
    concat: bool = True  # put the EAF behind the SAF or the attention's result; without: see `ESFG.forward`
    downscale: int = 2  # of I and E before the MLPs, in each direction: 1, 2 or 4
    feature_size: int = 1000  # F, the rows of F'
    lr: float = 1e-6  # of Adam

    def __post_init__(self) -> None:
        if not (self.saf or self.eaf):
            raise ValueError("saf and eaf are both off, so there is no feature; leave the whole ESFG out")
        for name in ("cross_attention", "concat"):
            if getattr(self, name) and not (self.saf and self.eaf):
                raise ValueError(f"{name} needs both saf and eaf, got saf={self.saf}, eaf={self.eaf}")
        if self.downscale not in (1, 2, 4):
            raise ValueError(f"downscale is {self.downscale}, wanted 1, 2 or 4")
        if self.feature_size < 1 or (self.concat and self.feature_size % 2):
            kind = "even number" if self.concat else "number"
            raise ValueError(f"feature_size is {self.feature_size}, wanted a positive {kind}")
        if not 0 < self.lr < math.inf:
            raise ValueError(f"lr is {self.lr}, wanted a positive number")


@dataclass(frozen=True)
class PaperConfig:
    """The method, or a part of it. `VARIANTS` has those of the paper's ablation.

    The paper gives one row of figures, V1 (3DGS) to V7 (everything), for five parts. Read so that each
    variant is a method and that V4 may be worse than V3, as it is there:

    =======  ===  ===  ======  ==  ===========  ==========
    variant  SAF  EAF  concat  CA  loss         F'
    =======  ===  ===  ======  ==  ===========  ==========
    V1                             L1 + D-SSIM  none: 3DGS
    V2       x                     L1 + D-SSIM  SAF
    V3            x                L1 + D-SSIM  EAF
    V4       x    x                L1 + D-SSIM  SAF + EAF
    V5       x    x    x           L1 + D-SSIM  [SAF; EAF]
    V6       x    x    x       x   L1 + D-SSIM  [CA; EAF]
    V7       x    x    x       x   L1 + 5 SCS   [CA; EAF]
    =======  ===  ===  ======  ==  ===========  ==========

    L1 + D-SSIM is 3DGS's, with the weights 0.8 and 0.2. The ablation of losses is V7 with each `loss`.
    """

    esfg: ESFGConfig | None = field(default_factory=ESFGConfig)  # None: the means are rasterized as they are
    loss: Loss = "l1+scs"

    def __post_init__(self) -> None:
        if self.loss not in get_args(Loss):
            raise ValueError(f"loss is {self.loss!r}, wanted one of {', '.join(get_args(Loss))}")


@dataclass(frozen=True)
class HQGSConfig:
    """What HQGS assumes and how it weighs its terms. ValueError for a value out of range."""

    guidance: str = FORMATION  # or "paper": `PaperHQGS` instead of everything below
    paper: PaperConfig = field(default_factory=PaperConfig)
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


def run_config(
    *,
    iterations: int | None = None,
    batch: int = 1,
    method: str = AUTO,
    leave_out: str = AUTO,
    seed: int = 0,
    max_gaussians: int = DensifyConfig.max_gaussians,
    guidance: str = FORMATION,
    formation: str = AUTO,
    eval_every: int | None = None,
) -> TrainConfig:
    """The configuration of a run as users ask for it: these are the options of `hqgs.train`.

    The schedule is fitted to the length; without `eval_every` evaluations are at least EVALUATIONS_APART
    iterations apart. ValueError for a name that there is not, or a number out of range.
    """
    items = parse_leave_out(leave_out)
    if iterations is None and leave_out == AUTO:
        items = (*items, "iterations")
    config = TrainConfig(
        iterations=TrainConfig.iterations if iterations is None else iterations,
        batch=batch,
        leave_out=items,
        method=method,
        seed=seed,
        densify=DensifyConfig(max_gaussians=max_gaussians),
        hqgs=HQGSConfig(guidance=guidance, formation=formation),
    ).scaled()
    return replace(
        config, eval_every=max(config.eval_every, EVALUATIONS_APART) if eval_every is None else eval_every
    )
