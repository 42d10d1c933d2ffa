"""report.html and what a notebook shows: what they say, and that names from files stay text."""

from __future__ import annotations

import base64
import gzip
import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from test_ply import random_gaussians
from tiny_scene import HEIGHT, WIDTH, tiny_config, tiny_scene

import hqgs
from hqgs.show.page.packing import pack_scene
from hqgs.show.page.page import _scene, line_chart, page_text, told_verdict


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> hqgs.Run:
    return hqgs.train(tiny_scene(), out=tmp_path_factory.mktemp("run"), config=tiny_config())


def page_of(run: hqgs.Run, **changes: Any) -> str:
    shown: dict[str, Any] = {
        "report": run.report,
        "scene": tiny_scene(),
        "gaussians": run.model,
        "views": run.views,
    }
    return page_text(**(shown | changes))


def test_a_run_has_its_page(run: hqgs.Run) -> None:
    assert run.out is not None
    text = (run.out / "report.html").read_text(encoding="utf-8")
    mean = run.report["metrics"]["mean"]["psnr"]
    assert f"{mean:.2f} dB" in text
    assert f"Measured on 1 held-out photo: {mean:.1f} dB PSNR." in text
    assert text.count("<svg") == 4
    assert text.count("<circle") == 4 * len(run.history)
    assert text.count("data:image/jpeg;base64,") == 2 * len(run.views)
    assert '"max_gaussians": ' in text.replace("&#34;", '"')
    assert "does not measure them" in text  # 3dgs diagnoses nothing


def test_nothing_is_loaded_from_elsewhere(run: hqgs.Run) -> None:
    text = page_of(run)
    assert "default-src 'none'" in text
    without_data = re.sub(r'"data:[^"]*"', '""', text)
    assert not re.search(r'(src|href)\s*=\s*"[^"]', without_data)
    assert "http" not in re.sub(r"http-equiv", "", without_data)


def test_names_from_files_are_text(run: hqgs.Run) -> None:
    rude = '</script><script>alert(1)</script><img src=x onerror="a()">'
    scene = tiny_scene()
    scene = replace(scene, test=[replace(scene.test[0], name=rude)])
    report: Any = dict(run.report) | {
        "scene": rude,
        "notes": [rude],
        "left_out": [{"what": rude, "why": rude}],
    }
    text = page_of(run, scene=scene, report=report, views=[replace(run.views[0], name=rude)])
    assert "alert(1)" in text
    assert "<script>alert" not in text
    assert "<img src=x" not in text
    assert text.count("</script>") == page_of(run).count("</script>")


def test_a_page_without_scene_views_or_history(run: hqgs.Run) -> None:
    report: Any = dict(run.report)
    report["history"] = []
    report["metrics"] = {"mean": dict.fromkeys(run.report["metrics"]["mean"]), "views": [], "reasons": {}}
    text = page_of(run, report=report, gaussians=None, views=[])
    assert "<canvas" not in text
    assert text.count("not measured while it trained") == 4
    assert told_verdict(report) == "Quality: not measured. No photo was held out: look at the renders."
    mean = {**run.report["metrics"]["mean"], "psnr": None}
    reasons = {"psnr": "1 of 3 views: the mask hides every pixel"}
    report["metrics"] = {**run.report["metrics"], "mean": mean, "reasons": reasons}
    assert told_verdict(report) == "Quality: not measured. PSNR: 1 of 3 views: the mask hides every pixel."


def test_the_diagnosis_is_told(run: hqgs.Run) -> None:
    scene = tiny_scene()
    diagnosis = hqgs.diagnose(scene)
    text = page_of(run, diagnosis=diagnosis)
    for part in diagnosis.parts:
        assert part.reason in text
    assert "Each of the 5 measured photos" in text


