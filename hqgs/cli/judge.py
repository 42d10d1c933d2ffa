"""`hqgs judge SCENE_FILE --photos SCENE`: how good a scene of any program is, how sure that is, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from hqgs import __version__
from hqgs.base.files import CONFIG, write_json, write_text
from hqgs.base.options import Color
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import MeasuredOptions, check_background, check_out_folder, measured_scene, ready
from hqgs.evaluation.verdict import judged_by, judgement

if TYPE_CHECKING:
    from hqgs.evaluation.held_out import HeldOutViews
    from hqgs.photos.look import Look
    from hqgs.scene.scene import Scene, View

NUMBERS, PAGE = "judge.json", "judge.html"


@dataclass(frozen=True, kw_only=True)
class Judge(MeasuredOptions):
    """Options of `hqgs judge`."""

    against: Annotated[Path | None, tyro.conf.arg(metavar="OTHER", help_behavior_hint="")] = None
    """Another scene of the same photos to compare with, or its judge.json."""
    views: Annotated[str, tyro.conf.arg(metavar="WHICH")] = "test"
    """Photos to measure on: test (held out), train, all, or names separated by commas."""
    background: Color = None
    """Background colour R G B; 1 is white (that of the run, or black)."""
    fit_cameras: bool = False
    """Also measure with each pose refined to the scene, about 10 s a photo: shows what pose errors cost."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="")] = None
    """Also write judge.json and judge.html, a page of photos beside renders, into this folder."""


OPTIONS = Judge


def run(options: Judge) -> int:
    """Measure and say how good it is; return the exit code (0 done, 1 failed, 2 bad input)."""
    if options.background is not None:
        check_background(options.background)
    if options.out is not None:
        check_out_folder(options.out)
    source, other, known = check_source(options.source, options.photos), None, None
    from hqgs.evaluation.held_out import looks_beside  # here: they load torch
    from hqgs.evaluation.judge import check_comparable, chosen_views, compared, protocol_of, read_judgement
    from hqgs.evaluation.run_folder import RunFolder
    from hqgs.model.formats.files import scene_file

    run, against = RunFolder.open(options.source), options.against
    if against is not None and against.suffix.lower() == ".json" and against.is_file():
        known = read_judgement(against)
    elif against is not None:
        other = scene_file(against)
    with LoadingScreen() as screen:
        scene = measured_scene(run, options, screen)
        views = chosen_views(scene, options.views)
        background = run.background if options.background is None else options.background
        files = [file for file in (source, other) if file is not None]
        # Those of the run that one of them lies in count for both.
        looks = next((found for file in files if (found := looks_beside(file, scene.train))), {})
        protocol = protocol_of(scene, options.views, views, background) | {"looks": bool(looks)}
        if known is not None:
            check_comparable(protocol, known["protocol"], str(options.against))
        judged = [
            judge_file(file, scene, views, background, screen, options.fit_cameras, looks) for file in files
        ]
    found: dict[str, Any] = {"hqgs": __version__, "protocol": protocol, "scene": judged[0][0]}
    if known is not None or other is not None:
        found["against"] = known["scene"] if known is not None else judged[1][0]
        found["difference"] = compared(found["scene"], found["against"])
    psnr, name = judged_by({**(run.report or {}), "metrics": {"mean": found["scene"]["mean"]}})
    found["judged_by"] = {"psnr": psnr, "name": name}
    if options.out is not None:
        from hqgs.show.page.judge_page import judge_page

        write_json(options.out / NUMBERS, found)
        write_text(options.out / PAGE, judge_page(found, judged[0][1]))
    print(judgement(found))
    if options.out is not None:
        print(f"\n{options.out / PAGE}: photos beside renders, and where the errors are")
    return 0


def check_source(source: Path, photos: str | None) -> Path:
    """The scene file that is meant, before anything that takes seconds. BAD_INPUT errors."""
    from hqgs.model.formats.files import format_of, scene_file  # here: --help waits for no array

    file = scene_file(source)
    format_of(file)
    if photos is None and not (source.is_dir() and (source / CONFIG).is_file()):
        raise ValueError(
            f"{source} is not the folder of a run: give --photos, a folder of photos with their cameras "
            "(COLMAP, nerfstudio, ...) to measure it with"
        )
    ready(str(source) if photos is None else photos)
    return file


def judge_file(
    file: Path,
    scene: Scene,
    views: Sequence[View],
    background: tuple[float, float, float],
    screen: LoadingScreen,
    fit: bool,
    looks: dict[str, Look],
) -> tuple[dict[str, Any], HeldOutViews]:
    """A scene file, measured; what its reading left out is told."""
    from hqgs.evaluation.judge import judge
    from hqgs.model.formats.files import bytes_of
    from hqgs.model.gaussians import Gaussians

    gaussians = Gaussians.load(file)
    for note in gaussians.notes:
        screen.say(f"read: {note}")
    held = gaussians.in_world(scene.world)
    return judge(str(file), bytes_of(file), held, scene, views, background, fit, screen.stage, looks)
