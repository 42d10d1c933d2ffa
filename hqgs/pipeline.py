"""From a scene to a trained one: train, report. The command line and `import hqgs` both call what is here."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np
from numpy.typing import NDArray

from hqgs import __version__
from hqgs.base.files import (
    CHECKPOINT,
    CONFIG,
    PAGE,
    PLAN,
    PLY,
    lock_folder,
    remove_leftovers,
    write_json,
    write_text,
)
from hqgs.base.interrupt import deferred_interrupt
from hqgs.base.left_out import LeftOut
from hqgs.base.machine import give_back_memory, peak_rss_mb
from hqgs.base.options import called_with
from hqgs.base.ranks import ALONE, Ranks
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.state import own_state
from hqgs.diagnosis.scene import Diagnosis, Inspector
from hqgs.evaluation.held_out import HeldOutViews, RenderedView
from hqgs.evaluation.metrics import psnr
from hqgs.evaluation.records import HistoryEntry, RankRecord, Report, RunRecord, WorldRecord
from hqgs.evaluation.report import write_report
from hqgs.evaluation.run_folder import RunFolder
from hqgs.model.gaussians import Gaussians
from hqgs.scene.camera_files import save_cameras
from hqgs.scene.photo_files import strangers
from hqgs.scene.scene import Scene
from hqgs.show.page.page import page_text, summary_html
from hqgs.training.checkpoint import checksum, scene_fingerprint
from hqgs.training.config import (
    Said,
    TrainConfig,
    TrainOptions,
    config_values,
    decided,
    merged,
    plan_values,
    resumed,
    said_by,
)
from hqgs.training.forward import Step
from hqgs.training.frame import Frame
from hqgs.training.notes import fell_short, learned_record, photo_record, run_notes
from hqgs.training.plan import essential
from hqgs.training.trainer import Trainer, fit_to_seconds


@dataclass(frozen=True)
class Progress:
    """What a run has just done: one step."""

    iteration: int  # steps done, those before a `resume` among them
    length: int  # steps of the whole run, as far as it is known; it may get less
    seconds: float  # of training so far
    gaussians: int
    loss: float
    view: str  # the training view of the step
    render: NDArray[np.float32]  # of that view, [H, W, 3], not clamped; may be smaller than the photo
    evaluated: HistoryEntry | None  # where the held-out views were measured after this step
    diagnosis: Diagnosis | None = field(repr=False)  # of the photos; None: the method asked for none
    _step: Step = field(repr=False)
    _trainer: Trainer = field(repr=False)

    def model(self) -> Gaussians:
        """The scene as it is rasterized now; its memory changes with the next step."""
        return self._trainer.model()

    def left(self) -> float:
        """Seconds that the rest of the steps will take, about."""
        return self._trainer.seconds_left()

    def psnr(self) -> float | None:
        """Of the render against the training photo, dB. None where it is infinite or nothing counts."""
        step = self._step
        return psnr(self.render, step.view.image, step.view.mask) if self.render.size else None


OnProgress = Callable[[Progress], None]


@dataclass(frozen=True)
class Run:
    """A training run that has come to its end, or was stopped by Ctrl-C."""

    model: Gaussians  # as the held-out views and scene.ply show it
    report: Report  # what report.json holds
    history: list[HistoryEntry]  # the held-out means while it trained; the last entry is the final one
    left_out: list[LeftOut]  # what the run did without, and why
    iterations: int  # training views seen
    length: int  # of the whole run
    seconds: float  # of training, without loading and the report
    views: Sequence[RenderedView] = field(repr=False)  # the held-out views; large ones are rendered anew
    out: Path | None  # the folder with the files; None: nothing was written

    def _repr_html_(self) -> str:
        """What a notebook shows: the verdict, and a held-out photo beside its render."""
        return summary_html(self.report, self.views)

    @property
    def finished(self) -> bool:
        """Whether it came to its end; False: Ctrl-C."""
        return self.iterations == self.length


@dataclass(frozen=True, kw_only=True)
class TrainCall(TrainOptions):
    """The arguments of `train`."""

    scene: Scene = field(kw_only=False)
    out: str | Path | None = None
    config: TrainConfig | Said | None = None
    resume: bool = False
    overwrite: bool = False
    progress: OnProgress | None = None
    on_stage: OnStage = silent
    ranks: Ranks = ALONE


@called_with(TrainCall)
@own_state(grad=True)
def train(call: TrainCall) -> Run:
    """Train a scene on the CPU. Same seed, same bits, for any number of threads, interrupted or not.

    The first Ctrl-C (or SIGTERM) ends the run after the step it is in: everything is written and returned,
    and `Run.finished` is False. The second raises KeyboardInterrupt at once and leaves the files as they were
    last written.

    Args:
        scene: from `hqgs.load`, or made of `hqgs.View` and points.
        out: a folder for checkpoint.safetensors, scene.ply, config.json, report.json, report.html,
            `comparison/*.png`, cameras.json and `photos/*.jpg`; None: nothing is written.
        iterations: training views to render; None: until the scene stops improving, at most 30,000.
        batch: of them in a step, rendered one after the other, or by several processes.
        seconds: of training, instead of `iterations`: as many iterations as fit, by the steps that are timed
            before training and once more after densification. plan.json in the run's folder repeats the
            result bit for bit.
        method: "auto" or "hqgs" (the degradation of the photos, if any, is part of the loss), "3dgs" or
            "srgs".
        leave_out: what may be left out if the scene does not need it: "auto", "none", or some of photos,
            growth, resolution, iterations, separated by commas.
        seed: of all random numbers.
        max_gaussians: the most Gaussians; limits the memory.
        guidance: of hqgs: "formation", or "paper", its published form.
        formation: the degradation of the photos, as `hqgs.degrade` reads it; "auto": it is measured.
        eval_every: iterations between evaluations; None: a tenth of the run.
        config: a `hqgs.TrainConfig`, or the options of one, as in config.json of a run; other arguments
            replace its values.
        resume: continue from the checkpoint in `out`, if there is one, with its options unless others are
            given. A finished run continues if `iterations` is larger, with the schedule of the longer run.
        overwrite: start again in a folder that holds a run.
        progress: is called after each step.
        on_stage: is called with what is done before the first step, and how far it is.
        ranks: of `hqgs.base.ranks.joined`, if torchrun has started several processes that make the same
            call. The result does not depend on their number; the first one writes and reports.

    Raises:
        ValueError: a scene or a setting that cannot be trained, a damaged checkpoint, or one of another run.
        FileExistsError: `out` holds a run, and neither `resume` nor `overwrite` is set; or other files
            that the run would overwrite.
        FolderBusyError: another run writes into `out`.
        TrainingError: training cannot continue; the message says at which iteration and why.
        RankError: another rank has failed or does not answer.
    """
    ranks, out = call.ranks, None if call.out is None else Path(call.out).expanduser()
    taken = ranks.first and out is not None and (out / CHECKPOINT).exists()
    if taken and not (call.resume or call.overwrite):
        raise FileExistsError(f"{out} holds a run; resume=True continues it, overwrite=True starts again")
    if call.resume and call.overwrite:
        raise ValueError("resume continues the run, overwrite starts again: give one of them, not both")
    if call.seconds is not None and call.iterations is not None:
        raise ValueError("iterations and seconds: only one of them can be given")
    said, before = call.said(), call.config
    if before is not None:
        said = merged(said_by(before) if isinstance(before, TrainConfig) else before, said)
    elif ranks.first and call.resume and out is not None:  # also one that was killed before a checkpoint
        said = resumed(out, said)
    said = ranks.tell(said if ranks.first else None)[0]
    if out is not None and ranks.first and not taken:
        strangers(out)
    with open_run(call.scene, decided(said), out, call.resume, call.on_stage, ranks, said) as trainer:
        return run_to_end(trainer, out, call.progress)


@contextmanager
def open_run(
    scene: Scene,
    config: TrainConfig,
    out: str | Path | None = None,
    resume: bool = False,
    on_stage: OnStage = silent,
    ranks: Ranks = ALONE,
    said: Said | None = None,
) -> Iterator[Trainer]:
    """A trainer that holds the folder `out`: fresh, or with `resume` where the checkpoint there ends.

    Of several `ranks` the first one holds the folder, and sends the others the checkpoint. `said`: what of
    the configuration somebody has said; None: all.

    Without a checkpoint `resume` starts fresh (the run may have been killed before its first one). A fresh
    run removes what an older one left. See `train` for the errors.
    """
    folder = Path(out) if out is not None and ranks.first else None
    with nullcontext() if folder is None else lock_folder(folder):
        checkpoint = None
        if folder is not None:
            checkpoint = folder / CHECKPOINT
            for file in (CHECKPOINT, PLY):
                remove_leftovers(folder / file)
        going_on = ranks.tell(resume and checkpoint is not None and checkpoint.exists())[0]
        trainer = Trainer(Frame.of(scene), config, Inspector(on_stage), ranks, tries=not going_on)
        if not going_on:
            fit_to_seconds(trainer)
        give_back_memory()  # of the start
        if going_on:
            with _for_all(checkpoint, ranks) as path:
                trainer.restore(path)
        elif checkpoint is not None and checkpoint.exists():  # another run's scene beside these cameras
            RunFolder(checkpoint.parent).remove()
        if ranks.count > 1:
            ranks.agree(scene_fingerprint(trainer.scene), "the scene")
            ranks.agree(trainer.plan, "the plan")
        _check_agreement(trainer)
        if ranks.first:
            on_stage(Stage("planned", 0, 0, essential(trainer.plan)))
        if folder is not None:
            said = said_by(config) if said is None else said
            asked = {"version": __version__, "scene": scene.origin, "said": said}
            write_json(folder / CONFIG, asked | {"train": config_values(config)})
        yield trainer


@contextmanager
def _for_all(file: Path | None, ranks: Ranks) -> Iterator[Path]:
    """The first rank's file, on each rank: the others, which have None, get a copy for a while."""
    data = ranks.begin(file.read_bytes() if file is not None and ranks.count > 1 else b"")()[0]
    if file is not None:
        yield file
        return
    with TemporaryDirectory() as name:
        copy = Path(name) / CHECKPOINT
        copy.write_bytes(data)
        yield copy


