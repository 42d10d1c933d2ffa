"""`hqgs judge`: our own runs bit for bit, scenes of others, what errors come from, and what is refused."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fixtures_scenes import make_truth, photographed, write_colmap
from PIL import Image
from scipy.ndimage import gaussian_filter
from tiny_scene import tiny_config, tiny_scene

import hqgs
from hqgs._rust import EPS2D
from hqgs.cli.main import main
from hqgs.evaluation import held_out
from hqgs.evaluation.causes import PARTS, causes, pixel_maps, shares, shown_by
from hqgs.evaluation.constants import CONFIDENCE
from hqgs.evaluation.held_out import RenderedView
from hqgs.evaluation.judge import VERSION, flat_psnr
from hqgs.evaluation.metrics import METRICS
from hqgs.evaluation.verdict import judged_by, overdone, verdict
from hqgs.model.gaussians import Gaussians
from hqgs.photos.look import Look
from hqgs.scene import source as scene_source
from hqgs.scene.geometry import median_depth
from hqgs.scene.scene import Camera, Scene

SIZE = 64


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a scene with three held-out photos, one of them masked."""
    out = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_source, "embedded_scene", lambda *_: held_out_scene())
        scene = hqgs.load("embedded")
        hqgs.train(scene, out=out, config=tiny_config(40))
    return out


def held_out_scene() -> Scene:
    made = tiny_scene(9, 60)
    views = [*made.test, *made.train]
    mask = np.ones(views[1].image.shape[:2], bool)
    mask[:, :5] = False
    return replace(made, train=views[3:], test=[views[0], replace(views[1], mask=mask), views[2]])


@pytest.fixture(autouse=True)
def photos_of_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_source, "embedded_scene", lambda *_: held_out_scene())


def judge(*arguments: object) -> int:
    try:
        return main(["judge", *map(str, arguments)])
    except SystemExit as end:  # the parser's own mistakes
        return int(end.code or 0)


