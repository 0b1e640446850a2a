"""Plans as files: one placement a line, as JSON, in metres (``plans.jsonl``).

A line has the keys

* ``episode``: a number; the lines of one episode follow one another, in the order of the placements.
* ``tote``: inner sides of the tote, ``[w, d, h]``.
* ``corner``: near corner of the item at rest in the tote, ``[x, y, z]``, from the tote's near corner on its floor.
* ``size``: sides of the item as it lies in the tote, ``[w, d, h]``.

which is all that ``settle`` needs, and for a robot (of these only their types are checked, and that nothing overlaps in
the bin)

* ``bin``: inner sides of the bin, ``[w, d, h]``; ``item``: near corner of the item in the bin, ``[x, y]``.
* ``effector``: sides of the end effector as it hangs over the bin, ``[w, d]``; ``body``, if it is not a rectangle:
  rectangles that make it up, ``[[x, y, w, d], ...]``, from its near corner.
* ``pick`` and ``place``: its centre when it sucks and when it releases, ``[x, y]``, in the frames of bin and tote.
* ``rotation``: turn between the two, counter-clockwise seen from above; 0, 90, 180 or 270 degrees.
* ``neighbours``, if the item does not lie alone: what else lies in the bin, ``[[x, y, w, d, h], ...]``, near corners
  and sides. An item lies there from the first line that names it until it is taken.
"""

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from pickplace.common.files import read_text
from pickplace.common.validate import excerpt, is_number, is_whole
from pickplace.rules.cell import MAX_BIN_ITEMS

PLANS = "plans.jsonl"
CELL_SIZE = 0.05  # side of a cell unless a robot cell says otherwise, m
TOLERANCE = 1e-4  # distance by which boxes may overlap or float, for rounding; m
MAX_LENGTH = 100.0  # greatest length or coordinate, m
MAX_FILE = 2**28  # greatest size of a file, bytes

MAX_BODY = 2_048  # rectangles of a body


class Value(NamedTuple):
    """What a key of a line holds: a whole number, or ``parts`` lengths and coordinates."""

    expected: str
    parts: int = 0  # numbers of a point or size; 0: one whole number
    sides: int = 0  # how many of the lengths, the last ones, are sides above 0
    most: int = 0  # greatest number of boxes of a list; 0: no list


SIDES, CORNER = (Value("3 lengths above 0, in metres", 3, 3), Value("3 coordinates, in metres", 3))
POINT = Value("2 coordinates, in metres", 2)
#: Keys of every line, further ones for a robot, and those that a robot may do without.
KEYS = {"episode": Value("a whole number >= 0"), "tote": SIDES, "corner": CORNER, "size": SIDES}
ROBOT_KEYS = {"bin": SIDES, "item": POINT, "effector": Value("2 lengths above 0, in metres", 2, 2), "pick": POINT}
ROBOT_KEYS |= {"place": POINT, "rotation": Value("0, 90, 180 or 270")}
OPTIONAL_KEYS = {
    "body": Value(f"up to {MAX_BODY:,} rectangles x, y, w, d, in metres", 4, 2, MAX_BODY),
    "neighbours": Value(f"up to {MAX_BIN_ITEMS} boxes x, y, w, d, h, in metres", 5, 3, MAX_BIN_ITEMS),
}

Point = tuple[float, ...]


@dataclass(frozen=True)
class Placement:
    """One item: where it comes to rest, and how a robot brings it there, if that is planned; in metres and degrees."""

    corner: Point
    size: Point
    item: Point = ()
    pick: Point = ()
    place: Point = ()
    rotation: int = 0
    neighbours: tuple[Point, ...] = ()  # what else lies in the bin, x, y, w, d, h

    @property
    def centre(self) -> Point:
        """The item's centre at rest."""
        return tuple(at + side / 2 for at, side in zip(self.corner, self.size, strict=True))

    @property
    def volume(self) -> float:
        """The volume, m^3."""
        return math.prod(self.size)


@dataclass(frozen=True)
class EpisodePlan:
    """The placements of an episode, in order; in metres."""

    episode: int
    tote: Point
    bin: Point = ()
    effector: Point = ()
    placements: list[Placement] = field(default_factory=list)
    body: tuple[Point, ...] = ()  # rectangles of the end effector, x, y, w, d; none: it is one


def to_lines(plans: Iterable[EpisodePlan]) -> str:
    """Return plans as the text of a ``plans.jsonl``."""
    lines = []
    for plan in plans:
        for placement in plan.placements:
            values = {**vars(plan), **vars(placement)}
            keys = [*KEYS, *ROBOT_KEYS, *(key for key in OPTIONAL_KEYS if values[key])] if plan.bin else KEYS
            lines.append(json.dumps({key: values[key] for key in keys}))
    return "".join(f"{line}\n" for line in lines)


