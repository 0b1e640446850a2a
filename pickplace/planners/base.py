"""The protocol of planners, and functions that several planners share."""

from abc import ABC, abstractmethod
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import PICKS, select_pick
from pickplace.rules.item import Item, Observation
from pickplace.rules.masks import PlacingMaps, action_footprints, action_mask, placing_maps
from pickplace.rules.state import State


@runtime_checkable
class BatchPlanner(Protocol):
    """Decides where to pick, where to place and how to turn, for ``N`` problems at once.

    A planner is made as ``Planner(cell, ...)``. A class attribute ``needs`` names further arguments that pickplace
    passes: ``"items"`` (the item distribution), ``"terms"`` (of the observation), ``"policy"`` and ``"critic"`` (of
    the checkpoint).

    Optional methods: ``evaluation_facts() -> dict`` describes the planner in ``evaluation.json`` (for a policy:
    ``candidates`` and ``mask_at_decision``), ``statistics() -> dict`` adds figures to it after the episodes, and
    ``heat_map(observation) -> [N, W_T, D_T]`` adds a picture to a replay.

    Attributes:
        name: its name in tables and in ``evaluation.json``.
    """

    name: str

    def decide(self, observation: Observation) -> Tensor:
        """Return flat actions, int64 ``[N]``."""


class MapPlanner(ABC):
    """A planner that chooses among the actions that given maps allow. So it also serves a robot.

    Attributes:
        cell: the sizes.
        name: as in :class:`BatchPlanner`.
    """

    name: str
    cell: CellSpec

    @abstractmethod
    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        """Return flat actions, int64 ``[N]``, feasible ones if there are any.

        Args:
            cell: the sizes; for a robot with another unit of heights, and perhaps with limits.
            state: heights in that unit.
            maps: determine which actions succeed.
            observation: the input of a policy, in the height units of its training.
        """

    def restart(self) -> None:  # noqa: B027
        """Begin random draws anew; by default there are none.

        A robot calls it before each plan, so that equal scenes have equal plans.
        """

    @torch.no_grad()
    def decide(self, observation: Observation) -> Tensor:
        state = State.from_observation(observation)
        return self.choose(self.cell, state, placing_maps(self.cell, state), observation)


#: Rules of :func:`restrict_items`, for the setting ``planner.item``.
ITEM_RULES = ("any", "first", "nearest")


def restrict_items(cell: CellSpec, rule: str, state: State, mask: Tensor) -> Tensor:
    """Return a mask of the choices of one item in each bin: the first item, by a rule, that has any choice.

    Args:
        cell: the sizes; with ``tipping`` the choices of all poses of the item stay.
        rule: ``"first"``: in the order of arrival; ``"nearest"``: by the distance of the item's centre from the bin's
            origin; ``"any"``: the mask stays as it is.
        state: has the items.
        mask: bool ``[N, M * C]``, the choices of an item side by side.
    """
    if rule == "any":
        return mask
    items, count = state.items, state.items.x.shape[1]
    mask = mask.unflatten(1, (count, -1))
    distance = (2 * items.x + items.w) ** 2 + (2 * items.y + items.d) ** 2 if rule == "nearest" else 0
    order = distance * count + torch.arange(count, device=mask.device)
    order = torch.where(mask.any(2), order, torch.iinfo(order.dtype).max)
    order = order.unflatten(1, (-1, cell.poses)).amin(2).repeat_interleave(cell.poses, 1)  # poses are one item
    return (mask & (order == order.amin(1, keepdim=True))[:, :, None]).flatten(1)


def narrow_first(cell: CellSpec, item: Item, values: Tensor) -> Tensor:
    """Return values of choices ``[N, M * Q * W_T * D_T]``, reordered: each item's narrower side along x comes first.

    So the order does not depend on how the items lie in the bin. The function is its own inverse.

    Args:
        cell: the sizes.
        item: all items, ``[N * M]``.
        values: of the choices.
    """
    if cell.footprint_turns == 1:
        return values
    each = values.reshape(len(item.w), cell.footprint_turns, -1)
    return torch.where((item.w > item.d)[:, None, None], each.flip(1), each).view(values.shape)


def first_choice(cell: CellSpec, maps: PlacingMaps, order: Tensor) -> Tensor:
    """Return the choice with the least order, int64 ``[N]``; ties: first item, narrower side along x, least x, least y.

    Args:
        order: of the choices, ``[N, M * Q * W_T * D_T]``.
    """
    number = torch.arange(order.shape[1], device=order.device).expand_as(order)
    first = narrow_first(cell, maps.item, order).argmin(1, keepdim=True)
    return narrow_first(cell, maps.item, number).gather(1, first)[:, 0]


def pick_first(cell: CellSpec, maps: PlacingMaps, rule: str) -> tuple[Tensor, Tensor, Tensor]:
    """Return a pick that does not look at the tote, and the placements with it.

    Args:
        maps: of one item in each bin.
        rule: a key of :data:`~pickplace.rules.grasps.PICKS`.

    Returns:
        the pick cell, int64 ``[N]``; and for every place and rotation, ``[N, W_T * D_T * R]``, the item's
        footprint, int64, and whether it succeeds, bool.
    """
    pick = PICKS[rule](cell, maps.item, maps.blocked)
    footprint = action_footprints(cell, maps.item.rows((slice(None), None)), maps.blocked)
    return pick, select_pick(cell, footprint, pick), select_pick(cell, action_mask(cell, maps), pick)
