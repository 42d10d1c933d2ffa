"""Scale, up and place of a scene from GPS, and scenes in metres by `--distance A B METRES`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures_photos import exif
from fixtures_scenes import make_truth, write_colmap, write_transforms
from PIL import Image
from plyfile import PlyData
from scipy.spatial.transform import Rotation
from test_world import placed

import hqgs
from hqgs.cli.main import main
from hqgs.cli.parse import parse
from hqgs.cli.train import Train
from hqgs.model.gaussians import Gaussians
from hqgs.photos.exif import Exif, read_exif
from hqgs.scene.camera_files import load_cameras, save_cameras
from hqgs.scene.georeference import Gps, georeference
from hqgs.scene.load import load_scene
from hqgs.scene.metres import distance_of, point_of
from hqgs.scene.sfm.bare_photos import ups
from hqgs.scene.world import World

NORTH, EAST = 48.5, 9.06
METRES = 111_194.0, 73_780.0  # of a degree there; 0.2 % off, by a sphere


def draw(seed: int, count: int, noise: float, wrong: int = 0) -> tuple[np.ndarray, list[Gps], np.ndarray]:
    """Camera centres in a turned frame, 20 m to the unit, and their GPS; up in that frame."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(count, 3)) * [1, 1, 0.3]
    R = Rotation.random(None, np.random.default_rng(seed)).as_matrix()
    metres = 20 * centers + rng.normal(size=(count, 3)) * np.array([1, 1, 2]) * noise
    metres[:wrong] += rng.normal(size=(wrong, 3)) * 200
    gps = [(NORTH + y / METRES[0], EAST + x / METRES[1], 320 + z) for x, y, z in metres.tolist()]
    return centers @ R, gps, R[2]


@pytest.mark.parametrize(("count", "wrong"), [(5, 0), (30, 7)])
def test_true_scale_and_up_lie_in_their_intervals(count: int, wrong: int) -> None:
    hits, upright = list[bool](), list[bool]()
    for seed in range(100):
        centers, gps, up = draw(seed, count, 1.0, wrong)
        found = georeference(centers, gps)
        hits.append(found is not None and found.interval[0] <= 20 <= found.interval[1])
        if found is None:
            continue
        assert found.tilt is not None
        upright.append(bool(np.degrees(np.arccos(np.clip(up @ found.up, -1, 1))) < found.tilt))
        if count == 30:
            assert found.tilt < 10
            np.testing.assert_allclose(found.origin[:2], [NORTH, EAST], atol=3e-5)
    assert sum(hits) >= 90
    assert np.mean(upright) >= 0.9


def test_what_gps_cannot_tell_is_not_told() -> None:
    centers, gps, _ = draw(0, 12, 0.0)
    assert georeference(centers, gps) is not None
    assert georeference(centers[:3], gps[:3]) is None
    assert georeference(centers, gps[:3] * 4) is None  # three places
    assert georeference(*draw(1, 12, 40.0)[:2]) is None
    assert georeference(np.outer(np.arange(12.0), [1, 2, 3]), gps) is None  # on a line


def place_of(east: float, north: float, height: float) -> dict[int, object]:
    """EXIF's GPS so many metres from the origin."""
    north, east = NORTH + north / METRES[0], EAST + east / METRES[1]
    return {1: "N", 2: (north, 0.0, 0.0), 3: "E", 4: (east, 0.0, 0.0), 5: b"\0", 6: height}


def test_photos_with_gps_say_where_the_scene_is(tmp_path: Path) -> None:
    truth = make_truth(suffix=".jpg")
    root = write_colmap(truth, tmp_path, binary=False)
    for name, viewmat in zip(truth.names, truth.viewmats, strict=True):
        x, y, z = (-viewmat[:3, :3].T @ viewmat[:3, 3]).tolist()  # 5 m to the unit; up is -y, north z
        with Image.open(root / "images" / name) as photo:
            photo.save(root / "images" / name, exif=exif(gps=place_of(5 * x, 5 * z, 320 - 5 * y)))
    scene = load_scene(root)
    assert scene.place is not None
    assert scene.world.place == scene.place
    assert scene.place.scale == pytest.approx(5, rel=0.01)
    assert scene.place.origin == pytest.approx([NORTH, EAST, 320], abs=0.1)
    np.testing.assert_allclose(scene.place.up, [0, -1, 0], atol=0.05)
    assert scene.notes[-1].startswith("GPS of 9 of 9 photos: a unit is 5")


