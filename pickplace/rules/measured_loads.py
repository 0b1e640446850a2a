"""Loads on measured items: which of them carry a new item, and whether they bear it."""

from typing import NamedTuple

import torch
from torch import Tensor

ROUNDING = 1e-6  # cells: intervals that only touch do not overlap
UNKNOWN_MASS = 2**40  # grams: above any limit; the sum over a tote stays below ANY_LOAD
ANY_LOAD = 2**60


class MeasuredLoads(NamedTuple):
    """The ``B`` items in a tote, and the load that each still bears. Heights are in height units."""

    bounds: Tensor  # float64 [B, 4]: least and greatest x, least and greatest y that the item may cover; cells
    tops: Tensor  # int64 [B]: height of the item's top
    capacity: Tensor  # int64 [B]: greatest mass on top that overloads neither it nor an item below; grams
    unknown: Tensor  # int64 [k W_T, k D_T]: greatest height of each patch that no item explains; else -1
    step: int  # greatest difference of two measurements of the same height

    @classmethod
    def of(
        cls, bounds: Tensor, tops: Tensor, grams: Tensor, max_load: Tensor, highest: Tensor, per_cell: int, step: int
    ) -> "MeasuredLoads":
        """Return the loads of items that lie on one another: the full mass of an item counts on each one below it.

        Args:
            bounds, tops, step: see the fields. What is at most ``step`` high is the floor.
            grams, max_load: int64 ``[B]``, see :class:`~pickplace.rules.item.Item`.
            highest: int32 ``[k W_T, k D_T]``, greatest height of each patch.
            per_cell: ``k``, patches along the side of a cell.
        """
        spans = [_span(torch.arange(size, device=highest.device) / per_cell, 1 / per_cell) for size in highest.shape]
        explained = highest <= step
        for bound, top in zip(bounds, tops, strict=True):  # one by one: a fine map of many items would be large
            inside = _meet(spans[0], bound[None, :2]) & _meet(spans[1], bound[None, 2:]).t()
            explained |= inside & ((highest - top).abs() <= step)
        unknown = torch.where(explained, -1, highest.long())
        if not len(tops):
            return cls(bounds, tops, max_load, unknown, step)
        below = _meet(bounds[:, :2], bounds[:, :2]) & _meet(bounds[:, 2:], bounds[:, 2:])
        # Any lower item may carry it: its underside is unknown.
        below &= tops[:, None] > tops  # [B, B]: the second may lie below the first
        for middle in tops.argsort().tolist():  # what lies on an item also lies on all items below it
            below |= below[:, middle, None] & below[middle]
        spare = max_load - torch.where(below, grams[:, None], 0).sum(0)
        held = torch.where(below | torch.eye(len(tops), dtype=torch.bool, device=tops.device), spare, ANY_LOAD)
        return cls(bounds, tops, held.amin(1).clamp(min=0), unknown, step)

    def can_bear(self, grams: int, footprint: tuple[int, int], z: Tensor) -> Tensor:
        """Return whether the items below bear a new item on each footprint, bool in the shape of ``z``.

        A surface that is neither the floor nor a known item bears nothing.

        Args:
            grams: the new item's mass.
            footprint: its sides in whole cells, which it does not leave, whatever its error.
            z: height on which it lies on each footprint inside the tote, ``[X, Y]``.
        """
        x, y = (
            _span(torch.arange(count, device=z.device), side) for count, side in zip(z.shape, footprint, strict=True)
        )
        in_x, in_y = _meet(x, self.bounds[:, :2]), _meet(y, self.bounds[:, 2:])  # [X, B], [Y, B]
        # A recorded top may differ from the measured one, and this from the height on which the item lies.
        carries = in_x[:, None] & in_y & ((z[..., None] - self.tops).abs() <= 2 * self.step)
        enough = (torch.where(carries, self.capacity, ANY_LOAD) >= grams).all(2)
        count = self.unknown.shape[0] // (len(z) + footprint[0] - 1)  # patches along a cell
        (wide, deep), patches = footprint, self.unknown
        highest = patches.unfold(0, wide * count, count).unfold(1, deep * count, count).amax((2, 3))
        return enough & ((highest < 0) | (highest < z - self.step))


def _span(begin: Tensor, length: float) -> Tensor:
    """Return intervals of one length, float64 ``[K, 2]``, from where they begin, ``[K]``."""
    return torch.stack([begin, begin + length], 1).double()


def _meet(one: Tensor, other: Tensor) -> Tensor:
    """Return whether each of some intervals ``[K, 2]`` overlaps each of others ``[L, 2]``, bool ``[K, L]``."""
    return (one[:, None, 0] < other[:, 1] - ROUNDING) & (one[:, None, 1] > other[:, 0] + ROUNDING)
