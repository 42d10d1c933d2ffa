"""A pass from photos to a COLMAP model: features, matches, geometry, mapping, and how far it is.

It imports of hqgs what needs nothing else: `program.py` uses it in COLMAP's process.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from hqgs.scene.sfm.agree import Agreement, agreement, confirmed, loose_parts
from hqgs.scene.sfm.constants import (
    ALWAYS_CHECKED,
    COARSE,
    FALSE,
    FEWER,
    LARGEST,
    LEAST_PHOTOS,
    LOG_LOOKS,
    MATCHED_ALL,
    PROBED,
    RICH,
    ROUNDS,
    SELDOM,
    SIGMAS,
    UNSURE,
    WEAKLY_JOINT,
)
from hqgs.scene.sfm.database import known_cameras, new_cameras, rigs
from hqgs.scene.sfm.facts import apart, borne_out, counts, placed_names
from hqgs.scene.sfm.home import brought_home, without
from hqgs.scene.sfm.likely import likely_pairs, pairs_of_faces
from hqgs.scene.sfm.matching import extract, match, pipeline_options
from hqgs.scene.sfm.sharpen import sharpened
from hqgs.scene.sfm.tracks import read_tracks, rebuilt, usual
from hqgs.scene.sfm.versions import join, smoothed_copies

BLOCK = re.compile(r"Processing block \[(\d+)/(\d+)(?:, (\d+)/(\d+))?\]")


class Attempt:
    """A pass from photos to a model.

    The tolerant one takes weaker features, and fewer matches as enough. `smoothed` 1 looks at smoothed
    photos, 2 at all versions together, after 1 and the pass without, whose database is `plain`.
    """

    def __init__(
        self,
        directory: Path,
        given: dict[str, Any],
        threads: int,
        tolerant: bool = False,
        coarse: bool = False,
        smoothed: int = 0,
        plain: Path | None = None,
    ) -> None:
        self.directory: Path = directory
        self.given: dict[str, Any] = given
        self.threads: int = threads
        self.tolerant: bool = tolerant
        self.coarse: bool = coarse
        self.smoothed: int = smoothed
        self.plain: Path = plain or directory / "colmap.db"
        self.versions: list[Path] = [directory / f"smoothed_{sigma}.db" for sigma in SIGMAS]
        names = {"tolerant.db": tolerant, "coarse.db": coarse, "joined.db": smoothed == len(SIGMAS)}
        named = [directory / name for name, on in names.items() if on]
        self.database: Path = [*named, self.versions[0] if smoothed else self.plain][0]
        self.names: list[str] = given["names"].tolist()
        self.photos: Path = Path(str(given["photos"]))
        self.faces: int = len(given.get("rotations", [0]))  # of a photo
        self.fixed: bool = "Ks" in given or self.faces > 1
        self.model: pycolmap.Reconstruction | None = None
        self._sure: set[str] = set(self.names)  # photos that need not be borne out
        self.agree: Agreement = {}
        self.apart: list[list[str]] = []  # photos that fit each other, and not those of the model
        self._tell("features", 0)

    @property
    def registered(self) -> int:
        return 0 if self.model is None else self.model.num_reg_images()

    @staticmethod
    def _off(model: pycolmap.Reconstruction) -> float:
        """What observations are usually off, px of what SIFT sees."""
        sides = [max(camera.width, camera.height) for camera in model.cameras.values()]
        return usual(model) * min(1, LARGEST / float(np.median(sides)))

    def _begin(self, database: Path) -> None:
        """A database of photos and cameras, if it is not there."""
        if not database.exists():
            new = database.with_suffix(".new")
            new.unlink(missing_ok=True)
            known = known_cameras if "Ks" in self.given else rigs
            (known if self.fixed else new_cameras)(self.given, new)
            new.rename(database)

    def run(self) -> None:
        if not self.smoothed:
            self._begin(self.database)
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads, extraction.max_image_size = self.threads, LARGEST
        if self.tolerant:
            extraction.sift.peak_threshold /= 4
        photos = self.photos
        if self.coarse:
            self.coarse = self._probe(photos, extraction)
        if self.smoothed:
            self._look_smoothed(photos, extraction)
        else:
            todo = self.directory, photos, self.names, extraction, self.threads, self.database
            match(*todo, self._watched, lambda: self._pairs(self.database))
        self._tell("verify", 0)
        verifier = pycolmap.GeometricVerifierOptions()
        verifier.num_threads = self.threads
        verifier.rig_verification = self.faces > 1  # one geometry for all faces of two photos: floors repeat
        pycolmap.geometric_verification(self.database, verifier, two_view_geometry_options=self._geometry())
        models = pycolmap.incremental_mapping(
            self.database,
            photos,
            self.directory / f"models_{self.database.stem}",
            options=self._mapping(),
            initial_image_pair_callback=lambda: self._place(2),
            next_image_callback=lambda: self._place(1),
        )
        if models:
            order = sorted(models, key=lambda k: (-models[k].num_reg_images(), -models[k].num_points3D(), k))
            self.model = models[order[0]]
            self.apart = apart([placed_names(models[k]) for k in order], LEAST_PHOTOS)
            self._settle(self.model)

    def bring_home(self) -> None:
        """Place the photos that have no place where weaker evidence tells one."""
        if self.model is None or self.faces > 1 or self.registered == len(self.names):
            return
        self._tell("home", self.registered, len(self.names))
        self._sure = placed_names(self.model)
        folder = self.directory / f"home_{self.database.stem}"
        self.model = brought_home(self.model, self.database, self.photos, folder, self._mapping)

    def sharpen(self) -> None:
        """Move the observations to where the photos agree, and adjust again, where that is more precise.

        Then what the photos show is compared with what they should show, where that may not be the same;
        photos that were brought home do not stay where it is not.
        """
        if self.model is None or self.faces > 1:
            return
        self._tell("sharpen", 0)
        plain, unsure = self.model, self._off(self.model) > UNSURE
        rounds = ROUNDS if unsure else FEWER
        for _ in range(1 if self._sure >= placed_names(plain) else 2):  # weaker evidence: farther off
            self.model = sharpened(self.model, self.photos, self._adjust, not self.fixed, rounds)
        if self.model is plain and not self._sure >= placed_names(plain):
            self._settle(plain)
        whole = self.registered == len(self.names) >= ALWAYS_CHECKED
        if whole and not unsure and not loose_parts(plain, WEAKLY_JOINT):
            return
        self._tell("agree", 0)
        rest = rebuilt(self.model, *read_tracks(plain))
        self._adjust(rest, usual(plain), False)
        self.agree = agreement(rest, self.photos)
        strange = {name for name, counts in self.agree.items() if not confirmed(*counts)} - self._sure
        if strange:
            without(self.model, strange)
            self._adjust(self.model, usual(self.model), True)
            self.agree = {name: counts for name, counts in self.agree.items() if name not in strange}

    def _adjust(self, model: pycolmap.Reconstruction, scale: float, move: bool) -> None:
        """Bundle adjustment in which errors from `scale` px on count less; `move`: of the photos as well."""
        options = self._mapping().get_global_bundle_adjustment()
        options.refine_rig_from_world = move
        if not move:
            options.refine_focal_length = options.refine_extra_params = False
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = scale
        pycolmap.bundle_adjustment(model, options)

    def _look_smoothed(self, photos: Path, extraction: pycolmap.FeatureExtractionOptions) -> None:
        """Features and matches of the smoothed photos; of all versions, they are joined."""
        if self.database in self.versions:
            done, todo = [], self.versions[:1]
        elif self.database.exists():
            return
        else:
            done, todo = [self.plain, self.versions[0]], self.versions[1:]
        for sigma, version in zip(SIGMAS, self.versions, strict=True):
            if version not in todo:
                continue
            self._begin(version)
            copies = self.directory / f"photos_{sigma}"
            if not copies.is_dir():
                smoothed_copies(photos, copies, self.names, sigma, LARGEST)
            given = self.directory, copies, self.names, extraction, self.threads, version
            match(*given, self._watched, partial(self._pairs, version))
        if done:
            new = self.directory / "joining.db"
            new.unlink(missing_ok=True)
            self._begin(new)
            join([*done, *todo], new, len(self.names))
            new.rename(self.database)

    def _probe(self, photos: Path, extraction: pycolmap.FeatureExtractionOptions) -> bool:
        """Whether a few photos show enough where they are not enlarged; if so, `extraction` is to do without.

        SIFT looks at each photo at twice its size first, which takes three quarters of its time.
        """
        poor = self.directory / "poor"  # there: what was found coarsely is gone
        if poor.exists():
            return False
        fine = extraction.sift.first_octave, extraction.sift.max_num_features
        extraction.sift.first_octave, extraction.sift.max_num_features = 0, COARSE
        some = self.names[:: -(-len(self.names) // PROBED)]
        extract(self.directory, photos, some, extraction, self.database)
        with pycolmap.Database.open(self.database) as db:
            found = [db.num_keypoints_for_image(self.names.index(name) + 1) for name in some]
            if np.median(found) >= RICH:
                return True
            db.clear_keypoints()
            db.clear_descriptors()
        poor.touch()
        extraction.sift.first_octave, extraction.sift.max_num_features = fine
        return False

    def _pairs(self, database: Path) -> Any:
        """Pairs [P, 2] of photos that are to be matched by their features in `database`; None: all."""
        if "pairs" in self.given and not self.tolerant:
            return self.given["pairs"]
        pairs = None
        if len(self.names) > MATCHED_ALL and not self.tolerant:
            self._tell("matches", 0)
            with pycolmap.Database.open(database) as db:
                pairs = likely_pairs(db, len(self.names))
        return pairs if self.faces == 1 else pairs_of_faces(len(self.names), self.faces, pairs)

    def facts(self) -> dict[str, Any]:
        """What `Pass` holds of it."""
        placed = set() if self.model is None else placed_names(self.model)
        own = {"tolerant": self.tolerant, "registered": self.registered}
        if self.model is not None and self.faces > 1:
            own["borne_out"] = borne_out(self.database, self.model)
        elif self.model is not None:
            own["loose"] = loose_parts(self.model)
        return {**own, "agree": self.agree, "apart": self.apart, **counts(self.database, placed)}

    def _geometry(self) -> pycolmap.TwoViewGeometryOptions:
        geometry = pycolmap.TwoViewGeometryOptions()
        geometry.ransac.random_seed = 0
        if self.tolerant:
            geometry.min_num_inliers = 10
        return geometry

    def _mapping(self) -> pycolmap.IncrementalPipelineOptions:
        options = pipeline_options()
        options.min_model_size = LEAST_PHOTOS
        mapper = options.mapper
        if self.coarse:
            options.ba_global_frames_ratio = options.ba_global_points_ratio = SELDOM
            options.ba_global_max_refinements = 2
        if self.tolerant:
            options.min_num_matches = 10
            mapper.init_min_num_inliers, mapper.init_min_tri_angle = 50, 6.0
            mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio = 15, 0.15
        options.ba_refine_sensor_from_rig = False
        if self.fixed:
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
            mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
        return options

    def _settle(self, model: pycolmap.Reconstruction) -> None:
        """Poses and points without the observations that lie far off.

        While photos are placed an observation may be 4 px off. In small photos false matches so near turn the
        cameras: without them rotations are off 0.3 to 0.85 times as far.
        """
        mapping = self._mapping()
        for _ in range(ROUNDS):
            far = FALSE * float(np.median([point.error for point in model.points3D.values()]))
            seen = pycolmap.ObservationManager(model)
            seen.filter_all_points3D(far, mapping.mapper.filter_min_tri_angle)
            pycolmap.bundle_adjustment(model, mapping.get_global_bundle_adjustment())
            model.update_point_3d_errors()

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
            while not done.wait(LOG_LOOKS):
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
        now: dict[str, Any] = {"stage": stage, "done": done, "total": total}
        now |= {name: getattr(self, name) for name in ("tolerant", "smoothed")}
        new = self.directory / "stage.new"
        new.write_text(json.dumps(now), encoding="utf-8")
        new.replace(self.directory / "stage.json")
