"""What the border between Python and the crate refuses, and what must not shake it: memory that is shared or
changes under its hands, processes that fork, scenes that do not fit into memory."""

from __future__ import annotations

import inspect
import os
import re
import subprocess
import sys
import threading
import time
import warnings
from typing import Any

import numpy as np
import pytest
import reference
import torch
from scenes import random_scene

import hqgs
from benchmarks.stability.oracle import ALPHA_FLOOR, OracleScene
from hqgs import _rust

OPTIONS = (0.01, 1e10, 0.0, 0.3, False, True)


def project(
    n: int = 40, width: int = 36, height: int = 20, cameras: int = 1, seed: int = 0, **changed: Any
) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """`_rust.project_forward` of a scene of channels: its keywords, and what it returns."""
    scene = random_scene(n, width, height, cameras=cameras, seed=seed, dtype=torch.float64)
    names = "means", "quats", "scales", "opacities", "colors", "viewmats"
    arrays = {name: getattr(scene, name).contiguous().numpy() for name in names}
    arguments = {
        **arrays, "rest": None, "ks": scene.Ks.double().numpy(), "width": width, "height": height,
        "options": OPTIONS, "sh_degree": None, **changed,
    }  # fmt: skip
    return arguments, _rust.project_forward(**arguments)


def test_a_composite_goes_back_through_its_own_frame() -> None:
    """Its tile lists belong to no other one: what is composited later changes nothing."""
    arguments, (frame, *_) = project(40)
    composite, *_ = _rust.composite_forward(frame, arguments["colors"], None, 3)
    v_image = np.random.default_rng(0).standard_normal((1, 20, 36, 3))
    expected = _rust.composite_backward(composite, None, v_image, None, [True] * 4)
    _, (other, *_) = project(7, width=100, height=90)
    del frame
    again = _rust.composite_backward(composite, None, v_image, None, [True] * 4)
    for a, b in zip(again, expected, strict=True):
        assert a is not None
        assert b is not None
        assert np.array_equal(a, b)
        assert a.any()
    with pytest.raises(TypeError):
        _rust.composite_backward(other, None, v_image, None, [True] * 4)  # type: ignore


def test_gradients_of_another_frame_are_refused() -> None:
    arguments, (_, *arrays) = project(40)
    _, (other, *_) = project(7)
    means, quats, scales, opacities = list(arguments.values())[:4]
    v_means2d = np.zeros_like(arrays[0]).reshape(1, 40, 2)
    cotangents = (v_means2d, None, None, None, None, None)
    with pytest.raises(ValueError, match=r"^means: expected shape \[7, 3\], got \[40, 3\]$"):
        _rust.project_backward(other, (means, quats, scales, opacities), cotangents, [True] * 8)


def test_the_constants_are_those_of_the_oracles() -> None:
    """Python takes them from the crate; what judges the crate has its own."""
    defaults = inspect.signature(reference.reference_rasterization).parameters
    assert _rust.ALPHA_MIN == reference.ALPHA_FLOOR == ALPHA_FLOOR == 1 / 255
    assert _rust.ALPHA_MAX == reference.ALPHA_CAP == 0.99
    assert _rust.TRANSMITTANCE_MIN == reference.TRANSMITTANCE_STOP == 0.999e-4
    assert _rust.FOV_MARGIN == reference.JACOBIAN_CLAMP == 0.3
    assert _rust.QUAT_NORM2_MIN == reference.QUAT_NORM2_MIN == 1e-12
    ours = inspect.signature(hqgs.rasterization).parameters
    for name, value in (("near_plane", 0.01), ("far_plane", 1e10), ("eps2d", 0.3)):
        assert ours[name].default == defaults[name].default == getattr(OracleScene, name) == value
    assert (_rust.NEAR_PLANE, _rust.FAR_PLANE, _rust.EPS2D) == (0.01, 1e10, 0.3)
    assert (_rust.TILE, _rust.BLOCK) == (16, 4)


# --- memory that is shared, or changes


