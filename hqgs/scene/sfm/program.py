"""COLMAP in a process of its own: the program `python program.py COMMAND DIRECTORY`.

So a crash or a hang of COLMAP cannot take its caller along. It imports nothing of hqgs, so that it starts at
once. DIRECTORY holds `input.npz`: photos (the folder), names [V], and of known cameras sizes [V, 2] as width
and height and Ks [V, 3, 3], of known poses viewmats [V, 4, 4]. If DIRECTORY has a folder `masks`, each photo
has a mask `NAME.png` there. The files of COLMAP and the answer go into DIRECTORY:

`triangulate`: points for known cameras and poses, `points.npz` (points [P, 3] float32, colors [P, 3] uint8,
and of each sighting the numbers of the photo and of the point: photos [O], rows [O]).

`reconstruct THREADS`: poses and points, the folder `model` with the largest COLMAP model; none if there is
no model. Known cameras stay as they are. Of unknown ones, which are SIMPLE_RADIAL, `input.npz` has sizes
[C, 2], focal lengths in px, focals [C], 0 where nothing is known, and the number of each photo's camera,
camera_of [V]. Where it has pairs [P, 2], numbers of photos, the first pass matches those alone. Where that
registers few photos, a second, more tolerant one follows, with every pair; the better of the two counts.
`facts.json` says what both came to, `stage.json` what is being done now, which is read from COLMAP's log: the
caller sends the output to `log.txt`. A second call in the same DIRECTORY goes on with the features and
matches that the first one left. The program ends when its standard input does.
"""

from __future__ import annotations

import json
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

MAX_FEATURES = 2048  # per photo, of known cameras
MIN_TRACK, MAX_ERROR = 3, 1.0  # a point needs so many photos, and may miss them by so many pixels on average
LARGEST = 1600  # px a side: features of larger photos cost minutes and place no camera better than that
ENOUGH = 0.7  # of the photos: with fewer, the second pass follows
FOCAL = 1.2  # of the longer side, where nothing tells
BLOCKS = 8  # of photos, squared: what matching tells its progress in, and goes on from when interrupted
LISTED = 64  # blocks of pairs that are listed
EVERY = 0.5  # s between looks into the log
BLOCK = re.compile(r"Processing block \[(\d+)/(\d+)(?:, (\d+)/(\d+))?\]")


def triangulate(directory: Path) -> None:
    """SIFT, exhaustive matching, epipolar check against the known poses, triangulation; all on one thread.

    The check with known poses needs no RANSAC, so the same photos give the same points.
    """
    database, given = directory / "colmap.db", _given(directory)
    known = _known_cameras(given, database)
    photos, names = Path(str(given["photos"])), given["names"].tolist()
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    extraction.sift.max_num_features = MAX_FEATURES
    _match(directory, photos, names, extraction, 1, database)
    pycolmap.guided_geometric_verification(known, database, num_threads=1)
    (directory / "model").mkdir()
    model = pycolmap.triangulate_points(
        known, database, photos, directory / "model", options=_pipeline_options()
    )
    points = [model.points3D[k] for k in sorted(model.points3D)]
    points = [p for p in points if p.track.length() >= MIN_TRACK and p.error <= MAX_ERROR]
    np.savez(
        directory / "points.npz",
        points=np.array([p.xyz for p in points], np.float32).reshape(-1, 3),
        colors=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        photos=np.array([e.image_id - 1 for p in points for e in p.track.elements], np.intp),
        rows=np.array([k for k, p in enumerate(points) for _ in p.track.elements], np.intp),
    )


def reconstruct(directory: Path, threads: int) -> None:
    """SIFT, matching, RANSAC, incremental mapping; the threads change no bit of the result.

    Features and matches of one photo or pair depend on no other, and are read back in the order of their
    numbers. What draws random numbers or adds up in the order of arrival has one thread and the seed 0.
    """
    given = _given(directory)
    passes = [_Pass(directory, given, threads, tolerant=False)]
    passes[0].run()
    if passes[0].registered < ENOUGH * len(given["names"]):
        passes.append(_Pass(directory, given, threads, tolerant=True))
        passes[1].run()
    best = max(passes, key=lambda one: (one.registered, -one.tolerant))
    facts = json.dumps({"passes": [one.facts() for one in passes]})
    (directory / "facts.json").write_text(facts, encoding="utf-8")
    if best.model is not None:
        (directory / "model").mkdir(exist_ok=True)
        best.model.write_binary(directory / "model")
        (directory / "model" / "facts.json").write_text(facts, encoding="utf-8")


