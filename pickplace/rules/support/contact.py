"""What supports an item where it comes to rest: on the grid, and on a surface that was measured.

The *supporting cells* are the cells under the footprint that are as high as the highest of them, and bear weight.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TypeAlias

import torch
from torch import Tensor

from pickplace.rules.state import surface_from
from pickplace.rules.support import hull

Cells: TypeAlias = Sequence[Tensor] | Tensor  # a tensor for each cell of a square, row by row


class Contact:
    """The supporting cells of many items; each quantity is computed when a rule asks for it.

    Args:
        surfaces: for each cell of a square at the footprint's minimum corner its surface, int32, all of one shape.
        under: whether the item covers that cell, bool, broadcastable.
        z: the height on which the item rests, int32.
        w, d: the footprint's sides, broadcastable; 0 for no item.

    Attributes:
        supporting: the surface of a supporting cell, int32 of the shape of ``z``.
        side: ``S``, of the square.
    """

    def __init__(self, surfaces: Cells, under: Cells, z: Tensor, w: Tensor, d: Tensor):
        self.surfaces, self.under, self.z, self.w, self.d = surfaces, under, z, w, d
        self.supporting, self.side = surface_from(z), round(len(under) ** 0.5)

    def cells(self) -> Iterator[Tensor]:
        """Yield for each cell of the square, row by row, whether it is a supporting one, bool of the shape of ``z``."""
        for surface, used in zip(self.surfaces, self.under, strict=True):
            yield (surface == self.supporting) & used

    @property
    def count(self) -> Tensor:
        """The number of supporting cells, of the shape of ``z``."""
        count = torch.zeros_like(self.z)
        for supports in self.cells():
            count += supports
        return count

    def rows(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield the first and the last supporting cell of each row of the square along y, int16 of the shape of ``z``.

        They are counted from the square's corner. Without one, the first is at least ``side``, and the last is -1.
        """
        cells = self.cells()
        for _ in range(self.side):
            first = last = torch.zeros_like(self.z, dtype=torch.int16)  # counted from the ends of the square; 0: none
            for y in range(self.side):
                here = next(cells).short()
                first, last = torch.maximum(first, here * (self.side - y)), torch.maximum(last, here * (y + 1))
            yield self.side - first, last - 1

    @cached_property
    def share(self) -> Tensor:
        """The supported share of the footprint, float64 of the shape of ``z``."""
        return self.count.double() / (self.w * self.d)

    @property
    def corners(self) -> Tensor:
        """The number of the footprint's corners that are supported, 0 to 4; one cell may have several corners."""
        corners = torch.zeros_like(self.z)
        for x, (first, last) in enumerate(self.rows()):
            corners += ((first == 0).int() + (last == self.d - 1)) * ((self.w == x + 1).int() + (x == 0))
        return corners

    def is_centre_in_hull(self, margin: float = 0.0) -> Tensor:
        """Return whether the item's centre lies inside the hull of the supporting cells, bool of the shape of ``z``.

        Args:
            margin: distance from the hull's edge that the centre must exceed, in cells.
        """
        return hull.is_centre_inside(self.surfaces, self.supporting, self.w, self.d, margin)

    def is_centre_in_hull_of_middles(self) -> Tensor:
        """Return whether the item's centre lies in the hull of the middles of the supporting cells, or on its edge."""
        return hull.is_centre_in_hull_of_middles(self.rows(), self.w, self.d, self.side)

    def in_hull(self) -> Tensor:
        """Return which cells under the items lie inside the hull of the supporting cells, bool ``[S * S, N]``."""
        under = torch.stack([*self.under])
        return hull.cells_inside(torch.stack([*self.cells()]), under)


class Patches:
    """The patches of a measured surface that are wholly under an item, for each place of it.

    Args:
        supports: whether they carry the item, bool ``[W, D, patches]``.
        along: how far a patch reaches from the item's centre in each direction, float64 ``[directions, patches]``.
        cells: cell of the footprint in which each patch lies, row by row, int64 ``[patches]``.
        per_cell: number of patches along a side of a cell.
        slack: by which a direction between two others may differ, in patches.
        touched: number of patches that the item covers, in part too.
        fewest: number of patches along its shorter side.
    """

    #: Least distance of an item's centre from the hull's edge, in patches: as far as a patch may be covered in part.
    MARGIN = 1.5

    def __init__(self, supports: Tensor, along: Tensor, cells: Tensor, per_cell: int, slack=0.0, touched=1.0, fewest=0):
        self.supports, self.along, self.cells, self.per_cell = supports, along, cells, per_cell
        self.slack, self.touched, self.fewest = slack, touched, fewest
        self._inside: dict[float, Tensor] = {}

    @property
    def share(self) -> Tensor:
        """The share of the item that is carried, float64 ``[W, D]``."""
        return self.supports.sum(-1).double() / self.touched

    @property
    def full(self) -> Tensor:
        """Whether all of the item is carried, bool ``[W, D]``.

        There must be two patches along both sides: something then carries each quarter of the item, though a patch may
        be covered in part. (With one value a cell only cells that are level bear weight.)
        """
        return self.supports.all(-1) & (self.fewest >= (2 if self.per_cell > 1 else 1))

    def is_centre_in_hull(self, margin: float = 0.0) -> Tensor:
        """Return whether the item's centre lies inside the hull of what carries it, bool ``[W, D]``.

        A patch that is covered in part counts as whole.

        Args:
            margin: distance from the hull's edge that the centre must exceed, in cells.
        """
        margin = max(margin * self.per_cell, self.MARGIN if self.per_cell > 1 else 0.0) + self.slack
        if margin not in self._inside:
            reached = self.supports.double() @ (self.along > margin).double().t()  # [W, D, directions]
            self._inside[margin] = (reached > 0).all(-1)
        return self._inside[margin]