def test_adam_refuses_arrays_that_overlap() -> None:
    """Tensors over the same memory come as arrays that know nothing of each other."""
    memory = torch.ones(40)
    apart = {"param": memory[:10], "grad": memory[10:20], "exp_avg": memory[20:30], "exp_avg_sq": memory[30:]}

    def step(**arrays: torch.Tensor) -> None:
        param, grad, exp_avg, exp_avg_sq = (tensor.numpy() for tensor in arrays.values())
        options = (0.1, 0.9, 0.999, 1e-8)
        _rust.adam_steps([(param, grad, exp_avg, exp_avg_sq, 1, options, None)])

    step(**apart)
    before = memory.clone()
    for name, other in (("exp_avg", "param"), ("exp_avg_sq", "param"), ("exp_avg_sq", "exp_avg")):
        begin = apart[other].storage_offset()
        for at in (begin, begin + 9, max(begin - 9, 0)):
            with pytest.raises(ValueError, match=f"^{name}: shares memory with {other}, which is written$"):
                step(**{**apart, name: memory[at : at + 10]})
    with pytest.raises(ValueError, match=r"^grad: shares memory with param, which is written$"):
        step(**{**apart, "grad": memory[9:19]})
    assert torch.equal(memory, before)


def test_another_thread_may_change_the_shape_meanwhile() -> None:
    """The call waits for the one thread of the pool; meanwhile `image` gets another shape."""
    rng = np.random.default_rng(0)
    turn = rng.random((30, 30))
    small = _rust.Separable(turn, turn, None)
    large = _rust.Separable(rng.random((700, 700)), rng.random((700, 700)), None)
    image, busy = rng.random((30, 30, 3)), rng.random((700, 700, 3))
    expected = small.apply(image, False)
    results: list[Any] = []

    def apply() -> None:
        try:
            results.append(small.apply(image, False))
        except Exception as error:  # of the other thread: shown by the assertion
            results.append(error)

    hqgs.set_num_threads(1)
    first = threading.Thread(target=large.apply, args=(busy, False))
    second = threading.Thread(target=apply)
    first.start()
    time.sleep(0.05)
    second.start()
    time.sleep(0.05)
    assert first.is_alive(), "too fast to tell"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # numpy would rather not have it set
        image.shape = (2700,)
    others = [np.empty((5, 6, 7)) for _ in range(20)]  # numpy puts their shapes where the old one was
    second.join()
    first.join()
    assert len(others) == 20
    assert np.array_equal(results[0], expected)


# --- processes that fork

FORK = """
import os, sys
import torch
import hqgs
sys.path.insert(0, "tests")
from scenes import random_scene

torch.set_num_threads(1)
scene = random_scene(200, 64, 48, seed=1)

def image():
    return hqgs.rasterization(**scene.arguments())[0]

if {set_first}:
    hqgs.set_num_threads(3)
expected = image()
threads = hqgs.get_num_threads()
for _ in range(2):
    child = os.fork()
    if child == 0:
        good = torch.equal(image(), expected) and hqgs.get_num_threads() == threads
        hqgs.set_num_threads(2)
        good = good and hqgs.get_num_threads() == 2 and torch.equal(image(), expected)
        grandchild = os.fork()
        if grandchild == 0:
            os._exit(0 if torch.equal(image(), expected) else 1)
        good = good and os.waitpid(grandchild, 0)[1] == 0
        os._exit(0 if good else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert torch.equal(image(), expected) and hqgs.get_num_threads() == threads
print("done")
"""


def run(script: str, timeout: float = 120) -> subprocess.CompletedProcess[str]:
    """`script` in a process of its own; one that hangs fails."""
    command = [sys.executable, "-c", script]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.parametrize("set_first", [False, True])
def test_a_forked_process_renders(set_first: bool) -> None:
    """As a worker of a DataLoader is. The threads of the pool do not come along: before, the child waited
    for them for ever."""
    done = run(FORK.format(set_first=set_first))
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr[-2000:]


# --- memory

LIMITED = """
import resource, sys
import numpy as np
from hqgs import _rust

OPTIONS = (0.01, 1e10, 0.0, 0.3, False, True)

def project(n, width, height, scale=0.02):
    rng = np.random.default_rng(0)
    means = rng.uniform(-1, 1, (n, 3)) + [0, 0, 4]
    view, K = np.eye(4)[None], np.array([[[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]])
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    arrays = means, quats, np.full((n, 3), scale), np.full(n, 0.5), np.full((n, 3), 0.5)
    return arrays, _rust.project_forward(*arrays, None, view, K, width, height, OPTIONS, None)

def limit(megabytes):
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (megabytes << 20),) * 2)

def composite(n, width, height, scale=0.02):
    arrays, (frame, *_) = project(n, width, height, scale)
    return _rust.composite_forward(frame, arrays[-1], None, 3)

composite(100, 64, 64)  # starts the threads
{call}
"""
CALLS = {
    "image": ("limit(1500); composite(10, 1 << 14, 1 << 14)", "image"),
    "tiles": ("limit(1500); composite(10, 1 << 19, 1 << 19)", "tile lists"),
    "pairs": ("limit(1500); composite(800, 4096, 4096, 2.0)", "tile lists"),
    "picture": (
        "o = _rust.Separable(np.eye(8192, 4), np.eye(8192, 4), None); limit(1000); "
        "o.apply(np.ones((4, 4, 3)), False)",
        "image",
    ),
    "bands": (
        "a = np.zeros((11, 1 << 21, 3)); limit(1500); _rust.photometric(a, a, None, 0.2, 0.0, False)",
        "loss",
    ),
    "columns": (
        "o = _rust.Separable(np.eye(1, 4), np.eye(4, 1 << 24), None); limit(700); "
        "o.apply(np.ones((4, 1 << 24, 1)), False)",
        "image",
    ),
    "operator": ("m = np.ones((8192, 8192)); limit(300); _rust.Separable(m, np.eye(4), None)", "rows"),
    "agreeing": (
        "g = np.zeros((32, 32), np.float32); "
        "_rust.agreed_depths(g, [g], np.zeros((1, 3, 4)), np.full((1, 2), 9.0), np.ones((1, 2)), 1 << 50)",
        "agreeing",
    ),
}