def _check_agreement(trainer: Trainer) -> None:
    """RankError where a rank has come to another state than the first one."""
    if trainer.ranks.count > 1:
        trainer.ranks.agree(checksum(trainer.state.tensors()), f"the state at iteration {trainer.iteration}")


def run_to_end(trainer: Trainer, out: str | Path | None = None, progress: OnProgress | None = None) -> Run:
    """Train to the end or to the first Ctrl-C and write everything into `out`, which the caller holds."""
    config, ranks = trainer.config, trainer.ranks
    out = Path(out) if out is not None and ranks.first else None
    ranks.count_anew()
    with deferred_interrupt() as interrupted:
        if out is not None:
            save_cameras(out, trainer.prepared.given, config.background)
        state = trainer.state
        while state.iteration < state.decisions.length and not any(ranks.tell(interrupted.is_set())):
            before = state.iteration
            step = trainer.step()

            def due(every: int, before: int = before) -> bool:
                return state.iteration // every > before // every

            evaluate = due(config.due.eval_every)
            if evaluate:
                trainer.evaluate()
            if progress is not None:
                progress(
                    Progress(
                        iteration=state.iteration,
                        length=state.decisions.length,
                        seconds=state.seconds,
                        gaussians=len(state.gaussians),
                        loss=step.loss,
                        view=step.view.name,
                        render=step.render.numpy(),
                        evaluated=state.history[-1] if evaluate else None,
                        diagnosis=trainer.diagnosis,
                        _step=step,
                        _trainer=trainer,
                    )
                )
            if due(config.due.checkpoint_every):
                _check_agreement(trainer)
                if out is not None:
                    trainer.save(out / CHECKPOINT)
        views = trainer.held_out()
        trainer.evaluate(views)
        if out is not None:
            trainer.save(out / CHECKPOINT)
        return _results(trainer, views, out)


