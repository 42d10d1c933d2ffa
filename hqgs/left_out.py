"""What a run leaves out because the scene does not need it."""

from __future__ import annotations

from dataclasses import dataclass


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
