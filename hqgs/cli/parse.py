"""From arguments to the options of a command, which are a dataclass; by tyro."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from collections.abc import Sequence
from typing import TypeVar

import tyro

from hqgs.base.options import PLAIN
from hqgs.cli.errors import fail

T = TypeVar("T")
MARKERS = (tyro.conf.FlagCreatePairsOff, tyro.conf.AvoidSubcommands)
WORDS = {  # tyro's, and ours
    r"Unrecognized options?: (?!-)": "one argument too many: ",
    r"(one argument too many: .*\.(?:jpe?g|png|heic|tiff?|mp4|mov|json|txt)\b.*)": r"\1; give their folder",
    r"Unrecognized options?:": "there is no option",
    r"Missing from hqgs \w+:": "missing:",
    r"Perhaps you meant:": "- did you mean",
    r"(?<=\S) (?=there is no option|missing:)": "; ",
    r"(there is no option --?[\w-]+)(?:,? [^-\s;]+)+": r"\1",  # what followed it is none of its own
    r"invalid choice '(.*?)' for argument '(.*?)'\. Expected one of \((.*?)\)\.": (
        r"\2 is \1, wanted one of: \3"
    ),
    r"Error parsing (\S+):(?= is )": r"\1",
    r"Error parsing \S+: ": "",
}
POINT = re.compile(r"-[\d.]+(?:e-?\d+)?,")  # one whose first coordinate is negative
HOME = re.compile(r"^(--[\w-]+=)?(~(?:/.*)?)$", re.DOTALL)  # which the shell leaves as it is after =


def parse(options: type[T], command: str, about: str, arguments: Sequence[str]) -> T:
    """The options that the arguments give. Help and mistakes end the program, mistakes with one sentence."""
    if asked := [a for a in arguments if a.split("=")[0] in ("--device", "--cuda", "--gpu", "--gpus")]:
        raise SystemExit(fail(2, f"there is no {asked[0]}: hqgs runs on the CPU; leave this option out"))
    if asked := [a for a in arguments if a in ("-s", "--source_path", "-m", "--model_path")]:
        raise SystemExit(fail(2, f"there is no {asked[0]}: write hqgs train PHOTOS --out RUN"))
    arguments = [f" {a}" if POINT.match(a) else a for a in arguments]  # else -1,2,3 would be an option
    arguments = [HOME.sub(lambda m: (m[1] or "") + os.path.expanduser(m[2]), a) for a in arguments]
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(
                options,
                prog=f"hqgs {command}",
                description=f"{about[0].upper()}{about[1:]}.",
                args=list(arguments),
                config=MARKERS,
                registry=PLAIN,
            )
    except SystemExit as end:
        if not end.code:  # help
            raise
        raise SystemExit(fail(2, f"{_sentence(told.getvalue())} (hqgs {command} --help)")) from None
    finally:
        if sys.exc_info()[0] is None:
            sys.stderr.write(told.getvalue())


def _sentence(box: str) -> str:
    """What tyro draws as a box, as one line without the options' help."""
    kept = []
    for line in (line.strip("│") for line in box.splitlines()[1:]):
        if len(line) - len(line.lstrip()) >= 8:  # columns from the border: it explains an option
            continue
        line = line.strip("│╭╮╰╯─ \n").rstrip()
        if line.startswith(("Got errors", "Argument helptext")):
            break
        if line.strip("-") and not line.startswith(("For full helptext", "hqgs ")):
            kept.append(line)
    text = " ".join(kept).replace("{None}|", "")
    for said, meant in WORDS.items():
        text = re.sub(said, meant, text)
    return text
