"""Build the wheel, install it into an empty environment outside the repository, and use it there.

    python scripts/wheel.py --portable      # for a registry: manylinux_2_28, linked by Zig
    python scripts/wheel.py                 # for this machine's C library; takes what cargo has compiled
    python scripts/wheel.py --wheel FILE    # only try one that is there

Needs uv and the Rust toolchain. What is used: the import, `hqgs --help`, 50 steps on the built-in scene, the
report as a page, an SPZ file, the server of `hqgs view`. Exit code 1 where something does not work.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MANYLINUX = "manylinux_2_28"  # what PyTorch's own wheels ask for
MATURIN = ">=1.9,<2"
EXTRAS = "view"
STEPS = 50
PATIENCE = 60.0  # seconds, for the server to answer
INSIDE = {"hqgs/_rust.abi3.so", "hqgs/py.typed", "hqgs/show/page/templates/splats.js"}  # and much else
OUTSIDE = ("tests/", "benchmarks/", "docs/", "rust/")  # what users do not need


def build(out: Path, portable: bool) -> Path:
    """Build the wheel into `out`; return its path."""
    before = set(out.glob("*.whl"))
    tool = f"maturin{'[zig]' if portable else ''}{MATURIN}"
    command = ["uv", "tool", "run", "--from", tool, "maturin", "build", "--release", "--out", str(out)]
    command += ["--zig", "--compatibility", MANYLINUX] if portable else ["--compatibility", "linux"]
    subprocess.run(command, cwd=ROOT, check=True)
    made = sorted(set(out.glob("*.whl")) - before or out.glob("*.whl"), key=lambda file: file.stat().st_mtime)
    return made[-1]


def check_contents(wheel: Path) -> None:
    """SystemExit where the wheel lacks what is needed, holds what is not, or fits one Python only."""
    names = set(zipfile.ZipFile(wheel).namelist())
    lacking = INSIDE - names
    strange = sorted(name for name in names if name.startswith(OUTSIDE))
    if lacking or strange or "-abi3-" not in wheel.name:
        raise SystemExit(f"{wheel.name}: lacks {sorted(lacking)}, holds {strange[:3]}; wanted an abi3 wheel")
    print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, {len(names)} files", flush=True)


class Environment:
    """An environment in a folder, with the wheel and what it asks for."""

    def __init__(self, folder: Path, wheel: Path) -> None:
        self.folder = folder
        self.bin = folder / "venv" / "bin"
        # No path of the repository, and no environment that is active, may help.
        self.variables = {
            name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")
        }
        self.run("uv", "venv", "--quiet", "--python", sys.executable, str(folder / "venv"))
        python = str(self.bin / "python")
        self.run("uv", "pip", "install", "--quiet", "--python", python, f"{wheel}[{EXTRAS}]")

    def run(self, *command: str) -> str:
        """What a command printed. CalledProcessError, its words shown, where it fails."""
        done = subprocess.run(
            command, cwd=self.folder, env=self.variables, capture_output=True, text=True, check=False
        )
        if done.returncode:
            print(done.stdout, done.stderr, sep="\n", file=sys.stderr)
        done.check_returncode()
        return done.stdout

    def hqgs(self, *arguments: str) -> str:
        """What the installed command printed."""
        return self.run(str(self.bin / "hqgs"), *arguments)


def look(environment: Environment, run: str) -> None:
    """Start `hqgs view`, fetch its page, end it by Ctrl-C. SystemExit where one of them fails."""
    server = subprocess.Popen(
        [environment.bin / "hqgs", "view", run, "--port", "0"],
        cwd=environment.folder,
        env=environment.variables,
        stdout=subprocess.PIPE,
        text=True,
        # In the background of a shell Ctrl-C is ignored, and what is started there inherits that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert server.stdout is not None
    try:
        told = server.stdout.readline()
        address = re.search(r"http://127\.0\.0\.1:\d+", told)
        if address is None:
            raise SystemExit(f"hqgs view said {told!r}, wanted an address")
        with urllib.request.urlopen(address.group(), timeout=PATIENCE) as answer:
            page = answer.read().decode()
        if "<html" not in page:
            raise SystemExit(f"{address.group()} answers {page[:100]!r}, wanted a page")
        server.send_signal(signal.SIGINT)
        if code := server.wait(PATIENCE):
            raise SystemExit(f"hqgs view ended with code {code} after Ctrl-C, wanted 0")
    finally:
        server.kill()
        server.wait()


def use(environment: Environment) -> None:
    """Use what is installed, and print how long each part took."""

    def timed(what: str, start: float) -> None:
        print(f"{time.perf_counter() - start:7.2f} s  {what}", flush=True)

    python = str(environment.bin / "python")
    start = time.perf_counter()
    home = environment.run(
        python, "-c", "import hqgs; hqgs.rasterization, hqgs.train; print(hqgs.__file__)"
    ).strip()
    if not Path(home).is_relative_to(environment.folder):
        raise SystemExit(f"hqgs was imported from {home}, not from the wheel")
    timed("first import, with PyTorch", start)
    for what in ("hqgs --help, the first time", "hqgs --help"):
        start = time.perf_counter()
        environment.hqgs("--help")
        timed(what, start)
    start = time.perf_counter()
    environment.hqgs(
        "train", "embedded", "--out", "run", "--iterations", str(STEPS), "--downscale", "4", "--threads", "2"
    )
    timed(f"{STEPS} steps on the built-in scene, with its photos and report", start)
    page = (environment.folder / "run" / "report.html").read_text(encoding="utf-8")
    if not page.lower().startswith("<!doctype html>"):
        raise SystemExit(f"report.html begins with {page[:40]!r}")
    start = time.perf_counter()
    environment.hqgs("export", "run", "--out", "scene.spz")
    environment.hqgs("info", "scene.spz")
    timed(f"scene.spz, {(environment.folder / 'scene.spz').stat().st_size:,} bytes", start)
    start = time.perf_counter()
    look(environment, "run")
    timed("hqgs view: started, its page fetched, ended by Ctrl-C", start)


def main() -> None:
    """Build, install, use."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--portable", action="store_true", help=f"for {MANYLINUX}, by Zig")
    parser.add_argument("--wheel", type=Path, help="try this one, build none")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the new wheel")
    options = parser.parse_args()
    wheel: Path = (options.wheel or build(options.out, options.portable)).resolve()
    check_contents(wheel)
    with tempfile.TemporaryDirectory(prefix="hqgs-wheel-") as name:
        start = time.perf_counter()
        environment = Environment(Path(name), wheel)
        print(f"{time.perf_counter() - start:7.2f} s  installed, with the extra {EXTRAS}", flush=True)
        use(environment)
    print(f"{wheel.name} works outside the repository")


if __name__ == "__main__":
    main()
