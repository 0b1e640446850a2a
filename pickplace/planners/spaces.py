"""Planners that set items down at the origins of maximal empty spaces, as the packing heuristics of the literature do.

The origin of a space is its cell with the least x and y.
"""

from abc import abstractmethod

import torch
from torch import Tensor

from pickplace.common.validate import flag, one_of
from pickplace.planners.base import ITEM_RULES, MapPlanner, first_choice, restrict_items
from pickplace.planners.empty_spaces import empty_spaces
from pickplace.planners.heuristics import dbl_order
from pickplace.rules.cell import MAX_SIDE, CellSpec
from pickplace.rules.grasps import footprint_index
from pickplace.rules.item import Observation
from pickplace.rules.maps import FAR
from pickplace.rules.masks import PlacingMaps, action_mask, choice_mask, first_action_reaching
from pickplace.rules.state import State

LAST = FAR**2  # order of a footprint that is not at the origin of a space


class SpacePlanner(MapPlanner):
    """Sets the item down at the origin of the empty space that is first in the planner's order.

    Minimises (:meth:`space_order`, footprint y, footprint x) over all feasible footprints that begin in the origin of a
    maximal empty space. Ties go to the item's narrower side along x, then to the lowest flat index.

    Args:
        cell: the sizes.
        item: rule that selects the items to consider, see :func:`~pickplace.planners.base.restrict_items`.
        dbl_fallback: whether deepest-bottom-left decides over all feasible footprints if no item fits at the origin of
            a space. Else an action is played that fails, and ends the episode, as in the literature.

    Raises:
        ValueError: for settings of other types.
    """

    holds_item = True  # whether a space must hold the item; else it may begin there and stick out

    def __init__(self, cell: CellSpec, item: str = "any", dbl_fallback: bool = True):
        self.cell, self.item = cell, one_of("planner.item", item, ITEM_RULES)
        self.dbl_fallback = flag("planner.dbl_fallback", dbl_fallback)

    @abstractmethod
    def space_order(self, floor: Tensor, left_x: Tensor, left_y: Tensor) -> Tensor:
        """Return a number >= 0 by which the planner orders spaces, least first, int64 that broadcasts to ``[S, M]``.

        Args:
            floor: height of each space's floor, ``[S, 1]``.
            left_x, left_y: cells along x and y that each item leaves free in each space, ``[S, M]``.
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
        """Return for each footprint the least order of a space at whose origin it lies, else :data:`LAST`, int64
        ``[N * M, Q, W_T, D_T]``."""
        spaces, item, bins = empty_spaces(state.heights, maps.level_step), state.items.flatten(), maps.bin_items
        order = torch.full((len(item.w), cell.footprint_turns, *cell.tote_size[:2]), LAST, device=item.w.device)
        row, floor, x0, y0, x1, y1 = (part[:, None] for part in spaces)
        number = row * bins + torch.arange(bins, device=row.device)  # of each item in the bin, [S, M]
        low_enough = floor + item.h[number] <= state.tote_height[row]
        for quarter_turned in range(cell.footprint_turns):
            w, d = (side[number] for side in (item.w, item.d)[:: 1 - 2 * quarter_turned])
            left_x, left_y = x1 - x0 - w, y1 - y0 - d
            fits = (left_x >= 0) & (left_y >= 0) & low_enough
            usable = fits if self.holds_item else torch.ones_like(fits)
            found = torch.where(usable, self.space_order(floor, left_x, left_y), LAST)
            at = footprint_index(cell.tote_size, number * cell.footprint_turns + quarter_turned, x0, y0)
            order.view(-1).scatter_reduce_(0, at.flatten(), found.flatten(), "amin")
        return order


class BestFit(SpacePlanner):
    """Fills the lowest maximal empty spaces first; of these the one with the fewest cells left along x or y, whichever
    is less."""

    name = "best_fit"

    def space_order(self, floor: Tensor, left_x: Tensor, left_y: Tensor) -> Tensor:
        return floor * MAX_SIDE + torch.minimum(left_x, left_y)


class OnlineBPH(SpacePlanner):
    """Tries the maximal empty spaces from the deepest-bottom-left one: the heuristic of Ha et al., 2017, "An online
    packing heuristic for the three-dimensional container loading problem in dynamic environments and the Physical
    Internet"."""

    name, holds_item = "online_bph", False

    def space_order(self, floor: Tensor, left_x: Tensor, left_y: Tensor) -> Tensor:
        return floor
