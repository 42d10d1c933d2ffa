"""Places of panoramas that the matches between them contradict are told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from hqgs.scene.sfm.facts import borne_out
from hqgs.scene.sfm.failure import Outcome, why_doubtful


def test_wrong_places_are_told_by_the_matches_that_they_contradict(tmp_path: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 2, 5
    options.num_points3D = 60
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(tmp_path / "colmap.db") as db:
        model = pycolmap.synthesize_dataset(options, db)
    right = borne_out(tmp_path / "colmap.db", model)
    assert right == 1
    frame = model.frames[min(model.frames)]
    pose = frame.rig_from_world
    assert pose is not None
    spin = Rotation.from_euler("z", 20, degrees=True).as_matrix()
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(spin), np.zeros(3))
    frame.rig_from_world = turn * pose
    wrong = borne_out(tmp_path / "colmap.db", model)
    assert 0.5 < wrong < 0.85  # those of 24 of 40 pairs are as they were
    one = Outcome(False, 10, {}, [], [], borne_out=wrong)
    assert f"only {wrong:.0%} of the matches between panoramas fit them" in why_doubtful(one)
    assert why_doubtful(replace(one, borne_out=right)) == why_doubtful(replace(one, borne_out=None)) == ""