def _results(trainer: Trainer, views: HeldOutViews, out: Path | None) -> Run:
    """Measure the trained scene; write scene.ply and the report into `out`, if there is one.

    Of several ranks the first one measures, and tells the others.
    """
    scene, guard, ranks = trainer.prepared.given, trainer.state.guard, trainer.ranks
    config, decisions = trainer.config, trainer.state.decisions
    if decisions.turned:
        config = replace(config, turn=(decisions.turned, decisions.length))
    model, left_out = trainer.model(), list[LeftOut]()
    model.look, model.world = (scene.test or scene.train)[0].upright_camera, scene.world
    if out is not None and (rows := model.save(out / PLY)):
        left_out.append(LeftOut(f"{rows} Gaussians in {PLY}", "their values are NaN or Inf"))
    if guard.skipped:
        left_out.append(LeftOut(f"{guard.skipped} training steps", "the loss or a gradient was NaN or Inf"))
    if guard.culled:
        why = "a value or a gradient was NaN or Inf"
        left_out.append(LeftOut(f"{guard.culled} Gaussians", why))
    if trainer.iteration < trainer.length:
        what = f"iterations {trainer.iteration + 1} to {trainer.length}"
        left_out.append(LeftOut(what, "the run was stopped"))
    if not views:
        left_out.append(LeftOut("held-out metrics", "no photo is held out to measure with"))
    left_out += trainer.left_out()
    records = cast(list[RankRecord], ranks.tell(ranks.record()) if ranks.count > 1 else [])
    report = _report(trainer, views, model, left_out, config, records, out) if ranks.first else None
    report = cast(Report, ranks.tell(report)[0])
    done, length = trainer.iteration, trainer.length
    return Run(model, report, trainer.history, left_out, done, length, trainer.seconds, views, out)


