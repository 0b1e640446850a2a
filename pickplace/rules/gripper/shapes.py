"""Shapes of the gripper: which cells of its rectangle are body, and which are cup.

A mask is a tuple of columns, ``mask[x][y]``, of 0 and 1: plain integers, as no tensor is needed before masks are used.
"""

import math
from collections.abc import Sequence
from itertools import groupby
from typing import Any, NamedTuple

from pickplace.common.validate import expect

Mask = tuple[tuple[int, ...], ...]
Polygon = tuple[tuple[float, float], ...]  # its corners, counter-clockwise

DISC_SIDES = 32  # of the polygon around a disc: 0.5% wider than it


class Box(NamedTuple):
    """A rectangle of cells of a mask: minimum corner and sides."""

    x: int
    y: int
    width: int
    depth: int


def is_in_disc(x: int, y: int, width: int, depth: int) -> bool:
    """Return whether the inside of a cell meets the ellipse inscribed in a rectangle: a circle if its sides are equal.

    Distances from the middle of each side to the cell are doubled, so that they are whole.
    """
    away_x, away_y = (max(0, 2 * at - side, side - 2 * (at + 1)) for at, side in ((x, width), (y, depth)))
    return (away_x * depth) ** 2 + (away_y * width) ** 2 < (width * depth) ** 2


def read_shape(key: str, value: Any, size: tuple[int, int]) -> str | Mask:
    """Return a shape as given, a mask as tuples; raise ``ValueError`` if it is neither a name nor a mask."""
    if isinstance(value, str) and value in ("rectangle", "disc"):
        return value
    try:
        columns = [] if isinstance(value, str) else [list(column) for column in value]
    except TypeError:
        columns = []
    good = [len(column) for column in columns] == [size[1]] * size[0] and not any(
        isinstance(cell, bool) or cell not in (0, 1) for column in columns for cell in column
    )
    mask = f"a mask of size={[*size]}: {size[0]} lists of {size[1]} times 0 or 1"
    expect(good, key, value, f"'rectangle', 'disc', or {mask}")
    expect(any(map(any, columns)), key, value, "a mask with a 1")
    return tuple(tuple(map(int, column)) for column in columns)


def centred(shape: str | Mask, inner: tuple[int, int], size: tuple[int, int]) -> Mask:
    """Return a rectangle or disc of ``inner`` cells in the middle of a mask of ``size``; a mask unchanged."""
    if not isinstance(shape, str):
        return shape
    x0, y0 = ((outer - side) // 2 for outer, side in zip(size, inner, strict=True))

    def is_covered(x: int, y: int) -> bool:
        is_inside = 0 <= x < inner[0] and 0 <= y < inner[1]
        return is_inside and (shape == "rectangle" or is_in_disc(x, y, *inner))

    return tuple(tuple(int(is_covered(x - x0, y - y0)) for y in range(size[1])) for x in range(size[0]))


def turned(mask: Mask) -> Mask:
    """Return a mask turned by a quarter turn: cell ``(x, y)`` goes where rotation 1 puts an item of one cell."""
    depth = len(mask[0])
    return tuple(tuple(column[depth - 1 - x] for column in mask) for x in range(depth))


def boxes(mask: Mask) -> tuple[Box, ...]:
    """Return rectangles that do not overlap and cover the ones of a mask; one for a rectangular mask."""
    found: list[Box] = []
    open_runs: dict[tuple[int, int], int] = {}  # (y, depth) of the runs of the column before -> where they began
    for x, column in enumerate((*mask, ())):
        runs = _runs(column)
        for run in [run for run in open_runs if run not in runs]:
            begin = open_runs.pop(run)
            found.append(Box(begin, run[0], x - begin, run[1]))
        for run in runs:
            open_runs.setdefault(run, x)
    return tuple(sorted(found))


def _runs(column: Sequence[int]) -> list[tuple[int, int]]:
    """Return the start and the length of each run of ones."""
    groups = (list(group) for _, group in groupby(enumerate(column), key=lambda entry: entry[1]))
    return [(group[0][0], len(group)) for group in groups if group[0][1]]


def parts(shape: str | Mask, size: tuple[int, int]) -> tuple[Polygon, ...]:
    """Return convex polygons that cover a shape of ``size``, in cells from its middle.

    A mask gives its rectangles. A disc gives one polygon around it, which touches the same sides of ``size``.
    """
    wide, deep = size
    if shape == "disc":
        angles = [2 * math.pi * (number + 0.5) / DISC_SIDES for number in range(DISC_SIDES)]
        reach = 0.5 / math.cos(math.pi / DISC_SIDES)
        return (tuple((reach * wide * math.cos(angle), reach * deep * math.sin(angle)) for angle in angles),)
    corners = ((0, 0), (1, 0), (1, 1), (0, 1))
    return tuple(
        tuple((box.x + box.width * x - wide / 2, box.y + box.depth * y - deep / 2) for x, y in corners)
        for box in boxes(centred(shape, size, size))
    )
