"""The stability rule of PCT's code: every item of the pile keeps its load inside the hull of what carries it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf, nan, sqrt
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from pickplace.common.capture import is_capturing
from pickplace.common.validate import refuse_if
from pickplace.rules.support.base import Support
from pickplace.rules.support.contact import Contact

SHRINK = 0.1  # the corners of a hull move by this share of the way to their mean
SKEW = 1e-6  # shift along x for each cell along y: then a line along y has a slope

MAX_VISITS = 2_000  # of boxes in one test: the number of paths grows exponentially in a pile of crossed planks

Point: TypeAlias = tuple[float, float]
Cuboid: TypeAlias = tuple[int, ...]  # x, y, z, w, d, h


@dataclass(frozen=True)
class Pct(Support):
    """For the item and each item below, the centre of the load is inside the hull of the areas that carry it.

    From the code of PCT (Zhao et al., 2022, "Learning Efficient Online 3D Bin Packing on Packing Configuration Trees"),
    setting 1. Items weigh as much as their volume. Hulls are made smaller by a tenth. An item hands its load to those
    that it touches: all of it to the one below its centre, else in shares by the places of the contacts. That code
    tests a placement twice, and both must agree: down each path to the floor by itself, and with all paths together.

    Placements are tested one by one, in Python. An item with thousands of paths down to the floor counts as unstable.
    """

    sees_boxes = True

    def stable(self, contact: Contact) -> Tensor:
        refuse_if(is_capturing(), "compile.cudagraphs=true: support=pct works in Python; expected false.")
        boxes, x, y, h = contact.neighbours
        parts = (part.expand(contact.z.shape) for part in (x, y, contact.z, contact.w, contact.d, h))
        cuboids = torch.stack([*parts], -1).view(-1, len(boxes), 6).transpose(0, 1).tolist()
        stable = [
            [cuboid[2] == 0 or pile.bears(tuple(cuboid)) for cuboid in some]
            for pile, some in zip(map(_pile, boxes), cuboids, strict=True)
        ]
        return torch.tensor(stable, device=boxes.device).t().reshape(contact.z.shape)


class _Load:
    """A mass and its centre. It changes while something else is put on top."""

    __slots__ = ("mass", "x", "y")

    def __init__(self, x: float, y: float, mass: float):
        self.x, self.y, self.mass = x, y, mass


class _Contact(NamedTuple):
    """The area in which an item lies on one below."""

    box: "_Box"
    near: tuple[int, int]  # least x and y
    far: tuple[int, int]  # greatest x and y

    @property
    def middle(self) -> Point:
        return (self.near[0] + self.far[0]) / 2, (self.near[1] + self.far[1]) / 2

    @property
    def corners(self) -> Iterable[Point]:
        return ((x, y) for x in (self.near[0], self.far[0]) for y in (self.near[1], self.far[1]))


class _Box:
    """An item of a pile, with what it lies on and what lies on it."""

    def __init__(self, cuboid: Cuboid, below: Sequence["_Box"]):
        x, y, z, w, d, h = cuboid
        self.near, self.far, self.top = (x, y), (x + w, y + d), z + h
        self.own = _Load(x + w / 2, y + d / 2, w * d * h)
        self.total = _Load(self.own.x, self.own.y, self.own.mass)  # with everything above
        self.received: dict[_Box, _Load] = {}  # from each item on top
        found = (_Contact(box, *_overlap(self, box)) for box in below)
        self.contacts = [each for each in found if each.near[0] < each.far[0] and each.near[1] < each.far[1]]
        self.hull = _smaller(_hull([corner for each in self.contacts for corner in each.corners]))

    def weigh(self, without: "_Box | None" = None, extra: _Load | None = None) -> _Load:
        """Return the load on what carries this item: its own mass and what it receives, but ``extra`` in place of what
        it receives from one item."""
        loads = [self.own, *(load for box, load in self.received.items() if box is not without)]
        loads += [] if extra is None else [extra]
        mass = sum(load.mass for load in loads)
        x, y = sum(load.x * load.mass for load in loads), sum(load.y * load.mass for load in loads)
        # Least squares may give a negative share. With no mass left there is no centre, and nothing carries it.
        return _Load(x / mass, y / mass, mass) if mass else _Load(nan, nan, mass)

    def hand_down(self, load: _Load) -> list[_Load] | None:
        """Return what each contact carries of a load; None if its centre is outside the hull."""
        if not self.contacts:
            return []
        return _shares(load, self.contacts) if _is_inside((load.x, load.y), self.hull) else None


#: An item, what it had received, and its load, before a change.
_Change: TypeAlias = tuple[_Box, dict[_Box, _Load], tuple[float, float, float]]


class _Pile:
    """The items in a tote."""

    def __init__(self, cuboids: Iterable[Cuboid]):
        self.by_top: dict[int, list[_Box]] = {}
        for cuboid in cuboids:
            box = _Box(cuboid, self.by_top.get(cuboid[2], []))
            _settle(box, [])
            self.by_top.setdefault(box.top, []).append(box)

    def bears(self, cuboid: Cuboid) -> bool:
        """Return whether another item would be stable, which does not lie on the floor."""
        if cuboid[2] not in self.by_top:
            return False  # outside the tote
        box = _Box(cuboid, self.by_top[cuboid[2]])
        if not box.contacts or not _is_carried_by_each_path(box):
            return False
        changes: list[_Change] = []
        try:
            return _settle(box, changes)
        finally:
            for below, received, total in reversed(changes):
                below.received, (below.total.x, below.total.y, below.total.mass) = received, total


def _is_carried_by_each_path(box: _Box) -> bool:
    """Return whether the load of a new item can be carried down every path to the floor, each by itself."""
    open_ = [(box, box.total)]
    for _ in range(MAX_VISITS):
        if not open_:
            return True
        box, load = open_.pop()
        if (shares := box.hand_down(load)) is None:
            return False
        open_ += [(below.box, below.box.weigh(box, share)) for below, share in zip(box.contacts, shares, strict=True)]
    return False


def _settle(box: _Box, changes: list[_Change]) -> bool:
    """Hand the load of a new item down, and return whether everything carries it; ``changes`` gets what was before."""
    open_ = [box]
    for _ in range(MAX_VISITS):
        if not open_:
            return True
        box = open_.pop()
        if (shares := box.hand_down(box.total)) is None:
            return False
        for (below, *_), share in zip(box.contacts, shares, strict=True):
            changes.append((below, below.received, (below.total.x, below.total.y, below.total.mass)))
            below.received = {**below.received, box: share}
            # In place: an item that carries all of the box refers to this load.
            after = below.weigh()
            below.total.x, below.total.y, below.total.mass = after.x, after.y, after.mass
        open_ += [below.box for below in reversed(box.contacts)]
    return False


def _pile(boxes: Tensor) -> _Pile:
    """Return the pile of a tote with boxes ``[L, 6]``."""
    return _pile_of(tuple(map(tuple, boxes[boxes[:, 5] > 0].tolist())))


_pile_of = lru_cache(maxsize=256)(_Pile)


def _overlap(box: _Box, other: _Box) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the corners of the area that two items share, seen from above."""
    near = max(box.near[0], other.near[0]), max(box.near[1], other.near[1])
    return near, (min(box.far[0], other.far[0]), min(box.far[1], other.far[1]))


