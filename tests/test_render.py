"""`hqgs render` and `hqgs.render_frames`: the files hold what the rasterizer sees."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image
from tiny_scene import HEIGHT, WIDTH, tiny_config, tiny_scene

import hqgs
from hqgs.cli import main as cli
from hqgs.model.formats.arrays import curve_order
from hqgs.scene.camera_files import KnownCamera, load_cameras, picked, save_path
from hqgs.scene.paths import with_size
from hqgs.show import frames, trust


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 30 steps."""
    out = tmp_path_factory.mktemp("run")
    hqgs.train(tiny_scene(), out=out, config=tiny_config())
    return out


def render(*arguments: str | float | Path) -> int:
    try:
        return cli.main(["render", *map(str, arguments)])
    except SystemExit as end:  # of the parser
        return int(end.code or 0)


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def expected(folder: Path, camera: hqgs.Camera, background: tuple[float, ...] = (0, 0, 0)) -> np.ndarray:
    with torch.no_grad():
        image = hqgs.Gaussians.load(folder).render(camera, background=background)
    return (255 * image.clamp(0, 1)).round().byte().numpy()


def test_given_views(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = load_cameras(folder)
    assert render(folder, "--views", "train", "--out", tmp_path / "train") == 0
    written = sorted((tmp_path / "train").iterdir())
    assert [file.name for file in written] == [f"{k:03}_view{k + 1}.png" for k in range(5)]
    for file, camera in zip(written, known.train, strict=True):
        assert np.array_equal(pixels(file), expected(folder, camera))
    assert f"{tmp_path / 'train'}: 5 frames, 24 x 16 px, " in capsys.readouterr().out
    assert render(folder, "--views", "view0.png", "--background", 1, 1, 0.5, "--out", tmp_path / "a.png") == 0
    assert np.array_equal(pixels(tmp_path / "a.png"), expected(folder, known.test[0], (1, 1, 0.5)))
    assert render(folder, "--views", "view3,view0", "--out", tmp_path / "two") == 0
    assert len(list((tmp_path / "two").iterdir())) == 2
    assert render(folder, "--views", "view3.png, view0", "--out", tmp_path / "two") == 0  # over them
    assert len(list((tmp_path / "two").iterdir())) == 2


def test_a_film(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "a.mp4"
    assert render(folder, "--frames", "7", "--fps", "12.5", "--size", "65", "48", "--out", out) == 0
    with av.open(str(out)) as film:
        assert film.streams.video[0].average_rate == 12.5
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert [frame.shape for frame in frames] == [(48, 64, 3)] * 7
    path = hqgs.camera_path(load_cameras(folder).train, 7)
    large = with_size(path[3], 65, 48)
    away = np.abs(frames[3].astype(float) - expected(folder, large)[:, :64])
    assert away.mean() < 6  # 4:2:0 chroma of a small picture
    assert np.abs(frames[3].astype(float) - frames[0]).mean() > 2 * away.mean() / 6


def test_a_gif_and_a_path_file(folder: Path, tmp_path: Path) -> None:
    path = [with_size(c, 48, 32) for c in hqgs.orbit(load_cameras(folder).train, 5)]
    save_path(tmp_path / "path.json", path, fps=10)
    assert render(folder, "--path", tmp_path / "path.json", "--out", tmp_path / "a.gif") == 0
    gif = Image.open(tmp_path / "a.gif")
    assert (gif.n_frames, gif.size, gif.info["duration"]) == (5, (48, 32), 100)  # type: ignore[attr-defined]
    gif.seek(2)
    away = np.abs(np.asarray(gif.convert("RGB"), float) - expected(folder, path[2]))
    assert away.mean() < 4  # 256 colours


def test_depth_and_alpha(folder: Path, tmp_path: Path) -> None:
    known, model = load_cameras(folder), hqgs.Gaussians.load(folder)
    assert render(folder, "--views", "test", "--show", "alpha", "--out", tmp_path / "a.png") == 0
    with torch.no_grad():
        seen = model.render(known.test[0], background=(0, 0, 0)) - model.render(
            known.test[0], background=(1, 1, 1)
        )
    alpha = (255 * (1 + seen).clamp(0, 1)).round().byte().numpy()
    assert np.abs(pixels(tmp_path / "a.png").astype(int) - alpha).max() <= 1
    assert render(folder, "--show", "depth", "--out", tmp_path / "d", "--frames", "3") == 0
    pictures = [pixels(file) for file in sorted((tmp_path / "d").iterdir())]
    assert len(pictures) == 3
    assert all(len(np.unique(picture)) > 8 for picture in pictures)


def test_near_is_red_and_far_is_blue() -> None:
    from hqgs.show.frames import depth_picture, depth_range

    depth = np.linspace(2, 10, 101, dtype=np.float32)[None]
    alpha = np.ones_like(depth)
    alpha[0, 50] = 0
    picture = depth_picture(depth, alpha, depth_range([(depth, alpha)]))[0].astype(int)
    assert picture[4, 0] > 2 * picture[4, 2]
    assert picture[92, 2] > picture[92, 0]
    assert picture[50].tolist() == [0, 0, 0]
    assert depth_range([(depth, 0 * alpha)]) == (1, 2)


def test_a_bare_file_gets_an_orbit(folder: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.ply"
    hqgs.Gaussians.load(folder).save(bare)
    assert render(bare, "--out", tmp_path / "o", "--frames", "4", "--size", "40", "30") == 0
    assert {pixels(file).shape for file in (tmp_path / "o").iterdir()} == {(30, 40, 3)}
    assert max(pixels(file).max() for file in (tmp_path / "o").iterdir()) > 20  # a young scene is thin
    assert render(bare, "--out", tmp_path / "o2", "--frames", "2", "--up", "0", "0", "1") == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--views", "nobody"], "--views: the run has no photo 'nobody'; there are: train, test, all, view0"),
        (["--path", "no.json"], "--path is 'no.json': no such file, and none of: cameras, orbit"),
        (["--up", "0", "0", "1"], "--up is for an orbit (--path orbit); a path through the cameras is level"),
        (["--frames", "0"], "frames is 0, wanted at least 1"),
        (["--fps", "fast"], "--fps is fast, wanted a number"),
        (["--fps", "0"], "fps is 0.0, wanted a number above 0"),
        (["--show", "normals"], "--show is normals, wanted one of: 'color', 'depth', 'alpha'"),
        (["--size", "7", "x"], "--size is 7 x, wanted two whole numbers"),
        (["--size", "0", "4"], "the size is 0 x 4, wanted at least 1 x 1"),
        (["--out", "folder.gif"], "folder.gif is a folder: name a file, or a folder without .gif"),
        (["--out", "a.mp4"], "no PyAV"),
        (["--out", "a.mp4", "--size", "1", "8"], "a film has sides of at least 2 px, these are 1 x 8"),
        (["--look", "nobody"], "{folder}: no exposure, vignetting or response was learned"),
        (["--look", "view0", "--show", "depth"], "--look is for --show color, and --show is depth"),
        (["--views", "train", "--out", "x.png"], "x.png holds one picture, and there are 5"),
    ],
)
def test_bad_input_is_one_line(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    def early(*_: object) -> None:
        raise AssertionError("the photos were measured first")

    def missing(_: str) -> None:
        raise ValueError("no PyAV")

    monkeypatch.setattr(trust, "trust_of", early)
    monkeypatch.setattr(frames, "pyav", missing)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.gif").mkdir()
    assert render(folder, "--out", tmp_path / "out", *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"hqgs: {message.format(folder=folder)}")
    assert list(tmp_path.glob("*.png")) == []


def test_sources_without_cameras(tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert render(tmp_path, "--out", tmp_path / "a.gif") == 2
    assert "there is no" in capsys.readouterr().err
    hqgs.Gaussians.load(folder).save(tmp_path / "a.ply")
    assert render(tmp_path / "a.ply", "--views", "test", "--out", tmp_path / "x") == 2
    assert "has no cameras.json" in capsys.readouterr().err


def test_names_with_commas_and_spaces() -> None:
    camera = hqgs.look_at((0, 0, 0), (0, 0, 3))
    names = ("a.jpg", "b, small.jpg", "c.jpg")
    views = [KnownCamera(name, camera, held_out=False, photo=None) for name in names]
    for which, found in (("b, small.jpg", [1]), ("b, small", [1]), ("c, a.jpg", [2, 0]), ("all", [0, 1, 2])):
        assert picked(views, [], which, "the run") == [views[k] for k in found]
    with pytest.raises(ValueError, match="has no photo 'b'"):
        picked(views, [], "a,b", "the run")


def test_pictures_do_not_go_among_the_photos_of_the_run(
    tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, photos = shutil.copytree(folder, tmp_path / "run"), tmp_path / "photos"
    photos.mkdir()
    assert render(run, "--frames", 2, "--out", photos) == 0  # an empty folder, then one of pictures
    assert render(run, "--frames", 2, "--out", photos) == 0
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | {"scene": {"path": str(photos.resolve())}}))
    before = sorted(photos.iterdir())
    assert render(run, "--frames", 3, "--out", photos) == 2
    assert "holds photos (00000.png, 00001.png): name another" in capsys.readouterr().err
    assert sorted(photos.iterdir()) == before


def test_films_of_mixed_sizes_and_unknown_kinds(folder: Path, tmp_path: Path) -> None:
    model = hqgs.Gaussians.load(folder)
    small = hqgs.look_at((0, 0, 0), (0, 0, 3), width=WIDTH, height=HEIGHT)
    other = hqgs.look_at((0, 0, 0), (0, 0, 3), width=WIDTH, height=HEIGHT + 1)
    with pytest.raises(ValueError, match="one size, these cameras have 24 x 16 and 24 x 17 px"):
        hqgs.render_frames(model, [small, other], tmp_path / "a.gif")
    with pytest.raises(ValueError, match="show is 'normals', wanted one of: color, depth, alpha"):
        hqgs.render_frames(model, [small], tmp_path / "a.png", show="normals")
    with pytest.raises(ValueError, match="there is no camera"):
        hqgs.render_frames(model, [], tmp_path / "a.png")
    with pytest.raises(
        ValueError, match=r"a\.mov is not a folder; films are \.mp4 or \.gif, a single picture"
    ):
        hqgs.render_frames(model, [small], tmp_path / "a.mov")
    assert list(tmp_path.iterdir()) == []


def test_neighbours_come_together_whatever_lies_far_out() -> None:
    torch.manual_seed(0)
    points = torch.rand(4096, 3)
    points[7], points[8] = 1e6, torch.nan
    order = torch.from_numpy(curve_order(points.numpy()))
    assert torch.equal(order.sort().values, torch.arange(4096))
    steps = points[order].diff(dim=0).norm(dim=1).nanmedian()
    assert steps < 0.2 * points.diff(dim=0).norm(dim=1).nanmedian()  # 4,096 fill a cube at a spacing of 1/16
    assert not len(curve_order(np.zeros((0, 3))))
