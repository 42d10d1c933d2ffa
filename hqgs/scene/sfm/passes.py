"""The passes from photos to a COLMAP model: features, matches, geometry, mapping, and how far it is."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image
from scipy.ndimage import gaussian_filter

from hqgs._rust import get_num_threads
from hqgs.base.evenly import evenly
from hqgs.base.threads import of_each
from hqgs.photos.pixels import grey
from hqgs.scene.constants import JPEG_QUALITY
from hqgs.scene.sfm.database import (
    INLIERS,
    LARGEST,
    LEAST_PHOTOS,
    MATCHES,
    extract,
    join,
    known_cameras,
    match,
    new_cameras,
    pipeline_options,
    table,
)
from hqgs.scene.sfm.facts import apart, borne_out, counts
from hqgs.scene.sfm.likely import MATCHED_ALL, PARTNERS, likely_pairs, pairs_of_faces
from hqgs.scene.sfm.refine import placed_names, refined
from hqgs.scene.sfm.refine.agree import Agreement, loose_parts

ALMOST = 0.95  # of the photos: with fewer, they are looked at again, more closely
# Features of a photo in short runs, before those with two directions count twice.
COARSE, FINE = 2048, 4096
BORNE_OUT = 0.78  # of the matches, by places found at once: 0.81 to 1 where right, 0.72 and 0.74 where wrong
# Photos by which a closer look is tried first; times the matches that it must bring, and that more of other
# kinds must (a film of 43 photos: 0.85, by which 12 of them found a place).
TRIED, GAIN, MORE = 6, 1.2, 0.5
GATE = 12, 0.1  # matches with points that agree on a place, and their share of all; least


@dataclass(frozen=True)
class Pass:
    """One way to look at the photos."""

    name: str
    # Photos as large as they are; else SIFT looks at them at twice their size: three quarters of its time.
    coarse: bool = False
    sigma: float = 0.0  # px of what SIFT sees, by which photos are smoothed
    of: tuple[Pass, ...] = ()  # whose features and matches it has side by side; the first went before


FINE_PASS = Pass("fine")
JOINED = Pass("joined", of=(FINE_PASS, Pass("smoothed", sigma=1.0), Pass("smoother", sigma=1.5)))
PASSES = (Pass("coarse", coarse=True), FINE_PASS, JOINED)  # until ALMOST all have a place


class Work:
    """The photos that are given, and the folder in which COLMAP works."""

    def __init__(self, directory: Path, given: dict[str, Any]) -> None:
        self.directory: Path = directory
        self.given: dict[str, Any] = given
        self.names: list[str] = given["names"].tolist()
        self.photos: Path = Path(str(given["photos"]))
        self.faces: int = len(given.get("rotations", [0]))  # of a photo
        self.fixed: bool = "Ks" in given or self.faces > 1
        self.quick: bool = "coarse" in given  # whether photos may be looked at coarsely

    def database(self, name: str) -> Path:
        """One of photos and cameras, made if it is not there."""
        path = self.directory / f"{name}.db"
        if not path.exists():
            new = path.with_suffix(".new")
            new.unlink(missing_ok=True)
            (known_cameras if "Ks" in self.given else new_cameras)(self.given, new)
            new.rename(path)
        return path

    def gains(self, one: Pass, before: Attempt) -> bool:
        """Whether photos that an attempt placed nowhere match those with a place better in another pass.

        A few are tried, those that match best as it is, each with two; where none has a place, a few of all.
        """
        count = len(self.names)
        placed = np.zeros(count, bool)
        if before.model is not None:
            has = placed_names(before.model)
            placed = np.array([name in has for name in self.names])
        next_ones = np.eye(count, k=1, dtype=np.int64) + np.eye(count, k=-1, dtype=np.int64)
        matches = table(before.database, count, MATCHES) + next_ones
        if placed.any():
            matches[:, ~placed] = matches[placed] = 0
            lost = np.argsort(-matches.max(axis=1), kind="stable")[:TRIED].tolist()
        else:
            lost = evenly(count, TRIED)
        partners = np.argsort(-matches, axis=1, kind="stable")[:, :2]
        pairs = {(min(k, j), max(k, j)) for k in lost for j in partners[k].tolist() if matches[k, j]}
        if not pairs:
            return False
        tried, least = np.array(sorted(pairs)), MORE if one.of else GAIN
        look = one.of[1] if one.of else one
        database = self.looked_at(look, [self.names[k] for k in np.unique(tried)], tried)
        self.verify(database)
        rows, columns = tried.T
        was, now = (
            int(table(path, count, INLIERS)[rows, columns].sum()) for path in (before.database, database)
        )
        return now > least * was

    def looked_at(self, one: Pass, some: Sequence[str], pairs: Any = None) -> Path:
        """The database with a pass's features of some photos, and the matches of these pairs, None: of all or
        the likely ones."""
        database = self.database(one.name)
        photos = self.smoothed(one.sigma, some) if one.sigma else self.photos
        self.tell("smoothed" if one.sigma else "features", 0, len(some))
        extract(self.directory, photos, list(some), self._extraction(one), database)
        pairs = self._pairs(database) if pairs is None else pairs
        self.tell("matches", 0, len(some) * (len(some) - 1) // 2 if pairs is None else len(pairs))
        match(self.directory, self.names, pairs, get_num_threads(), database)
        return database

    def joined(self, one: Pass) -> Path:
        """The database of a pass that has the features and matches of several."""
        path, new = self.directory / f"{one.name}.db", self.directory / "joining.db"
        if not path.exists():
            more = [self.looked_at(each, self.names) for each in one.of[1:]]
            new.unlink(missing_ok=True)
            join([self.database(one.of[0].name), *more], self.database(new.stem), len(self.names))
            new.rename(path)
        return path

    def _extraction(self, one: Pass) -> pycolmap.FeatureExtractionOptions:
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads, extraction.max_image_size = get_num_threads(), LARGEST
        if self.quick:
            extraction.sift.max_num_features = COARSE if one.coarse else FINE
        if one.coarse:
            extraction.sift.first_octave = 0
        return extraction

    def _pairs(self, database: Path) -> Any:
        """Pairs [P, 2] of photos that are to be matched by their features in `database`; None: all."""
        pairs = None
        if len(self.names) > MATCHED_ALL:
            self.tell("matches", 0)
            with pycolmap.Database.open(database) as db:
                pairs = likely_pairs(db, len(self.names), PARTNERS)
        return pairs if self.faces == 1 else pairs_of_faces(len(self.names), self.faces, pairs)

    def smoothed(self, sigma: float, names: Sequence[str]) -> Path:
        """A folder with smoothed copies of the photos of these names."""
        out = self.directory / f"photos_{sigma}"

        def copy(name: str) -> None:
            smooth_copy(self.photos / name, out / name, sigma, LARGEST)

        list(of_each(copy, names))
        return out

    def verify(self, database: Path) -> None:
        """Look for the geometry of each pair that matches."""
        geometry, verifier = pycolmap.TwoViewGeometryOptions(), pycolmap.GeometricVerifierOptions()
        geometry.ransac.random_seed = 0
        # COLMAP's 30,000 took 20 minutes of a corridor, and told the same pairs but for one in 23 that had 18
        # matches.
        geometry.ransac.max_num_trials, geometry.ransac.dyn_num_trials_multiplier = 1000, 1.0
        verifier.num_threads = get_num_threads()
        verifier.rig_verification = self.faces > 1  # one geometry for all faces of two photos: floors repeat
        pycolmap.geometric_verification(database, verifier, two_view_geometry_options=geometry)

    def mapping(self) -> pycolmap.IncrementalPipelineOptions:
        options = pipeline_options()
        options.min_model_size = LEAST_PHOTOS
        mapper = options.mapper
        if self.quick:
            # of what was found coarsely, all is adjusted seldom
            options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
            options.ba_global_max_refinements = 2
        options.ba_refine_sensor_from_rig = False
        if self.fixed:
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
            mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
        return options

    def adjust(self, model: pycolmap.Reconstruction, scale: float, move: bool) -> None:
        """Bundle adjustment in which errors from `scale` px on count less; `move`: of the photos as well."""
        options = self.mapping().get_global_bundle_adjustment()
        options.refine_rig_from_world = move
        if not move:
            options.refine_focal_length = options.refine_extra_params = False
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = scale
        pycolmap.bundle_adjustment(model, options)

    def settle(self, model: pycolmap.Reconstruction) -> None:
        """Poses and points without the observations that lie far off.

        While photos are placed an observation may be 4 px off. In small photos false matches so near turn the
        cameras: without them rotations are off 0.3 to 0.85 times as far.
        """
        mapping = self.mapping()
        for _ in range(3):
            far = 2.5 * float(np.median([point.error for point in model.points3D.values()]))
            seen = pycolmap.ObservationManager(model)
            seen.filter_all_points3D(far, mapping.mapper.filter_min_tri_angle)
            pycolmap.bundle_adjustment(model, mapping.get_global_bundle_adjustment())
            model.update_point_3d_errors()

    def tell(self, stage: str, done: int, total: int = 0) -> None:
        """What is being done, and where COLMAP's log begins to tell of it, for whoever waits."""
        log = self.directory / "log.txt"
        start = log.stat().st_size if log.exists() else 0
        now = {"stage": stage, "done": done, "total": total, "log": start}
        new = self.directory / "stage.new"
        new.write_text(json.dumps(now), encoding="utf-8")
        new.replace(self.directory / "stage.json")


