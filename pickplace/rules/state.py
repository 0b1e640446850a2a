"""The state of a problem: the items in the bin, the surface in the tote, and why an episode ended."""

from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.rules.item import Item, Observation, items_from_observation

EMPTY = 1  # surface of an empty tote, see `surface_from`


class Failure(IntEnum):
    """The reason why an episode ended; 1 to 6 in the order of the checks.

    Attributes:
        sentence: the reason for a reader who does not know the rules.
        label: the reason in a word or two.
    """

    sentence: str
    label: str

    NONE = 0, "The item stream is over.", "stream over"
    PICK_MISS = 1, "The gripper does not cover the item.", "missed the item"
    BIN_COLLISION = 2, "The gripper would hit the bin's wall, or another item in it.", "hit the bin"
    TOTE_COLLISION = 3, "The gripper or the item would hit the tote's wall.", "hit the tote"
    OVERFLOW = 4, "The item would stick out of the tote.", "too high"
    ITEM_COLLISION = 5, "The gripper would hit an item in the tote.", "hit an item"
    UNSTABLE = 6, "The item would not rest stably.", "unstable"
    STUCK = 7, "This item fits nowhere any more.", "no place left"
    OUT_OF_REACH = 8, "The robot does not reach this pick or this place.", "out of reach"  # judged after 1 to 6

    def __new__(cls, code: int, sentence: str = "", label: str = ""):
        failure = int.__new__(cls, code)
        failure._value_, failure.sentence, failure.label = code, sentence, label
        return failure


class State(NamedTuple):
    """Everything that the rules need to know of ``N`` problems."""

    surface: Tensor  # int32 [N, W_T, D_T]: of what the tote holds, see `surface_from`
    tote_height: Tensor  # int64 [N]: height of the episode's tote, H_T
    items: Item  # in the bin, [N, M]

    @classmethod
    def from_observation(cls, observation: Observation) -> "State":
        """Return the state that the standard terms of an observation ``[N]`` show."""
        tote_height = observation["tote_height"].reshape(-1)
        heights = tote_height[:, None, None] - observation["tote_depth"]
        return cls(surface_from(heights, observation["tote_bearing"]), tote_height, items_from_observation(observation))

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
