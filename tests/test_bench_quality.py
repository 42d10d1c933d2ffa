"""The benchmark `quality` on a tiny scene: what is kept, resumed and left out, and that its tables hold the
numbers that follow from the runs' files."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pandas import DataFrame
from PIL import Image
from scipy import ndimage

import hqgs
from benchmarks import cli, study
from benchmarks.output import means
from benchmarks.protocol import Protocol, degraded, degraded_view, load_scenes, narrowed, validation_split
from benchmarks.quality import cell as quality_cell
from benchmarks.quality import run as quality
from benchmarks.quality.cell import count_regions, edge_robustness
from benchmarks.quality.run import PROTOCOLS
from benchmarks.quality.tables import courses, equal_time_gain, metrics, psnr_at, with_degraded
from benchmarks.study import Cell, Store, Study, grid, key_of
from hqgs.evaluation.metrics import psnr
from hqgs.photos.formula import parse_formation
from hqgs.scene.scene import Camera, Scene, SfmReport, View
from hqgs.training.checkpoint import scene_fingerprint
from hqgs.training.config import SRGSConfig, TrainConfig
from hqgs.training.methods.paper import VARIANTS
from hqgs.training.trainer import TrainingError
from tests.tiny_scene import tiny_scene

KINDS, ROWS, SEEDS = ("none", "noise:25", "lowres:2"), ("3dgs", "srgs", "hqgs"), (0, 1)
OPTIONS = ("--degradations", *KINDS, "--seeds", *map(str, SEEDS), "--iterations", "5")


def call(out: Path, *options: str) -> int:
    before = hqgs.get_num_threads()
    try:
        return cli.main(["quality", "--quick", "--threads", "1", "--out", str(out), *options])
    finally:
        hqgs.set_num_threads(before)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("quality")
    assert call(folder, *OPTIONS) == 0
    return folder


@pytest.fixture(scope="module")
def runs(out: Path) -> dict[tuple[str, int, str], dict[str, Any]]:
    """The files' contents by degradation, seed and method."""
    read = [json.loads(path.read_text(encoding="utf-8")) for path in files(out)]
    return {(run["degradation"], run["seed"], run["method"]): run for run in read}


def table(text: str, title: str) -> dict[str, dict[str, str]]:
    """The cells of the Markdown table whose title starts so, by row and column."""
    lines = text.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(f"**{title}"))
    end = next((k for k in range(start + 2, len(lines)) if not lines[k]), len(lines))
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[start + 2 : end]]
    head, body = rows[0], rows[2:]
    return {row[0]: dict(zip(head[1:], row[1:], strict=True)) for row in body}


def files(out: Path) -> list[Path]:
    """Those of the runs that were made here."""
    return list(Store(out).here.glob("*.json"))


def stamps(out: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in files(out)}


def bench_of(
    out: Path, protocol: Protocol, scenes: list[Scene], sfm: bool = False, pictures: int = 0
) -> quality.Quality:
    args = argparse.Namespace(
        out=out, validate=False, sfm=sfm, fit_cameras=False, pictures=pictures, known=None, finished=False
    )
    return quality.Quality(Study(args, "quality", protocol, scenes, labelled=False))


