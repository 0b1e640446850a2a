"""Planners that set items down at the origins of maximal empty spaces, as the packing heuristics of the literature do.

A *maximal empty space* is a space above the items, open to the top, that cannot grow: a rectangle of cells no higher
than its floor, one of which is as high, with something higher, or a wall, along each side. Its origin is its cell with
the least x and y.
"""

from abc import abstractmethod
from collections.abc import Iterator

import torch
from torch import Tensor

from pickplace.common.validate import check_bytes, flag, one_of
from pickplace.planners.base import ITEM_RULES, MapPlanner, first_choice, restrict_items
from pickplace.planners.heuristics import dbl_order
from pickplace.rules.cell import MAX_SIDE, CellSpec
from pickplace.rules.item import Observation
from pickplace.rules.maps import FAR
from pickplace.rules.masks import PlacingMaps, action_mask, choice_mask, first_action_reaching
from pickplace.rules.state import State

LAST = FAR**2  # order of a footprint at the origin of no space
MAX_RECTANGLES = 2**23  # that are looked at together, over all problems


def all_rectangles(wide: int, deep: int, device) -> list[Tensor]:
    """Return all rectangles of a grid: ``x0``, ``y0``, ``x1`` and ``y1``, int64 ``[S]`` each.

    They reach from ``x0`` to before ``x1``, and the same along y.

    Raises:
        ValueError: if the memory does not hold them.
    """
    count = wide * (wide + 1) // 2 * (deep * (deep + 1) // 2)
    check_bytes(f"tote_size: {count:,} rectangles of cells", 100 * count, device)
    along_x, along_y = (torch.combinations(torch.arange(side + 1, device=device)) for side in (wide, deep))
    x, y = along_x.repeat_interleave(len(along_y), 0), along_y.repeat(len(along_x), 1)
    return [x[:, 0], y[:, 0], x[:, 1], y[:, 1]]


def empty_spaces(heights: Tensor, rectangles: list[Tensor], level_step: int = 0) -> Iterator[tuple[int, Tensor]]:
    """Yield each height in the totes, and which rectangles are maximal empty spaces with their floor there.

    Args:
        heights: int32 ``[N, W_T, D_T]``.
        rectangles: see :func:`all_rectangles`.
        level_step: by how much the heights of a level surface may differ.

    Yields:
        the height, and bool ``[S, N]``, batch last
    """
    x0, y0, x1, y1 = rectangles
    area = ((x1 - x0) * (y1 - y0))[:, None]
    one_further = [(x0 - 1, y0, x1, y1), (x0, y0 - 1, x1, y1), (x0, y0, x1 + 1, y1), (x0, y0, x1, y1 + 1)]
    for level in heights.unique().tolist():
        higher = _counter(heights > level + level_step)
        lower = _counter(heights < level, outside=0)
        space = (higher(*rectangles) == 0) & (lower(*rectangles) < area)
        for grown in one_further:
            space &= higher(*grown) > 0
        yield level, space


def _counter(cells: Tensor, outside: int = 1):
    """Return a function that counts marked cells ``[N, W, D]`` in rectangles, ``[S, N]``; ``outside`` beyond walls."""
    padded = torch.nn.functional.pad(cells.int(), (1, 1, 1, 1), value=outside)
    table = torch.nn.functional.pad(padded.cumsum(1, dtype=torch.int32).cumsum(2, dtype=torch.int32), (1, 0, 1, 0))
    deep, table = table.shape[2], table.flatten(1).t().contiguous()

    def at(x: Tensor, y: Tensor) -> Tensor:
        return table.index_select(0, (x + 1) * deep + y + 1)

    return lambda x0, y0, x1, y1: at(x1, y1) - at(x0, y1) - at(x1, y0) + at(x0, y0)


