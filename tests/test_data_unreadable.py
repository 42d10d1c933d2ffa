"""Training photos that cannot be read: left out on request, without any other change to the scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fixtures_scenes import make_truth, write_colmap, write_llff, write_transforms
from PIL import Image

from hqgs.photos.formula import parse_degradation
from hqgs.scene.degrade import write_degraded_scene
from hqgs.scene.load import load_scene

pytestmark = pytest.mark.filterwarnings("ignore:Truncated File Read")  # Pillow says so before it raises


def spoil(*paths: Path, share: float = 0.5) -> None:
    for path in paths:
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])


def names(root: Path, skip: bool = True) -> tuple[list[str], list[str]]:
    scene = load_scene(root, skip_unreadable=skip)
    return [view.name for view in scene.train], [view.name for view in scene.test]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("longest", [None, 32])
def test_training_photos_are_skipped_and_named(
    tmp_path: Path, share: float, suffix: str, longest: int | None
) -> None:
    """The test views stay those of the whole folder: views 0 and 8 of 10, although 3 and 5 are gone."""
    truth = make_truth(10, suffix)
    whole = load_scene(write_colmap(truth, tmp_path), longest=longest)
    spoil(tmp_path / f"images/view_03{suffix}", tmp_path / f"images/view_05{suffix}", share=share)
    scene = load_scene(tmp_path, skip_unreadable=True, longest=longest)
    gone = {f"view_03{suffix}", f"view_05{suffix}"}
    left = [view for view in whole.train if view.name not in gone]
    assert [view.name for view in scene.train] == [view.name for view in left]
    assert [view.name for view in scene.test] == [f"view_00{suffix}", f"view_08{suffix}"]
    for view, before in zip(scene.train, left, strict=True):
        np.testing.assert_array_equal(view.image, before.image)
        np.testing.assert_array_equal(view.camera.viewmat, before.camera.viewmat)
    told = 0 if longest is None else 1  # how many photos are scaled down: of those that can be opened
    assert scene.notes[told:-1] == whole.notes[told:]
    assert scene.notes[-1].startswith(
        f"2 of 8 training photos cannot be used and were left out: view_03{suffix}, view_05{suffix}. The "
        "first: cannot read the photo "
    )
    with pytest.raises(ValueError, match=rf"cannot read the photo .*view_03\{suffix}"):
        load_scene(tmp_path, longest=longest)


def test_nothing_to_skip_changes_nothing(tmp_path: Path) -> None:
    write_colmap(make_truth(9), tmp_path)
    assert load_scene(tmp_path, skip_unreadable=True).notes == load_scene(tmp_path).notes
    assert names(tmp_path) == names(tmp_path, skip=False)


@pytest.mark.parametrize(("gone", "readable"), [(4, True), (5, False)])
def test_half_must_remain(tmp_path: Path, gone: int, readable: bool) -> None:
    """Of 8 training photos among 10; the error is that of the first one, as without the option."""
    write_colmap(make_truth(10), tmp_path)
    spoil(*(tmp_path / f"images/view_{k:02d}.png" for k in range(2, 2 + gone)))
    if readable:
        assert names(tmp_path)[0] == ["view_01.png", "view_06.png", "view_07.png", "view_09.png"]
        return
    with pytest.raises(ValueError, match=r"cannot read the photo .*view_02\.png"):
        load_scene(tmp_path, skip_unreadable=True)


def test_held_out_photos_are_left_out_while_one_remains(tmp_path: Path) -> None:
    write_colmap(make_truth(10), tmp_path)
    spoil(tmp_path / "images/view_08.png", tmp_path / "images/view_03.png")
    scene = load_scene(tmp_path, skip_unreadable=True)
    assert [view.name for view in scene.test] == ["view_00.png"]
    assert any(note.startswith("1 of 2 held-out photos cannot be used") for note in scene.notes)
    spoil(tmp_path / "images/view_00.png")
    with pytest.raises(ValueError, match=r"cannot read the photo .*view_00\.png"):
        load_scene(tmp_path, skip_unreadable=True)


def test_a_photo_of_another_shape_is_left_out(tmp_path: Path) -> None:
    write_colmap(make_truth(4), tmp_path)
    Image.new("RGB", (30, 60)).save(tmp_path / "images/view_01.png")
    scene = load_scene(tmp_path, skip_unreadable=True)
    assert [view.name for view in scene.train] == ["view_02.png", "view_03.png"]
    assert "view_01.png' is 30 x 60, but its camera is for 48 x 36: another aspect ratio" in scene.notes[-1]
    with pytest.raises(ValueError, match=r"view_01\.png' is 30 x 60, but its camera is for"):
        load_scene(tmp_path)


def test_mask(tmp_path: Path) -> None:
    """A photo is not trained on without its mask."""
    write_colmap(make_truth(4), tmp_path)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks/view_02.png").write_bytes(b"nothing")
    assert names(tmp_path) == (["view_01.png", "view_03.png"], ["view_00.png"])


def test_transforms_without_size(tmp_path: Path) -> None:
    """The size stands in the photo alone, so that reading the cameras meets the photo first."""
    write_transforms(make_truth(10), tmp_path, w=None, h=None)
    spoil(tmp_path / "images/view_05.png", share=0.0)
    train, test = names(tmp_path)
    assert test == ["images/view_00.png", "images/view_08.png"]
    assert train == [f"images/view_{k:02d}.png" for k in (1, 2, 3, 4, 6, 7, 9)]
    with pytest.raises(ValueError, match=r"cannot read the photo .*view_05\.png"):
        load_scene(tmp_path)
    spoil(tmp_path / "images/view_00.png", share=0.0)
    assert names(tmp_path) == (train, ["images/view_08.png"])


def test_marker_counts_the_photos_in_the_folder(tmp_path: Path) -> None:
    write_llff(make_truth(10), tmp_path)
    (tmp_path / "hold=3").touch()
    spoil(tmp_path / "images/view_01.png")
    train, test = names(tmp_path)
    assert test == [f"view_{k:02d}.png" for k in (0, 3, 6, 9)]
    assert train == [f"view_{k:02d}.png" for k in (2, 4, 5, 7, 8)]


def test_small_photo(tmp_path: Path) -> None:
    scene = load_scene(write_colmap(make_truth(10), tmp_path / "clean"))
    write_degraded_scene(scene, tmp_path / "low", parse_degradation("lowres:2"), seed=0)
    spoil(tmp_path / "low/low/view_05.png", tmp_path / "low/images/view_06.png")
    train, test = names(tmp_path / "low")
    assert test == ["view_00.png", "view_08.png"]
    assert train == [f"view_{k:02d}.png" for k in (1, 2, 3, 4, 7, 9)]
    with pytest.raises(ValueError, match=r"cannot read the photo .*view_06\.png"):
        load_scene(tmp_path / "low")


def test_cut_out_photos_stay_cut_out(tmp_path: Path) -> None:
    """A photo that cannot be opened does not make masks of the transparency of all others."""
    truth = make_truth(5)
    write_colmap(truth, tmp_path)
    alpha = np.full((36, 48), 255, np.uint8)
    alpha[:, :24] = 0
    for name, photo in zip(truth.names, truth.photos, strict=True):
        Image.fromarray(np.dstack([photo, alpha])).save(tmp_path / "images" / name)
    (tmp_path / "images/view_02.png").write_bytes(b"")
    scene = load_scene(tmp_path, test_every=0, skip_unreadable=True)
    assert len(scene.train) == 4
    assert all(view.mask is None and view.empty is not None for view in scene.train)
