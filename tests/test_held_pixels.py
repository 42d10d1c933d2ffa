"""The pixels that the loss leaves out, and the learning rates that follow them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from run_state import run_until
from test_hqgs import fixed
from tiny_scene import tiny_config, tiny_scene
from torch import Tensor

from hqgs.evaluation.held_out import held_out_renders
from hqgs.photos.formula import parse_degradation
from hqgs.pipeline import run_to_end
from hqgs.scene.degrade import degrade_scene
from hqgs.scene.scene import View
from hqgs.training.methods.formed import HELD_PIXELS, PLATEAU_STEPS, HeldPixels, Plateau
from hqgs.training.methods.hqgs import HQGS
from hqgs.training.trainer import Trainer

SIZE = (20, 30)
Photos = dict[str, tuple[Tensor, Tensor | None]]


def photos(count: int = 3) -> Photos:
    rng = np.random.default_rng(5)
    return {f"{k}.png": (torch.from_numpy(rng.random((*SIZE, 3), np.float32)), None) for k in range(count)}


class Held:
    """The held pixels of photos, and what is decided on them."""

    def __init__(self, given: Photos) -> None:
        drawn = {name: HeldPixels.draw(k, *photo) for k, (name, photo) in enumerate(given.items())}
        self.masks = {name: mask for name, (_, mask) in drawn.items()}
        self.pixels = {name: (k, held) for k, (name, (held, _)) in enumerate(drawn.items())}
        self.plateau = Plateau(len(given))

    def see(self, name: str, image: Tensor) -> None:
        k, held = self.pixels[name]
        self.plateau.see(k, held.error(image))

    @property
    def rate_left(self) -> float:
        return self.plateau.rate_left


def test_rates_that_move_nothing_are_not_halved_to_nothing() -> None:
    """A report says which part of them was left."""
    plateau = Plateau(1)
    for _ in range(1200):
        for _ in range(PLATEAU_STEPS):
            plateau.see(0, torch.tensor(1.0))
    assert 0 < plateau.rate_left < 1e-10


def look(held: Held, given: Photos, offset: float) -> None:
    """As many steps as lie between two looks, with renders that are `offset` off."""
    names = list(given)
    for k in range(len(names) * -(-PLATEAU_STEPS // len(names))):
        name = names[k % len(names)]
        held.see(name, given[name][0] + offset)


def test_a_fiftieth_of_the_pixels_that_count_is_held_back() -> None:
    mask = torch.zeros(SIZE, dtype=torch.bool)
    mask[:, :10] = True
    given = photos(2) | {"mask.png": (photos()["0.png"][0], mask)}
    masks = Held(given).masks
    assert {name: int((~m).sum()) for name, m in masks.items() if name != "mask.png"} == {
        "0.png": 600 / HELD_PIXELS,
        "1.png": 600 / HELD_PIXELS,
    }
    assert int(masks["mask.png"].sum()) == 200 - 200 // HELD_PIXELS
    assert not masks["mask.png"][~mask].any()
    assert int(mask.sum()) == 200  # the given one is as it was
    assert not torch.equal(masks["0.png"], masks["1.png"])
    again = Held(given).masks
    assert all(torch.equal(masks[name], again[name]) for name in masks)


def test_only_held_pixels_are_looked_at() -> None:
    given = photos()
    held = Held(given)
    look(held, given, 0.3)
    for name, (photo, _) in given.items():
        worse = torch.where(held.masks[name][..., None], photo + 9.0, photo + 0.2)
        given[name] = (worse, None)
    look(held, given, 0.0)
    assert held.rate_left == 1.0


def test_rates_are_halved_at_each_look_without_a_gain() -> None:
    given = photos()
    held = Held(given)
    rates = []
    for offset in (0.5, 0.4, 0.4, 0.41, 0.39, 0.395, 0.3):
        look(held, given, offset)
        rates.append(held.rate_left)
    assert rates == [1, 1, 1 / 2, 1 / 4, 1 / 4, 1 / 8, 1 / 8]


def test_photos_are_compared_with_themselves() -> None:
    """A photo that comes in later, or is left out for a while, is no gain and no loss."""
    given = photos()
    first = {name: given[name] for name in ("0.png", "1.png")}
    held = Held(given)
    for offset in (0.5, 0.4):
        for k in range(201):
            held.see(f"{k % 2}.png", first[f"{k % 2}.png"][0] + offset)
    for k in range(201):
        name = f"{k % 3}.png"
        held.see(name, given[name][0] + (5.0 if k % 3 == 2 else 0.39))
    assert held.rate_left == 1.0
    for _ in range(201):
        held.see("2.png", given["2.png"][0] + 4.0)
    assert held.rate_left == 1.0


def test_what_is_not_finite_is_passed_over() -> None:
    given = photos() | {"masked.png": (photos()["0.png"][0], torch.zeros(SIZE, dtype=torch.bool))}
    held = Held(given)
    look(held, given, 0.5)
    held.see("0.png", torch.full((*SIZE, 3), torch.nan))
    look(held, given, 0.4)
    look(held, given, 0.4)
    assert held.rate_left == 1 / 2
    look(held, given, torch.nan)
    assert held.rate_left == 1 / 2


def test_its_state_goes_on_where_it_was() -> None:
    given = photos()
    one, other = Held(given), Held(given)
    for offset in (0.5, 0.6):
        look(one, given, offset)
    for k in range(100):
        one.see(f"{k % 3}.png", given[f"{k % 3}.png"][0] + 0.7)
    other.plateau.load_state_dict(one.plateau.state_dict())
    for held in (one, other):
        for k in range(100, 201):
            held.see(f"{k % 3}.png", given[f"{k % 3}.png"][0] + 0.4)
    assert one.rate_left == other.rate_left == 1 / 4
    ends = one.plateau.state_dict(), other.plateau.state_dict()
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])
    with pytest.raises(ValueError, match=r"sums is \[3\], wanted \[2\]"):
        Plateau(2).load_state_dict(one.plateau.state_dict())
    with pytest.raises(KeyError, match="counts"):
        other.plateau.load_state_dict({k: v for k, v in one.plateau.state_dict().items() if k != "counts"})


def test_a_scene_that_learns_the_noise_is_found_out(tmp_path: Path) -> None:
    """Grey photos have nothing else to learn. The scene stays nearer to the grey for it."""
    clean = tiny_scene()
    grey = [replace(view, image=np.full_like(view.image, 128)) for view in clean.train]
    scene = degrade_scene(replace(clean, train=grey), parse_degradation("noise:50"), 0)
    fast = {"lr_sh0": 0.02, "lr_shN": 0.01, "lr_scales": 0.03, "lr_quats": 0.01, "lr_opacities": 0.2}
    config = tiny_config(2_000, method="hqgs", hqgs=fixed("noise:50"), **fast)
    trainer, constant = Trainer(scene, config), Trainer(scene, config)
    with patch.object(HQGS, "rate_left", 1.0):
        run_until(constant, config.iterations)
    run_until(trainer, config.iterations)
    assert trainer.method.rate_left <= 1 / 16
    errors = [error_of_grey(t, scene.train) for t in (trainer, constant)]
    assert errors[0] < 0.92 * errors[1]
    run_to_end(trainer, tmp_path / "out")  # which only writes
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert any(note.startswith("the learning rates were lowered to 1/") for note in report["notes"])
    assert any(entry["what"] == "1/50 of each photo's pixels in the loss" for entry in report["left_out"])


def error_of_grey(trainer: Trainer, views: list[View]) -> float:
    renders = held_out_renders(replace(trainer.scene, test=views), trainer.shown())
    return float(np.mean([np.square(view.render - 128 / 255) for view in renders]))
