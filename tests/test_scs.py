"""The SCS loss and its edge map: values, gradients, digits in single precision, limits, masks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from hqgs.training.methods.paper import DIMMEST, edge_magnitude, scs_loss, scs_weights


def loss_of(render: Tensor, target: Tensor, g: Tensor, mask: Tensor | None = None) -> Tensor:
    weights = 1 - g
    return scs_loss(render, target, weights if mask is None else torch.where(mask[..., None], weights, 0.0))


def images(
    height: int = 7, width: int = 6, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor]:
    """A render, a target and the target's g."""
    rng = np.random.default_rng(0)
    render, target = (torch.from_numpy(rng.uniform(0, 1, (height, width, 3))).to(dtype) for _ in range(2))
    return render, target, edge_magnitude(target)


def reference(render: Tensor, target: Tensor, g: Tensor, mask: Tensor | None = None) -> Tensor:
    """The equation, by torch's own operations in double precision."""
    low = 1 - g
    low = low if mask is None else low * mask[..., None]
    a, b = ((low * x).double().flatten() for x in (render, target))
    return 1 - torch.nn.functional.cosine_similarity(a, b, dim=0)


@pytest.mark.parametrize("masked", [False, True])
def test_value_and_gradient_follow_the_equation(masked: bool) -> None:
    render, target, g = images()
    mask = torch.from_numpy(np.random.default_rng(1).random((7, 6)) < 0.7) if masked else None
    render.requires_grad_()
    loss, expected = loss_of(render, target, g, mask), reference(render, target, g, mask)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-12)
    assert 0.05 < loss.item() < 1
    (grad,) = torch.autograd.grad(loss, render)
    (expected_grad,) = torch.autograd.grad(expected, render)
    torch.testing.assert_close(grad, expected_grad, rtol=1e-10, atol=1e-14)
    assert torch.autograd.gradcheck(lambda r: loss_of(r, target, g, mask), (render,), eps=1e-6, atol=1e-9)
    # No pull on the brightness as a whole.
    assert abs((grad * render.detach()).sum().item()) < 1e-15


def test_the_gradient_below_the_floor() -> None:
    render, target, g = images()
    dim = (1e-3 * render).requires_grad_()
    assert torch.autograd.gradcheck(lambda r: loss_of(r, target, g), (dim,), eps=1e-6, atol=1e-7)
    # The floor is entered without a jump.
    low = 1 - g
    at_floor = render * (DIMMEST * (low * target).norm() / (low * render).norm())
    above, below = (loss_of(at_floor * (1 + s), target, g).item() for s in (1e-9, -1e-9))
    assert above == pytest.approx(below, abs=1e-8)
    assert above == pytest.approx(reference(render, target, g).item(), rel=1e-9)


def test_bytes_and_floats_agree() -> None:
    render, _, _ = images(20, 30, torch.float32)
    target = torch.from_numpy(np.random.default_rng(2).integers(0, 256, (20, 30, 3), dtype=np.uint8))
    g = edge_magnitude(target)
    found = []
    for photo in (target, target / 255.0):
        for scale in (1.0, 1e-3):  # above and below the floor
            r = (scale * render).requires_grad_()
            loss = loss_of(r, photo, g)
            (grad,) = torch.autograd.grad(loss, r)
            found.append((loss.item(), grad))
    for one, other in ((found[0], found[2]), (found[1], found[3])):
        assert one[0] == pytest.approx(other[0], rel=1e-5)
        torch.testing.assert_close(one[1], other[1], rtol=1e-4, atol=1e-5 * one[1].abs().max().item())


def test_only_structure_off_the_edges_counts() -> None:
    render, target, g = images()
    base = loss_of(render, target, g).item()
    assert loss_of(3.7 * render, target, g).item() == pytest.approx(base, rel=1e-12)
    assert loss_of(0.4 * target, target, g).item() < 1e-30
    on_edge = torch.where(g == 1, 50.0, 0.0)
    assert on_edge.any()
    assert loss_of(render + on_edge, target, g).item() == base
    assert loss_of(render, target, torch.zeros_like(g)).item() != pytest.approx(base, rel=1e-3)
    assert loss_of(-target, target, g).item() == pytest.approx(2, rel=1e-12)


