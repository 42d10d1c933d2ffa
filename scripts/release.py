"""Make a release; a dry run unless told otherwise: it checks, builds, tries, and says what it would upload.

    python scripts/release.py              # nothing leaves the machine
    python scripts/release.py --upload     # to crates.io and PyPI, by cargo's and uv's own credentials

Checked: the tree is clean; Cargo.toml, pyproject.toml, hqgs.__version__ and CITATION.cff name one version;
the change log has a heading for it. Then the source distribution and the portable wheel are built, the wheel
is used in an empty environment, and cargo and uv go through their uploads. Exit code 1 where something is in
the way.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from pathlib import Path

from wheel import ROOT, build

OUT = ROOT / "dist" / "release"
CRATES = ("-p", "hqgs", "-p", "hqgs-training")
VERSIONS = {  # where each file says it
    "Cargo.toml": r'^\[workspace\.package\]\s+version = "([^"]+)"',
    "pyproject.toml": r'^name = "hqgs"\s+version = "([^"]+)"',
    "hqgs/__init__.py": r'^__version__ = "([^"]+)"',
    "CITATION.cff": r"^version: (\S+)",
}


def versions(root: Path) -> dict[str, str]:
    """The version that each file names. ValueError where one names none."""
    found: dict[str, str] = {}
    for name, pattern in VERSIONS.items():
        match = re.search(pattern, (root / name).read_text(encoding="utf-8"), re.MULTILINE)
        if match is None:
            raise ValueError(f"{name} names no version")
        found[name] = match.group(1)
    return found


def problems(root: Path) -> list[str]:
    """What is in the way of a release of the tree, in words."""
    found = versions(root)
    version = found["pyproject.toml"]
    wrong = [
        f"{name} says {said}, pyproject.toml {version}" for name, said in found.items() if said != version
    ]
    changes = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    if not re.search(rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d$", changes, re.MULTILINE):
        wrong.append(f"CHANGELOG.md has no heading '## [{version}] - YYYY-MM-DD'")
    state = subprocess.run(
        ["git", "status", "--porcelain"], cwd=root, capture_output=True, text=True, check=True
    )
    if state.stdout:
        wrong.append(f"the tree is not clean:\n{state.stdout.rstrip()}")
    return wrong


def main() -> int:
    """Check, build, try, and upload or say what would be uploaded."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--upload", action="store_true", help="publish what was built")
    upload = parser.parse_args().upload
    wrong = problems(ROOT)
    for line in wrong:
        print(f"in the way: {line}", file=sys.stderr)
    if wrong and upload:
        return 1
    shutil.rmtree(OUT, ignore_errors=True)
    subprocess.run(["uv", "build", "--sdist", "--out-dir", str(OUT)], cwd=ROOT, check=True)
    wheel = build(OUT, portable=True)
    subprocess.run([sys.executable, "scripts/wheel.py", "--wheel", str(wheel)], cwd=ROOT, check=True)
    files = sorted(str(path) for path in OUT.iterdir() if path.name.startswith("hqgs-"))
    dry = [] if upload else ["--dry-run"]
    dirty = ["--allow-dirty"] if wrong else []  # in a dry run alone
    subprocess.run(["cargo", "publish", "--locked", *CRATES, *dry, *dirty], cwd=ROOT, check=True)
    # Without an index to ask, uv's dry run only looks at the files.
    subprocess.run(
        ["uv", "publish", *dry, *(["--token", "none"] if dry else []), *files], cwd=ROOT, check=True
    )
    print(
        "uploaded:" if upload else "would upload: the crates hqgs and hqgs-training to crates.io, and to PyPI"
    )
    for file in files:
        print(f"  {Path(file).name}  {Path(file).stat().st_size / 1e6:.2f} MB")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