def read_plans(path: str | Path) -> list[EpisodePlan]:
    """Return the plans of a ``plans.jsonl``.

    Raises:
        ValueError: naming the file, the line and the key, for a line that is no placement, or a box that cannot lie
            there: it leaves the tote, overlaps another one, or has nothing below it.
        OSError: if the file cannot be read.
    """
    plans: list[EpisodePlan] = []
    for number, line in enumerate(read_text(path, MAX_FILE).splitlines(), 1):
        where = f"{path}, line {number}"
        values = _read_line(where, line)
        sizes = {key: values.get(key, ()) for key in ("tote", "bin", "effector", "body")}
        if not plans or plans[-1].episode != values["episode"]:
            if any(plan.episode == values["episode"] for plan in plans):
                raise ValueError(f"{where}: episode={values['episode']}: expected its lines to follow one another.")
            plans.append(EpisodePlan(values["episode"], **sizes))
        for key, value in sizes.items():
            if getattr(plans[-1], key) != value:
                raise ValueError(f"{where}: {key}: expected the same in all lines of episode {values['episode']}.")
        placement = Placement(**{key: values[key] for key in values if key not in ("episode", *sizes)})
        if fault := _fault(placement, plans[-1]):
            raise ValueError(f"{where}: the item {fault}.")
        plans[-1].placements.append(placement)
    return plans


def _read_line(where: str, line: str) -> dict:
    """Return the values of a line."""
    try:
        values = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where}: expected an object in JSON ({error}).") from error
    if not isinstance(values, dict):
        raise ValueError(f"{where}: got {type(values).__name__}, expected an object with {', '.join(KEYS)}.")
    known = {**KEYS, **ROBOT_KEYS}
    kinds = {**known, **OPTIONAL_KEYS}
    if unknown := [key for key in values if key not in kinds]:
        raise ValueError(f"{where}: {excerpt(unknown[0])}: there is no such key; expected {', '.join(known)}.")
    needed = known if values.keys() - KEYS.keys() else KEYS
    if missing := [key for key in needed if key not in values]:
        raise ValueError(f"{where}: {missing[0]}: missing; expected {', '.join(needed)}.")
    found = {key: _read_value(f"{where}: {key}", value, kinds[key]) for key, value in values.items()}
    if found.get("rotation", 0) not in (0, 90, 180, 270):
        raise ValueError(f"{where}: rotation={found['rotation']}: expected {ROBOT_KEYS['rotation'].expected}.")
    for key, outer in (("body", "effector"), ("neighbours", "bin")):
        for x, y, w, d, *_ in found.get(key, ()):
            wide, deep, *_ = found[outer]
            if min(x, y) < -TOLERANCE or x + w > wide + TOLERANCE or y + d > deep + TOLERANCE:
                raise ValueError(f"{where}: {key}: {[x, y, w, d]} leaves the {outer} of {wide:g} x {deep:g} m.")
    if "neighbours" in found:
        w, d, _ = found["size"]
        item = *found["item"], *((d, w) if found["rotation"] % 180 else (w, d))
        for one, other in combinations([item, *found["neighbours"]], 2):
            shared = [min(one[i] + one[i + 2], other[i] + other[i + 2]) - max(one[i], other[i]) for i in (0, 1)]
            if min(shared) > TOLERANCE:
                raise ValueError(f"{where}: neighbours: {excerpt([*other])} overlaps {excerpt([*one])} in the bin.")
    return found


def _read_value(where: str, value, kind: Value):
    """Return the value of a key: a whole number, a tuple of numbers, or a tuple of such tuples."""

    def is_good(point) -> bool:
        if not isinstance(point, list) or len(point) != kind.parts or not all(map(is_number, point)):
            return False
        return max(map(abs, point)) <= MAX_LENGTH and all(side >= 1e-6 for side in point[kind.parts - kind.sides :])

    if kind.parts == 0:
        points: list = []
        good = is_whole(value) and value >= 0
    else:
        points = value if kind.most else [value]
        good = isinstance(points, list) and len(points) <= max(kind.most, 1) and all(map(is_good, points))
    if not good:
        raise ValueError(f"{where}={excerpt(value)}: expected {kind.expected}.")
    boxes = tuple(tuple(map(float, point)) for point in points)
    return boxes if kind.most else boxes[0] if kind.parts else value


def _fault(placement: Placement, plan: EpisodePlan) -> str:
    """Return why the item cannot lie where it is planned; empty if it can."""
    size, corner = placement.size, placement.corner
    for axis, name in enumerate("xyz"):
        low, high = corner[axis], corner[axis] + size[axis]
        if low < -TOLERANCE or high > plan.tote[axis] + TOLERANCE:
            return f"leaves the tote: along {name} from {low:g} to {high:g} m, expected 0 to {plan.tote[axis]:g} m"
    below = 0.0
    for number, other in enumerate(plan.placements, 1):
        far, others = ([at + side for at, side in zip(one.corner, one.size, strict=True)] for one in (placement, other))
        shared = [min(a, b) - max(c, d) for a, b, c, d in zip(far, others, corner, other.corner, strict=True)]
        if min(shared) > TOLERANCE:
            return f"overlaps item {number} of its episode by {1e3 * min(shared):.1f} mm"
        if min(shared[:2]) > 0 and others[2] <= corner[2] + TOLERANCE:
            below = max(below, others[2])
    if corner[2] - below > TOLERANCE:
        return f"floats {1e3 * (corner[2] - below):.1f} mm above what lies below it"
    return ""
