"""Training by two processes over a network of a given speed, on one Linux machine: what the network costs.

    sudo python scripts/network.py SCENE --out FOLDER     # a run whose network changes every few steps
    sudo python scripts/network.py SCENE --out FOLDER --cut 20 40   # a run that loses its network for a while

Two network namespaces stand for two machines (network_machines.py: `ip`, `tc`; root). The links take turns
within one run, so that each is measured beside the same other work. Hidden is the share of a transfer that no
rank waits for: 1 - (waiting - waiting without a limit) / (bytes that a rank sends in a step / rate), of
medians over steps and ranks.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from network_machines import CARD, HOSTS, SPACES, Link, machines, set_link, tool

import hqgs
from hqgs.base.files import CHECKPOINT, PLY, write_json
from hqgs.base.ranks import joined
from hqgs.pipeline import open_run
from hqgs.training.config import TrainOptions, decided

ROOT = Path(__file__).resolve().parents[1]
PORT = 29500
STEADY = 2  # steps after a change of the link that do not count

LINKS = (
    Link("no limit"),
    Link("10 GbE", 10e9),
    Link("1 GbE", 1e9),
    Link("1 GbE, 1 ms", 1e9, 1e-3),
    Link("100 Mb/s", 1e8),
)


def torchrun(rank: int, *command: object, restarts: int = 0) -> list[str]:
    """The command of one machine of two."""
    options = f"--nnodes 2 --nproc-per-node 1 --max-restarts {restarts} --rdzv-backend c10d --rdzv-id run "
    options += f"--rdzv-endpoint {HOSTS[0]}:{PORT} --rdzv-conf is_host={1 - rank} --local-addr {HOSTS[rank]}"
    inside = ["ip", "netns", "exec", SPACES[rank], sys.executable, "-m", "torch.distributed.run"]
    return [*inside, *options.split(), *map(str, command)]


def start(rank: int, *command: object, **options: Any) -> subprocess.Popen[str]:
    env = {**os.environ, "GLOO_SOCKET_IFNAME": CARD, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        torchrun(rank, *command, **options),
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def digest(run: Path) -> str:
    return hashlib.sha256((run / PLY).read_bytes()).hexdigest()


# --- what the network costs ---


def trained(args: argparse.Namespace, ranks: Any, out: Path) -> list[dict[str, Any]]:
    """Train, and save the scene; a record of each step."""
    asked = TrainOptions(
        iterations=args.iterations,
        batch=args.batch,
        method="hqgs",
        leave_out="none",
        max_gaussians=args.gaussians,
        eval_every=10**9,
    )
    config = decided(asked.said())
    hqgs.set_num_threads(1)
    records: list[dict[str, Any]] = []
    with open_run(hqgs.load(args.scene), config, ranks=ranks) as trainer:
        while trainer.iteration < trainer.length:
            number, views = len(records), trainer.iteration
            if number % args.hold == 0 and ranks.count > 1:
                set_link(ranks.rank, LINKS[number // args.hold % len(LINKS)])
            ranks.count_anew()
            began = time.perf_counter()
            ranks.tell(False)  # as a run asks each of them for Ctrl-C
            trainer.step()
            step = {
                "link": LINKS[number // args.hold % len(LINKS)].name,
                "steady": number % args.hold >= STEADY,
                "gaussians": len(trainer.gaussians),
                "views": trainer.iteration - views,
                "seconds": time.perf_counter() - began,
                "worked": ranks.worked,
                "waited": ranks.waited,
                "sent": ranks.sent,
            }
            records.append(step)
        if ranks.first:
            out.mkdir(exist_ok=True)
            trainer.model().save(out / PLY)
    return records


def work(args: argparse.Namespace) -> None:
    """What each of the processes does."""
    with joined() as ranks:
        write_json(args.out / f"steps{ranks.rank}.json", trained(args, ranks, args.out / "two"))


def line(link: Link, steps: Sequence[dict[str, Any]], free: float) -> dict[str, Any]:
    """What a link costs: medians over the steps of both ranks; `free`: s of waiting without a limit."""
    middle = {
        k: statistics.median(step[k] for step in steps) for k in ("seconds", "worked", "waited", "sent")
    }
    transfer = 8 * middle["sent"] / link.rate if link.rate else 0.0
    hidden = 1 - (middle["waited"] - free) / transfer if transfer else None
    return asdict(link) | {"steps": len(steps), "transfer": transfer, "hidden": hidden} | middle


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """A run over all links in turn, and the same by one process."""
    options = ["--iterations", args.iterations, "--batch", args.batch, "--hold", args.hold]
    options += ["--gaussians", args.gaussians, "--out", args.out, args.scene, "--work"]
    with machines(max(link.delay for link in LINKS)):
        processes = [start(rank, __file__, *options) for rank in range(2)]
        said = [process.communicate()[0] for process in processes]
    if any(process.returncode for process in processes):
        raise RuntimeError("\n".join(said))
    ranks = [json.loads((args.out / f"steps{rank}.json").read_text()) for rank in range(2)]
    size = max(step["views"] for step in ranks[0])
    kept = [
        [s for s in steps[args.hold * len(LINKS) :] if s["steady"] and s["views"] == size] for steps in ranks
    ]
    found = [s for steps in kept for s in steps]
    by = {link: [s for s in found if s["link"] == link.name] for link in LINKS}
    free = statistics.median(step["waited"] for step in by[LINKS[0]])
    results: dict[str, Any] = {
        "views": size,
        "gaussians": found[-1]["gaussians"],
        "load": os.getloadavg()[1],
        "lines": [line(link, steps, free) for link, steps in by.items()],
        "scene.ply": digest(args.out / "two"),
    }
    if args.alone:
        with joined() as ranks_of_one:
            trained(args, ranks_of_one, args.out / "one")
        results["scene.ply alone"] = digest(args.out / "one")
    return results


# --- what a lost network does ---


def cut(args: argparse.Namespace) -> dict[str, Any]:
    """A run that loses its network, and the same by one process that never does."""
    after, lasting = args.cut
    train = ["-m", "hqgs", "train", args.scene, "--method", "3dgs", "--iterations", args.iterations]
    train += ["--batch", args.batch, "--threads", "1", "--config.checkpoint-every", "100"]
    train += ["--downscale", "4", "--out"]
    for name in ("cut", "one"):
        shutil.rmtree(args.out / name, ignore_errors=True)
    events: list[dict[str, Any]] = []

    def listen(rank: int, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for said in process.stdout:
            if "hqgs:" in said or "Error" in said or "stopped" in said:
                tell(f"machine {rank}", said.strip()[:200])
        tell(f"machine {rank}", f"torchrun ends with {process.wait()}")

    def tell(who: str, what: str) -> None:
        events.append({"seconds": time.perf_counter() - began, "who": who, "what": what})
        print(f"{events[-1]['seconds']:7.1f} s  {who}: {what}", flush=True)

    with machines(0.0):
        began = time.perf_counter()
        processes = [start(rank, *train, args.out / "cut", restarts=3) for rank in range(2)]
        ears = [threading.Thread(target=listen, args=at) for at in enumerate(processes)]
        for ear in ears:
            ear.start()
        while not (args.out / "cut" / CHECKPOINT).exists() and processes[0].poll() is None:
            time.sleep(0.1)
        time.sleep(after)
        began = time.perf_counter()
        for state, pause in (("down", lasting), ("up", 0)):
            tool("ip", "link", "set", CARD, state, space=SPACES[1])
            tell("network", state)
            time.sleep(pause)
        for ear in ears:
            ear.join()
    results: dict[str, Any] = {"events": events}
    if not any(process.returncode for process in processes):
        alone = [sys.executable, *map(str, train), str(args.out / "one")]
        subprocess.run(alone, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, check=True)
        results |= {"scene.ply": digest(args.out / "cut"), "scene.ply alone": digest(args.out / "one")}
    return results


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", help="a folder")
    parser.add_argument("--out", type=Path, required=True, help="a folder for the runs")
    parser.add_argument("--iterations", type=int, default=1600)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--hold", type=int, default=6, help="steps until the next link")
    parser.add_argument("--alone", action="store_true", help="train with one process too, and compare")
    parser.add_argument(
        "--cut", type=float, nargs=2, metavar="S", help="s until the cut, s until it is mended"
    )
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.work:
        work(args)
        return 0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # what was made is removed
    try:
        results = cut(args) if args.cut else measure(args)
    except (RuntimeError, ValueError, OSError) as error:
        print(f"network: {error}", file=sys.stderr)
        return 1
    write_json(args.out / ("cut.json" if args.cut else "network.json"), results)
    if not args.cut:
        show(results)
    print({name: value for name, value in results.items() if name.startswith("scene")})
    return 0


def show(results: dict[str, Any]) -> None:
    """The table."""
    print(f"{results['views']} views a step, {results['gaussians']:,} Gaussians, load {results['load']:.1f}")
    print("| link | s a step | on views | waiting | sent (MB) | transfer (s) | hidden | steps |")
    for at in results["lines"]:
        hidden = "" if at["hidden"] is None else f"{at['hidden']:.0%}"
        print(
            f"| {at['name']} | {at['seconds']:.3f} | {at['worked']:.3f} | {at['waited']:.3f} | "
            f"{at['sent'] / 1e6:.2f} | {at['transfer']:.3f} | {hidden} | {at['steps']} |"
        )


if __name__ == "__main__":
    sys.exit(main())
