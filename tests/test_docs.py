"""What README, CONTRIBUTING, CHANGELOG and docs name is there, and they are short enough to be read."""

from __future__ import annotations

from pathlib import Path

import pytest
from docs_claims import PAGES, ROOT, wrong_claims, wrong_command

RESULTS = {ROOT / "docs" / "results.md", ROOT / "docs" / "log.md", *ROOT.glob("docs/results/*.md")}
GUIDE = set(ROOT.glob("docs/**/*.md")) - RESULTS


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_everything_that_a_page_names_exists(page: Path) -> None:
    assert wrong_claims(page.read_text(encoding="utf-8"), page.parent) == []


@pytest.mark.parametrize(
    ("pages", "most"),
    [({ROOT / "README.md"}, 700), ({ROOT / "CHANGELOG.md"}, 600), (GUIDE, 9_300)],
    ids=["README", "CHANGELOG", "guide and how it works"],
)
def test_pages_are_short_enough_to_be_read(pages: set[Path], most: int) -> None:
    """Words as `wc -w` counts them."""
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in pages) <= most


@pytest.mark.parametrize(
    "page",
    [
        "see `hqgs/scene/load.py`, `rust/`, `docs/results/*.csv` and [the README](README.md)",
        "`train --sfm`, `--leave-out none`, `python -m hqgs export`, `uv run pytest tests/test_docs.py`",
        "`hqgs.rasterization`, `hqgs.scene.load.load_scene`, `Scene.seen`; not `report.json`, `NAME.txt`",
        "```sh\nuv run python -m hqgs train FOLDER --out DIR  # a comment\n```",
        "```python\nimport hqgs\nhqgs.set_num_threads(2)\n```",
    ],
)
def test_what_exists_is_not_found_wrong(page: str) -> None:
    assert wrong_claims(page) == []


@pytest.mark.parametrize(
    ("page", "wrong"),
    [
        ("see `hqgs/scene/laod.py`", "path hqgs/scene/laod.py"),
        ("see `methods.py`", "path methods.py"),
        ("see [that page](docs/nowhere.md#here)", "link to docs/nowhere.md"),
        ("`uv run pytest tests/test_nothing.py`", "path tests/test_nothing.py"),
        ("`train --no-such-flag`", "flag --no-such-flag"),
        ("`--no-such-flag`", "flag --no-such-flag"),
        ("`--guidance papr`", "--guidance papr"),
        ("`uv run python -m hqgs trian FOLDER`", "command trian"),
        ("`python -m benchmarks qualty --sfm`", "command qualty"),
        ("`bench quality --sfm`", "command bench"),
        ("`examples/train_llff.py --epochs 3`", "examples/train_llff.py --epochs"),
        ("`cargo bench --bench nothing`", "cargo --bench nothing"),
        ("`hqgs.rasterise`", "name hqgs.rasterise"),
        ("`TrainConfig.selective_atom`", "name TrainConfig.selective_atom"),
        ("```python\nhqgs.rasterise(means)\n```", "name hqgs.rasterise"),
        ("```sh\npython -m hqgs train FOLDER\n```", "--out"),  # which it cannot do without
        ("```sh\npython -m hqgs diagnose FOLDER --down 2\n```", "--down"),  # no shortened flag
        ("```sh\npython -m benchmarks quality --seeds none\n```", "--seeds"),
        ("```sh\npip install -q uv && uv run examples/nothing.py\n```", "path examples/nothing.py"),
    ],
)
def test_what_does_not_exist_is_found(page: str, wrong: str) -> None:
    (found,) = wrong_claims(page)
    assert wrong in found


def test_a_report_with_a_flag_that_is_gone_is_found() -> None:
    (found,) = wrong_command(["python", "-m", "benchmarks", "quality", "--scene-of-old", "fern"])
    assert "--scene-of-old" in found
