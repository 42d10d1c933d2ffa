"""Mistakes of the first ten minutes: each one sentence that says what to do, and nothing is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fixtures_scenes import make_truth, write_colmap, write_photos, write_transforms

from hqgs.cli.main import main
from hqgs.model.gaussians import Gaussians

TRAIN = "train scene --out run"
MISTAKES = {
    "trian scene --out run": "did you mean 'train'?",
    "train": "missing: SCENE --out DIR",
    "train scene": "missing: --out DIR",
    "train scnee --out run": "did you mean {root}/scene?",
    "train embeded --out run": "did you mean the built-in embedded?",
    "train https://a.b/photos.zip --out run": "is a web address: download it",
    "train photos/view_00.png photos/view_01.png --out run": "photos/view_01.png; give their folder",
    "train scene/transforms.json --out run": "a folder with photos, or a film: did you mean {root}/scene?",
    "train colmap/sparse --out run": "has a COLMAP model but no photos",
    "train colmap/sparse/0 --out run": "has a COLMAP model but no photos: looked for ",
    "train a.ply --out run": "is a trained scene file, which hqgs view shows",
    "train raws --out run": "holds no photos, but a.CR2: raw photos: develop them to JPEG",
    "train films --out run": "holds no photos, but a.mp4, b.MOV: several films: give one of them",
    "train film --out run": "a.mp4 cannot be read: it is not a film, or damaged",
    "train -s scene -m run": "there is no -s: write hqgs train PHOTOS --out RUN",
    "train photos.zip --out run": "is an archive: unpack it, and give the folder with the photos",
    "train photos/view_00.png --out run": "is a file; wanted a folder with photos, or a film",
    "train empty --out run": "is empty: give a folder with photos",
    "train texts --out run": "holds no photos (.png, ",
    "train two --out run": "needs at least 3 photos, got 2: 20 to 100 that overlap make a good scene",
    "train scene more --out run": "one argument too many: more",
    "train scene --out scene": "is the folder of the photos: name another folder for the run",
    "train scene --out others/../scene/.": "is the folder of the photos: name another folder for the run",
    "train scene --out notes.txt": "is a file: name a folder",
    "train scene --out others": "holds config.json, not of a run, which a run would overwrite: name another",
    f"{TRAIN} --overwrte": "there is no option --overwrte - did you mean --overwrite",
    f"{TRAIN} --foo 1 2": "there is no option --foo (hqgs train --help)",
    f"{TRAIN} --config.lr-sh0 q": "--config.lr-sh0 is q, wanted a number",
    "--iterations 3": "there is no option '--iterations'",
    f"{TRAIN} --device cuda": "there is no --device: hqgs runs on the CPU",
    f"{TRAIN} --gpu": "there is no --gpu: hqgs runs on the CPU; leave this option out",
    f"{TRAIN} --iterations 0": "iterations is 0, wanted at least 1",
    f"{TRAIN} --iterations 1e4": "--iterations is 1e4, wanted a whole number",
    f"{TRAIN} --iterations 9 --seconds 5": "give only one of --iterations and --seconds",
    f"{TRAIN} --preset fast": "--preset is fast, wanted one of: 'quick', 'standard', 'best'",
    f"{TRAIN} --method gaussian": "unknown method 'gaussian'; the methods are: ",
    f"{TRAIN} --downscale 0.5": "downscale must be at least 1, got 0.5",
    f"{TRAIN} --degrade jpg:10": "unknown degradation 'jpg'; there are: jpeg, ",
    f"{TRAIN} --degrade jpeg:1000": "jpeg is 1000, wanted a quality, an integer in 1..95",
    f"{TRAIN} --distance view_00.png 2": "Missing value for argument '--distance'. Expected 3 values.",
    f"{TRAIN} --distance view_00 view_77 2": "no photo with a camera is called 'view_77', or several are",
    f"{TRAIN} --up 0 0 0": "up is [0.0, 0.0, 0.0], wanted three numbers x, y, z that are not all 0",
    f"{TRAIN} --frames 9": "frames is for films, and {root}/scene is not a film: all of its photos are used",
    f"{TRAIN} --test-every 1": "all 9 photos are held out, none is left to train on",
    f"{TRAIN} --leave-out phtos": "unknown 'phtos'; wanted auto, none, or some of photos, ",
    f"{TRAIN} --config missing.json": "there is no configuration missing.json",
    f"{TRAIN} --restore missing.pth": "there is no file of weights missing.pth",
    "view nowhere": "there is no nowhere: give the folder of a run, or a scene file",
    "view photos": "there is no photos/scene.ply: give the folder of a run, or a scene file",
    "view unfinished": "unfinished holds an unfinished run without a scene: hqgs train PHOTOS --out",
    "view a.ply --port a": "--port is a, wanted a whole number",
    "view a.ply --port 99999": "port is 99999, wanted 0..65535",
    "render a.ply --out film.txt": "film.txt is not a folder; films are .mp4 or .gif, a single picture",
    "render a.ply --out photos": "--out photos holds photos (view_00.png, view_01.png, ",
    "render a.ply --out b.png --path round": "no such file, and none of: cameras, orbit",
    "export a.ply --out a.ply": "is the source a.ply itself: name another file, or what is left",
    "export a.ply --out a.obj": "unknown suffix; wanted .ply, ",
    "export half.ply --out b.ply": "half.ply: not a PLY file",
    "export a.ply --out b.ply --downscale 2": "--downscale is for the photos of --scene: give",
    "export a.ply --out b.spz --sh-bits 8 q": "--sh-bits is 8 q, wanted two whole numbers",
    "export a.ply --out b.ply --sh-bits 6 3": "--sh-bits is for spz, and --out b.ply says ply",
    "export a.ply --out b --format glb --spz-version 4": "--spz-version is for spz, and --format says glb",
    "export a.ply --out b.ply --scene photos": "photos has no cameras, and newly found ones would not be in",
    "render a.ply --out b.png --views all --frames 3": "--frames is for paths, and --views uses the photos'",
    "render a.ply --out b.png --views all --path orbit": "--path is for paths, and --views uses the photos'",
    "render a.ply --out b.png --views all --up 0 0 1": "--up is for paths, and --views uses the photos'",
    "render a.ply --out b.png --background 255 0 0": "--background is 255 0 0, wanted three numbers in 0..1",
    "render a.ply --out b.png --background nan 0 0": "--background is nan 0 0, wanted three numbers in 0..1",
    "render a.ply --out b.mp4 --path path.json --up 0 0 1": "--up is for an orbit; a path file has its own",
    "render a.ply --out b.png --up 0 q 0": "--up is 0 q 0, wanted three numbers",
    "render a.ply --out b.png --up 0 0 0": "up is [0.0, 0.0, 0.0], wanted a direction",
    "render a.ply --out notes.txt/a.gif": "--out notes.txt/a.gif is inside {root}/notes.txt, which",
    "judge a.ply --photos scene --background nan 0 0": "--background is nan 0 0, wanted three numbers in",
    "judge a.ply --photos nowhere --out notes.txt": "--out notes.txt is a file: name a folder",
    "judge a.ply --photos nowhere --out notes.txt/a": "--out notes.txt/a is inside {root}/notes.txt",
    "diagnose nowhere --out empty": "--out empty is a folder: name the file to write",
    "plan photos --out nowhere": "--out nowhere: there is no run; leave --out away",
    "plan photos --test-every 1": "no photo is left to train on",
    "clean a.ply --out b.ply": "give --photos, a folder of photos",
    "degrade scene --kind noise:25 --out photos": "photos exists and is not an empty folder",
    "degrade x --out y --degrade blur:2": "missing: --kind KIND; there is no option --degrade (h",
    "diagnose x.zip": "there is no scene folder",
    "diagnose nowhere": "there is no scene folder {root}/nowhere",
    "sfm films --out run": "several films: give one of them",
    "sfm photos --out others": "others exists and is not an empty folder",
}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a newcomer's folder may hold."""
    root = tmp_path_factory.mktemp("first")
    write_transforms(make_truth(), root / "scene")
    write_colmap(make_truth(), root / "colmap")
    write_photos(make_truth(), root / "photos")
    write_photos(make_truth(2), root / "two")
    for name in ("empty", "texts", "others", "raws", "films", "film", "unfinished"):
        (root / name).mkdir()
    for name in (
        "texts/a.txt",
        "notes.txt",
        "photos.zip",
        "half.ply",
        "others/config.json",
        "raws/a.CR2",
        "films/a.mp4",
        "films/b.MOV",
        "film/a.mp4",
        "unfinished/config.json",
        "unfinished/checkpoint.safetensors",
    ):
        (root / name).write_text("ply")
    points = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    Gaussians.from_points(points, np.zeros((9, 3), np.uint8), 0).save(root / "a.ply")
    return root


@pytest.mark.parametrize(("command", "told"), MISTAKES.items(), ids=MISTAKES)
def test_a_mistake_is_one_sentence_and_nothing_is_written(
    command: str, told: str, root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(root)
    before = held(root)
    try:
        code = main(command.split())
    except SystemExit as end:
        code = end.code
    *earlier, line = capsys.readouterr().err.splitlines()
    assert code == 2
    assert all(said.endswith("no camera in EXIF") for said in earlier)  # of photos that were counted
    assert line.startswith("hqgs: ")
    assert "│" not in line
    assert told.format(root=root) in line
    assert held(root) == before


def held(root: Path) -> dict[Path, bytes | None]:
    return {path: path.read_bytes() if path.is_file() else None for path in root.rglob("*")}
