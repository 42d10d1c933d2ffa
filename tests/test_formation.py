"""The operators that degrade a render in the loss, against the degradations of the photos themselves."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fixtures_scenes import degrade_image
from numpy.typing import NDArray
from scipy import ndimage

from hqgs.photos.formation import Kernel, Separable, blur_matrix, formation
from hqgs.photos.formula import parse_degradation
from hqgs.photos.jpeg import tables_of_quality
from hqgs.photos.resize import resize_matrix
from hqgs.training.methods.formed import JpegCells


def picture(height: int, width: int) -> NDArray[np.float32]:
    """Waves of several lengths and an edge, float32 [H, W, 3]."""
    y, x = np.mgrid[:height, :width]
    waves = [0.5 + 0.2 * np.sin(0.3 * x + k) * np.cos(0.2 * y) + 0.2 * (x + y > 40) for k in range(3)]
    return np.stack(waves, -1).astype(np.float32)


@pytest.mark.parametrize(
    "kind",
    [
        "blur:1.7", "blur", "lowres:4", "blur+lowres:2", "blur:2+lowres:3", "defocus:3", "defocus",
        "motion:9", "motion:4.5+lowres:2", "lowres:3+motion:7+blur:1", "blur:1+defocus:2+lowres:2",
    ],
)  # fmt: skip
def test_the_operator_is_the_degradation(kind: str) -> None:
    image, degradation = picture(61, 90), parse_degradation(kind)
    degraded = degrade_image(image, degradation, np.random.default_rng(3))
    expected = degraded.image if degraded.low is None else degraded.low
    direction = np.random.default_rng(3).uniform(0, np.pi)  # what the degradation draws first
    operator = formation(degradation, 61, 90, direction)
    assert operator is not None
    assert operator.size == expected.shape[:2]
    np.testing.assert_allclose(operator(torch.from_numpy(image)).numpy(), expected, atol=2e-6)


def test_noise_and_jpeg_are_not_linear() -> None:
    assert formation(parse_degradation("noise:10+jpeg:20"), 40, 50) is None
    assert formation(parse_degradation("motion:9"), 40, 50, direction=None) is None


def test_a_kernel_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="a kernel of 41 x 41 px is too large for a photo of 50 x 20 px"):
        formation(parse_degradation("defocus:20"), 20, 50)


def test_the_gradient_is_the_transposed_operator() -> None:
    rng = np.random.default_rng(1)
    operator = Separable.of(rng.random((3, 5)), rng.random((4, 6)))
    image = torch.rand(5, 6, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(operator, (image.requires_grad_(),), atol=1e-5, fast_mode=True)


def test_the_gradient_of_a_kernel_is_the_transposed_one() -> None:
    """Also at the border, where the kernel meets its mirror image; the kernel has no symmetry."""
    operator = Kernel.of(np.random.default_rng(1).random((5, 7)), 6, 9)
    image, other, weights = torch.rand(
        3, 6, 9, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    (gradient,) = torch.autograd.grad((operator(image.requires_grad_()) * weights).sum(), image)
    assert float((gradient * other).sum()) == pytest.approx(
        float((operator(other) * weights).sum()), rel=1e-12
    )


def test_a_kernel_is_a_convolution() -> None:
    rng = np.random.default_rng(2)
    kernel, image = rng.random((3, 5)), rng.random((8, 9, 1))
    expected = ndimage.convolve(image[..., 0], kernel, mode="mirror")
    found = Kernel.of(kernel, 8, 9)(torch.from_numpy(image)).numpy()
    np.testing.assert_allclose(found[..., 0], expected, rtol=1e-12)


def test_against_dense_matrices_in_float64() -> None:
    operator = formation(parse_degradation("blur:2+lowres:3"), 120, 90)
    rows, columns = (resize_matrix(side, side // 3) @ blur_matrix(side, 2.0) for side in (120, 90))
    assert operator is not None
    image = picture(120, 90)
    expected = np.einsum("hH,HWc,wW->hwc", rows, image.astype(np.float64), columns)
    out = operator(torch.from_numpy(image)).numpy()
    assert out.dtype == np.float32
    np.testing.assert_allclose(out, expected, atol=5e-7)
    double = operator(torch.from_numpy(image).double()).numpy()
    np.testing.assert_allclose(double, expected, atol=1e-14)


def test_channels_are_mixed_between_the_axes() -> None:
    rng = np.random.default_rng(2)
    rows, columns, channels = rng.normal(size=(7, 5)), rng.normal(size=(3, 20)), rng.normal(size=(2, 3))
    operator = Separable.of(rows, columns, channels)
    image = torch.from_numpy(rng.normal(size=(5, 20, 3))).requires_grad_()
    expected = np.einsum("hH,HWc,wW,dc->hwd", rows, image.detach().numpy(), columns, channels)
    np.testing.assert_allclose(operator(image).detach().numpy(), expected, atol=1e-12)
    assert torch.autograd.gradcheck(operator, (image,), fast_mode=True)


def test_what_is_no_picture_is_refused() -> None:
    operator = Separable.of(np.ones((2, 3)), np.ones((4, 5)))
    assert operator.size == (2, 4)
    with pytest.raises(ValueError, match=r"image: expected shape \[3, 5, C\], got \[5, 3, 1\]"):
        operator(torch.zeros(5, 3, 1))
    with pytest.raises(ValueError, match=r"image: must be float32 or float64, got torch\.uint8"):
        operator(torch.zeros(3, 5, 1, dtype=torch.uint8))
    with pytest.raises(ValueError, match=r"columns: expected shape \[height, width\], got \[5\]"):
        Separable.of(np.ones((2, 3)), np.ones(5))


@pytest.mark.parametrize(
    ("kind", "least"), [("lowres:2", 300), ("defocus:3", 1500), ("motion:9+lowres:2", 300)]
)
def test_a_masked_pixel_spoils_what_it_reaches(kind: str, least: int) -> None:
    operator = formation(parse_degradation(kind), 40, 40, direction=0.5)
    assert operator is not None
    mask = np.ones((40, 40), bool)
    mask[20, 10] = False
    low = operator.mask(mask)
    image = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0))
    changed = image.clone()
    changed[20, 10] += 1
    moved = (operator(changed) != operator(image)).any(-1).numpy()
    assert moved.any()
    assert not (moved & low).any()
    assert low.sum() > least


@pytest.mark.parametrize("size", [(48, 64), (45, 61)])
@pytest.mark.parametrize("quality", [5, 10, 20, 50])
def test_the_clean_picture_lies_in_the_cells_of_its_file(quality: int, size: tuple[int, int]) -> None:
    image = np.float32(0.2) + np.float32(0.6) * picture(*size)  # nothing is clipped
    photo = degrade_image(image, parse_degradation(f"jpeg:{quality}"), np.random.default_rng(0)).image
    cells = JpegCells(tables_of_quality(quality), *size)
    centres = cells.centres(torch.from_numpy(photo))
    inside = float(cells.loss(torch.from_numpy(image), centres))
    assert inside < 0.02 * np.abs(photo - image).mean()  # rounding to 8 bits and libjpeg's integer arithmetic
    brighter = float(cells.loss(torch.from_numpy(image + 0.1), centres))
    assert brighter > 3e-3 > 3 * inside


def test_cells_at_quality_100_are_the_pixels() -> None:
    """With steps of 1/255 the distance is that of the coefficients, here of a change in one block's mean."""
    ones = (1,) * 64
    cells = JpegCells((ones, ones), 16, 16)
    photo = torch.full((16, 16, 3), 0.5)
    centres = cells.centres(photo)
    image = photo.clone()
    image[:8, :8] += 0.1  # grey: luma only; the DC coefficient of an 8 x 8 block is 8 times its mean
    expected = (8 * 0.1 - 0.5 / 255 - (cells.coefficients(photo)[0] - centres[0])[0, 0, 0].abs()).item()
    assert float(cells.loss(image, centres)) * 3 * 256 == pytest.approx(expected, abs=3e-3)


def test_the_cells_have_a_gradient() -> None:
    cells = JpegCells(tables_of_quality(20), 9, 17)
    photo = torch.rand(9, 17, 3, generator=torch.Generator().manual_seed(0))
    centres = cells.centres(photo)
    image = (photo + 0.3).double().requires_grad_()
    centres = [part.double() for part in centres]
    assert torch.autograd.gradcheck(
        lambda x: cells.loss(x, centres), (image,), atol=1e-6, rtol=1e-3, fast_mode=True
    )
