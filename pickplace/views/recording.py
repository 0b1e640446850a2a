"""Recorded episodes, move by move."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from torch import Tensor

from pickplace.rules.bin import remove_item
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import split_action
from pickplace.rules.item import Item
from pickplace.rules.state import Failure, State
from pickplace.rules.step import Step, apply
from pickplace.views.motion import Outcome

if TYPE_CHECKING:
    from tensordict import TensorDictBase  # its import takes a second, and packing an order does not need it

FULL = "The tote is full."

#: An item in the bin: its minimum corner and its size, x, y, w, d, h; in cells and height units.
InBin = tuple[int, int, int, int, int]


class PlacedItem(NamedTuple):
    """An item in the tote: its minimum corner and its sides; in cells and height units."""

    x: int
    y: int
    z: int
    w: int
    d: int
    h: int

    @property
    def volume(self) -> int:
        """The volume, in cells times height units."""
        return self.w * self.d * self.h


@dataclass
class Move:
    """One decision and its effect; in cells and height units."""

    item: InBin  # the item that is taken
    pick: tuple[int, int]  # min corner of the end effector in the bin
    place: tuple[int, int]  # min corner of the turned end effector in the tote
    rotation: int  # quarter turns, counter-clockwise seen from above
    footprint: tuple[int, int, int, int]  # x, y, w, d in the tote
    z: int  # height of the item's underside once it rests
    failure: Failure
    heat: np.ndarray | None = None  # uint8 [W_T, D_T]: the policy's preference for each place cell, 255 the highest
    others: list[InBin] = field(default_factory=list)  # the other items in the bin
    grams: int = 0  # mass of the item; 0: not known
    coming: list[InBin] = field(default_factory=list)  # the items that are seen to arrive next, in order


@dataclass
class Recording:
    """One episode, move by move."""

    episode: int  # its number in the stream
    tote_height: int
    moves: list[Move] = field(default_factory=list)
    ending: Failure | None = None  # None while it goes on; Failure.NONE if the item stream ended
    waiting: list[InBin] = field(default_factory=list)  # items left in the bin at the end of a stuck episode
    occupancy: float = 0.0
    carried_out: Outcome | None = None  # by a physics engine

    @property
    def boxes(self) -> list[PlacedItem]:
        """The items placed, in order."""
        return [
            PlacedItem(*move.footprint[:2], move.z, *move.footprint[2:], move.item[4])
            for move in self.moves
            if not move.failure
        ]

    def describe_ending(self, cell: CellSpec) -> str:
        """Return the reason why the episode ended, as a sentence; empty while it goes on."""
        if self.ending == Failure.STUCK:
            if sum(box.volume for box in self.boxes) == cell.num_places * self.tote_height:
                return FULL
            if len(self.waiting) > cell.poses:  # an item in all its poses is one
                return "None of these items fits anywhere any more."
        return "" if self.ending is None else self.ending.sentence


def items_in_bin(items: Item, row: int) -> list[InBin]:
    """Return the items in the bin of one row of ``[N, M]``, in the order of arrival."""
    return [tuple(item) for item in items.rows(row).cuboids.tolist() if item[4] > 0]


def record_moves(
    cell: CellSpec, planner, observation: "TensorDictBase | None", state: State, action: Tensor,
    step: Step | None = None,
) -> list[Move]:  # fmt: skip
    """Record the moves that actions make, one for each row.

    Args:
        cell: the sizes.
        planner: the planner that decided; its ``heat_map`` is recorded if it has one.
        observation: the planner's observation, ``[N]``; only heat maps need it.
        state: the states before the moves.
        action: int64 ``[N]``.
        step: the step of these actions, if it is known; None: it is computed.
    """
    step = apply(cell, state, action) if step is None else step
    x_bin, y_bin, x_tote, y_tote, rotation = (part.tolist() for part in split_action(cell, action))
    heat = planner.heat_map(observation) if hasattr(planner, "heat_map") else None
    if heat is not None:
        heat = (255 * heat / heat.amax((1, 2), keepdim=True).clamp(min=1e-30)).round().byte().cpu().numpy()
    items, others = step.item.cuboids.tolist(), remove_item(cell, state.items, step.taken)
    shape, turned = cell.effector(0), [cell.effector(turns) for turns in rotation]
    return [
        Move(
            item=tuple(items[row]),
            pick=(x_bin[row] - shape.ref_x, y_bin[row] - shape.ref_y),
            place=(x_tote[row] - turned[row].ref_x, y_tote[row] - turned[row].ref_y),
            rotation=rotation[row],
            footprint=tuple(step.footprint[row].tolist()),
            z=int(step.top[row]) - items[row][4],
            failure=Failure(int(step.failure[row])),
            heat=None if heat is None else heat[row],
            others=items_in_bin(others, row),
            grams=int(step.item.grams[row]),
            coming=[] if state.coming is None else items_in_bin(state.coming, row),
        )
        for row in range(len(action))
    ]