def test_each_cell_is_one_file_with_its_numbers(out: Path, runs: dict[Any, dict[str, Any]]) -> None:
    assert set(runs) == {(kind, seed, row) for kind in KINDS for seed in SEEDS for row in ROWS}
    assert len(stamps(out)) == len(runs) == 18
    for run in runs.values():
        assert (Store(out).here / f"{run['key']}.json").is_file()
        assert run["machine"]["cores"] >= 1
        assert run["versions"]["hqgs"] == hqgs.__version__ or run["versions"]["hqgs"] is None
        assert run["config"]["seed"] == run["seed"]
        assert [h["iteration"] for h in run["history"]] == [1, 2, 3, 4, 5]
        assert run["history"][-1]["psnr"] == pytest.approx(run["metrics"]["psnr"])
        assert run["history"][-1]["seconds"] == run["seconds"] > 0
        for metric in ("psnr", "ssim", "haarpsi"):
            assert run["metrics"][metric] == pytest.approx(np.mean([v[metric] for v in run["views"]]))
        assert {v["name"] for v in run["views"]} == {"view_00.png", "view_08.png"}
        assert run["metrics"]["lpips"] is None
        assert "lpips" in run["reasons"]["lpips"] or "63" in run["reasons"]["lpips"]
        assert run["threads"] == 1
        assert run["render_ms"] > 0
        regions = run["regions"]
        assert regions["edge"]["pixels"] + regions["flat"]["pixels"] == 8 * 48 * 36
        assert sum(r["gaussians"] for r in regions.values()) <= 8 * run["gaussians"]
    for kind in KINDS:
        formation = runs[kind, 0, "hqgs"]["formation"]
        assert str(parse_formation(formation)) == runs[kind, 0, "hqgs"]["config"]["hqgs"]["formation"]
    assert "lowres:2" in runs["lowres:2", 0, "hqgs"]["formation"]  # the small photos are at hand
    assert runs["noise:25", 0, "3dgs"]["formation"] is None


def test_methods_of_a_cell_see_the_same_photos(runs: dict[Any, dict[str, Any]]) -> None:
    for kind in KINDS:
        for seed in SEEDS:
            notes = [runs[kind, seed, row]["notes"] for row in ROWS]
            assert notes[0] == notes[1] == notes[2]
            assert kind == "none" or f"degradation {kind}, seed {seed}" in notes[0][-1]
    scene = tiny_scene()
    first = degraded(scene, "noise:25", 3)
    alone = degraded_view(scene, scene.train[1], "noise:25", 3)
    assert np.array_equal(first.train[1].image, alone.image)  # of one photo as of all of them
    assert not np.array_equal(first.train[0].image, degraded(scene, "noise:25", 4).train[0].image)


def test_tables_follow_from_the_files(out: Path, runs: dict[Any, dict[str, Any]]) -> None:
    text = (out / "quality_quick.md").read_text(encoding="utf-8")
    main = table(text, "PSNR/SSIM/HaarPSI, held-out test views of embedded; 5 iterations")
    gain = table(text, "PSNR gain over 3dgs (dB)")
    cost = table(text, "Cost")
    assert list(main) == list(ROWS)
    assert list(main["3dgs"]) == [*KINDS, "degraded"]
    assert list(gain) == ["srgs", "hqgs"]
    for row in ROWS:
        for column in main[row]:
            kinds = KINDS[1:] if column == "degraded" else [column]
            chosen = [(kind, seed) for kind in kinds for seed in SEEDS]
            means = [
                np.mean([runs[kind, seed, row]["metrics"][m] for kind, seed in chosen])
                for m in ("psnr", "ssim", "haarpsi")
            ]
            assert main[row][column] == "{:.2f}/{:.3f}/{:.3f}".format(*means)
            if row != "3dgs":
                gains = np.array(
                    [
                        runs[kind, seed, row]["metrics"]["psnr"] - runs[kind, seed, "3dgs"]["metrics"]["psnr"]
                        for kind, seed in chosen
                    ]
                )
                std = math.sqrt(((gains - gains.mean()) ** 2).sum() / (len(gains) - 1))
                assert gain[row][column] == f"{gains.mean():+.2f} ± {std:.2f} ({gains.min():+.2f})"
        mine = [run for (_, _, method), run in runs.items() if method == row]
        assert cost[row]["Gaussians"] == f"{np.mean([run['gaussians'] for run in mine]):,.0f}"
        assert cost[row]["step (ms)"] == f"{np.mean([200 * run['seconds'] for run in mine]):.1f}"


