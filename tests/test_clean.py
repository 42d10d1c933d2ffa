"""`hqgs clean`: what hangs before one photo alone goes, and held-out photos tell whether it paid."""

from __future__ import annotations

import signal
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from run_state import run_until
from tiny_scene import tiny_config, tiny_scene

import hqgs
from hqgs.cli.main import main
from hqgs.evaluation.run_folder import RunFolder
from hqgs.model.gaussians import Gaussians
from hqgs.scene import source as scene_source
from hqgs.scene.scene import Scene
from hqgs.scene.world import World
from hqgs.training import cleaning
from hqgs.training.cleaning import Cleaned, clean
from hqgs.training.trainer import Trainer

FOG = 12  # Gaussians in the air


@cache
def scene() -> Scene:
    """With two held-out photos, so that a gain has a scatter."""
    made = tiny_scene(8, 60)
    return replace(made, test=[*made.test, made.train[-1]], train=made.train[:-1])


@cache
def foggy() -> Gaussians:
    """A trained scene, with opaque blobs of wrong colours halfway between the cameras and the plane."""
    trainer = run_until(Trainer(scene(), tiny_config(150)), 150)
    shown, rng = trainer.shown(), np.random.default_rng(0)
    means = np.concatenate([rng.uniform(-0.7, 0.7, (FOG, 2)), np.full((FOG, 1), 1.5)], 1).astype(np.float32)
    blobs = Gaussians.from_points(means, np.full((FOG, 3), 255, np.uint8), shown.sh_degree)
    blobs = replace(blobs, scales=torch.full((FOG, 3), -2.5), opacities=torch.full((FOG,), 1.0))
    both = zip(shown.named().items(), blobs.named().values(), strict=True)
    return shown.like({name: torch.cat([tensor, other]) for (name, tensor), other in both})


def test_fog_goes_and_held_out_photos_gain() -> None:
    done = clean(foggy(), scene(), steps=200)
    assert done.gain > 1.0
    assert done.pays
    assert done.removed + len(done.gaussians) == len(foggy())
    left = done.gaussians.means[:, 2] < 2
    faded = done.gaussians.activated_opacities()[left].sum()
    assert float(faded) < 0.5 * float(foggy().activated_opacities()[-FOG:].sum())
    again = clean(foggy(), scene(), steps=200)
    assert torch.equal(again.gaussians.opacities, done.gaussians.opacities)


def test_a_foreign_file_is_cleaned_in_its_own_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It says nothing of the frame in which the photos' scene is held, and it is antialiased."""
    world = World(0.25, (3.0, 0.0, -2.0))
    held = foggy().like(foggy().named())
    held.world, held.antialiased = world, True
    foreign = held.in_world(World())
    foreign.save(tmp_path / "foreign.spz")
    monkeypatch.setattr(scene_source, "embedded_scene", lambda *_: replace(scene(), world=world))
    out, options = tmp_path / "clean.glb", ["--photos", "embedded", "--steps", "200"]
    assert main(["clean", str(tmp_path / "foreign.spz"), "--out", str(out), *options]) == 0
    assert "left out: the antialias flag: a .glb file cannot store it" in capsys.readouterr().out
    found = Gaussians.load(out)
    assert found.world.ordinary
    read = Gaussians.load(tmp_path / "foreign.spz").means
    assert float((found.means[:, None] - read).abs().amax(2).amin(1).max()) < 1e-5


def test_a_gain_must_exceed_its_scatter() -> None:
    def done(*gains: float) -> Cleaned:
        return Cleaned(foggy(), 0, (20.0,) * len(gains), tuple(20.0 + gain for gain in gains))

    assert done(0.5, 0.6, 0.4).pays
    assert not done(2.0, -1.5, 0.1).pays
    assert not done(1.0).pays  # one photo tells no scatter
    assert not done(-0.2, -0.3).pays
    masked = Cleaned(foggy(), 0, (20.0, None, 21.0, 20.0), (20.5, 30.0, None, 20.6))
    assert masked.pairs == [(20.0, 20.5), (20.0, 20.6)]
    assert masked.gain == pytest.approx(0.55)
    nothing = Cleaned(foggy(), 0, (None, None), (None, 20.0))
    assert (nothing.gain, nothing.pays) == (0.0, False)


