"""A bin with several items: which one a pick takes, and what stands in the way.

Each pick takes one item: the highest that the cup grips. The end effector may hang over lower ones; one that is as high
or higher would be lifted, too, or hit. Nothing is in the way of an item that lies alone: with ``M = 1`` the
functions take a shorter path to the same result.
"""

import torch
from torch import Tensor

from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import split_action
from pickplace.rules.item import Item


def blocked_picks(cell: CellSpec, items: Item) -> Tensor | None:
    """Return at which pick cells the end effector would touch another item that is as high or higher.

    Args:
        items: ``[N, M]``.

    Returns:
        bool ``[N * M, P]``, for each item, those of a bin one after the other, the picks that would take it; None with
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
        in_the_way[:, other] = False
        blocked |= touches[..., other, None] & in_the_way
    return blocked.flatten(2).flatten(0, 1).t()


def take_item(cell: CellSpec, items: Item, action: Tensor) -> tuple[Tensor, Item, Tensor | None]:
    """Return what flat actions, int64 ``[N]``, take out of bins ``[N, M]``.

    Returns:
        the number of the item in its bin, int64 ``[N]``; the item, ``[N]``; and bool ``[N, P]``, as of
        :func:`blocked_picks`.
    """
    blocked = blocked_picks(cell, items)
    if blocked is None:
        return torch.zeros_like(action), items.flatten(), None
    number = taken_item(cell, items, *split_action(cell, action)[:2])
    row = torch.arange(len(number), device=number.device)
    return number, select_item(items, number), blocked.unflatten(0, items.x.shape)[row, number]


def taken_item(cell: CellSpec, items: Item, x: Tensor, y: Tensor) -> Tensor:
    """Return the number of the item that picks at cells ``(x, y)`` take, int64 ``[N]``: the highest that is gripped.

    Of equals the first, and 0 if none is gripped; such picks fail.

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
    count = number.shape[0]  # not len(), of which torch.export would make a constant
    return items.rows((torch.arange(count, device=number.device), number))


def remove_item(cell: CellSpec, items: Item, number: Tensor, removed: Tensor | None = None) -> Item:
    """Return what is left in the bins ``[N, M]``; later items move up, so that the first is the oldest.

    Args:
        cell: with its ``tipping`` an item leaves in all its poses.
        items: ``[N, M]``.
        number: int64 ``[N]``.
        removed: bool ``[N]``, whether that item is removed at all; None: it is.
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


def must_share(items: Item, rows: Tensor) -> bool:
    """Return whether any of the bins in ``rows``, bool ``[N]``, holds an item already; all of them have room."""
    return items.x.shape[1] > 1 and bool((rows & items.exists[:, 0]).any())


def add_item(items: Item, item: Item, rows: Tensor) -> Item:
    """Return the bins ``[N, M]`` after an item is added behind the others.

    Args:
        items: ``[N, M]``.
        item: ``[N]``.
        rows: bool ``[N]``, the bins to which one is added; they have room.
    """
    added, count = rows[:, None], items.x.shape[1]
    if count > 1:
        added = added & (torch.arange(count, device=rows.device) == items.exists.sum(1, keepdim=True))
    return Item.from_table(torch.where(added[..., None], item.table[:, None], items.table))
