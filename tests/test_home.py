"""Photos without a place are placed by weaker evidence, and places are checked by what the photos show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from test_sharpen import made  # noqa: F401

from hqgs.scene.scene import Scene
from hqgs.scene.sfm.failure import Outcome, doubtful, why_doubtful
from hqgs.scene.sfm.passes import PASSES, Attempt, Work
from hqgs.scene.sfm.refine import placed_names, without
from hqgs.scene.sfm.refine.agree import agreement, confirmed, loose_parts
from hqgs.scene.sfm.refine.tracks import Tracks, read_tracks, rebuilt
from hqgs.scene.sfm.run import Model
from hqgs.scene.sfm.triangulated import write_photos

Made = tuple[pycolmap.Reconstruction, list[np.ndarray], Path]


def test_places_that_photos_bear_out_are_told_from_others(made: Made) -> None:  # noqa: F811
    """Though features tell nothing of it: the observations of the turned photo follow its place."""
    model, true, folder = made
    for k, pose in enumerate(true, 1):
        model.frames[model.images[k].frame_id].rig_from_world = pycolmap.Rigid3d(pose)
    right = agreement(model, folder)
    assert all(confirmed(*counts) for counts in right.values())
    assert np.mean([agreed / looked for looked, agreed, _ in right.values()]) > 0.9
    wrong = true[3].copy()
    wrong[:, :3] = Rotation.from_euler("y", 6, degrees=True).as_matrix() @ wrong[:, :3]  # 16 px
    model.frames[model.images[4].frame_id].rig_from_world = pycolmap.Rigid3d(wrong)
    told = agreement(model, folder)
    assert [name for name, counts in told.items() if not confirmed(*counts)] == ["3.png"]
    one = Outcome(8, {}, [], agree={name: list(counts) for name, counts in told.items()})
    assert doubtful(one) == ["3.png"]
    looked, agreed, beside = told["3.png"]
    said = f"The poses of 1 photos may be wrong (tree.jpg): of {looked} points that should be visible,"
    assert f"{said} {agreed} are found, at random places {beside}" in why_doubtful(
        one, lambda name: "tree.jpg"
    )
    few = replace(one, agree={"3.png": [19, 0, 9]})
    assert doubtful(few) == []  # too little was looked for


def test_a_part_that_lies_wrong_as_a_whole_is_told(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    """Its photos bear each other out, and 12 points join it to the rest: two sides of a house look alike."""
    monkeypatch.setattr(
        "hqgs.scene.sfm.refine.agree.WEAKLY_JOINT", 20
    )  # photos share fewer here than real ones
    model, true, folder = made
    names, tracks = read_tracks(model)
    part = (tracks.view >= 5).astype(np.intp)
    count, joint = len(tracks.points), tracks.point < 12
    turn = Rotation.from_euler("y", 6, degrees=True).as_matrix()
    for shift in (np.eye(3), turn):  # of the world of photos 5 to 7
        for k, pose in enumerate(true):
            placed = np.concatenate([pose[:, :3] @ shift.T, pose[:, 3:]], 1) if k >= 5 else pose
            model.frames[model.images[k + 1].frame_id].rig_from_world = pycolmap.Rigid3d(placed)
        point = np.where(joint, tracks.point, tracks.point + part * count)
        points = np.concatenate([tracks.points, tracks.points @ shift.T])
        apart = replace(
            tracks, points=points, colors=np.zeros((2 * count, 3), np.uint8), view=tracks.view, point=point
        )
        told = agreement(rebuilt(model, names, apart.chosen(np.ones(len(point), bool))), folder)
        doubted = [name for name, counts in told.items() if not confirmed(*counts)]
        assert doubted == ([] if shift is not turn else ["5.png", "6.png", "7.png"])


@pytest.fixture
def attempt(cards: Scene, tmp_path: Path) -> Attempt:
    """A pass over the cards' photos, all of which have a place."""
    views = {f"{k:05d}.png": view for k, view in enumerate(cards.train)}
    (tmp_path / "photos").mkdir()
    write_photos(tmp_path / "photos", views)
    cameras = [view.camera for view in cards.train]
    given = {
        "names": np.array(list(views)),
        "sizes": np.array([(camera.width, camera.height) for camera in cameras]),
        "Ks": np.stack([camera.K for camera in cameras]),
        "photos": np.array(str(tmp_path / "photos")),
    }
    ran = Attempt(Work(tmp_path, given), PASSES[1])
    ran.run()
    assert ran.registered == 7
    return ran