def test_what_was_learned_of_the_cameras_is_told(run: hqgs.Run) -> None:
    assert "What was learned" not in page_of(run)
    way = [[0.5 * k, 0.0] for k in range(-4, 5)]
    learned = [
        {
            "name": "a<b>.png",
            "shake_px": 4.0,
            "defocus_px": 0.0,
            "focus": None,
            "trajectory_px": way,
            "gains": [2.0, 2.0, 0.5],
        },
        {
            "name": "c.png",
            "shake_px": 0.0,
            "defocus_px": 1.5,
            "focus": 2.0,
            "trajectory_px": [[0.0, 0.0]] * 9,
            "gains": [1.0, 1.0, 1.0],
            "response": [[0.1, 0.0, 0.0], [0.0, 0.0, 0.0]],
        },
    ]
    report: Any = {**run.report, "learned": learned}
    text = page_of(run, report=report)
    cells = "".join(
        f"<td>{cell}</td>"
        for cell in ("a&lt;b&gt;.png", "4.0 px", "sharp", "+0.33", "+0.67", "+0.67", "-1.33")
    )
    assert cells + "<td></td></tr>" in text
    assert "<th>B</th><th>response curve</th></tr>" in text
    assert "<td>slope up to 10% off the mean</td></tr>" in text
    assert "<td>c.png</td><td>still</td><td>1.5 px, sharp at 2 of the median depth</td><td>+0.00</td>" in text
    assert text.count("data:image/jpeg;base64,") == 2 * len(run.views)


@pytest.mark.parametrize(("psnr", "word"), [(31, "very good"), (26, "good"), (21, "fair"), (9, "poor")])
def test_the_verdict_goes_by_the_held_out_photos(run: hqgs.Run, psnr: float, word: str) -> None:
    mean = {**run.report["metrics"]["mean"], "psnr": psnr}
    report: Any = {**run.report, "metrics": {**run.report["metrics"], "mean": mean}}
    assert told_verdict(report).startswith(f"Quality: {word}. ")
    assert told_verdict(report).endswith(f" Measured on 1 held-out photo: {psnr:.1f} dB PSNR.")


def test_packed_values_are_near(run: hqgs.Run) -> None:
    """Read by the layout that packing.py states."""
    g = random_gaussians(1000, 3)
    g.opacities[:] = 2.0
    g.shN[:] = torch.randn(40, 15, 3)[torch.arange(1000) % 40] + 0.01 * torch.randn(1000, 15, 3)  # 40 kinds
    (head, packed), n = pack_scene(g), 1000
    assert (head["count"], head["degree"]) == (n, 3)
    data, sets = gzip.decompress(base64.b64decode(packed)), head["sets"]
    assert 125 < sets <= n  # few Gaussians: nearly each has its own
    assert len(data) == n * (6 + 3 + 4 + 1 + 3 + 2) + 45 * sets
    fine, coarse = np.frombuffer(data[: 6 * n], np.uint8).reshape(2, 3, n).astype(int)
    low, high = np.array(head["low"]), np.array(head["high"])
    logs = low + (high - low) * (fine + 256 * coarse).T / 65535
    means = np.sign(logs) * np.expm1(np.abs(logs))
    order = ((means[:, None] - g.means.numpy()[None]) ** 2).sum(2).argmin(1)  # the file has another order
    assert len(set(order)) == n
    steps = (high - low) / 65535 * (1 + np.abs(means))
    assert (np.abs(means - g.means.numpy()[order]) < steps).all()
    logs = np.frombuffer(data[6 * n : 9 * n], np.uint8).reshape(3, n).T
    span = head["scales"][1] - head["scales"][0]
    away = np.abs(head["scales"][0] + span * logs / 255 - g.scales.numpy()[order])
    assert 0 < away.max() <= span / 510 + 1e-6
    labels = np.frombuffer(data[17 * n : 19 * n], "<u2")
    sh = np.frombuffer(data[19 * n :], np.int8).reshape(45, sets).T.reshape(sets, 15, 3)[labels] / 127
    tops = np.repeat(head["tops"], [3, 5, 7])[:, None]
    rest = g.shN.numpy()[order]
    assert np.square(tops * sh - rest).mean() < 0.1 * np.square(rest).mean()


def test_50000_gaussians_take_less_than_3_mb() -> None:
    head, packed = pack_scene(random_gaussians(50_000, 3))  # noise, which packs worst
    assert head["degree"] == 3
    assert len(packed) < 3e6


def test_large_and_broken_scenes() -> None:
    g = random_gaussians(3000, 3)
    g.opacities[:] = 0.0
    g.means[5] = torch.nan
    g.scales[:100] += 9  # the largest show most
    head, _ = pack_scene(g, most=120)
    assert head["count"] == 120
    assert head["scales"][1] == pytest.approx(float(g.scales[:100].max()))
    assert pack_scene(random_gaussians(4, 0))[0]["degree"] == 0
    g.opacities[:] = -20
    assert pack_scene(g)[0]["count"] == 0


