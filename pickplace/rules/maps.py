"""Operations on height maps of many problems.

Maps have the batch last in memory, ``[W, D, N]``. Most operations shift maps, and every inner loop then runs over the
problems instead of over a row of a few cells.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

FAR = 1 << 20  # higher than any wall: stands for a cell that nothing may occupy
NEVER = -1  # the "top" of a footprint on which the item cannot rest; no clearance is that low


def surround(maps: Tensor, margins: tuple[int, int, int, int], value: int) -> Tensor:
    """Return maps ``[W, D, N]`` with margins (before and after along x, then y) of a value.

    A negative margin cuts the maps.
    """
    x0, x1, y0, y1 = margins
    wide, deep, batch = maps.shape
    out = maps.new_full((wide + x0 + x1, deep + y0 + y1, batch), value)
    if min(margins) < 0:
        maps = maps[max(0, -x0) : max(0, wide + min(0, x1)), max(0, -y0) : max(0, deep + min(0, y1))]
        (wide, deep, _), x0, y0 = maps.shape, max(0, x0), max(0, y0)
    out[x0 : x0 + wide, y0 : y0 + deep] = maps
    return out


def windows(maps: Tensor, count: int) -> Tensor:
    """Return all shifts of maps ``[W + count - 1, D + count - 1, N]`` by up to ``count - 1`` cells.

    The result is a view, ``[count, count, W, D, N]``.
    """
    return maps.unfold(0, count, 1).unfold(1, count, 1).permute(3, 4, 0, 1, 2)


def rectangle(grid: Sequence[int], x: Tensor, y: Tensor, w: Tensor, d: Tensor) -> Tensor:
    """Return the cells of a grid inside the rectangle of size ``(w, d)`` at ``(x, y)``, bool ``[*grid, N]``."""
    column, row = (torch.arange(side, device=x.device)[:, None] for side in grid[:2])
    in_x, in_y = (column >= x) & (column < x + w), (row >= y) & (row < y + d)
    return in_x[:, None] & in_y


def square_cells(grid: Sequence[int], x: Tensor, y: Tensor, side: int) -> Tensor:
    """Return the flat cells of a square, int64 ``[side * side, N]``, row by row.

    Args:
        grid: ``(W, D)``.
        x, y: int64 ``[N]``, the square's minimum corner. Cells outside the grid become the nearest cell.
        side: side of the square, in cells.
    """
    (wide, deep), step = grid, torch.arange(side, device=x.device)[:, None]
    column, row = (x + step).clamp_(0, wide - 1), (y + step).clamp_(0, deep - 1)  # [side, N]
    return ((column * deep)[:, None] + row).flatten(0, 1)


def is_under(w: Tensor, d: Tensor, side: int) -> Tensor:
    """Return whether a ``w x d`` rectangle covers each cell of a square with the same minimum corner, row by row.

    The result is bool, ``[side * side, *shape of w]``.
    """
    step = torch.arange(side, device=w.device).view(-1, *[1] * w.dim())
    return ((step < w)[:, None] & (step < d)).flatten(0, 1)


def rectangle_sums(maps: Tensor, w: Tensor, d: Tensor, layer: Tensor | int = 0) -> Tensor:
    """Return the sum of a map over the part inside the grid of the ``w x d`` rectangle at each cell.

    Args:
        maps: whole numbers or bool, ``[L, W, D, N]``.
        w, d: int64, broadcastable to ``[Q, W, D, N]``.
        layer: int64 ``[Q, W, D, N]``, the index of the map to sum.

    Returns:
        int64 ``[Q, W, D, N]``
    """
    layers, wide, deep, batch = maps.shape
    before = maps.new_zeros(layers, wide + 1, deep + 1, batch, dtype=torch.int64)  # sums of the cells before x and y
    before[:, 1:, 1:] = maps.cumsum(1).cumsum(2)
    x, y, number = (torch.arange(size, device=maps.device) for size in (wide, deep, batch))
    x, y = x.view(-1, 1, 1), y.view(-1, 1)
    end_x, end_y = (x + w).clamp_(max=wide), (y + d).clamp_(max=deep)
    corners = [
        before.take(((layer * (wide + 1) + i) * (deep + 1) + j) * batch + number)
        for i, j in ((end_x, end_y), (x, y), (x, end_y), (end_x, y))
    ]
    return corners[0] + corners[1] - corners[2] - corners[3]