class Attempt:
    """A pass over the photos, and the model that it comes to."""

    def __init__(self, work: Work, one: Pass) -> None:
        self.work: Work = work
        self.one: Pass = one
        self.database: Path = work.directory / f"{one.name}.db"
        self.model: pycolmap.Reconstruction | None = None
        self.agree: Agreement = {}
        self.apart: list[list[str]] = []  # photos that fit each other, and not those of the model
        self._sure: set[str] = set(work.names)  # photos that need not be borne out

    @property
    def registered(self) -> int:
        return 0 if self.model is None else self.model.num_reg_images()

    def run(self) -> None:
        work, placed, most = self.work, 0, 0

        def place(photos: int) -> None:
            nonlocal placed, most
            placed = photos if photos == 2 else placed + photos  # two: a model begins
            most = max(most, placed)
            work.tell("place", most, len(work.names))

        if self.one.of:
            work.joined(self.one)
        else:
            work.looked_at(self.one, work.names)
        work.tell("verify", 0)
        work.verify(self.database)
        models = pycolmap.incremental_mapping(
            self.database,
            work.photos,
            work.directory / f"models_{self.one.name}",
            options=work.mapping(),
            initial_image_pair_callback=lambda: place(2),
            next_image_callback=lambda: place(1),
        )
        if models:
            order = sorted(models, key=lambda k: (-models[k].num_reg_images(), -models[k].num_points3D(), k))
            self.model = models[order[0]]
            self.apart = apart([placed_names(models[k]) for k in order], LEAST_PHOTOS)
        if work.quick and work.faces == 1 and self.registered < ALMOST * len(work.names):
            self._at_once()
        if self.model is not None:
            work.settle(self.model)

    def _at_once(self) -> None:
        """Place all photos at once, where one after the other found few (a street walked along: no pair shows
        depth enough to begin with), and the matches bear the places out."""
        work = self.work
        folder = work.directory / f"global_{self.one.name}"
        folder.mkdir(exist_ok=True)
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads, options.random_seed = 1, 0
        copy = shutil.copyfile(self.database, folder / "colmap.db")  # it writes relative poses
        models = pycolmap.global_mapping(copy, work.photos, folder, options=options)
        best = max(models.values(), key=lambda one: one.num_reg_images(), default=None)
        if best is None:
            return
        share = borne_out(self.database, best)
        if best.num_reg_images() > self.registered and share >= BORNE_OUT:
            self.model, self.apart = best, []

    def bring_home(self) -> None:
        """Place the photos that have no place where weaker evidence tells one.

        COLMAP asks 30 matches with the model's points that agree, and a quarter of all. Bad photos often have
        half of it, and whole parts of a capture hang on one of them. What contradicts the new places is not
        left out yet: parts that hang on one photo may be bent there, and those observations are what will
        straighten them. What weak gates let in is judged at last, by what the photos show (`agree.py`).
        """
        work = self.work
        best = self.model
        if best is None or work.faces > 1 or self.registered == len(work.names):
            return
        work.tell("home", self.registered, len(work.names))
        self._sure = placed_names(best)
        folder = work.directory / f"home_{self.one.name}"
        start, out = folder / "start", folder / "found"
        for new in (start, out):
            shutil.rmtree(new, ignore_errors=True)
            new.mkdir(parents=True)
        best.write(start)
        options = work.mapping()
        options.mapper.abs_pose_min_num_inliers, options.mapper.abs_pose_min_inlier_ratio = GATE
        found = pycolmap.incremental_mapping(
            self.database, work.photos, out, options=options, input_path=start
        )
        held = [one for one in found.values() if placed_names(one) >= self._sure]
        self.model = max([best, *held], key=lambda one: one.num_reg_images())

    def refine(self) -> None:
        """Make places precise, and check them."""
        work, model = self.work, self.model
        if model is not None and work.faces == 1:
            given = work.photos, work, self._sure, len(work.names), LARGEST
            self.model, self.agree = refined(model, *given)

    def facts(self) -> dict[str, Any]:
        """What `Outcome` holds of it."""
        placed = set() if self.model is None else placed_names(self.model)
        own: dict[str, Any] = {"registered": self.registered}
        if self.model is not None and self.work.faces > 1:
            own["borne_out"] = borne_out(self.database, self.model)
        elif self.model is not None:
            own["loose"] = loose_parts(self.model)
        return {
            **own,
            "agree": self.agree,
            "apart": self.apart,
            **counts(self.database, self.work.names, placed),
        }


