"""What a step of several ranks takes over a network, on paper.

    python scripts/network_model.py     # prints how many times as fast

Of one view a rank computes for a + b M seconds of one core, where M Gaussians are visible: the line through
two sizes of `docs/results/speed.csv`. To each of the P - 1 others it sends 64 M bytes.
Views of a rank follow each other, and a view's bytes travel while the next one is computed.
"""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SPEED = ROOT / "docs" / "results" / "speed.csv"
BYTES = 64  # of a visible Gaussian
RATES = 1e9, 10e9, 25e9  # bit/s
SIZES = 100_000, 1_000_000, 10_000_000
RANKS = 2, 4, 16, 64
VIEWS = 2  # of a rank in a step
UPDATE = 0.35  # of a view's b M: adding up and Adam, for each view of the step, by every rank


@dataclass(frozen=True)
class Model:
    """Of machines with so many cores."""

    fixed: float  # core-seconds of a view
    each: float  # core-seconds of a Gaussian of it
    cores: int

    @staticmethod
    def of(cores: int, smaller: int = 100_000, larger: int = 500_000) -> Model:
        """By what was measured, as if cores shared the work evenly."""
        with SPEED.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["part"] == "rasterizer"]
        seconds = {int(row["gaussians"]): float(row["seconds"]) * int(row["threads"]) for row in rows}
        each = (seconds[larger] - seconds[smaller]) / (larger - smaller)
        return Model(seconds[smaller] - each * smaller, each, cores)

    def view(self, visible: int) -> float:
        """Seconds of a view."""
        return (self.fixed + self.each * visible) / self.cores

    def transfer(self, visible: int, ranks: int, rate: float) -> float:
        """Seconds that a view's bytes take to all others."""
        return 8 * BYTES * visible * (ranks - 1) / rate

    def update(self, visible: int, ranks: int) -> float:
        """Seconds of what every rank does with all views of a step."""
        return UPDATE * VIEWS * ranks * self.each * visible / self.cores

    def step(self, visible: int, ranks: int, rate: float) -> float:
        """Seconds of a step of VIEWS views a rank."""
        view, sent, update = (
            self.view(visible),
            self.transfer(visible, ranks, rate),
            self.update(visible, ranks),
        )
        return view + max((VIEWS - 1) * view + sent, VIEWS * sent) + update

    def gain(self, visible: int, ranks: int, rate: float) -> float:
        """Times as fast as one machine."""
        alone = VIEWS * ranks * self.view(visible) + self.update(visible, ranks)
        return alone / self.step(visible, ranks, rate)


def table(cores: int) -> list[str]:
    """How many times as fast P machines are, for each network and size."""
    model = Model.of(cores)
    head = ["Gaussians in a view", "s a view", "network", *map(str, RANKS), "most"]
    rows = ["| " + " | ".join(head) + " |", "|" + "--:|" * len(head)]
    for size in SIZES:
        for rate in RATES:
            gains = {ranks: model.gain(size, ranks, rate) for ranks in range(2, max(RANKS) + 1)}
            most = max(gains, key=lambda ranks: gains[ranks])
            best = f"{gains[most]:.1f} at {most}" if gains[most] > 1 else "never"
            cells = [
                f"{size:,}",
                f"{BYTES * size / 1e6:,.0f}",
                f"{model.view(size):.3f}",
                f"{rate / 1e9:.0f} GbE",
            ]
            rows.append("| " + " | ".join([*cells, *(f"{gains[k]:.1f}" for k in RANKS), best]) + " |")
    return rows


def main() -> int:
    for cores in (1, 16):
        print(f"{cores} core{'s' * (cores > 1)} a machine, times as fast as one machine:\n")
        print("\n".join(table(cores)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
