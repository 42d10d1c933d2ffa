"""The set: a room with a table, a window, lamps, cords, text and a cage.

World frame: x right, y down, z forward, one unit about as long as an arm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes.room import textures as tx
from benchmarks.scenes.room.raycast import Box, Cylinder, Ellipsoid, Material, Panel, Surface, Torus

Point = tuple[float, float, float]

FLOOR, CEILING, BACK, SIDE, TABLE = 1.5, -3.0, 8.0, 3.5, 0.75


@dataclass(frozen=True)
class Studio:
    """Surfaces and lights. Colours are linear RGB, [3]."""

    surfaces: tuple[Surface, ...]
    occluders: tuple[Surface, ...]  # those that dim the ambient light around them
    room: tuple[tuple[int, float, float], ...]  # axis, position and inward sign of the room's planes
    lamp_frame: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]  # across, down, towards
    lamp_size: float  # half the side of the square key light, as a tangent
    fill_direction: Point
    key: NDArray[np.float32]
    fill: NDArray[np.float32]
    sky: NDArray[np.float32]
    ground: NDArray[np.float32]
    backdrop: NDArray[np.float32]

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """Corners of the surfaces' bounding boxes, [N, 8, 3]."""
        return np.stack([s.corners for s in self.surfaces])

    @cached_property
    def casters(self) -> tuple[Surface, ...]:
        """The surfaces that throw shadows."""
        return tuple(s for s in self.surfaces if s.shadow)

    @cached_property
    def lamp_boxes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper bounds of the casters in the lamp's frame, [M, 3] each."""
        corners = np.stack([s.corners for s in self.casters]) @ np.stack(self.lamp_frame).T
        return corners.min(1), corners.max(1)


def rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> NDArray[np.float64]:
    """Turn by degrees: roll about z, then pitch about x, then yaw about y; [3, 3]."""
    angles = (math.radians(t) for t in (yaw, pitch, roll))
    (a, b), (c, d), (e, f) = ((math.cos(t), math.sin(t)) for t in angles)
    ry = np.array([[a, 0, b], [0, 1, 0], [-b, 0, a]])
    rx = np.array([[1, 0, 0], [0, c, -d], [0, d, c]])
    rz = np.array([[e, -f, 0], [f, e, 0], [0, 0, 1]])
    return ry @ rx @ rz


def _put(
    shape: Box | Cylinder | Ellipsoid | Panel | Torus,
    material: Material,
    center: Point,
    turn: NDArray[np.float64] | None = None,
    shadow: bool = True,
    occludes: float = 0.0,
) -> Surface:
    return Surface(shape, material, center, np.eye(3) if turn is None else turn, shadow, occludes)


def _ball(center: Point, radius: float, material: Material) -> Surface:
    return _put(Ellipsoid((radius, radius, radius)), material, center, occludes=radius)


