"""`hqgs view`: a page on this machine to look at a scene, and the same while it trains."""

from __future__ import annotations

import argparse
import time
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.model.formats.files import scene_file

if TYPE_CHECKING:
    from hqgs.scene.scene import Scene
    from hqgs.training.progress import Progress

PORT = 8080
EVERY = 2.0  # seconds between copies of the scene while it trains


def run(source: Path, *, port: int = PORT, open_browser: bool = False, seconds: float | None = None) -> int:
    """Show a run, or a scene file, until Ctrl-C; return the exit code (0 done, 2 bad input).

    Args:
        source: the folder of a run, or a scene file.
        port: the first to try; 0: any that is free.
        open_browser: also open the page in the browser of this machine.
        seconds: end by itself after this time; None: at Ctrl-C.
    """
    try:
        file = scene_file(source)
        from hqgs.model.gaussians import Gaussians  # here: they load torch
        from hqgs.scene.camera_files import CAMERAS, load_cameras
        from hqgs.viewer.viewer import Viewer

        gaussians = Gaussians.load(file)
        folder = file.parent
        known = load_cameras(folder) if (folder / CAMERAS).is_file() else None
        viewer = Viewer(known, folder, port=port, title=folder.resolve().name)
    except BAD_INPUT as error:
        return fail(2, str(error))
    viewer.set_scene(gaussians, _numbers(folder, len(gaussians)))
    _tell(viewer.url, open_browser)
    try:
        viewer.serve(seconds)
    except KeyboardInterrupt:
        print()
    finally:
        viewer.close()
    return 0


class LiveView:
    """The page of a run that trains: hand it to `hqgs.train` as `progress`, or call it in yours."""

    def __init__(self, scene: Scene, out: Path, *, port: int = PORT, open_browser: bool = False) -> None:
        """ValueError without viser, the extra `view`."""
        from hqgs.scene.camera_files import load_cameras, save_cameras
        from hqgs.viewer.viewer import Viewer

        save_cameras(out, scene)
        self.viewer = Viewer(load_cameras(out), out, port=port, title=scene.name)
        self._copied = -EVERY
        _tell(self.viewer.url, open_browser)

    def __call__(self, now: Progress) -> None:
        """Show the scene as it is, every two seconds, and answer the page after each step."""
        first, last = now.iteration == 1, now.iteration == now.length
        due = self.viewer.watched and time.monotonic() - self._copied > EVERY
        if first or last or due:
            rows = [("iteration", f"{now.iteration} of {now.length}"), ("Gaussians", f"{now.gaussians:,}")]
            if now.evaluated is not None and now.evaluated["psnr"] is not None:
                rows.append(("held-out PSNR", f"{now.evaluated['psnr']:.2f} dB"))
            self.viewer.set_scene(now.model(), rows)
            self._copied = time.monotonic()
        self.viewer.pump()

    def stay(self) -> None:
        """Go on showing the trained scene until Ctrl-C."""
        try:
            self.viewer.serve()
        except KeyboardInterrupt:
            print()
        finally:
            self.viewer.close()


def _tell(url: str, open_browser: bool) -> None:
    print(f"look at {url} in a browser of this machine; Ctrl-C ends it", flush=True)
    if open_browser:
        webbrowser.open(url)


def _numbers(folder: Path, gaussians: int) -> list[tuple[str, str]]:
    from hqgs.evaluation.report import REPORT, read_report

    rows = [("Gaussians", f"{gaussians:,}")]
    if (folder / REPORT).is_file():
        report: Any = read_report(folder / REPORT)
        mean = report["metrics"]["mean"]
        rows += [
            ("iterations", f"{report.get('iterations', '-')}"),
            ("method", str(report.get("method", "-"))),
        ]
        rows += [
            (name.upper(), f"{mean[name]:.3f}") for name in ("psnr", "ssim") if mean.get(name) is not None
        ]
    return rows


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command `view` and its options."""
    parser = commands.add_parser("view", help="look at a scene in a browser")
    parser.set_defaults(run=lambda args: run(args.source, port=args.port, open_browser=args.open))
    parser.add_argument("source", type=Path, metavar="SOURCE", help="folder of a run, or a scene file")
    add_options(parser)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Of the page, for `view` and `train --view`."""
    parser.add_argument("--port", type=int, default=PORT, metavar="P", help="first to try (%(default)s)")
    parser.add_argument("--open", action="store_true", help="open the page in this machine's browser")