def test_one_file_holds_everything(out: Path, runs: dict[Any, dict[str, Any]]) -> None:
    whole = json.loads((out / "quality_quick.json").read_text(encoding="utf-8"))
    labelled = [run | {"row": run["method"]} for run in runs.values()]
    assert {run["key"]: run for run in whole["results"]["runs"]} == {run["key"]: run for run in labelled}
    assert whole["settings"]["protocol"] == "quick"
    assert whole["settings"]["validation"] is False
    assert {entry["what"] for entry in whole["left_out"]} == {"lpips", "lpips_vgg"}
    with Image.open(out / "quality_quick_gains.png") as chart:
        assert len(np.unique(np.asarray(chart.convert("RGB")).reshape(-1, 3), axis=0)) > 10


def test_sheets_show_the_photo_and_every_render(out: Path, runs: dict[Any, dict[str, Any]]) -> None:
    sheets = sorted((out / "pictures").iterdir())
    assert len(sheets) == len(KINDS)  # one for each degradation, of the first seed
    with Image.open(next(p for p in sheets if "noise_25" in p.name)) as image:
        sheet = np.asarray(image)
    line, gap = sheet.shape[0] // 2 - 36 - 4, 8  # the captions' font follows the pictures' size
    assert sheet.shape == (2 * (36 + line) + gap, 5 * 48 + 4 * gap, 3)
    with Image.open(out / "scenes" / "embedded_48x36_10" / "view_00.png") as image:
        photo = np.asarray(image.convert("RGB")).astype(int)
    assert np.array_equal(sheet[line : line + 36, :48], photo)
    for k, row in enumerate(ROWS):
        with Image.open(Store(out).beside(runs["noise:25", 0, row]["key"], "0.png")) as image:
            render = np.asarray(image).astype(int)
        left = (k + 2) * (48 + gap)
        assert np.array_equal(sheet[line : line + 36, left : left + 48], render)
        below = sheet[2 * line + 36 + gap :, left : left + 48]
        assert np.array_equal(below, np.minimum(4 * np.abs(render - photo), 255))
        value = -10 * math.log10(np.mean(((render - photo) / 255) ** 2))
        assert value == pytest.approx(runs["noise:25", 0, row]["views"][0]["psnr"], abs=0.05)