def _wire(a: Point, b: Point, radius: float, material: Material) -> Surface:
    """A thin cylinder from a to b."""
    start, end = np.array(a), np.array(b)
    length = float(np.linalg.norm(end - start))
    y = (end - start) / length
    x = np.cross(y, [0.0, 0.0, 1.0] if abs(y[2]) < 0.9 else [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    cx, cy, cz = ((start + end) / 2).tolist()
    turn = np.stack([x, y, np.cross(x, y)], 1)
    turn = np.where(np.abs(turn) < 1e-12, 0, turn)
    # its shadow would be thinner than the steps of the penumbra
    return _put(Cylinder(radius, length), material, (cx, cy, cz), turn, shadow=False)


def _picture(size: tuple[float, float], texture: tx.Texture, glow: float = 0.0) -> tuple[Panel, Material]:
    """A panel that shows its texture once."""
    return Panel(size), Material(texture, size, glow=glow)


def _room() -> Iterator[Surface]:
    height, middle = FLOOR - CEILING, (FLOOR + CEILING) / 2
    window = (0.4, -2.15, 2.9, -0.15)
    hole = (window[0], window[1] - middle, window[2], window[3] - middle)
    wall = Material(tx.bricks(1), (5.2, 4.0))
    yield _put(Panel((2 * SIDE, height), hole), wall, (0, middle, BACK), shadow=False)
    teal = Material(tx.plaster("#5b9a97", 2), (4.0, 4.0))
    yield _put(Panel((9, height)), teal, (-SIDE, middle, BACK - 4.5), rotation(yaw=-90), shadow=False)
    paper = Material(tx.wallpaper(3), (1.6, 1.6))
    yield _put(Panel((9, height)), paper, (SIDE, middle, BACK - 4.5), rotation(yaw=90), shadow=False)
    floor = Material(tx.tiles("#d9c9a8", "#7a4b35", 4), (1.8, 1.8), gloss=0.10, mirror=0.04)
    yield _put(Panel((2 * SIDE, 9)), floor, (0, FLOOR, BACK - 4.5), rotation(pitch=-90), shadow=False)
    white = Material(tx.plaster("#e9e2d2", 5, 0.06), (4.0, 4.0))
    yield _put(Panel((2 * SIDE, 9)), white, (0, CEILING, BACK - 4.5), rotation(pitch=90), shadow=False)
    beam = Material(tx.wood("#8a5a34", "#4d2d18", 6, 2), (3.0, 0.6))
    for x in (-2.3, 0.0, 2.3):
        yield _put(Box((0.13, 0.12, 4.5)), beam, (x, CEILING + 0.12, BACK - 4.5), shadow=False)

    yield _put(*_picture((18.0, 10.3), tx.landscape(7), glow=1.15), (4.0, -2.6, 20.0), shadow=False)
    dark = Material(tx.plain("#20242a"))
    for k in range(3):  # power lines, far outside
        yield _wire((-2.0, -3.6 + 0.35 * k, 14.0), (9.0, -3.1 + 0.42 * k, 14.5), 0.014, dark)
    frame = Material(tx.plain("#f1ead8"), gloss=0.1)
    x0, y0, x1, y1 = window
    xm, ym = (x0 + x1) / 2, (y0 + y1) / 2
    for x in (x0, xm, x1):
        yield _put(Box((0.045, (y1 - y0) / 2, 0.06)), frame, (x, ym, BACK - 0.02))
    for y in (y0, ym, y1):
        yield _put(Box(((x1 - x0) / 2, 0.045, 0.05)), frame, (xm, y, BACK - 0.02))
    yield _put(Box(((x1 - x0) / 2 + 0.15, 0.04, 0.16)), frame, (xm, y1 + 0.06, BACK - 0.15))


def _walls_hangings() -> Iterator[Surface]:
    chart = [("E", 0.26, 0.17), ("F P", 0.16, 0.40), ("T O Z", 0.11, 0.55), ("L P E D", 0.075, 0.67)]
    chart += [("P E C F D", 0.052, 0.77), ("E D F C Z P", 0.036, 0.85), ("F E L O P Z D", 0.026, 0.92)]
    paper = tx.text((320, 440), chart, "#fbf8ee", "#161616", border=True)
    yield _put(*_picture((1.6, 2.2), paper), (-1.15, -1.35, BACK - 0.04))
    gilt = Material(tx.plain("#b08a3c"), gloss=0.4)
    yield _put(Box((0.66, 0.52, 0.04)), gilt, (-2.76, -0.75, BACK - 0.05))
    yield _put(*_picture((1.16, 0.88), tx.painting(8)), (-2.76, -0.75, BACK - 0.095))
    oak = Material(tx.wood("#b98a54", "#7c4f27", 9, 2), (1.2, 0.4))
    yield _put(Box((1.2, 0.035, 0.2)), oak, (-2.0, 0.45, BACK - 0.2))
    for k, name in enumerate(("#c44536", "#2a6f97", "#e9c46a", "#588157", "#6d597a", "#f4a261", "#1d3557")):
        tall = 0.17 + 0.035 * ((k * 5) % 4)
        book = Material(tx.plaster(name, 20 + k, 0.3), (0.3, 0.3))
        size = (0.055 + 0.012 * (k % 3), tall, 0.13)
        yield _put(Box(size), book, (-3.0 + 0.16 * k, 0.415 - tall, BACK - 0.2))
    vase = Material(tx.marble("#dfe7ee", "#27548a", 10), (0.5, 0.5), gloss=0.5, shine=6)
    yield _put(Ellipsoid((0.16, 0.22, 0.16)), vase, (-1.5, 0.2, BACK - 0.2), occludes=0.18)


def _table() -> Iterator[Surface]:
    top = Material(tx.wood("#d3a066", "#83502a", 11, 5), (2.4, 1.6), gloss=0.16, mirror=0.03)
    yield _put(Box((1.7, 0.04, 0.95)), top, (0.0, TABLE + 0.04, 3.3))
    leg = Material(tx.plain("#5a3a22"), gloss=0.15)
    for x in (-1.55, 1.55):
        for z in (2.5, 4.1):
            yield _put(Cylinder(0.05, FLOOR - TABLE - 0.08), leg, (x, (FLOOR + TABLE) / 2 + 0.04, z))
    red = Material(tx.plaster("#c2242c", 12, 0.25), (0.6, 0.6), gloss=0.7, shine=7, mirror=0.05)
    yield _ball((-0.52, TABLE - 0.27, 2.95), 0.27, red)
    stone = Material(tx.marble("#f0ece2", "#3b5d54", 13), (0.5, 0.35), gloss=0.5, shine=6, mirror=0.04)
    yield _ball((0.02, TABLE - 0.17, 2.6), 0.17, stone)
    gold = Material(tx.plaster("#d9a036", 14, 0.3), (0.3, 0.3), gloss=0.9, shine=5, mirror=0.22)
    turn = rotation(yaw=28, pitch=82)
    yield _put(Torus(0.24, 0.075), gold, (0.62, TABLE - 0.315, 3.05), turn, occludes=0.2)
    label = [("SALSA", 0.34, 0.30), ("di pomodoro", 0.17, 0.56), ("400 g", 0.16, 0.80)]
    tin = Material(
        tx.text((420, 190), label, "#b8342a", "#fff3d6", border=True), (0.44, 0.40), gloss=0.5, shine=5
    )
    yield _put(Cylinder(0.14, 0.40), tin, (0.30, TABLE - 0.2, 3.62), rotation(yaw=-100), occludes=0.15)
    lid = Material(tx.plain("#b9bcc0"), gloss=0.6)
    yield _put(Cylinder(0.136, 0.012), lid, (0.30, TABLE - 0.402, 3.62))
    dice = Material(tx.checker("#f5efe0", "#274690", 4), (0.24, 0.24), gloss=0.2)
    yield _put(Box((0.12, 0.12, 0.12)), dice, (0.37, TABLE - 0.12, 2.62), rotation(yaw=35), occludes=0.11)

    y = TABLE
    stack = (
        ("LIGHT & SHADE", "#1f5f8b", "#f5e6c8", 0.46, 0.065, 8),
        ("Fields of View", "#d8a31a", "#3a1f0f", 0.42, 0.05, -6),
        ("EPIPOLAR TALES", "#7b2d43", "#f2d7b0", 0.38, 0.06, 15),
        ("a small atlas", "#3d7a4e", "#f7f3df", 0.31, 0.045, -3),
    )
    for title, cover, ink, width, thick, yaw in stack:
        turn = rotation(yaw=yaw)
        cx, cz = -1.13, 3.55
        cloth = Material(tx.plaster(cover, 15, 0.3), (0.4, 0.4))
        yield _put(Box((width, thick, 0.3)), cloth, (cx, y - thick, cz), turn)
        spine = tx.text((460, int(460 * thick / width)), [(title, 0.66, 0.5)], cover, ink)
        out = turn @ np.array([0, 0, -0.302])
        yield _put(*_picture((1.96 * width, 1.9 * thick), spine), (cx + out[0], y - thick, cz + out[2]), turn)
        y -= 2 * thick

    letter = [("Hello, splats!", 0.135, 0.12), ("The quick brown fox", 0.082, 0.29)]
    letter += [("jumps over the lazy dog.", 0.072, 0.40), ("0123456789  + - = %", 0.068, 0.52)]
    letter += [("Sphinx of black quartz, judge my vow.", 0.046, 0.65)]
    letter += [("Pack my box with five dozen liquor jugs.", 0.040, 0.75)]
    letter += [("How vexingly quick daft zebras jump! 3141592653", 0.032, 0.86)]
    page = tx.text((440, 380), letter, "#fdfaf0", "#1b2a41", border=True)
    turn = rotation(yaw=4, pitch=-12)
    yield _put(Box((0.62, 0.535, 0.015)), Material(tx.plain("#3a2a1c")), (0.08, TABLE - 0.545, 4.02), turn)
    face = turn @ np.array([0, 0, -0.018])
    yield _put(*_picture((1.16, 1.0), page), (0.08 + face[0], TABLE - 0.545 + face[1], 4.02 + face[2]), turn)


def _cage() -> Iterator[Surface]:
    """A bird cage of thin rods on the table, with its bird."""
    brass = Material(tx.plain("#c9a24a"), gloss=0.8, shine=5)
    x, z, radius, top = 1.22, 3.2, 0.30, TABLE - 0.85
    yield _put(Cylinder(radius + 0.03, 0.04), brass, (x, TABLE - 0.02, z))
    for k in range(18):
        a = 2 * math.pi * (k + 0.25) / 18
        cx, cz = x + radius * math.cos(a), z + radius * math.sin(a)
        yield _wire((cx, TABLE - 0.03, cz), (cx, top, cz), 0.0042, brass)
        yield _wire((cx, top, cz), (x, top - 0.26, z), 0.0042, brass)
    for y in (top, TABLE - 0.45):
        yield _put(Torus(radius, 0.010), brass, (x, y, z))
    yield _put(Torus(0.05, 0.008), brass, (x, top - 0.31, z), rotation(pitch=90))
    yield _wire((x - radius, TABLE - 0.33, z), (x + radius, TABLE - 0.33, z), 0.008, brass)
    canary = Material(tx.plaster("#f2c81e", 16, 0.5), (0.2, 0.2))
    yield _put(Ellipsoid((0.12, 0.085, 0.08)), canary, (x, TABLE - 0.41, z), rotation(yaw=20, roll=25))
    yield _put(Ellipsoid((0.06, 0.058, 0.055)), canary, (x - 0.10, TABLE - 0.51, z - 0.03))
    beak, eye = Material(tx.plain("#d9621e")), Material(tx.plain("#101010"), gloss=0.5)
    yield _put(Ellipsoid((0.035, 0.012, 0.012)), beak, (x - 0.165, TABLE - 0.505, z - 0.05))
    yield _put(Ellipsoid((0.01, 0.01, 0.01)), eye, (x - 0.115, TABLE - 0.53, z - 0.082))


def _cords() -> Iterator[Surface]:
    """Pendant lamps and a sagging string of small bulbs."""
    cord = Material(tx.plain("#1c1c1e"))
    lamps = (
        (-0.35, -1.05, 4.7, 0.17, "#ffb44d"),
        (0.35, -1.42, 5.4, 0.20, "#ff7a59"),
        (-1.75, -1.30, 5.0, 0.19, "#ffe08a"),
    )
    for x, y, z, radius, name in lamps:
        yield _wire((x, CEILING, z), (x, y - radius, z), 0.007, cord)
        yield _put(Ellipsoid((radius, radius * 0.9, radius)), Material(tx.plain(name), glow=1.1), (x, y, z))
        cap = Material(tx.plain("#33302c"), gloss=0.4)
        yield _put(Cylinder(0.06, 0.10), cap, (x, y - 0.9 * radius - 0.03, z))
    colours = ("#e63946", "#ffb703", "#2a9d8f", "#f28482", "#4ea8de", "#b5e48c")
    points: list[Point] = []
    for k in range(15):
        s = k / 14 * 2 - 1
        points.append((3.4 * s, -1.0 - 0.75 * s * s + 0.25 * s, 5.6 - 0.8 * s))
    for k, (a, b) in enumerate(pairwise(points)):
        yield _wire(a, b, 0.006, cord)
        bulb = Material(tx.plain(colours[k % len(colours)]), gloss=0.8, shine=5, mirror=0.05)
        yield _put(Ellipsoid((0.045, 0.06, 0.045)), bulb, (b[0], b[1] + 0.06, b[2]))


def _plant() -> Iterator[Surface]:
    """A pot close to the cameras, with cut-out leaves that hide what lies behind."""
    x, z = -0.98, 1.72
    clay = Material(tx.plaster("#b5623c", 17, 0.5), (0.4, 0.4))
    yield _put(Cylinder(0.15, 0.5), clay, (x, 0.93, z), occludes=0.15)
    blade = tx.leaf(18)
    stem = Material(tx.plain("#55752f"))
    leaves = (  # aside, height, forward, length, roll, yaw
        (0.12, -0.10, -0.04, 0.46, 24, 15),
        (-0.14, 0.05, 0.02, 0.44, -38, -12),
        (0.20, 0.22, -0.10, 0.40, 58, 22),
        (-0.02, 0.00, 0.10, 0.50, -8, -25),
        (0.06, 0.30, -0.16, 0.36, 35, -30),
        (-0.20, 0.30, -0.06, 0.38, -64, 10),
    )
    for dx, y, dz, length, roll, yaw in leaves:
        turn = rotation(yaw=yaw, pitch=18, roll=roll)
        size = (length * 0.40, length)
        middle = np.array([x + dx, y, z + dz])
        foot = middle + turn @ np.array([0, length / 2, 0])
        yield _wire((x, 0.70, z), (foot[0], foot[1], foot[2]), 0.006, stem)
        green = Material(blade, size, gloss=0.12)
        yield _put(Panel(size, cutout=blade), green, (middle[0], middle[1], middle[2]), turn)


@cache
def studio() -> Studio:
    """The scene; built once (about a second), always the same."""
    parts = (_room(), _walls_hangings(), _table(), _cage(), _cords(), _plant())
    surfaces = tuple(surface for part in parts for surface in part)
    towards = np.array([-0.50, -0.85, -0.52])
    towards /= np.linalg.norm(towards)
    across = np.cross(towards, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)

    def rgb(r: float, g: float, b: float) -> NDArray[np.float32]:
        return np.array([r, g, b], np.float32)

    return Studio(
        surfaces=surfaces,
        occluders=tuple(s for s in surfaces if s.occludes > 0),
        room=((1, FLOOR, -1.0), (1, CEILING, 1.0), (2, BACK, -1.0), (0, -SIDE, 1.0), (0, SIDE, -1.0)),
        lamp_frame=(across, np.cross(towards, across), towards),
        lamp_size=0.05,
        fill_direction=(0.6, -0.35, -0.72),
        key=rgb(1.30, 1.16, 0.95),
        fill=rgb(0.13, 0.16, 0.22),
        sky=rgb(0.36, 0.40, 0.48),
        ground=rgb(0.34, 0.28, 0.22),
        backdrop=tx.colour("#9db8d6"),
    )
