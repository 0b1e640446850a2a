"""Planners that need no training."""

from abc import abstractmethod

import torch
from torch import Tensor

from pickplace.common.validate import number, one_of
from pickplace.items.distributions import check_seed
from pickplace.planners.base import ITEM_RULES, MapPlanner, restrict_items
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Observation
from pickplace.rules.maps import FAR, rectangle_sums
from pickplace.rules.masks import (
    PlacingMaps,
    action_mask,
    actions_reaching,
    choice_mask,
    first_action_reaching,
)
from pickplace.rules.placing import footprint_sizes
from pickplace.rules.state import State


def dbl_order(cell: CellSpec, top: Tensor) -> Tensor:
    """Return a number that orders footprints by (top, y, x): deepest-bottom-left has the least one.

    Args:
        cell: the sizes.
        top: whole numbers ``[..., W_T, D_T]``.

    Returns:
        int64, of the same shape
    """
    x, y = (torch.arange(side, device=top.device) for side in cell.tote_size[:2])
    return (top.long() * len(y) + y) * len(x) + x[:, None]


class UniformRandom:
    """Uniform over all ``N_a`` flat actions, feasible or not: the policy with which training without a mask begins.

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
    """Uniform over the feasible flat actions.

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


class JointDBL(MapPlanner):
    """Deepest-bottom-left over all feasible (pick, place, rotation) triples; not in the paper, and strong.

    Minimises (height of the item's top, footprint y, footprint x); ties go to the lowest flat index.

    Args:
        cell: the sizes.
        item: which of several items in the bin are considered, see
            :func:`~pickplace.planners.base.restrict_items`.
    """

    name = "joint_dbl"

    def __init__(self, cell: CellSpec, item: str = "any"):
        self.cell, self.item = cell, one_of("planner.item", item, ITEM_RULES)

    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        feasible = restrict_items(self.item, state, choice_mask(cell, maps))  # [N, M * Q * W_T * D_T]
        order = torch.where(feasible, maps.join(dbl_order(cell, maps.top)), FAR**2)
        best, place = order.unflatten(1, (-1, cell.num_places)).min(2)  # [N, M * Q]
        # Items and parities that share the least order are tied.
        tied, actions = best == best.amin(1, keepdim=True), []
        for index in range(best.shape[1]):
            reaching = actions_reaching(cell, maps, index * cell.num_places + place[:, index])
            good = (reaching >= 0) & tied[:, index, None]
            actions.append(torch.where(good, reaching, cell.num_actions - 1).amin(1))
        return torch.stack(actions).amin(0)


class _Cheapest(MapPlanner):
    """Chooses the footprint of least cost over everything that is feasible; ties go to the lowest index."""

    item: str

    @abstractmethod
    def cost(self, cell: CellSpec, state: State, maps: PlacingMaps, distance: Tensor) -> Tensor:
        """Return the cost of each footprint, ``[N, Q, W_T, D_T]``.

        Args:
            distance: from the tote's origin, ``x + y``, int64 ``[W_T, D_T]``.
        """

    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        feasible = restrict_items(self.item, state, choice_mask(cell, maps))
        x, y = (torch.arange(side, device=feasible.device) for side in cell.tote_size[:2])
        cost = self.cost(cell, state, maps, x[:, None] + y)
        choice = torch.where(feasible, maps.join(cost), torch.inf).argmin(1)
        return first_action_reaching(cell, maps, choice)


class Corner(_Cheapest):
    """Keeps the item's top low and its footprint near the tote's origin; not in the paper.

    Minimises ``height_weight * top + x + y`` of the footprint over everything that is feasible; ties go to the lowest
    footprint index, then to the lowest flat index.

    Args:
        cell: the sizes.
        height_weight: cost of one height unit, in cells of distance.
        item: which of several items in the bin are considered, see
            :func:`~pickplace.planners.base.restrict_items`.
    """

    name = "corner"

    def __init__(self, cell: CellSpec, height_weight: float = 10, item: str = "any"):
        self.cell, self.item = cell, one_of("planner.item", item, ITEM_RULES)
        self.height_weight = number("planner.height_weight", height_weight)

    def cost(self, cell: CellSpec, state: State, maps: PlacingMaps, distance: Tensor) -> Tensor:
        return self.height_weight * maps.top + distance


class HeightmapMinimisation(_Cheapest):
    """Raises the tote's height map least: the heuristic of Wang and Hauser, 2019, "Stable bin packing of non-convex 3D
    objects with a robot manipulator".

    Minimises ``distance_weight * (x + y)`` of the footprint plus the sum of all heights in the tote after the
    placement, over everything that is feasible; ties go to the lowest footprint index, then to the lowest flat index.

    Args:
        cell: the sizes.
        distance_weight: cost of one cell of distance from the tote's origin, in cells times height units.
        item: which of several items in the bin are considered, see
            :func:`~pickplace.planners.base.restrict_items`.
    """

    name = "heightmap_minimisation"

    def __init__(self, cell: CellSpec, distance_weight: float = 0.01, item: str = "any"):
        self.cell, self.item = cell, one_of("planner.item", item, ITEM_RULES)
        self.distance_weight = number("planner.distance_weight", distance_weight)

    def cost(self, cell: CellSpec, state: State, maps: PlacingMaps, distance: Tensor) -> Tensor:
        surface, _, item = state.each_item()
        before = rectangle_sums((surface >> 1).permute(1, 2, 0)[None], *footprint_sizes(cell, item))
        # The item's volume, and the empty space that it encloses below itself.
        added = (item.w * item.d).view(-1, 1, 1, 1) * maps.top - before.permute(3, 0, 1, 2)
        return added + self.distance_weight * distance.double()
