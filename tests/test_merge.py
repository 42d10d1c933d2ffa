"""Runs of parts put together: crops, errors, one brightness, seams."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_scene import HEIGHT, WIDTH, tiny_scene

from benchmarks.parts import write_city
from hqgs.cli.main import main
from hqgs.evaluation.seams import measure_seams, seams
from hqgs.model.gaussians import Gaussians
from hqgs.scene.camera_files import save_cameras
from hqgs.scene.cells import Cut, cell_of
from hqgs.scene.formats.part_json import keep_part, read_part
from hqgs.scene.scene import Part
from hqgs.training.merge import brighter, merge

HALVES = Cut((1.0, 0.0, 0.0), 0.25, 0, 1)


def cloud(seed: int, sh_degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -1.5, 2.9], [2, 1.5, 3.1], (200, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (200, 3), dtype=np.uint8)
    return Gaussians.from_points(points, colors, sh_degree)


def made_run(folder: Path, k: int, gaussians: Gaussians, split: str = "a", gains: float = 1.0) -> Path:
    """What merging reads of a run."""
    folder.mkdir()
    gaussians.save(folder / "scene.ply")
    keep_part(folder, Part("plane", split, k, 2, HALVES, ["view0.png"]))
    scene = tiny_scene()
    save_cameras(folder, scene)
    learned = [
        {"name": view.name, "gains": [gains * (1 + 0.1 * n)] * 3} for n, view in enumerate(scene.train)
    ]
    (folder / "report.json").write_text(json.dumps({"learned": learned if gains != 1 else []}))
    return folder


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    return [made_run(tmp_path / f"run{k}", k, cloud(k)) for k in range(2)]


def test_each_gaussian_comes_from_the_part_whose_cell_it_lies_in(runs: list[Path], tmp_path: Path) -> None:
    merged = merge(runs[::-1], tmp_path / "scene.ply")  # in any order
    back, parts = Gaussians.load(tmp_path / "scene.ply"), [Gaussians.load(run) for run in runs]
    low, high = (part.means[:, 0] >= 0.25 for part in parts)
    for name, tensor in back.named().items():
        wanted = torch.cat([parts[0].named()[name][~low], parts[1].named()[name][high]])
        assert torch.equal(tensor[: len(wanted)], wanted)
    assert [(one.part, one.gaussians, one.cropped) for one in merged.parts] == [
        (1, int((~low).sum()), int(low.sum())),
        (2, int(high.sum()), int((~high).sum())),
    ]


def test_harmonics_are_those_of_the_part_with_most(tmp_path: Path) -> None:
    runs = [made_run(tmp_path / f"run{k}", k, cloud(k, sh_degree=3 * k)) for k in range(2)]
    merged = merge(runs, tmp_path / "scene.spz")
    assert merged.model.sh_degree == 3
    assert not merged.model.shN[: merged.parts[0].gaussians].any()


def test_wrong_runs_are_named(runs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "scene.ply"

    def refused(wrong: list[Path], words: str) -> None:
        with pytest.raises(ValueError, match=words):
            merge(wrong, out)
        assert not out.exists()

    refused(runs[:1], "plane has 2 parts, and 1 runs were given; missing: part 2")
    refused([*runs, runs[0]], "part 1 of 2 of plane came twice")
    foreign = made_run(tmp_path / "foreign", 1, cloud(1), split="b")
    refused([runs[0], foreign], "part 2 of 2 of plane, but of another split")
    (runs[1] / "part.json").unlink()
    refused(runs, "not the run of a part")
    with pytest.raises(ValueError, match="which would be lost"):
        merge([runs[0], made_run(tmp_path / "again", 1, cloud(1))], runs[0] / "scene.ply")
    with pytest.raises(FileNotFoundError):
        merge([tmp_path / "nowhere"], out)


def test_an_error_leaves_the_old_file(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scene.ply"
    out.write_text("old")
    (runs[1] / "scene.ply").write_text("ply damaged")
    assert main(["merge", *map(str, runs), "--out", str(out)]) == 2
    assert "run1" in capsys.readouterr().err
    assert out.read_text() == "old"
    assert main(["merge", *map(str, runs), "--out", str(out), "--whole", str(runs[0])]) == 2
    assert "--whole is given without --scene" in capsys.readouterr().err


def test_shared_photos_bring_parts_to_one_brightness(tmp_path: Path) -> None:
    """The second run takes all photos for twice as bright, so its scene is half as bright."""
    runs = [made_run(tmp_path / f"run{k}", k, cloud(k), gains=1.1 * 2**k) for k in range(2)]
    first, second = merge(runs, tmp_path / "scene.ply").parts
    np.testing.assert_allclose(np.array(second.gains) / first.gains, 2.0, rtol=1e-6)
    # The mean photo of the whole has a gain of 1.
    mean = np.exp(np.mean([np.log(1.1 * (1 + 0.1 * n)) for n in range(5)]))
    np.testing.assert_allclose(first.gains, mean, rtol=1e-6)


def test_brighter_light_is_that_of_linear_light() -> None:
    gaussians = cloud(0, sh_degree=0)
    bright = brighter(gaussians, np.log([2.0, 1.0, 0.5]))
    colors = [0.5 + 0.28209479177387814 * one.sh0.numpy() for one in (gaussians, bright)]
    linear = [np.where(c <= 0.04045, c / 12.92, ((np.maximum(c, 0) + 0.055) / 1.055) ** 2.4) for c in colors]
    np.testing.assert_allclose(linear[1], linear[0] * (2.0, 1.0, 0.5), atol=1e-5)


def test_seams_are_where_another_part_begins() -> None:
    scene, gaussians = tiny_scene(), cloud(0)
    camera = scene.test[0].camera
    parts = (gaussians.means[:, 0] >= 0.25).numpy().astype(int)
    beside = seams(gaussians, parts, camera)
    assert beside.shape == (HEIGHT, WIDTH)
    assert beside.any()
    assert not seams(gaussians, 0 * parts, camera).any()
    rows = {row.what: row for row in measure_seams([gaussians, gaussians], parts, scene.test)}
    assert rows["all"].psnr[0] == rows["all"].psnr[1] == rows["views with a seam"].psnr[0]
    assert rows["views without a seam"].psnr == [None, None]


def test_from_a_scene_to_its_parts_and_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    city = tmp_path / "city"
    write_city(city, 16, 640)
    assert main(["split", str(city), "--parts", "2", "--out", str(tmp_path / "parts")]) == 0
    assert "--around COARSE" in capsys.readouterr().out
    runs, coarse = list[str](), str(tmp_path / "coarse")
    options = ["--method", "3dgs", "--iterations", "8", "--leave-out", "none", "--threads", "1"]
    assert main(["train", str(tmp_path / "parts" / "coarse"), "--out", coarse, *options]) == 0
    options += ["--around", coarse]
    for k in (1, 2):
        runs.append(str(tmp_path / f"run{k}"))
        assert main(["train", str(tmp_path / "parts" / f"part{k}"), "--out", runs[-1], *options]) == 0
    longer = ["--out", runs[0], "--resume", "--iterations", "10", "--threads", "1"]  # it knows the coarse one
    assert main(["train", str(tmp_path / "parts" / "part1"), *longer]) == 0
    capsys.readouterr()
    out = tmp_path / "polished.ply"
    assert main(["merge", *runs, "--out", str(out), "--scene", str(city), "--polish", "4"]) == 0
    assert "polished: 4 steps" in capsys.readouterr().out
    polished = out.read_bytes()
    out = tmp_path / "scene.ply"
    rest = ["--scene", str(city), "--polish", "0", "--whole", runs[0]]
    assert main(["merge", *runs, "--out", str(out), *rest]) == 0
    assert out.read_bytes() != polished
    told = capsys.readouterr().out
    assert "| run" in told
    assert "PSNR (dB) on the held-out photos" in told
    part = read_part(Path(runs[0]))
    assert part is not None
    shutil.rmtree(tmp_path / "parts")  # the runs say all that is needed
    again = merge(runs, tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == out.read_bytes()
    own = again.part_of
    means = again.model.means.numpy()[: len(own)]
    np.testing.assert_array_equal(cell_of(part.cells, means), own)
