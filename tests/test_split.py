"""A scene cut into parts: cells, photos, points, and the folders that are trained."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from fixtures_scenes import make_truth, write_colmap
from PIL import Image

from benchmarks.parts import write_city
from hqgs.cli.main import main
from hqgs.scene import part_folders
from hqgs.scene.cells import Cells, Cut, cell_of, count, cut_space, sight_shares
from hqgs.scene.formats import colmap_stream
from hqgs.scene.formats.part_json import read_part
from hqgs.scene.listing import some_views
from hqgs.scene.load import load_scene
from hqgs.scene.split import Split, split

QUARTERS = Cut((1.0, 0.0, 0.0), 0.0, Cut((0.0, 1.0, 0.0), 1.0, 0, 1), Cut((0.0, 1.0, 0.0), -1.0, 2, 3))
PHOTOS, POINTS, PARTS = 36, 1440, 4  # of the city: 40 points in each block, shown by three photos


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("split") / "city"
    write_city(root, PHOTOS, POINTS)
    return root


@pytest.fixture(scope="module")
def made(city: Path) -> Split:
    return split(city, city.parent / "parts", PARTS, test_every=4)


def part(made: Split, k: int) -> Path:
    return made.folder / made.parts[k].folder


def model(folder: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(folder / "sparse" / "0")


def test_each_point_of_space_lies_in_one_cell() -> None:
    inside = np.array([[-1, 0, 9], [-1, 2, 9], [1, -2, -9], [1, 0, 1e6]])
    assert cell_of(QUARTERS, inside).tolist() == [0, 1, 2, 3]
    assert cell_of(QUARTERS, np.array([[0.0, -1.0, 0.0]])).tolist() == [3]  # on two planes
    far = np.random.default_rng(0).normal(size=(500, 3)) * 1e9
    x, y = far[:, 0] >= 0, np.where(far[:, 0] >= 0, far[:, 1] >= -1, far[:, 1] >= 1)
    np.testing.assert_array_equal(cell_of(QUARTERS, far), 2 * x + y)


@pytest.mark.parametrize("parts", [1, 2, 3, 5, 8])
def test_cuts_balance_photos_and_points(parts: int) -> None:
    rng = np.random.default_rng(parts)
    places, points = rng.normal(size=(400, 3)) * (5, 3, 0.1), rng.normal(size=(4000, 3)) * (9, 9, 1)
    cells = cut_space(places, points, parts)
    assert count(cells) == parts
    shares = sum(np.bincount(cell_of(cells, rows), minlength=parts) / len(rows) for rows in (places, points))
    np.testing.assert_allclose(shares, 2 / parts, rtol=0.1)


def test_the_first_cut_runs_across_the_longest_side() -> None:
    places = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * (1, 8, 0.5)
    cells = cut_space(places, places, 2)
    assert isinstance(cells, Cut)
    assert cells.normal[1] > 0.99


def test_one_place_cannot_be_cut() -> None:
    with pytest.raises(ValueError, match="no plane can cut"):
        cut_space(np.ones((9, 3)), np.ones((20, 3)), 2)


def test_lines_of_sight_count_where_they_end_and_where_they_pass() -> None:
    halves: Cells = Cut((1.0, 0.0, 0.0), 0.0, 0, 1)
    center = np.array([-1.0, 0.0, 0.0])
    across, own = np.array([[3.0, 1.0, 0.0]]), np.array([[-0.5, 0.0, 2.0]])
    np.testing.assert_allclose(sight_shares(halves, center, across), [0.25, 1.0])
    np.testing.assert_allclose(sight_shares(halves, center, own), [1.0, 0.0])
    both = np.concatenate([across, own])
    np.testing.assert_allclose(sight_shares(halves, center, both), [0.625, 0.5])
    np.testing.assert_allclose(sight_shares(halves, center, np.zeros((0, 3))), [1.0, 0.0])
    # Through three cells: 1 along x of 3, the rest below or above y = 0.
    line = np.array([[2.0, -2.0, 0.0]])
    thirds = Cut((1.0, 0.0, 0.0), 0.0, 0, Cut((0.0, 1.0, 0.0), -1.0, 1, 2))
    np.testing.assert_allclose(sight_shares(thirds, np.array([-1.0, 1.0, 0.0]), line), [1 / 3, 1, 1 / 3])


def test_each_point_is_in_the_part_whose_cell_it_lies_in(made: Split, city: Path) -> None:
    whole = model(city)
    assert sum(facts.own_points for facts in made.parts) == made.points == POINTS
    for k, facts in enumerate(made.parts):
        own, manifest = model(part(made, k)), read_part(part(made, k))
        assert manifest is not None
        xyz = {number: point.xyz for number, point in whole.points3D.items()}
        cells = cell_of(manifest.cells, np.array([*xyz.values()], np.float32))
        inside = {number for number, cell in zip(xyz, cells, strict=True) if cell == k}
        assert len(inside) == facts.own_points
        photos = {image.name for image in own.images.values()}
        wanted = {
            number
            for number, point in whole.points3D.items()
            if number in inside
            or sum(whole.images[e.image_id].name in photos for e in point.track.elements) >= 2
        }
        assert set(own.points3D) == wanted
        assert facts.points == len(wanted)
        assert len(photos) == facts.train + facts.held_out


def test_a_part_is_a_whole_model(made: Split, city: Path) -> None:
    """Every track and every pixel point at each other, as in the whole; nothing has moved."""
    whole, own = model(city), model(part(made, 1))
    for number, point in own.points3D.items():
        np.testing.assert_array_equal(point.xyz, whole.points3D[number].xyz)
        photos = {e.image_id for e in whole.points3D[number].track.elements} & set(own.images)
        assert {e.image_id for e in point.track.elements} == photos
        for element in point.track.elements:
            assert own.images[element.image_id].points2D[element.point2D_idx].point3D_id == number
    for number, image in own.images.items():
        there = whole.images[number]
        np.testing.assert_array_equal(image.cam_from_world().matrix(), there.cam_from_world().matrix())
        shown = {p.point3D_id for p in there.points2D if p.has_point3D()}
        assert {p.point3D_id for p in image.points2D if p.has_point3D()} == shown & set(own.points3D)


def test_held_out_photos_are_those_of_the_whole(made: Split, city: Path) -> None:
    held_out = {view.name for view in load_scene(city, test_every=4).test}
    seen: set[str] = set()
    for k, facts in enumerate(made.parts):
        scene = load_scene(part(made, k))  # a part has its own choice, whatever it is asked for
        assert {view.name for view in scene.test} == held_out & {v.name for v in scene.train + scene.test}
        assert (len(scene.train), len(scene.test)) == (facts.train, facts.held_out)
        assert scene.part is not None
        assert f"part {k + 1} of 4 of city" in scene.notes[0]
        seen |= {view.name for view in scene.train + scene.test}
    assert len(seen) == PHOTOS


def test_the_same_scene_gives_the_same_parts(
    made: Split, city: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(colmap_stream, "PIECE", 3000)  # bytes: dozens of pieces, and records across them
    again = split(city, city.parent / "again", PARTS, test_every=4, copy=True)
    assert again.parts == made.parts
    for k in range(PARTS):
        for name in ("part.json", *(f"sparse/0/{kind}.bin" for kind in ("cameras", "images", "points3D"))):
            assert (part(made, k) / name).read_bytes() == (part(again, k) / name).read_bytes()
    photo = next((part(again, 0) / "images").iterdir())
    assert not photo.is_symlink()
    assert (part(made, 0) / "images" / photo.name).is_symlink()
    other = split(city, city.parent / "other", PARTS + 1, test_every=4)
    ids = {json.loads((made.folder / "parts.json").read_text())["split"] for made in (made, again, other)}
    assert len(ids) == 2


def test_ids_in_no_order(made: Split, city: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ids far apart are sought in place of a table; the parts are the same."""
    monkeypatch.setattr(part_folders, "DENSE", -1000)
    again = split(city, city.parent / "sought", PARTS, test_every=4)
    first = "sparse/0/images.bin"
    assert (part(made, 2) / first).read_bytes() == (part(again, 2) / first).read_bytes()