class SpacePlanner(MapPlanner):
    """Sets the item down at the origin of the empty space that comes first in an order of the planner's own.

    Minimises (:meth:`space_order`, footprint y, footprint x) over all feasible footprints that begin in the origin of a
    maximal empty space. Ties go to the item's narrower side along x, then to the lowest flat index.

    Args:
        cell: the sizes.
        item: which of several items in the bin are considered, see
            :func:`~pickplace.planners.base.restrict_items`.
        dbl_fallback: where no item fits at the origin of a space: whether deepest-bottom-left decides over all feasible
            footprints. Else an action is played that fails, and ends the episode, as in the literature.

    Raises:
        ValueError: for settings of other types.
    """

    holds_item = True  # whether a space must hold the item; else it may begin there and stick out

    def __init__(self, cell: CellSpec, item: str = "any", dbl_fallback: bool = True):
        self.cell, self.item = cell, one_of("planner.item", item, ITEM_RULES)
        self.dbl_fallback = flag("planner.dbl_fallback", dbl_fallback)

    @abstractmethod
    def space_order(self, floor: int, left_x: Tensor, left_y: Tensor) -> Tensor | int:
        """Return a number >= 0 by which the planner orders spaces, least first, int64 of the shape of ``left_x``.

        Args:
            floor: height of the spaces' floor.
            left_x, left_y: cells along x and y that the item leaves free in each space.
        """

    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        feasible = restrict_items(cell, self.item, state, choice_mask(cell, maps))
        last = LAST * cell.num_places
        at_origin, elsewhere = (
            torch.where(feasible, maps.join(dbl_order(cell, order)), last)
            for order in (self._least_order(cell, state, maps), maps.top)
        )
        has_origin = (at_origin < last).any(1, keepdim=True)
        choice = first_choice(cell, maps, torch.where(has_origin, at_origin, elsewhere))
        action = first_action_reaching(cell, maps, choice)
        if self.dbl_fallback or has_origin.all():
            return action
        return torch.where(has_origin[:, 0], action, action_mask(cell, maps).int().argmin(1))

    def _least_order(self, cell: CellSpec, state: State, maps: PlacingMaps) -> Tensor:
        """Return the least order of a space at whose origin a footprint lies, int64 ``[N * M, Q, W_T, D_T]``."""
        surface, tote_height, item = state.each_item()
        heights = surface >> 1
        x0, y0, x1, y1 = rectangles = all_rectangles(*cell.tote_size[:2], heights.device)
        wide, deep, origin = (sides[:, None] for sides in (x1 - x0, y1 - y0, x0 * cell.tote_size[1] + y0))
        order = torch.full((cell.parities, cell.num_places, len(heights)), LAST, device=origin.device)
        for rows in torch.arange(len(heights), device=origin.device).split(max(1, MAX_RECTANGLES // len(origin))):
            w_and_d, height = (item.w[rows], item.d[rows]), item.h[rows]
            for floor, space in empty_spaces(heights[rows], rectangles, maps.level_step):
                for parity in range(cell.parities):
                    w, d = w_and_d[:: 1 - 2 * parity]
                    left_x, left_y = wide - w, deep - d
                    fits = (left_x >= 0) & (left_y >= 0) & (floor + height <= tote_height[rows])
                    usable = space & fits if self.holds_item else space
                    found = torch.where(usable, self.space_order(floor, left_x, left_y), LAST)
                    at = origin.expand_as(found)
                    order[parity, :, rows] = order[parity][:, rows].scatter_reduce(0, at, found, "amin")
        return order.permute(2, 0, 1).unflatten(2, cell.tote_size[:2])


class BestFit(SpacePlanner):
    """Fills the lowest maximal empty space that the item fits best: with the least rest along x or y, whichever is
    less."""

    name = "best_fit"

    def space_order(self, floor: int, left_x: Tensor, left_y: Tensor) -> Tensor:
        return floor * MAX_SIDE + torch.minimum(left_x, left_y)


class OnlineBPH(SpacePlanner):
    """Tries the maximal empty spaces from the deepest-bottom-left one: the heuristic of Ha et al., 2017, "An online
    packing heuristic for the three-dimensional container loading problem in dynamic environments and the Physical
    Internet"."""

    name, holds_item = "online_bph", False

    def space_order(self, floor: int, left_x: Tensor, left_y: Tensor) -> int:
        return floor