def xmp(above: float, pitch: float, roll: float = 0.0) -> bytes:
    """As DJI's drones write it."""
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description rdf:about="DJI Meta Data" '
        f'drone-dji:AbsoluteAltitude="+151.2" drone-dji:RelativeAltitude="{above:+.2f}" '
        f'drone-dji:GimbalRollDegree="{roll:+.2f}" drone-dji:GimbalPitchDegree="{pitch:+.2f}"/></x:xmpmeta>'
    ).encode()


def test_drones_tell_their_height_and_how_the_camera_was_held(tmp_path: Path) -> None:
    """GPS heights are 20 m off in turn; the barometer's are right."""
    truth = make_truth(12, ".jpg")
    root = write_colmap(truth, tmp_path, binary=False)
    for k, (name, viewmat) in enumerate(zip(truth.names, truth.viewmats, strict=True)):
        x, y, z = (-viewmat[:3, :3].T @ viewmat[:3, 3]).tolist()
        tags = exif(gps=place_of(50 * x, 50 * z, 320 - 50 * y + 20 * (-1) ** k))
        with Image.open(root / "images" / name) as photo:
            photo.save(root / "images" / name, exif=tags, xmp=xmp(80 - 50 * y, -37.5))
    found = read_exif(root / "images" / truth.names[0])
    assert found.pitch == -37.5
    place = load_scene(root).place
    assert place is not None
    assert place.scale == pytest.approx(50, rel=3e-3)
    assert place.residual < 1
    np.testing.assert_allclose(place.up, [0, -1, 0], atol=3e-3)
    level, steep, down = ups([Exif(), Exif(pitch=-30.0), Exif(pitch=-90.0)])
    np.testing.assert_allclose(level, [0, -1, 0])
    np.testing.assert_allclose(steep, [0, -np.cos(np.pi / 6), -0.5])
    np.testing.assert_allclose(down, [0, 0, -1], atol=1e-12)  # ahead is down
    Image.new("RGB", (64, 48)).save(tmp_path / "rolled.jpg", xmp=xmp(80, -37.5, 12))
    assert read_exif(tmp_path / "rolled.jpg").pitch is None


# --- `--distance A B METRES`: the same scene, written in metres


A, B = "view_01.png", "view_06.png"


