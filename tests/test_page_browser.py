"""report.html in a browser: the scene looks as the rasterizer renders it, and the page does what it says."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import chromium, wait
from PIL import Image
from tiny_scene import tiny_scene

import hqgs
from hqgs.scene.paths import with_size
from hqgs.scene.scene import Scene
from hqgs.show.page.page import page_text

SIZE = (120, 80)
BEHIND = (0.1, 0.5, 0.8)


@pytest.fixture(scope="module")
def trained() -> tuple[hqgs.Run, Scene]:
    scene = tiny_scene()
    config = hqgs.TrainConfig(iterations=300, method="3dgs", leave_out=(), background=BEHIND)
    run = hqgs.train(scene, config=config)
    model = run.model
    rng = torch.Generator().manual_seed(1)
    kinds = 0.15 * torch.randn((5, *model.shN.shape[1:]), generator=rng)  # so that every harmonic matters
    model.shN[:] = kinds[torch.arange(len(model)) % 5]
    return run, scene


def test_the_page(trained: tuple[hqgs.Run, Scene], tmp_path: Path) -> None:
    run, scene = trained
    assert run.model.sh_degree == 3
    page = tmp_path / "report.html"
    page.write_text(page_text(run.report, scene, run.model, run.views), encoding="utf-8")
    asked: list[str] = []
    with chromium() as (page, wrong):
        page.on("request", lambda r: asked.append(r.url))
        page.goto(f"file://{tmp_path / 'report.html'}")
        wait(page, "window.viewer && viewer.settled")
        page.evaluate(f"viewer.size = [{SIZE[0]}, {SIZE[1]}]; viewer.dirty = true")
        for number, view in enumerate([*scene.test, *scene.train][:3]):
            page.evaluate(f"viewer.go({number})")
            wait(page, "viewer.settled")
            url = page.evaluate("viewer.canvas.toDataURL('image/png')")
            shown = np.asarray(
                Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB"), float
            )
            camera = with_size(view.camera, *SIZE)
            with torch.no_grad():
                ours = 255 * run.model.render(camera, background=BEHIND).clamp(0, 1).numpy()
            assert shown.shape == ours.shape
            assert ours.std() > 20
            error = float(np.mean((shown - ours) ** 2))
            assert 10 * math.log10(255**2 / error) > 35, view.name
        # The buttons and the mouse move the camera.
        page.click("#after")
        assert page.inner_text("#view") == page.evaluate("viewer.views[3].name")
        before = page.evaluate("viewer.eye")
        page.evaluate("viewer.size = null")
        page.locator("#scene").scroll_into_view_if_needed()
        box = page.locator("#scene").bounding_box()
        before = page.evaluate("viewer.eye")
        page.mouse.move(box["x"] + 200, box["y"] + 100)
        page.mouse.down()
        page.mouse.move(box["x"] + 300, box["y"] + 140, steps=4)
        page.mouse.up()
        assert math.dist(before, page.evaluate("viewer.eye")) > 0.05
        R = np.array(page.evaluate("viewer.R"))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(R) > 0
        # The slider uncovers the render.
        pair = page.locator(".pair").first
        pair.scroll_into_view_if_needed()
        box = pair.bounding_box()
        cuts = []
        for part in (0.1, 0.9):
            page.mouse.move(box["x"] + part * box["width"], box["y"] + 0.5 * box["height"])
            cuts.append(
                (
                    page.evaluate(
                        "getComputedStyle(document.querySelector('.pair')).getPropertyValue('--cut')"
                    ),
                    pair.screenshot(),
                )
            )
        assert float(cuts[0][0].rstrip("%")) == pytest.approx(10, abs=1)
        assert float(cuts[1][0].rstrip("%")) == pytest.approx(90, abs=1)
        assert cuts[0][1] != cuts[1][1]
        assert wrong == []
    assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []


def test_a_browser_without_webgl_is_told(trained: tuple[hqgs.Run, Scene], tmp_path: Path) -> None:
    run, scene = trained
    page = tmp_path / "report.html"
    page.write_text(page_text(run.report, replace(scene, name="x"), run.model, run.views), encoding="utf-8")
    with chromium() as (page, _):
        page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
        page.goto(f"file://{tmp_path / 'report.html'}")
        wait(page, "document.getElementById('note').textContent.startsWith('The scene cannot be shown here')")
