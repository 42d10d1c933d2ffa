"""The edge map: against SciPy's Sobel filter, at the borders, on flat photos, and with masks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import ndimage

from hqgs.training.methods.paper import edge_aware_map, edge_magnitude


def scipy_magnitude(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """sqrt(Ix^2 + Iy^2) for each channel, with the border repeated."""
    channels = [image[..., c].astype(np.float64) for c in range(image.shape[2])]
    sobel = [[ndimage.sobel(channel, axis=axis, mode="nearest") for axis in (0, 1)] for channel in channels]
    return np.stack([np.hypot(rows, columns) for rows, columns in sobel], axis=-1)


@pytest.mark.parametrize("size", [(7, 5), (2, 9), (1, 6), (6, 1), (33, 40)])
def test_against_scipy(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).normal(0.4, 0.6, (*size, 3))
    m = scipy_magnitude(image)
    expected = (m - m.min()) / (m.max() - m.min())
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 2e-6)):
        g = edge_magnitude(torch.from_numpy(image).to(dtype))
        assert g.dtype == dtype
        np.testing.assert_allclose(g.numpy(), expected, rtol=0, atol=tolerance)
        assert g.min() == 0
        assert g.max() == 1


def test_bytes_are_divided_by_255() -> None:
    image = torch.from_numpy(np.random.default_rng(1).integers(0, 256, (9, 8, 3), dtype=np.uint8))
    assert torch.equal(edge_magnitude(image), edge_magnitude(image / 255.0))
    expected = edge_magnitude(image) * (image / 255.0)
    assert torch.equal(edge_aware_map(image), expected)
    assert edge_aware_map(image).max() > 0.1


def test_a_step_has_its_edge_on_both_sides_and_only_there() -> None:
    image = torch.zeros(6, 8, 3)
    image[:, 4:] = torch.tensor([0.9, 0.3, 0.0])
    g = edge_magnitude(image)
    expected = torch.zeros(6, 8, 3)
    expected[:, 3:5] = torch.tensor([1.0, 1 / 3, 0.0])  # one range for the three channels
    torch.testing.assert_close(g, expected)
    assert edge_aware_map(image)[:, 3].abs().max() == 0  # the dark side of the edge: g * 0


def test_brightness_and_contrast_do_not_matter() -> None:
    image = torch.from_numpy(np.random.default_rng(2).random((12, 10, 3)))
    torch.testing.assert_close(edge_magnitude(3 * image + 7), edge_magnitude(image), rtol=0, atol=1e-12)


@pytest.mark.parametrize("value", [0.0, 0.1, 0.3, 1.0, -2.7, 1e-30, 1e30])
@pytest.mark.parametrize("size", [(1, 1), (3, 3), (37, 51)])
def test_flat_photos_have_no_edges(value: float, size: tuple[int, int]) -> None:
    for dtype in (torch.float32, torch.float64):
        image = torch.full((*size, 3), value, dtype=dtype)
        image[..., 1] *= 0.7
        assert edge_magnitude(image).abs().max() == 0
        assert edge_aware_map(image).abs().max() == 0


def test_rounding_is_no_edge() -> None:
    noise = torch.from_numpy(np.random.default_rng(3).normal(0, 6e-8, (20, 20, 3)).astype(np.float32))
    assert edge_magnitude(0.7 + noise).abs().max() == 0
    assert edge_magnitude(0.7 + 1e4 * noise).max() == 1


def test_what_a_mask_leaves_out_changes_nothing() -> None:
    rng = np.random.default_rng(4)
    image = torch.from_numpy(rng.random((14, 11, 3)))
    mask = torch.ones(14, 11, dtype=torch.bool)
    mask[:, 7:] = False
    g = edge_magnitude(image, mask)
    other = image.clone()
    other[:, 7:] = torch.from_numpy(rng.normal(0, 100, (14, 4, 3)))
    assert torch.equal(edge_magnitude(other, mask), g)
    # Columns 0..5 have all their neighbours within the mask.
    m = scipy_magnitude(image.numpy())[:, :6]
    np.testing.assert_allclose(g[:, :6].numpy(), (m - m.min()) / (m.max() - m.min()), atol=1e-12)
    assert g[:, 6:].abs().max() == 0


def test_a_mask_without_an_inner_pixel_gives_no_edges() -> None:
    image = torch.rand(6, 6, 3, generator=torch.Generator().manual_seed(0))
    assert edge_magnitude(image, torch.zeros(6, 6, dtype=torch.bool)).abs().max() == 0
    assert edge_magnitude(image, torch.eye(6, dtype=torch.bool)).abs().max() == 0


def test_bad_input_is_named() -> None:
    image = torch.zeros(4, 5, 3)
    with pytest.raises(ValueError, match=r"image: must be \[H, W, C\] with at least one pixel, got \[4, 5\]"):
        edge_magnitude(image[..., 0])
    with pytest.raises(ValueError, match=r"image: must be .*got \[0, 5, 3\]"):
        edge_magnitude(image[:0])
    with pytest.raises(ValueError, match=r"image: must be uint8, float32 or float64, got torch\.int32"):
        edge_magnitude(image.int())
    with pytest.raises(
        ValueError, match=r"mask: must be bool \[4, 5\] as the image, got torch\.bool \[5, 4\]"
    ):
        edge_magnitude(image, torch.ones(5, 4, dtype=torch.bool))
    image[1, 2, 0] = torch.nan
    with pytest.raises(ValueError, match="image: 1 values are not finite"):
        edge_aware_map(image)