def test_without_tracks_photos_have_what_lies_in_their_frame(tmp_path: Path) -> None:
    truth = make_truth()
    root = write_colmap(truth, tmp_path / "scene", binary=False)
    made = split(root, tmp_path / "parts", 2, test_every=0)
    assert sum(facts.own_points for facts in made.parts) == len(truth.points)
    for facts in made.parts:
        scene = load_scene(made.folder / facts.folder, test_every=3)
        assert not scene.test
        assert scene.seen is None


def test_masks_scaled_photos_and_degraded_ones_come_along(tmp_path: Path) -> None:
    root = write_colmap(make_truth(), tmp_path / "scene")
    assert main(["degrade", str(root), "--kind", "lowres:2", "--out", str(tmp_path / "bad")]) == 0
    bad = tmp_path / "bad"
    (bad / "images_2").mkdir()
    for photo in sorted((bad / "images").iterdir()):
        (bad / "images_2" / photo.name).write_bytes(photo.read_bytes())
    (bad / "masks").mkdir(exist_ok=True)
    first = sorted((bad / "images").iterdir())[1].name
    Image.new("L", (48, 36), 255).save(bad / "masks" / first)
    made = split(bad, tmp_path / "parts", 2)
    folders = [made.folder / facts.folder for facts in made.parts]
    assert any((folder / "masks" / first).is_symlink() for folder in folders)
    whole = {view.name: view for view in load_scene(bad).train}
    for folder in folders:
        scene = load_scene(folder)
        for view in scene.train:
            np.testing.assert_array_equal(view.low, whole[view.name].low)
        assert load_scene(folder, downscale=2).train[0].camera.width == 48  # images_2, as it is


