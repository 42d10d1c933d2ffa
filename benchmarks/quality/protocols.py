"""Which scenes, degradations, methods and seeds a quality benchmark runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

from hqgs.photos.formula import parse_degradation
from hqgs.scene.builtin.scene import HEIGHT, WIDTH
from hqgs.training.config import PAPER, ESFGConfig, HQGSConfig, PaperConfig, SRGSConfig, TrainConfig
from hqgs.training.methods.paper import VARIANTS

T = TypeVar("T")


@dataclass(frozen=True)
class Row:
    """A row of the tables: a method with its options."""

    label: str
    method: str
    srgs: SRGSConfig = field(default_factory=SRGSConfig)
    hqgs: HQGSConfig = field(default_factory=HQGSConfig)

    def config(self, seed: int, iterations: int) -> TrainConfig:
        """The training run, with the schedule fitted to its length."""
        return TrainConfig(
            iterations=iterations, method=self.method, seed=seed, srgs=self.srgs, hqgs=self.hqgs
        ).scaled()


@dataclass(frozen=True)
class Protocol:
    """Everything but the scenes. All rows of a (scene, degradation, seed) see the same photos."""

    help: str
    rows: tuple[Row, ...]
    degradations: tuple[str, ...]  # as `parse_degradation` reads them
    baseline: str = "3dgs"  # the row that the others are compared with
    seeds: tuple[int, ...] = (0,)  # of the training and of the degradation
    iterations: int = 3_000
    downscale: float = 2.0
    one_scene: bool = False  # the first that is given
    embedded: tuple[int, int, int] = (WIDTH, HEIGHT, 24)  # width, height in px, views of the built-in scene

    @property
    def labels(self) -> list[str]:
        return [row.label for row in self.rows]


@dataclass(frozen=True)
class Cell:
    """One training run of a protocol."""

    scene: str
    downscale: float
    degradation: str
    row: Row
    seed: int
    iterations: int

    @property
    def group(self) -> tuple[str, str, int]:
        """What it shares with the other rows: scene, degradation, seed."""
        return self.scene, self.degradation, self.seed

    @property
    def config(self) -> TrainConfig:
        return self.row.config(self.seed, self.iterations)

    def __str__(self) -> str:
        return f"{self.scene}, {self.degradation}, {self.row.label}, seed {self.seed}"


def cells(protocol: Protocol, scenes: Sequence[str]) -> list[Cell]:
    """All cells of these scenes, the seeds outermost: whole tables come early. The rows are innermost."""
    return [
        Cell(scene, protocol.downscale, degradation, row, seed, protocol.iterations)
        for seed in protocol.seeds
        for scene in scenes
        for degradation in protocol.degradations
        for row in protocol.rows
    ]


def narrowed(
    protocol: Protocol,
    degradations: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    iterations: int | None = None,
    downscale: float | None = None,
) -> Protocol:
    """The protocol with other degradations, seeds, iterations or downscale, or with some of its rows only.

    ValueError names what is unknown, given twice, or out of range.
    """
    if degradations is not None:
        # The parser's own spelling, so that `noise:25.0` is no other run than `noise:25`.
        spelled = tuple(str(parse_degradation(text)) for text in degradations)
        protocol = replace(protocol, degradations=_distinct("degradations", spelled))
    if methods is not None:
        if unknown := [label for label in methods if label not in protocol.labels]:
            raise ValueError(f"unknown method {unknown[0]!r}; there are here: {', '.join(protocol.labels)}")
        chosen = _distinct("methods", methods)
        protocol = replace(protocol, rows=tuple(row for row in protocol.rows if row.label in chosen))
    if seeds is not None:
        protocol = replace(protocol, seeds=_distinct("seeds", seeds))
    if iterations is not None:
        protocol = replace(protocol, iterations=iterations)
    if downscale is not None:
        if not downscale >= 1:
            raise ValueError(f"downscale must be at least 1, got {downscale}")
        protocol = replace(protocol, downscale=downscale)
    for seed in protocol.seeds:
        for row in protocol.rows:
            row.config(seed, protocol.iterations)  # its checks, before any work
    return protocol


def _distinct(name: str, values: Sequence[T]) -> tuple[T, ...]:
    if twice := [value for k, value in enumerate(values) if value in values[:k]]:
        raise ValueError(f"{name} holds {twice[0]} twice")
    return tuple(values)


def _paper(label: str, config: PaperConfig) -> Row:
    return Row(label, "hqgs", hqgs=HQGSConfig(guidance=PAPER, paper=config))


BASELINE, SRGS, HQGS = Row("3dgs", "3dgs"), Row("srgs", "srgs"), Row("hqgs", "hqgs")
OWN_POINTS = Row("scene's points", "hqgs", hqgs=HQGSConfig(first_points=0.0))
METHODS = (BASELINE, SRGS, HQGS)
KINDS = ("none", "jpeg:10", "noise:25", "lowres:4", "blur", "mixed")
GRID = (
    "none", "noise:10", "noise:25", "noise:50", "jpeg:20", "jpeg:10", "jpeg:5",
    "lowres:2", "lowres:4", "lowres:8",
)  # fmt: skip

PROTOCOLS = {
    "standard": Protocol("the main table", METHODS, KINDS, seeds=(0, 1)),
    "full": Protocol(
        "full resolution", METHODS, ("lowres:4", "noise:25", "blur"), iterations=7_000, downscale=1.0
    ),
    "long": Protocol(
        "the paper's 50,000 iterations on blurred photos", (BASELINE, HQGS), ("blur",),
        iterations=50_000, one_scene=True,  # on clean photos the two are one method
    ),
    "ablation": Protocol(
        "the paper's parts V1 to V7 on blurred photos",
        tuple(_paper(name, config) for name, config in VARIANTS.items()), ("blur",), baseline="V1",
    ),
    "loss": Protocol(
        "the paper's losses with its whole module (V7) on blurred photos",
        (
            _paper("l1", PaperConfig(loss="l1")),
            _paper("l1+dssim", PaperConfig(loss="l1+dssim")),
            _paper("l1+scs", PaperConfig(loss="l1+scs")),
        ),
        ("blur",), baseline="l1",
    ),
    "downsampling": Protocol(
        "the paper's downsampling before its module, with times",
        (BASELINE, *(_paper(f"paper/{k}", PaperConfig(esfg=ESFGConfig(downscale=k))) for k in (1, 2, 4))),
        ("lowres:2",),
    ),
    "grid": Protocol("how each method bears stronger degradation", METHODS, GRID, one_scene=True),
    "guidance": Protocol(
        "hqgs, the paper's guidance and 3dgs", (BASELINE, _paper("paper", PaperConfig()), HQGS), KINDS
    ),
    "points": Protocol(
        "hqgs from the scene's points alone and with those along edges",
        (OWN_POINTS, HQGS), tuple(kind for kind in KINDS if kind != "none"), baseline=OWN_POINTS.label,
    ),
    "smoke": Protocol(
        "a tiny scene, seconds: only a test", METHODS, ("none", "noise:25", "lowres:2"),
        iterations=10, downscale=1.0, one_scene=True, embedded=(48, 36, 10),
    ),
}  # fmt: skip
