"""What a reader of a run's report should know of it, in words."""

from __future__ import annotations

import numpy as np

from hqgs.evaluation.records import LearnedRecord
from hqgs.evaluation.verdict import overdone
from hqgs.training.methods.cameras import LearnedCamera
from hqgs.training.rules import MOST_ITERATIONS
from hqgs.training.trainer import Trainer


def run_notes(trainer: Trainer) -> list[str]:
    """Sentences, one for each thing."""
    own, left, notes = len(trainer.scene.points), trainer.method.rate_left, list[str]()
    if more := trainer.first_points - own:
        notes.append(f"started from the scene's {own} points and {more} more from the photos")
    if some := [entry["views"] for entry in trainer.history if "views" in entry]:
        notes.append(
            f"while it trained, {max(some)} of {len(trainer.scene.test)} held-out views were measured, which "
            "are evenly spread, to save time; the last values are of all"
        )
    if fell := overdone(trainer.history):
        notes.append(fell)
    if (seconds := trainer.config.seconds) is not None:
        text = f"{trainer.config.iterations} iterations were planned for {seconds:g} s of training"
        if at := trainer.state.decisions.turned:
            text += f"; after iteration {at}, {trainer.length} in all"
        if trainer.length == trainer.plan.clock_most < MOST_ITERATIONS:
            text += ", and more looks at the photos do not pay"
        notes.append(f"{text}. `--plan` with plan.json trains the same again, bit for bit")
    if trainer.lengthened is not None:
        notes.append(
            f"the run had ended at iteration {trainer.lengthened}; from there on its schedule is that of "
            f"{trainer.config.iterations} iterations: learning rates rose again"
        )
    if left < 1:
        why = "pixels held back from the noisy photos showed no gain any more"
        notes.append(f"the learning rates fell to 1/{1 / left:.6g}: {why}")
    if found := trainer.method.learned():
        lengths = sorted(photo.extent for photo in found)
        if moved := sum(length > 0 for length in lengths):
            notes.append(
                f"{moved} of {len(lengths)} photos are shaken, by {lengths[len(lengths) // 2]:.1f} px in the "
                f"median and {lengths[-1]:.1f} px at most; held-out photos that are shaken themselves "
                "measure a sharp scene as worse than it is"
            )
        discs = sorted(photo.defocus for photo in found)
        if soft := sum(disc > 0 for disc in discs):
            notes.append(
                f"{soft} of {len(discs)} photos are out of focus somewhere, with discs of up to "
                f"{discs[-1]:.1f} px radius; held-out photos that are so themselves measure a sharp scene as "
                "worse than it is"
            )
        gains = np.log2([photo.gains for photo in found])
        if gains.any():
            notes.append(f"photos are up to {np.abs(gains).max():.2f} stops brighter or darker than the mean")
        corners = sorted(1 - np.exp(-photo.vignetting.sum()) for photo in found)
        bends = max(float(np.abs(photo.response).max()) for photo in found)
        if any(corners) or bends:
            notes.append(
                f"cameras darken corners by up to {corners[-1]:.0%}, the slopes of their responses are "
                f"up to {bends:.0%} off their mean; the scene looks as the mean camera has it, with bright "
                "corners: held-out photos by these cameras are measured in their look, and "
                "`hqgs render --look PHOTO` shows it as a photo's camera would"
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
