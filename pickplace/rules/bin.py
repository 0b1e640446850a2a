"""A bin with several items: which one a pick takes, what stands in the way, and how the bin is filled again.

Each pick takes one item: the highest that the cup grips. The end effector may hang over lower ones; one that is as high
or higher would be lifted, too, or hit. The tables here have a row for each item, ``[N * M]``, those of a bin one after
the other (:meth:`~pickplace.task.state.State.each_item`).
"""

from functools import reduce

import torch
from torch import Tensor

from pickplace.task.cell import CellSpec
from pickplace.task.grasps import is_gripped
from pickplace.task.items import ItemDistribution, hashed_uniform
from pickplace.task.state import Item


def blocked_picks(cell: CellSpec, items: Item) -> Tensor:
    """Return at which pick cells the end effector would touch another item that is as high or higher.

    Args:
        items: ``[N, M]``.

    Returns:
        bool ``[N * M, P]``, for each item the picks that would take it.
    """
    near = [torch.arange(side, device=items.x.device).view(-1, 1, 1) for side in cell.bin_size[:2]]
    shape = cell.effector(0)
    left, front = near[0] - shape.ref_x, near[1] - shape.ref_y  # [W_B, 1, 1], [D_B, 1, 1]
    touches = torch.zeros(*cell.bin_size[:2], *items.x.shape, dtype=torch.bool, device=items.x.device)
    for box in shape.body:
        in_x = (left + box.x < items.x + items.w) & (left + box.x + box.width > items.x)  # [W_B, N, M]
        in_y = (front + box.y < items.y + items.d) & (front + box.y + box.depth > items.y)
        touches |= in_x[:, None] & in_y
    touches &= ~items.is_empty
    count = items.x.shape[1]
    blocked = torch.zeros_like(touches)
    for other in range(count):
        in_the_way = items.h[:, other, None] >= items.h  # [N, M]
        in_the_way[:, other] = False
        blocked |= touches[..., other, None] & in_the_way
    return blocked.flatten(2).flatten(0, 1).t()


def taken_item(cell: CellSpec, items: Item, x: Tensor, y: Tensor) -> Tensor:
    """Return the number of the item that picks at cells ``(x, y)`` take, int64 ``[N]``: the highest that is gripped.

    Of equals the first, and 0 if none is gripped; such picks fail.

    Args:
        items: ``[N, M]``.
        x, y: int64 ``[N]``.
    """
    shape = cell.effector(0)
    near_x, near_y = items.x - (x - shape.ref_x)[:, None], items.y - (y - shape.ref_y)[:, None]
    gripped = is_gripped(cell, near_x, near_y, items.w, items.d) & ~items.is_empty
    return torch.where(gripped, items.h, 0).argmax(1)


def select_item(items: Item, number: Tensor) -> Item:
    """Return one item of each bin, ``[N]``; ``number`` is int64 ``[N]``."""
    return Item(*(part.gather(1, number[:, None])[:, 0] for part in items))


def remove_item(items: Item, number: Tensor, removed: Tensor | None = None) -> Item:
    """Return what is left in the bins ``[N, M]``; later items move up, so that the first is the oldest.

    Args:
        number: int64 ``[N]``.
        removed: bool ``[N]``, whether that item is removed at all; None: it is.
    """
    place = torch.arange(items.x.shape[1], device=items.x.device)
    later = place >= number[:, None]
    after = place + (later if removed is None else later & removed[:, None])
    return Item(*(torch.cat([part, torch.zeros_like(part[:, :1])], 1).gather(1, after) for part in items))


def refill(
    cell: CellSpec, source: ItemDistribution, stream: str, seed: Tensor, episode: Tensor, arrived: Tensor, items: Item
) -> tuple[Item, Tensor]:
    """Return the bins after new items arrived, ``[N, M]``, and how many have arrived in all, int64 ``[N]``.

    Items arrive in the order of the stream, each at a uniformly random place where it overlaps no other. One that has
    no room waits, and those after it wait, too. With ``cell.refill="batch"`` only empty bins are filled.

    Args:
        cell: has the refill rule.
        source: the item distribution.
        stream, seed, episode: as of :meth:`~pickplace.task.items.ItemDistribution.sample`.
        arrived: int64 ``[N]``, number of items that have arrived so far.
        items: ``[N, M]``, the first ones filled.
    """
    table, arrived = items.table, arrived.clone()
    count = (items.h > 0).sum(1)
    open_ = count == 0 if cell.refill == "batch" else torch.ones_like(count, dtype=torch.bool)
    for _ in range(table.shape[1]):
        row = (open_ & (count < table.shape[1])).nonzero()[:, 0]
        if len(row) == 0:
            break
        address = seed[row], episode[row], arrived[row]
        item = source.sample(stream, *address, cell.bin_size)
        uniform = hashed_uniform(stream, *address, 4)[3]
        item = _find_room(cell, item, Item.from_table(table[row]), None if source.has_corners else uniform)
        table[row, count[row]] = item.table
        found = item.h > 0
        arrived[row] += found
        count[row] += found
        open_[row] = found
    return Item.from_table(table), arrived


def _find_room(cell: CellSpec, item: Item, others: Item, uniform: Tensor | None) -> Item:
    """Return an item at a place where it overlaps no other, ``[N]``; of size 0 if there is none.

    Args:
        item: ``[N]``.
        others: ``[N, M]``.
        uniform: float64 ``[N]``, decides among the places; None: only its own place counts.
    """
    (bin_w, bin_d), count = cell.bin_size[:2], len(item.x)
    x, y = (torch.arange(side, device=item.x.device) for side in (bin_w, bin_d))
    w, d = item.w[:, None], item.d[:, None]
    hits = []
    for other in zip(*(part.t()[..., None] for part in others[:4]), strict=True):  # [N, 1] each
        in_x = (x < other[0] + other[2]) & (x + w > other[0])  # [N, W_B]
        in_y = (y < other[1] + other[3]) & (y + d > other[1])
        hits.append(in_x[:, :, None] & in_y[:, None])
    inside = (x <= bin_w - w)[:, :, None] & (y <= bin_d - d)[:, None]
    free = (inside & ~reduce(torch.logical_or, hits)).flatten(1)  # [N, W_B * D_B]
    if uniform is None:
        place = item.x * bin_d + item.y
    else:
        rank = free.cumsum(1)
        wanted = (uniform * rank[:, -1]).long() + 1
        place = torch.searchsorted(rank, wanted[:, None])[:, 0].clamp(max=bin_w * bin_d - 1)
    found = free[torch.arange(count, device=place.device), place] & ~item.is_empty
    parts = place // bin_d, place % bin_d, item.w, item.d, item.h
    return Item(*(torch.where(found, part, 0) for part in parts))
