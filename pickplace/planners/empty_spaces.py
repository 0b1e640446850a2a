"""Maximal empty spaces of totes, on whose floors packing heuristics set items down.

A *maximal empty space* is a space above the items, open to the top, that cannot grow. Its base is a rectangle of cells
that are no higher than its floor, and at least one of them is as high. Along each side of the rectangle is something
higher, or a wall.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

CELLS_AT_ONCE = 2**18  # cells that are processed together, over all floors


class Spaces(NamedTuple):
    """Maximal empty spaces, from ``x0`` to before ``x1``, and the same along y; int64 ``[S]`` each."""

    row: Tensor  # the number of the tote
    floor: Tensor  # the height
    x0: Tensor
    y0: Tensor
    x1: Tensor
    y1: Tensor


def empty_spaces(heights: Tensor, level_step: int = 0) -> Spaces:
    """Return the maximal empty spaces of totes; some may appear more than once.

    Args:
        heights: int32 ``[N, W_T, D_T]``.
        level_step: greatest difference between the heights of a level surface.
    """
    wide, deep = heights.shape[1:]
    levels = heights.flatten(1).sort(1).values
    row, place = F.pad(levels.diff(dim=1) > 0, (1, 0), value=True).nonzero(as_tuple=True)  # each height of a tote once
    at_once = max(1, CELLS_AT_ONCE // (wide * deep))
    parts = zip(row.split(at_once), levels[row, place].split(at_once), strict=True)
    found = [_spaces_on(heights, *part, level_step) for part in parts]
    return Spaces(*(torch.cat(each) for each in zip(*found, strict=True)))


def _spaces_on(heights: Tensor, row: Tensor, floor: Tensor, level_step: int) -> Spaces:
    """Return the maximal empty spaces with given floors, ``[F]``, in the totes of given numbers.

    Along y, such a space is as deep as the shortest run of free cells from its first row. Along x, it extends to both
    sides until a run is shorter. So only the side of least y remains to be checked.
    """
    heights, level = heights[row], floor[:, None, None]
    (wide, deep), y = heights.shape[1:], torch.arange(heights.shape[2], device=heights.device, dtype=torch.int32)
    free = heights <= level + level_step  # [F, W_T, D_T]
    run = torch.where(free, deep, y).flip(2).cummin(2).values.flip(2) - y
    x = torch.arange(wide, device=heights.device)[:, None]
    x0, x1 = x - _run_extent(run), x + 1 + _run_extent(run.flip(1)).flip(1)
    before = F.pad(free[:, :, :-1], (1, 0))  # whether the cell before along y is free
    closed = F.pad((~before).cumsum(1), (0, 0, 1, 0))
    grows = closed.gather(1, x1) == closed.gather(1, x0)
    number, x, y0 = (free & ~grows).nonzero(as_tuple=True)
    x0, x1, y1 = x0[number, x, y0], x1[number, x, y0], y0 + run[number, x, y0]
    filled = F.pad((heights >= level).cumsum(1).cumsum(2), (1, 0, 1, 0))  # counts of the cells as high as the floor
    count = filled[number, x1, y1] - filled[number, x0, y1] - filled[number, x1, y0] + filled[number, x0, y0]
    spaces = Spaces(row[number], floor[number].long(), x0, y0, x1, y1)
    return Spaces(*(part[count > 0] for part in spaces))


def _run_extent(run: Tensor) -> Tensor:
    """Return the number of successive cells towards x = 0 whose runs are no shorter, int64 of the same shape."""
    reach, going = torch.zeros_like(run, dtype=torch.int64), run > 0
    for step in range(1, run.shape[1]):
        going = going[:, 1:] & (run[:, :-step] >= run[:, step:])
        if not going.any():
            break
        reach[:, step:] += going
    return reach