def _shares(load: _Load, contacts: Sequence[_Contact]) -> list[_Load]:
    """Return the part of a load that each contact carries."""
    if len(contacts) == 1:
        return [load]
    for number, (_, near, far) in enumerate(contacts):
        if near[0] < load.x < far[0] and near[1] < load.y < far[1]:
            return [load if number == other else _Load(load.x, load.y, 0.0) for other in range(len(contacts))]
    middles = [contact.middle for contact in contacts]
    if len(contacts) == 2:
        first, second = middles
        along = first[0] - second[0], first[1] - second[1]
        square = sqrt(along[0] ** 2 + along[1] ** 2) ** 2  # as in that code: equal loads must round alike
        unit = along[0] / square, along[1] / square
        ratios = [abs((load.x - end[0]) * unit[0] + (load.y - end[1]) * unit[1]) for end in (second, first)]
    else:
        ratios = _least_squares((load.x, load.y), middles)
    return [_Load(*middle, load.mass * ratio) for middle, ratio in zip(middles, ratios, strict=True)]


def _least_squares(centre: Point, middles: Sequence[Point]) -> list[float]:
    """Return the share of a load that each of three or more contacts carries: each pair as if it were alone."""
    count = len(middles)
    rows = []
    for i in range(count - 1):
        for j in range(i + 1, count):
            along = middles[i][0] - middles[j][0], middles[i][1] - middles[j][1]
            from_i, from_j = (
                (centre[0] - end[0]) * along[0] + (centre[1] - end[1]) * along[1] for end in (middles[i], middles[j])
            )
            row = [0.0] * count
            if from_i != 0:
                row[i], row[j] = 1.0, -abs(from_j) / from_i
            rows.append(row)
    system = torch.tensor([*rows, [1.0] * count], dtype=torch.float64)
    sums = torch.tensor([*[0.0] * len(rows), 1.0], dtype=torch.float64)[:, None]
    return torch.linalg.lstsq(system, sums, driver="gelsd").solution[:, 0].tolist()


def _hull(corners: Iterable[Point]) -> list[Point]:
    """Return the corners of the convex hull, skewed by :data:`SKEW`."""
    skewed = sorted(((x + y * SKEW, float(y)) for x, y in corners), key=lambda point: point[0])
    return _chain(skewed)[:-1] + _chain(skewed[::-1])[:-1]


def _chain(points: Sequence[Point]) -> list[Point]:
    """Return one side of the hull, from the first to the last of sorted points."""
    chain: list[Point] = []
    for point in points:
        while len(chain) >= 2 and not _slope(chain[-2], chain[-1]) < _slope(chain[-1], point):
            chain.pop()
            if chain[0] == chain[-1]:
                break
        chain.append(point)
    return chain


def _slope(first: Point, second: Point) -> float:
    along, across = second[0] - first[0], second[1] - first[1]
    if along != 0:
        return across / along
    return across * inf if across else nan


def _smaller(hull: Sequence[Point]) -> list[Point]:
    """Return the corners of a hull after it is made smaller, see :data:`SHRINK`."""
    if not hull:
        return []
    mean = [sum(part) / len(hull) for part in zip(*hull, strict=True)]
    return [(x - (x - mean[0]) * SHRINK, y - (y - mean[1]) * SHRINK) for x, y in hull]


def _is_inside(point: Point, polygon: Sequence[Point]) -> bool:
    """Return whether a point is inside a polygon, and on the line of none of its edges."""
    inside, (x, y), (last_x, last_y) = False, point, polygon[-1]
    for at_x, at_y in polygon:
        if (at_x - x) * (y - last_y) - (at_y - y) * (x - last_x) == 0:
            return False
        crosses = (at_y < y) != (last_y < y)
        if crosses and at_x + (y - at_y) / (last_y - at_y) * (last_x - at_x) < x:
            inside = not inside
        last_x, last_y = at_x, at_y
    return inside