def test_our_own_runs_bit_for_bit(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = json.loads((run / "report.json").read_text())
    assert judge(run, "--out", tmp_path) == 0
    told = capsys.readouterr().out
    assert judge(run / "scene.ply", "--photos", "embedded", "--out", tmp_path / "file") == 0
    found = [json.loads((tmp_path / name / "judge.json").read_text())["scene"] for name in ("", "file")]
    for one in found:
        assert one["mean"] == report["metrics"]["mean"]
        assert one["interval"] == report["metrics"]["interval"]
        for view in report["metrics"]["views"]:
            known = {metric: view[metric] for metric in METRICS}
            assert {metric: one["views"][view["name"]][metric] for metric in METRICS} == known
    sure = f"{found[0]['mean']['psnr']:.2f} ± {found[0]['interval']['psnr']:.2f}"
    assert f"{sure} dB" in (run / "report.html").read_text()
    assert sure in told
    assert "masked pixels of 1 photo do not count" in " ".join(told.split())
    assert found[0]["gaussians"] == report["gaussians"]
    assert found[0]["bytes"] == report["scene_bytes"]
    for view in found[0]["views"].values():
        parts = sum(view["causes"][part] for part in PARTS)
        assert parts == pytest.approx(view["causes"]["mse"], rel=1e-9)
    assert sum(found[0]["causes"].values()) == pytest.approx(1)


def test_two_scenes_are_compared_photo_by_photo(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    worse = Gaussians.load(run)
    (tmp_path / "other").mkdir()
    replace(worse, sh0=worse.sh0 * 0.8).save(tmp_path / "other" / "scene.ply")
    assert judge(run, "--against", tmp_path / "other" / "scene.ply", "--out", tmp_path / "named") == 0
    assert f"| against {tmp_path / 'other' / 'scene.ply'} " in capsys.readouterr().out  # both are scene.ply
    replace(worse, sh0=worse.sh0 * 0.9).save(tmp_path / "worse.spz")
    assert judge(run, "--against", tmp_path / "worse.spz", "--out", tmp_path / "both") == 0
    told = capsys.readouterr().out
    assert "(better)" in told
    found = json.loads((tmp_path / "both" / "judge.json").read_text())
    apart = [
        found["scene"]["views"][name]["psnr"] - found["against"]["views"][name]["psnr"]
        for name in found["protocol"]["names"]
    ]
    assert found["difference"]["psnr"]["mean"] == pytest.approx(np.mean(apart))
    assert found["difference"]["psnr"]["sure"]
    assert judge(run, "--out", tmp_path / "one") == 0
    assert judge(run, "--against", tmp_path / "one" / "judge.json", "--out", tmp_path / "same") == 0
    same = json.loads((tmp_path / "same" / "judge.json").read_text())["difference"]
    assert same["psnr"] == {"mean": 0.0, "interval": 0.0, "sure": False}
    assert "(not significant)" in capsys.readouterr().out


def test_both_scenes_are_measured_in_the_look_of_the_run(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = Look(np.full(3, 0.8), np.zeros(2), np.zeros((2, 3)))
    monkeypatch.setattr(
        held_out, "looks_beside", lambda file, _: {"": look} if file.parent == run else dict[str, Look]()
    )
    shutil.copy(run / "scene.ply", tmp_path / "same.ply")
    photos = ["--photos", "embedded"]
    assert judge(tmp_path / "same.ply", *photos, "--against", run, "--out", tmp_path / "both") == 0
    found = json.loads((tmp_path / "both" / "judge.json").read_text())
    assert found["protocol"]["looks"] is True
    assert found["difference"]["psnr"]["mean"] == 0
    assert judge(tmp_path / "same.ply", *photos, "--out", tmp_path / "bare") == 0
    assert judge(run, "--against", tmp_path / "bare" / "judge.json") == 2


def test_a_bright_photo_of_many_pixels_is_flat_to_all_digits() -> None:
    view, rng = tiny_scene().test[0], np.random.default_rng(0)
    values = rng.integers(240, 252, (1500, 1000, 3)).astype(np.uint8)
    wanted = -10 * np.log10((values / 255.0).reshape(-1, 3).var(0).mean())
    assert flat_psnr(replace(view, image=values)) == pytest.approx(wanted, abs=1e-3)


def with_wrong_poses() -> Scene:
    """Held-out cameras that are two pixels off."""
    scene = held_out_scene()
    moved = []
    for view in scene.test:
        viewmat = view.camera.viewmat.copy()
        viewmat[0, 3] += 2 * median_depth(scene, view) / view.camera.K[0, 0]
        moved.append(replace(view, camera=replace(view.camera, viewmat=viewmat)))
    return replace(scene, test=moved)


def test_what_poses_cost_is_set_aside(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_source, "embedded_scene", lambda *_: with_wrong_poses())
    assert judge(run, "--fit-cameras", "--out", tmp_path) == 0
    assert "poses refined" in capsys.readouterr().out
    one = json.loads((tmp_path / "judge.json").read_text())["scene"]
    assert one["fitted"]["mean"]["psnr"] > one["mean"]["psnr"]
    assert one["causes"]["pose"] > 0
    assert sum(one["causes"].values()) == pytest.approx(1)
    assert all(view["moved_px"] >= 0 for view in one["fitted"]["views"].values())


def test_the_page_is_one_file(run: Path, tmp_path: Path) -> None:
    assert judge(run, "--against", run / "scene.ply", "--out", tmp_path) == 0
    page = (tmp_path / "judge.html").read_text()
    assert len(page) < 100_000
    assert re.findall(r'(?:src|href)="(?!data:)', page) == []
    assert page.count('type="range"') == 3
    assert page.count('class="map"') == 6
    for word in ("Causes of the error", "How it was measured", "held out", "Student"):
        assert word in page


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"names": ["a.png"]}, "the photos differ, 3 here and 1 there"),
        ({"sizes": [[24, 16], [9, 9], [24, 16]]}, "the sizes of the photos differ, [24, 16] here and [9, 9]"),
        ({"pixels": "0"}, "the photos' pixels or masks (their digest) differ"),
        ({"background": [1.0, 1.0, 1.0]}, "the backgrounds differ, 0.0 here and 1.0 there"),
        ({"version": 0}, "the measuring rules differ, 1 here and 0 there"),
    ],
)
def test_what_cannot_be_compared_is_refused_by_name(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict[str, Any], words: str
) -> None:
    assert judge(run, "--out", tmp_path) == 0
    known = json.loads((tmp_path / "judge.json").read_text())
    known["protocol"] |= change
    (tmp_path / "other.json").write_text(json.dumps(known))
    capsys.readouterr()
    assert judge(run, "--against", tmp_path / "other.json") == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1


def test_other_words_for_the_same_rules_are_compared(run: Path, tmp_path: Path) -> None:
    """As in a judge.json of before, which has no version; the version stands for these numbers."""
    assert (1, pytest.approx(0.3), 0.9) == (VERSION, EPS2D, CONFIDENCE)
    assert judge(run, "--out", tmp_path) == 0
    known = json.loads((tmp_path / "judge.json").read_text())
    known["protocol"]["rules"]["psnr"] = "said otherwise"
    del known["protocol"]["version"]
    (tmp_path / "older.json").write_text(json.dumps(known))
    assert judge(run, "--against", tmp_path / "older.json") == 0


