"""Arrival: how bins are filled again from the stream of items."""

from functools import reduce

import torch
from torch import Tensor

from pickplace.items.distributions import ItemDistribution, hashed_uniform
from pickplace.rules.cell import CellSpec
from pickplace.rules.state import Item


def refill(
    cell: CellSpec, source: ItemDistribution, stream: str, seed: Tensor, episode: Tensor, arrived: Tensor, items: Item
) -> tuple[Item, Tensor]:
    """Return the bins after new items arrived, ``[N, M]``, and how many have arrived in all, int64 ``[N]``.

    Items arrive in the order of the stream, each at a uniformly random place where it overlaps no other. One that has
    no room waits, and those after it wait, too. With ``cell.refill="batch"`` only empty bins are filled.

    Args:
        cell: has the refill rule.
        source: the item distribution.
        stream, seed, episode: as of :meth:`~pickplace.items.distributions.ItemDistribution.sample`.
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
