"""Photos of all around and wide lenses: as faces of a cube, against rays that are computed here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from fixtures_photos import looked_at
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation
from test_diagnose import clean_photo

from hqgs.base.stages import Stage
from hqgs.diagnosis.differences import TURNED, unlike_sharpness
from hqgs.photos.exif import read_exif
from hqgs.scene import views
from hqgs.scene.faces import CUBE, around, face_name, faces_of
from hqgs.scene.geometry import project
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Camera, Scene, View
from hqgs.scene.sfm.align import align, rotation_angles
from hqgs.scene.sfm.facts import borne_out
from hqgs.scene.sfm.failure import Outcome, why_doubtful
from hqgs.scene.sfm.folder import write_colmap_folder
from hqgs.scene.sfm.likely import pairs_of_faces

Floats = NDArray[np.float64]
HALF = np.array([3.0, 1.5, 4.0])  # of a box-shaped room around the origin
TEXELS = 60  # per world unit of its walls


def walls() -> list[Floats]:
    """A picture for each of the box's sides: blots of several sizes."""
    found = []
    for side in range(6):
        rng = np.random.default_rng(side)
        shape = tuple(int(2 * TEXELS * HALF[axis]) for axis in range(3) if axis != side // 2)
        levels = np.zeros((*shape, 3))
        for sigma in (1.5, 4, 12):
            blots = gaussian_filter(rng.normal(size=(*shape, 3)), (sigma, sigma, 0), mode="wrap")
            levels += blots / blots.std()
        found.append(128 + 30 * levels)
    return found


WALLS = walls()


def light(center: Floats, rays: Floats) -> NDArray[np.uint8]:
    """What the room looks like from a place along rays [..., 3]."""
    with np.errstate(divide="ignore"):
        ends = (np.sign(rays) * HALF - center) / rays
    axis = ends.argmin(-1)
    hit = center + rays * np.take_along_axis(ends, axis[..., None], -1)
    out = np.zeros((*rays.shape[:-1], 3))
    for side in range(6):
        mine = (axis == side // 2) & ((np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0) == side % 2)
        others = [k for k in range(3) if k != side // 2]
        at = (hit[mine][:, others] + HALF[others]) * TEXELS - 0.5
        for channel in range(3):
            out[mine, channel] = map_coordinates(WALLS[side][..., channel], at.T, order=1, mode="nearest")
    return np.rint(out.clip(0, 255)).astype(np.uint8)


def rays_around(width: int) -> Floats:
    """Of the pixels of a panorama, by the definition of longitude and latitude; [width / 2, width, 3]."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(width // 2) + 0.5) / (width // 2)) * np.pi  # up is positive
    up, across = np.meshgrid(latitude, longitude, indexing="ij")
    return np.stack([np.cos(up) * np.sin(across), -np.sin(up), np.cos(up) * np.cos(across)], -1)


def panorama(viewmat: Floats, width: int) -> NDArray[np.uint8]:
    rotation = viewmat[:3, :3]
    return light(-rotation.T @ viewmat[:3, 3], rays_around(width) @ rotation)


def pinhole(camera: Camera) -> NDArray[np.uint8]:
    y, x = np.indices((camera.height, camera.width)) + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.K).T
    return light(camera.center, rays @ camera.viewmat[:3, :3])


def walk(count: int) -> list[Floats]:
    """World to camera, a ring in the room, each turned and tilted in its own way."""
    rng = np.random.default_rng(3)
    poses = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        center = np.array([1.2 * np.cos(angle), 0.2 * rng.uniform(-1, 1), 1.6 * np.sin(angle)])
        rotation = Rotation.from_euler(
            "yxz", [*rng.uniform(-25, 25, 1), *rng.uniform(-6, 6, 2)], degrees=True
        )
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation.as_matrix()
        viewmat[:3, 3] = -viewmat[:3, :3] @ center
        poses.append(viewmat)
    return poses


def write_walk(folder: Path, count: int, width: int, suffix: str = ".png") -> list[Floats]:
    folder.mkdir(parents=True, exist_ok=True)
    poses = walk(count)
    for k, pose in enumerate(poses):
        Image.fromarray(panorama(pose, width)).save(folder / f"{k:02d}{suffix}")
    return poses


def write_model(folder: Path, camera: pycolmap.Camera, photos: list[NDArray[np.uint8]]) -> None:
    """A COLMAP model without points of photos by one camera, at the places of `walk`."""
    model = pycolmap.Reconstruction()
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    (folder / "images").mkdir(parents=True)
    for k, (photo, viewmat) in enumerate(zip(photos, walk(len(photos)), strict=True)):
        Image.fromarray(photo).save(folder / "images" / f"{k:02d}.png")
        image = pycolmap.Image(name=f"{k:02d}.png", camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")


def off(view: View) -> Floats:
    """Absolute differences [H, W] from what a pinhole camera sees there, in levels."""
    found = np.abs(view.image.astype(np.float64) - pinhole(view.camera)).mean(-1)
    return found if view.mask is None else np.where(view.mask, found, 0)


def test_a_panorama_is_read_as_the_faces_of_a_cube(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And decoded once for all of them."""
    width, real, opened = 720, views.decode, list[str]()
    monkeypatch.setattr(views, "decode", lambda path, *rest: opened.append(path.name) or real(path, *rest))
    write_model(tmp_path, around(width, width // 2), [panorama(pose, width) for pose in walk(2)])
    scene = load_scene(tmp_path, test_every=2)
    assert sorted(opened) == ["00.png", "01.png"]
    assert [view.name for view in scene.test] == sorted(face_name("00.png", face) for face in CUBE)
    assert [view.name for view in scene.train] == sorted(face_name("01.png", face) for face in CUBE)
    for view in [*scene.train, *scene.test]:
        assert view.image.shape == (width // 4, width // 4, 3)
        assert view.mask is None
        assert np.median(off(view)) < 4
    half = load_scene(tmp_path, test_every=2, longest=90)
    assert half.train[0].image.shape == (90, 90, 3)
    assert np.median(off(half.train[0])) < 8


def test_panoramas_by_what_they_show_are_called_so_and_how_to_refuse_it(tmp_path: Path) -> None:
    write_walk(tmp_path, 5, 512)
    photos = looked_at(tmp_path)
    assert photos.around
    (said,) = [note for note in photos.notes if "look like panoramas" in note]
    assert said.startswith("5 photos look like panoramas of 360 x 180 degrees")
    for file in tmp_path.iterdir():  # as the note says
        with Image.open(file) as photo:
            photo.crop((0, 0, 512, 255)).save(file)
    assert not looked_at(tmp_path).around


def test_no_seam_where_a_panorama_ends(tmp_path: Path) -> None:
    """Its first and its last column meet in the middle of the face behind."""
    width = 360
    write_model(tmp_path, around(width, width // 2), [np.full((180, 360, 3), 90, np.uint8)] * 2)
    path = tmp_path / "images" / "00.png"
    ramp = np.abs(np.arange(width) - (width - 1) / 2)[None, :, None] + np.zeros((width // 2, 1, 3))
    Image.fromarray(np.rint(ramp).astype(np.uint8)).save(path)
    view = next(v for v in load_scene(tmp_path, test_every=0).train if v.name == "00.back.png")
    row = view.image[view.image.shape[0] // 2, :, 0].astype(int)
    middle = len(row) // 2
    assert row[middle - 1] == row[middle] >= 178  # both ends show 179.5, and what lies between them the same
    assert (np.abs(np.diff(row)) <= 2).all()


@pytest.mark.parametrize(("focal", "degrees", "faces"), [(115.0, 180, 5), (150.0, 150, 5), (215.0, 110, 1)])
def test_a_fisheye_keeps_its_rim(tmp_path: Path, focal: float, degrees: float, faces: int) -> None:
    """An equidistant lens: r = f theta. From 120 degrees on it becomes faces, which show all that it saw."""
    side = 400
    camera = pycolmap.Camera(
        model="OPENCV_FISHEYE", width=side, height=side, params=[focal, focal, side / 2, side / 2, 0, 0, 0, 0]
    )
    y, x = np.indices((side, side)) + 0.5 - side / 2
    theta = np.hypot(x, y) / focal
    rays = np.stack(
        [x / np.hypot(x, y) * np.sin(theta), y / np.hypot(x, y) * np.sin(theta), np.cos(theta)], -1
    )
    circle = theta < np.radians(min(90, degrees / 2))
    photos = []
    for pose in walk(2):
        photo = light(-pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3])
        photos.append(np.where(circle[..., None], photo, 0).astype(np.uint8) if faces > 1 else photo)
    write_model(tmp_path, camera, photos)
    views = load_scene(tmp_path, test_every=0).train
    assert len(views) == 2 * faces
    shown = 0.0  # of the sphere, steradians
    for view in views[:faces]:
        counts = np.ones(view.image.shape[:2], bool) if view.mask is None else view.mask
        assert np.median(off(view)[counts]) < 4
        assert (off(view)[counts] > 60).mean() < 0.002, (off(view)[counts] > 60).mean()  # no dark corners
        v, u = np.indices(counts.shape) + 0.5
        at = np.stack([u, v], -1) - view.camera.K[:2, 2]
        shown += (counts / (1 + np.square(at / view.camera.K[0, 0]).sum(-1)) ** 1.5).sum() / view.camera.K[
            0, 0
        ] ** 2
    if faces > 1:
        assert shown == pytest.approx(2 * np.pi * (1 - np.cos(np.radians(degrees / 2))), rel=0.04)


def test_a_lens_whose_polynomial_turns_back_ends_there() -> None:
    params = [300.0, 300, 500, 500, -0.3, 0, 0, 0]  # r = f (t - 0.3 t^3) grows up to t = sqrt(1 / 0.9)
    camera = pycolmap.Camera(model="OPENCV_FISHEYE", width=1000, height=1000, params=params)
    limits = [face.limit for face in faces_of(camera)]
    assert limits == pytest.approx([np.sqrt(1 / 0.9)] * 5, abs=0.005)


def save(folder: Path, names: str, size: tuple[int, int] = (80, 40), **more: Any) -> None:
    """Pictures of other shapes or kinds than panoramas have."""
    folder.mkdir(exist_ok=True)
    for k, name in enumerate(names.split()):
        noise = np.random.default_rng(k).integers(0, 255, (size[1], size[0], 3)).astype(np.uint8)
        Image.fromarray(noise).save(folder / name, **more)


TAG = b'<rdf:Description GPano:ProjectionType="equirectangular"/>'


def test_panoramas_are_told_from_others(tmp_path: Path) -> None:
    write_walk(tmp_path / "untold", 4, 320)
    assert looked_at(tmp_path / "untold").around
    save(tmp_path / "told", "a.jpg b.jpg c.jpg", xmp=TAG)
    assert looked_at(tmp_path / "told").around
    save(tmp_path / "wide", "a.png b.png c.png d.png")
    assert not looked_at(tmp_path / "wide").around
    save(tmp_path / "parts", "a.png b.png c.png", (90, 60))
    save(tmp_path / "parts", "p.jpg", (90, 30), xmp=TAG)  # a sweep by a phone, among photos
    assert not looked_at(tmp_path / "parts").around
    write_walk(tmp_path / "circles", 4, 320)  # two fisheye circles side by side
    y, x = np.indices((160, 320)) + 0.5
    dark = np.hypot(x % 160 - 80, y - 80) > 78
    for path in (tmp_path / "circles").iterdir():
        pixels = np.where(dark[..., None], 0, np.asarray(Image.open(path))).astype(np.uint8)
        Image.fromarray(pixels).save(path)
    assert not looked_at(tmp_path / "circles").around


@pytest.mark.parametrize(
    ("panoramas", "flat", "left_out"),
    [(4, "phone.png", "1 of 5 photos are flat"), (1, "a.png b.png c.png", "1 of 4 photos are panoramas")],
)
def test_the_kind_that_has_more_photos_is_used(
    tmp_path: Path, panoramas: int, flat: str, left_out: str
) -> None:
    write_walk(tmp_path, panoramas, 320)
    save(tmp_path, flat, (64, 48))
    photos = looked_at(tmp_path)
    assert photos.around == (panoramas > 1)
    assert len(photos.names) == max(panoramas, len(flat.split())) == len(photos.sizes) == len(photos.exif)
    assert any(note.startswith(left_out) for note in photos.notes)


def test_what_is_no_walk_of_panoramas_is_refused_by_name(tmp_path: Path) -> None:
    save(tmp_path / "one", "hall.jpg", xmp=TAG)
    with pytest.raises(ValueError, match=r"1 panorama of 360 x 180 degrees \(hall\.jpg\) show.* at least 3"):
        looked_at(tmp_path / "one")
    save(tmp_path / "parts", "a.jpg b.jpg", (90, 30), xmp=TAG)
    with pytest.raises(ValueError, match=r"2 of 2 photos are tagged .* \(a\.jpg: 90 x 30 px\)"):
        looked_at(tmp_path / "parts")


def gpano(apart: str, **said: object) -> bytes:
    """XMP data as cameras and stitchers write them, as attributes or as elements."""
    form = "<GPano:{0}>{1}</GPano:{0}>" if apart == "element" else " GPano:{0} = '{1}'"
    return "".join(form.format(name, value) for name, value in said.items()).encode()


SIDES = {"FullPanoWidthPixels": 8000, "FullPanoHeightPixels": 4000}
WHOLE = {**SIDES, "CroppedAreaImageWidthPixels": 8000, "CroppedAreaImageHeightPixels": 4000}
PART = {**SIDES, "CroppedAreaImageWidthPixels": 4000, "CroppedAreaImageHeightPixels": 2000}


@pytest.mark.parametrize("apart", ["element", "attribute"])
@pytest.mark.parametrize(
    ("kind", "said", "around"),
    [
        ("equirectangular", WHOLE, True),  # and resized since
        ("Equirectangular", {}, True),
        ("equirectangular", PART, False),  # of a drone or a phone, 180 x 90 degrees: 2:1 as well
        ("cylindrical", {}, False),
        ("rectilinear", {}, None),
    ],
)
def test_tags_tell_whole_spheres_from_parts(
    kind: str, said: dict[str, int], around: bool | None, apart: str, tmp_path: Path
) -> None:
    save(tmp_path, "a.jpg b.jpg c.jpg", xmp=gpano(apart, ProjectionType=kind, **said))
    assert read_exif(tmp_path / "a.jpg").panorama is around
    if around is False:
        with pytest.raises(ValueError, match="tagged as panoramas, but do not show the whole sphere"):
            looked_at(tmp_path)
        save(tmp_path, "d.jpg e.jpg f.jpg g.jpg")  # photos, of which it is none
        assert looked_at(tmp_path).names == ["d.jpg", "e.jpg", "f.jpg", "g.jpg"]
    else:
        assert looked_at(tmp_path).around == bool(around)


def test_faces_of_one_photo_are_no_pair() -> None:
    pairs = pairs_of_faces(12, 6)
    assert len(pairs) == 36
    assert (pairs[:, 0] // 6 == 0).all()
    assert (pairs[:, 1] // 6 == 1).all()
    some = pairs_of_faces(18, 6, np.array([[0, 1], [0, 13]]))
    alike = {(k, k + 6 * n) for k in range(18) for n in (1, 2) if k + 6 * n < 18}
    assert {(a, b) for a, b in some.tolist()} == alike | {(0, 13)}


def test_faces_that_were_resampled_differently_are_not_shaken() -> None:
    """Each face lost the fine details of one direction, as all of its direction did."""
    views = []
    for k in range(12):
        sigma = (1.2, 0.1, 0) if k % 2 else (0.1, 1.2, 0)
        image = (
            np.rint(gaussian_filter(clean_photo(k).astype(np.float64), sigma)).clip(0, 255).astype(np.uint8)
        )
        camera = Camera(image.shape[1], image.shape[0], np.diag([100.0, 100, 1]), np.eye(4))
        views.append(View(f"{k}.png", camera, image, face=("front", "up")[k % 2]))
    scene = Scene("s", views, [], np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), "photos")
    found = unlike_sharpness(scene)
    shaken = unlike_sharpness(replace(scene, train=[replace(view, face="") for view in views]))
    assert found is not None
    assert shaken is not None
    assert found[1] < TURNED < shaken[1]


@pytest.mark.slow
def test_photos_alone_become_a_scene_of_faces(tmp_path: Path) -> None:
    """End to end: COLMAP finds the places of a rig to 0.1 degree, and each face is a view of the room."""
    poses = write_walk(tmp_path / "walk", 6, 640)
    heard: list[Stage] = []
    keep = tmp_path / "keep"
    scene = load_scene(tmp_path / "walk", test_every=4, keep_sfm=keep, on_stage=heard.append)
    assert any((stage.note or "").startswith("6 panoramas of 360 x 180 degrees") for stage in heard)
    assert {view.name for view in scene.test} == {face_name(f"{k:02d}.png", f) for k in (0, 4) for f in CUBE}
    assert len(scene.train) == 4 * len(CUBE)
    assert scene.sfm is not None
    assert (scene.sfm.photos, scene.sfm.not_registered) == (6, [])
    assert scene.seen is not None
    check_places(scene, poses)
    for view in scene.train:
        rows = scene.seen[view.name]
        pixels, depths = project(view.camera, scene.points[rows].astype(np.float64))
        assert len(rows) > 20
        assert (depths > 0).all()
        assert ((pixels >= 0) & (pixels <= view.camera.width)).all()
    written = tmp_path / "written"
    assert write_colmap_folder(tmp_path / "walk", written, keep).not_registered == []
    check_places(load_scene(written, test_every=4), poses)


def check_places(scene: Scene, poses: list[Floats]) -> None:
    """All faces are turned as they were, up to one rotation of the world, and show the room."""
    views = [*scene.train, *scene.test]
    assert len(views) == len(poses) * len(CUBE)
    found = np.stack([view.camera.viewmat for view in views])
    true = np.zeros_like(found)
    true[:, 3, 3] = 1
    for k, view in enumerate(views):
        true[k, :3] = CUBE[view.name.split(".")[1]] @ poses[int(view.name[:2])][:3]
    similarity, _ = align(found, true)
    moved = similarity.viewmats(found)
    degrees = np.rad2deg(rotation_angles(np.einsum("nij,nkj->nik", moved[:, :3, :3], true[:, :3, :3])))
    assert degrees.max() < 0.1
    for view, viewmat in zip(views, true, strict=True):
        assert np.median(off(replace(view, camera=replace(view.camera, viewmat=viewmat)))) < 8


# --- Places of panoramas that the matches between them contradict are told


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
    one = Outcome(10, {}, [], borne_out=wrong)
    assert f"only {wrong:.0%} of the matches between panoramas fit them" in why_doubtful(one)
    assert why_doubtful(replace(one, borne_out=right)) == why_doubtful(replace(one, borne_out=None)) == ""
