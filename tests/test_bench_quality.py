"""The benchmark `quality` on a tiny scene: what is kept, resumed and left out, and what its lines hold."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import hqgs
from benchmarks import cli, study
from benchmarks.protocol import Protocol, degraded, degraded_view, load_scenes, narrowed, validation_split
from benchmarks.quality import cell as quality_cell
from benchmarks.quality import run as quality
from benchmarks.quality.run import PROTOCOLS
from benchmarks.rows import RUN, Table
from benchmarks.study import PHOTOS, Cell, Study, digest_of, grid
from hqgs.photos.formula import parse_formation
from hqgs.scene.scene import Scene, SfmReport
from hqgs.training.checkpoint import scene_fingerprint
from hqgs.training.config import SRGSConfig, TrainConfig
from hqgs.training.trainer import TrainingError
from tests.tiny_scene import tiny_scene

KINDS, ROWS = ("noise:25", "lowres:2"), ("3dgs", "srgs", "hqgs")
OPTIONS = ("--degradations", *KINDS, "--iterations", "5")


def call(out: Path, *options: str) -> int:
    return cli.main(["quality", "--quick", "--threads", "1", "--out", str(out), *options])


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("quality")
    assert call(folder, *OPTIONS) == 0
    return folder


@pytest.fixture(scope="module")
def runs(out: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """The lines of the table by degradation and row."""
    found = Table(out / "quality.csv").frame().to_dict("records")
    return {(line["degradation"], line["row"]): line for line in found}


def bench_of(out: Path, protocol: Protocol, scenes: list[Scene], sfm: bool = False) -> quality.Quality:
    args = argparse.Namespace(out=out, validate=False, sfm=sfm, fit_cameras=False, pictures=0, finished=False)
    bench = quality.Quality(Study(args, "quality", protocol, scenes))
    bench.study.train(bench.measure)
    return bench


def test_each_run_is_one_line_with_its_numbers(out: Path, runs: dict[Any, dict[str, Any]]) -> None:
    assert set(runs) == {(kind, row) for kind in KINDS for row in ROWS}
    assert len((out / "quality.csv").read_text(encoding="utf-8").splitlines()) == 1 + len(runs)
    for (kind, row), run in runs.items():
        assert (run["scene"], run["seed"], run["iterations"], run["poses"]) == ("embedded", 0, 5, "own")
        assert 5 < run["psnr"] < 40
        assert 0 < run["ssim"] < 1
        assert 0 < run["haarpsi"] < 1
        assert run["psnr_aligned"] >= run["psnr"] - 1e-3  # no gains and no tint is one of the choices
        assert min(run["seconds"], run["cpu_seconds"], run["gaussians"]) > 0
        assert run["threads"] == 1
        assert run["sources"] == study.sources()
        assert row == "hqgs" or run["found"] == ""
        if row == "hqgs":
            assert str(parse_formation(run["found"])) == run["found"]
        picture = out / "runs" / f"{run['digest']}-{study.sources()}" / "0.png"
        with Image.open(picture) as image:
            assert image.size == (48, 36)
        assert kind in KINDS
    assert "lowres:2" in runs["lowres:2", "hqgs"]["found"]  # the small photos are at hand


def test_methods_of_a_cell_see_the_same_photos() -> None:
    scene = tiny_scene()
    first = degraded(scene, "noise:25", 3)
    alone = degraded_view(scene, scene.train[1], "noise:25", 3)
    assert np.array_equal(first.train[1].image, alone.image)  # of one photo as of all of them
    assert not np.array_equal(first.train[0].image, degraded(scene, "noise:25", 4).train[0].image)


def test_what_is_printed_follows_from_the_lines(
    out: Path, runs: dict[Any, dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(out, *OPTIONS, "--finished") == 0
    printed = capsys.readouterr().out
    psnrs = {row: [runs[kind, row]["psnr"] for kind in KINDS] for row in ROWS}
    for row in ROWS:
        assert f"| {row} | {' | '.join(f'{value:.2f}' for value in psnrs[row])} |" in printed
    over = [f"{a - b:+.2f}" for a, b in zip(psnrs["hqgs"], psnrs["3dgs"], strict=True)]
    assert f"| hqgs | {' | '.join(over)} |" in printed


def test_sheets_show_the_photo_and_every_render(out: Path, runs: dict[Any, dict[str, Any]]) -> None:
    sheets = sorted((out / "pictures").iterdir())
    assert len(sheets) == len(KINDS)  # one for each degradation, of the first seed
    with Image.open(next(p for p in sheets if "noise_25" in p.name)) as image:
        sheet = np.asarray(image)
    line, gap = sheet.shape[0] // 2 - 36 - 4, 8  # the captions' font follows the pictures' size
    assert sheet.shape == (2 * (36 + line) + gap, 5 * 48 + 4 * gap, 3)
    with np.load(out / "scenes" / "embedded_48x36_10" / "room.npz") as made:
        photo = made["photo view_00.png"].astype(int)
    assert np.array_equal(sheet[line : line + 36, :48], photo)
    for k, row in enumerate(ROWS):
        folder = out / "runs" / f"{runs['noise:25', row]['digest']}-{study.sources()}"
        with Image.open(folder / "0.png") as image:
            render = np.asarray(image).astype(int)
        left = (k + 2) * (48 + gap)
        assert np.array_equal(sheet[line : line + 36, left : left + 48], render)
        below = sheet[2 * line + 36 + gap :, left : left + 48]
        assert np.array_equal(below, np.minimum(4 * np.abs(render - photo), 255))


def test_finished_runs_are_not_repeated(
    out: Path,
    runs: dict[Any, dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    table = Table(out / "quality.csv")
    before = table.path.read_text(encoding="utf-8")
    trained: list[str] = []
    real = quality_cell.run_cell

    def counted(cell: Cell, *rest: Any) -> Any:
        trained.append(str(cell))
        return real(cell, *rest)

    monkeypatch.setattr(quality, "run_cell", counted)
    assert call(out, *OPTIONS) == 0
    assert call(out, "--degradations", "noise:25.0", "--rows", "hqgs", "3dgs", "--iterations", "5") == 0
    assert (trained, table.path.read_text(encoding="utf-8")) == ([], before)

    gone = runs["lowres:2", "hqgs"]
    lines = before.splitlines(keepends=True)
    old = [line for line in lines if "lowres:2,hqgs" not in line]
    table.path.write_text("".join(old), encoding="utf-8")
    capsys.readouterr()
    assert call(out, "--finished", *OPTIONS) == 0
    assert "left out: run embedded, lowres:2, hqgs, seed 0: not finished" in capsys.readouterr().out
    assert trained == []

    assert call(out, *OPTIONS) == 0
    assert trained == ["embedded, lowres:2, hqgs, seed 0"]
    again = table.frame().iloc[-1]
    for name in ("psnr", "ssim", "haarpsi", "gaussians", "digest"):
        assert again[name] == gone[name]  # the same bits
    assert table.path.read_text(encoding="utf-8").startswith("".join(old))


def test_runs_of_other_sources_do_not_count(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "quality.csv").write_bytes((out / "quality.csv").read_bytes())
    assert call(tmp_path, *OPTIONS, "--finished") == 0
    printed = capsys.readouterr().out
    assert printed.count("the runs did not keep its renders") == 2
    assert "not finished" not in printed
    longer = ("--degradations", *KINDS, "--iterations", "6")  # is another run
    assert call(tmp_path, *longer, "--finished") == 0
    assert capsys.readouterr().out.count("not finished") == 6
    monkeypatch.setattr(study, "sources", lambda: "other")
    assert call(tmp_path, *OPTIONS, "--finished") == 0
    assert capsys.readouterr().out.count("not finished") == 6


def test_validation_never_sees_a_test_view(out: Path) -> None:
    scene = replace(tiny_scene(18), test=tiny_scene(18).train[:2], train=tiny_scene(18).train[2:])
    split = validation_split(scene)
    assert [v.name for v in split.test] == [v.name for v in scene.train[::7]]
    names = {v.name for v in split.train} | {v.name for v in split.test}
    assert names == {v.name for v in scene.train}
    assert names.isdisjoint(v.name for v in scene.test)
    assert {v.name for v in split.train}.isdisjoint(v.name for v in split.test)
    with pytest.raises(ValueError, match="1 training photos"):
        validation_split(replace(scene, train=scene.train[:1]))

    before = (out / "quality.csv").read_bytes()
    options = ("--degradations", "noise:25", "--rows", "3dgs", "--iterations", "2", "--validate")
    assert call(out, *options) == 0
    assert (out / "quality.csv").read_bytes() == before  # results and tuning have a table each
    (line,) = Table(out / "quality_validation.csv", RUN).rows()
    assert line["row"] == "3dgs"


def test_with_sfm_all_rows_share_the_poses_of_the_degraded_photos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = {"median": 0.125, "max": 0.5}
    seen = []

    def sfm(scene: Scene, keep: Path) -> Scene:
        assert keep == tmp_path / "sfm"
        seen.append(scene.train[0].image)
        report = SfmReport(5, ["lost"], 40, 3.5, 0.5, [], error, error, 0.4, 40)
        report = replace(report, auc={"1": 0.25, "3": 0.5, "5": 0.75})
        return replace(scene, sfm=report, points=scene.points + np.float32(0.01))

    monkeypatch.setattr(study, "sfm_scene", sfm)
    protocol = narrowed(PROTOCOLS["quick"], degradations=["noise:25"], rows=["3dgs", "hqgs"], iterations=2)
    bench = bench_of(tmp_path, protocol, [tiny_scene()], sfm=True)
    assert len(seen) == 1
    np.testing.assert_array_equal(seen[0], degraded(tiny_scene(), "noise:25", 0).train[0].image)
    runs = bench.study.frame()
    assert list(runs["poses"]) == [PHOTOS, PHOTOS]
    assert (runs["psnr_fitted"] >= runs["psnr"]).all()  # the camera it had counts too
    (line,) = Table(tmp_path / "poses.csv").frame().to_dict("records")
    wanted = {"photos": 5, "registered": 4, "rotation_max": 0.5, "centre_median": 0.125, "auc_3": 0.5}
    wanted |= {"cameras_px": 0.4, "points": 40, "own_points": 40, "track_length": 3.5}
    assert {name: line[name] for name in wanted} == wanted
    assert any("fitted" in text for text in bench.tables())

    table = Table(tmp_path / "poses.csv")
    table.put([table.rows()[0] | {"photos": "9", "search_cpu_s": "1.5"}])
    again = quality.Quality(Study(bench.args, "quality", protocol, [tiny_scene()]))
    cell = again.study.cells[0]
    again.note(cell, again.study.photos(cell))
    (line,) = table.frame().to_dict("records")
    assert (line["photos"], line["search_cpu_s"]) == (5, 1.5)  # the model was kept: no process found it anew


def test_a_kill_or_a_failure_costs_one_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tiny_scene()
    protocol = narrowed(
        PROTOCOLS["quick"], degradations=["none", "noise:25"], rows=["3dgs", "srgs"], iterations=2
    )
    real = quality_cell.run_cell
    lost = "tiny, noise:25, 3dgs, seed 0"

    def raising(error: BaseException) -> None:
        def run(cell: Cell, *rest: Any) -> Any:
            if str(cell) == lost:
                raise error
            return real(cell, *rest)

        monkeypatch.setattr(quality, "run_cell", run)

    raising(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        bench_of(tmp_path, protocol, [scene])
    table = Table(tmp_path / "quality.csv")
    assert len(table.rows()) == 2

    raising(TrainingError("it blew up"))
    bench = bench_of(tmp_path, protocol, [scene])
    assert [len(bench.study.runs), len(table.rows())] == [3, 3]
    assert bench.study.missing() == [f"left out: run {lost}: it blew up"]
    assert "–" in bench.tables()[2]  # srgs alone is not compared

    monkeypatch.setattr(quality, "run_cell", real)
    bench = bench_of(tmp_path, protocol, [scene])  # it is tried again
    assert (bench.study.missing(), len(table.rows())) == ([], 4)

    table.path.write_text("scene\ntiny\n", encoding="utf-8")
    with pytest.raises(ValueError, match="is damaged"):
        bench_of(tmp_path, protocol, [scene])


def test_the_digest_covers_what_a_result_depends_on(monkeypatch: pytest.MonkeyPatch) -> None:
    base = grid(PROTOCOLS["quick"], [tiny_scene()])[0]

    def digest(cell: Cell, **options: Any) -> str:
        """With other options of the methods."""
        return digest_of(replace(cell, config=replace(cell.config, **options)), scene_fingerprint(cell.scene))

    first = digest(base)
    same = replace(base, row=replace(base.row, label="other"))
    assert digest(same, srgs=SRGSConfig(texture_weight=0.9)) == first  # another method's options
    srgs = replace(base, row=replace(base.row, method="srgs"))
    moved = replace(base.scene, points=base.scene.points + 1)
    others = [
        digest(base, seed=1),
        digest(base, iterations=11),
        digest(replace(base, degradation="blur")),
        digest(replace(base, scene=moved)),
        digest(replace(base, scene=validation_split(base.scene))),
        digest(srgs),
        digest(srgs, srgs=SRGSConfig(texture_weight=0.8)),
        digest(replace(base, poses=PHOTOS)),
        digest(base, faster_rates=True),
        digest(replace(base, row=replace(base.row, method="hqgs"))),
    ]
    monkeypatch.setattr(hqgs, "__version__", "999")
    others.append(digest(base))
    assert len({first, *others}) == 12


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
    for protocol in PROTOCOLS.values():
        assert protocol.baseline in protocol.labels
        assert len(set(protocol.labels)) == len(protocol.rows)
        assert (
            narrowed(protocol, degradations=protocol.degradations) == protocol
        )  # spelled as the parser does
    scene = tiny_scene()
    standard = grid(narrowed(PROTOCOLS["standard"], seeds=[0, 1]), [scene, replace(scene, name="b")])
    assert len(standard) == 2 * 6 * 2 * 2
    assert len({cell.group for cell in standard[:2]}) == 1
    assert {cell.seed for cell in standard[:24]} == {0}
    assert TrainConfig(50_000).due.stop == 15_000
    for cell in standard:
        assert cell.config == TrainConfig(2_000, cell.row.label, cell.seed, leave_out=())
    paper, alone = grid(PROTOCOLS["others"], [scene])
    assert (paper.config.hqgs.guidance, alone.config.hqgs.formation) == ("paper", "none")


def test_scenes_that_tables_could_not_tell_apart_are_refused(tmp_path: Path) -> None:
    tiny = Protocol(rows=(), iterations=1, downscale=1.0, embedded=(48, 36, 10))
    with pytest.raises(ValueError, match="two scenes are called 'fern'"):
        load_scenes([tmp_path / "a" / "fern", tmp_path / "b" / "fern"], tiny, tmp_path, False)
    (tmp_path / "degradation.json").write_text("{}", encoding="utf-8")
    with pytest.raises(ValueError, match="holds degraded photos"):
        load_scenes([tmp_path], tiny, tmp_path, False)
