"""The command line: `hqgs COMMAND ...`; each command has a module of its own, loaded when it is used.

Exit codes: 0 done; 1 the run failed (a full disk, no Gaussians left); 2 bad input; 130 stopped by Ctrl-C or
SIGTERM. Then a training run has written everything, unless Ctrl-C was pressed twice, and degrading nothing.
141: nobody reads the output any more (`hqgs ... | head`), as with other programs.
"""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from io import TextIOWrapper
from typing import TextIO

from hqgs import __version__
from hqgs.cli.errors import BAD_INPUT, fail

# A command's module, and what it is about. The module has `OPTIONS`, a dataclass, and `run`, which takes one
# and gives an exit code; it may have `read` in place of `hqgs.cli.parse.parse`.
COMMANDS = {
    "train": ("hqgs.cli.train", "make a scene and a report from photos or a film"),
    "sfm": ("hqgs.cli.sfm", "find cameras and points of photos or a film (COLMAP)"),
    "judge": ("hqgs.cli.judge", "measure how good a run or a scene file is, and what causes its errors"),
    "eval": ("hqgs.cli.judge", "the same as judge"),
    "render": ("hqgs.cli.render", "make pictures and films of a scene"),
    "view": ("hqgs.cli.view", "show a scene in a browser (train --view: while it trains)"),
    "export": ("hqgs.cli.export", "write a smaller scene file, or another format"),
    "plan": ("hqgs.cli.plan", "print the settings that a run would use, and why, without training"),
    "clean": ("hqgs.cli.clean", "remove floaters from a scene file"),
    "diagnose": ("hqgs.cli.diagnose", "measure blur, noise, JPEG compression and exposure of photos"),
    "degrade": ("hqgs.cli.degrade", "write a scene with degraded training photos"),
    "info": ("hqgs.cli.info", "print what a run, a scene file or a folder of photos holds"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code. SIGTERM counts as Ctrl-C."""
    # None where the shell closed them (`>&-`).
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a name that it cannot show is no reason to fail
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            return command(argv)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        if not any([unread(stream) for stream in (sys.stdout, sys.stderr)]):
            raise
        return 141


def unread(stream: TextIO) -> bool:
    """Whether nobody reads the stream any more; then what it still holds goes nowhere."""
    poll = select.poll()
    poll.register(stream, select.POLLOUT)
    gone = any(event & select.POLLERR for _, event in poll.poll(0))
    if gone:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return gone


def command(argv: Sequence[str] | None) -> int:
    """The exit code of the command that `argv` names; of what was typed where it is None."""
    name, *rest = [*(sys.argv[1:] if argv is None else argv)] or ["--help"]
    if name in ("-h", "--help", "help"):
        print(overview())
        return 0
    if name in ("-V", "--version"):
        print(f"hqgs {__version__}")
        return 0
    if name not in COMMANDS:
        near = get_close_matches(name, COMMANDS, n=1)
        mean = f"did you mean {near[0]!r}? " if near else ""
        what = "option" if name.startswith("-") else "command"
        return fail(2, f"there is no {what} {name!r}; {mean}the commands are: {', '.join(COMMANDS)}")
    options: object = None
    try:
        from hqgs.cli.parse import parse  # here: only a command waits for the parser

        place, about = COMMANDS[name]
        module = import_module(place)
        options = getattr(module, "read", parse)(module.OPTIONS, name, about, rest)
        return module.run(options)
    except KeyboardInterrupt:
        return fail(130, "stopped")
    except BrokenPipeError:  # `main` knows it
        raise
    except BAD_INPUT as error:
        return fail(2, error)
    except OSError as error:
        places = [getattr(options, place, None) for place in ("out", "source", "path", "scene")]
        return fail(1, f"{next(filter(None, places), name)}: {error}")


def overview() -> str:
    """What `hqgs --help` says."""
    width = max(map(len, COMMANDS))
    commands = [f"  {name:{width}}  {about}" for name, (_, about) in COMMANDS.items()]
    return "\n".join(
        [
            "usage: hqgs COMMAND ...",
            "",
            "3D Gaussian Splatting from bad photos, on the CPU.",
            "",
            *commands,
            "",
            "  hqgs train PHOTOS --out RUN --preset quick   a first scene",
            "  hqgs COMMAND --help                          the options of a command",
            "  hqgs --version",
        ]
    )
