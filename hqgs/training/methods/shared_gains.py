"""The brightness that the parts of a scene have in common: that of the coarse whole, which all start from.

How bright a scene is and how its photos were exposed can only be told together. A part that took its own
photos' mean for 1 would have to paint all that it starts from anew.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hqgs.evaluation.report import REPORT
from hqgs.scene.scene import Scene

Floats = NDArray[np.float64]


def learned_gains(run: Path) -> dict[str, Floats]:
    """The log gains [3] that a run learned, by the photo's name; empty where it did not ask.

    FileNotFoundError or ValueError where it has no report, or a damaged one.
    """
    path = run / REPORT
    try:
        learned = json.loads(path.read_text(encoding="utf-8"))["learned"]
        return {one["name"]: np.log(np.array(one["gains"], np.float64)) for one in learned}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error


def known_gains(scene: Scene) -> dict[str, Floats]:
    """Those of the run that a part starts from; empty where there is none, or it took all gains for 1."""
    if scene.around is None:
        return {}
    run = scene.around if scene.around.is_dir() else scene.around.parent
    found = learned_gains(run) if (run / REPORT).is_file() else {}
    return found if any(gains.any() for gains in found.values()) else {}


def beside(own: Floats, known: Sequence[Floats | None]) -> Floats:
    """`own` log gains [N, 3] of a part's photos in the brightness of the `known` ones, which go before."""
    rows = [k for k, value in enumerate(known) if value is not None]
    if not rows:
        return own
    values = np.stack([value for value in known if value is not None])
    found = own + np.median(values - own[rows], axis=0)
    found[rows] = values
    return found
