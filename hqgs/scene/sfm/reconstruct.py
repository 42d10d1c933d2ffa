"""Poses and points from the photos themselves (`--sfm`), by COLMAP in a process of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hqgs.base.stages import OnStage, silent
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.formats.colmap import seen_points
from hqgs.scene.scene import Scene, SfmReport, TrackStatistics, View
from hqgs.scene.sfm.align import Floats, align, camera_centers, pose_auc, refine, rotation_angles
from hqgs.scene.sfm.refine.tracks import read_tracks
from hqgs.scene.sfm.run import run_colmap
from hqgs.scene.sfm.triangulated import write_photos


def sfm_scene(scene: Scene, keep: Path | None = None, on_stage: OnStage = silent) -> Scene:
    """The scene with poses and points from its training photos as they are, in its own frame.

    COLMAP (SIFT, matching, incremental mapping) sees the training photos alone, clipped and
    rounded to 8 bits, with the scene's intrinsics, which stay as they are: held-out views share them. The
    reconstruction is moved into the scene's frame by the training cameras (`align`, `refine`), so that the
    held-out cameras, which are not touched, stay valid. Photos without a place in it are left out.
    `Scene.sfm` and `Scene.notes` compare the two. The same photos give the same bits, whatever the number of
    threads. `keep` is a folder for the reconstruction, which the next call with the same photos takes from
    there; `on_stage` hears what is being done.

    ValueError for fewer than 3 photos, or where less than half of them, or fewer than 3, are registered.
    """
    views = {f"{k:05d}.png": view for k, view in enumerate(scene.train)}
    ran = run_colmap(
        list(views),
        map(_content, views.values()),
        [view.camera for view in scene.train],
        lambda folder: write_photos(folder, views),
        keep,
        on_stage,
        called={file: view.name for file, view in views.items()},
    )
    model = ran.found
    poses = ran.poses()
    kept = [views[file] for file in poses]
    viewmats, own = np.stack(list(poses.values())), np.stack([view.camera.viewmat for view in kept])
    _, seen = read_tracks(model)
    similarity, inliers = align(viewmats, own)
    Ks = np.stack([view.camera.K for view in kept])
    similarity, misses = refine(similarity, seen, Ks, own)
    viewmats, points = similarity.viewmats(viewmats), similarity.points(seen.points)

    train = [
        replace(view, camera=replace(view.camera, viewmat=viewmat))
        for view, viewmat in zip(kept, viewmats, strict=True)
    ]
    tracks = TrackStatistics(model.compute_mean_track_length(), model.compute_mean_reprojection_error())
    off = float(np.median(misses))  # infinite where the own cameras have most of the points behind them
    rotation, translation = _compared(viewmats, own, scene.extent)
    report = SfmReport(
        photos=len(views),
        not_registered=[view.name for file, view in views.items() if file not in poses],
        outliers=[view.name for view, inlier in zip(kept, inliers, strict=True) if not inlier],
        own_cameras_px=off if np.isfinite(off) else None,
        points=len(points),
        track_length=tracks.length,
        reprojection_error_px=tracks.error,
        own_points=len(scene.points),
        lost=ran.lost(),
        rotation_error_deg=rotation,
        translation_error=translation,
        auc=dict(zip("135", pose_auc(viewmats, own, len(views)), strict=True)),
    )
    return replace(
        scene,
        train=train,
        points=points.astype(np.float32),
        point_colors=seen.colors,
        notes=[*scene.notes, str(report)],
        tracks=tracks,
        seen={views[file].name: rows for file, rows in seen_points(model).items()},
        sfm=report,
        guessed=False,
    )


def _content(view: View) -> bytes:
    """What tells a photo and its mask from others."""
    mask = b"" if view.mask is None else view.mask.tobytes()
    return to_uint8(as_floats(view.image)).tobytes() + mask


def _compared(found: Floats, own: Floats, extent: float) -> tuple[dict[str, float], dict[str, float]]:
    """How far poses are off the scene's own, world-to-camera matrices [V, 4, 4]: degrees; in extents."""
    degrees = np.rad2deg(rotation_angles(np.einsum("nij,nkj->nik", found[:, :3, :3], own[:, :3, :3])))
    apart = np.linalg.norm(camera_centers(found) - camera_centers(own), axis=1) / extent
    rotation, translation = (
        {"median": float(np.median(off)), "max": float(off.max())} for off in (degrees, apart)
    )
    return rotation, translation
