"""What a benchmark runs, from the TOML file beside it; rows, degradations, seeds and scenes of a study."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes.room.scene import embedded_scene
from benchmarks.scenes.rooms import is_room, room
from hqgs.base.typed import build
from hqgs.photos.formula import parse_degradation
from hqgs.scene.degrade import degrade_scene
from hqgs.scene.formats.degradation_json import FILE
from hqgs.scene.formats.llff import hold_marker
from hqgs.scene.known_points import with_points
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene, View
from hqgs.training.config import NONE, TrainConfig, parse_leave_out

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

T = TypeVar("T")
EMBEDDED = Path("embedded")  # stands for the built-in scene
SMALLEST = 8  # pixels: the sides of the built-in scenes' photos
VALIDATE_EVERY = 7  # every 7th training photo


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file; ValueError with its name where it is none."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path.name}: {error}") from error


@dataclass(frozen=True)
class Row:
    """A row of the tables: a configuration of the training."""

    label: str
    method: str = "3dgs"
    leave_out: str = NONE  # as the command line has it
    config: dict[str, Any] = field(default_factory=dict)  # further changes of the `TrainConfig`

    @property
    def more(self) -> dict[str, Any]:
        """What the result depends on, beside configuration and photos."""
        return {}

    def train_config(self, seed: int, iterations: int, changes: dict[str, Any] | None = None) -> TrainConfig:
        """The run, its schedule fitted to its length. `changes`: of the protocol, before those of the row."""
        items = parse_leave_out(self.leave_out)
        config = TrainConfig(iterations=iterations, method=self.method, seed=seed, leave_out=items)
        config = build(TrainConfig, changes or {}, "the protocol's config", config)
        return build(TrainConfig, self.config, f"row {self.label!r}, config", config)


@dataclass(frozen=True)
class Protocol:
    """Everything but the scenes. All rows of a (scene, degradation, seed) see the same photos."""

    rows: tuple[Row, ...]
    iterations: int
    downscale: float
    help: str = ""
    degradations: tuple[str, ...] = (NONE,)  # as `parse_degradation` reads them
    baseline: str = ""  # the row that the others are compared with
    seeds: tuple[int, ...] = (0,)  # of the training and of the degradation
    embedded: tuple[int, int, int] = (504, 378, 24)  # width, height in px, views of the built-in scene
    config: dict[str, Any] = field(default_factory=dict)  # changes of every row's `TrainConfig`
    photos: int | None = None  # to train on, evenly spread over those that there are; None: all
    longest: int | None = None  # px: sides of photos that are longer are scaled down

    @property
    def labels(self) -> list[str]:
        return [row.label for row in self.rows]

    def train_config(self, row: Row, seed: int) -> TrainConfig:
        return row.train_config(seed, self.iterations, self.config)


def read_protocols(path: Path, row_type: type[Row] = Row) -> dict[str, Protocol]:
    """The protocols of a file: `[rows.LABEL]` are rows, `[protocols.NAME]` choose among them.

    ValueError names the place of a mistake.
    """
    tables = read_toml(path)
    rows = {
        label: build(row_type, {"label": label, **table}, f"{path.name}, row {label!r}")
        for label, table in tables["rows"].items()
    }
    protocols = {}
    for name, table in tables["protocols"].items():
        where = f"{path.name}, protocol {name!r}"
        chosen = chosen_from(rows, table.get("rows", list(rows)), f"{where}, rows")
        protocol = build(Protocol, table | {"rows": chosen}, where)
        if protocol.baseline and protocol.baseline not in protocol.labels:
            raise ValueError(f"{where}: the baseline {protocol.baseline!r} is none of its rows")
        protocols[name] = narrowed(protocol)
        if protocols[name] != protocol:
            raise ValueError(f"{where}: write {', '.join(protocols[name].degradations)}")
    return protocols


def chosen_from(rows: dict[str, T], labels: Sequence[str], where: str = "rows") -> list[T]:
    """The rows of these labels, in their own order; ValueError for one that is unknown or given twice."""
    if unknown := [label for label in labels if label not in rows]:
        raise ValueError(f"{where}: there is no {unknown[0]!r}; there are: {', '.join(rows)}")
    _distinct(where, labels)
    return [row for label, row in rows.items() if label in labels]


def narrowed(protocol: Protocol, **given: Any) -> Protocol:
    """The protocol with other values where they are not None; of `rows` the labels.

    ValueError names what is unknown, given twice, or out of range.
    """
    changes = {name: value for name, value in given.items() if value is not None}
    if "seeds" in changes:
        changes["seeds"] = _distinct("seeds", changes["seeds"])
    if "rows" in changes:
        changes["rows"] = tuple(chosen_from({row.label: row for row in protocol.rows}, changes["rows"]))
    # The parser's own spelling, so that `noise:25.0` is no other run than `noise:25`.
    kinds = [str(parse_degradation(kind)) for kind in changes.get("degradations", protocol.degradations)]
    protocol = replace(protocol, **changes | {"degradations": _distinct("degradations", kinds)})
    if not protocol.downscale >= 1:
        raise ValueError(f"downscale must be at least 1, got {protocol.downscale}")
    for seed in protocol.seeds:
        for row in protocol.rows:
            protocol.train_config(row, seed)  # its checks, before any work
    return protocol


def _distinct(name: str, values: Sequence[T]) -> tuple[T, ...]:
    if twice := [value for k, value in enumerate(values) if value in values[:k]]:
        raise ValueError(f"{name} holds {twice[0]} twice")
    return tuple(values)


def load_scenes(sources: Sequence[Path], protocol: Protocol, cache: Path, validate: bool) -> list[Scene]:
    """The clean scenes of these folders, of the size and with the number of photos that the protocol has.

    With `validate` the held-out views are gone: see `validation_split`. The built-in scenes, and cameras that
    were found for photos alone, are kept in `cache`. Raises FileNotFoundError for a missing folder,
    ValueError for a bad one, for two of one name, for one that `hqgs degrade` wrote, and for degraded photos
    where clean ones are to validate on.
    """
    names = [source.resolve().name for source in sources]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise ValueError(f"two scenes are called {twice[0]!r}; the tables could not tell them apart")
    scenes, downscale, embedded = [], protocol.downscale, protocol.embedded
    for source in sources:
        if source == EMBEDDED:
            width, height = (round(size / downscale) for size in embedded[:2])
            if min(width, height) < SMALLEST:
                most = min(embedded[:2]) / SMALLEST
                raise ValueError(f"downscale must be in 1..{most:g} for {source}, got {downscale}")
            folder = cache / f"{source}_{width}x{height}_{embedded[2]}"
            made = embedded_scene(folder, width, height, num_views=embedded[2])
            scene = replace(made, name=str(source))
        elif is_room(source):
            scene = replace(room(source, cache / f"{source}_x{downscale:g}", downscale), name=str(source))
        else:
            if (source / FILE).is_file():
                raise ValueError(f"{source} holds degraded photos; give the folder of the clean ones")
            if validate and hold_marker(source) is not None:
                raise ValueError(
                    f"{source}: the training photos are degraded, so there is no clean one to validate on"
                )
            kept = cache / f"{source.name}_sfm"
            scene = load_scene(source, downscale=downscale, keep_sfm=kept, longest=protocol.longest)
            scene = with_points(scene, kept)
        if not scene.test:
            raise ValueError(f"scene {scene.name!r} has no held-out view to judge by")
        scene = validation_split(scene) if validate else scene
        scenes.append(scene if protocol.photos is None else fewer_photos(scene, protocol.photos))
    return scenes


def fewer_photos(scene: Scene, count: int) -> Scene:
    """The scene with `count` of its training photos, and the points that two of them see.

    The split of the few-photo papers (RegNeRF, Niemeyer et al. 2022): every 8th photo is held out, `count`
    are spread evenly over the rest in the order of their names, and cameras are those of the whole capture.
    ValueError where there are fewer.
    """
    if not 2 <= count <= len(scene.train):
        raise ValueError(f"photos is {count}, wanted 2 to {len(scene.train)}, as {scene.name} has")
    train = [scene.train[k] for k in np.linspace(0, len(scene.train) - 1, count).round().astype(int)]
    name = f"{scene.name}-{count}"
    if scene.seen is None:
        return replace(scene, name=name, train=train)
    rows, photos = np.unique(
        np.concatenate([np.unique(scene.seen.get(view.name, no_rows())) for view in train]),
        return_counts=True,
    )
    kept = rows[photos >= 2]
    place = np.full(len(scene.points), -1)
    place[kept] = np.arange(len(kept))
    seen = {view.name: place[scene.seen.get(view.name, no_rows())] for view in train}
    return replace(
        scene,
        name=name,
        train=train,
        points=scene.points[kept],
        point_colors=scene.point_colors[kept],
        seen={key: value[value >= 0] for key, value in seen.items()},
    )


def no_rows() -> NDArray[np.intp]:
    return np.zeros(0, np.intp)


def validation_split(scene: Scene) -> Scene:
    """A scene to tune on: every 7th training photo is held out, and no test view is left in it.

    ValueError where no photo would be left to train on.
    """
    train = [view for k, view in enumerate(scene.train) if k % VALIDATE_EVERY]
    if not train:
        raise ValueError(
            f"scene {scene.name!r} has {len(scene.train)} training photos, too few to hold any out"
        )
    held = scene.train[::VALIDATE_EVERY]
    note = (
        f"for tuning: every {VALIDATE_EVERY}th training photo ({len(held)}) is held out, "
        f"the {len(scene.test)} test views are not used; the points stem from all training photos"
    )
    return replace(scene, train=train, test=held, notes=[*scene.notes, note])


def degraded(scene: Scene, degradation: str, seed: int) -> Scene:
    """Degraded training photos, clean held-out ones."""
    kind = parse_degradation(degradation)
    return degrade_scene(scene, kind, seed) if kind.steps else scene


def degraded_view(scene: Scene, view: View, degradation: str, seed: int) -> View:
    """A view with the photo that `degraded` would give it if the scene trained on it and no other."""
    others = [other for other in (*scene.train, *scene.test) if other.name != view.name]
    return degraded(replace(scene, train=[view], test=others), degradation, seed).train[0]


def add_options(parser: argparse.ArgumentParser, protocols: Mapping[str, Protocol]) -> None:
    """The options that choose a protocol and narrow it, and those about finished runs."""
    parser.set_defaults(validate=False, sfm=False)
    add: Any = parser.add_argument
    about = "; ".join(f"{name}: {one.help}" if one.help else name for name, one in protocols.items())
    add("--protocol", choices=protocols, default="standard", metavar="NAME", help=about)
    protocol = protocols["standard"]
    add(
        "--scenes", nargs="+", type=Path, default=[EMBEDDED], metavar="SCENE",
        help="folders, or names of built-in scenes (%(default)s)",
    )  # fmt: skip
    listed = ", ".join(protocol.labels).replace("%", "%%")
    add("--rows", nargs="+", metavar="ROW", help=f"only these of: {listed}")
    add("--seeds", nargs="+", type=int, metavar="S", help=f"({' '.join(map(str, protocol.seeds))})")
    add("--iterations", type=int, metavar="N", help=f"training views of each run ({protocol.iterations})")
    add("--downscale", type=float, metavar="F", help=f"divide the photos' sides ({protocol.downscale:g})")
    add(
        "--photos",
        type=int,
        metavar="K",
        help="train on K of the photos, by the split of the few-photo papers",
    )
    add("--finished", action="store_true", help="train nothing: tables of the runs that are finished")
