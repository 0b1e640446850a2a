"""Files of plans, ``plans.jsonl``: one placement a line, as JSON, in metres.

A line has the keys

* ``episode``: a number; the lines of one episode follow one another, in the order of the placements.
* ``tote``: inner sides of the tote, ``[w, d, h]``.
* ``corner``: near corner of the item at rest in the tote, ``[x, y, z]``, from the tote's near corner on its floor.
* ``size``: sides of the item as it lies in the tote, ``[w, d, h]``.

and, if the item's mass is known, ``mass``, kg. ``settle`` needs no more. Lines for a robot have further keys. Only
their types are checked, that body and neighbours lie in effector and bin, and that nothing overlaps in the bin:

* ``bin``: inner sides of the bin, ``[w, d, h]``; ``item``: near corner of the item in the bin, ``[x, y]``.
* ``effector``: sides of the end effector as it hangs over the bin, ``[w, d]``; ``body``, if it is not a rectangle:
  rectangles that make it up, ``[[x, y, w, d], ...]``, from its near corner.
* ``pick`` and ``place``: its centre when it sucks and when it releases, ``[x, y]``, in the frames of bin and tote.
* ``rotation``: turn between the two, counter-clockwise seen from above; 0, 90, 180 or 270 degrees.
* ``neighbours``, if the item does not lie alone: the other items in the bin, ``[[x, y, w, d, h], ...]``, near corners
  and sides. An item lies there from the first line that names it until it is taken.
"""

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

from pickplace.common.files import read_text
from pickplace.common.validate import excerpt, is_number, is_whole, refuse_if
from pickplace.physics.neighbours import BoxIndex
from pickplace.rules.cell import MAX_BIN_ITEMS

PLANS = "plans.jsonl"
TOLERANCE = 1e-4  # distance by which boxes may overlap or float, for rounding; m
MAX_LENGTH = 100.0  # greatest length or coordinate, m
MAX_MASS = 1e5  # greatest mass of an item, kg
MAX_FILE = 2**28  # greatest size of a file, bytes

MAX_BODY = 2_048  # greatest number of rectangles of a body


def _are_numbers(value, count: int, sides: int = 0) -> bool:
    """Return whether a value is a list of ``count`` lengths and coordinates, the last ``sides`` of them above 0."""
    is_list = isinstance(value, list) and len(value) == count and all(map(is_number, value))
    return is_list and max(map(abs, value)) <= MAX_LENGTH and all(side >= 1e-6 for side in value[count - sides :])


def _are_boxes(value, count: int, sides: int, most: int) -> bool:
    """Return whether a value is a list of at most ``most`` boxes; see :func:`_are_numbers`."""
    return isinstance(value, list) and len(value) <= most and all(_are_numbers(box, count, sides) for box in value)


SIDES = "3 lengths above 0, in metres", partial(_are_numbers, count=3, sides=3)
POINT = "2 coordinates, in metres", partial(_are_numbers, count=2)
#: Expected content of each key, and a function that checks a value: keys of every line, of lines for a robot, and
#: optional ones.
KEYS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "episode": ("a whole number >= 0", lambda value: is_whole(value) and value >= 0),
    "tote": SIDES,
    "corner": ("3 coordinates, in metres", partial(_are_numbers, count=3)),
    "size": SIDES,
}
ROBOT_KEYS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "bin": SIDES,
    "item": POINT,
    "effector": ("2 lengths above 0, in metres", partial(_are_numbers, count=2, sides=2)),
    "pick": POINT,
    "place": POINT,
    "rotation": ("0, 90, 180 or 270", lambda value: is_whole(value) and value in (0, 90, 180, 270)),
}
OPTIONAL_KEYS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "mass": (
        f"a mass above 0, and up to {MAX_MASS:,.0f} kg",
        lambda value: is_number(value) and 1e-6 <= value <= MAX_MASS,
    ),
    "body": (
        f"up to {MAX_BODY:,} rectangles x, y, w, d, in metres",
        partial(_are_boxes, count=4, sides=2, most=MAX_BODY),
    ),
    "neighbours": (
        f"up to {MAX_BIN_ITEMS} boxes x, y, w, d, h, in metres",
        partial(_are_boxes, count=5, sides=3, most=MAX_BIN_ITEMS),
    ),
}

Point = tuple[float, ...]


@dataclass(frozen=True)
class Placement:
    """The place where an item comes to rest and, if planned, the motion of the robot; in metres and degrees."""

    corner: Point
    size: Point
    item: Point = ()
    pick: Point = ()
    place: Point = ()
    rotation: int = 0
    neighbours: tuple[Point, ...] = ()  # the other items in the bin, x, y, w, d, h
    mass: float = 0.0  # kg; 0: not known, so the density of the simulation gives it

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
    body: tuple[Point, ...] = ()  # rectangles of the end effector, x, y, w, d; empty: it is a single one


def to_lines(plans: Iterable[EpisodePlan]) -> str:
    """Return plans as the text of a ``plans.jsonl``."""
    lines = []
    for plan in plans:
        for values in ({**vars(plan), **vars(placement)} for placement in plan.placements):
            keys = [*KEYS, *(ROBOT_KEYS if plan.bin else ()), *(key for key in OPTIONAL_KEYS if values[key])]
            lines.append(json.dumps({key: values[key] for key in keys}) + "\n")
    return "".join(lines)