@pytest.mark.parametrize("away", [0.0, 5e6])
def test_what_is_written_is_in_metres_and_nothing_else_changes(tmp_path: Path, away: float) -> None:
    truth = make_truth()
    viewmats = truth.viewmats.copy()
    for viewmat in viewmats:
        viewmat[:3, 3] -= viewmat[:3, :3] @ np.full(3, away)
    truth = replace(truth, viewmats=viewmats, points=truth.points + away)
    centers = np.stack([-v[:3, :3].T @ v[:3, 3] for v in viewmats])
    metres = 7.5 / np.linalg.norm(centers[1] - centers[6])
    root = write_colmap(truth, tmp_path / "scene", binary=False)
    own, scene = hqgs.load(root), hqgs.load(root, distance=(A, B, 7.5))
    assert scene.world.metres == pytest.approx(metres, rel=1e-6)
    np.testing.assert_array_equal(scene.points, own.points)
    for ours, theirs in zip(scene.train, own.train, strict=True):
        np.testing.assert_array_equal(ours.camera.viewmat, theirs.camera.viewmat)
    assert any("7.5 m apart" in note for note in scene.notes)

    model = Gaussians.from_points(scene.points, scene.point_colors, 0)
    model.world = scene.world
    for name in ("a.ply", "a.glb", "a.spz", "a.full.ply"):
        model.save(tmp_path / name)
        read = Gaussians.load(tmp_path / name)
        assert read.world.metres == pytest.approx(metres, rel=1e-6)
        out = read.world.out(read.means.double().numpy())
        np.testing.assert_allclose(out, metres * truth.points, atol=0.01 if name == "a.spz" else 1e-5)
        back = read.in_world(own.world)  # of the same photos, loaded without the distance
        np.testing.assert_allclose(
            back.means, own.points, atol=0.01 if name == "a.spz" else 1e-5, err_msg=name
        )
        np.testing.assert_allclose(back.scales, model.scales, atol=0.07 if name == "a.spz" else 1e-5)
    vertices = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    np.testing.assert_allclose(vertices["x"], metres * truth.points[:, 0], rtol=1e-6, atol=1e-6)
    beside = json.loads((tmp_path / "a.spz.world.json").read_text())
    assert beside["metres"] == pytest.approx(metres, rel=1e-6)
    assert beside["frame"].startswith("metres are unit * x")

    save_cameras(tmp_path / "run", scene)
    content = json.loads((tmp_path / "run" / "cameras.json").read_text())
    told = {view["name"]: np.array(view["world_to_camera"]) for view in content["views"]}
    places = [-told[name][:3, :3].T @ told[name][:3, 3] for name in (A, B)]
    assert np.linalg.norm(places[0] - places[1]) == pytest.approx(7.5, rel=1e-6)
    again = {entry.name: entry.camera.viewmat for entry in load_cameras(tmp_path / "run").views}
    for view in scene.train:
        np.testing.assert_allclose(again[view.name], view.camera.viewmat, atol=1e-8)


@pytest.mark.parametrize("away", [0.0, 5e6])
def test_a_distance_of_points_in_the_frame_of_the_files(tmp_path: Path, away: float) -> None:
    truth = placed(make_truth(), 1e-3, np.full(3, away), seed=2)
    root = write_colmap(truth, tmp_path, binary=False)
    a, b = (",".join(repr(float(x)) for x in point) for point in truth.points[:2])
    apart = np.linalg.norm(truth.points[0] - truth.points[1])
    scene = hqgs.load(root, distance=(a, b, 3.0))
    assert scene.world.metres == pytest.approx(3 / apart, rel=1e-6)
    camera = -truth.viewmats[1, :3, :3].T @ truth.viewmats[1, :3, 3]
    mixed = hqgs.load(root, distance=(a, A, 3.0)).world.metres
    assert mixed == pytest.approx(3 / np.linalg.norm(truth.points[0] - camera), rel=1e-5)
    assert any(
        f"the point {a} and the camera of {A} are 3 m apart" in note
        for note in hqgs.load(root, distance=(a, A, 3.0)).notes
    )
    with pytest.raises(ValueError, match=r"the point .* and the point .* are in one place"):
        hqgs.load(root, distance=(a, f" {a}", 3.0))


def test_points_with_negative_coordinates_on_the_command_line() -> None:
    options = parse(Train, "train", "x", ["a", "--out", "b", "--distance", "-1,2e-3,-3", "-.5,0,1", "2.5"])
    assert options.distance is not None
    assert distance_of(options.distance)[2] == 2.5
    for written, wanted in zip(options.distance[:2], ([-1, 2e-3, -3], [-0.5, 0, 1]), strict=True):
        np.testing.assert_array_equal(point_of(written), wanted)
    assert point_of("1,2.jpg") is None
    assert point_of("1,2") is None


