"""Features and matches of photos in COLMAP's database, before their geometry is checked.

It imports of hqgs what needs nothing else: `program.py` uses it in COLMAP's process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pycolmap

from hqgs.scene.sfm.constants import BLOCKS


@contextmanager
def _unwatched(stage: str, total: int) -> Iterator[None]:
    yield


def match(
    directory: Path,
    photos: Path,
    names: list[str],
    extraction: pycolmap.FeatureExtractionOptions,
    threads: int,
    database: Path,
    watched: Callable[[str, int], AbstractContextManager[None]] = _unwatched,
    wanted: Callable[[], Any] = lambda: None,
) -> None:
    """Features, and matches of the pairs [P, 2] that are wanted then, or of all; geometry is not checked."""
    with watched("features", len(names)):
        extract(directory, photos, names, extraction, database)
    pairs = wanted()
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.skip_geometric_verification = True
    if pairs is not None:
        listed = pycolmap.ImportedPairingOptions()
        listed.match_list_path, listed.block_size = directory / "pairs.txt", -(-len(pairs) // BLOCKS**2)
        text = "".join(f"{names[i]} {names[j]}\n" for i, j in pairs.tolist())
        listed.match_list_path.write_text(text, encoding="utf-8")
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


def extract(directory: Path, photos: Path, names: list[str], extraction: Any, database: Path) -> None:
    """Features of photos that have none yet."""
    reader = pycolmap.ImageReaderOptions()
    if (directory / "masks").is_dir():
        reader.mask_path = directory / "masks"
    found = {"reader_options": reader, "extraction_options": extraction, "device": pycolmap.Device.cpu}
    pycolmap.extract_features(database, photos, image_names=names, **found)


def pipeline_options() -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
    return options
