"""What a reader of a run's report should know of it, in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hqgs.base.evenly import evenly
from hqgs.diagnosis.photo import PhotoDiagnosis
from hqgs.evaluation.held_out import HeldOutViews, held_out_means
from hqgs.evaluation.metrics import psnr
from hqgs.evaluation.records import LearnedRecord, PhotoRecord
from hqgs.evaluation.verdict import fallen, overdone
from hqgs.model.gaussians import Gaussians
from hqgs.photos.pixels import as_floats
from hqgs.training.methods.cameras import LearnedCamera
from hqgs.training.rules import MOST_ITERATIONS
from hqgs.training.trainer import Trainer

_POOR, _ASKED = 20.0, 4  # dB, above which no run has failed; photos that are asked
_LOOKS = 3  # at each photo, before which a run is a try and no failure


def fell_short(trainer: Trainer) -> str | None:
    """What to say of a poor run that ends far below where it began; see `fallen`."""
    last = trainer.history[-1]["psnr"] if trainer.history else None
    if (last is not None and last > _POOR) or trainer.iteration < _LOOKS * len(trainer.scene.train):
        return None
    scene, background = trainer.prepared.given, trainer.config.background
    views = scene.test or scene.train
    asked = [views[k] for k in evenly(len(views), _ASKED)]
    first = Gaussians.from_points(scene.points, scene.point_colors, 0)
    degree = trainer.schedule.degree(trainer.iteration)
    ends = [*HeldOutViews(asked, trainer.model(), degree, background)]  # rendered once, read twice
    photos = [as_floats(view.image)[... if view.mask is None else view.mask].reshape(-1, 3) for view in asked]
    if not sum(map(len, photos)):  # masks hide all of them
        return None
    color = np.concatenate(photos).mean(0)
    flats = [replace(end, render=np.broadcast_to(color, end.photo.shape)) for end in ends]
    of = (ends, flats, HeldOutViews(asked, first, 0, background))
    return fallen(*(held_out_means([psnr], renders)[0] for renders in of))


def run_notes(trainer: Trainer) -> list[str]:
    """Sentences, one for each thing."""
    own, left, notes = len(trainer.scene.points), trainer.method.rate_left, list[str]()
    if more := trainer.first_points - own:
        notes.append(f"training started from the scene's {own} points and {more} found along edges")
    if some := [entry["views"] for entry in trainer.history if "views" in entry]:
        notes.append(
            f"during training {max(some)} of {len(trainer.scene.test)} held-out views were measured, evenly "
            "spread, to save time; the last values are of all views"
        )
    if fell := overdone(trainer.history):
        notes.append(fell)
    if (seconds := trainer.config.seconds) is not None:
        text = f"{trainer.config.iterations} iterations were planned for {seconds:g} s of training"
        if at := trainer.state.decisions.turned:
            text += f"; changed after iteration {at} to {trainer.length} in all"
        if trainer.length == trainer.plan.clock_most < MOST_ITERATIONS:
            text += "; more iterations seldom improve the scene"
        notes.append(f"{text}. `--plan` with plan.json repeats this training bit for bit")
    if trainer.lengthened is not None:
        notes.append(
            f"the run had ended at iteration {trainer.lengthened} and was continued with the schedule of "
            f"{trainer.config.iterations} iterations, so that its learning rates rose again"
        )
    if left < 1:
        why = "the validation pixels of the noisy photos stopped improving"
        notes.append(f"the learning rates were lowered to 1/{1 / left:.6g}: {why}")
    if found := trainer.method.learned():
        lengths = sorted(photo.extent for photo in found)
        if moved := sum(length > 0 for length in lengths):
            notes.append(
                f"{moved} of {len(lengths)} photos have camera shake: {lengths[len(lengths) // 2]:.1f} px in "
                f"the median, {lengths[-1]:.1f} px at most; held-out photos with shake give a sharp scene "
                "too low a PSNR"
            )
        discs = sorted(photo.defocus for photo in found)
        if soft := sum(disc > 0 for disc in discs):
            notes.append(
                f"{soft} of {len(discs)} photos have defocus, with blur discs of up to {discs[-1]:.1f} px "
                "radius; held-out photos with defocus give a sharp scene too low a PSNR"
            )
        gains = np.log2([photo.gains for photo in found])
        if gains.any():
            notes.append(f"exposures differ by up to {np.abs(gains).max():.2f} stops from the mean")
        corners = sorted(1 - np.exp(-photo.vignetting.sum()) for photo in found)
        bends = max(float(np.abs(photo.response).max()) for photo in found)
        if any(corners) or bends:
            notes.append(
                f"vignetting darkens corners by up to {corners[-1]:.0%}, and the slopes of the response "
                f"curves are up to {bends:.0%} off their mean. The scene has no vignetting and the mean "
                "response. Held-out photos by these cameras are compared with renders that have their "
                "vignetting and response; `hqgs render --look PHOTO` renders so"
            )
    return notes


def learned_record(learned: LearnedCamera) -> LearnedRecord:
    """What was learned of a photo's camera, for the report."""
    return {
        "name": learned.name,
        "shake_px": learned.extent,
        "trajectory_px": learned.trajectory.tolist(),
        "defocus_px": learned.defocus,
        "focus": learned.focus,
        "gains": learned.gains.tolist(),
        "vignetting": learned.vignetting.tolist(),
        "response": learned.response.tolist(),
    }


def photo_record(found: PhotoDiagnosis) -> PhotoRecord:
    """The diagnosis of a photo as the report keeps it."""
    return {
        "name": found.name,
        "width": found.width,
        "height": found.height,
        "blur": None if found.blur is None else found.blur.kind,
        "blur_px": None if found.blur is None else found.blur.amount,
        "noise": found.noise,
        "jpeg_quality": found.jpeg.quality,
        "enlarged": found.enlargement.factor,
    }
