"""`hqgs view`: a page on this machine to look at a scene, and the same while it trains."""

from __future__ import annotations

import os
import time
import webbrowser
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from hqgs.cli.scenes import heed_endings, tell_read
from hqgs.evaluation.run_folder import RunFolder
from hqgs.show.viewer.guard import ELSEWHERE, PORT, check

if TYPE_CHECKING:
    from hqgs.pipeline import Progress
    from hqgs.scene.scene import Scene
    from hqgs.show.viewer.viewer import Viewer

EVERY = 2.0  # seconds between copies of the scene while it trains


Port = Annotated[int, tyro.conf.arg(metavar="P", help="Port of the page: the first one to try; 0: any.")]
Open = Annotated[bool, tyro.conf.arg(help_behavior_hint="", help="Open the page in this machine's browser.")]


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Options of `hqgs view`."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """The folder of a run, or a scene file."""
    port: Port = PORT
    open: Open = False


OPTIONS = ViewOptions


def run(options: ViewOptions, seconds: float | None = None) -> int:
    """Show a scene until Ctrl-C, or for some seconds; return the exit code (0 done, 2 bad input)."""
    from hqgs.model.formats.files import scene_file  # here: --help waits for no array

    file = scene_file(options.source)
    check(options.port)
    from hqgs.model.gaussians import Gaussians  # here: they load torch
    from hqgs.show.viewer.viewer import Viewer

    heed_endings()
    gaussians, run = Gaussians.load(file), RunFolder.open(file)
    report, title = run.report, run.folder.resolve().name
    cameras, source = gaussians.along(run.cameras), options.source
    viewer = Viewer(cameras, run.folder, port=options.port, title=title, source=source)
    try:
        tell_read(gaussians)
        viewer.set_scene(gaussians, _numbers(report, len(gaussians)))
        viewer.offer_trust()
        _tell(viewer.url, options.open)
        viewer.serve(seconds)
    except KeyboardInterrupt:
        print()
    finally:
        viewer.close()
    return 0


class LiveView:
    """The page of a run that trains: hand it to `hqgs.train` as `progress`, or call it in yours."""

    def __init__(self, scene: Scene, out: Path, *, port: int = PORT, open_browser: bool = False) -> None:
        self._scene, self._out, self._port, self._open = scene, out, port, open_browser
        self._copied = -EVERY  # when; below 0: nothing has been shown

    @cached_property
    def viewer(self) -> Viewer:
        """The page, from the first step on: by then the run holds its folder, and has written its cameras.

        ValueError without viser, the extra `view`.
        """
        from hqgs.show.viewer.viewer import Viewer

        viewer = Viewer(RunFolder(self._out).cameras, self._out, port=self._port, title=self._scene.name)
        _tell(viewer.url, self._open)
        return viewer

    def __call__(self, now: Progress) -> None:
        """Show the scene as it is, every two seconds, and answer the page after each step."""
        first, last = self._copied < 0, now.iteration == now.length
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
        from hqgs.model.gaussians import Gaussians

        if self._copied < 0:  # a run that had ended already makes no step
            gaussians = Gaussians.load(self._out)
            self.viewer.set_scene(gaussians, _numbers(RunFolder(self._out).report, len(gaussians)))
        _tell(self.viewer.url, open_browser=False)
        try:
            self.viewer.serve()
        except KeyboardInterrupt:
            print()
        finally:
            self.close()

    def close(self) -> None:
        """Close the page, if there is one."""
        if "viewer" in vars(self):
            self.viewer.close()


def _tell(url: str, open_browser: bool) -> None:
    print(f"open {url} in a browser on this machine; Ctrl-C ends it", flush=True)
    if elsewhere():
        print(ELSEWHERE.format(port=url.rsplit(":", 1)[-1]), flush=True)
    if open_browser:
        webbrowser.open(url)


def elsewhere() -> bool:
    """Whether the browser is likely on another machine: from a container, an ssh session, a notebook."""
    marks = ("SSH_CONNECTION", "SSH_TTY", "VSCODE_IPC_HOOK_CLI", "REMOTE_CONTAINERS", "CODESPACES")
    marks += ("JUPYTERHUB_USER", "COLAB_RELEASE_TAG", "KUBERNETES_SERVICE_HOST")
    return any(os.environ.get(mark) for mark in marks) or Path("/.dockerenv").exists()


def _numbers(report: Any, gaussians: int) -> list[tuple[str, str]]:
    rows = [("Gaussians", f"{gaussians:,}")]
    if report is not None:
        mean = report["metrics"]["mean"]
        rows += [
            ("iterations", f"{report.get('iterations', '-')}"),
            ("method", str(report.get("method", "-"))),
        ]
        rows += [
            (name.upper(), f"{mean[name]:.3f}") for name in ("psnr", "ssim") if mean.get(name) is not None
        ]
    return rows
