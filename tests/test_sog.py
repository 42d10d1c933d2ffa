"""SOG as it is written, read by our reader and by another one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from test_ply import random_gaussians

from hqgs.model.formats.codebooks import codebook, palette
from hqgs.model.gaussians import Gaussians


def matched(read: Gaussians, g: Gaussians) -> Gaussians:
    """The Gaussians of the file in the order of those that were written."""
    order = torch.cdist(g.means.double(), read.means.double()).argmin(1)
    assert len(set(order.tolist())) == len(g)
    return read.rows(order)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_is_read_within_the_bounds(tmp_path: Path, degree: int) -> None:
    g = random_gaussians(1200, degree)
    g.antialiased = degree == 2
    assert g.save(tmp_path / "a.sog") == 0
    read = Gaussians.load(tmp_path / "a.sog")
    assert (len(read), read.sh_degree, read.antialiased) == (1200, degree, degree == 2)
    read = matched(read, g)
    logs = [torch.sign(x.means) * torch.log1p(x.means.abs()) for x in (g, read)]
    step = (logs[0].amax(0) - logs[0].amin(0)) / 65535
    assert ((logs[0] - logs[1]).abs() <= 0.5 * step + 1e-6).all()
    assert (g.activated_opacities() - read.activated_opacities()).abs().max() <= 0.5 / 255 + 1e-3
    unit = torch.nn.functional.normalize(g.quats, dim=1), torch.nn.functional.normalize(read.quats, dim=1)
    angles = 2 * torch.arccos((unit[0] * unit[1]).sum(1).abs().clamp(max=1))
    assert 0 < angles.max() <= 0.02
    for before, after in ((g.scales, read.scales), (g.sh0, read.sh0)):
        assert (before - after).square().mean() < 2e-4 * before.var()
    assert (tmp_path / "a.sog").stat().st_size < 45 * 1200


def test_another_reader_finds_the_same(tmp_path: Path) -> None:
    pytest.importorskip("imagecodecs")
    gsply = pytest.importorskip("gsply")
    g = random_gaussians(500, 3)
    g.save(tmp_path / "a.sog")
    ours, theirs = Gaussians.load(tmp_path / "a.sog"), gsply.sogread(str(tmp_path / "a.sog"))
    np.testing.assert_allclose(theirs.means, ours.means, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(theirs.scales, ours.scales, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(np.abs((theirs.quats * ours.quats.numpy()).sum(1)), 1, atol=1e-5)
    np.testing.assert_allclose(theirs.sh0, ours.sh0[:, 0], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(theirs.shN, ours.shN, rtol=1e-5, atol=1e-5)


def test_the_same_scene_gives_the_same_bytes(tmp_path: Path) -> None:
    g = random_gaussians(300, 3)
    for name in ("a.sog", "b.sog"):
        g.save(tmp_path / name)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_a_codebook_holds_what_there_is() -> None:
    values = np.array([[-3.0, 0.5, 0.5], [7.0, -3.0, 1e-3]])
    book, codes = codebook(values)
    assert len(book) == 256
    np.testing.assert_allclose(book[codes], values, rtol=1e-6)
    rng = np.random.default_rng(0)
    many = rng.normal(size=20_000) ** 3  # most near 0, some far off
    book, codes = codebook(many)
    assert (np.abs(many[:, None] - book).argmin(1) == codes).mean() > 0.999
    even = np.linspace(many.min(), many.max(), 256)
    nearest = np.abs(many[:, None] - even).min(1)
    assert np.square(book[codes] - many).mean() < 0.3 * np.square(nearest).mean()


def test_a_palette_finds_the_kinds_that_there_are() -> None:
    rng = np.random.default_rng(0)
    kinds = rng.normal(size=(30, 45))
    rows = kinds[rng.integers(30, size=3000)] + 0.01 * rng.normal(size=(3000, 45))
    sets, labels = palette(rows, np.ones(3000), 200)
    assert len(sets) <= 200
    assert labels.max() < len(sets)
    assert np.square(sets[labels] - rows).mean() < 1e-3 * rows.var()
    (one,), labels = palette(rows[:1], np.ones(1), 1)
    np.testing.assert_allclose(one, rows[0])
    assert labels.tolist() == [0]