def test_a_photo_may_be_named_without_folder_suffix_or_case(tmp_path: Path) -> None:
    root = write_colmap(make_truth(), tmp_path / "scene", binary=False)
    wanted = hqgs.load(root, distance=(A, B, 2.0)).world
    assert hqgs.load(root, distance=("VIEW_01", "View_06.PNG", 2.0)).world == wanted


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((A, "view_66.png", 1.0), r"no photo with a camera is called 'view_66.png'.* are view_0?6"),
        ((A, A, 1.0), "both photos are 'view_01.png'; name two"),
        ((A, "view_01", 1.0), "are both the photo view_01.png"),
        ((A, B, 0.0), "0 m between view_01.png and view_06.png; it must be more than 0"),
        ((A, B, -3.0), "-3 m between"),
        ((A, B, float("nan")), "nan m between"),
        ((A, B), "takes two photos' names, or points x,y,z, and metres"),
    ],
)
def test_a_distance_that_cannot_be_is_told(
    given: tuple[str | float, ...], words: str, tmp_path: Path
) -> None:
    root = write_colmap(make_truth(), tmp_path / "scene", binary=False)
    with pytest.raises(ValueError, match=words):
        hqgs.load(root, distance=given)  # pyright: ignore[reportArgumentType]


def test_photos_from_one_place_have_no_distance(tmp_path: Path) -> None:
    truth = make_truth()
    viewmats = truth.viewmats.copy()
    viewmats[6] = viewmats[1]
    root = write_colmap(replace(truth, viewmats=viewmats), tmp_path / "scene", binary=False)
    with pytest.raises(ValueError, match=r"view_01.png and the camera of view_06.png are in one place"):
        hqgs.load(root, distance=(A, B, 1.0))


def test_a_wrong_name_among_photos_alone_is_told_before_colmap(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Photos of noise, of which COLMAP would make nothing."""
    rng = np.random.default_rng(0)
    for k in range(4):
        Image.fromarray(rng.integers(0, 256, (30, 40, 3), np.uint8)).save(tmp_path / f"{k}.jpg")
    (tmp_path / "x").mkdir()
    out = tmp_path / "x" / "run"
    wrong = ["train", str(tmp_path), "--out", str(out), "--distance", "0.jpg", "7.jpg", "2.5"]
    assert main(wrong) == 2
    assert "no photo with a camera is called '7.jpg'" in capsys.readouterr().err
    assert not (out / "config.json").exists()


def test_a_run_is_written_in_metres_and_goes_on_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_colmap(make_truth(), tmp_path / "scene", binary=False)
    out = tmp_path / "run"
    call = ["train", str(root), "--out", str(out), "--method", "3dgs", "--test-every", "0"]
    assert main([*call, "--iterations", "4", "--distance", A, B, "7.5"]) == 0
    assert "are 7.5 m apart" in capsys.readouterr().out
    first = json.loads((out / "report.json").read_text())["world"]
    assert first["metres"] == pytest.approx(first["unit"])
    assert main([*call, "--iterations", "6", "--resume"]) == 0
    assert json.loads((out / "report.json").read_text())["world"] == first
    assert Gaussians.load(out / "scene.ply").world == World(first["unit"], (0, 0, 0), first["metres"])


def test_photos_of_all_around_have_their_own_names(tmp_path: Path) -> None:
    """As before COLMAP has worked; the names of their faces mean the same."""
    truth = make_truth()
    root = write_transforms(truth, tmp_path, camera_model="EQUIRECTANGULAR")
    centers = [-v[:3, :3].T @ v[:3, 3] for v in truth.viewmats]
    metres = 7.5 / np.linalg.norm(centers[1] - centers[6])
    for a, b in ((A, "VIEW_06"), (f"images/{A}", "view_06.up.png"), ("view_01.back", B)):
        scene = hqgs.load(root, distance=(a, b, 7.5))
        assert scene.world.metres == pytest.approx(metres, rel=1e-6)
    assert any(
        "the camera of images/view_01.back.png and the camera of images/view_06.png are" in note
        for note in scene.notes
    )
    with pytest.raises(ValueError, match=r"view_01\.png and .*view_01\.back\.png are in one place"):
        hqgs.load(root, distance=(A, "view_01.back", 7.5))
