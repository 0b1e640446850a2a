"""Planners that need no training."""

from abc import abstractmethod
from itertools import product

import torch
from torch import Tensor

from pickplace.common.validate import number, one_of
from pickplace.items.distributions import check_seed
from pickplace.planners.base import ITEM_RULES, MapPlanner, first_choice, narrow_first, pick_first, restrict_items
from pickplace.planners.empty_spaces import empty_spaces
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import PICKS, all_grasps, join_pick
from pickplace.rules.item import Observation
from pickplace.rules.maps import FAR, rectangle_sums
from pickplace.rules.masks import (
    PlacingMaps,
    action_mask,
    choice_mask,
    first_action_reaching,
)
from pickplace.rules.placing import footprint_sizes
from pickplace.rules.state import State


def dbl_order(cell: CellSpec, top: Tensor) -> Tensor:
    """Return a number that orders footprints by (top, y, x): the deepest-bottom-left one has the least.

    Args:
        cell: the sizes.
        top: whole numbers ``[..., W_T, D_T]``.

    Returns:
        int64, of the same shape
    """
    x, y = (torch.arange(side, device=top.device) for side in cell.tote_size[:2])
    return (top.long() * len(y) + y) * len(x) + x[:, None]


class UniformRandom:
    """Draws uniformly among all ``N_a`` flat actions, feasible or not, like a policy before training without a mask.

    Args:
        cell: the sizes.
        seed: seed of the planner's own generator.
    """

    name = "uniform"

    def __init__(self, cell: CellSpec, seed: int = 0):
        self.cell, self._generator = cell, torch.Generator().manual_seed(check_seed(seed, "planner.seed"))

    def decide(self, observation: Observation) -> Tensor:
        depth = observation["bin_depth"]
        return torch.randint(self.cell.num_actions, (len(depth),), generator=self._generator).to(depth.device)


class RandomFeasible(MapPlanner):
    """Draws uniformly among the feasible flat actions.

    Args:
        cell: the sizes.
        seed: seed of the planner's own generator.
    """

    name = "random"

    def __init__(self, cell: CellSpec, seed: int = 0):
        self.cell, self.seed = cell, check_seed(seed, "planner.seed")
        self._generator: torch.Generator | None = None

    def decide(self, observation: Observation) -> Tensor:
        mask = observation.get("action_mask", None)
        return super().decide(observation) if mask is None else self._draw(mask)

    def restart(self) -> None:
        self._generator = None

    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        return self._draw(action_mask(cell, maps))

    def _draw(self, mask: Tensor) -> Tensor:
        """Return one of the actions that a mask ``[N, N_a]`` allows, int64 ``[N]``."""
        if self._generator is None:
            self._generator = torch.Generator(mask.device).manual_seed(self.seed)
        # The k-th feasible action, k uniform: exact for any N_a, unlike a float32 multinomial.
        rank = mask.cumsum(1, dtype=torch.int32)
        draw = torch.rand(len(mask), dtype=torch.float64, device=mask.device, generator=self._generator)
        wanted = (draw * rank[:, -1]).int() + 1
        return torch.searchsorted(rank, wanted[:, None])[:, 0].clamp(max=mask.shape[1] - 1)


class _Cheapest(MapPlanner):
    """Chooses the feasible footprint with the least cost.

    Ties are decided in this order: the first item, its narrower side along x, the least x, the least y, the lowest flat
    index. So it does not matter how an item lies in the bin.
    """

    def __init__(self, cell: CellSpec, item: str = "any"):
        self.cell, self.item = cell, one_of("planner.item", item, ITEM_RULES)

    @abstractmethod
    def cost(self, cell: CellSpec, state: State, maps: PlacingMaps, distance: Tensor) -> Tensor:
        """Return the cost of each footprint, ``[N, Q, W_T, D_T]``.

        Args:
            distance: from the tote's origin, ``x + y``, int64 ``[W_T, D_T]``.
        """

    def height_units(self, cell: CellSpec) -> float:
        """Return the number of the planner's height units in one of ``cell``: a robot counts in millimetres."""
        return cell.height_unit / self.cell.height_unit

    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        feasible = restrict_items(cell, self.item, state, choice_mask(cell, maps))
        x, y = (torch.arange(side, device=feasible.device) for side in cell.tote_size[:2])
        cost = self.cost(cell, state, maps, x[:, None] + y)
        order = torch.where(feasible, maps.join(cost), torch.inf)
        return first_action_reaching(cell, maps, first_choice(cell, maps, order))


class JointDBL(_Cheapest):
    """Deepest-bottom-left over all feasible (pick, place, rotation) triples; not in the paper, and strong.

    Minimises (height of the item's top, footprint y, footprint x).

    Args:
        cell: the sizes.
        item: rule that selects the items to consider, see :func:`~pickplace.planners.base.restrict_items`.
    """

    name = "joint_dbl"

    def cost(self, cell: CellSpec, state: State, maps: PlacingMaps, distance: Tensor) -> Tensor:
        return dbl_order(cell, maps.top).double()


