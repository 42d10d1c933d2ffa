"""What a page says of trust: how far renders of other places can be believed, and where they cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from hqgs.model.gaussians import Gaussians
from hqgs.photos.pixels import to_uint8
from hqgs.scene.camera_files import load_cameras
from hqgs.scene.next_photos import Spot
from hqgs.scene.paths import camera_path
from hqgs.show.constants import PATH_LOOKS, TRUST_LEAST, TRUST_PASSES, TRUST_PHOTOS, TRUST_ROUNDS
from hqgs.show.frames import trust_picture
from hqgs.show.trust import Held, learn_trust
from hqgs.show.trust_measured import measure_trust, predict_psnr
from hqgs.show.trust_next import doubtful_spots


@dataclass(frozen=True)
class TrustPart:
    """Sentences, and pictures of the held-out photo that the scene shows worst."""

    lines: list[str]
    name: str = ""
    pictures: tuple[tuple[str, Image.Image], ...] = ()  # what they are, and they
    spots: Sequence[Spot] = ()  # where to photograph next


def trust_part(folder: Path, gaussians: Gaussians, iterations: int) -> TrustPart:
    """Of a run that has written its cameras and photos into a folder."""
    known = load_cameras(folder)
    some = min(max(round(TRUST_PASSES * iterations / (TRUST_ROUNDS + 1)), TRUST_LEAST), TRUST_PHOTOS)
    trust = learn_trust(gaussians, known, photos=some)
    measured = measure_trust(trust)
    spots = doubtful_spots(trust, [view for view in known.views if not view.held_out])
    if measured is None:
        why = "No photo was held out, so no number says how far renders of other places can be believed."
        return TrustPart([why], spots=spots)
    by = (
        "Each photo is judged by a calibration on the others"
        if measured.photos > 1
        else "It is not calibrated"
    )
    lines = [f"Trust: {measured}. {by}."]
    path = predict_psnr(trust, camera_path(known.train, PATH_LOOKS, cuts=True), known.train)
    if path is not None:
        lines.append(f"Photos from the way through the training cameras would have a PSNR of {path}.")
    worst = min(range(len(trust.held)), key=lambda k: trust.held[k].psnr)
    one = trust.held[worst]
    return TrustPart(lines, one.name, _pictures(one, gaussians, trust.bound(one.camera)), spots)


def _pictures(one: Held, gaussians: Gaussians, bound: np.ndarray) -> tuple[tuple[str, Image.Image], ...]:
    render = to_uint8(gaussians.render(one.camera).detach().numpy())
    maps = ("render", render), ("trust", trust_picture(bound)), ("error", trust_picture(255 * one.error))
    return tuple((what, Image.fromarray(shown)) for what, shown in maps)