def _report(
    trainer: Trainer,
    views: HeldOutViews,
    model: Gaussians,
    left_out: list[LeftOut],
    config: TrainConfig,
    ranks: list[RankRecord],
    out: Path | None,
) -> Report:
    """The report, written into `out`, if there is one; what made it is in `trainer`."""
    scene = trainer.prepared.given
    rows = [row.known() for row in (*trainer.plan.rows, *trainer.state.rows)]
    place, sfm, diagnosis = scene.place, scene.sfm, trainer.diagnosis
    learned = [learned_record(found) for found in trainer.method.learned()]
    record: RunRecord = {
        "scene": scene.name,
        "source": scene.source,
        "notes": [*scene.notes, *run_notes(trainer)],
        "method": config.method,
        "seed": config.seed,
        "iterations": trainer.iteration,
        "length": trainer.length,
        "seconds": trainer.seconds,
        "gaussians": len(trainer.gaussians),
        "scene_bytes": None if out is None else (out / PLY).stat().st_size,
        "peak_rss_mb": peak_rss_mb(),
        "history": trainer.history,
        "left_out": [item.known() for item in left_out],
        "guard": trainer.state.guard.summary(),
        "world": cast(WorldRecord, {"metres": None} | replace(scene.world, place=None).json()),
        "place": place and asdict(place),
        "sfm": sfm and asdict(sfm),
        "photos": [photo_record(p) for p in diagnosis.photos] if diagnosis else [],
        "ranks": ranks,
        "learned": learned,
        "config": asdict(config.fitted()),
        "plan": rows,
    }
    if fell := fell_short(trainer):
        record["notes"].insert(0, fell)
        record["fallen"] = fell
    if out is not None and config.seconds is not None:
        write_json(out / PLAN, plan_values(config, rows))
    report = write_report(out, record, views)
    if out is not None:
        write_text(out / PAGE, page_text(report, scene, model, views, diagnosis))
    return report