def test_views_of_a_list_are_those_of_the_scene(city: Path) -> None:
    scene = load_scene(city, test_every=4)
    views = [*some_views(city, [view.name for view in scene.test])]
    assert [view.name for view in views] == [view.name for view in scene.test]
    for view, wanted in zip(views, scene.test, strict=True):
        np.testing.assert_array_equal(view.image, wanted.image)
        np.testing.assert_array_equal(view.camera.K, wanted.camera.K)
        np.testing.assert_allclose(view.camera.viewmat, wanted.camera.viewmat, atol=1e-12)
    with pytest.raises(ValueError, match=r"no photo nobody\.jpg"):
        next(some_views(city, ["nobody.jpg"]))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--parts", "0"], "parts is 0, wanted 1..256"),
        (["--parts", "257"], "parts is 257, wanted 1..256"),
        (["--parts", "40"], "parts is 40, and"),
        (["--parts", "2", "--test-every", "-1"], "test_every must be at least 0, got -1"),
    ],
)
def test_bad_numbers(
    city: Path, tmp_path: Path, options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["split", str(city), "--out", str(tmp_path / "new"), *options]) == 2
    assert words in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


def test_what_cannot_be_split(city: Path, made: Split, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is part 1 of 4 of city"):
        split(part(made, 0), tmp_path / "new", 2)
    with pytest.raises(ValueError, match="holds no COLMAP model"):
        split(city / "images", tmp_path / "new", 2)
    with pytest.raises(FileExistsError):
        split(city, made.folder, 2)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("change", [-5, 3])
def test_damaged_models_are_named_and_leave_nothing(
    city: Path, tmp_path: Path, name: str, change: int
) -> None:
    sparse = tmp_path / "scene" / "sparse" / "0"
    sparse.mkdir(parents=True)
    (tmp_path / "scene" / "images").symlink_to(city / "images")
    for file in (city / "sparse" / "0").iterdir():
        data = file.read_bytes()
        if file.stem == name:
            data = data[:change] if change < 0 else data + b"x" * change
        (sparse / file.name).write_bytes(data)
    with pytest.raises(ValueError, match=rf"{name}\.bin is damaged"):
        split(tmp_path / "scene", tmp_path / "new", 2)
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_a_stopped_split_leaves_nothing(city: Path, tmp_path: Path) -> None:
    def stop(stage: object) -> None:
        if getattr(stage, "what", "") == "parts written":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        split(city, tmp_path / "new", 2, told=stop)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    "change",
    [
        {"version": 2},
        {"part": 4},
        {"cells": 0},
        {"cells": {"normal": [1, 0], "offset": 0, "below": 0, "above": 1}},
        {"held_out": "a.jpg"},
        {"more": 1},
    ],
)
def test_a_damaged_manifest_is_named(made: Split, tmp_path: Path, change: dict[str, object]) -> None:
    facts = json.loads((part(made, 0) / "part.json").read_text())
    (tmp_path / "part.json").write_text(json.dumps(facts | change))
    with pytest.raises(ValueError, match=r"part\.json is damaged"):
        read_part(tmp_path)
