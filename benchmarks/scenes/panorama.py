"""The room as a camera sees it that looks all around: panoramas of 360 x 180 degrees."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from benchmarks.scenes.room.scene import assemble
from benchmarks.scenes.room.shading import render_view
from benchmarks.scenes.wild import WildRoom, kept_photos
from hqgs.photos.light import to_linear, to_srgb
from hqgs.scene.faces import CUBE, around, face_name, faces_of
from hqgs.scene.scene import Camera
from hqgs.scene.views import to_pinhole

WIDTH = 1008  # px of a panorama
PLACES = 14  # of the camera
TEST_EVERY = 4  # places; of these the faces are held out
OPEN = "back"  # the face on the side where the room has no wall: nothing is judged there
MIDDLE, REACH = (0.0, -0.4, 1.6), (1.6, 0.4, 1.1)  # of its places, world units
TILT = 5.0  # degrees that the camera is held askew, most
LEAST_WIDTH = 64  # px
FINER = 2  # px of the ray-cast faces a pixel of the panorama, each way


def panorama_poses(places: int = PLACES) -> list[NDArray[np.float64]]:
    """World to camera [4, 4]: a walk in a ring before the table, the camera turned and tilted a little."""
    rng = np.random.default_rng(360)
    poses = []
    for k in range(places):
        angle, jitter = 2 * math.pi * k / places, rng.uniform(-1, 1, 6)
        center = np.array(MIDDLE) + np.array(REACH) * [math.cos(angle), jitter[0], math.sin(angle)]
        turn = Rotation.from_euler("yxz", [20 * jitter[1], *(TILT * jitter[2:4])], degrees=True).as_matrix()
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ center
        poses.append(viewmat)
    return poses


def face_cameras(viewmat: NDArray[np.float64], width: int) -> dict[str, Camera]:
    """The pinhole cameras of the faces of a panorama of `width` px at a pose."""
    found = {}
    for face in faces_of(around(width, width // 2)):
        pose = np.eye(4)
        pose[:3] = face.rotation @ viewmat[:3]
        found[face.name] = Camera(face.width, face.height, face.K, pose)
    return found


def panorama_room(cache: Path | None = None, width: int = WIDTH, places: int = PLACES) -> WildRoom:
    """The room by a camera that sees all around: ray-cast panoramas of `width` px, cut into faces of cubes.

    The faces of every 4th place are held out and ray-cast as pinhole photos, which the clean scene also has
    for those to train on: the same view directions and as many pixels, without the way over a panorama.
    Poses are exact, points those of the clean photos. ValueError for fewer than 2 places, or a width that is
    odd or below 64 px.
    """
    if places < 2:
        raise ValueError(f"places is {places}, wanted at least 2")
    if width < LEAST_WIDTH or width % 2:
        raise ValueError(f"width is {width}, wanted an even number from {LEAST_WIDTH} on")
    poses = panorama_poses(places)
    cameras: dict[str, Camera] = {}
    held_out: dict[int, str] = {}
    for k, pose in enumerate(poses):
        for face, camera in face_cameras(pose, width).items():
            if k % TEST_EVERY == 0:
                if face == OPEN:
                    continue
                held_out[len(cameras)] = "view"
            cameras[face_name(f"panorama_{k:02d}.png", face)] = camera
    clean = assemble(
        "true-panorama",
        list(cameras.values()),
        None if cache is None else cache / "clean",
        {"cameras": "panorama", "places": places},
        held_out=held_out,
        names=list(cameras),
    )
    made = {"kind": "panorama", "width": width, "places": places}
    names = {k: f"panorama_{k:02d}.png" for k in range(places) if k % TEST_EVERY}
    panoramas = kept_photos(
        None if cache is None else cache / "panoramas.npz",
        made,
        lambda: {name: render_panorama(poses[k], width) for k, name in names.items()},
    )
    camera = around(width, width // 2)
    faces = {face.name: to_pinhole(camera, width, width // 2, face=face) for face in faces_of(camera)}
    photos = {
        face_name(name, face): flat.picture(photo)
        for name, photo in panoramas.items()
        for face, flat in faces.items()
    }
    note = f"training views are faces of {len(names)} ray-cast panoramas of {width} x {width // 2} px"
    train = [replace(view, image=photos[view.name], face=view.name.split(".")[1]) for view in clean.train]
    return WildRoom(replace(clean, train=train, notes=[*clean.notes, note]), clean, {})


def render_panorama(viewmat: NDArray[np.float64], width: int = WIDTH) -> NDArray[np.uint8]:
    """The panorama [width / 2, width, 3] at a pose, sRGB.

    The room is ray-cast on the faces of a cube, FINER times as densely, with a border that hides their
    seams; FINER x FINER rays of each pixel are looked up there and averaged in linear light.
    """
    focal = FINER * width / (2 * math.pi)
    half = math.ceil(1.02 * focal)
    K = np.array([[focal, 0, half], [0, focal, half], [0, 0, 1]])
    across, down = FINER * width, FINER * width // 2
    longitude = ((np.arange(across) + 0.5) / across * 2 - 1) * math.pi
    latitude = ((np.arange(down) + 0.5) / down - 0.5) * math.pi
    rays = np.stack(
        [
            np.cos(latitude)[:, None] * np.sin(longitude),
            np.broadcast_to(np.sin(latitude)[:, None], (down, across)),
            np.cos(latitude)[:, None] * np.cos(longitude),
        ],
        -1,
    )
    nearest = np.argmax(np.stack([rays @ rotation[2] for rotation in CUBE.values()]), axis=0)
    light = np.empty((down, across, 3), np.float32)
    for k, rotation in enumerate(CUBE.values()):
        pose = np.eye(4)
        pose[:3] = rotation @ viewmat[:3]
        picture = to_linear(render_view(Camera(2 * half, 2 * half, K, pose), 2) / np.float32(255))
        mine = nearest == k
        seen = rays[mine] @ rotation.T
        at = focal * seen[:, 1::-1] / seen[:, 2:] + half - 0.5  # rows and columns of pixel centres
        for channel in range(3):
            light[mine, channel] = map_coordinates(picture[..., channel], at.T, order=1)
    mean = light.reshape(down // FINER, FINER, across // FINER, FINER, 3).mean((1, 3))
    return (to_srgb(mean) * 255 + 0.5).astype(np.uint8)