def best_attempt(work: Work) -> Attempt:
    """The best of the passes, with lost photos brought home."""
    best: Attempt | None = None
    for one in PASSES:
        if best is not None and (best.registered >= ALMOST * len(work.names) or not work.gains(one, best)):
            break
        if one.coarse and not work.quick:
            continue
        now = Attempt(work, one)
        now.run()
        if best is None or now.registered > best.registered - best.one.coarse:
            best = now
    assert best is not None  # the first pass has no condition
    best.bring_home()
    return best


def smooth_copy(photo: Path, target: Path, sigma: float, largest: int) -> None:
    """A gray copy of a photo, if it is not there, smoothed by `sigma` px of what SIFT sees.

    Noise and blocks hide features that it shows. SIFT sees photos whose longest side has more than `largest`
    px at that size.
    """
    if target.exists():
        return
    with Image.open(photo) as image:
        gray = np.asarray(grey(image), np.float32)
    smooth = gaussian_filter(gray, sigma * max(1, max(gray.shape) / largest), mode="nearest")
    target.parent.mkdir(parents=True, exist_ok=True)
    new = target.with_name(f"new {target.name}")
    Image.fromarray(np.rint(smooth).astype(np.uint8)).save(new, quality=JPEG_QUALITY, compress_level=1)
    new.replace(target)
