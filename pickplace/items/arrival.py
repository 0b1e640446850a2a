"""Arrival: how bins are filled again from the stream of items."""

from functools import reduce

import torch
from torch import Tensor

from pickplace.items.distributions import ItemDistribution, hashed_uniform
from pickplace.items.tipping import in_pose
from pickplace.rules.bin import add_item, must_share
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Item
from pickplace.rules.state import FULL_TASK, REFILLS, Episode


def refill(
    cell: CellSpec, source: ItemDistribution, stream: str, seed: Tensor, episode: Tensor, arrived: Tensor, items: Item,
    rows: Tensor, differs: Episode = FULL_TASK,
) -> tuple[Item, Tensor]:  # fmt: skip
    """Return the bins after new items arrived, ``[N, M]``, and how many have arrived in all, int64 ``[N]``.

    Items arrive in the order of the stream. Into an empty bin an item comes at its own place; else at a uniformly
    random place where it overlaps no other. One that has no room waits, and those after it wait, too. With
    ``refill="batch"`` only empty bins are filled. With ``cell.tipping`` an item comes in all its poses, or waits, each
    at the first place that is free.

    Args:
        cell: has the refill rule, unless episodes differ in it.
        source: the item distribution.
        stream, seed, episode: as of :meth:`~pickplace.items.distributions.ItemDistribution.sample`.
        arrived: int64 ``[N]``, number of items that have arrived so far.
        items: ``[N, M]``, the first ones filled.
        rows: bool ``[N]``, the bins in which items may arrive.
        differs: what the episodes differ in.
    """
    waits = cell.refill == "batch" if differs.refill is None else differs.refill == REFILLS.index("batch")
    open_ = rows & ~(items.exists[:, 0] & waits)  # waits: for an empty bin
    for number in range(0, items.x.shape[1], cell.poses):
        open_ = open_ & ~items.exists[:, -1]
        if differs.bin_items is not None:
            open_ = open_ & (items.exists.sum(1) < differs.bin_items)
        if number and not open_.any():
            break
        item, before = next_item(cell, source, stream, seed, episode, arrived, differs), items
        for pose in range(cell.poses):
            posed = in_pose(cell, source, item, pose)
            if must_share(items, open_):
                # The place among the free ones: any, or with poses the first.
                share = hashed_uniform(stream, seed, episode, arrived, 4)[3] * (not cell.tipping)
                keeps_place = ~items.exists[:, 0] | (source.has_corners and not cell.tipping)
                posed = _find_room(cell, posed, items, keeps_place, share)
            open_ = open_ & posed.exists
            items = add_item(items, posed, open_)
        if cell.tipping:  # where the last pose had no room, the item waits
            items = Item.from_table(torch.where(open_[:, None, None], items.table, before.table))
        arrived = arrived + open_
    return items, arrived


def next_item(
    cell: CellSpec, source: ItemDistribution, stream: str, seed: Tensor, episode: Tensor, arrived: Tensor,
    differs: Episode,
) -> Item:  # fmt: skip
    """Return the item that arrives next in each episode, ``[N]``, at its own place; arguments as of :func:`refill`."""
    item = source.sample(stream, seed, episode, arrived, cell.bin_size, **source.of_mix(differs.item_mix))
    return item if differs.turns is None else item._replace(turns=item.turns & differs.turns)


def _find_room(cell: CellSpec, item: Item, others: Item, keeps_place: Tensor, uniform: Tensor) -> Item:
    """Return an item at a place where it overlaps no other, ``[N]``; of size 0 if there is none.

    Args:
        item: ``[N]``.
        others: ``[N, M]``.
        keeps_place: bool ``[N]``, whether only its own place counts.
        uniform: float64 ``[N]``, decides among the places.
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
    rank = free.cumsum(1)
    wanted = (uniform * rank[:, -1]).long() + 1
    drawn = torch.searchsorted(rank, wanted[:, None])[:, 0].clamp(max=bin_w * bin_d - 1)
    place = torch.where(keeps_place, item.x * bin_d + item.y, drawn)
    found = free[torch.arange(count, device=place.device), place] & item.exists
    return item._replace(x=place // bin_d, y=place % bin_d).map(lambda part: torch.where(found, part, 0))
