"""The extension module; rust/python.rs and rust/python_loss.rs are its source."""

from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]

class Frame:
    """The projection of N Gaussians into C cameras."""

    width: int
    height: int

class Composite:
    """Tile lists and replay state of a composited frame."""

    work: tuple[int, int, int]
    blended: int
    bin_seconds: float

def project_forward(
    means: Array,
    quats: Array,
    scales: Array,
    opacities: Array,
    colors: Array,
    rest: Array | None,
    viewmats: Array,
    ks: Array,
    width: int,
    height: int,
    options: tuple[float, float, float, float, bool],
    sh_degree: int | None,
    knobs: tuple[float, float, str, bool, int] | None = None,
) -> tuple[Frame, Array, Array, Array, Array, Array, Array]: ...
def project_backward(
    frame: Frame,
    inputs: tuple[Array, Array, Array, Array, Array | None, Array | None],
    cotangents: tuple[Array, Array, Array, Array | None, Array | None, Array | None],
    wanted: list[bool],
) -> tuple[Array | None, ...]: ...
def composite_forward(
    frame: Frame, colors: Array, backgrounds: Array | None, channels: int
) -> tuple[Composite, Array, Array]: ...
def composite_backward(
    frame: Frame,
    composite: Composite,
    colors: Array,
    backgrounds: Array | None,
    v_image: Array,
    v_alphas: Array | None,
    channels: int,
    wanted: list[bool],
) -> tuple[Array | None, ...]: ...
def photometric(
    render: Array, target: Array, mask: Array | None, lambda_dssim: float, want_grad: bool
) -> tuple[float, float, float | None, Array | None]: ...
def ssim(a: Array, b: Array, mask: Array | None = None) -> float: ...
def adam_step(
    param: Array,
    grad: Array,
    exp_avg: Array,
    exp_avg_sq: Array,
    step: int,
    options: tuple[float, float, float, float],
    visible: Array | None,
) -> None: ...
def set_num_threads(threads: int) -> None: ...
def get_num_threads() -> int: ...
def data_pointer(array: Array) -> int: ...
