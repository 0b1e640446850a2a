"""Placing: how high an item rests on a footprint, whether it is stable there, and what the end effector must clear.

Surfaces, see :func:`~pickplace.rules.state.surface_from`, are halved where heights are needed.
"""

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor

from pickplace.rules import large_items
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Item
from pickplace.rules.maps import FAR, NEVER, is_under, surround, windows
from pickplace.rules.state import State, surface_from
from pickplace.rules.support.contact import Contact


# ---------------------------------------------------------------------- the checks of a placement, one function each
def rest(cells: Sequence[Tensor], under: Sequence[Tensor]) -> Tensor:
    """Return the height on which an item comes to rest.

    Loops over cells, so that the inner loops run over whole maps, which is fast.

    Args:
        cells: for each cell of a square at the footprint's minimum corner its surface, int32, all of one shape.
        under: whether the item covers that cell, bool, broadcastable.
    """
    highest = torch.full((), NEVER, dtype=cells[0].dtype, device=cells[0].device)
    for surface, used in zip(cells, under, strict=True):
        highest = torch.maximum(highest, torch.where(used, surface, NEVER))
    return highest >> 1


def overflows(top: Tensor, tote_height: Tensor) -> Tensor:
    """Return whether an item's top passes the rim."""
    return top > tote_height


def is_within_reach(lowest: Tensor, highest: Tensor, top: Tensor) -> Tensor:
    """Return whether the robot may bring an item's top to that height, see :class:`~pickplace.rules.cell.Limits`."""
    return (lowest <= top) & (top <= highest)


# ---------------------------------------------------------------------- maps
def resting_top(cell: CellSpec, surface: Tensor, tote_height: Tensor, item: Item) -> tuple[Tensor, Tensor]:
    """Return the height of the item's top for every footprint, and what it rests on; int32 ``[N, Q, W_T, D_T]`` each.

    Arguments as of :meth:`~pickplace.rules.state.State.each_item`.

    The top is ``NEVER`` where the item cannot rest: the footprint leaves the tote, the top passes the rim, or the
    support is too small. The height below it is that of :func:`rest`, stable or not; ``FAR`` outside the tote.
    """
    w, d = footprint_sizes(cell, item)
    if large_items.are_large(cell):
        z, stable = large_items.resting(cell, surface.permute(1, 2, 0), w, d)
    else:
        cells, under = footprint_cells(cell, surface, w, d)
        z = rest(cells, under)
        stable = cell.support.stable(Contact(cells, under, z, w, d))
    top = z + item.h.to(z.dtype)
    good = stable & ~overflows(top, tote_height) & ~item.is_empty
    return torch.where(good, top, NEVER).permute(3, 0, 1, 2), z.permute(3, 0, 1, 2)


def unchecked_top(cell: CellSpec, surface: Tensor, item: Item) -> tuple[Tensor, Tensor]:
    """Return the same as :func:`resting_top`, but for every footprint in the tote, stable or not."""
    z = rest(*footprint_cells(cell, surface, *footprint_sizes(cell, item)))
    return (z + item.h.to(z.dtype)).permute(3, 0, 1, 2), z.permute(3, 0, 1, 2)


def footprint_sizes(cell: CellSpec, item: Item) -> tuple[Tensor, Tensor]:
    """Return width and depth of the item's footprint in each parity, int64 ``[Q, 1, 1, N]`` each."""
    w, d = (torch.stack(pair)[: cell.parities, None, None] for pair in ((item.w, item.d), (item.d, item.w)))
    return w, d


def footprint_cells(
    cell: CellSpec, surface: Tensor, w: Tensor, d: Tensor
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Return the cells of a square at every footprint's minimum corner, and whether the item covers them.

    Args:
        surface: int32 ``[N, W_T, D_T]``.
        w, d: as of :func:`footprint_sizes`.

    Returns:
        for each cell of the square its surface, int32 ``[W_T, D_T, N]``, beyond any height outside the tote; and bool
        ``[Q, 1, 1, N]``.
    """
    side = cell.max_side
    padded = surround(surface.permute(1, 2, 0), (0, side - 1, 0, side - 1), 2 * FAR)
    return windows(padded, side).flatten(0, 1).unbind(0), is_under(w, d, side).unbind(0)


def clearance(cell: CellSpec, state: State) -> Tensor:
    """Return the least top at which the end effector hits nothing, per shape and place cell.

    That is the highest tote cell under the end effector; where it leaves the tote, the rim. The result is int32
    ``[N, B, W_T, D_T]``, for each of :attr:`~pickplace.rules.cell.CellSpec.effectors`.
    """
    (tote_w, tote_d, _), surface = cell.tote_size, state.surface
    maps = surface.new_empty(len(cell.effectors), tote_w, tote_d, len(surface))
    rim = surface_from(state.tote_height)
    for number, shape in enumerate(cell.effectors):
        after_x, after_y = shape.width - 1 - shape.ref_x, shape.depth - 1 - shape.ref_y
        walled = surround(surface.permute(1, 2, 0), (shape.ref_x, after_x, shape.ref_y, after_y), rim)
        highest = []
        for box in shape.body:
            under = walled
            # The maximum over a rectangle is a maximum along one axis, then along the other.
            for axis, begin, size, grid in ((0, box.x, box.width, tote_w), (1, box.y, box.depth, tote_d)):
                under = reduce(torch.maximum, [under.narrow(axis, begin + i, grid) for i in range(size)])
            highest.append(under)
        maps[number] = reduce(torch.maximum, highest) >> 1
    return maps.permute(3, 0, 1, 2)
