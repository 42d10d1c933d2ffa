"""The extension module; rust/python/ is its source."""

from typing import Any

from numpy.typing import NDArray

# The constants of the rasterizer; rust/constants.rs has each with its reason.
ALPHA_MIN: float
ALPHA_MAX: float
TRANSMITTANCE_MIN: float
EPS2D: float
NEAR_PLANE: float
FAR_PLANE: float
FOV_MARGIN: float
QUAT_NORM2_MIN: float
TILE: int
BLOCK: int

Array = NDArray[Any]
Maybe = Array | None

class Frame:
    """The projection of N Gaussians into C cameras."""

    width: int
    height: int
    projected: int

class Composite:
    """Tile lists and replay state of a composited frame."""

    work: tuple[int, int]
    bin_seconds: float

class Separable:
    """A linear operator on pictures and its transpose."""

    size: tuple[int, int]

    def __init__(self, rows: Array, columns: Array, channels: Array | None) -> None: ...
    def apply(self, image: Array, transposed: bool) -> Array: ...
    def apply_absolute(self, image: Array) -> Array: ...

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
    options: tuple[float, float, float, float, bool, bool],
    sh_degree: int | None,
    activate: bool = False,
    knobs: tuple[float, float, str, bool] | None = None,
    all: bool = True,
) -> tuple[Frame, Array, Array, Array, Array, Array, Array]: ...
def project_backward(
    frame: Frame, inputs: tuple[Array, Array, Array, Array], cotangents: tuple[Maybe, ...], wanted: list[bool]
) -> tuple[Maybe, Maybe, Maybe, Maybe, Maybe, Maybe, Maybe, Maybe]: ...
def composite_forward(
    frame: Frame, colors: Array, backgrounds: Array | None, channels: int
) -> tuple[Composite, Array, Array]: ...
def composite_picture(frame: Frame, colors: Array, backgrounds: Array | None) -> Array: ...
def composite_backward(
    composite: Composite,
    backgrounds: Array | None,
    v_image: Array,
    v_alphas: Array | None,
    wanted: list[bool],
) -> tuple[Maybe, Maybe, Maybe, Maybe, Maybe, Maybe]: ...
def photometric(
    render: Array, target: Array, mask: Array | None, lambda_dssim: float, knee: float, want_grad: bool
) -> tuple[float, float, float | None, Array | None]: ...

class Exposure:
    """A taken photo, for its gradient."""

def exposure_forward(
    image: Array, size: list[int], nearness: Array | None, warps: Array, gains: list[float]
) -> tuple[Exposure, Array]: ...
def exposure_backward(exposure: Exposure, v_photo: Array) -> tuple[Array, Array, list[float]]: ...
def agreed_depths(
    first: Array, others: list[Array], maps: Array, pixels: Array, ranges: Array, agreeing: int
) -> tuple[Array, Array]: ...
def cell_distance(
    x: Array, centres: Array, widths: Array, scale: float, want_grad: bool
) -> tuple[float, Array | None]: ...
def adam_steps(
    steps: list[tuple[Array, Array, Array, Array, int, tuple[float, float, float, float], int | None]],
) -> None:
    """Of each: the parameter, its gradient, both moments, the step, (lr, beta1, beta2, eps), what is used."""

def add_pulls(
    sums: Array, views: Array, gradient: Array, radii: Array, half: tuple[float, float]
) -> None: ...
def add_rows(views: list[tuple[Array, Array]], sums: Array, scale: float) -> None: ...
def add_harmonics(
    views: list[tuple[Array, Array, list[float], int]], means: Array, high: Array, scale: float
) -> None: ...
def set_num_threads(threads: int) -> None:
    """Use this many threads from now on, 1 to 1024; results do not depend on it. ValueError for others."""

def get_num_threads() -> int:
    """Number of threads in use."""

def give_back_memory() -> None:
    """Hand what the crate has freed back to the system, now and not ten seconds later."""

def simd_level() -> str: ...
