"""COLMAP in a process of its own: the program `python program.py COMMAND DIRECTORY THREADS`.

So a crash or a hang of COLMAP cannot take its caller along. What it imports of hqgs needs nothing else, so
that it starts at once. DIRECTORY holds `input.npz`: photos (the folder), names [V], and of known cameras
sizes [V, 2] as width and height and Ks [V, 3, 3], of known poses viewmats [V, 4, 4]. If DIRECTORY has a
folder `masks`, each photo has a mask `NAME.png` there. COLMAP's files and the answer go into DIRECTORY:

`triangulate`, on one thread: points for known cameras and poses, from the pairs [P, 2], numbers of photos,
where it has some, else from all; `points.npz` (points [P, 3] float32, colors [P, 3] uint8, and of each
observation the numbers of the photo and of the point: photos [O], rows [O]).

`reconstruct`: poses and points, the folder `model` with the largest COLMAP model; none if there is no
model. Known cameras stay as they are. Of unknown ones, which are SIMPLE_RADIAL, `input.npz` has sizes [C, 2],
focal lengths in px, focals [C], 0 where nothing is known, and the number of each photo's camera, camera_of
[V]; where photos are faces of panoramas, the known focal lengths, and the rotations [F, 3, 3] of the F faces
that each panorama has in `names`, one after the other. All pairs are matched, or of many photos those that
are alike. Where it has `coarse`, photos are looked at coarsely first. The passes are those of `passes.py`, in
their order, as long as too few photos have a place; the best one counts.
In the end observations are moved to where the photos agree. `facts.json` says what all came to,
`stage.json` what is being done now, which is read from COLMAP's log: the caller sends the output to
`log.txt`. A second call in the same DIRECTORY goes on with the features and matches that the first one left.
The program ends when its standard input does.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from hqgs._rust import set_num_threads
from hqgs.scene.sfm.database import LARGEST, extract, known_cameras, match, pipeline_options
from hqgs.scene.sfm.passes import COARSE, Work, best_attempt

MIN_TRACK, MAX_ERROR = 3, 1.0  # a point needs so many photos, and may miss them by so many px on average


def triangulate(directory: Path) -> None:
    """SIFT, exhaustive matching, epipolar check against the known poses, triangulation; all on one thread.

    The check with known poses needs no RANSAC, so the same photos give the same points.
    """
    database, given = directory / "colmap.db", _given(directory)
    known = known_cameras(given, database)
    photos, names = Path(str(given["photos"])), given["names"].tolist()
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.max_image_size = 1, LARGEST
    extraction.sift.max_num_features = COARSE
    extract(directory, photos, names, extraction, database)
    match(directory, names, given.get("pairs"), 1, database)
    pycolmap.guided_geometric_verification(known, database, num_threads=1)
    (directory / "model").mkdir()
    options = pipeline_options()
    options.triangulation.ignore_two_view_tracks = len(names) > 2
    model = pycolmap.triangulate_points(known, database, photos, directory / "model", options=options)
    points = [model.points3D[k] for k in sorted(model.points3D)]
    least = min(MIN_TRACK, len(names))
    points = [p for p in points if p.track.length() >= least and p.error <= MAX_ERROR]
    np.savez(
        directory / "points.npz",
        points=np.array([p.xyz for p in points], np.float32).reshape(-1, 3),
        colors=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        photos=np.array([e.image_id - 1 for p in points for e in p.track.elements], np.intp),
        rows=np.array([k for k, p in enumerate(points) for _ in p.track.elements], np.intp),
    )


def reconstruct(directory: Path) -> None:
    """SIFT, matching, RANSAC, incremental mapping; the threads change no bit of the result.

    What is found of one photo or pair depends on no other, not even its random numbers, and is read back in
    the order of numbers. Mapping has one thread and the seed 0.
    """
    best = best_attempt(Work(directory, _given(directory)))
    best.refine()
    facts = json.dumps(best.facts())
    (directory / "facts.json").write_text(facts, encoding="utf-8")
    if best.model is not None:
        (directory / "model").mkdir(exist_ok=True)
        best.model.write_binary(directory / "model")
        (directory / "model" / "facts.json").write_text(facts, encoding="utf-8")


def _given(directory: Path) -> dict[str, Any]:
    with np.load(directory / "input.npz", allow_pickle=False) as data:
        return dict(data)


def _end_with_caller() -> None:
    """End when the caller does, who holds the other end of standard input."""
    while os.read(0, 1):  # not `sys.stdin`: its lock would be held when the program ends
        pass
    os._exit(1)


def main(command: str, directory: str, threads: str) -> None:
    pycolmap.set_random_seed(0)
    set_num_threads(int(threads))
    threading.Thread(target=_end_with_caller, daemon=True).start()
    if command == "triangulate":
        pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL.value)
        triangulate(Path(directory))
    else:
        reconstruct(Path(directory))


if __name__ == "__main__":
    main(*sys.argv[1:])
