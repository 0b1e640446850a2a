"""Piles: which items of a tote lie on which, and what each of them may still bear.

An item rests on the items that it touches from above: the top items of the cells under it that are as high as its
underside. The *pile below* it are these items and all that they rest on, down to the floor. The full mass of an item
counts on each item of the pile below it: how they share it is unknown, and none may be overloaded.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.common.capture import is_capturing
from pickplace.rules.item import NO_LIMIT, Item

MANY_ITEMS = 128  # in a tote, beyond which it is faster to look at those only that are seen from above


class Pile(NamedTuple):
    """The items in totes, numbered from 1 in the order in which they were put down; there is room for ``L`` of them."""

    labels: Tensor  # int64 [N, W_T, D_T]: number of the item on top of each cell; 0: the floor
    spare: Tensor  # int64 [N, L]: mass that each item may still bear, grams; 0 where there is no item
    below: Tensor  # bool [N, L, L]: [n, i, j]: item j is in the pile below item i, or is item i

    @classmethod
    def empty(cls, batch: int, grid: Sequence[int], room: int, device=None) -> "Pile":
        """Return the piles of empty totes with a grid ``(W_T, D_T)`` and room for ``room`` items."""
        labels = torch.zeros(batch, *grid[:2], dtype=torch.int64, device=device)
        return cls(labels, labels.new_zeros(batch, room), labels.new_zeros(batch, room, room, dtype=torch.bool))

    def rows(self, index) -> "Pile":
        """Return the piles of some problems, by their numbers, which may repeat."""
        return Pile(*(part[index] for part in self))

    @property
    def num_items(self) -> Tensor:
        """The number of items, int64 ``[N]``."""
        return self.below.diagonal(dim1=1, dim2=2).sum(1)

    @property
    def capacity(self) -> Tensor:
        """The greatest mass on each cell that overloads no item below it, grams, int64 ``[N, W_T, D_T]``.

        -1 everywhere in a tote that has no room for another item.
        """
        labels, below = self.labels.flatten(1), self.below
        if below.shape[1] > MANY_ITEMS and len(labels) and not is_capturing():  # only those that are seen from above
            seen, labels = labels.unique(return_inverse=True)
            shown = seen[seen > 0]
            below, labels = below[:, shown - 1], labels + (len(shown) == len(seen))  # 0 remains the floor
        each = torch.where(below, self.spare[:, None], NO_LIMIT).amin(2)
        floor = each.new_full((len(each), 1), NO_LIMIT)
        capacity = torch.cat([floor, each], 1).gather(1, labels).view_as(self.labels)
        return torch.where((self.num_items == self.spare.shape[1])[:, None, None], -1, capacity)

    def add(self, item: Item, index: Tensor, touched: Tensor, inside: Tensor) -> "Pile":
        """Return the piles with another item on top of each.

        Args:
            item: ``[N]``.
            index: int64 ``[S * S, N]``, flat cells of the tote, some of which the item rests on.
            touched: bool ``[S * S, N]``, whether the item rests on each of them.
            inside: bool ``[N, W_T, D_T]``, the cells that the item covers; none if no item is added.
        """
        number, added = self.num_items[:, None], inside.flatten(1).any(1)[:, None]
        own = (torch.arange(self.spare.shape[1], device=number.device) == number) & added  # [N, L]
        touching = torch.where(touched, self.labels.flatten(1).t().gather(0, index), 0).t()
        flags = torch.zeros_like(own[:, :1]).repeat(1, own.shape[1] + 1).scatter_(1, touching, True)
        beneath = (flags[:, 1:, None] & self.below).any(1)  # [N, L]
        loaded = beneath & added & (self.spare < NO_LIMIT)
        spare = torch.where(own, item.max_load[:, None], self.spare - loaded * item.grams[:, None])
        below = torch.where(own[:, :, None], (beneath | own)[:, None], self.below)
        return Pile(torch.where(inside, number[..., None] + 1, self.labels), spare, below)
