"""Preparation of depth maps and items for the networks: clipping, and one-hot codes."""

from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.rules.item import Item


class ScoredItems(NamedTuple):
    """The items in the bins, and the number of the item of each footprint that is scored."""

    items: Item  # [N, M]
    number: Tensor  # int64, one for each footprint that is scored

    def sizes(self, row: Tensor) -> list[Tensor]:
        """Return width, depth and height of each footprint's item; ``row`` is the bin of each."""
        at = row * self.items.x.shape[1] + self.number
        return [part.flatten()[at] for part in (self.items.w, self.items.d, self.items.h)]

    def rest_code(self, row: Tensor, item_range: int) -> Tensor:
        """Return the mean code of the other items in the bin, float32 ``[rows, 3 * item_range]``; 0 without any."""
        there = self.items.exists
        code = item_code(self.items, item_range) & there[..., None]
        rest = code.sum(1)[row] - code[row, self.number].int()
        return rest / (there.sum(1, keepdim=True) - 1).clamp(min=1)[row]


def clip_depth(depth: Tensor, limit: float | None, floor: float | None = None) -> Tensor:
    """Shift each depth map down until nothing in it is greater than ``limit`` (depth clipping, eq. 4).

    The result is ``s - max(max(s) - limit, 0)``; the inner maximum is over the whole map of one environment.
    Differences between cells stay the same, and only the greatest value is bounded. So a policy serves any tote
    height. Cells further than ``limit`` below the maximum become negative, as in eq. 4; ``floor`` (not in the
    paper) clamps them.

    Args:
        depth: ``[..., W, D]``; every leading dimension is a batch dimension.
        limit: ``H_max`` of eq. 4, or None for no clipping.
        floor: least value of the result, or None for no floor. Applied after the clipping.

    Returns:
        ``[..., W, D]``
    """
    if limit is not None:
        depth = depth - (depth.amax((-2, -1), keepdim=True) - limit).clamp_min(0)
    return depth if floor is None else depth.clamp_min(floor)


def item_code(item: Item, item_range: int, level: int = 1) -> Tensor:
    """Return the item's width, depth, and height in levels, as one-hot codes, bool ``[..., 3 * item_range]``."""
    size = torch.stack([item.w, item.d, item.h // level], -1).clamp(1, item_range)
    return (size[..., None] == torch.arange(1, item_range + 1, device=size.device)).flatten(-2)
