"""The passes from photos to a COLMAP model: features, matches, geometry, mapping, and how far it is.

It imports of hqgs what needs nothing else: `program.py` uses it in COLMAP's process.
"""

from __future__ import annotations

import json
import re
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image
from scipy.ndimage import gaussian_filter

from hqgs.base.evenly import evenly
from hqgs.photos.pixels import grey
from hqgs.scene.constants import JPEG_QUALITY
from hqgs.scene.sfm.database import (
    LARGEST,
    LEAST_PHOTOS,
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
TRIED, GAIN = 6, 1.2  # photos by which a closer look is tried first; times the matches that it must bring
TRIALS = 1000  # of RANSAC for each pair's geometry; COLMAP's 30,000 took 20 minutes of a corridor and told
# the same pairs but for one in 23 that had 18 matches
SELDOM = 1.3  # times the photos or points: until then, no adjustment of all that was found coarsely
GATES = ((15, 0.15), (12, 0.1))  # matches with points that agree on a place, and their share of all; least
FALSE = 2.5  # medians of the points' errors; what lies farther off is taken for a false match at last
_BLOCK = re.compile(r"Processing block \[(\d+)/(\d+)(?:, (\d+)/(\d+))?\]")


@dataclass(frozen=True)
class Pass:
    """One way to look at the photos. It is gone where passes before it placed `enough` of them."""

    name: str
    enough: float = ALMOST
    # Photos as large as they are; else SIFT looks at them at twice their size: three quarters of its time.
    coarse: bool = False
    sigmas: tuple[float, ...] = (0.0,)  # px of what SIFT sees: smoothed versions whose features join
    tolerant: bool = False  # weaker features, and fewer matches are enough


PASSES = (
    Pass("coarse", coarse=True),
    Pass("fine"),
    Pass("smoothed", sigmas=(1.0,)),
    Pass("joined", sigmas=(0.0, 1.0, 1.5)),
    Pass("tolerant", enough=0.7, tolerant=True),
)


class Work:
    """The photos that are given, and the folder in which COLMAP works."""

    def __init__(self, directory: Path, given: dict[str, Any], threads: int) -> None:
        self.directory: Path = directory
        self.given: dict[str, Any] = given
        self.threads: int = threads
        self.names: list[str] = given["names"].tolist()
        self.photos: Path = Path(str(given["photos"]))
        self.faces: int = len(given.get("rotations", [0]))  # of a photo
        self.fixed: bool = "Ks" in given or self.faces > 1
        self.quick: bool = "coarse" in given  # whether photos may be looked at coarsely
        self.now: Pass = PASSES[1]
        self.most: int = 0  # photos with a place in a model of this pass

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
        self.now, count = one, len(self.names)
        placed = np.zeros(count, bool)
        if before.model is not None:
            has = placed_names(before.model)
            placed = np.array([name in has for name in self.names])
        next_ones = np.eye(count, k=1, dtype=np.int64) + np.eye(count, k=-1, dtype=np.int64)
        matches = table(before.database, count, "read_num_matches") + next_ones
        if placed.any():
            matches[:, ~placed] = matches[placed] = 0
            lost = np.argsort(-matches.max(axis=1), kind="stable")[:TRIED].tolist()
        else:
            lost = evenly(count, TRIED)
        partners = np.argsort(-matches, axis=1, kind="stable")[:, :2]
        pairs = {(min(k, j), max(k, j)) for k in lost for j in partners[k].tolist() if matches[k, j]}
        if not pairs:
            return False
        tried = np.array(sorted(pairs))
        sigma = one.sigmas[-1]
        some = [self.names[k] for k in np.unique(tried)]
        photos, database = self._seen(one, sigma, some)
        self.match(photos, some, one, database, lambda: tried)
        self.verify(database)
        rows, columns = tried.T
        was, now = (
            int(table(path, count, "read_two_view_geometry_num_inliers")[rows, columns].sum())
            for path in (before.database, database)
        )
        return now > GAIN * was

    def looked_at(self, one: Pass) -> Path:
        """The database with a pass's features and matches; of several versions, they are joined."""
        versions = [self._version(one, sigma) for sigma in one.sigmas]
        if len(versions) == 1:
            return versions[0]
        joined = self.directory / f"{one.name}.db"
        if not joined.exists():
            (self.directory / "joining.db").unlink(missing_ok=True)
            new = self.database("joining")
            join(versions, new, len(self.names))
            new.rename(joined)
        return joined

    def _version(self, one: Pass, sigma: float) -> Path:
        photos, database = self._seen(one, sigma, self.names)
        self.match(photos, self.names, one, database, lambda: self._pairs(one, database))
        return database

    def _seen(self, one: Pass, sigma: float, names: Sequence[str]) -> tuple[Path, Path]:
        """The folder with photos of these names as a pass sees them, and the database of what it finds."""
        if sigma:
            return self.smoothed(sigma, names), self.database(f"smoothed_{sigma}")
        return self.photos, self.database(one.name if one.sigmas == Pass.sigmas else "fine")

    def match(
        self, photos: Path, some: list[str], one: Pass, database: Path, wanted: Callable[[], Any]
    ) -> None:
        """Features of some photos, then matches of the pairs that are wanted, or of all."""
        with self.watched("features", len(some)):
            extract(self.directory, photos, some, self._extraction(one), database)
        pairs = wanted()
        with self.watched("matches", len(some) * (len(some) - 1) // 2 if pairs is None else len(pairs)):
            match(self.directory, self.names, pairs, self.threads, database)

    def _extraction(self, one: Pass) -> pycolmap.FeatureExtractionOptions:
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads, extraction.max_image_size = self.threads, LARGEST
        if self.quick:
            extraction.sift.max_num_features = COARSE if one.coarse else FINE
        if one.coarse:
            extraction.sift.first_octave = 0
        if one.tolerant:
            extraction.sift.peak_threshold /= 4
        return extraction

    def _pairs(self, one: Pass, database: Path) -> Any:
        """Pairs [P, 2] of photos that are to be matched by their features in `database`; None: all."""
        if "pairs" in self.given and not one.tolerant:
            return self.given["pairs"]
        pairs = None
        if len(self.names) > MATCHED_ALL:
            self.tell("matches", 0)
            with pycolmap.Database.open(database) as db:
                most = PARTNERS * (2 if one.tolerant else 1)
                pairs = likely_pairs(db, len(self.names), most, self.threads)
        return pairs if self.faces == 1 else pairs_of_faces(len(self.names), self.faces, pairs)

    def smoothed(self, sigma: float, names: Sequence[str]) -> Path:
        """A folder with smoothed copies of the photos of these names."""
        out = self.directory / f"photos_{sigma}"

        def copy(name: str) -> None:
            smooth_copy(self.photos / name, out / name, sigma, LARGEST)

        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(copy, names))
        return out

    def verify(self, database: Path) -> None:
        """Look for the geometry of each pair that matches."""
        geometry, verifier = pycolmap.TwoViewGeometryOptions(), pycolmap.GeometricVerifierOptions()
        geometry.ransac.random_seed = 0
        geometry.ransac.max_num_trials, geometry.ransac.dyn_num_trials_multiplier = TRIALS, 1.0
        if self.now.tolerant:
            geometry.min_num_inliers = 10
        verifier.num_threads = self.threads
        verifier.rig_verification = self.faces > 1  # one geometry for all faces of two photos: floors repeat
        pycolmap.geometric_verification(database, verifier, two_view_geometry_options=geometry)

    def mapping(self) -> pycolmap.IncrementalPipelineOptions:
        options = pipeline_options()
        options.min_model_size = LEAST_PHOTOS
        mapper = options.mapper
        if self.quick:
            options.ba_global_frames_ratio = options.ba_global_points_ratio = SELDOM
            options.ba_global_max_refinements = 2
        if self.now.tolerant:
            options.min_num_matches = 10
            mapper.init_min_num_inliers, mapper.init_min_tri_angle = 50, 6.0
            mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio = 15, 0.15
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
            far = FALSE * float(np.median([point.error for point in model.points3D.values()]))
            seen = pycolmap.ObservationManager(model)
            seen.filter_all_points3D(far, mapping.mapper.filter_min_tri_angle)
            pycolmap.bundle_adjustment(model, mapping.get_global_bundle_adjustment())
            model.update_point_3d_errors()

    @contextmanager
    def watched(self, stage: str, total: int) -> Iterator[None]:
        """Tell how far COLMAP's log says that it is, until the work is done.

        Not its database: two libraries of SQLite in a process take each other's locks away.
        """
        log = self.directory / "log.txt"
        start = log.stat().st_size if log.exists() else 0
        done = threading.Event()

        def watch() -> None:
            while not done.wait(0.5):
                text = log.read_bytes()[start:].decode(errors="replace") if log.exists() else ""
                count = text.count("Processed file [")
                if blocks := _BLOCK.findall(text):
                    row, rows, column, columns = (int(part or 1) for part in blocks[-1])
                    count = round(total * ((row - 1) * columns + column - 1) / (rows * columns))
                self.tell(stage, count, total)

        self.tell(stage, 0, total)
        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            done.set()
            watcher.join()

    def tell(self, stage: str, done: int, total: int = 0) -> None:
        """What is being done, for whoever waits."""
        now = {"stage": stage, "done": done, "total": total, "pass": self.now.name}
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
        work, placed = self.work, 0

        def place(photos: int) -> None:
            nonlocal placed
            placed = photos if photos == 2 else placed + photos  # two: a model begins
            work.most = max(work.most, placed)
            work.tell("place", work.most, len(work.names))

        work.now, work.most = self.one, 0
        self.database = work.looked_at(self.one)
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
        work.now = self.one
        work.tell("home", self.registered, len(work.names))
        self._sure = placed_names(best)
        folder = work.directory / f"home_{self.one.name}"
        for number, (least, share) in enumerate(GATES):
            start, out = folder / f"start{number}", folder / f"found{number}"
            for new in (start, out):
                shutil.rmtree(new, ignore_errors=True)
                new.mkdir(parents=True)
            best.write(start)
            options = work.mapping()
            options.mapper.abs_pose_min_num_inliers, options.mapper.abs_pose_min_inlier_ratio = least, share
            found = pycolmap.incremental_mapping(
                self.database, work.photos, out, options=options, input_path=start
            )
            held = [one for one in found.values() if placed_names(one) >= self._sure]
            self.model = best = max([best, *held], key=lambda one: one.num_reg_images())
            if self.registered == len(work.names):
                break

    def refine(self) -> None:
        """Make places precise, and check them."""
        work, model = self.work, self.model
        if model is not None and work.faces == 1:
            work.now = self.one
            given = work.photos, work, self._sure, len(work.names), LARGEST
            self.model, self.agree = refined(model, *given)

    def facts(self) -> dict[str, Any]:
        """What `Outcome` holds of it."""
        placed = set() if self.model is None else placed_names(self.model)
        own: dict[str, Any] = {"tolerant": self.one.tolerant, "registered": self.registered}
        if self.model is not None and self.work.faces > 1:
            own["borne_out"] = borne_out(self.database, self.model)
        elif self.model is not None:
            own["loose"] = loose_parts(self.model)
        return {**own, "agree": self.agree, "apart": self.apart, **counts(self.database, placed)}


def attempts(work: Work) -> list[Attempt]:
    """The best of the passes, and the tolerant one where it was made, each with lost photos brought home."""
    *plain, tolerant = PASSES
    best: Attempt | None = None
    for one in plain:
        if best is not None and best.registered >= one.enough * len(work.names):
            break
        if one.coarse and not work.quick:
            continue
        if best is not None and not work.gains(one, best):
            break
        now = Attempt(work, one)
        now.run()
        pair = [now] if best is None else [now, best] if best.one.coarse else [best, now]
        best = max(pair, key=lambda attempt: attempt.registered)
    assert best is not None  # the first pass has no condition
    best.bring_home()
    if best.registered >= tolerant.enough * len(work.names) or not work.gains(tolerant, best):
        return [best]
    second = Attempt(work, tolerant)
    second.run()
    second.bring_home()
    return [best, second]


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
