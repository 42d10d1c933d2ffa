"""The bits of short runs of every method, against those recorded in same_bits.json.

python tests/same_bits.py [--record] [CASE ...]

A line for each run: a hash of all of its tensors at the end, and whether it is the recorded one. Runs that
are stopped and resumed, or shared out to two processes, must come to what they come to in one go. `--record`
writes what they come to now: that belongs into a commit of its own, which says why the bits are others.
The network of `paper` multiplies matrices by MKL: these two runs come to others on other makes of CPU.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).parents[1]
if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from planned import run_config  # noqa: E402
from test_learned_cameras import textured_scene, with_gains  # noqa: E402
from tiny_scene import tiny_config, tiny_scene  # noqa: E402

from hqgs._rust import simd_level  # noqa: E402
from hqgs.base.files import CHECKPOINT  # noqa: E402
from hqgs.base.ranks import ALONE, joined  # noqa: E402
from hqgs.photos.formula import parse_degradation  # noqa: E402
from hqgs.pipeline import open_run  # noqa: E402
from hqgs.scene.degrade import degrade_scene  # noqa: E402
from hqgs.scene.scene import Scene  # noqa: E402
from hqgs.training.config import HQGSConfig, TrainConfig  # noqa: E402
from hqgs.training.trainer import Trainer  # noqa: E402

RECORD = Path(__file__).with_suffix(".json")
STEPS = 45  # of a run: two rounds of densification and the end of growth
STOPPED = 17  # the step after which a run is stopped and resumed


@cache
def textured(degradation: str = "none", gains: bool = False) -> Scene:
    """Points that photos see, enough photos to hold some back, and large enough for a half-size start."""
    scene = textured_scene(12, 64)
    if gains:
        logs = np.random.default_rng(1).normal(0, 0.3, (len(scene.train), 3))
        scene = with_gains(scene, logs - logs.mean(0))
    return degrade_scene(scene, parse_degradation(degradation), 0)


def few_points() -> Scene:
    """The textured scene with a twentieth of its points."""
    scene = textured()
    seen = {name: rows[rows % 20 == 0] // 20 for name, rows in (scene.seen or {}).items()}
    return replace(scene, points=scene.points[::20], point_colors=scene.point_colors[::20], seen=seen)


def tiny() -> tuple[Scene, TrainConfig]:
    """Resets and all degrees of the harmonics within the run."""
    return tiny_scene(12), tiny_config(STEPS)


@dataclass(frozen=True)
class Case:
    """A run: its scene and what is asked for, and the ways beside the straight one that must end alike."""

    make: Callable[[], tuple[Scene, TrainConfig]]
    steps: int = STEPS
    resumed: bool = False
    ranks: bool = False


def asked(
    scene: Callable[[], Scene], *ways: str, changes: dict[str, Any] | None = None, **options: Any
) -> Case:
    """The run of these options of `hqgs.train`; `changes` are made to the configuration."""

    def make() -> tuple[Scene, TrainConfig]:
        given: dict[str, Any] = {"iterations": STEPS} | options
        config = run_config(**given)
        config = replace(config, densify=replace(config.densify, grad_threshold=5e-5))
        return scene(), replace(config, **(changes or {}))

    return Case(make, resumed="resumed" in ways, ranks="ranks" in ways)


def formed(formation: str, *ways: str, **options: Any) -> Case:
    """HQGS of photos that this has happened to, and which it knows of."""
    own = {"exposure", "shake", "focus", "grain", "video"}
    degradation = "none" if formation in own else formation

    def scene() -> Scene:
        return textured(degradation, gains=formation == "exposure")

    return asked(scene, *ways, method="hqgs", formation=formation, **options)


KINDS = ("none", "noise:12", "jpeg:20", "blur:1.5", "defocus:2", "motion:3", "lowres:2", "noise:6+jpeg:20")
OWN = ("exposure", "shake", "focus", "grain", "video")
SOME = "growth,resolution"
CASES: dict[str, Case] = {
    "tiny 3dgs": Case(tiny, resumed=True),
    "auto": asked(textured, "resumed"),
    "auto few points": asked(few_points),
    "auto without a number": asked(textured, iterations=None),
    "auto noise": asked(lambda: textured("noise:20")),
    "auto none": asked(textured, formation="none", leave_out="none"),
    "auto exposure": asked(lambda: textured(gains=True)),
    "3dgs": asked(textured, "resumed", method="3dgs"),
    "3dgs none": asked(textured, method="3dgs", leave_out="none"),
    "3dgs some": asked(textured, method="3dgs", leave_out=SOME),
    "3dgs batch": asked(textured, "resumed", "ranks", method="3dgs", batch=2),
    "3dgs turn": asked(textured, "resumed", method="3dgs", changes={"turn": (35, 50)}),
    "3dgs rates": asked(textured, method="3dgs", changes={"faster_rates": True}),
    "srgs": asked(lambda: textured("lowres:2"), method="srgs"),
    "srgs noise": asked(lambda: textured("noise:12"), method="srgs", leave_out="none"),
    "paper": asked(textured, "resumed", method="hqgs", guidance="paper"),
    "paper batch": asked(textured, "ranks", method="hqgs", guidance="paper", batch=2),
    **{f"hqgs {kind}": formed(kind) for kind in (*KINDS, *OWN)},
    **{f"hqgs {kind} all": formed(kind, leave_out="none") for kind in ("none", "noise:12", "exposure")},
    "hqgs noise batch": formed("noise:12", "resumed", "ranks", batch=2),
    "hqgs none batch": formed("none", "ranks", batch=3),
    "hqgs exposure batch": formed("exposure", "resumed", "ranks", batch=2),
    "hqgs first points": formed(
        "blur:1.5", changes={"hqgs": HQGSConfig(formation="blur:1.5", first_points=0.5)}
    ),
}


def key() -> str:
    """What bits depend on beside the code."""
    torch_level = torch.backends.cpu.get_cpu_capability()
    versions = f"torch {torch.__version__}, numpy {np.__version__}"
    return f"{platform.system()} {platform.machine()}, {simd_level()}, {torch_level}, {versions}"


def hashed(trainer: Trainer) -> str:
    """Of the state's and the method's tensors, and of how long the run is to be."""
    sha = hashlib.sha256(f"{trainer.iteration} of {trainer.length}".encode())
    for tensors in (trainer.state.tensors(), trainer.method.state_dict()):
        for name in sorted(tensors):
            array = tensors[name].detach().contiguous().numpy()
            sha.update(f"{name} {array.dtype} {array.shape}".encode())
            sha.update(array.tobytes())
    return sha.hexdigest()[:24]


@cache
def trained(case: Case, stop: int | None = None) -> str:
    """The hash at the end; with `stop` the run is stopped after that step, and resumed."""
    scene, config = case.make()
    trainer: Trainer | None = None
    with TemporaryDirectory() as name:
        for end in (stop, None) if stop else (None,):
            with open_run(scene, config, name, resume=True) as trainer:
                while trainer.iteration < min(trainer.length, end or case.steps):
                    trainer.step()
                trainer.save(Path(name) / CHECKPOINT)
    assert trainer is not None
    return hashed(trainer)


def by_two(case: str) -> str:
    """The hash that two processes come to, which share out each step."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2"}
    command = [sys.executable, __file__, "--rank", case]
    started = [
        subprocess.Popen(command, env={**os.environ, **own, "RANK": rank}, stdout=subprocess.PIPE, text=True)
        for rank in "01"
    ]
    said = [process.communicate(timeout=240)[0].split() for process in started]
    return said[0][-1] if said[0] == said[1] else f"two processes differ: {said}"


