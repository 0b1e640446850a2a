"""Index of boxes by their place, to find those that may touch a new box without checking all."""

import math
from collections import defaultdict
from collections.abc import Sequence
from itertools import product

Key = tuple[int, ...]


class BoxIndex:
    """Boxes in three dimensions, numbered in the order in which they were added.

    Boxes of similar sides share a grid. Along each axis, a cell is as long as the next power of two above the side. So
    a box lies in at most eight cells, and a cell holds few boxes that do not overlap.
    """

    def __init__(self) -> None:
        self._count = 0
        #: boxes in each cell, for each grid; a grid is named by the exponents of its cell's sides
        self._grids: dict[Key, dict[Key, list[int]]] = defaultdict(lambda: defaultdict(list))

    def add(self, corner: Sequence[float], size: Sequence[float]) -> None:
        """Add a box, by its least corner and its sides, each above 0."""
        exponents = tuple(math.frexp(side)[1] for side in size)
        grid = self._grids[exponents]
        for cell in product(*_cells(exponents, corner, size, 0.0)):
            grid[cell].append(self._count)
        self._count += 1

    def near(self, corner: Sequence[float], size: Sequence[float], margin: float) -> list[int]:
        """Return the numbers of all boxes within a margin of a box, ascending; some further ones may be included."""
        found: set[int] = set()
        for exponents, grid in self._grids.items():
            ranges = _cells(exponents, corner, size, margin)
            if math.prod(map(len, ranges)) <= len(grid):
                for cell in product(*ranges):
                    found.update(grid.get(cell, ()))
            else:  # a large box among small ones
                for cell, numbers in grid.items():
                    if all(at in along for at, along in zip(cell, ranges, strict=True)):
                        found.update(numbers)
        return sorted(found)


def _cells(exponents: Key, corner: Sequence[float], size: Sequence[float], margin: float) -> list[range]:
    """Return the indices of the cells of a grid that a box with a margin touches, along each axis."""
    return [
        range(math.floor((low - margin) / 2.0**power), math.floor((low + side + margin) / 2.0**power) + 1)
        for power, low, side in zip(exponents, corner, size, strict=True)
    ]