@pytest.mark.skipif(sys.platform != "linux", reason="limits the address space as Linux does")
@pytest.mark.parametrize("case", CALLS)
def test_memory_that_is_not_there_is_a_memory_error(case: str) -> None:
    """Before, the process was aborted."""
    call, name = CALLS[case]
    script = LIMITED.replace("{call}", f"try:\n    {call}\nexcept MemoryError as e:\n    print(e)")
    done = run(script)
    assert done.returncode == 0, (done.returncode, done.stderr[-2000:])
    assert re.fullmatch(rf"{name}: cannot allocate \d+ bytes\n", done.stdout), (
        done.stdout,
        done.stderr[-2000:],
    )


def test_too_many_pairs_are_refused_before_they_are_made() -> None:
    """1000 Gaussians that cover all 2^18 tiles: their pairs would take 65 GB. Counting stops at the limit."""
    n, side = 1000, 8192
    means = np.tile([0.0, 0.0, 2.0], (n, 1)).astype(np.float32)
    quats, scales = np.tile([1.0, 0, 0, 0], (n, 1)).astype(np.float32), np.full((n, 3), 9.0, np.float32)
    opacities, colors = np.full(n, 0.5, np.float32), np.zeros((n, 3), np.float32)
    K = np.array([[[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]]])
    frame, *_ = _rust.project_forward(
        means, quats, scales, opacities, colors, None, np.eye(4)[None], K, side, side, OPTIONS, None
    )
    message = (
        r"^means: 1000 Gaussians reach more than (\d+) times one of the 262144 tiles of the image; so many "
        r"pairs take up to (\d+) bytes; use fewer or smaller Gaussians, a smaller image or float32$"
    )
    with pytest.raises(ValueError, match=message) as error:
        _rust.composite_forward(frame, colors, None, 3)
    found = re.match(message, str(error.value))
    assert found is not None
    pairs, size = map(int, found.groups())
    assert pairs < 1000 * 2**18
    assert 24 * 2**30 - 1000 < size <= 24 * 2**30


def test_the_gradient_of_an_exposure_holds_a_few_bands_at_a_time() -> None:
    """A warp that nearly folds the picture over lets each band reach every row: 2.4 GB, all at once."""
    script = LIMITED.replace(
        "{call}",
        "image, warps = np.full((6144, 64, 3), 0.5, np.float32), np.zeros((2, 3, 4)); "
        "warps[0, 2, 0] = -1 / 32; "
        "taken, _ = _rust.exposure_forward(image, [6144, 64], None, warps, [1.0] * 3); limit(1000); "
        "print([x.shape for x in _rust.exposure_backward(taken, image)[:2]])",
    )
    done = run(script)
    assert (done.returncode, done.stdout) == (0, "[(1179648,), (24,)]\n"), done.stderr[-2000:]


def test_depths_are_sought_at_the_corner_of_a_wide_photo() -> None:
    """From 2^15 px on a float just below the last pixel is that pixel: a patch there reached past the end."""
    width = 33_000
    grey = np.random.default_rng(0).random((16, width), dtype=np.float32)
    pixels = np.array([[width - 3.501, 12.499], [width - 3.5, 12.5], [width - 4.0, 12.0]])
    pixels = np.concatenate([pixels, pixels + 0.001, pixels - 0.001])
    for end in (0.5, 0.4995, 0.499, 0.498, 0.5005, 0.501):
        corner = np.array([[width - end - 3.0, 16 - end - 3.0]])
        for step in np.linspace(-0.01, 0.01, 41):
            some = np.concatenate([pixels, corner]) + step
            depths, scores = _rust.agreed_depths(
                grey, [grey], np.eye(3, 4)[None], some, np.tile([1.0, 2.0], (len(some), 1)), 1
            )
            assert np.isfinite(depths).all()
            assert (scores >= -1).all()


