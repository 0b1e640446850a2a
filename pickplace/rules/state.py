"""The state of a problem: the items in the bin, the surface in the tote, and why an episode ended."""

from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.rules.item import (
    Item,
    Observation,
    coming_from_observation,
    items_from_observation,
    turns_from_flags,
)
from pickplace.rules.pile import Pile

EMPTY = 1  # surface of an empty tote, see `surface_from`
REFILLS = ("each", "batch")  # see :attr:`~pickplace.rules.cell.CellSpec.refill`


class Failure(IntEnum):
    """The reason why an episode ended; see :data:`~pickplace.rules.checks.CHECKS` for the order of the checks.

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
    FORBIDDEN_TURN = 9, "The item may not be turned like that.", "forbidden turn"
    OVERLOADED = 10, "An item below would carry more than it bears.", "overloaded"  # judged last

    def __new__(cls, code: int, sentence: str = "", label: str = ""):
        failure = int.__new__(cls, code)
        failure._value_, failure.sentence, failure.label = code, sentence, label
        return failure


class EpisodeSettings(NamedTuple):
    """The settings in which episodes may differ besides the tote height, ``[N]`` each; None if all are alike.

    See :attr:`~pickplace.rules.cell.CellSpec.varies`.
    """

    item_mix: Tensor | None = None  # int64: number of the item distribution's mix of kinds
    turns: Tensor | None = None  # int64: bit mask of the allowed rotations, as in an item
    bin_items: Tensor | None = None  # int64: greatest number of items in the bin
    refill: Tensor | None = None  # int64: index of the rule in REFILLS
    preview: Tensor | None = None  # int64: number of the next items that are seen
    level: Tensor | None = None  # int64: number of the curriculum's level

    @classmethod
    def from_observation(cls, observation: Observation) -> "EpisodeSettings":
        """Return the settings in the entries of an observation."""
        read = {key: observation.get(key, None) for key in cls._fields if key != "turns"}
        rotations = observation.get("rotations", None)
        return cls(
            turns=rotations if rotations is None else turns_from_flags(rotations),
            **{key: entry if entry is None else entry.reshape(-1) for key, entry in read.items()},
        )

    def rows(self, index) -> "EpisodeSettings":
        """Return the settings of some problems, by their numbers."""
        return EpisodeSettings(*(part if part is None else part[index] for part in self))


FULL_TASK = EpisodeSettings()


class State(NamedTuple):
    """Everything that the rules need to know of ``N`` problems."""

    surface: Tensor  # int32 [N, W_T, D_T]: heights in the tote and bearing flags, see `surface_from`
    tote_height: Tensor  # int64 [N]: height of the episode's tote, H_T
    items: Item  # in the bin, [N, M]
    episode: EpisodeSettings = FULL_TASK  # settings in which the running episodes may differ
    pile: Pile | None = None  # the items in the tote; None: any item bears any load
    coming: Item | None = None  # items that arrive next, in their order, [N, p]; None: none are seen
    boxes: Tensor | None = None  # int64 [N, L, 6]: corner x, y, z and sides w, d, h of the items in the tote, in the
    # order in which they were put down, then zeros; None: they are not recorded

    @classmethod
    def from_observation(cls, observation: Observation) -> "State":
        """Return the state that the standard terms of an observation ``[N]`` show."""
        tote_height = observation["tote_height"].reshape(-1)
        heights = tote_height[:, None, None] - observation["tote_depth"]
        surface, items = surface_from(heights, observation["tote_bearing"]), items_from_observation(observation)
        pile = None
        if "pile_below" in observation:
            pile = Pile(*(observation[key] for key in ("tote_labels", "pile_spare", "pile_below")))
        coming, boxes = coming_from_observation(observation), observation.get("tote_boxes", None)
        return cls(surface, tote_height, items, EpisodeSettings.from_observation(observation), pile, coming, boxes)

    @property
    def heights(self) -> Tensor:
        """The height of each cell of the tote, int32 ``[N, W_T, D_T]``."""
        return self.surface >> 1

    @property
    def bearing(self) -> Tensor:
        """Whether each cell of the tote bears weight, bool ``[N, W_T, D_T]``."""
        return (self.surface & 1).bool()

    def rows(self, index) -> "State":
        """Return the state of some problems, by their numbers, which may repeat."""
        parts = self.surface[index], self.tote_height[index], self.items.rows(index), self.episode.rows(index)
        pile = None if self.pile is None else self.pile.rows(index)
        coming = None if self.coming is None else self.coming.rows(index)
        return State(*parts, pile, coming, None if self.boxes is None else self.boxes[index])

    def each_item(self) -> tuple[Tensor, Tensor, Item]:
        """Return one problem for each item; the items of a bin follow one another.

        Returns:
            Surface ``[N * M, W_T, D_T]``, height of the tote ``[N * M]``, item ``[N * M]``. With one item in a bin they
            are not copies.
        """
        count = self.items.x.shape[1]
        each = self if count == 1 else self.repeat(count)
        return each.surface, each.tote_height, self.items.flatten()

    @property
    def capacity(self) -> Tensor | None:
        """The greatest mass that each cell of the tote bears, int64 ``[N * M, W_T, D_T]``, one map for each item of
        :meth:`each_item`; None: any mass."""
        return None if self.pile is None else self.pile.capacity.repeat_interleave(self.items.x.shape[1], 0)

    def repeat(self, count: int) -> "State":
        """Return each problem ``count`` times, one copy after the other."""
        return self.rows(torch.arange(len(self.surface), device=self.surface.device).repeat_interleave(count))


def surface_from(heights: Tensor, bearing: Tensor | int = 1) -> Tensor:
    """Return twice the heights, plus one where a cell bears weight: int32 of the same shape.

    One number holds both, because the rules need them together: the cells that support an item are those with the
    greatest possible value under it.

    Args:
        heights: whole numbers.
        bearing: bool, or 0 and 1, of that shape; by default every cell bears weight.
    """
    return 2 * heights.int() + (bearing if isinstance(bearing, int) else bearing.int())
