"""Shapes of the end effector: which cells of its rectangle are body, and which are cup.

A mask is a tuple of columns, ``mask[x][y]``, of 0 and 1. Plain integers: no tensor is needed before masks are used.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from pickplace.common.validate import excerpt

Mask = tuple[tuple[int, ...], ...]

SHAPES = ("rectangle", "disc")


class Box(NamedTuple):
    """A rectangle of cells of a mask: minimum corner and sides."""

    x: int
    y: int
    width: int
    depth: int


def rectangle_mask(width: int, depth: int) -> Mask:
    """Return a mask of ones."""
    return ((1,) * depth,) * width


def disc_mask(width: int, depth: int) -> Mask:
    """Return the cells whose inside meets the ellipse inscribed in a rectangle: a circle if its sides are equal."""

    def distance(cell: int, side: int) -> int:
        """Twice the distance from the middle of the side to the cell."""
        return max(0, 2 * cell - side, side - 2 * (cell + 1))

    def is_touched(x: int, y: int) -> bool:
        return (distance(x, width) * depth) ** 2 + (distance(y, depth) * width) ** 2 < (width * depth) ** 2

    return tuple(tuple(int(is_touched(x, y)) for y in range(depth)) for x in range(width))


def read_shape(key: str, value: Any, size: tuple[int, int]) -> Any:
    """Return a shape as it was given, with a mask as tuples; ``ValueError`` if it is neither a name nor a mask."""
    if isinstance(value, str) and value in SHAPES:
        return value
    columns = _columns(value)
    if [len(column) for column in columns] != [size[1]] * size[0] or any(
        isinstance(cell, bool) or cell not in (0, 1) for column in columns for cell in column
    ):
        raise ValueError(
            f"{key}={excerpt(value)}: expected 'rectangle', 'disc', or a mask of effector_size={[*size]}: {size[0]} "
            f"lists of {size[1]} times 0 or 1."
        )
    if not any(map(any, columns)):
        raise ValueError(f"{key}={excerpt(value)}: expected a mask with a 1.")
    return tuple(tuple(int(cell) for cell in column) for column in columns)


def check_edges(key: str, mask: Mask) -> None:
    """Refuse a mask with an edge of zeros, which would be a smaller end effector."""
    for edge in (mask[0], mask[-1], *([column[at] for column in mask] for at in (0, -1))):
        if not any(edge):
            raise ValueError(
                f"{key}={excerpt(mask)}: expected a 1 in its first and last list, and first and last in some list; "
                "a smaller body needs a smaller effector_size."
            )


def check_cup_size(value: Any, size: tuple[int, int]) -> None:
    """Refuse sides of a cup that cannot lie in the middle of the body."""
    pairs = list(zip(value, size, strict=True))
    if any(cup > body or (body - cup) % 2 for cup, body in pairs):
        raise ValueError(
            f"cup_size={[*value]}: expected sides that differ from effector_size={[*size]} by an even number of cells, "
            "so that the cup is centred in the body."
        )


def centred(shape: str, cup: tuple[int, int], size: tuple[int, int]) -> Mask:
    """Return a rectangle or disc of ``cup`` cells in the middle of a mask of ``size``."""
    made = (disc_mask if shape == "disc" else rectangle_mask)(*cup)
    x0, y0 = ((outer - inner) // 2 for outer, inner in zip(size, cup, strict=True))
    return tuple(
        tuple(made[x - x0][y - y0] if x0 <= x < x0 + cup[0] and y0 <= y < y0 + cup[1] else 0 for y in range(size[1]))
        for x in range(size[0])
    )


def turned(mask: Mask) -> Mask:
    """Return a mask turned by a quarter turn: cell ``(x, y)`` goes where rotation 1 puts an item of one cell."""
    depth = len(mask[0])
    return tuple(tuple(column[depth - 1 - x] for column in mask) for x in range(depth))


def boxes(mask: Mask) -> tuple[Box, ...]:
    """Return rectangles that do not overlap and cover the ones of a mask; a rectangle is one."""
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
    """Return where the runs of ones begin, and their lengths."""
    runs, begin = [], None
    for y, cell in enumerate((*column, 0)):
        if cell and begin is None:
            begin = y
        elif not cell and begin is not None:
            runs.append((begin, y - begin))
            begin = None
    return runs


def _columns(value: Any) -> list[list]:
    """Return the columns of what may be a mask; none if it is not a list of lists."""
    try:
        return [] if isinstance(value, str) else [list(column) for column in value]
    except TypeError:
        return []