def test_finished_cells_are_not_repeated(
    out: Path, runs: dict[Any, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = stamps(out)
    trained: list[str] = []
    real = quality_cell.run_cell

    def counted(cell: Cell, *rest: Any) -> Any:
        trained.append(str(cell))
        return real(cell, *rest)

    monkeypatch.setattr(quality, "run_cell", counted)
    assert call(out, *OPTIONS) == 0
    assert (trained, stamps(out)) == ([], before)

    gone = runs["lowres:2", 1, "hqgs"]
    name = f"{gone['key']}.json"
    (Store(out).here / name).unlink()
    assert call(out, "--finished", *OPTIONS) == 0
    assert not (Store(out).here / name).exists()
    left_out = json.loads((out / "quality_quick.json").read_text(encoding="utf-8"))["left_out"]
    assert {"what": "run embedded, lowres:2, hqgs, seed 1", "why": "not finished"} in left_out

    assert call(out, *OPTIONS) == 0
    assert trained == ["embedded, lowres:2, hqgs, seed 1"]
    after = stamps(out)
    assert {k: v for k, v in after.items() if k != name} == {k: v for k, v in before.items() if k != name}
    again = json.loads((Store(out).here / name).read_text(encoding="utf-8"))
    for field in ("metrics", "gaussians", "regions", "config", "views"):
        assert again[field] == gone[field]  # the same bits


def test_a_run_serves_other_protocols_and_filters(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quality, "run_cell", lambda *rest: pytest.fail("nothing is left to train"))
    assert call(out, "--degradations", "noise:25.0", "--rows", "hqgs", "3dgs", "--iterations", "5") == 0
    whole = json.loads((out / "quality_quick.json").read_text(encoding="utf-8"))
    assert [run["method"] for run in whole["results"]["runs"]] == ["3dgs", "hqgs"]  # the protocol's order


def test_known_runs_of_another_machine_are_not_repeated(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = quality_cell.run_cell
    monkeypatch.setattr(quality, "run_cell", lambda *rest: pytest.fail("nothing is left to train"))
    known = tmp_path / "known.json"
    assert call(out, *OPTIONS, "--finished") == 0
    known.write_bytes((out / "quality_quick.json").read_bytes())
    assert call(tmp_path / "elsewhere", *OPTIONS, "--known", str(known)) == 0
    here, there = (
        json.loads((folder / "quality_quick.json").read_text(encoding="utf-8"))["results"]
        for folder in (out, tmp_path / "elsewhere")
    )
    assert here["runs"] == there["runs"]
    assert "the runs did not keep its renders" in capsys.readouterr().out

    # An own run is worth more than one that is brought.
    changed = json.loads(known.read_text(encoding="utf-8"))
    changed["results"]["runs"][0]["metrics"]["psnr"] = 99.0
    known.write_text(json.dumps(changed), encoding="utf-8")
    monkeypatch.setattr(quality, "run_cell", real)
    assert call(out, *OPTIONS, "--known", str(known)) == 0
    kept = json.loads((out / "quality_quick.json").read_text(encoding="utf-8"))["results"]["runs"][0]
    assert kept == here["runs"][0]
    known.write_text("[]", encoding="utf-8")
    assert call(out, *OPTIONS, "--known", str(known)) == 2
    assert "holds no runs of this benchmark" in capsys.readouterr().err


def test_validation_never_sees_a_test_view(out: Path, tmp_path: Path) -> None:
    scene = replace(tiny_scene(18), test=tiny_scene(18).train[:2], train=tiny_scene(18).train[2:])
    split = validation_split(scene)
    assert [v.name for v in split.test] == [v.name for v in scene.train[::7]]
    names = {v.name for v in split.train} | {v.name for v in split.test}
    assert names == {v.name for v in scene.train}
    assert names.isdisjoint(v.name for v in scene.test)
    assert {v.name for v in split.train}.isdisjoint(v.name for v in split.test)
    with pytest.raises(ValueError, match="1 training photos"):
        validation_split(replace(scene, train=scene.train[:1]))

    options = ("--degradations", "noise:25", "--rows", "3dgs", "--iterations", "2", "--validate")
    assert call(out, *options) == 0
    whole = json.loads((out / "quality_quick_validation.json").read_text(encoding="utf-8"))
    assert whole["settings"]["validation"] is True
    (run,) = whole["results"]["runs"]
    assert "-validation-" in run["key"]
    assert [v["name"] for v in run["views"]] == ["view_01.png", "view_09.png"]  # 00 and 08 are test views
    assert "for tuning" in run["notes"][1]
    text = (out / "quality_quick_validation.md").read_text(encoding="utf-8")
    assert "VALIDATION" in text.splitlines()[0]


def test_with_sfm_all_rows_share_the_poses_of_the_degraded_photos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = {"median": 0.125, "max": 0.5}
    seen = []

    def sfm(scene: Scene, keep: Path) -> Scene:
        assert keep == tmp_path / "sfm"
        seen.append(scene.train[0].image)
        report = SfmReport(5, ["lost"], [], error, error, 0.4, 40, 0.1, 3.5, 0.5, 40, None, 0.3)
        report = replace(report, auc={"1": 0.25, "3": 0.5, "5": 0.75})
        return replace(scene, sfm=report, points=scene.points + np.float32(0.01))

    monkeypatch.setattr(study, "sfm_scene", sfm)
    protocol = narrowed(PROTOCOLS["quick"], degradations=["noise:25"], rows=["3dgs", "hqgs"], iterations=2)
    scene = tiny_scene()
    bench = bench_of(tmp_path, protocol, [scene], sfm=True)
    bench.tables()
    report = bench.report
    assert len(seen) == 1
    np.testing.assert_array_equal(seen[0], degraded(scene, "noise:25", 0).train[0].image)
    runs = report.results["runs"]
    assert [run["sfm"]["points"] for run in runs] == [40, 40]
    assert all("-sfm-" in run["key"] for run in runs)
    assert "poses and points from the degraded photos" in report.tables[0].splitlines()[0]
    assert all(
        run["fitted"]["psnr"] >= run["metrics"]["psnr"] for run in runs
    )  # the camera it had counts too
    (fitted,) = (text for text in report.tables if "each held-out camera fitted" in text.splitlines()[0])
    assert f"{runs[0]['fitted']['psnr']:.2f}/{runs[0]['fitted']['ssim']:.3f}" in fitted
    (table,) = (text for text in report.tables if text.startswith("**Poses and points"))
    cells_of_row = [cell.strip() for cell in table.splitlines()[-1].split("|")[1:-1]]
    assert cells_of_row == [
        "tiny, noise:25, seed 0", "4 / 5", "0.125 / 0.500", "0.25/0.50/0.75", "12.50% / 50.00%", "0.40",
        "40 (40)", "10.00%", "3.5 (–)", "0.50 (0.30)",
    ]  # fmt: skip


def test_a_kill_or_a_failure_costs_one_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene()
    protocol = narrowed(
        PROTOCOLS["quick"], degradations=["none", "noise:25"], rows=["3dgs", "srgs"], iterations=2
    )
    real = quality_cell.run_cell

    def make() -> quality.Quality:
        return bench_of(tmp_path, protocol, [scene])

    def raising(error: BaseException, at: str) -> None:
        def run(cell: Cell, *rest: Any) -> Any:
            if str(cell) == at:
                raise error
            return real(cell, *rest)

        monkeypatch.setattr(quality, "run_cell", run)

    raising(KeyboardInterrupt(), "tiny, noise:25, 3dgs, seed 0")
    with pytest.raises(KeyboardInterrupt):
        make()
    assert len(stamps(tmp_path)) == 2

    raising(TrainingError("it blew up"), "tiny, noise:25, 3dgs, seed 0")
    bench = make()
    assert [len(bench.study.runs), len(stamps(tmp_path))] == [3, 4]  # and the reason of the other
    for later in (bench, make()):  # which the next call still knows
        later.tables()
        assert {"what": "run tiny, noise:25, 3dgs, seed 0", "why": "it blew up"} in later.report.left_out
        assert set(later.compared()["degradation"]) == {"none"}  # srgs alone is not compared

    monkeypatch.setattr(quality, "run_cell", real)
    bench = make()  # it is tried again
    assert (bench.study.failures, len(bench.study.runs), len(stamps(tmp_path))) == ({}, 4, 4)
    assert make().study.failures == {}

    first = files(tmp_path)[0]
    first.write_text("{", encoding="utf-8")
    with pytest.raises(ValueError, match=r"is damaged.*remove it"):
        make()


def test_the_key_covers_what_a_result_depends_on(monkeypatch: pytest.MonkeyPatch) -> None:
    base = grid(PROTOCOLS["quick"], [tiny_scene()])[0]

    def key(cell: Cell, **options: Any) -> str:
        """With other options of the methods."""
        return key_of(replace(cell, config=replace(cell.config, **options)), scene_fingerprint(cell.scene))

    first = key(base)
    assert first.startswith("tiny-x1-none-3dgs-s0-10-")
    same = replace(base, row=replace(base.row, label="other"))
    assert key(same, srgs=SRGSConfig(texture_weight=0.9)) == first  # another method's options
    srgs = replace(base, row=replace(base.row, method="srgs"))
    moved = replace(base.scene, points=base.scene.points + 1)
    others = [
        key(base, seed=1),
        key(base, iterations=11),
        key(replace(base, degradation="blur")),
        key(replace(base, scene=moved)),
        key(replace(base, scene=validation_split(base.scene))),
        key(srgs),
        key(srgs, srgs=SRGSConfig(texture_weight=0.8)),
        key(replace(base, more={"sfm": True})),
        key(base, brisk=True),
        key(replace(base, row=replace(base.row, method="hqgs"))),
        key(replace(base, row=replace(base.row, method="hqgs")), brisk=False),
    ]
    monkeypatch.setattr(hqgs, "__version__", "999")
    others.append(key(base))
    assert len({first, *others}) == 13


def test_runs_of_other_sources_do_not_count(
    out: Path, runs: dict[Any, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert {run["sources"] for run in runs.values()} == {Store(out).here.name.split("-")[-1]}
    run = runs["none", 0, "3dgs"]
    first = Store(tmp_path)
    first.write(run)
    monkeypatch.setattr(study, "sources", lambda: "other")
    second = Store(tmp_path)
    assert second.read(run["key"]) is None
    second.write(run | {"seconds": 0.0})
    assert second.read(run["key"]) == run | {"seconds": 0.0}
    assert first.read(run["key"]) == run


def test_the_sources_are_those_that_make_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    made_of = ("hqgs/pipeline.py", "hqgs/training/loop.py", "rust/lib.rs", "Cargo.lock")
    for changed in ("", "hqgs/cli/main.py", *made_of):
        root = tmp_path / f"at {changed}".replace("/", "_")
        for name in ("hqgs/__init__.py", "hqgs/cli/main.py", *made_of, "Cargo.toml"):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text("2" if name == changed else "1", encoding="utf-8")
        monkeypatch.setattr(hqgs, "__file__", str(root / "hqgs" / "__init__.py"))
        study.sources.cache_clear()
        found.append(study.sources())
    study.sources.cache_clear()
    assert found[0] == found[1]  # the command line makes no result
    assert len(set(found)) == 1 + len(made_of)


def test_protocols() -> None:
    assert {"standard", "full", "long", "ablation", "grid"} < set(PROTOCOLS)
    for protocol in PROTOCOLS.values():
        assert protocol.baseline in protocol.labels
        assert len(set(protocol.labels)) == len(protocol.rows)
        assert (
            narrowed(protocol, degradations=protocol.degradations) == protocol
        )  # spelled as the parser spells them
    scene = tiny_scene()
    standard = grid(PROTOCOLS["standard"], [scene, replace(scene, name="b")])
    assert len(standard) == 2 * 6 * 2 * 4
    assert [cell.row.label for cell in standard[:4]] == ["3dgs", "srgs", "paper", "hqgs"]
    assert len({cell.group for cell in standard[:4]}) == 1
    assert {cell.seed for cell in standard[:48]} == {0}
    assert PROTOCOLS["ablation"].labels == [*(f"V{k}" for k in range(1, 7)), "l1", "paper"]
    for cell in grid(PROTOCOLS["ablation"], [scene]):
        assert cell.config.hqgs.guidance == "paper"
        if cell.row.label != "l1":
            assert cell.config.hqgs.paper == VARIANTS[cell.row.label.replace("paper", "V7")]
    assert [cell.config.hqgs.first_points for cell in grid(PROTOCOLS["points"], [scene])[:2]] == [0.0, 1.0]
    assert [cell.config.batch for cell in grid(PROTOCOLS["ranks"], [scene])] == [1, 2, 4, 8]
    assert grid(PROTOCOLS["long"], [scene])[0].config.densify.stop == 15_000
    for cell in standard:
        if cell.row.paper:
            continue
        config = TrainConfig(3_000, cell.row.label, cell.seed, leave_out=()).scaled()
        assert cell.config == config


def test_bad_options_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options, message in (
        (["--rows", "nerf"], "rows: there is no 'nerf'; there are: 3dgs, srgs, hqgs"),
        (["--degradations", "fog"], "unknown degradation 'fog'"),
        (["--degradations", "blur", "blur"], "degradations holds blur twice"),
        (["--seeds", "-1"], "seed is -1"),
        (["--iterations", "0"], "iterations is 0"),
        (["--downscale", "0.5"], "downscale must be at least 1, got 0.5"),
        (["--pictures", "-1"], "pictures is -1"),
        (["--scenes", str(tmp_path / "no")], "there is no scene folder"),
    ):
        assert call(tmp_path / "out", *options) == 2
        assert message in capsys.readouterr().err
    tiny = Protocol(rows=(), iterations=1, downscale=1.0, embedded=(48, 36, 10))
    with pytest.raises(ValueError, match="two scenes are called 'fern'"):
        load_scenes([tmp_path / "a" / "fern", tmp_path / "b" / "fern"], tiny, tmp_path, False)
    (tmp_path / "degradation.json").write_text("{}", encoding="utf-8")
    with pytest.raises(ValueError, match="holds degraded photos"):
        load_scenes([tmp_path], tiny, tmp_path, False)


def test_regions_of_a_hand_made_view() -> None:
    image = np.zeros((10, 20, 3), np.uint8)
    image[5, 5] = 255
    K = np.array([[10.0, 0, 10], [0, 10.0, 5], [0, 0, 1]])
    view = View("a", Camera(20, 10, K, np.eye(4)), image)

    def at(column: int, row: int, z: float = 2.0) -> list[float]:
        return [(column + 0.5 - 10) * z / 10, (row + 0.5 - 5) * z / 10, z]

    means = np.array(
        [at(4, 5), at(6, 6), at(6, 6, 5.0), at(15, 2), at(0, 0), at(19, 9), at(20, 5), at(5, 5, -2.0)],
        np.float32,
    )
    regions = count_regions(means, [view, view])
    # The Sobel magnitude of a dot is positive in its 8 neighbours and 0 in itself.
    assert regions["edge"] == {"gaussians": 2 * 3, "pixels": 2 * 8, "density": 375.0}
    assert regions["flat"] == {"gaussians": 2 * 3, "pixels": 2 * 192, "density": 1000 * 6 / 384}
    masked = replace(view, mask=np.zeros((10, 20), bool))
    assert count_regions(means, [masked])["edge"] == {"gaussians": 0, "pixels": 0, "density": None}


def test_edge_maps_against_another_sobel() -> None:
    scene = tiny_scene()
    kinds = ["noise:25", "jpeg:10", "none"]
    found = edge_robustness(scene, kinds, seed=2)

    def edges(image: np.ndarray) -> np.ndarray:
        image = image.astype(np.float64) / (255 if image.dtype == np.uint8 else 1)
        smooth, slope = np.array([1, 2, 1]), np.array([-1, 0, 1])
        kernels = (np.outer(smooth, slope), np.outer(slope, smooth))
        g = np.hypot(*(ndimage.correlate(image, k[..., None], mode="nearest") for k in kernels))
        return (g - g.min()) / (g.max() - g.min())

    def decibel(a: np.ndarray, b: np.ndarray) -> float:
        return -10 * math.log10(np.mean((a.clip(0, 1) - b.clip(0, 1)) ** 2))

    expected = []
    for kind in kinds[:2]:
        pairs = list(zip(degraded(scene, kind, 2).train, scene.train, strict=True))
        photo = np.mean([decibel(a.image.astype(np.float64), b.image / 255) for a, b in pairs])
        edge = np.mean([decibel(edges(a.image), edges(b.image)) for a, b in pairs])
        assert found["degradations"][kind] == pytest.approx(
            {"photo_psnr": photo, "edge_psnr": edge}, abs=1e-3
        )
        expected.append((photo, edge))
    assert set(found["degradations"]) == set(kinds[:2])  # clean photos have no finite PSNR
    (p, e), (q, f) = expected
    assert found["photo_variance"] == pytest.approx((p - q) ** 2 / 2, rel=1e-3)
    assert found["edge_variance"] == pytest.approx((e - f) ** 2 / 2, rel=1e-3)
    assert edge_robustness(scene, kinds[:1], 0)["edge_variance"] is None


def test_edge_maps_are_those_of_the_photos_that_are_trained_on() -> None:
    scene, kind = tiny_scene(), "some:noise:25"
    trained = degraded(scene, kind, 2).train
    hit = [k for k, (a, b) in enumerate(zip(trained, scene.train, strict=True)) if a.image.dtype != np.uint8
           and np.abs(a.image - b.image / np.float32(255)).max() > 1e-6]  # fmt: skip
    assert 0 < len(hit) < len(trained)
    values = [psnr(trained[k].image, scene.train[k].image) for k in hit]
    found = edge_robustness(scene, [kind], seed=2)["degradations"][kind]["photo_psnr"]
    assert found == pytest.approx(np.mean([value for value in values if value is not None]))


def history(*points: tuple[float, float | None]) -> list[dict[str, Any]]:
    return [{"iteration": k, "seconds": t, "psnr": v, "ssim": None} for k, (t, v) in enumerate(points)]


def test_gain_at_equal_time() -> None:
    slow, fast = history((10, 20), (20, 24), (40, 30)), history((5, 18), (15, 26))
    assert psnr_at(slow, 15) == 22
    assert psnr_at(slow, 9) is None
    assert psnr_at(slow, 41) is None
    assert equal_time_gain(fast, slow) == 26 - 22  # at 15 s, where the fast one ends
    assert equal_time_gain(slow, fast) == 22 - 26
    assert equal_time_gain(history((1, 18), (2, 26)), slow) is None  # the slow one was not evaluated by then
    assert equal_time_gain(history((5, 18), (15, None)), slow) is None


def test_means_over_groups() -> None:
    values = {("a", "none"): 1.0, ("a", "blur"): 2.0, ("b", "blur"): 6.0, ("b", "jpeg:5"): 7.0}
    lines = [{"scene": s, "degradation": kind, "row": "x", "psnr": v} for (s, kind), v in values.items()]
    frame = DataFrame(lines)

    def found(frame: DataFrame) -> dict[str, float]:
        return means(with_degraded(frame), ["degradation"], ["psnr"])["psnr"].to_dict()

    assert found(frame) == {"none": 1.0, "blur": 4.0, "jpeg:5": 7.0, "degraded": 5.0}
    assert list(found(frame)) == ["none", "blur", "jpeg:5", "degraded"]
    assert list(found(frame.loc[:1])) == ["none", "blur"]
    frame.loc[1, "psnr"] = None
    assert math.isnan(found(frame)["blur"])  # never over fewer runs


def test_each_scene_has_a_table_of_its_own() -> None:
    line = {"scene": "a", "degradation": "blur", "row": "x"}
    frame = DataFrame([line | {"seed": seed, "psnr": 20.0 + seed, "ssim": 0.5} for seed in (0, 3)])
    found = table(metrics(frame, "a", ("psnr", "ssim")), "PSNR/SSIM, a")
    assert found == {"x": {"blur": "21.50/0.500"}}


def test_the_way_of_the_runs_is_that_of_their_common_evaluations() -> None:
    first, second = history((10, 20), (20, 24), (40, 30)), history((5, 18), (15, 26))
    lines = [("x", first), ("y", first), ("x", second), ("y", first)]
    frame = DataFrame([{"row": label, "history": one} for label, one in lines])
    way = table(courses(frame), "PSNR (dB) and seconds of training on the way, means over all runs")
    assert way == {
        "x": {"0": "19.00, 8 s", "1": "25.00, 18 s"},
        "y": {"0": "20.00, 10 s", "1": "24.00, 20 s"},
    }
    second[0]["psnr"] = None
    assert courses(frame.loc[frame["row"] == "x"]).count("–, 8 s") == 1
