"""Bicubic resizing against a slow direct computation, Pillow's interior, and pictures with known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from hqgs.photos.resize import resize, resize_matrix

SIZES = [(12, 12), (12, 6), (12, 3), (13, 5), (378, 95), (7, 2), (2, 7), (5, 13), (95, 378), (1, 4), (4, 1)]


def keys(x: float) -> float:
    """Keys's cubic by its conditions (a = -0.5), in the form of Catmull and Rom."""
    x = abs(x)
    if x < 1:
        return 0.5 * (2 - 5 * x**2 + 3 * x**3)
    return 0.5 * (4 - 8 * x + 5 * x**2 - x**3) if x < 2 else 0.0


def direct(signal: NDArray[np.float64], size_out: int) -> NDArray[np.float64]:
    """Weighted means over a signal that was mirrored beforehand, sample by sample."""
    step = len(signal) / size_out
    wide = max(1.0, step)
    margin = math.ceil(2 * wide) + 1
    long = np.pad(signal, margin, mode="symmetric")
    out = np.empty(size_out)
    for i in range(size_out):
        weights = [keys((k - margin + 0.5 - (i + 0.5) * step) / wide) for k in range(len(long))]
        out[i] = np.dot(weights, long) / np.sum(weights)
    return out


@pytest.mark.parametrize(("size_in", "size_out"), SIZES)
def test_the_matrix_is_the_direct_computation(size_in: int, size_out: int) -> None:
    signal = np.random.default_rng(size_in).standard_normal(size_in)
    matrix = resize_matrix(size_in, size_out)
    assert matrix.shape == (size_out, size_in)
    assert matrix.dtype == np.float64
    np.testing.assert_allclose(matrix.sum(1), 1, rtol=0, atol=1e-14)
    np.testing.assert_allclose(matrix @ signal, direct(signal, size_out), rtol=0, atol=1e-13)


def test_weights_of_a_half() -> None:
    """At a half the distances are 1/8, 3/8, 5/8, 7/8 of the widened kernel: fractions of 256."""
    np.testing.assert_allclose(
        resize_matrix(16, 8)[3, 3:11] * 256, [-3, -9, 29, 111, 111, 29, -9, -3], rtol=0, atol=1e-11
    )
    edge = resize_matrix(16, 8)[0] * 256  # the three samples beyond the border fall back onto the first three
    np.testing.assert_allclose(edge[:5], [111 + 29, 111 - 9, 29 - 3, -9, -3], rtol=0, atol=1e-11)


@pytest.mark.parametrize(("width", "height"), [(30, 20), (15, 10), (40, 13), (120, 77)])
def test_like_pillow_inside(width: int, height: int) -> None:
    """Pillow's bicubic filter has a = -0.5 and widens its kernel too; its borders differ."""
    image = np.random.default_rng(1).random((40, 60, 1), np.float32)
    theirs = np.asarray(Image.fromarray(image[..., 0]).resize((width, height), Image.Resampling.BICUBIC))
    ours = resize(image, height, width)[..., 0]
    rows, columns = (math.ceil(2 * max(1, new / old) + 1) for old, new in ((40, height), (60, width)))
    inner = np.s_[rows:-rows, columns:-columns]
    assert theirs[inner].size > 0
    np.testing.assert_allclose(ours[inner], theirs[inner], rtol=0, atol=2e-6)
    assert np.abs(ours - theirs).max() > 1e-3


def test_the_same_size_changes_nothing() -> None:
    image = np.random.default_rng(2).random((9, 14, 3), np.float32)
    np.testing.assert_array_equal(resize(image, 9, 14), image)


def test_each_axis_and_channel_on_its_own() -> None:
    image = np.random.default_rng(3).random((9, 14, 3), np.float32)
    out = resize(image, 4, 21)
    assert out.shape == (4, 21, 3)
    assert out.dtype == np.float32
    assert out.flags.c_contiguous
    expected = np.einsum("ij,jkc,lk->ilc", resize_matrix(9, 4), image.astype(float), resize_matrix(14, 21))
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-7)


def test_enlarging_keeps_parabolas_in_place() -> None:
    """a = -0.5 is the value at which the cubic reproduces quadratics; any shift would show."""
    x = np.arange(20) + 0.5
    new = (np.arange(60) + 0.5) / 3
    out = resize_matrix(20, 60) @ (x - 7) ** 2
    np.testing.assert_allclose(out[6:-6], (new[6:-6] - 7) ** 2, rtol=0, atol=1e-11)


@pytest.mark.parametrize(("waves", "passes"), [(1, True), (4, True), (8, True), (60, False), (90, False)])
def test_what_a_quarter_can_hold_stays_and_the_rest_goes(waves: int, passes: bool) -> None:
    """Cosines that the mirrored border continues: 96 samples to 24, which can hold 24 half-waves."""
    old = np.cos(np.pi * waves * (np.arange(96) + 0.5) / 96)
    new = np.cos(np.pi * waves * (np.arange(24) + 0.5) / 24)
    out = resize_matrix(96, 24) @ old
    if passes:
        assert 0.98 < np.dot(out, new) / np.dot(new, new) < 1.03
        assert np.abs(out - new * np.dot(out, new) / np.dot(new, new)).max() < 1e-12  # no shift, no border
    else:
        assert np.abs(out).max() < 0.1  # taking every fourth sample would leave all of it


def test_bad_sizes_and_shapes() -> None:
    with pytest.raises(ValueError, match="size_out 0"):
        resize_matrix(4, 0)
    with pytest.raises(ValueError, match="size_in 0"):
        resize_matrix(0, 4)
    with pytest.raises(ValueError, match=r"\[H, W, C\], got the shape \(4, 4\)"):
        resize(np.zeros((4, 4), np.float32), 2, 2)
