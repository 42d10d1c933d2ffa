"""What the pages say is there: paths, commands, flags and names, and which of them are not."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import re
import shlex
import subprocess
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import tyro

from benchmarks.cli import make_parser as benchmarks_parser
from hqgs.cli.main import COMMANDS
from hqgs.cli.parse import MARKERS
from hqgs.cli.train import Whole

ROOT = Path(__file__).parent.parent
PAGES = [*ROOT.glob("*.md"), *sorted(ROOT.glob("docs/**/*.md"))]
FOLDERS = (
    "benchmarks",
    "docs",
    "examples",
    "hqgs",
    "rust",
    "scripts",
    "tests",
    ".ci",
)  # whose paths are checked
SOURCES = (".py", ".rs", ".toml", ".md")  # a name with such an end is a path from the repository's top
CLASSES = ("hqgs", "hqgs.model.gaussians", "hqgs.scene.scene", "hqgs.training.config")  # of `Scene.extent`
TOOLS = ("pip", "pytest", "ruff", "sphinx-build", "torchrun")  # of others, whose flags are not checked


@lru_cache(maxsize=1)
def _hqgs_commands() -> dict[str, argparse.ArgumentParser]:
    options = {name: importlib.import_module(place).OPTIONS for name, (place, _) in COMMANDS.items()}
    parsers: dict[str, Any] = {
        name: tyro.extras.get_parser(Whole if name == "train" else kind, prog=name, config=MARKERS)
        for name, kind in options.items()
    }
    return parsers


def hqgs_parser() -> argparse.ArgumentParser:
    """The commands' parsers below one of argparse, which knows the same options."""
    parser = argparse.ArgumentParser(prog="hqgs")
    parser.add_argument("--version", action="store_true")
    commands = parser.add_subparsers(required=True)
    commands._name_parser_map.update(_hqgs_commands())
    return parser