class Corner(_Cheapest):
    """Keeps the item's top low and its footprint near the tote's origin; not in the paper.

    Minimises ``height_weight * top + x + y`` of the footprint.

    Args:
        cell: the sizes.
        height_weight: cost of one height unit, in cells of distance.
        item: rule that selects the items to consider, see :func:`~pickplace.planners.base.restrict_items`.
    """

    name = "corner"

    def __init__(self, cell: CellSpec, height_weight: float = 10, item: str = "any"):
        super().__init__(cell, item)
        self.height_weight = number("planner.height_weight", height_weight)

    def cost(self, cell: CellSpec, state: State, maps: PlacingMaps, distance: Tensor) -> Tensor:
        return self.height_weight * self.height_units(cell) * maps.top + distance


class HeightmapMinimisation(_Cheapest):
    """Raises the tote's height map least: the heuristic of Wang and Hauser, 2019, "Stable bin packing of non-convex 3D
    objects with a robot manipulator".

    Minimises ``distance_weight * (x + y)`` of the footprint plus the sum of all heights in the tote after it.

    Args:
        cell: the sizes.
        distance_weight: cost of one cell of distance from the tote's origin, in cells times height units.
        item: rule that selects the items to consider, see :func:`~pickplace.planners.base.restrict_items`.
    """

    name = "heightmap_minimisation"

    def __init__(self, cell: CellSpec, distance_weight: float = 0.01, item: str = "any"):
        super().__init__(cell, item)
        self.distance_weight = number("planner.distance_weight", distance_weight)

    def cost(self, cell: CellSpec, state: State, maps: PlacingMaps, distance: Tensor) -> Tensor:
        surface, _, item = state.each_item()
        before = rectangle_sums((surface >> 1).permute(1, 2, 0)[None], *footprint_sizes(cell, item))
        # The item's volume, and the empty space that it encloses below itself.
        added = (item.w * item.d).view(-1, 1, 1, 1) * maps.top - before.permute(3, 0, 1, 2)
        return added.double() * self.height_units(cell) + self.distance_weight * distance.double()


class IndividualHeuristic(MapPlanner):
    """Picks without a look at the tote, then places deepest-bottom-left in the corners of empty spaces.

    A candidate is a footprint in a corner of a maximal empty space, on its floor (MaxRects, Jylanki 2010). The
    candidates are tried in a forward simulation, in the order (top, footprint y, footprint x), and the first that
    succeeds is played. Ties go to the item's narrower side along x, then to the lowest flat index. If none succeeds,
    the first is played, and fails.

    Of several items in the bin it takes the first that can be picked.

    Args:
        cell: the sizes.
        candidates: ``"corners"``, or ``"cells"`` for every footprint.
        item: order of the items: ``"first"``, by arrival, or ``"nearest"``, by the distance from the bin's origin.
        pick: pick of the item: ``"least_offset"``, the paper's (:func:`~pickplace.rules.grasps.heuristic_pick`), or
            ``"middle"``, the one nearest to the middle of the item.
    """

    name = "individual_heuristic"

    def __init__(self, cell: CellSpec, candidates: str = "corners", item: str = "first", pick: str = "least_offset"):
        self.cell, self.candidates = cell, one_of("planner.candidates", candidates, ("corners", "cells"))
        self.item = one_of("planner.item", item, ("first", "nearest"))
        self.pick = one_of("planner.pick", pick, PICKS)

    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        lifted = all_grasps(cell, maps.item, maps.blocked)[0]  # [N * M, P]
        lifted = restrict_items(cell, self.item, state, lifted.reshape(len(state.surface), -1))
        number = lifted.unflatten(1, (maps.bin_items, -1)).any(2).int().argmax(1)
        maps, _ = maps.of_choice(cell, number * cell.num_footprints)
        pick, footprint, succeeds = pick_first(cell, maps, self.pick)
        allowed, footprint = footprint >= 0, footprint.clamp(min=0)
        if self.candidates == "corners":
            allowed &= corner_footprints(cell, state.heights, maps).flatten(1).gather(1, footprint)
        turned = torch.arange(cell.num_footprints, device=footprint.device) // cell.num_places
        order = dbl_order(cell, maps.top).flatten(1) * cell.footprint_turns
        order = (order + narrow_first(cell, maps.item, turned.expand(len(footprint), -1))).gather(1, footprint)
        # Those that succeed, in order; then those that fail, in order; ties by the lowest flat index.
        order = torch.where(allowed, order + FAR * ~(succeeds & allowed) * cell.num_footprints, FAR**2)
        return join_pick(cell, pick, order.argmin(1))


def corner_footprints(cell: CellSpec, heights: Tensor, maps: PlacingMaps) -> Tensor:
    """Mask of the footprints in a corner of a maximal empty space on whose floor they rest, bool ``[N, Q, W_T, D_T]``.

    Args:
        heights: int32 ``[N, W_T, D_T]``.
        maps: of this state; footprints on which the item cannot rest are in no corner.
    """
    found, spaces = torch.zeros_like(maps.top, dtype=torch.bool), empty_spaces(heights)
    level = maps.top - maps.item.h[:, None, None, None]
    for turned in range(cell.footprint_turns):
        w, d = (side[spaces.row] for side in (maps.item.w, maps.item.d)[:: 1 - 2 * turned])
        fits = (w > 0) & (spaces.x1 - spaces.x0 >= w) & (spaces.y1 - spaces.y0 >= d)  # a width of 0: no item
        row, floor, x0, y0, x1, y1 = (part[fits] for part in spaces)
        for x, y in product((x0, x1 - w[fits]), (y0, y1 - d[fits])):
            rests = level[row, turned, x, y] == floor
            found[row[rests], turned, x[rests], y[rests]] = True
    return found
