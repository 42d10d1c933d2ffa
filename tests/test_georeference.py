"""Scale, up and place of a scene from the GPS of its photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fixtures_scenes import make_truth, write_colmap
from PIL import Image
from scipy.spatial.transform import Rotation

from hqgs.scene.georeference import Gps, georeference
from hqgs.scene.load import load_scene

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
def test_the_true_scale_lies_in_the_interval(count: int, wrong: int) -> None:
    hits = []
    for seed in range(100):
        centers, gps, up = draw(seed, count, 1.0, wrong)
        found = georeference(centers, gps)
        hits.append(found is not None and found.interval[0] <= 20 <= found.interval[1])
        if found is not None and count == 30:
            assert np.degrees(np.arccos(np.clip(up @ found.up, -1, 1))) < 10
            np.testing.assert_allclose(found.origin[:2], [NORTH, EAST], atol=3e-5)
    assert sum(hits) >= 90


def test_what_gps_cannot_tell_is_not_told() -> None:
    centers, gps, _ = draw(0, 12, 0.0)
    assert georeference(centers, gps) is not None
    assert georeference(centers[:3], gps[:3]) is None
    assert georeference(centers, gps[:3] * 4) is None  # three places
    assert georeference(*draw(1, 12, 40.0)[:2]) is None
    assert georeference(np.outer(np.arange(12.0), [1, 2, 3]), gps) is None  # on a line


def test_photos_with_gps_say_where_the_scene_is(tmp_path: Path) -> None:
    truth = make_truth(suffix=".jpg")
    root = write_colmap(truth, tmp_path, binary=False)
    for name, viewmat in zip(truth.names, truth.viewmats, strict=True):
        x, y, z = (-viewmat[:3, :3].T @ viewmat[:3, 3]).tolist()  # 5 m to the unit; up is -y, north z
        tags = Image.Exif()
        place = {
            1: "N",
            2: (NORTH + 5 * z / METRES[0], 0.0, 0.0),
            3: "E",
            4: (EAST + 5 * x / METRES[1], 0.0, 0.0),
        }
        tags.get_ifd(0x8825).update({**place, 5: b"\0", 6: 320 - 5 * y})
        with Image.open(root / "images" / name) as photo:
            photo.save(root / "images" / name, exif=tags)
    scene = load_scene(root)
    assert scene.place is not None
    assert scene.place.scale == pytest.approx(5, rel=0.01)
    assert scene.place.origin == pytest.approx([NORTH, EAST, 320], abs=0.1)
    np.testing.assert_allclose(scene.place.up, [0, -1, 0], atol=0.05)
    assert scene.notes[-1].startswith("GPS of 9 of 9 photos: a unit is 5")
