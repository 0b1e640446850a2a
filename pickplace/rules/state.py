"""The state of a problem: the items in the bin, the surface in the tote, and why an episode ended."""

from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.rules.item import Item, Observation, items_from_observation

EMPTY = 1  # surface of an empty tote, see `surface_from`


class Failure(IntEnum):
    """The reason why an episode ended; 1 to 6 in the order of the checks."""

    NONE = 0
    PICK_MISS = 1
    BIN_COLLISION = 2
    TOTE_COLLISION = 3
    OVERFLOW = 4
    ITEM_COLLISION = 5
    UNSTABLE = 6
    STUCK = 7
    OUT_OF_REACH = 8  # judged after 1 to 6

    @property
    def sentence(self) -> str:
        """The reason for a reader who does not know the rules."""
        return _WORDS[self][0]

    @property
    def label(self) -> str:
        """The reason in a word or two."""
        return _WORDS[self][1]


_WORDS = {
    Failure.NONE: ("The item stream is over.", "stream over"),
    Failure.PICK_MISS: ("The gripper does not cover the item.", "missed the item"),
    Failure.BIN_COLLISION: ("The gripper would hit the bin's wall, or another item in it.", "hit the bin"),
    Failure.TOTE_COLLISION: ("The gripper or the item would hit the tote's wall.", "hit the tote"),
    Failure.OVERFLOW: ("The item would stick out of the tote.", "too high"),
    Failure.ITEM_COLLISION: ("The gripper would hit an item in the tote.", "hit an item"),
    Failure.UNSTABLE: ("The item would not rest stably.", "unstable"),
    Failure.STUCK: ("This item fits nowhere any more.", "no place left"),
    Failure.OUT_OF_REACH: ("The robot does not reach this pick or this place.", "out of reach"),
}


class State(NamedTuple):
    """Everything that the rules need to know of ``N`` problems."""

    surface: Tensor  # int32 [N, W_T, D_T]: of what the tote holds, see `surface_from`
    tote_height: Tensor  # int64 [N]: height of the episode's tote, H_T
    items: Item  # in the bin, [N, M]

    @classmethod
    def from_observation(cls, observation: Observation) -> "State":
        """Return the state that the standard terms of an observation ``[N]`` show."""
        tote_height = observation["tote_height"].reshape(-1)
        heights = heights_from_depth(observation["tote_depth"], tote_height)
        surface = surface_from(heights, observation["tote_bearing"])
        return cls(surface, tote_height, items_from_observation(observation))

    @property
    def heights(self) -> Tensor:
        """The height of each cell of the tote, int32 ``[N, W_T, D_T]``."""
        return self.surface >> 1

    @property
    def bearing(self) -> Tensor:
        """Whether each cell of the tote bears weight, bool ``[N, W_T, D_T]``."""
        return (self.surface & 1).bool()

    def rows(self, index) -> "State":
        """Return the state of some problems, by their numbers, which may come up more than once."""
        return State(self.surface[index], self.tote_height[index], self.items.rows(index))

    def each_item(self) -> tuple[Tensor, Tensor, Item]:
        """Return a problem for each item, those of a bin one after the other.

        Returns:
            Surface ``[N * M, W_T, D_T]``, height of the tote ``[N * M]``, item ``[N * M]``. With one item in a bin they
            are no copies.
        """
        count = self.items.x.shape[1]
        each = self if count == 1 else self.repeat(count)
        return each.surface, each.tote_height, self.items.flatten()

    def repeat(self, count: int) -> "State":
        """Return each problem ``count`` times, one copy after the other."""
        return self.rows(torch.arange(len(self.surface), device=self.surface.device).repeat_interleave(count))


def surface_from(heights: Tensor, bearing: Tensor | int = 1) -> Tensor:
    """Return twice the heights, and one more where a cell bears weight: int32 of the same shape.

    The two stay in one number, because the rules ask about them together: the cells that support an item are those
    with the greatest possible value under it.

    Args:
        heights: whole numbers.
        bearing: bool, or 0 and 1, of that shape; by default every cell bears weight.
    """
    return 2 * heights.int() + (bearing if isinstance(bearing, int) else bearing.int())


def depth_from_heights(heights: Tensor, tote_height: Tensor) -> Tensor:
    """Return the remaining depth ``H_T - height`` of each cell, float32 ``[N, W_T, D_T]``."""
    return (tote_height[:, None, None] - heights).float()


def heights_from_depth(tote_depth: Tensor, tote_height: Tensor) -> Tensor:
    """Return the heights, int32 ``[N, W_T, D_T]``: the inverse of :func:`depth_from_heights`."""
    return (tote_height[:, None, None] - tote_depth).int()
