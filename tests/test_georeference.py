"""Scale, up and place of a scene from the GPS of its photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fixtures_photos import exif
from fixtures_scenes import make_truth, write_colmap
from PIL import Image
from scipy.spatial.transform import Rotation

from hqgs.photos.exif import Exif, read_exif
from hqgs.scene.georeference import Gps, georeference
from hqgs.scene.load import load_scene
from hqgs.scene.sfm.bare_photos import ups

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
