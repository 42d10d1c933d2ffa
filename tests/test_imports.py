"""What is loaded when: heavy packages wait until something needs them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import hqgs
from hqgs.cli.main import COMMANDS

ROOT = Path(__file__).parent.parent
HEAVY = {"kornia", "matplotlib", "piq", "pycolmap", "scipy"}


def loaded(code: str) -> set[str]:
    """The packages that a fresh Python has loaded after the code; its last line on stdout tells."""
    code = f"import sys\n{code}\nprint(' '.join(name for name in sys.modules if '.' not in name))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines()[-1].split())


def test_import_loads_nothing_heavy() -> None:
    assert not loaded("import hqgs") & {*HEAVY, "torch", "numpy"}


def test_the_command_loads_nothing_before_it_hears_ctrl_c() -> None:
    names = loaded("import hqgs.__main__")
    assert not names & {*HEAVY, "torch", "numpy", "tyro", "rich", "filelock"}


def test_ctrl_c_while_the_command_line_loads_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    from hqgs.__main__ import run
    from hqgs.cli import main

    def stopped() -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(main, "main", stopped)
    assert run() == 130
    assert '\nhqgs = "hqgs.__main__:run"\n' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_to_render_and_to_read_a_scene_needs_torch_alone() -> None:
    names = loaded(
        "import hqgs\nhqgs.rasterization, hqgs.Gaussians.load, hqgs.Camera, hqgs.get_num_threads()"
    )
    assert "torch" in names
    assert not names & HEAVY


def test_to_load_and_to_train_draws_no_chart_yet() -> None:
    assert not loaded("import hqgs\nhqgs.load, hqgs.train") & {"kornia", "matplotlib", "piq"}


ANSWERS = [
    (["--help"], 0, "usage: hqgs"),
    (["train", "--help"], 0, "--leave-out"),
    (["export", "--help"], 0, "--sh-degree"),
    (["trane"], 2, "did you mean 'train'"),
    (["--version"], 0, "hqgs 0."),
    (["train", "--help-all"], 0, "--config.densify.grad-threshold"),
    (["train", "x", "--out", "y", "--iteratons", "3"], 2, "did you mean --iterations"),
    (["train", "embedded", "--out", "x", "--method", "4dgs"], 2, "unknown method '4dgs'"),
    (["train", "embedded", "--out", "x", "--iterations", "0"], 2, "iterations is 0"),
    (["train", "/no/such", "--out", "x"], 2, "there is no scene folder /no/such"),
    (["diagnose", "/no/such"], 2, "there is no scene folder /no/such"),
    (["degrade", "/no/such", "--kind", "blur", "--out", "x"], 2, "there is no scene folder /no/such"),
    (["render", "--help"], 0, "--background"),
    (["view", "--help"], 0, "--port"),
    (["render", "/no/such", "--out", "x.png"], 2, "there is no /no/such"),
    (["view", "/no/such"], 2, "there is no /no/such"),
    (["export", "/no/such", "--out", "x.ply"], 2, "there is no /no/such"),
]


def test_help_and_mistakes_are_answered_without_torch() -> None:
    program = f"""
import contextlib, io
from hqgs.cli.main import main
for arguments, wanted, text in {ANSWERS!r}:
    told = io.StringIO()
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
        try:
            code = main(arguments)
        except SystemExit as end:
            code = end.code
    assert code == wanted, (arguments, code)
    assert text in told.getvalue(), (arguments, told.getvalue())
"""
    assert not loaded(program) & {*HEAVY, "torch"}


@pytest.mark.parametrize(
    ("commands", "needed"),
    [
        ([], set[str]()),
        ([name for name in COMMANDS if name != "export"], {"tyro"}),
        (["export"], {"tyro", "numpy", "PIL", "plyfile"}),
    ],
)
def test_help_waits_for_nothing_that_it_does_not_need(commands: list[str], needed: set[str]) -> None:
    """`hqgs --help` for Python alone, that of a command for its parser; export lists what formats hold."""
    program = f"""
from hqgs.cli.main import main
for command in {commands!r} or [""]:
    try:
        main([*command.split(), "--help"])
    except SystemExit:
        pass
print()
"""
    kept = {*HEAVY, "torch", "numpy", "tyro", "rich", "filelock", "PIL", "jinja2", "plyfile"}
    assert loaded(program) & kept <= needed


@pytest.mark.parametrize(
    "command", ["train PHOTOS --out RUN", "plan PHOTOS", "judge a.splat --photos PHOTOS"]
)
def test_the_first_line_comes_before_what_takes_seconds(command: str, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").touch()
    (tmp_path / "a.splat").write_bytes(bytes(32))
    words = command.replace("PHOTOS", str(tmp_path / "photos")).replace("RUN", str(tmp_path / "run"))
    words = words.replace("a.splat", str(tmp_path / "a.splat"))
    program = f"""
import builtins
from hqgs.cli.main import main
own, said = print, []
def first(*words, **more):
    own(*words)
    said.append(words)
    if len(said) == 1:
        raise ValueError("that is enough")
builtins.print = first
assert main({words.split()!r}) == 2
builtins.print = own
"""
    assert not loaded(program) & {*HEAVY, "torch", "rich"}


def test_every_public_name_is_there() -> None:
    assert set(hqgs.__all__) <= set(dir(hqgs))
    assert all(getattr(hqgs, name) is not None for name in hqgs.__all__)
    with pytest.raises(AttributeError, match="module 'hqgs' has no attribute 'trian'"):
        hqgs.trian  # type: ignore[attr-defined]  # noqa: B018