def test_an_opacity_of_nothing_spoils_no_step() -> None:
    """Other programs write it as a logit of -400, whose sigmoid has no logarithm."""
    named = {name: tensor.clone() for name, tensor in foggy().named().items()}
    named["opacities"][0] = -400.0
    done = clean(foggy().like(named), scene(), steps=200)
    assert done.pays
    assert len(done.gaussians) > len(foggy()) // 2


def test_a_scene_in_another_frame_is_refused() -> None:
    moved = foggy().like(foggy().named() | {"means": foggy().means + 100.0})
    with pytest.raises(ValueError, match="6 of 6 renders have a larger error than a picture of one colour"):
        clean(moved, scene(), steps=1)


def test_nothing_is_written_where_the_file_does_not_gain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a run: on its own photos, before its own background; a lossy file counts as it is read."""
    foggy().save(tmp_path / "scene.ply")
    (tmp_path / "config.json").write_text('{"train": {"background": [1.0, 0.5, 0.0]}}')
    monkeypatch.setattr(RunFolder, "photos", lambda *_: scene())
    asked, gains = [], [-1.0, 0.5]

    def cleaned(gaussians: Gaussians, _: Scene, *rest: object) -> Cleaned:
        asked.append(rest[:2])
        gain = gains[len(asked) - 1]
        return Cleaned(gaussians, 0, (80.0, 80.0), (80.0 + gain, 80.0 + gain))

    monkeypatch.setattr(cleaning, "clean", cleaned)
    for name, words in (
        ("new.ply", "do not improve; nothing"),
        ("new.splat", "do not improve as a .splat file"),
    ):
        assert main(["clean", str(tmp_path), "--out", str(tmp_path / name), "--steps", "9"]) == 1
        said = capsys.readouterr().err
        assert words in said
        assert "nothing was written: 80.00 -> " in said
        assert not (tmp_path / name).exists()
    assert asked == [(9, (1.0, 0.5, 0.0))] * 2
    assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler


def test_a_run_that_corrects_its_photos_is_not_fitted_to_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scene_source, "embedded_scene", lambda *_: scene())
    hqgs.train(hqgs.load("embedded"), out=tmp_path, iterations=2, method="hqgs", formation="blur:1")
    assert main(["clean", str(tmp_path), "--out", str(tmp_path / "new.ply"), "--steps", "1"]) == 2
    assert "is a run that corrects its photos (blur:1)" in capsys.readouterr().err


def test_bad_input_is_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for count in (0, 1):
        with pytest.raises(ValueError, match=f"tiny has {count} held-out photos, wanted at least 2"):
            clean(foggy(), replace(scene(), test=scene().test[:count]))
    hidden = replace(scene().test[1], mask=np.zeros(scene().test[1].image.shape[:2], bool))
    with pytest.raises(ValueError, match="tiny has 1 held-out photos, wanted at least 2"):
        clean(foggy(), replace(scene(), test=[scene().test[0], hidden]))
    with pytest.raises(ValueError, match="steps is 0, wanted at least 1"):
        clean(foggy(), scene(), steps=0)
    file = tmp_path / "scene.ply"
    (tmp_path / "folder.ply").mkdir()
    foggy().save(file)
    for options, message in (
        ([str(file), "--out", str(file), "--photos", "embedded"], "what is left out would be lost"),
        ([str(file), "--out", str(tmp_path / "new.obj"), "--photos", "embedded"], "new.obj"),
        ([str(tmp_path / "no.ply"), "--out", str(tmp_path / "new.ply")], "no.ply"),
        (
            [str(file), "--out", str(tmp_path / "folder.ply"), "--photos", "embedded"],
            "folder.ply is a folder",
        ),
    ):
        assert main(["clean", *options]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "new.ply").exists()