# --- messages


def calls() -> dict[str, tuple[Any, dict[str, Any]]]:
    """Each function of the binding with arguments that it takes."""
    forward, (frame, *_) = project(12, cameras=2)
    harmonics, _ = project(12)
    harmonics = {**harmonics, "colors": np.zeros((12, 1, 3)), "rest": np.zeros((12, 3, 3)), "sh_degree": 1}
    composite, *_ = _rust.composite_forward(frame, forward["colors"], None, 3)
    inputs = dict(list(forward.items())[:4])
    shapes = [(2, 12, 2), (2, 12, 3), (2, 12), (2, 12), (2, 12, 3), (2, 12, 3)]
    names = ("v_means2d", "v_whitened", "v_opacities", "v_depths", "v_conics", "v_colors")
    cotangents = {name: np.zeros(shape) for name, shape in zip(names, shapes, strict=True)}

    def project_backward(**arrays: Any) -> Any:
        values = list(arrays.values())
        return _rust.project_backward(differentiable, tuple(values[:4]), tuple(values[4:]), [True] * 8)

    def add_rows(rows: Any, values: Any, sums: Any) -> None:
        _rust.add_rows([(rows, values)], sums, 0.5)

    def adam_steps(**arguments: Any) -> None:
        _rust.adam_steps([tuple(arguments.values())])

    def add_harmonics(rows: Any, colors: Any, means: Any, high: Any) -> None:
        _rust.add_harmonics([(rows, colors, [0.0, 0.0, 0.0], 1)], means, high, 0.5)

    def agreed_depths(others: Any, **arguments: Any) -> Any:
        return _rust.agreed_depths(others=[others], **arguments)

    rows = {"rows": np.array([0, 2], np.int32)}
    photographed = {
        "image": np.ones((24, 34, 3)), "size": [20, 30], "nearness": np.ones((20, 30)),
        "warps": np.full((2, 3, 4), 0.01), "gains": [1.0, 1.0, 1.0],
    }  # fmt: skip
    grey = np.random.default_rng(0).random((20, 30), dtype=np.float32)
    shaded = {**harmonics, "viewmats": forward["viewmats"], "ks": forward["ks"]}
    differentiable = _rust.project_forward(**shaded)[0]
    pictures = [np.zeros((20, 30, 3)) for _ in range(2)]
    adam = {name: np.zeros((12, 4, 3)) for name in ("param", "grad", "exp_avg", "exp_avg_sq")}
    options = {"step": 1, "options": (0.1, 0.9, 0.999, 1e-8)}
    cells = {name: np.ones(64) for name in ("x", "centres", "widths")}
    photo = {"lambda_dssim": 0.2, "knee": 0.0, "want_grad": True}
    mask = np.ones((20, 30), np.uint8)
    operator = _rust.Separable(np.eye(20), np.eye(30), np.eye(3))
    return {
        "project_forward": (_rust.project_forward, forward),
        "project_forward of harmonics": (_rust.project_forward, harmonics),
        "project_backward": (project_backward, {**inputs, **cotangents}),
        "composite_forward": (
            _rust.composite_forward,
            {"frame": frame, "colors": forward["colors"], "backgrounds": np.zeros((2, 3)), "channels": 3},
        ),
        "composite_picture": (
            _rust.composite_picture,
            {"frame": frame, "colors": forward["colors"], "backgrounds": np.zeros((2, 3))},
        ),
        "composite_backward": (
            _rust.composite_backward,
            {
                "composite": composite, "backgrounds": np.zeros((2, 3)), "v_image": np.zeros((2, 20, 36, 3)),
                "v_alphas": np.zeros((2, 20, 36, 1)), "wanted": [True] * 4,
            },
        ),
        "photometric": (
            _rust.photometric, {"render": pictures[0], "target": pictures[1], "mask": mask, **photo}
        ),
        "cell_distance": (_rust.cell_distance, {**cells, "scale": 1.0, "want_grad": True}),
        "adam_steps": (adam_steps, {**adam, **options, "used": 2}),
        "Separable": (
            _rust.Separable, {"rows": np.eye(20), "columns": np.eye(30), "channels": np.eye(3)}
        ),
        "add_rows": (
            add_rows, {**rows, "values": np.ones((2, 5), np.float32), "sums": np.zeros((4, 5), np.float32)}
        ),
        "add_pulls": (
            _rust.add_pulls,
            {
                "gradient": np.ones((12, 2), np.float32), "radii": np.ones((12, 2), np.int32),
                "sums": np.zeros(12, np.float32), "views": np.zeros(12, np.float32), "half": (15.0, 10.0),
            },
        ),
        "add_harmonics": (
            add_harmonics,
            {
                **rows, "colors": np.ones((2, 3), np.float32), "means": np.ones((4, 3), np.float32),
                "high": np.zeros((4, 3, 3), np.float32),
            },
        ),
        "exposure_forward": (_rust.exposure_forward, photographed),
        "exposure_backward": (
            _rust.exposure_backward,
            {"exposure": _rust.exposure_forward(**photographed)[0], "v_photo": np.ones((20, 30, 3))},
        ),
        "agreed_depths": (
            agreed_depths,
            {
                "first": grey, "others": grey.copy(), "maps": np.eye(3, 4)[None],
                "pixels": np.full((2, 2), 9.0), "ranges": np.tile([1.0, 2.0], (2, 1)), "agreeing": 1,
            },
        ),
        "apply": (operator.apply, {"image": pictures[0], "transposed": False}),
        "apply_absolute": (operator.apply_absolute, {"image": pictures[0].astype(np.float32)}),
    }  # fmt: skip


