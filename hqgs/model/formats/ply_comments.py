"""What the comments in a PLY file's header say of its scene, ours and other programs'.

Ours: the frame (`hqgs world`) and the antialias flag. Of others: that flag (Postshot's `antialiased 1`,
`SplatRenderMode: mip` of Brush and gsplat), where up is (`Vertical axis: z` of nerfstudio), a unit.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

from hqgs.model.formats.arrays import Told
from hqgs.scene.world import World

OURS = "hqgs"  # how comments of the header begin that hqgs writes, one at least
_WORLD = f"{OURS} world "
_ANTIALIASED = [f"{OURS} antialiased", "SplatRenderMode: mip"]  # the latter for other programs

# Comments of other programs.
_MODE = re.compile(rf"(?:{OURS} )?(?:antialias\w*|train_flags|splat ?render ?mode)[\s:=]*(.*)")
_OFF: tuple[str, ...] = ("0", "false", "no", "off", "none", "default", "classic")
_ON: tuple[str, ...] = ("", "1", "true", "yes", "on", "mip", "antialiased", "antialiasing")
_UP = re.compile(r"(?:vertical|up)[ _-]?(?:axis|vector|direction)?[\s:=]+(.*)")
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_UNIT = re.compile(r"(?:\w+[ _-])?units?[\s:=]+(.*)")
_TELLING = re.compile(r"unit|axis|axes|handed|coordinate|colou?r|gamma|offset|shift|origin|epsg|crs|kernel")


def comments_of(world: World, antialiased: bool) -> list[str]:
    """What is written into a header."""
    says = [f"{OURS} scene", *([f"{_WORLD}{json.dumps(world.json())}"] if world != World() else [])]
    return says + (_ANTIALIASED if antialiased else [])


def told_by(comments: list[str]) -> Told:
    """What comments of a header say of a scene, and `notes` of what they say beside that.

    ValueError where one of ours is damaged.
    """
    told: Told = {"notes": []}
    for comment in comments:
        line, world = comment.lower(), told.get("world", World())
        if comment.startswith(_WORLD):
            try:
                told["world"] = World.of_json(json.loads(comment.removeprefix(_WORLD)))
            except (ValueError, RecursionError) as error:
                raise ValueError(f"its comment {comment!r:.80} is damaged: {error}") from error
        elif (mode := _MODE.fullmatch(line)) and mode[1] in _OFF + _ON:
            told["antialiased"] = mode[1] in _ON
        elif (axis := _UP.fullmatch(line)) and (up := _direction(axis[1])):
            if up != (0.0, -1.0, 0.0):  # that of a scene that says nothing
                told["world"] = replace(world, up=up)
            told["notes"].append(f"up is ({up[0]:g}, {up[1]:g}, {up[2]:g}), as its header says: {comment}")
        elif (unit := _UNIT.fullmatch(line)) and unit[1] in ("m", "meter", "meters", "metre", "metres"):
            told["world"] = replace(world, metres=1.0)
            told["notes"].append("its unit is a metre, as its header says")
        elif mode or (not comment.startswith(OURS) and _TELLING.search(line)):
            told["notes"].append(f"its header says {comment!r:.100}, which was ignored")
    return told


def _direction(words: str) -> tuple[float, float, float] | None:
    """The unit vector of an axis, or of three numbers; None of anything else.

    y without a sign means down of COLMAP's frame, as in Brush, and x and z are up, as z is in nerfstudio.
    """
    words = words.strip().replace("neg_", "-").replace("pos_", "+")
    if (axis := words.lstrip("+-")) in _AXES and len(words) <= 2:
        sign = -1.0 if words in ("y", f"-{axis}") else 1.0
        x, y, z = (sign * value + 0.0 for value in _AXES[axis])
        return x, y, z
    try:
        x, y, z = (float(value) for value in re.sub(r"[\[\](),]", " ", words).split())
    except ValueError:
        return None
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length) if 0 < length < math.inf else None
