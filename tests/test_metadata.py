"""What scene files say of themselves is heeded, or said: colour spaces, flags, axes, units, moves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fixtures_scenes import make_truth, photographed, write_colmap, write_transforms
from PIL import Image
from scipy.spatial.transform import Rotation
from test_formats import change_gltf
from test_ply import layout, random_gaussians, values, write

import hqgs
from hqgs import Camera, Gaussians
from hqgs.cli.main import main
from hqgs.scene.camera_files import load_path, moved, save_cameras, save_path
from hqgs.scene.source import load as load_scene
from hqgs.scene.world import World

NAME = "KHR_gaussian_splatting"


def flat(degree: int = 0, n: int = 300) -> hqgs.Gaussians:
    """A wall of Gaussians in front of a camera, opaque, of several colours."""
    rng = torch.Generator().manual_seed(1)
    g = random_gaussians(n, degree)
    g.means[:] = torch.rand(n, 3, generator=rng) * torch.tensor([2.0, 2.0, 0.1]) - torch.tensor(
        [1.0, 1.0, -3]
    )
    g.scales[:], g.opacities[:] = -1.0, 9.0
    g.sh0[:] = (torch.rand(n, 1, 3, generator=rng) * 0.6 - 0.3) / 0.2820948
    g.shN *= 0.03
    return g


def extension(content: Any) -> Any:
    return content["meshes"][0]["primitives"][0]["extensions"][NAME]


def by_iec(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clip(1e-9) ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("space", ["lin_rec709_display", "BT.709-linear"])
@pytest.mark.parametrize("degree", [0, 3])
def test_linear_colours_become_srgb(tmp_path: Path, degree: int, space: str) -> None:
    """Of every Gaussian, from any direction, by the curve of the standard."""
    g = flat(degree)
    g.save(tmp_path / "a.glb")
    change_gltf(tmp_path / "a.glb", lambda c: extension(c).update(colorSpace=space))
    read = hqgs.Gaussians.load(tmp_path / "a.glb")
    assert any(space in note for note in read.notes)
    for k in range(3):
        for eye in ([0.0, 0, 0], [1.0, -0.5, 1]):
            camera = hqgs.look_at(np.array(eye), g.means[k].numpy(), width=9, height=9)
            shown = []
            for scene in (g, read):
                one = scene.rows(torch.tensor([k]))
                one.opacities[:] = 20.0
                shown.append(one.render(camera)[4, 4].double().numpy() / 0.99)  # alpha ends at 0.99
            np.testing.assert_allclose(shown[1], by_iec(shown[0]), atol=0.004 if degree else 1e-4)


@pytest.mark.parametrize("space", ["srgb_rec709_display", "BT.709-sRGB", None])
def test_srgb_colours_stay(tmp_path: Path, space: str | None) -> None:
    g = flat()
    g.save(tmp_path / "a.glb")
    change_gltf(
        tmp_path / "a.glb",
        lambda c: extension(c).update(colorSpace=space) if space else extension(c).pop("colorSpace"),
    )
    read = hqgs.Gaussians.load(tmp_path / "a.glb")
    torch.testing.assert_close(read.sh0, g.sh0)
    assert read.notes == ([] if space else ["it names no colour space: its colours were read as sRGB"])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda c: c.update(extensionsRequired=[NAME, "EXT_of_tomorrow"]), "EXT_of_tomorrow"),
        (lambda c: c.update(extensionsRequired=[f"{NAME}_compression_spz_2"]), "compression_spz_2"),
        (lambda c: c.update(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
        (lambda c: extension(c).update(extensions={f"{NAME}_compression_spz": {}}), "compression_spz"),
        (lambda c: extension(c).update(kernel="gabor"), "kernel is 'gabor'"),
        (lambda c: extension(c).update(projection="orthographic"), "projection is 'orthographic'"),
        (lambda c: extension(c).update(sortingMethod="none"), "sortingMethod is 'none'"),
        (lambda c: extension(c).update(colorSpace="lin_p3d65_display"), "colorSpace is 'lin_p3d65_display'"),
        (lambda c: extension(c).update(kernel=3), "kernel is 3"),
    ],
)  # fmt: skip
def test_what_a_gltf_file_needs_and_is_unknown_is_named(tmp_path: Path, change: Any, named: str) -> None:
    flat().save(tmp_path / "a.glb")
    change_gltf(tmp_path / "a.glb", change)
    with pytest.raises(ValueError, match=rf"a\.glb.*{named}"):
        hqgs.Gaussians.load(tmp_path / "a.glb")


def test_what_a_gltf_file_needs_for_its_points_alone_is_read(tmp_path: Path) -> None:
    g = flat()
    g.save(tmp_path / "a.glb")
    change_gltf(tmp_path / "a.glb", lambda c: c.update(extensionsRequired=[NAME, "KHR_materials_unlit"]))
    change_gltf(tmp_path / "a.glb", lambda c: extension(c).update(sortingMethod="zDepth"))
    torch.testing.assert_close(hqgs.Gaussians.load(tmp_path / "a.glb").means, g.means)


TURNED = Rotation.from_euler("xyz", [30, -50, 20], degrees=True)


@pytest.mark.parametrize(
    "world",
    [
        World(up=(0.0, 0.6, -0.8)),
        World(unit=0.25, shift=(3.0, -2.0, 7.0), up=(0.0, -1.0, 0.0)),
        World(shift=(5e6, 1e6, 200.0)),
    ],
)
def test_a_scene_of_ours_that_was_moved_is_where_its_node_says(tmp_path: Path, world: World) -> None:
    """Moved by 10 along an axis of the file, and turned and enlarged: by the frame of the file in numbers."""
    g = random_gaussians(40, 2)
    g.world = world
    g.save(tmp_path / "a.glb")
    still = hqgs.Gaussians.load(tmp_path / "a.glb")
    assert torch.equal(still.means, g.means)
    assert (still.world, still.moved, still.notes) == (world, None, [])
    before = world.out(g.means.double().numpy())

    def shifted(content: Any) -> None:
        node = content["nodes"][0]
        node["translation"] = [node["translation"][0] + 10, *node["translation"][1:]]

    change_gltf(tmp_path / "a.glb", shifted)
    read = hqgs.Gaussians.load(tmp_path / "a.glb")
    away = read.world.out(read.means.double().numpy()) - before
    assert np.ptp(away, axis=0).max() < 1e-3
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 10, atol=1e-3)
    if world.up == (0.0, -1.0, 0.0):
        np.testing.assert_allclose(away[0], [10, 0, 0], atol=1e-3)
    assert read.world.up == world.up
    assert any("moved" in note for note in read.notes)
    read.save(tmp_path / "b.glb")  # and stays there
    again = hqgs.Gaussians.load(tmp_path / "b.glb")
    np.testing.assert_allclose(again.world.out(again.means.double().numpy()) - before, away, atol=1e-3)


def test_a_parent_that_turns_and_enlarges_counts(tmp_path: Path) -> None:
    g = flat(1)
    g.world = World(unit=0.5, shift=(1.0, 2.0, 3.0), up=(0.0, 0.6, -0.8))
    g.save(tmp_path / "a.glb")

    def under(content: Any) -> None:
        content["nodes"].append(
            {"children": [0], "rotation": TURNED.as_quat().tolist(), "scale": [2.0, 2, 2]}
        )
        content["scenes"][0]["nodes"] = [1]

    change_gltf(tmp_path / "a.glb", under)
    read = hqgs.Gaussians.load(tmp_path / "a.glb")
    before, after = (s.world.out(s.means.double().numpy()) for s in (g, read))
    apart = [np.linalg.norm(x[:, None] - x[None], axis=2) for x in (before, after)]
    np.testing.assert_allclose(apart[1], 2 * apart[0], atol=1e-4)
    torch.testing.assert_close(read.scales.sum(), g.scales.sum() + 3 * len(g) * np.log(2), rtol=1e-5, atol=0)


def run_folder(tmp_path: Path) -> tuple[Path, hqgs.Gaussians]:
    """A folder with scene and cameras of a run."""
    truth, gaussians = photographed(make_truth(6))
    write_colmap(truth, tmp_path / "scene")
    scene = load_scene(tmp_path / "scene")
    save_cameras(tmp_path / "run", scene)
    gaussians.world = scene.world
    return tmp_path / "run", gaussians


def pictures(folder: Path) -> list[np.ndarray]:
    return [np.asarray(Image.open(file)).astype(int) for file in sorted(folder.glob("*.png"))]


def test_views_and_paths_of_a_run_go_along_with_its_moved_scene(tmp_path: Path) -> None:
    run, gaussians = run_folder(tmp_path)
    gaussians.world = replace(gaussians.world, up=(0.0, 0.6, -0.8))
    gaussians.save(run / "scene.glb")
    save_path(tmp_path / "path.json", hqgs.load_cameras(run).train[:2], world=gaussians.world)

    def rendered(name: str) -> list[np.ndarray]:
        for kind, given in (("views", "all"), ("path", tmp_path / "path.json")):
            out = tmp_path / f"{name}-{kind}"
            assert main(["render", str(run / "scene.glb"), f"--{kind}", str(given), "--out", str(out)]) == 0
        return [*pictures(tmp_path / f"{name}-views"), *pictures(tmp_path / f"{name}-path")]

    before = rendered("before")

    def move(content: Any) -> None:
        content["nodes"].append(
            {
                "children": [0],
                "rotation": TURNED.as_quat().tolist(),
                "scale": [2.0, 2, 2],
                "translation": [1.0, 2, 3],
            }
        )
        content["scenes"][0]["nodes"] = [1]

    change_gltf(run / "scene.glb", move)
    after = rendered("after")
    assert len(before) == len(after) == 8
    assert np.std(before) > 10
    assert max(np.abs(a - b).max() for a, b in zip(before, after, strict=True)) <= 1
    change_gltf(run / "scene.glb", lambda c: c["nodes"][1].update(scale=[2.0, 1, 1]))
    assert main(["render", str(run / "scene.glb"), "--views", "all", "--out", str(tmp_path / "no")]) == 2


@pytest.mark.parametrize("kind", ["lost comment", "another's", "lost frame beside it"])
def test_views_and_paths_find_a_scene_whose_frame_nothing_says(tmp_path: Path, kind: str) -> None:
    """Cameras of a run whose world was moved, beside a scene in the photos' frame: as photographed."""
    truth = make_truth(6)
    truth = replace(truth, params=[42.0, 42, 24, 18], K=np.array([[42.0, 0, 24], [0, 42, 18], [0, 0, 1]]))
    truth, gaussians = photographed(truth)
    far = truth.viewmats.copy()
    far[:, :3, 3] = 1024 * far[:, :3, 3] - far[:, :3, :3] @ (30000.0, -2000, 500)
    write_transforms(replace(truth, viewmats=far), tmp_path / "scene", fl_x=42, cx=24, cy=18)
    scene = load_scene(tmp_path / "scene", points=False)
    assert not scene.world.ordinary
    save_cameras(tmp_path / "run", scene)
    gaussians.world = World(1024.0, (30000.0, -2000.0, 500.0))
    name = {"lost comment": "scene.ply", "another's": "a.splat"}.get(kind, "a.spz")
    if name == "a.spz":
        gaussians.in_world(scene.world).save(tmp_path / "run" / name)
        (tmp_path / "run/a.spz.world.json").unlink()
    else:
        means = gaussians.world.out(gaussians.means.double().numpy())
        bare = replace(gaussians, means=torch.from_numpy(means).float(), world=World())
        bare.scales = bare.scales + np.log(1024)
        bare.save(tmp_path / "run" / name)
    K, size = truth.K, (truth.width, truth.height)
    save_path(tmp_path / "path.json", [Camera(*size, K, viewmat) for viewmat in far])
    shown = []
    for way, given in (("views", "view_01,images/view_04.png"), ("path", tmp_path / "path.json")):
        out = tmp_path / way
        assert main(["render", str(tmp_path / "run" / name), f"--{way}", str(given), "--out", str(out)]) == 0
        shown += pictures(out)
    wanted = [truth.photos[k].astype(int) for k in (1, 4, *range(6))]
    worst = max(np.abs(a - b).max() for a, b in zip(shown, wanted, strict=True))
    assert worst <= (12 if name == "a.spz" else 1)  # of 8 bits