# What a message calls an argument; by function where it depends on it.
PUBLIC = {"ks": "Ks", "rest": r"colors\[1\]", "project_forward of harmonics colors": r"colors\[0\]"}
ARRAYS = [
    (call, name)
    for call, (_, arguments) in calls().items()
    for name, value in arguments.items()
    if isinstance(value, np.ndarray)
]


def refusal(call: str, name: str, value: Any) -> tuple[str, str]:
    """The message for `value`, and the name that it should begin with."""
    function, arguments = calls()[call]
    function(**arguments)
    with pytest.raises(ValueError, match=":") as error:
        function(**{**arguments, name: value})
    return str(error.value), PUBLIC.get(f"{call} {name}", PUBLIC.get(name, name))


@pytest.mark.parametrize(("call", "name"), ARRAYS)
@pytest.mark.parametrize("change", ["one more", "one axis more", "one axis less"])
def test_a_wrong_shape_is_named_with_the_right_one(call: str, name: str, change: str) -> None:
    array = calls()[call][1][name]
    shape = {
        "one more": (*array.shape[:-1], array.shape[-1] + 1),
        "one axis more": (*array.shape, 1),
        "one axis less": array.shape[1:],
    }[change]
    leading = (call, name) in {
        ("adam_steps", "param"),
        ("cell_distance", "x"),
        ("photometric", "render"),
        ("add_rows", "sums"),
        ("add_pulls", "gradient"),
        ("agreed_depths", "first"),
        ("agreed_depths", "others"),
    }
    free = leading and (call in ("adam_steps", "cell_distance") or change == "one more")
    free |= change == "one more" and (
        call == "Separable" or (name == "colors" and call in ("composite_picture", "project_forward"))
    )
    if free:
        pytest.skip("any such shape will do, and the others follow it")
    wrong = np.zeros(shape, array.dtype)
    message, public = refusal(call, name, wrong)
    got = re.escape(str(list(shape)))
    assert re.fullmatch(rf"{public}: expected shape .*\[.*\].*, got {got}", message), message


@pytest.mark.parametrize(("call", "name"), ARRAYS)
def test_a_wrong_dtype_is_named(call: str, name: str) -> None:
    array = calls()[call][1][name]
    message, public = refusal(call, name, array.astype(np.int64))
    assert re.fullmatch(rf"{public}: expected an array of (float|u?int).*, got int64", message), message
    message, public = refusal(call, name, [1.0])
    assert re.fullmatch(rf"{public}: expected an array of (float|u?int).*, got list", message), message


@pytest.mark.parametrize(("call", "name"), ARRAYS)
def test_another_float_is_named(call: str, name: str) -> None:
    """The first array decides the type of the others."""
    function, arguments = calls()[call]
    array = arguments[name]
    others = {k: v for k, v in arguments.items() if isinstance(v, np.ndarray) and v.dtype == np.float64}
    if name not in others or name == next(iter(others)) or call == "Separable":
        pytest.skip("it decides the type, or is of another")
    with pytest.raises(ValueError, match=PUBLIC.get(name, name)):
        function(**{**arguments, name: array.astype(np.float32)})