def read_plans(path: str | Path) -> list[EpisodePlan]:
    """Return the plans of a ``plans.jsonl``.

    Raises:
        ValueError: naming the file, the line and the key, for a line that is no placement, or a box that cannot lie
            there: it leaves the tote, overlaps another one, or has nothing below it.
        OSError: if the file cannot be read.
    """
    plans: list[EpisodePlan] = []
    episodes: set[int] = set()
    for number, line in enumerate(read_text(path, MAX_FILE).splitlines(), 1):
        try:
            values = _read_line(line)
            episode = values.pop("episode")
            sizes = {key: values.pop(key, ()) for key in ("tote", "bin", "effector", "body")}
            if not plans or plans[-1].episode != episode:
                refuse_if(episode in episodes, f"episode={episode}: expected its lines to follow one another.")
                plans.append(EpisodePlan(episode, **sizes))
                episodes.add(episode)
                placed = BoxIndex()
            if changed := [key for key, value in sizes.items() if getattr(plans[-1], key) != value]:
                raise ValueError(f"{changed[0]}: expected the same in all lines of episode {episode}.")
            placement = Placement(**values)
            _check_place(placement, plans[-1], placed)
            plans[-1].placements.append(placement)
            placed.add(placement.corner, placement.size)
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from error
    return plans


def _read_line(line: str) -> dict:
    try:
        given = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"expected an object in JSON ({error}).") from error
    refuse_if(not isinstance(given, dict), f"got {type(given).__name__}, expected an object with {', '.join(KEYS)}.")
    known = {**KEYS, **ROBOT_KEYS}
    kinds = {**known, **OPTIONAL_KEYS}
    if unknown := [key for key in given if key not in kinds]:
        raise ValueError(f"{excerpt(unknown[0])}: there is no such key; expected {', '.join(known)}.")
    needed = known if given.keys() - KEYS.keys() - {"mass"} else KEYS
    if missing := [key for key in needed if key not in given]:
        raise ValueError(f"{missing[0]}: missing; expected {', '.join(needed)}.")
    for key, value in given.items():
        expected, is_good = kinds[key]
        refuse_if(not is_good(value), f"{key}={excerpt(value)}: expected {expected}.")
    values: dict[str, Any] = {key: _frozen(value) if isinstance(value, list) else value for key, value in given.items()}
    for key, outer in (("body", "effector"), ("neighbours", "bin")):
        for x, y, w, d, *_ in values.get(key, ()):
            wide, deep, *_ = values[outer]
            refuse_if(
                min(x, y) < -TOLERANCE or x + w > wide + TOLERANCE or y + d > deep + TOLERANCE,
                f"{key}: {[x, y, w, d]} leaves the {outer} of {wide:g} x {deep:g} m.",
            )
    if "neighbours" in values:
        w, d, _ = values["size"]
        item = *values["item"], *((d, w) if values["rotation"] % 180 else (w, d))
        for one, other in combinations([item, *values["neighbours"]], 2):
            if min(_shared(one[:2], one[2:4], other[:2], other[2:4])) > TOLERANCE:
                raise ValueError(f"neighbours: {excerpt([*other])} overlaps {excerpt([*one])} in the bin.")
    return values


def _frozen(value: list) -> tuple:
    """Convert a list, or a list of lists, to tuples of floats."""
    return tuple(_frozen(part) if isinstance(part, list) else float(part) for part in value)


def _shared(corner: Point, size: Point, other: Point, other_size: Point) -> list[float]:
    """Return the length that two boxes share along each axis; a negative value is the distance between them."""
    return [
        min(a + length, b + other_length) - max(a, b)
        for a, length, b, other_length in zip(corner, size, other, other_size, strict=True)
    ]


def _check_place(placement: Placement, plan: EpisodePlan, placed: BoxIndex) -> None:
    """Refuse an item that cannot lie at its planned place; ``placed`` holds the placements of the plan so far."""
    size, corner = placement.size, placement.corner
    for name, low, side, most in zip("xyz", corner, size, plan.tote, strict=True):
        refuse_if(
            low < -TOLERANCE or low + side > most + TOLERANCE,
            f"the item leaves the tote: along {name} from {low:g} to {low + side:g} m, expected 0 to {most:g} m.",
        )
    near = placed.near(corner, size, 2 * TOLERANCE)
    for index in near:
        other = plan.placements[index]
        overlap = min(_shared(corner, size, other.corner, other.size))
        refuse_if(overlap > TOLERANCE, f"the item overlaps item {index + 1} of its episode by {1e3 * overlap:.1f} mm.")
    if _gap(placement, [plan.placements[index] for index in near]) > TOLERANCE:
        gap = _gap(placement, plan.placements)  # others may lie further below
        raise ValueError(f"the item floats {1e3 * gap:.1f} mm above what lies below it.")


def _gap(placement: Placement, others: Iterable[Placement]) -> float:
    """Return the distance from an item down to the highest other one below it, or to the floor; m."""
    size, corner, below = placement.size, placement.corner, 0.0
    for other in others:
        top = other.corner[2] + other.size[2]
        if top <= corner[2] + TOLERANCE and min(_shared(corner, size, other.corner, other.size)[:2]) > 0:
            below = max(below, top)
    return corner[2] - below
