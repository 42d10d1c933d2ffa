"""What a release needs: one version, a citation that is one, extras, and a script that looks first."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import network
import network_machines
import pytest
import yaml
from network import Link, line
from network_model import Model, main, table
from release import VERSIONS, problems, versions
from wheel import check_contents

from hqgs import __version__

ROOT = Path(__file__).parent.parent
if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]


def test_the_tree_names_one_version() -> None:
    assert set(versions(ROOT).values()) == {__version__}


def test_the_citation_has_what_its_format_asks_for() -> None:
    """Citation File Format 1.2.0: the keys that it demands, and no key of another kind."""
    citation: dict[str, Any] = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation.keys() >= {"cff-version", "message", "title", "authors"}
    optional = {"type", "abstract", "version", "license", "keywords"}
    assert citation.keys() <= {"cff-version", "message", "title", "authors", *optional}
    assert (citation["cff-version"], citation["type"]) == ("1.2.0", "software")
    assert citation["license"] == "Apache-2.0"
    assert all(author["name"] for author in citation["authors"])


def test_extras_are_what_messages_name() -> None:
    """Each extra that a message or a page tells to install is there; none of them is in the core."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras: dict[str, list[str]] = project["optional-dependencies"]
    texts = [*ROOT.glob("hqgs/**/*.py"), *ROOT.glob("docs/**/*.md"), ROOT / "README.md"]
    named = {n for text in texts for n in re.findall(r"hqgs\[(\w+)\]", text.read_text(encoding="utf-8"))}
    assert named == set(extras)
    needed = {re.split(r"[<>=;\[]", line)[0] for line in project["dependencies"]}
    assert not needed & {re.split(r"[<>=;\[]", line)[0] for lines in extras.values() for line in lines}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A repository with what names a version, clean, and with a heading for it."""
    for name in VERSIONS:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    (tmp_path / "CHANGELOG.md").write_text(f"# Changelog\n\n## [{__version__}] - 2026-11-23\n")
    git(tmp_path, "init", "-q")
    commit(tmp_path)
    return tmp_path


def git(folder: Path, *arguments: str) -> None:
    subprocess.run(["git", *arguments], cwd=folder, check=True, capture_output=True)


def commit(folder: Path) -> None:
    git(folder, "add", "-A")
    git(folder, "-c", "user.name=a", "-c", "user.email=a@b.example", "commit", "-qm", "all")


def test_nothing_is_in_the_way_of_a_whole_release(tree: Path) -> None:
    assert problems(tree) == []


@pytest.mark.parametrize("name", VERSIONS)
def test_another_version_is_in_the_way(tree: Path, name: str) -> None:
    text = (tree / name).read_text(encoding="utf-8").replace(__version__, "7.8.9", 1)
    (tree / name).write_text(text, encoding="utf-8")
    commit(tree)
    found = problems(tree)
    assert any("7.8.9" in line for line in found)
    if name != "pyproject.toml":  # by which the others are judged
        assert found == [f"{name} says 7.8.9, pyproject.toml {__version__}"]


def test_changes_and_a_missing_heading_are_in_the_way(tree: Path) -> None:
    (tree / "CHANGELOG.md").write_text("# Changelog\n\n## [Unreleased]\n")
    heading, dirty = problems(tree)
    assert heading == f"CHANGELOG.md has no heading '## [{__version__}] - YYYY-MM-DD'"
    assert dirty.startswith("the tree is not clean:\n M CHANGELOG.md")
    (tree / "CITATION.cff").write_text("nothing\n")
    with pytest.raises(ValueError, match=r"CITATION\.cff names no version"):
        problems(tree)


def test_a_wheel_that_lacks_a_part_is_refused(tmp_path: Path) -> None:
    wheel = tmp_path / "hqgs-0-cp310-abi3-linux_x86_64.whl"
    with zipfile.ZipFile(wheel, "w") as file:
        file.writestr("hqgs/_rust.abi3.so", "")
        file.writestr("tests/x.py", "")
    with pytest.raises(SystemExit, match=r"lacks \['hqgs/py.typed', 'hqgs/show/page/templates/splats.js'\]"):
        check_contents(wheel)


# --- The scripts about networks: their sums, and what they need. Namespaces need root, so no test makes any


def step(waited: float) -> dict[str, float]:
    return {"seconds": 0.5, "worked": 0.2, "waited": waited, "sent": 12_500_000}


def test_what_is_hidden_is_what_no_rank_waits_for() -> None:
    found = line(Link("1 GbE", 1e9), [step(0.9), step(0.07), step(0.01)], free=0.05)
    assert (found["transfer"], found["steps"]) == (0.1, 3)
    assert found["hidden"] == pytest.approx(0.8)
    assert line(Link("no limit"), [step(0.4)], free=0.4)["hidden"] is None


def test_namespaces_need_root(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(network_machines.os, "geteuid", lambda: 1000)
    with pytest.raises(RuntimeError, match="need root, and ip and tc"), network_machines.machines(0.0):
        pass
    monkeypatch.setattr(sys, "argv", ["network.py", "nowhere", "--out", str(tmp_path)])
    assert network.main() == 1


def test_the_model_follows_its_words(capsys: pytest.CaptureFixture[str]) -> None:
    model = Model(fixed=0.1, each=1e-6, cores=2)
    assert model.view(900_000) == pytest.approx(0.5)
    assert model.transfer(1_000_000, ranks=3, rate=1e9) == pytest.approx(1.024)
    assert model.gain(1_000, ranks=4, rate=1e15) == pytest.approx(4, rel=0.02)
    assert model.gain(10_000_000, ranks=2, rate=1e6) < 0.01
    gains = [model.gain(1_000_000, 4, rate) for rate in (1e9, 1e10, 1e11)]
    assert gains == sorted(gains)
    assert main() == 0
    said = capsys.readouterr().out
    assert "\n".join(table(1)) in said