def test_lost_photos_come_home_and_strange_ones_do_not(attempt: Attempt) -> None:
    model = attempt.model
    assert model is not None
    before = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    lost = {"00002.png", "00005.png"}
    without(model, lost)
    assert placed_names(model) == set(before) - lost
    attempt.bring_home()
    home = attempt.model
    assert home is not None
    assert placed_names(home) == set(before)
    for image in home.images.values():
        R = image.cam_from_world().matrix()[:, :3]
        turned = Rotation.from_matrix(R @ before[image.name][:, :3].T).magnitude()
        assert np.rad2deg(turned) < 1
    # Another one goes again: weak evidence put it where it does not belong, by false observations.
    names, tracks = read_tracks(home)
    xy, mine = tracks.xy.copy(), np.flatnonzero(tracks.view == names.index("00002.png"))
    xy[mine] = xy[np.random.default_rng(0).permutation(mine)]
    home = attempt.model = rebuilt(home, names, replace(tracks, xy=xy))
    frame = home.frames[home.images[3].frame_id]
    assert frame.rig_from_world is not None
    spin = Rotation.from_euler("x", 25, degrees=True).as_matrix()
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(spin), np.zeros(3)) * frame.rig_from_world
    home.update_point_3d_errors()
    attempt.refine()
    assert attempt.model is not None
    assert placed_names(attempt.model) == set(before) - {"00002.png"}
    assert set(attempt.agree) == set(before) - {"00002.png"}
    assert all(confirmed(*counts) for counts in attempt.agree.values())


def test_parts_that_hang_on_few_points_are_told(made: Made) -> None:  # noqa: F811
    """Photos 0 to 3 share 60 points, 4 to 6 share 25, and both parts 12; photo 7 shares 9 with the first."""
    model, _, _ = made
    seen = [(range(4), range(60)), (range(4, 7), range(60, 85)), (range(3, 5), range(85, 97))]
    seen += [(range(7, 8), range(9)), (range(7, 8), range(97, 150))]  # and 53 that nobody else has
    pairs = np.array(sorted({(v, p) for views, points in seen for v in views for p in points}))
    rng = np.random.default_rng(0)
    tracks = Tracks(
        rng.random((150, 3)),
        np.zeros((150, 3), np.uint8),
        pairs[:, 0],
        pairs[:, 1],
        rng.random((len(pairs), 2)),
    )
    hung = rebuilt(model, [f"{k}.png" for k in range(8)], tracks)
    parts = loose_parts(hung)
    assert parts == [(["4.png", "5.png", "6.png"], 12), (["7.png"], 9)]
    said = why_doubtful(Outcome(8, {}, [], loose=parts))
    assert "4.png, 5.png, 6.png by 12 points; 7.png by 9 points. Take photos between these" in said
    more = replace(tracks, view=np.append(tracks.view, [2] * 8), point=np.append(tracks.point, range(60, 68)))
    more = replace(more, xy=rng.random((len(more.view), 2)))
    assert loose_parts(rebuilt(model, [f"{k}.png" for k in range(8)], more)) == [(["7.png"], 9)]


def test_a_run_says_that_no_pose_can_be_trusted() -> None:
    """Where most of the photos do not show what their places say."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=9, height=9, params=[9, 9, 4.5, 4.5])
    model.add_camera_with_trivial_rig(camera)
    for k in range(4):
        image = pycolmap.Image(name=f"{k}.png", camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    features = {f"{k}.png": 500 for k in range(4)}
    good, bad = [40, 30, 5], [40, 6, 5]
    one = Outcome(4, features, [], agree={"0.png": bad, "1.png": bad, "2.png": good, "3.png": good})
    assert len(Model(model, one).poses()) == 4
    worse = replace(one, agree=one.agree | {"2.png": bad})
    with pytest.raises(
        ValueError, match=r"most poses of these photos are probably wrong\. The poses of 3 photos"
    ):
        Model(model, worse).poses()