class _Pass:
    """One way from photos to a model; the tolerant one takes weaker features, and fewer matches as enough."""

    def __init__(self, directory: Path, given: dict[str, Any], threads: int, tolerant: bool) -> None:
        self.directory, self.given, self.threads, self.tolerant = directory, given, threads, tolerant
        self.database = directory / ("tolerant.db" if tolerant else "colmap.db")
        self.names: list[str] = given["names"].tolist()
        self.model: pycolmap.Reconstruction | None = None
        self._tell("features", 0)

    @property
    def registered(self) -> int:
        return 0 if self.model is None else self.model.num_reg_images()

    def run(self) -> None:
        fixed = "Ks" in self.given
        if not self.database.exists():
            new = self.database.with_suffix(".new")
            new.unlink(missing_ok=True)
            _known_cameras(self.given, new) if fixed else _new_cameras(self.given, new)
            new.rename(self.database)
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads, extraction.max_image_size = self.threads, LARGEST
        if self.tolerant:
            extraction.sift.peak_threshold /= 4
        photos = Path(str(self.given["photos"]))
        pairs = None if self.tolerant else self.given.get("pairs")
        todo = self.directory, photos, self.names, extraction, self.threads, self.database
        _match(*todo, self._watched, pairs)
        self._tell("verify", 0)
        verifier = pycolmap.GeometricVerifierOptions()
        verifier.num_threads = 1
        pycolmap.geometric_verification(self.database, verifier, two_view_geometry_options=self._geometry())
        models = pycolmap.incremental_mapping(
            self.database,
            photos,
            self.directory / f"models_{self.database.stem}",
            options=self._mapping(fixed),
            initial_image_pair_callback=lambda: self._place(2),
            next_image_callback=lambda: self._place(1),
        )
        if models:
            best = max(sorted(models), key=lambda k: (models[k].num_reg_images(), models[k].num_points3D()))
            self.model = models[best]

    def facts(self) -> dict[str, Any]:
        """Features of each photo, matches and those that a geometry bears out of each pair, both sorted."""
        with pycolmap.Database.open(self.database) as db:
            images = {image.image_id: image.name for image in db.read_all_images()}
            features = {name: int(db.num_keypoints_for_image(k)) for k, name in images.items()}
            _, matches = db.read_num_matches()
            _, inliers = db.read_two_view_geometry_num_inliers()
        return {
            "tolerant": self.tolerant,
            "registered": self.registered,
            "features": features,
            "matches": sorted(matches, reverse=True),
            "inliers": sorted(inliers, reverse=True),
        }

    def _geometry(self) -> pycolmap.TwoViewGeometryOptions:
        geometry = pycolmap.TwoViewGeometryOptions()
        geometry.ransac.random_seed = 0
        if self.tolerant:
            geometry.min_num_inliers = 10
        return geometry

    def _mapping(self, fixed: bool) -> pycolmap.IncrementalPipelineOptions:
        options = _pipeline_options()
        options.min_model_size = 3
        mapper = options.mapper
        if self.tolerant:
            options.min_num_matches = 10
            mapper.init_min_num_inliers, mapper.init_min_tri_angle = 50, 6.0
            mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio = 15, 0.15
        if fixed:
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
            mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
        return options

    def _place(self, photos: int) -> None:
        """Photos have a place; two: a model begins."""
        self._placed = photos if photos == 2 else self._placed + photos
        self._tell("place", self._placed, len(self.names))

    @contextmanager
    def _watched(self, stage: str, total: int) -> Iterator[None]:
        """Tell how far COLMAP's log says that it is, until the work is done.

        Not its database: two libraries of SQLite in a process take each other's locks away.
        """
        log = self.directory / "log.txt"
        start = log.stat().st_size if log.exists() else 0
        done = threading.Event()

        def watch() -> None:
            while not done.wait(EVERY):
                text = log.read_bytes()[start:].decode(errors="replace") if log.exists() else ""
                count = text.count("Processed file [")
                if blocks := BLOCK.findall(text):
                    row, rows, column, columns = (int(part or 1) for part in blocks[-1])
                    count = round(total * ((row - 1) * columns + column - 1) / (rows * columns))
                self._tell(stage, count, total)

        self._tell(stage, 0, total)
        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            done.set()
            watcher.join()

    def _tell(self, stage: str, done: int, total: int = 0) -> None:
        """What is being done, for whoever waits."""
        now = {"tolerant": self.tolerant, "stage": stage, "done": done, "total": total}
        new = self.directory / "stage.new"
        new.write_text(json.dumps(now), encoding="utf-8")
        new.replace(self.directory / "stage.json")