@pytest.mark.parametrize("noise", [1e-2, 1e-3, 1e-4, 1e-5])
def test_single_precision_keeps_its_digits_where_render_and_photo_agree(noise: float) -> None:
    rng = np.random.default_rng(3)
    target = rng.uniform(0.05, 1, (64, 80, 3)).astype(np.float32)
    render = (target * (1 + noise * rng.standard_normal(target.shape))).astype(np.float32)
    g = edge_magnitude(torch.from_numpy(target))
    low = (1 - g).numpy().astype(np.longdouble)
    a, b = low * render, low * target
    u, v = a / np.sqrt((a * a).sum()), b / np.sqrt((b * b).sum())
    expected = 0.5 * ((u - v) ** 2).sum()
    expected_grad = low * (u - v - expected * u) / np.sqrt((a * a).sum())
    r = torch.from_numpy(render).requires_grad_()
    loss = loss_of(r, torch.from_numpy(target), g)
    (grad,) = torch.autograd.grad(loss, r)
    tolerance = max(1e-6, 2e-7 / noise)
    assert loss.item() == pytest.approx(float(expected), rel=tolerance)
    error = np.linalg.norm((grad.numpy() - expected_grad).astype(np.float64).ravel())
    assert error < tolerance * np.linalg.norm(expected_grad.astype(np.float64).ravel())


def value_and_gradient(render: Tensor, target: Tensor, mask: Tensor | None = None) -> tuple[float, Tensor]:
    render = render.clone().requires_grad_()
    loss = loss_of(render, target, edge_magnitude(target), mask)
    (grad,) = torch.autograd.grad(loss, render)
    return loss.item(), grad


def test_limits() -> None:
    render, target, g = images(dtype=torch.float32)
    black, white = torch.zeros_like(render), torch.ones_like(render)
    # A black target has no direction, and neither has one that is masked away.
    for r in (render, black, white):
        assert value_and_gradient(r, black)[0] == 0
        assert value_and_gradient(r, black)[1].abs().max() == 0
    nothing = torch.zeros(7, 6, dtype=torch.bool)
    loss, grad = value_and_gradient(render, target, nothing)
    assert loss == 0
    assert grad.abs().max() == 0
    # A black render: 1, and a finite pull towards the target.
    loss, grad = value_and_gradient(black, target)
    assert loss == 1
    low = 1 - g
    expected = -low * (low * target) / (DIMMEST * (low * target).square().sum())
    torch.testing.assert_close(grad, expected, rtol=1e-5, atol=0)
    # Constant images point the same way, whatever their brightness.
    loss, grad = value_and_gradient(0.3 * white, white)
    assert loss < 1e-12
    assert grad.abs().max() < 1e-7
    assert value_and_gradient(white, white)[0] < 1e-14


@pytest.mark.parametrize("render", [0.0, 1e-30, 1e-3, 0.5, 1.0, 1e4])
@pytest.mark.parametrize("target", [0.0, 1e-6, 0.5, 1.0])
def test_one_pixel(render: float, target: float) -> None:
    loss, grad = value_and_gradient(torch.full((1, 1, 3), render), torch.full((1, 1, 3), target))
    assert 0 <= loss <= 1
    assert torch.isfinite(grad).all()
    if render >= 0.1 * target > 0:
        assert loss < 1e-12  # the same hue


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_what_is_not_finite_stays_so(bad: float) -> None:
    render, target, g = images(dtype=torch.float32)
    render[2, 3, 1] = bad
    assert loss_of(render, target, g).isnan()


def test_the_number_of_threads_changes_no_bit() -> None:
    render, target, g = images(150, 200)
    found = set()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        r = render.clone().requires_grad_()
        loss = loss_of(r, target, g)
        loss.backward()
        assert r.grad is not None
        found.add((loss.item(), r.grad.numpy().tobytes()))
        assert torch.get_num_threads() == threads
    assert len(found) == 1


def test_the_weights_leave_out_edges_and_what_is_masked() -> None:
    _, target, g = images(dtype=torch.float32)
    mask = torch.from_numpy(np.random.default_rng(1).random((7, 6)) < 0.7)
    assert torch.equal(scs_weights(target), 1 - g)
    weights = scs_weights(target, mask)
    assert not weights[~mask].any()
    assert torch.equal(weights[mask], (1 - edge_magnitude(target, mask))[mask])


# --- The edge map: against SciPy's Sobel filter, at the borders, on flat photos, and with masks


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


def test_a_step_has_its_edge_on_both_sides_and_only_there() -> None:
    image = torch.zeros(6, 8, 3)
    image[:, 4:] = torch.tensor([0.9, 0.3, 0.0])
    g = edge_magnitude(image)
    expected = torch.zeros(6, 8, 3)
    expected[:, 3:5] = torch.tensor([1.0, 1 / 3, 0.0])  # one range for the three channels
    torch.testing.assert_close(g, expected)


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
        edge_magnitude(image)
