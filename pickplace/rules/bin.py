"""A bin with several items: which one a pick takes, and what stands in the way.

Each pick takes one item: the highest that the cup grips. The end effector may hang over lower ones; one that is as high
or higher would be lifted, too, or hit. The tables here have a row for each item, ``[N * M]``, those of a bin one after
the other (:meth:`~pickplace.rules.state.State.each_item`).
"""

import torch
from torch import Tensor

from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import is_gripped
from pickplace.rules.state import Item


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
