"""Failure codes of flat actions of one problem: those of the single step, from maps, for half a million actions."""

from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.rules.bin import blocked_picks, taken_item
from pickplace.rules.cell import CellSpec
from pickplace.rules.checks import FOOTPRINT, EffectorOverTote, Resting, combine, first_failure
from pickplace.rules.grasps import Grasp, carry, footprint_index, is_outside, split_action
from pickplace.rules.item import Item, flags_from_turns
from pickplace.rules.maps import FAR, NEVER
from pickplace.rules.masks import PlacingMaps
from pickplace.rules.placing import effector_over_tote, resting_top
from pickplace.rules.state import State


class FailureMaps(NamedTuple):
    """The facts that the checks look at, for every footprint and place of one problem with ``M`` items in its bin."""

    items: Item  # [M]
    blocked: Tensor | None  # bool [M, P], see `blocked_picks`
    rest: Tensor  # int32 [M, Q, W_T, D_T]: height on which the item would lie; FAR outside the tote
    stable: Tensor  # bool [M, Q, W_T, D_T]: whether it is stable there
    rim: Tensor  # int64 [1]: height of the tote
    effector: EffectorOverTote  # the end effector over every place cell

    @classmethod
    def of(cls, cell: CellSpec, state: State) -> "FailureMaps":
        """Return the facts of a state of one problem, with items ``[1, M]``."""
        surface, rim, items = state.each_item()
        # With the highest possible rim, the top inside the tote is NEVER only where the item is unstable.
        top, rest = resting_top(cell, surface, torch.full_like(rim, FAR), items)
        effector = effector_over_tote(cell, state.surface, state.tote_height)
        return cls(items, blocked_picks(cell, state.items), rest, top != NEVER, state.tote_height, effector)

    def placing_maps(self, cell: CellSpec) -> PlacingMaps:
        """Return the same as :func:`~pickplace.rules.masks.placing_maps` for the state."""
        top = self.rest + self.items.h.to(self.rest.dtype)[:, None, None, None]
        good = combine(FOOTPRINT, Resting(None, top, self.rim, self.stable))
        maps = PlacingMaps.of(torch.where(good, top, NEVER), self.rest, self.effector, self.items, self.blocked)
        return maps.within_turns(cell) if cell.forbids_turns else maps

    def codes(self, cell: CellSpec, action: Tensor) -> Tensor:
        """Return the failure codes of flat actions, int64 ``[A]``, as :func:`~pickplace.rules.step.apply` does."""
        items = self.items.map(lambda part: part.expand(len(action), -1))
        taken = taken_item(cell, items, *split_action(cell, action)[:2])
        item = self.items.map(lambda part: part[taken])
        carried = carry(cell, item, action, None if self.blocked is None else self.blocked[taken])
        return failure_codes(cell, action, item, carried, self.rest, self.stable, self.rim, self.effector, taken)


def failure_codes(
    cell: CellSpec,
    action: Tensor,
    item: Item,
    carried: tuple[Grasp, Tensor, tuple[Tensor, ...], tuple[Tensor, ...]],
    rest: Tensor,
    stable: Tensor,
    rim: Tensor | int,
    effector: EffectorOverTote,
    number: Tensor | int = 0,
    borne: Tensor | None = None,
) -> Tensor:
    """Return the failure codes of flat actions, int64 ``[A]``, in the order of the rules' checks.

    Args:
        cell: with the limits of the robot.
        action: int64 ``[A]``.
        item: the items that they take, ``[A]``.
        carried: see :func:`~pickplace.rules.grasps.carry`.
        rest, stable: the height on which an item lies on each footprint, and whether it is stable there,
            ``[M, Q, W_T, D_T]``, or ``[Q, W_T, D_T]`` with one item.
        rim: greatest height of the item's top.
        effector: the end effector over every place cell.
        number: the item's number, int64 ``[A]``, from 0 to ``M - 1``.
        borne: whether the items below bear the item, in the shape of ``stable``; None: they bear any load.
    """
    (wide, deep, _), (_, _, x_tote, y_tote, _) = cell.tote_size, split_action(cell, action)
    picked, rotation, _, (x, y, w, d) = carried
    inside = ~is_outside(x, w, wide) & ~is_outside(y, d, deep)
    footprint = footprint_index(cell.tote_size, rotation % 2, x.clamp(0, wide - 1), y.clamp(0, deep - 1))
    footprint = footprint + number * cell.num_footprints
    place = footprint_index(cell.tote_size, rotation % len(effector.leaves_tote), x_tote, y_tote)
    resting = Resting(
        inside, rest.flatten()[footprint] + item.h, rim, stable.flatten()[footprint],
        None if borne is None else borne.flatten()[footprint],
    )  # fmt: skip
    turn = None
    if cell.forbids_turns:
        turn = flags_from_turns(item.turns, cell.rotations).gather(1, rotation[:, None])[:, 0]
    return first_failure(picked, resting, effector.at(place), turn)
