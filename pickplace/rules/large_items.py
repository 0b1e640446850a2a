"""The placements of large items on fine grids: what an item rests on, and which cells hold it.

:mod:`~pickplace.rules.placing` looks at each cell of the square under an item, for all footprints at once. That is
fastest for items of a few cells. Here the work grows with the side of the square instead of its area: the greatest
height under a rectangle is a maximum along one axis, then along the other; and for each height in a tote tables are
made of the cells that have it, in which a row of any footprint is looked up.
"""

from collections.abc import Iterator
from functools import cached_property, reduce

import torch
from torch import Tensor

from pickplace.rules.cell import CellSpec
from pickplace.rules.maps import FAR, NEVER, is_under, rectangle_sums, surround, windows
from pickplace.rules.state import surface_from
from pickplace.rules.support.contact import Contact

LEAST_SIDE = 8  # of the square; from there on this way is faster
MAX_ENTRIES = 2**22  # of a table; more problems are looked at in turn


def are_large(cell: CellSpec) -> bool:
    """Return whether :func:`resting` is faster than a look at each cell of the square."""
    return cell.max_side >= LEAST_SIDE


def resting(cell: CellSpec, surface: Tensor, w: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Return the height on which an item comes to rest on each footprint, and whether it is stable there.

    Both are ``[Q, W_T, D_T, N]``, int32 and bool. Footprints that leave the tote rest higher than any rim.

    Args:
        surface: int32 ``[W_T, D_T, N]``.
        w, d: footprint sizes, int64 ``[Q, 1, 1, N]``.
    """
    count = surface.shape[-1]
    at_once = max(1, MAX_ENTRIES // (len(surface.unique()) * cell.tote_size[0] * cell.tote_size[1]))
    parts = [slice(start, start + at_once) for start in range(0, count, at_once)]
    contacts = (LargeContact(cell, surface[..., part], w[..., part], d[..., part]) for part in parts)
    z, stable = zip(*((contact.z, cell.support.stable(contact)) for contact in contacts), strict=True)
    return torch.cat(z, -1), torch.cat(stable, -1)


class LargeContact(Contact):
    """The supporting cells of large items on every footprint; all quantities are ``[Q, W_T, D_T, N]``.

    Args: as of :func:`resting`.
    """

    def __init__(self, cell: CellSpec, surface: Tensor, w: Tensor, d: Tensor):
        self.side, self.surface, self.w, self.d = cell.max_side, surface, w, d
        self.padded = surround(surface, (0, self.side - 1, 0, self.side - 1), 2 * FAR)
        highest = self.padded[None]
        for axis, size, grid in ((1, w, surface.shape[0]), (2, d, surface.shape[1])):
            parts = (torch.where(step < size, highest.narrow(axis, step, grid), NEVER) for step in range(self.side))
            highest = reduce(torch.maximum, parts)
        self.z = highest >> 1
        self.supporting = surface_from(self.z)

    @property
    def surfaces(self):
        return windows(self.padded, self.side).flatten(0, 1).unbind(0)

    @property
    def under(self):
        return is_under(self.w, self.d, self.side).unbind(0)

    @cached_property
    def _levels(self) -> tuple[Tensor, Tensor]:
        """Whether a cell has a height, bool ``[levels, W_T, D_T, N]``, and the index of the supporting cells' height.

        The last level is one that no cell has.
        """
        levels = torch.cat([self.surface.unique(), self.surface.new_tensor([4 * FAR])])
        level = torch.searchsorted(levels, self.supporting)
        level = torch.where(levels[level] == self.supporting, level, len(levels) - 1)
        return self.surface == levels.view(-1, 1, 1, 1), level

    @property
    def count(self) -> Tensor:
        has_level, level = self._levels
        return rectangle_sums(has_level, self.w, self.d, level)

    def rows(self) -> Iterator[tuple[Tensor, Tensor]]:
        (has_level, level), side = self._levels, self.side
        _, wide, deep, count = has_level.shape
        x_at, y_at, number = (torch.arange(size, device=level.device) for size in (wide, deep, count))
        start = ((level * wide + x_at.view(-1, 1, 1)) * deep + y_at.view(-1, 1)) * count + number
        y = y_at.view(-1, 1).short()
        after = torch.where(has_level, y, deep).flip(2).cummin(2).values.flip(2)  # first of the level from y on
        before = torch.where(has_level, y, -1).cummax(2).values
        end = start + (self.d - 1) * count
        for x in range(side):
            row, most = x * deep * count, after.numel() - 1
            first, last = after.take((start + row).clamp_(max=most)) - y, before.take((end + row).clamp_(max=most)) - y
            held = (x < self.w) & (first < self.d)
            yield torch.where(held, first, side), torch.where(held, last, -1)
