"""A bin with several items: the item that a pick takes, the picks that others block, and the room for new items.

Each pick takes one item: the highest that the cup grips. The end effector may hang over lower items. An item that is as
high or higher blocks the pick, as it would be lifted or hit. An item that lies alone is never blocked: with ``M = 1``
the functions take a shorter path to the same result.
"""

from functools import reduce

import torch
from torch import Tensor

from pickplace.common.capture import any_of
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import split_action
from pickplace.rules.item import Item
from pickplace.rules.state import REFILLS, EpisodeSettings, State


def blocked_picks(cell: CellSpec, items: Item) -> Tensor | None:
    """Return a mask of the pick cells at which the end effector would touch another item that is as high or higher.

    Args:
        items: ``[N, M]``.

    Returns:
        bool ``[N * M, P]``, for each item as the one to take; the items of a bin follow one another. None with
        ``M = 1``: no pick is blocked.
    """
    if (count := items.x.shape[1]) == 1:
        return None
    near = [torch.arange(side, device=items.x.device).view(-1, 1, 1) for side in cell.bin_size[:2]]
    shape = cell.effector(0)
    left, front = near[0] - shape.ref_x, near[1] - shape.ref_y  # [W_B, 1, 1], [D_B, 1, 1]
    touches = torch.zeros(*cell.bin_size[:2], *items.x.shape, dtype=torch.bool, device=items.x.device)
    for box in shape.body:
        in_x = (left + box.x < items.x + items.w) & (left + box.x + box.width > items.x)  # [W_B, N, M]
        in_y = (front + box.y < items.y + items.d) & (front + box.y + box.depth > items.y)
        touches |= in_x[:, None] & in_y
    touches &= items.exists
    blocked = torch.zeros_like(touches)
    for other in range(count):
        in_the_way = items.h[:, other, None] >= items.h  # [N, M]
        in_the_way[:, other].fill_(False)
        blocked |= touches[..., other, None] & in_the_way
    return blocked.flatten(2).flatten(0, 1).t()


def take_item(cell: CellSpec, items: Item, action: Tensor) -> tuple[Tensor, Item, Tensor | None]:
    """Return the items that flat actions, int64 ``[N]``, take out of bins ``[N, M]``.

    Returns:
        the number of the item in its bin, int64 ``[N]``; the item, ``[N]``; and its blocked picks, bool ``[N, P]``,
        see :func:`blocked_picks`.
    """
    blocked = blocked_picks(cell, items)
    if blocked is None:
        return torch.zeros_like(action), items.flatten(), None
    number = taken_item(cell, items, *split_action(cell, action)[:2])
    row = torch.arange(len(number), device=number.device)
    return number, select_item(items, number), blocked.unflatten(0, items.x.shape)[row, number]


def taken_item(cell: CellSpec, items: Item, x: Tensor, y: Tensor) -> Tensor:
    """Return the number of the item that picks at cells ``(x, y)`` take, int64 ``[N]``: the highest that is gripped.

    Ties go to the first item. The number is 0 if no item is gripped; such picks fail.

    Args:
        items: ``[N, M]``.
        x, y: int64 ``[N]``.
    """
    if items.x.shape[1] == 1:
        return torch.zeros_like(x)
    shape = cell.effector(0)
    near_x, near_y = items.x - (x - shape.ref_x)[:, None], items.y - (y - shape.ref_y)[:, None]
    gripped = cell.gripper.is_gripped(near_x, near_y, items.w, items.d, cell.item_inset) & items.exists
    return torch.where(gripped, items.h, 0).argmax(1)


def select_item(items: Item, number: Tensor) -> Item:
    """Return one item of each bin, ``[N]``; ``number`` is int64 ``[N]``."""
    if items.x.shape[1] == 1:
        return items.flatten()
    count = number.shape[0]  # not len(), which torch.export would turn into a constant
    return items.rows((torch.arange(count, device=number.device), number))