def as_rank(case: Case) -> str:
    scene, config = case.make()
    with joined() as ranks, open_run(scene, config, ranks=ranks) as trainer:
        assert ranks is not ALONE
        while trainer.iteration < case.steps:
            trainer.step()
        return hashed(trainer)


def recorded() -> dict[str, str]:
    """Hashes of this machine's kind; empty where there are none."""
    return json.loads(RECORD.read_text()).get(key(), {}) if RECORD.exists() else {}


def main(arguments: Sequence[str]) -> int:
    names = [name for name in arguments if not name.startswith("--")] or list(CASES)
    if "--rank" in arguments:
        print(as_rank(CASES[names[0]]))
        return 0
    before, found, bad = recorded(), dict[str, str](), 0
    for name in names:
        case = CASES[name]
        found[name] = trained(case)
        same = {found[name]: "as recorded", None: "no record"}.get(before.get(name), "ANOTHER THAN RECORDED")
        ways = {"resumed": trained(case, STOPPED)} if case.resumed else {}
        ways |= {"two processes": by_two(name)} if case.ranks else {}
        wrong = [f"{way.upper()}: {other}" for way, other in ways.items() if other != found[name]]
        bad += bool(wrong) or same.startswith("A")
        print(f"{found[name]}  {name}: {', '.join([same, *(wrong or ways)])}", flush=True)
    if "--record" in arguments:
        others = json.loads(RECORD.read_text()) if RECORD.exists() else {}
        others[key()] = before | found
        RECORD.write_text(json.dumps(others, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        return 0
    return bool(bad)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
