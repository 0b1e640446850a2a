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

from pickplace.common.files import read_text
from pickplace.common.validate import excerpt, is_number, is_whole
from pickplace.rules.cell import MAX_BIN_ITEMS

PLANS = "plans.jsonl"
CELL_SIZE = 0.05  # side of a cell unless a robot cell says otherwise, m
TOLERANCE = 1e-4  # distance by which boxes may overlap or float, for rounding; m
MAX_LENGTH = 100.0  # greatest length or coordinate, m
MAX_FILE = 2**28  # greatest size of a file, bytes

#: Keys of every line, and further ones for a robot, with the number of their values; 0: one number.
KEYS = {"episode": 0, "tote": 3, "corner": 3, "size": 3}
ROBOT_KEYS = {"bin": 3, "item": 2, "effector": 2, "pick": 2, "place": 2, "rotation": 0}
OPTIONAL_KEYS = ("body", "neighbours")  # which a robot may do without
MAX_BODY = 2_048  # rectangles of a body

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
    if unknown := [key for key in values if key not in known and key not in OPTIONAL_KEYS]:
        raise ValueError(f"{where}: {excerpt(unknown[0])}: there is no such key; expected {', '.join(known)}.")
    needed = known if (ROBOT_KEYS.keys() | {*OPTIONAL_KEYS}) & values.keys() else KEYS
    if missing := [key for key in needed if key not in values]:
        raise ValueError(f"{where}: {missing[0]}: missing; expected {', '.join(needed)}.")
    for key in needed:
        value = values[key]
        if not known[key]:
            if not is_whole(value) or value < 0 or (key == "rotation" and value not in (0, 90, 180, 270)):
                expected = "0, 90, 180 or 270" if key == "rotation" else "a whole number >= 0"
                raise ValueError(f"{where}: {key}={excerpt(value)}: expected {expected}.")
            continue
        is_side = key in ("tote", "size", "bin", "effector")
        good = isinstance(value, list) and len(value) == known[key] and all(map(is_number, value))
        if not good or not all((1e-6 if is_side else -MAX_LENGTH) <= part <= MAX_LENGTH for part in value):
            kind = "lengths above 0" if is_side else "coordinates"
            raise ValueError(f"{where}: {key}={excerpt(value)}: expected {known[key]} {kind}, in metres.")
        values[key] = tuple(map(float, value))
    if "body" in values:
        values["body"] = _read_body(where, values["body"], values["effector"])
    if "neighbours" in values:
        values["neighbours"] = _read_neighbours(where, values)
    return values


def _read_body(where: str, value, effector) -> tuple[Point, ...]:
    """Return the rectangles of an end effector."""

    def is_good(box) -> bool:
        if not isinstance(box, list) or len(box) != 4 or not all(map(is_number, box)):
            return False
        (x, y, w, d), (wide, deep) = box, effector
        inside = min(x, y) >= 0 and x + w <= wide + TOLERANCE and y + d <= deep + TOLERANCE
        return inside and min(w, d) >= 1e-6

    if not isinstance(value, list) or not 1 <= len(value) <= MAX_BODY or not all(map(is_good, value)):
        raise ValueError(
            f"{where}: body={excerpt(value)}: expected up to {MAX_BODY:,} rectangles x, y, w, d inside the effector, "
            "in metres."
        )
    return tuple(tuple(map(float, box)) for box in value)


def _read_neighbours(where: str, values: dict) -> tuple[Point, ...]:
    """Return what else lies in the bin of a line whose other values have been read."""
    value, (w, d, _) = values["neighbours"], values["size"]

    def is_good(box) -> bool:
        if not isinstance(box, list) or len(box) != 5 or not all(map(is_number, box)):
            return False
        return min(box[2:]) >= 1e-6 and max(map(abs, box)) <= MAX_LENGTH

    if not isinstance(value, list) or len(value) > MAX_BIN_ITEMS or not all(map(is_good, value)):
        raise ValueError(
            f"{where}: neighbours={excerpt(value)}: expected up to {MAX_BIN_ITEMS} boxes x, y, w, d, h with sides "
            "above 0, in metres."
        )
    wide, deep, _ = values["bin"]
    for box in value:
        x, y, far_x, far_y = box[0], box[1], box[0] + box[2], box[1] + box[3]
        if min(x, y) < -TOLERANCE or far_x > wide + TOLERANCE or far_y > deep + TOLERANCE:
            raise ValueError(f"{where}: neighbours: {excerpt(box)} leaves the bin of {wide:g} x {deep:g} m.")
    item = *values["item"], *((d, w) if values["rotation"] % 180 else (w, d))
    for one, other in combinations([item, *value], 2):
        shared = [min(one[i] + one[i + 2], other[i] + other[i + 2]) - max(one[i], other[i]) for i in (0, 1)]
        if min(shared) > TOLERANCE:
            raise ValueError(f"{where}: neighbours: {excerpt([*other])} overlaps {excerpt([*one])} in the bin.")
    return tuple(tuple(map(float, box)) for box in value)


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
