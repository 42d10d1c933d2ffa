"""Facts about the machine and the software, for reports. No host names, user names or paths."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

AT_ONCE = 1 << 20  # values of a kind that are made on the way together, so that memory is bounded


def machine_facts() -> dict[str, Any]:
    """Facts about this machine, as JSON values; cores: that this process may use. None: not known."""
    from hqgs._rust import simd_level  # here, since the rest of this file loads nothing

    return {
        "cpu": _cpu_model(),
        "simd": simd_level(),  # a virtual machine's model may name none: "AMD EPYC" has them all
        "cores": len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count(),
        "memory_gib": _memory_gib(),
        "system": platform.system(),
        "architecture": platform.machine(),
    }


def version_facts() -> dict[str, str | None]:
    """Versions of Python and of the packages that shape the numbers (None: not installed).

    `git_commit` is the commit of the checkout that this package runs from, with "-dirty" where tracked
    files differ from it; None for an installed copy.
    """
    facts: dict[str, str | None] = {"python": platform.python_version()}
    for package in ("hqgs", "torch", "numpy", "pycolmap", "piq", "lpips", "pillow", "matplotlib"):
        try:
            facts[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            facts[package] = None
    facts["git_commit"] = _git_commit(Path(__file__).resolve().parent.parent.parent)
    return facts


def peak_rss_mb() -> float | None:
    """The largest resident memory of this process so far in MB (10^6 bytes); None where unknown."""
    if sys.platform == "linux":
        # Not getrusage: its maximum starts from that of the process that started this one.
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    if sys.platform == "darwin":
        import resource  # only Unix has it

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return None


def _cpu_model() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    return platform.processor() or platform.machine()


def _memory_gib() -> float | None:
    if sys.platform == "win32":
        return None
    return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)


def _git_commit(root: Path) -> str | None:
    if not (root / ".git").exists() or not (root / "pyproject.toml").is_file():
        return None
    try:
        commit = _git(root, "rev-parse", "HEAD")
        dirty = _git(root, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{commit}-dirty" if dirty else commit


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()


def keep_large_arrays_apart() -> None:
    """Let the C library, where it can be asked (glibc), take each array of 4 MB and more from the system, and
    give it back when it is freed.

    By itself it soon keeps those of up to 32 MB, between what stays: new ones do not fit into the holes, and
    memory grows.
    """
    _of_glibc("mallopt", -3, 4 << 20)  # M_MMAP_THRESHOLD, bytes
    _of_glibc("mallopt", -1, 64 << 20)  # M_TRIM_THRESHOLD, which would else follow: its own most


def give_back_memory() -> None:
    """Hand freed memory back to the system: what the crate keeps for later, and the C library where it can be
    asked (glibc).

    Arrays of a few MB that several threads made and freed would hold hundreds of MB else.
    """
    from hqgs import _rust  # here, since the rest of this file loads nothing

    _rust.give_back_memory()
    _of_glibc("malloc_trim", 0)


def _of_glibc(name: str, *numbers: int) -> None:
    """Call a function of the C library, where it has it."""
    try:
        function = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # another system
        return
    function(*numbers)
