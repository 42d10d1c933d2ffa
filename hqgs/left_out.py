"""What a run leaves out because the scene does not need it: the names, and the record of each."""

from __future__ import annotations

from dataclasses import dataclass

AUTO, NONE = "auto", "none"
ITEMS = {
    "photos": "training photos that repeat others or show nothing",
    "growth": "Gaussians finer than the photos' pixels",
    "weight": "Gaussians that no photo shows",
    "harmonics": "bands of the harmonics that held-back photos do not ask for",
    "resolution": "full resolution in the first part of the run",
    "iterations": "the rest of a run that has stopped improving",
}


@dataclass(frozen=True)
class LeftOut:
    """One thing that a run did without. None: not known or not measured."""

    what: str
    why: str
    evidence: str | None = None  # what was measured to decide it
    seconds: float | None = None  # of run time saved, an estimate
    memory_mb: float | None = None  # saved
    bytes: int | None = None  # of the scene file saved
    cost_db: float | None = None  # lost in PSNR on training photos that were held back; below 0: gained


def parse_leave_out(text: str) -> tuple[str, ...]:
    """The items of "auto" (all), "none" or a list with commas, in the order of ITEMS; ValueError else."""
    if text == AUTO:
        return tuple(ITEMS)
    names = set() if text == NONE else {name.strip() for name in text.split(",")}
    check_items(names)
    return tuple(item for item in ITEMS if item in names)


def check_items(names: set[str]) -> None:
    """ValueError, which lists the items there are, for an unknown one."""
    if unknown := sorted(names - ITEMS.keys()):
        raise ValueError(
            f"leave out: there is no {unknown[0]!r}; there are: {AUTO}, {NONE}, or some of {', '.join(ITEMS)}"
        )
