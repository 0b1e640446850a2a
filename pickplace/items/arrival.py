"""Arrival: the refill of bins from the stream of items."""

import torch
from torch import Tensor

from pickplace.common.capture import any_of
from pickplace.items.distributions import ItemDistribution, hashed_uniform
from pickplace.items.tipping import tipped_items
from pickplace.rules.bin import add_item, find_room, has_occupied_bins, is_below_limit
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Item
from pickplace.rules.state import FULL_TASK, EpisodeSettings


def refill(
    cell: CellSpec, source: ItemDistribution, stream: str, seed: Tensor, episode: Tensor, arrived: Tensor, items: Item,
    rows: Tensor, settings: EpisodeSettings = FULL_TASK,
) -> tuple[Item, Tensor]:  # fmt: skip
    """Return the bins after new items arrived, ``[N, M]``, and the number that has arrived in all, int64 ``[N]``.

    Items arrive in the order of the stream. In an empty bin an item lies at its own place; else at a uniformly random
    place where it overlaps no other. An item without room waits, and so do those after it. With ``cell.tipping`` an
    item arrives in all its poses, each at the first free place, or waits.

    Args:
        cell: the sizes and options.
        source: the item distribution.
        stream, seed, episode: see :meth:`~pickplace.items.distributions.ItemDistribution.sample`.
        arrived: int64 ``[N]``, number of items that have arrived so far.
        items: ``[N, M]``, the first ones filled.
        rows: bool ``[N]``, the bins in which items may arrive, see :func:`~pickplace.rules.bin.may_arrive`.
        settings: those in which the episodes differ.
    """
    open_ = rows
    for number in range(0, items.x.shape[1], cell.poses):
        open_ = open_ & is_below_limit(items, settings)
        if number and not any_of(open_):
            break
        item, before = next_item(cell, source, stream, seed, episode, arrived, settings), items
        for pose in range(cell.poses):
            posed = tipped_items(cell, source, item, pose)
            if has_occupied_bins(items, open_):
                # It selects one of the free places at random, or with poses the first.
                share = hashed_uniform(stream, seed, episode, arrived, 4)[3] * (not cell.tipping)
                keeps_place = ~items.exists[:, 0] | (source.has_corners and not cell.tipping)
                posed = find_room(cell, posed, items, keeps_place, share)
            open_ = open_ & posed.exists
            items = add_item(items, posed, open_)
        if cell.tipping:  # where the last pose had no room, the item waits
            items = Item.from_table(torch.where(open_[:, None, None], items.table, before.table))
        arrived = arrived + open_
    return items, arrived


def next_item(
    cell: CellSpec, source: ItemDistribution, stream: str, seed: Tensor, episode: Tensor, arrived: Tensor,
    settings: EpisodeSettings,
) -> Item:  # fmt: skip
    """Return the item that arrives next in each episode, ``[N]``, at its own place; arguments: see :func:`refill`."""
    item = source.sample(stream, seed, episode, arrived, cell.bin_size, **source.mix_arguments(settings.item_mix))
    return item if settings.turns is None else item._replace(turns=item.turns & settings.turns)


def coming_items(
    cell: CellSpec, source: ItemDistribution, stream: str, seed: Tensor, episode: Tensor, arrived: Tensor,
    settings: EpisodeSettings = FULL_TASK,
) -> Item:  # fmt: skip
    """Return the items of the preview, in their order, ``[N, p]``; arguments: see :func:`refill`.

    Each is at its own place. Rows are zeros after the stream's end, and beyond an episode's own preview.
    """
    count, number = len(arrived), torch.arange(cell.preview, device=arrived.device)
    row = torch.arange(count, device=arrived.device).repeat_interleave(cell.preview)
    later = (arrived[:, None] + number).flatten()
    item = next_item(cell, source, stream, seed[row], episode[row], later, settings.rows(row))
    seen = item.exists if settings.preview is None else item.exists & (number.repeat(count) < settings.preview[row])
    return Item.from_table((item.table * seen[:, None]).unflatten(0, (count, cell.preview)))