def remove_item(cell: CellSpec, items: Item, number: Tensor, removed: Tensor | None = None) -> Item:
    """Return the bins ``[N, M]`` without an item; later items move up, so that the first is the oldest.

    Args:
        cell: with ``tipping``, all poses of the item leave.
        items: ``[N, M]``.
        number: int64 ``[N]``, the item's number in its bin.
        removed: bool ``[N]``, whether the item is removed; None: it is.
    """
    table = items.table
    if table.shape[1] == 1:
        return Item.from_table(
            torch.zeros_like(table) if removed is None else table.masked_fill(removed[:, None, None], 0)
        )
    place = torch.arange(table.shape[1], device=table.device)
    later = place >= (number - number % cell.poses)[:, None]
    after = place + cell.poses * (later if removed is None else later & removed[:, None])  # [N, M]
    longer = torch.cat([table, torch.zeros_like(table[:, : cell.poses])], 1)
    return Item.from_table(longer.gather(1, after[..., None].expand_as(table)))


def has_occupied_bins(items: Item, rows: Tensor) -> bool:
    """Return whether any of the bins in ``rows``, bool ``[N]``, already holds an item, or may. All must have room."""
    return items.x.shape[1] > 1 and any_of(rows & items.exists[:, 0])


def add_item(items: Item, item: Item, rows: Tensor) -> Item:
    """Return the bins ``[N, M]`` after an item is added behind the others.

    Args:
        items: ``[N, M]``.
        item: ``[N]``.
        rows: bool ``[N]``, the bins to which an item is added; they must have room.
    """
    added, count = rows[:, None], items.x.shape[1]
    if count > 1:
        added = added & (torch.arange(count, device=rows.device) == items.exists.sum(1, keepdim=True))
    return Item.from_table(torch.where(added[..., None], item.table[:, None], items.table))


def find_room(cell: CellSpec, item: Item, others: Item, keeps_place: Tensor, uniform: Tensor) -> Item:
    """Return items at places where they overlap no other, ``[N]``; of size 0 where there is no such place.

    Args:
        item: ``[N]``.
        others: ``[N, M]``.
        keeps_place: bool ``[N]``, whether an item may lie only at its own place.
        uniform: float64 ``[N]``, in [0, 1), selects one of the free places.
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


def may_arrive(cell: CellSpec, items: Item, settings: EpisodeSettings) -> Tensor:
    """Return whether items may arrive in the bins ``[N, M]`` now, bool ``[N]``; a batch only in empty bins.

    Args:
        cell: has the refill rule, unless episodes differ in it.
        items: ``[N, M]``.
        settings: those in which the episodes differ.
    """
    waits = cell.refill == "batch" if settings.refill is None else settings.refill == REFILLS.index("batch")
    return ~(items.exists[:, 0] & waits)


def is_below_limit(items: Item, settings: EpisodeSettings) -> Tensor:
    """Return whether the bins ``[N, M]`` hold fewer items than they may, bool ``[N]``."""
    below = ~items.exists[:, -1]
    return below if settings.bin_items is None else below & (items.exists.sum(1) < settings.bin_items)


def admit_coming_items(cell: CellSpec, state: State) -> tuple[State, Tensor]:
    """Add the items of the preview to the bins, as far as these have room.

    Returns:
        The new state, and a mask of the bins in which an item outside the preview arrives next, bool ``[N]``.

    In an empty bin an item lies at its own place, as in the environment. In any other bin it lies at the first free
    place; the environment draws one at random.
    """
    items, settings, coming = state.items, state.episode, state.coming
    awaits = may_arrive(cell, items, settings)  # asked once: the items of a batch arrive together
    if coming is None:
        return state, awaits & is_below_limit(items, settings)
    open_, first = awaits, torch.zeros_like(state.tote_height)
    for _ in range(items.x.shape[1]):
        open_ = open_ & is_below_limit(items, settings)
        item = select_item(coming, first)
        if has_occupied_bins(items, open_):
            item = find_room(cell, item, items, ~items.exists[:, 0], first.double())
        open_ = open_ & item.exists
        if not any_of(open_):
            break
        items, coming = add_item(items, item, open_), remove_item(cell, coming, first, open_)
    awaits = awaits & is_below_limit(items, settings) & ~coming.exists[:, 0]
    return state._replace(items=items, coming=coming), awaits
