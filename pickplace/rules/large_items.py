"""The placements of large items on fine grids: what an item rests on, and which cells hold it.

:mod:`~pickplace.rules.placing` looks at each cell of the square under an item, for all footprints at once. That is
fastest for items of a few cells. Here the work grows with the side of the square instead of its area: the greatest
height under a rectangle is a maximum along one axis, then along the other; and for each height in a tote tables are
made of the cells that have it, in which a row of any footprint is looked up.
"""

from functools import reduce

import torch
from torch import Tensor

from pickplace.rules.cell import HULL_RULES, CellSpec
from pickplace.rules.maps import FAR, NEVER, rectangle_sums, surround
from pickplace.rules.state import surface_from
from pickplace.rules.support import Rows, is_stable

LEAST_SIDE = 8  # of the square; from there on this way is faster
MAX_ENTRIES = 2**22  # of a table; more problems are looked at in turn


def are_large(cell: CellSpec) -> bool:
    """Return whether :func:`resting` serves a cell and is faster than a look at each cell of the square."""
    return cell.max_side >= LEAST_SIDE and cell.support not in HULL_RULES


def resting(cell: CellSpec, surface: Tensor, w: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Return the height on which an item comes to rest on each footprint, and whether it is stable there.

    Both are ``[Q, W_T, D_T, N]``, int32 and bool. Footprints that leave the tote rest higher than any rim.

    Args:
        surface: int32 ``[W_T, D_T, N]``, all cells bear weight.
        w, d: footprint sizes, int64 ``[Q, 1, 1, N]``.
    """
    count = surface.shape[-1]
    at_once = max(1, MAX_ENTRIES // (len(surface.unique()) * cell.tote_size[0] * cell.tote_size[1]))
    parts = [slice(start, start + at_once) for start in range(0, count, at_once)]
    z, stable = zip(*(_resting(cell, surface[..., part], w[..., part], d[..., part]) for part in parts), strict=True)
    return torch.cat(z, -1), torch.cat(stable, -1)


def _resting(cell: CellSpec, surface: Tensor, w: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    (wide, deep, _), side = cell.tote_size, cell.max_side
    highest = surround(surface, (0, side - 1, 0, side - 1), 2 * FAR)[None]
    for axis, size, grid in ((1, w, wide), (2, d, deep)):
        parts = (torch.where(step < size, highest.narrow(axis, step, grid), NEVER) for step in range(side))
        highest = reduce(torch.maximum, parts)
    z, levels = highest >> 1, surface.unique()
    has_level = surface == levels.view(-1, 1, 1, 1)  # [levels, W_T, D_T, N]
    level = torch.searchsorted(levels, surface_from(z)).clamp_(max=len(levels) - 1)  # of the supporting cells
    count = rectangle_sums(has_level, w, d, level)
    return z, is_stable(cell, count, _rows(has_level, level, side, w, d), w, d)


def _rows(has_level: Tensor, level: Tensor, side: int, w: Tensor, d: Tensor) -> Rows:
    """Yield the rows of the supporting cells under each footprint.

    Args:
        has_level: whether a cell has a height, bool ``[levels, W_T, D_T, N]``.
        level: the index of the supporting cells' height, int64 ``[Q, W_T, D_T, N]``.
    """
    _, wide, deep, count = has_level.shape
    x_at, y_at, number = (torch.arange(size, device=level.device) for size in (wide, deep, count))
    start = ((level * wide + x_at.view(-1, 1, 1)) * deep + y_at.view(-1, 1)) * count + number
    y = y_at.view(-1, 1).short()
    after = torch.where(has_level, y, deep).flip(2).cummin(2).values.flip(2)  # first of the level from y on
    before = torch.where(has_level, y, -1).cummax(2).values
    end = start + (d - 1) * count
    for x in range(side):
        row, most = x * deep * count, after.numel() - 1
        first, last = after.take((start + row).clamp_(max=most)) - y, before.take((end + row).clamp_(max=most)) - y
        held = (x < w) & (first < d)
        yield torch.where(held, first, side), torch.where(held, last, -1)
