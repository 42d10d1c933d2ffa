"""Tiny scenes with known cameras, written in each format the loaders read."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from PIL import Image

from hqgs.model.gaussians import Gaussians
from hqgs.photos.degrade import Degraded, degrade_sequence
from hqgs.photos.formula import Degradation
from hqgs.photos.pixels import to_uint8
from hqgs.scene.scene import Camera

CX, CY = 25.0, 17.5  # not the middle, so that a swapped axis shows
FX, FY = 40.0, 42.0
WIDTH, HEIGHT = 48, 36


@dataclass(frozen=True)
class Truth:
    """What a fixture was written from."""

    names: list[str]
    viewmats: NDArray[np.float64]  # [N, 4, 4], world to camera, OpenCV
    photos: list[NDArray[np.uint8]]  # [H, W, 3] each
    points: NDArray[np.float64]  # [P, 3]
    colors: NDArray[np.uint8]  # [P, 3]
    model: str = "PINHOLE"
    params: list[float] = field(default_factory=lambda: [FX, FY, CX, CY])
    width: int = WIDTH
    height: int = HEIGHT

    K: NDArray[np.float64] = field(default_factory=lambda: np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1.0]]))


def make_truth(count: int = 9, suffix: str = ".png", seed: int = 0) -> Truth:
    """Cameras on an arc of about 100 degrees, 4 units from the origin, with unequal heights and some roll."""
    rng = np.random.default_rng(seed)
    viewmats = np.stack([_look_at_origin(0.22 * i - 0.8, 0.1 * np.sin(i), 0.05 * i) for i in range(count)])
    photos = [rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(count)]
    points = rng.uniform(-0.7, 0.7, (12, 3))
    colors = rng.integers(0, 256, (12, 3), dtype=np.uint8)
    return Truth([f"view_{i:02d}{suffix}" for i in range(count)], viewmats, photos, points, colors)


def photographed(truth: Truth, beside: float = 0.0) -> tuple[Truth, Gaussians]:
    """Solid Gaussians, and photos of them by cameras that stand so far beside those of the scene."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1.5, 1.5, (150, 3)).astype(np.float32)
    model = Gaussians.from_points(points, rng.integers(0, 255, (150, 3)).astype(np.uint8), 0)
    model = replace(model, opacities=model.opacities + 4)
    photos = []
    for viewmat in truth.viewmats.copy():
        viewmat[0, 3] += beside
        with torch.no_grad():
            seen = model.render(Camera(truth.width, truth.height, truth.K, viewmat))
        photos.append(to_uint8(seen.clamp(0, 1).numpy()))
    return replace(truth, photos=photos), model


def _look_at_origin(azimuth: float, elevation: float, roll: float) -> NDArray[np.float64]:
    center = 4 * np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), -np.cos(azimuth) * np.cos(elevation)]
    )
    forward = -center / np.linalg.norm(center)
    right = np.cross([0, 1.0, 0], forward)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([c * right + s * down, -s * right + c * down, forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return viewmat


def quaternion(R: NDArray[np.float64]) -> list[float]:
    """w, x, y, z of a rotation by less than 180 degrees."""
    w = 0.5 * np.sqrt(1 + np.trace(R))
    x, y, z = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w)
    return [w, x, y, z]


def write_photos(truth: Truth, folder: Path, names: list[str] | None = None) -> None:
    for name, photo in zip(names or truth.names, truth.photos, strict=True):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(photo).save(path)


def write_colmap(
    truth: Truth, root: Path, *, binary: bool = True, model: str = "sparse/0", images: str | None = "images"
) -> Path:
    """A COLMAP scene. The text files follow COLMAP's description of them; pycolmap makes the binary ones."""
    folder = root / model
    folder.mkdir(parents=True, exist_ok=True)
    numbers = " ".join(repr(float(p)) for p in truth.params)
    (folder / "cameras.txt").write_text(f"7 {truth.model} {truth.width} {truth.height} {numbers}\n")
    lines = []
    for i in reversed(range(len(truth.names))):  # not in the order of the names
        pose = [*quaternion(truth.viewmats[i, :3, :3]), *truth.viewmats[i, :3, 3]]
        lines += [f"{i + 3} {' '.join(repr(float(v)) for v in pose)} 7 {truth.names[i]}", "1.5 2.5 -1"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = [
        " ".join([str(i + 1), *(repr(float(v)) for v in p), *(str(v) for v in c), "0.5"])
        for i, (p, c) in enumerate(zip(truth.points, truth.colors, strict=True))
    ]
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
    if binary:
        reconstruction = pycolmap.Reconstruction()
        reconstruction.read_text(folder)
        reconstruction.write_binary(folder)
        for text in folder.glob("*.txt"):
            text.unlink()
    if images is not None:
        write_photos(truth, root / images)
    return root


def write_llff(
    truth: Truth, root: Path, *, images: str = "images", names: list[str] | None = None, full: int = 1
) -> Path:
    """poses_bounds.npy for photos `full` times as large as those written; one focal length, centred."""
    root.mkdir(parents=True, exist_ok=True)
    rows = []
    for viewmat in truth.viewmats:
        right, down, forward = viewmat[:3, :3]
        center = -viewmat[:3, :3].T @ viewmat[:3, 3]
        size = [HEIGHT * full, WIDTH * full, FX * full]
        rows.append([*np.stack([down, right, -forward, center, size], 1).ravel(), 2.0, 9.0])
    np.save(root / "poses_bounds.npy", np.array(rows))
    write_photos(truth, root / images, names)
    return root


def frames(truth: Truth, folder: str = "images") -> list[dict[str, Any]]:
    """Frames of a transforms.json: camera to world, x right, y up, z back."""
    out = []
    for name, viewmat in zip(truth.names, truth.viewmats, strict=True):
        right, down, forward = viewmat[:3, :3]
        c2w = np.eye(4)
        c2w[:3] = np.stack([right, -down, -forward, -viewmat[:3, :3].T @ viewmat[:3, 3]], 1)
        out.append({"file_path": f"{folder}/{name}", "transform_matrix": c2w.tolist()})
    return out


def write_transforms(truth: Truth, root: Path, **values: Any) -> Path:
    """A nerfstudio scene; `values` are added to the file, None removes one."""
    write_photos(truth, root / "images")
    meta = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT, "frames": frames(truth)}
    meta = {k: v for k, v in {**meta, **values}.items() if v is not None}
    (root / "transforms.json").write_text(json.dumps(meta))
    return root


def subset(truth: Truth, keep: list[int]) -> Truth:
    return replace(
        truth,
        names=[truth.names[i] for i in keep],
        viewmats=truth.viewmats[keep],
        photos=[truth.photos[i] for i in keep],
    )


def degrade_image(
    image: NDArray[Any], degradation: Degradation, rng: np.random.Generator, factor: float | None = None
) -> Degraded:
    """One photo, as `degrade_sequence` degrades it."""
    return degrade_sequence([image], degradation, [rng], [factor])[0]