def test_mistakes_get_a_sentence(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "no.json").write_text("{}")
    (tmp_path / "bare").mkdir()
    (tmp_path / "foreign.ply").write_bytes((run / "scene.ply").read_bytes())
    away = Gaussians.load(run)
    replace(away, means=away.means - 1000.0).save(tmp_path / "away.ply")
    truth = make_truth(4)
    for k, photo in enumerate(truth.photos):
        Image.fromarray(photo).save(tmp_path / "bare" / f"{k}.png")
    foreign, photos = tmp_path / "foreign.ply", ["--photos", "embedded"]
    cases = [
        ([tmp_path / "missing.ply", *photos], "there is no"),
        ([foreign], "is not the folder of a run: give --photos, a folder of photos"),
        ([foreign, "--photos", tmp_path / "nowhere"], "there is no scene folder"),
        ([foreign, "--photos", tmp_path / "bare"], "has no cameras"),
        ([foreign, *photos, "--views", "x.png"], "has no photo 'x.png'"),
        ([foreign, *photos, "--against", tmp_path / "no.json"], "is not a judge.json"),
        ([tmp_path / "away.ply", *photos], "none of its"),
        ([run, "--test-every", "4"], "--downscale and --test-every need --photos"),
        ([], "missing: SOURCE"),
    ]
    for arguments, words in cases:
        assert judge(*arguments) == 2, arguments
        told = capsys.readouterr().err
        assert words in told, told
        assert told.splitlines()[-1].startswith("hqgs: ")


def test_a_foreign_file_and_a_folder_with_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, model = photographed(make_truth(9))
    root = write_colmap(truth, tmp_path / "scene", binary=False)
    model.save(tmp_path / "foreign.ply")
    found = {}
    for which in ("test", "train", "all"):
        out = tmp_path / which
        assert judge(tmp_path / "foreign.ply", "--photos", root, "--views", which, "--out", out) == 0
        found[which] = json.loads((out / "judge.json").read_text())
        assert found[which]["scene"]["mean"]["psnr"] > 45  # 8 bits alone are between
    names = [found[which]["protocol"]["names"] for which in ("train", "test", "all")]
    assert sorted(names[0] + names[1]) == names[2]
    one = found["test"]["protocol"]["names"][0]
    assert judge(tmp_path / "foreign.ply", "--photos", root, "--views", one, "--out", tmp_path / "one") == 0
    single = json.loads((tmp_path / "one" / "judge.json").read_text())
    assert single["protocol"]["names"] == [one]
    assert single["scene"]["interval"]["psnr"] is None
    words = "have a larger error than a picture of one colour: the scene file and the cameras are of"
    assert words not in capsys.readouterr().out
    replace(model, means=model.means[:, [2, 0, 1]]).save(tmp_path / "turned.ply")
    assert judge(tmp_path / "turned.ply", "--photos", root, "--out", tmp_path / "turned") == 0
    assert words in capsys.readouterr().out
    assert "than a picture of one colour" in (tmp_path / "turned" / "judge.html").read_text()