def test_charts() -> None:
    chart = str(line_chart("A <b>", "dB", [[(1, 10), (2, 20)], [(4, 15)]], "#000"))
    assert "A &lt;b&gt;" in chart
    x = [float(v) for v in re.findall(r'<circle cx="([\d.]+)"', chart)]
    y = [float(v) for v in re.findall(r'cy="([\d.]+)"', chart)]
    assert x[2] - x[1] == pytest.approx(2 * (x[1] - x[0]), abs=0.2)
    assert (y[0] - y[1]) == pytest.approx(2 * (y[0] - y[2]), abs=0.2)
    lines = re.findall(r'<polyline points="([^"]*)"', chart)
    assert [len(line.split()) for line in lines] == [2, 1]  # no line leads to what was measured otherwise
    assert "nan" not in str(line_chart("one", "", [[(0, 5)]], "#000"))


# --- What a notebook shows of a scene, a render and a run


def shown(model: hqgs.Gaussians) -> np.ndarray:
    data = model._repr_png_()
    assert data is not None
    return np.asarray(Image.open(io.BytesIO(data)))


def test_a_scene_shows_itself_from_a_camera_of_its_run(tmp_path: Path) -> None:
    scene = tiny_scene()
    run = hqgs.train(scene, out=tmp_path, config=tiny_config())
    expected = np.asarray(hqgs.picture(run.model.render(scene.test[0].camera)))
    assert expected.std() > 5
    for model in (run.model, hqgs.Gaussians.load(tmp_path), hqgs.Gaussians.load(tmp_path / "scene.ply")):
        assert np.array_equal(shown(model), expected)
    html = run._repr_html_()
    assert html.count("data:image/jpeg;base64,") == 2
    assert "30 iterations" in html


def test_photos_on_their_side_are_shown_upright(run: hqgs.Run) -> None:
    """In a notebook, and by the page's viewer, as cameras.json and the pictures beside are."""
    made = tiny_scene()
    train, test = ([replace(view, quarter_turns=1) for view in views] for views in (made.train, made.test))
    scene = replace(made, train=train, test=test)
    shown = _scene(scene, run.model, [0, 0, 0])
    assert shown["aspect"] == f"{HEIGHT} / {WIDTH}"
    assert np.dot(shown["up"], shown["views"][0]["R"][1]) < -0.9  # the picture's y is down
    look, upright = hqgs.train(scene, config=tiny_config(2)).model.look, test[0].upright_camera
    assert look is not None
    assert np.array_equal(look.viewmat, upright.viewmat)
    assert (look.width, look.height) == (HEIGHT, WIDTH)


def test_a_bare_scene_shows_itself_whole(tmp_path: Path) -> None:
    g = random_gaussians(200, 0)
    g.scales[:], g.sh0[:], g.opacities[:] = -2.0, 1.0, 2.0
    g.save(tmp_path / "other.ply")
    model = hqgs.Gaussians.load(tmp_path / "other.ply")
    assert model.look is None
    picture = shown(model)
    assert picture.shape == (378, 504, 3)
    assert picture[120:260, 170:330].mean() > picture[:40, :40].mean() + 10
    assert random_gaussians(0, 0)._repr_png_() is None


def test_a_scene_beside_damaged_cameras_loads_and_shows_itself_whole(tmp_path: Path) -> None:
    random_gaussians(20, 0).save(tmp_path / "scene.ply")
    (tmp_path / "cameras.json").write_text("{")
    model = hqgs.Gaussians.load(tmp_path / "scene.ply")
    assert (len(model), model.look) == (20, None)
    assert shown(model).shape == (378, 504, 3)


def test_pictures() -> None:
    image = torch.tensor([[[-1.0, 0.5, 2.0]]])
    assert hqgs.picture(image).getpixel((0, 0)) == (0, 128, 255)
    assert hqgs.picture(np.full((2, 3, 3), 7, np.uint8)).size == (3, 2)
    with pytest.raises(ValueError, match=r"image has shape \[3, 2\], wanted \[H, W, 3\]"):
        hqgs.picture(torch.zeros(3, 2))
