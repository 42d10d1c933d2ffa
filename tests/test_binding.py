"""The border between Python and the crate: arrays are borrowed as they are, or refused."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import hqgs
from hqgs import _rust


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((3, 5)).T,
        np.asfortranarray(np.zeros((5, 3))),
        np.zeros((5, 6))[:, ::2],
        np.zeros((5, 6))[:, :3],
    ],
    ids=["transposed", "fortran", "strided", "sliced"],
)
def test_other_layouts_are_refused(array: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"x: must be C-contiguous, got shape \[5, 3\]"):
        _rust.cell_distance(array, array, array, 1.0, False)


def test_a_transposed_tensor_is_not_misread() -> None:
    torch.manual_seed(0)
    n = 40
    means = torch.rand(3, n) * 2 - 1 + torch.tensor([[0.0], [0.0], [4.0]])
    rest = (torch.rand(n, 4), torch.full((n, 3), 0.2), torch.rand(n), torch.rand(n, 3))
    camera = (torch.eye(4)[None], torch.tensor([[[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]]), 32, 24)
    image, _, _ = hqgs.rasterization(means.T, *rest, *camera)
    expected, _, _ = hqgs.rasterization(means.T.contiguous(), *rest, *camera)
    assert torch.equal(image, expected)
    assert image.max() > 0.1


def test_the_gil_is_released() -> None:
    """Another Python thread goes on while the crate works."""
    torch.manual_seed(0)
    n = 60_000
    means = torch.rand(n, 3) * 4 - 2 + torch.tensor([0.0, 0.0, 5.0])
    rest = (torch.rand(n, 4) + 0.1, torch.full((n, 3), 0.3), torch.rand(n) * 0.01 + 0.005, torch.rand(n, 3))
    camera = (torch.eye(4)[None], torch.tensor([[[300.0, 0, 256], [0, 300, 256], [0, 0, 1]]]), 512, 512)
    ticks: list[float] = []
    done = threading.Event()

    def tick() -> None:
        while not done.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.001)

    thread = threading.Thread(target=tick)
    hqgs.set_num_threads(1)  # many would be too fast to tell
    thread.start()
    try:
        started = time.perf_counter()
        hqgs.rasterization(means, *rest, *camera)
        ended = time.perf_counter()
    finally:
        done.set()
        thread.join()
    assert ended - started > 0.05, "too fast to tell"
    assert sum(started < t < ended for t in ticks) >= 5


FAULTS = """
import resource, time
from benchmarks.speed.inputs import make_inputs
from benchmarks.speed.rasterizer import RasterPass

raster = RasterPass(make_inputs(30_000))
for wait in (0, 0, 0, 1.5, 0):
    time.sleep(wait)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    raster.run()
    raster.clear()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="counts the page faults of Linux")
def test_freed_buffers_are_kept_for_the_next_iteration() -> None:
    """Longer than the second after which the allocator would give them back. In a process of its own: what
    earlier tests have freed may go at any time."""
    run = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True)
    first, *_, waited, after = map(int, run.stdout.split())
    assert max(waited, after) < first / 4


GIVEN_BACK = """
from pathlib import Path
from benchmarks.speed.inputs import make_inputs
from benchmarks.speed.rasterizer import RasterPass
from hqgs.base.machine import give_back_memory

raster = RasterPass(make_inputs(100_000))
for _ in range(2):
    for step in (give_back_memory, raster.run, raster.clear, give_back_memory):
        step()
        print(next(int(s.split()[1]) for s in Path("/proc/self/status").open() if s.startswith("VmRSS")))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's figures of the process")
def test_freed_buffers_can_be_given_back() -> None:
    run = subprocess.run([sys.executable, "-c", GIVEN_BACK], capture_output=True, text=True, check=True)
    before, ran, cleared, after = list(map(int, run.stdout.split()))[4:]
    assert ran - before > 20_000  # kB, and so it is
    assert cleared - before > 20_000  # until it is asked for
    assert after - before < 0.2 * (ran - before)


APART = """
from pathlib import Path
import numpy as np
from hqgs.base.machine import keep_large_arrays_apart

def resident():
    return next(int(s.split()[1]) for s in Path("/proc/self/status").open() if s.startswith("VmRSS"))

keep_large_arrays_apart()
for _ in range(2):
    np.ones(3_000_000)  # from here on glibc by itself would keep arrays of 24 MB
large = np.ones(2_000_000)
stays = [np.ones(2_000) for _ in range(1000)]
before = resident()
del large
print(before - resident())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks glibc")
def test_large_arrays_leave_no_holes() -> None:
    run = subprocess.run([sys.executable, "-c", APART], capture_output=True, text=True, check=True)
    assert int(run.stdout) > 15_000  # kB, of 16,000


def test_threads_can_be_set_and_a_number_out_of_range_is_refused() -> None:
    hqgs.set_num_threads(3)
    assert hqgs.get_num_threads() == 3
    for wrong in (0, -1, -(2**70), 1025, 2**31, 2**64, 10**30):
        with pytest.raises(ValueError, match=f"threads: must be 1 to 1024, got {wrong}$"):
            hqgs.set_num_threads(wrong)
    with pytest.raises(TypeError):
        hqgs.set_num_threads(2.0)  # type: ignore[arg-type]
    assert hqgs.get_num_threads() == 3


def with_simd(level: str) -> subprocess.CompletedProcess[str]:
    code = "from hqgs import _rust; print(_rust.simd_level())"
    env = {**os.environ, "HQGS_SIMD": level}
    return subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="other levels elsewhere")
def test_the_environment_forces_vector_instructions() -> None:
    assert with_simd("sse4.2").stdout.strip() == "SSE4.2"
    assert with_simd("").stdout.strip() == _rust.simd_level()


ELSEWHERE = "neon" if platform.machine() == "x86_64" else "avx2"


@pytest.mark.parametrize(
    ("level", "problem"), [("avx9", "there is no level"), (ELSEWHERE, "this CPU does not have")]
)
def test_vector_instructions_that_are_not_there_are_refused(level: str, problem: str) -> None:
    done = with_simd(level)
    assert done.returncode == 1
    assert f'ValueError: HQGS_SIMD: {problem} "{level}"; use one of ' in done.stderr


def test_what_valgrind_is_to_watch_can_be_called(tmp_path: Path) -> None:
    """`rust/check_unsafe.sh` takes minutes and runs seldom; that its calls fit the binding is told here."""
    shutil.copy(_rust.__file__, tmp_path / "_rust.abi3.so")
    calls = Path(__file__).parent.parent / "rust" / "python" / "check_unsafe.py"
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run([sys.executable, calls], env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()[1:]) == (0, ["looked", "at", "everything"]), done.stderr