def test_a_camera_path_of_nerfstudio_goes_along_with_its_export(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written = export(tmp_path)
    inside, _ = looks(np.c_[TURN, SHIFT], SCALE)
    K = np.array([[60.0, 0, 24], [0, 60, 18], [0, 0, 1]])
    inside = hqgs.Camera(48, 36, K, inside.viewmat)
    save_path(tmp_path / "camera_path.json", [inside, inside])
    out = tmp_path / "out"
    path = ["--path", str(tmp_path / "camera_path.json")]
    assert main(["render", str(tmp_path / "splat.ply"), *path, "--out", str(out)]) == 0
    assert "camera paths that lie beside it are taken there" in capsys.readouterr().out
    wanted = (255 * written.render(inside).clamp(0, 1)).round().int().numpy()
    assert np.abs(pictures(out)[0] - wanted).max() <= 1
    read = hqgs.Gaussians.load(tmp_path / "splat.ply")
    again = tmp_path / "again.json"  # as the viewer saves it: nerfstudio reads it
    shown, _ = load_path(tmp_path / "camera_path.json")
    save_path(again, [moved(shown[0], read.world, read.moved)], world=read.world, by=read.moved)
    np.testing.assert_allclose(load_path(again)[0][0].viewmat, inside.viewmat, atol=1e-9)


@pytest.mark.parametrize("kind", ["equirectangular", "fisheye", "vr180", "omnidirectional_l", "orthographic"])
def test_paths_of_other_cameras_are_refused_by_name(tmp_path: Path, kind: str) -> None:
    save_path(tmp_path / "a.json", [looks(np.eye(4), 1.0)[0]])
    value = json.loads((tmp_path / "a.json").read_text())
    for changed in (
        {**value, "camera_type": kind},
        {**value, "camera_path": [{**value["camera_path"][0], "camera_type": kind}]},
    ):
        (tmp_path / "a.json").write_text(json.dumps(changed))
        with pytest.raises(ValueError, match=rf"a\.json.*camera_type is '{kind}'"):
            load_path(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("comments", "flag"),
    [
        (["antialiased 1"], True),  # Postshot
        (["antialiased 0"], False),
        (["Exported from Brush", "SplatRenderMode: mip"], True),
        (["SplatRenderMode: default"], False),
        (["SplatRenderMode: default", "splatrendermode:MIP"], True),  # the last counts
        (["train_flags antialiasing"], True),
        (["Antialiasing: on"], True),
        ([], False),
    ],
)
@pytest.mark.parametrize("info", [False, True])
def test_the_antialias_flag_of_other_programs(
    tmp_path: Path, comments: list[str], flag: bool, info: bool
) -> None:
    names, _ = layout("3dgs", 0)
    path = write(tmp_path / "a.ply", values(names), names, comments)
    if info:
        path.write_bytes(path.read_bytes().replace(b"comment ", b"obj_info "))
    read = hqgs.Gaussians.load(path)
    assert (read.antialiased, read.notes) == (flag, [])
    for name in ("b.ply", "b.compressed.ply", "b.full.ply"):
        read.save(tmp_path / name)
        assert hqgs.Gaussians.load(tmp_path / name).antialiased == flag
        assert (b"comment SplatRenderMode: mip\n" in (tmp_path / name).read_bytes()) == flag


@pytest.mark.parametrize(
    ("comment", "up"),
    [
        ("Vertical axis: y", None),  # as Brush writes it: y is down, as where nothing is said
        ("Vertical Axis: z", (0, 0, 1)),  # nerfstudio
        ("vertical axis: x", (1, 0, 0)),
        ("Vertical axis: 0.0 -0.6 0.8", (0, -0.6, 0.8)),
        ("up: -z", (0, 0, -1)),
        ("Up axis: [0, 2, 0]", (0, 1, 0)),
        ("up_vector = +y", (0, 1, 0)),
    ],
)
def test_up_of_other_programs(tmp_path: Path, comment: str, up: tuple[float, ...] | None) -> None:
    names, _ = layout("gsplat", 0)
    read = hqgs.Gaussians.load(write(tmp_path / "a.ply", values(names), names, [comment]))
    assert (read.world.up is None) if up is None else np.allclose(read.world.up or (), up)
    assert any("up is (" in note for note in read.notes)
    read.save(tmp_path / "b.spz")
    assert hqgs.Gaussians.load(tmp_path / "b.spz").world.up == read.world.up


@pytest.mark.parametrize(
    ("comment", "metres", "words"),
    [
        ("units: m", 1.0, "its unit is a metre"),
        ("Length unit: metres", 1.0, "its unit is a metre"),
        ("unit mm", None, "'unit mm', which was ignored"),
        ("Handedness: left", None, "'Handedness: left', which was ignored"),
        ("offset 500000 5200000 0", None, "which was ignored"),
        ("colorspace linear", None, "which was ignored"),
        ("SplatRenderMode: 2dgs", None, "which was ignored"),
        ("Vertical axis: north", None, "which was ignored"),
        ("EPSG:32632", None, "which was ignored"),
    ],
)
def test_what_comments_say_is_heeded_or_said(
    tmp_path: Path, comment: str, metres: float | None, words: str
) -> None:
    names, _ = layout("3dgs", 0)
    read = hqgs.Gaussians.load(write(tmp_path / "a.ply", values(names), names, [comment, "made by hand"]))
    assert read.world.metres == metres
    assert len(read.notes) == 1
    assert words in read.notes[0]


def test_the_axis_of_an_export_turns_with_it(tmp_path: Path) -> None:
    export(tmp_path)
    data = (tmp_path / "splat.ply").read_bytes()
    (tmp_path / "splat.ply").write_bytes(data.replace(b"element", b"comment Vertical Axis: z\nelement", 1))
    up = hqgs.Gaussians.load(tmp_path / "splat.ply").world.up
    np.testing.assert_allclose(up or (), TURN.T @ [0, 0, 1], atol=1e-9)


@pytest.mark.parametrize("word", ["see end_header of X", "end_header", "end_header\tlast", "end_headers"])
def test_a_comment_with_the_word_end_header(tmp_path: Path, word: str) -> None:
    g = random_gaussians(5, 1)
    g.world, g.antialiased = World(unit=0.25, shift=(3e6, -2.0, 7.0)), True
    g.save(tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    said = f"comment {word}\ncomment hqgs scene\n".encode()
    (tmp_path / "a.ply").write_bytes(data.replace(b"comment hqgs scene\n", said, 1))
    read = hqgs.Gaussians.load(tmp_path / "a.ply")
    assert (read.world, read.antialiased, read.notes) == (g.world, True, [])
    torch.testing.assert_close(read.means, g.means)


# --- A scene as nerfstudio exports it, read in the frame of its photos' cameras


TURN, SHIFT, SCALE = Rotation.from_euler("xyz", [20, -70, 130], degrees=True).as_matrix(), [3.0, -1, 2], 0.37
APPLIED = np.array([[1.0, 0, 0, 0.5], [0, 0, 1, 0], [0, -1, 0, -2]])


def export(folder: Path, name: str = "splat.ply") -> Gaussians:
    """Some Gaussians in nerfstudio's frame, written with the file that says how it got there."""
    torch.manual_seed(0)
    n = 40
    g = Gaussians(
        means=torch.rand(n, 3) - 0.5,
        scales=-3 + 0.5 * torch.randn(n, 3),
        quats=torch.randn(n, 4),
        opacities=torch.randn(n),
        sh0=torch.randn(n, 1, 3),
        shN=0.3 * torch.randn(n, 15, 3),
    )
    g.save(folder / name)
    ours = (folder / name).read_bytes()
    assert b"comment hqgs scene\n" in ours
    (folder / name).write_bytes(ours.replace(b"comment hqgs scene\n", b""))
    rows = np.c_[TURN, SHIFT].tolist()
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": rows, "scale": SCALE}))
    return g


def looks(matrix: np.ndarray, scale: float) -> tuple[Camera, Camera]:
    """One camera in nerfstudio's frame, and in that before x -> scale (matrix x)."""
    K = np.array([[60.0, 0, 24], [0, 60, 18], [0, 0, 1]])
    inside = np.eye(4)
    inside[:3, :3], inside[:3, 3] = Rotation.from_euler("xyz", [0.1, 0.4, 0.2]).as_matrix(), [0.1, 0, 2]
    before = np.eye(4)
    before[:3, :3] = inside[:3, :3] @ matrix[:3, :3]
    before[:3, 3] = inside[:3, :3] @ matrix[:3, 3] + inside[:3, 3] / scale
    return Camera(48, 36, K, inside), Camera(48, 36, K, before)


@pytest.mark.parametrize("applied", [False, True])
def test_an_export_is_read_in_the_frame_of_its_photos(tmp_path: Path, applied: bool) -> None:
    written = export(tmp_path)
    matrix, scale = np.c_[TURN, SHIFT], SCALE
    if (
        applied
    ):  # photos' cameras are those of transforms.json: x = applied (what COLMAP has), 3 times as large
        frames = {"frames": [], "applied_transform": APPLIED.tolist(), "applied_scale": 3.0}
        (tmp_path / "transforms.json").write_text(json.dumps(frames))
        turn = matrix[:, :3] @ APPLIED[:, :3].T
        matrix, scale = np.c_[turn, matrix[:, 3] - turn @ APPLIED[:, 3]], SCALE / 3.0
    inside, before = looks(matrix, scale)
    wanted = written.render(inside)
    assert wanted.std() > 0.05
    read = Gaussians.load(tmp_path / "splat.ply")
    torch.testing.assert_close(read.render(before), wanted, rtol=0, atol=2e-4)
    assert any("dataparser_transforms.json" in note for note in read.notes)
    assert not torch.allclose(written.render(before), wanted, atol=0.05)


def test_other_files_beside_it_stay_as_they_are(tmp_path: Path) -> None:
    written = export(tmp_path, "scene.ply")
    assert torch.equal(Gaussians.load(tmp_path / "scene.ply").means, written.means)
    content = (tmp_path / "scene.ply").read_bytes()
    (tmp_path / "scene.ply").write_bytes(
        content.replace(b"element", b"comment Generated by Nerfstudio 1.1.5\nelement", 1)
    )
    assert not torch.allclose(Gaussians.load(tmp_path / "scene.ply").means, written.means, atol=0.1)
    Gaussians.load(tmp_path / "scene.ply").save(tmp_path / "ours.ply")  # which says nothing of nerfstudio
    kept = hqgs.Gaussians.load(tmp_path / "ours.ply")
    assert torch.equal(kept.means, Gaussians.load(tmp_path / "scene.ply").means)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ("[]", r"expected an object, got \[\]"),
        ("{", "Expecting property name"),
        ('{"scale": 1}', "transform must be 3 rows of 4 numbers, got None"),
        ('{"scale": 1, "transform": [[1, 0, 0]]}', "transform must be 3 rows"),
        ('{"scale": 0, "transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}', "scale must be a number"),
        ('{"scale": 1, "transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]]}', "transform is singular"),
    ],
)  # fmt: skip
def test_a_damaged_frame_is_named(tmp_path: Path, said: str, message: str) -> None:
    export(tmp_path)
    (tmp_path / "dataparser_transforms.json").write_text(said)
    with pytest.raises(ValueError, match=f"dataparser_transforms.json.*{message}"):
        Gaussians.load(tmp_path / "splat.ply")
