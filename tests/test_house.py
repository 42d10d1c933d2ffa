"""The floor plan stays what docs/architecture.md draws: few layers, small files, a sentence at each door."""

from __future__ import annotations

import ast
import subprocess
from pathlib import Path

import pytest

from hqgs.base.files import CHECKPOINT

ROOT = Path(__file__).parent.parent
FOLDERS = ("benchmarks", "examples", "hqgs", "scripts")
FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
PACKAGES = [path for path in FILES if path.name == "__init__.py"]
OF_PYTHON = {"__init__.py", "__main__.py", "__pycache__", "_rust.abi3.so", "_rust.pyi", "py.typed"}
MOST_LAYERS, MOST_LINES, MOST_IN_FUNCTION = 12, 700, 60


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_a_newcomer_sees_few_layers_and_the_map_has_each() -> None:
    """Beside the files that Python itself wants in a package."""
    layers = {path.name for path in (ROOT / "hqgs").iterdir()} - OF_PYTHON
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert len(layers) <= MOST_LAYERS
    assert [layer for layer in sorted(layers) if f"| `hqgs/{layer}" not in page] == []


def test_no_file_is_long() -> None:
    lines = {relative(path): len(path.read_text(encoding="utf-8").splitlines()) for path in FILES}
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}


def test_no_function_is_long() -> None:
    """Its docstring does not count."""
    long = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            first = node.body[0]
            told = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
            docstring = (first.end_lineno or 0) - first.lineno + 1 if told else 0
            if (node.end_lineno or 0) - node.lineno + 1 - docstring > MOST_IN_FUNCTION:
                long.append(f"{relative(path)}: {node.name}")
    assert long == []


def test_a_file_begins_with_what_lives_there() -> None:
    assert [relative(p) for p in FILES if not p.read_text(encoding="utf-8").startswith('"""')] == []


@pytest.mark.parametrize("package", PACKAGES, ids=relative)
def test_a_folder_says_in_a_sentence_what_lives_there(package: Path) -> None:
    told = ast.get_docstring(ast.parse(package.read_text(encoding="utf-8")))
    assert told is not None
    assert told.splitlines()[0].endswith(".")


def test_no_run_lies_in_the_repository() -> None:
    """What a run writes is large, and of somebody's photos."""
    try:
        told = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no clone, or git may not read it")
    files = [ROOT / name for name in told.stdout.decode().split("\0") if name]
    runs = [file for file in files if file.name in {CHECKPOINT, "scene.ply", "report.json", "report.html"}]
    assert not runs
    assert not [file for file in files if file.exists() and file.stat().st_size > 2**20]