PARSERS = {"hqgs": hqgs_parser, "benchmarks": benchmarks_parser}
FENCE = re.compile(r"^```(\S*)\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)


def wrong_claims(text: str, folder: Path = ROOT) -> list[str]:
    """Each path, command, flag and name of a page (Markdown, in `folder`) that does not exist, in words."""
    blocks = [(kind, body) for kind, body in FENCE.findall(text)]
    prose = FENCE.sub("", text)
    spans = re.findall(r"(?<!`)`([^`\n]+)`(?!`)", prose)
    wrong = [f"link to {link}" for link in _links(prose) if not (folder / link).exists()]
    for span in spans:
        wrong += [f"path {path}" for path in _paths(span) if not any(ROOT.glob(path))]
        wrong += [f"name {name}" for name in _names(span) if not _resolves(name)]
        wrong += [problem for words in _commands(span) for problem in _wrong_mention(words)]
    for kind, body in blocks:
        if kind == "python":
            wrong += [f"name {name}" for name in _names(body) if not _resolves(name)]
        elif kind == "sh":
            for line in body.splitlines():
                wrong += [f"path {path}" for path in _paths(line) if not any(ROOT.glob(path))]
                wrong += [problem for words in _commands(line) for problem in wrong_command(words)]
    return wrong


def wrong_command(words: list[str]) -> list[str]:
    """A whole command, as a user would type it: why its own parser refuses it."""
    parser, arguments = _parser_of(words)
    if parser is None:
        return _wrong_mention(words)
    try:
        _raise_errors(parser).parse_args(arguments)
    except ValueError as error:
        return [f"{shlex.join(words)}: {error}"]
    return []


def _wrong_mention(words: list[str]) -> list[str]:
    """A command as prose names it, where arguments may be missing: flags and choices that do not exist."""
    if words[0] == "cargo":
        return _wrong_cargo(words)
    if words[0].startswith(("examples/", "scripts/")):
        source = (ROOT / words[0]).read_text(encoding="utf-8") if (ROOT / words[0]).is_file() else ""
        return [f"{words[0]} {flag}" for flag in _flags(words) if f'"{flag}"' not in source]
    if words[0].startswith("--"):
        known: dict[str, argparse.Action] = {}
        for make in PARSERS.values():
            for parser in _commands_of(make()).values():
                known |= parser._option_string_actions
        return _wrong_flags(words, known, "any command")
    parser, arguments = _parser_of(words)
    if parser is None:
        return [f"command {words[0]}"] if _flags(words) and words[0] not in TOOLS else []
    commands = _commands_of(parser)
    if not arguments or arguments[0] == "--help":
        return []
    if arguments[0] not in commands:
        return [f"command {arguments[0]} of {parser.prog}"]
    return _wrong_flags(arguments, commands[arguments[0]]._option_string_actions, shlex.join(words[:4]))


def _wrong_flags(words: list[str], known: dict[str, argparse.Action], where: str) -> list[str]:
    wrong = [f"flag {flag} of {where}" for flag in _flags(words) if flag not in known]
    for flag, value in pairwise(words):
        choices = known[flag].choices if flag in known else None
        if choices is not None and not value.startswith("--") and value not in choices:
            wrong.append(f"{flag} {value} of {where}")
    return wrong


def _wrong_cargo(words: list[str]) -> list[str]:
    kinds = {"--bench": "bench", "--example": "example", "--test": "test"}
    packages = _cargo_packages()
    targets = [(kind, target["name"]) for p in packages for target in p["targets"] for kind in target["kind"]]
    features = {feature for package in packages for feature in package["features"]}
    wrong = []
    for flag, value in pairwise(words):
        if flag in kinds and (kinds[flag], value) not in targets:
            wrong.append(f"cargo {flag} {value}")
        if flag in ("-p", "--package") and value not in {package["name"] for package in packages}:
            wrong.append(f"cargo {flag} {value}")
        if flag == "--features" and value not in features:
            wrong.append(f"cargo {flag} {value}")
    return wrong


@lru_cache(maxsize=1)
def _cargo_packages() -> list[dict[str, Any]]:
    command = ["cargo", "metadata", "--no-deps", "--offline", "--format-version", "1"]
    found = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return json.loads(found.stdout)["packages"]


def _links(prose: str) -> list[str]:
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", prose)
    return [link for link in links if "://" not in link]


def _paths(code: str) -> list[str]:
    """Those that start in a folder of the repository, and names of source files."""
    words = [word.strip("\"'(),:;") for word in code.split()]
    return [
        word.rstrip("/")
        for word in words
        if "://" not in word
        and not word.startswith("--")
        and ((word.split("/")[0] in FOLDERS and "/" in word) or word.endswith(SOURCES))
    ]


def _names(code: str) -> list[str]:
    """`hqgs.a.b`, and attributes of classes: `Scene.extent`; `NAME.txt` stands for a file of any name."""
    names = re.findall(r"(?<![\w/.\"'])(?:hqgs(?:\.[A-Za-z_]\w*)+|[A-Z]\w*\.[a-z_]\w*)(?![\w/\"'])", code)
    return [name for name in names if not name.endswith(SOURCES) and not name.split(".")[0].isupper()]


def _resolves(name: str) -> bool:
    """Whether `hqgs.a.b` is a module, or what a module or class holds; whether a class has `Class.name`."""
    first, *rest = name.split(".")
    if first[0].isupper():
        classes = [getattr(importlib.import_module(module), first, None) for module in CLASSES]
        return any(_has(found, rest[0]) for found in classes if found is not None)
    found: Any = importlib.import_module(first)
    for i, part in enumerate(rest, start=1):
        module = ".".join([first, *rest[:i]])
        if hasattr(found, "__path__") and not hasattr(found, part) and importlib.util.find_spec(module):
            found = importlib.import_module(module)
        elif _has(found, part):
            found = getattr(found, part, None)
        else:
            return False
    return True


def _has(found: Any, name: str) -> bool:
    return hasattr(found, name) or name in getattr(found, "__dataclass_fields__", {})


def _commands(line: str) -> Iterator[list[str]]:
    """The simple commands of a line, without `uv run`."""
    try:
        words = shlex.split(line, comments=True)
    except ValueError:  # prose with an apostrophe
        return
    command: list[str] = []
    for word in [*words, "&&"]:
        if word != "&&":
            command.append(word)
            continue
        if command[:2] == ["uv", "run"]:
            command = command[2:]
        if command[:1] == ["torchrun"] and "-m" in command:
            command = ["python", *command[command.index("-m") :]]
        if command[:1] == ["python"] and command[1:2] != ["-m"]:
            command = command[1:]
        if command:
            yield command
        command = []


def _parser_of(words: list[str]) -> tuple[argparse.ArgumentParser | None, list[str]]:
    """The parser of a command and the arguments that it gets; none for a command that is not ours."""
    if words[:2] == ["python", "-m"] and words[2:3] and words[2] in PARSERS:
        return PARSERS[words[2]](), words[3:]
    if words[0] == "hqgs" and len(words) > 1:
        return hqgs_parser(), words[1:]
    if words[0] in _commands_of(hqgs_parser()) and _flags(words):
        return hqgs_parser(), words
    return None, []


def _commands_of(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    (action,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return action.choices


def _flags(words: list[str]) -> list[str]:
    return [word.split("=")[0] for word in words if word.startswith("--") and word != "--"]


def _raise_errors(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """The parser, which raises ValueError where it would end the program, and takes no shortened flag."""

    def error(message: str) -> Any:
        raise ValueError(message)

    for one in (parser, *_commands_of(parser).values()):
        one.error = error
        one.allow_abbrev = False
    return parser
