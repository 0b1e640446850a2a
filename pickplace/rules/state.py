"""The state of a problem: the items in the bin, the surface in the tote, and why an episode ended."""

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pickplace.rules.maps import rectangle

EMPTY = 1  # surface of an empty tote, see `surface_from`

#: An observation ``[N]``: a TensorDict, or a dict of its entries.
Observation: TypeAlias = TensorDictBase | Mapping[str, Tensor]


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


class Item(NamedTuple):
    """One item per problem, lying in its bin: minimum corner ``(x, y)`` and size ``(w, d, h)``, int64 ``[N]`` each.

    ``h`` is in height units, the rest in cells. An empty bin has size ``(0, 0, 0)``. The items that lie in a bin
    together have parts of shape ``[N, M]``, in the order in which they arrived; those of size 0 are not there.
    """

    x: Tensor
    y: Tensor
    w: Tensor
    d: Tensor
    h: Tensor

    @classmethod
    def from_table(cls, table: Tensor) -> "Item":
        """Return the items of a table ``[..., 5]`` with columns x, y, w, d, h."""
        return cls(*table.unbind(-1))

    @property
    def table(self) -> Tensor:
        """The parts as columns, int64 ``[N, 5]`` or ``[N, M, 5]``."""
        return torch.stack(self, -1)

    @property
    def volume(self) -> Tensor:
        """The item's volume, in cells times height units, int64 ``[N]``."""
        return self.w * self.d * self.h

    @property
    def is_empty(self) -> Tensor:
        """Whether the bin is empty, bool ``[N]``."""
        return self.h <= 0

    def rows(self, index) -> "Item":
        """Return the items of some problems."""
        return Item(*(part[index] for part in self))


class State(NamedTuple):
    """Everything that the rules need to know of ``N`` problems."""

    surface: Tensor  # int32 [N, W_T, D_T]: of what the tote holds, see `surface_from`
    tote_height: Tensor  # int64 [N]: height of the episode's tote, H_T
    item: Item  # what lies in the bin, [N]; with several items [N, M]

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
    def items(self) -> Item:
        """The items in each bin, ``[N, M]``, be it one."""
        return self.item if self.item.x.dim() == 2 else self.item.rows((slice(None), None))

    @property
    def bearing(self) -> Tensor:
        """Whether each cell of the tote bears weight, bool ``[N, W_T, D_T]``."""
        return (self.surface & 1).bool()

    def rows(self, index) -> "State":
        """Return the state of some problems, by their numbers, which may come up more than once."""
        return State(self.surface[index], self.tote_height[index], self.item.rows(index))

    def each_item(self) -> "State":
        """Return a problem for each item of a bin, one after the other: ``[N * M]``; of one item this state."""
        if self.item.x.dim() == 1:
            return self
        return State(*self.repeat(self.item.x.shape[1])[:2], Item(*(part.flatten() for part in self.item)))

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


def bin_depth_from_item(item: Item, bin_size: Sequence[int]) -> Tensor:
    """Return the height above the bin's floor, float32 ``[N, W_B, D_B]``: an item's height under it, else 0."""
    return _bin_map(item, item.h, bin_size)


def bin_labels_from_items(items: Item, bin_size: Sequence[int]) -> Tensor:
    """Return which item of ``[N, M]`` lies on each cell of the bin, float32 ``[N, W_B, D_B]``, from 1; 0: none."""
    return _bin_map(items, torch.arange(1, items.x.shape[1] + 1, device=items.x.device).expand_as(items.x), bin_size)


def _bin_map(item: Item, value: Tensor, bin_size: Sequence[int]) -> Tensor:
    """Return a map of a value of each item on its cells, 0 elsewhere, float32 ``[N, W_B, D_B]``."""
    if item.x.dim() == 1:
        inside = rectangle(bin_size, *item[:4])
        return (inside * value.float()).permute(2, 0, 1).contiguous()
    inside = rectangle(bin_size, *(part.flatten() for part in item[:4])).permute(2, 0, 1)  # [N * M, W_B, D_B]
    return (inside * value.flatten()[:, None, None].float()).unflatten(0, item.x.shape).sum(1)


def listed_items(observation: Observation) -> Item | None:
    """Return the items that an observation of bins with several items lists, ``[N, M]``; None if it has no list."""
    if "items" in observation.keys():  # noqa: SIM118 - a TensorDict does not iterate over its keys
        return Item.from_table(observation["items"])
    return None


def items_from_observation(observation: Observation) -> Item:
    """Return what lies in the bins: the listed items, ``[N, M]``, or the one that the depth map shows, ``[N]``."""
    items = listed_items(observation)
    return item_from_depth(observation["bin_depth"]) if items is None else items


def item_from_depth(bin_depth: Tensor) -> Item:
    """Return the item that a bin's depth map ``[N, W_B, D_B]`` shows: the bounding box of its non-zero cells."""
    filled = bin_depth > 0
    columns, rows = filled.any(2), filled.any(1)  # [N, W_B], [N, D_B]
    # argmax of a 0/1 map is its first 1: where the item begins.
    return Item(
        x=columns.int().argmax(1),
        y=rows.int().argmax(1),
        w=columns.sum(1),
        d=rows.sum(1),
        h=bin_depth.amax((1, 2)).long(),
    )
