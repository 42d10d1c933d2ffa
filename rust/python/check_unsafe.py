"""Calls through the binding for `rust/check_unsafe.sh`: each output is looked at, number by number.

Valgrind reports a number that was never written once something depends on it.
"""

import sys

import _rust
import numpy as np

WIDTH, HEIGHT, COUNT = 21, 19, 70  # no whole number of tiles, nor of groups of Gaussians


def look(*arrays: np.ndarray | None) -> None:
    """Make a branch of numpy depend on each number; those of Python itself are not watched."""
    for array in arrays:
        if array is not None and not (array < 1e30).all():
            sys.exit(f"not below 1e30: {array}")


def rasterize(dtype: type, degree: int | None) -> None:
    """Forward and backward, with harmonics or with five channels."""
    rng = np.random.default_rng(1)
    uniform = lambda *shape: rng.uniform(0.05, 1.0, shape).astype(dtype)  # noqa: E731
    inputs = (
        uniform(COUNT, 3) + dtype([-0.5, -0.5, 1.0]),
        uniform(COUNT, 4),
        0.2 * uniform(COUNT, 3),
        uniform(COUNT),
    )
    given, channels = (uniform(COUNT, 5), 5) if degree is None else (uniform(COUNT, 16, 3), 3)
    viewmats, ks = np.eye(4)[None], np.array([[[20.0, 0, 10], [0, 20, 9], [0, 0, 1]]])
    options = (0.01, 1e10, 0.0, 0.3, True, True)
    frame, *outputs, colors = _rust.project_forward(
        *inputs, given, None, viewmats, ks, WIDTH, HEIGHT, options, degree
    )
    look(*outputs, colors)
    colors, background = given if degree is None else colors.reshape(COUNT, 3), uniform(1, channels)
    composite, image, alphas = _rust.composite_forward(frame, colors, background, channels)
    look(image, alphas)
    v_image, v_alphas = uniform(1, HEIGHT, WIDTH, channels), uniform(1, HEIGHT, WIDTH, 1)
    grads = _rust.composite_backward(composite, background, v_image, v_alphas, [True] * 4)
    look(*grads)
    means2d, whitened, opacities, _, v_colors = grads[:5]
    cotangents = (
        means2d.reshape(1, COUNT, 2), whitened.reshape(1, COUNT, 3), opacities.reshape(1, COUNT), None, None,
        None if degree is None else v_colors.reshape(1, COUNT, 3),
    )  # fmt: skip
    harmonics = degree is not None
    wanted = [True] * 4 + [False, harmonics, False, True]  # no covariances, and no harmonics that lie apart
    look(*_rust.project_backward(frame, inputs, cotangents, wanted))


def train(dtype: type) -> None:
    """The loss, an operator on pictures, the distance to cells and a step of Adam."""
    rng = np.random.default_rng(2)
    picture = rng.uniform(size=(HEIGHT, WIDTH, 3)).astype(dtype)
    target = (255 * picture[::-1]).astype(np.uint8)
    mask = (rng.uniform(size=(HEIGHT, WIDTH)) > 0.2).astype(np.uint8)
    _, _, _, grad = _rust.photometric(picture, target, mask, 0.2, 0.1, True)
    look(grad)
    operator = _rust.Separable(np.eye(HEIGHT)[:7] + 0.1, np.eye(WIDTH)[:5] + 0.1, None)
    small = operator.apply(picture, False).reshape(7, 5, 3)
    look(small, operator.apply(small, True))
    flat = picture.ravel()
    distance, slope = _rust.cell_distance(flat, flat[::-1].copy(), np.full_like(flat, 0.1), 1.0, True)
    look(np.array(distance), slope)
    param, first, second = picture[0].copy(), np.zeros((WIDTH, 3), dtype), np.zeros((WIDTH, 3), dtype)
    _rust.adam_steps([(param, picture[1].copy(), first, second, 1, (0.01, 0.9, 0.999, 1e-15), 2)])
    look(param, first, second)


def photograph(dtype: type) -> None:
    """A photo that a camera took while it moved, and its gradient."""
    rng = np.random.default_rng(3)
    image = rng.uniform(size=(HEIGHT + 4, WIDTH + 4, 3)).astype(dtype)
    nearness = rng.uniform(size=(HEIGHT, WIDTH)).astype(dtype)
    warps = 1e-3 * rng.normal(size=(3, 3, 4))
    state, photo = _rust.exposure_forward(image, [HEIGHT, WIDTH], nearness, warps, [0.9, 1.0, 1.1])
    look(photo)
    v_image, v_warps, v_gains = _rust.exposure_backward(state, np.ones((HEIGHT, WIDTH, 3), dtype))
    look(v_image, v_warps, np.array(v_gains))


def add_views() -> None:
    """The gradients of several views, each of some of the Gaussians."""
    rng = np.random.default_rng(4)
    views = [np.flatnonzero(rng.uniform(size=COUNT) > 0.4).astype(np.int32) for _ in range(3)]
    sums, high = np.empty((COUNT, 5), np.float32), np.empty((COUNT, 15, 3), np.float32)
    means = rng.normal(size=(COUNT, 3)).astype(np.float32)
    values = [(rows, np.ones((len(rows), 5), np.float32)) for rows in views]
    colors = [(rows, np.ones((len(rows), 3), np.float32), [0.0, 0.0, -4.0], 3) for rows in views]
    _rust.add_rows(values, sums, 0.5)
    _rust.add_harmonics(colors, means, high, 0.5)
    look(sums, high)
    norms, seen = np.zeros(COUNT, np.float32), np.zeros(COUNT, np.float32)
    gradient = rng.normal(size=(COUNT, 2)).astype(np.float32)
    _rust.add_pulls(norms, seen, gradient, np.ones((COUNT, 2), np.int32), (WIDTH / 2, HEIGHT / 2))
    look(norms, seen)


for kind in (np.float32, np.float64):
    rasterize(kind, 3)
    rasterize(kind, None)
    train(kind)
    photograph(kind)
add_views()
print(_rust.simd_level(), "looked at everything")