@contextmanager
def _unwatched(stage: str, total: int) -> Iterator[None]:
    yield


def _match(
    directory: Path,
    photos: Path,
    names: list[str],
    extraction: pycolmap.FeatureExtractionOptions,
    threads: int,
    database: Path,
    watched: Callable[[str, int], AbstractContextManager[None]] = _unwatched,
    pairs: Any = None,
) -> None:
    """Features, and matches of these pairs [P, 2] or of every pair, not yet checked by geometry."""
    reader = pycolmap.ImageReaderOptions()
    if (directory / "masks").is_dir():
        reader.mask_path = directory / "masks"
    with watched("features", len(names)):
        pycolmap.extract_features(
            database,
            photos,
            image_names=names,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.skip_geometric_verification = True
    if pairs is not None:
        listed = pycolmap.ImportedPairingOptions()
        listed.match_list_path, listed.block_size = directory / "pairs.txt", -(-len(pairs) // LISTED)
        listed.match_list_path.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs.tolist()))
        with watched("matches", len(pairs)):
            pycolmap.match_image_pairs(
                database, matching_options=matching, pairing_options=listed, device=pycolmap.Device.cpu
            )
        return
    pairing = pycolmap.ExhaustivePairingOptions()
    pairing.block_size = max(2, -(-len(names) // BLOCKS))
    with watched("matches", len(names) * (len(names) - 1) // 2):
        pycolmap.match_exhaustive(
            database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu
        )


def _pipeline_options() -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
    return options


def _given(directory: Path) -> dict[str, Any]:
    with np.load(directory / "input.npz", allow_pickle=False) as data:
        return dict(data)


def _known_cameras(given: dict[str, Any], database: Path) -> pycolmap.Reconstruction:
    """A reconstruction without points, and a database that gives its cameras and images the same numbers."""
    known = pycolmap.Reconstruction()
    names, sizes, Ks = (given[key] for key in ("names", "sizes", "Ks"))
    viewmats = given.get("viewmats", np.broadcast_to(np.eye(4), (len(names), 4, 4)))
    with pycolmap.Database.open(database) as db:
        for k, (size, K, viewmat) in enumerate(zip(sizes.tolist(), Ks, viewmats, strict=True), 1):
            pinhole = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
            camera = pycolmap.Camera(
                camera_id=k, model="PINHOLE", width=size[0], height=size[1], params=pinhole
            )
            camera.has_prior_focal_length = True
            image = pycolmap.Image(name=str(names[k - 1]), camera_id=k, image_id=k)
            known.add_camera_with_trivial_rig(camera)
            known.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
            db.write_camera(camera, use_camera_id=True)
            db.write_rig(known.rigs[k], use_rig_id=True)
            db.write_image(image, use_image_id=True)
            db.write_frame(known.frames[k], use_frame_id=True)
    return known


def _new_cameras(given: dict[str, Any], database: Path) -> None:
    """A database with the photos and their cameras, whose focal lengths and distortion COLMAP finds."""
    with pycolmap.Database.open(database) as db:
        for number, (focal, (width, height)) in enumerate(
            zip(given["focals"].tolist(), given["sizes"].tolist(), strict=True), 1
        ):
            camera = pycolmap.Camera(
                camera_id=number,
                model="SIMPLE_RADIAL",
                width=width,
                height=height,
                params=[focal or FOCAL * max(width, height), width / 2, height / 2, 0.0],
            )
            camera.has_prior_focal_length = focal > 0
            db.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(camera.sensor_id)
            db.write_rig(rig, use_rig_id=True)
        for k, (name, number) in enumerate(
            zip(given["names"].tolist(), (given["camera_of"] + 1).tolist(), strict=True), 1
        ):
            image = pycolmap.Image(name=name, camera_id=number, image_id=k)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=k, rig_id=number)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)


def _end_with_caller() -> None:
    """End when the caller does, who holds the other end of standard input."""
    while os.read(0, 1):  # not `sys.stdin`: its lock would be held when the program ends
        pass
    os._exit(1)


def main(command: str, directory: str, *options: str) -> None:
    pycolmap.set_random_seed(0)
    if command == "triangulate":
        pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL.value)
        triangulate(Path(directory))
    else:
        threading.Thread(target=_end_with_caller, daemon=True).start()
        reconstruct(Path(directory), *map(int, options))


if __name__ == "__main__":
    main(*sys.argv[1:])