def picture(seed: int = 0) -> np.ndarray:
    """Fine and broad structure."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    broad = np.stack([0.4 + 0.2 * np.sin(3 * x + k) * np.cos(2 * y) for k in range(3)], -1)
    return broad + rng.uniform(-0.1, 0.1, (SIZE, SIZE, 1))


def sorted_error(
    render: np.ndarray, fog: float = 0.0, photos: float = 9.0, noise: float = 0.0
) -> dict[str, float]:
    photo = picture().astype(np.float32)
    maps = np.full((SIZE, SIZE), fog), np.full((SIZE, SIZE), photos)
    return shares([causes(RenderedView("a", photo, render.astype(np.float32)), maps, noise)])


def test_errors_go_to_their_causes() -> None:
    photo = picture()
    broad = photo + 0.1 * np.sin(np.linspace(0, 6, SIZE))[:, None, None]
    blurred = gaussian_filter(photo, (1.5, 1.5, 0))
    noisy = photo + np.random.default_rng(1).normal(0, 0.03, photo.shape)
    assert sorted_error(0.8 * photo)["color"] == pytest.approx(1, abs=0.01)
    assert sorted_error(blurred)["detail"] > 0.9
    assert sorted_error(broad)["broad"] > 0.8
    assert sorted_error(broad, fog=0.5)["fog"] > 0.8
    assert sorted_error(broad, fog=0.5, photos=1.0)["edge"] > 0.8
    assert sorted_error(noisy, noise=0.03)["noise"] > 0.85
    assert sorted_error(photo) == dict.fromkeys(PARTS, 0.0)


def test_a_fitted_camera_shows_what_the_pose_costs() -> None:
    photo = picture().astype(np.float32)
    maps = np.zeros((SIZE, SIZE)), np.full((SIZE, SIZE), 9.0)
    beside = RenderedView("a", photo, np.roll(photo, 1, axis=1))
    right = RenderedView("a", photo, photo + np.float32(0.001))
    found = shares([causes(beside, maps, 0.0, right)])
    assert found["pose"] > 0.95
    assert sum(found.values()) == pytest.approx(1)


def test_fog_and_the_edge_of_the_capture_are_found() -> None:
    """An opaque wall at depth 4; a faint blob before its left half; photos that see its upper half alone."""
    K = np.array([[40.0, 0, 32], [0, 40, 32], [0, 0, 1]])
    camera = Camera(SIZE, SIZE, K, np.eye(4))
    grid = np.stack(np.meshgrid(np.linspace(-4, 4, 33), np.linspace(-4, 4, 33)), -1).reshape(-1, 2)
    wall = np.concatenate([grid, np.full((len(grid), 1), 4.0)], 1)
    points = np.concatenate([wall, [[-0.6, 0.0, 1.5]]]).astype(np.float32)
    made = Gaussians.from_points(points, np.full(points.shape, 128, np.uint8), 0)
    scales, opacities = torch.full((len(points), 3), np.log(0.2)), torch.full((len(points),), 4.0)
    scales[-1], opacities[-1] = np.log(0.25), -0.5
    made = replace(made, scales=scales, opacities=opacities)
    upper = np.eye(4)
    upper[1, 3] = 3.2  # a camera that is as much higher: y points down
    fog, photos = pixel_maps(made, camera, shown_by(made, [Camera(SIZE, SIZE, K, upper)] * 3))
    assert fog[32, 16] > 0.3
    assert fog[:, 40:].max() < 0.01
    assert photos[2, 50] == pytest.approx(3, abs=0.1)
    assert photos[60, 50] == pytest.approx(0, abs=0.1)
    many = shown_by(made, [Camera(SIZE, SIZE, K, upper)] * 1000)  # not all of them are asked
    assert float(many.max()) == 1000


# --- What a run is judged by


def report(gains: list[list[float]], aligned: float | None) -> dict[str, Any]:
    learned = [{"name": str(k), "gains": gain} for k, gain in enumerate(gains)]
    return {"metrics": {"mean": {"psnr": 21.0, "psnr_aligned": aligned}}, "learned": learned}


def test_brightness_is_set_aside_where_photos_were_exposed_each_in_its_own_way() -> None:
    same, own = [[1.0, 1.0, 1.0]] * 2, [[1.0, 1.0, 1.0], [1.3, 1.0, 0.9]]
    assert judged_by(report(same, 27.0)) == (21.0, "PSNR")
    assert judged_by(report(own, 27.0))[0] == 27.0
    assert "matched" in judged_by(report(own, 27.0))[1]
    assert judged_by(report(own, None)) == (21.0, "PSNR")
    assert judged_by({"metrics": {"mean": {"psnr": None}}}) == (None, "PSNR")


@pytest.mark.parametrize(
    ("psnr", "word"),
    [(19.99, "poor"), (20.0, "fair"), (25.0, "good"), (30.0, "very good"), (None, "not measured")],
)
def test_the_word_rises_with_the_psnr(psnr: float | None, word: str) -> None:
    assert verdict(psnr)[0] == word


def test_the_verdict_goes_by_the_look_of_the_photos_cameras() -> None:
    """Gains alike for all photos are the scene's brightness, and no exposure of their own."""
    measured = {"mean": {"psnr": 25.1, "psnr_aligned": 25.6}, "psnr_shown": 21.6, "views": []}
    psnr, name = judged_by({"metrics": measured, "learned": 3 * [{"gains": [1.1, 1.1, 1.1]}]})
    assert psnr == 25.1
    assert "21.6 dB without" in name


def moments(*values: tuple[float | None, float | None], views: int | None = None) -> list[Any]:
    more = {} if views is None else {"views": views}
    return [
        {"iteration": 100 * k, "seconds": k, "psnr": psnr, "ssim": ssim, **more}
        for k, (psnr, ssim) in enumerate(values, 1)
    ]


def test_a_run_that_ends_below_its_best_is_told() -> None:
    fell = moments((20.0, 0.5), (22.5, 0.7), (22.0, 0.69))
    told = overdone(fell)
    assert told is not None
    assert "after iteration 200, 0.5 dB better than at the end" in told
    assert overdone(moments((20.0, 0.5), (22.05, 0.71), (22.0, 0.7))) is None  # two seeds differ by more
    assert overdone(moments((22.5, 0.6), (22.0, 0.7))) is None  # darker, say, and yet more like the photos
    assert overdone(moments((22.5, 0.7), (None, None))) is None
    assert overdone([]) is None
    assert overdone([*moments((22.5, 0.7), views=2), *moments((20.0, 0.5))]) is None  # of other photos
