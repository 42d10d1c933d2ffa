"""Evaluations while a run trains: on how many held-out views, what is said of it, and what they keep."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from run_state import run_until
from tiny_scene import tiny_config, tiny_scene

from hqgs.evaluation import held_out
from hqgs.evaluation.held_out import held_out_means, held_out_renders
from hqgs.evaluation.metrics import psnr
from hqgs.evaluation.records import alike
from hqgs.pipeline import train
from hqgs.scene.scene import Scene, View
from hqgs.training.schedule import on_the_way
from hqgs.training.trainer import Trainer


def scene_of(train_views: int, test_views: int) -> Scene:
    whole = tiny_scene(train_views + 1)
    names = [f"held{k}.png" for k in range(test_views)]
    test = [replace(whole.train[k % train_views], name=name) for k, name in enumerate(names)]
    return replace(whole, test=test)


@pytest.mark.parametrize(
    ("every", "test", "wanted"),
    [
        (100, 5, [0, 1, 2, 3, 4]),
        (100, 10, list(range(10))),
        (100, 20, [1, 3, 5, 7, 9, 11, 13, 15, 17, 19]),
        (20, 16, [4, 12]),
        (3, 16, [8]),
        (3, 0, []),
    ],
)
def test_a_tenth_of_the_trained_pixels(every: int, test: int, wanted: list[int]) -> None:
    assert on_the_way(scene_of(4, test), every) == wanted


def test_larger_held_out_views_are_fewer() -> None:
    scene = scene_of(4, 20)
    small = replace(scene, train=[_halved(scene, k) for k in range(4)])
    assert len(on_the_way(small, 100)) == 2  # each has four times the pixels of a training view


def _halved(scene: Scene, k: int) -> View:
    view = scene.train[k]
    camera = replace(view.camera, width=view.camera.width // 2, height=view.camera.height // 2)
    return replace(view, camera=camera, image=np.ascontiguousarray(view.image[::2, ::2]))


def test_all_views_at_the_end_and_some_before(tmp_path: Path) -> None:
    scene = scene_of(4, 6)
    run = train(scene, config=tiny_config(30, eval_every=10), out=tmp_path)
    assert [entry.get("views") for entry in run.history] == [1, 1, None]
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["history"] == run.history
    assert report["history"][-1]["psnr"] == pytest.approx(report["metrics"]["mean"]["psnr"], abs=1e-9)
    assert any("1 of 6 held-out views were measured" in note for note in report["notes"])
    page = (tmp_path / "report.html").read_text()
    assert "Measured on 1 of the 6 held-out photos, the last point on all of them." in page
    assert [len(part) for part in alike(run.history)] == [2, 1]


def test_a_run_with_few_views_measures_all_of_them(tmp_path: Path) -> None:
    run = train(scene_of(4, 1), config=tiny_config(30, eval_every=10), out=tmp_path)
    assert ["views" in entry for entry in run.history] == [False] * 3
    assert "Measured on" not in (tmp_path / "report.html").read_text().split("During training")[1][:200]
    assert not any("held-out views were measured" in note for note in run.report["notes"])


def test_stopped_where_some_were_measured() -> None:
    """The entry of the same iteration gives way to one of all views."""
    trainer = run_until(Trainer(scene_of(4, 6), tiny_config(30, eval_every=10)), 10)
    trainer.evaluate()
    assert trainer.history[-1].get("views") == 1
    trainer.evaluate(trainer.held_out())
    (entry,) = trainer.history
    assert "views" not in entry
    assert entry["psnr"] == held_out_means([psnr], trainer.held_out())[0]
    trainer.evaluate()
    assert trainer.history == [entry]


def test_few_renders_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(4, 6)
    trainer = Trainer(scene, tiny_config())
    calls: list[int] = []
    real: Callable[..., Any] = held_out.render_view

    def counted(*arguments: Any) -> Any:
        calls.append(1)
        return real(*arguments)

    monkeypatch.setattr(held_out, "render_view", counted)
    views = held_out_renders(scene, trainer.shown())
    assert views.names == [f"held{k}.png" for k in range(6)]
    assert calls == []
    first = [view.render for view in views]
    assert all(view.render is render for view, render in zip(views, first, strict=True))
    assert len(calls) == 6  # the second time they were kept
    size = first[0].nbytes
    monkeypatch.setattr(held_out, "KEPT_BYTES", 2 * size)
    tight = held_out_renders(scene, trainer.shown())
    for _ in range(2):
        for k, view in enumerate(tight):
            np.testing.assert_array_equal(view.render, first[k])
    assert len(calls) == 6 + 12
    assert sum(view.render.nbytes for view in tight._kept.values()) == 2 * size  # pyright: ignore[reportPrivateUsage]
