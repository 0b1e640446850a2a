"""Observations: lists of terms. A new channel is one term, and one line in the config of the environment.

The environment, Gymnasium, the robot's planner and search use the same list. Policies and critics read the entries that
they name in ``in_keys``.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.common.validate import expect, number, refuse_if, short_text
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import NO_LIMIT, Item, bin_depth_from_items, bin_labels_from_items, flags_from_turns
from pickplace.rules.state import State

PAPER_CELL = CellSpec()
MAX_NUMBER = 2**31 - 1  # greatest value of an :class:`EpisodeNumber`


class Bounds(NamedTuple):
    """The range, shape and type of one problem's entry."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: torch.dtype = torch.float32


class Term(ABC):
    """One entry of the observation; its key is its name in the list of terms."""

    @abstractmethod
    def bounds(self, cell: CellSpec, tallest: int) -> Bounds:
        """Return the values that this entry may take.

        Args:
            cell: the sizes.
            tallest: height of the highest item that may arrive.
        """

    @abstractmethod
    def value(self, cell: CellSpec, state: State) -> Tensor:
        """Return this entry for the states of ``N`` problems, ``[N, *shape]``, in a new tensor."""


class BinDepth(Term):
    """Height above the bin's floor, float32 ``[N, W_B, D_B]``, 0 where empty; height units."""

    def bounds(self, cell, tallest):
        return Bounds(0, tallest, cell.bin_size[:2])

    def value(self, cell, state):
        return bin_depth_from_items(state.items, cell.bin_size)


class BinLabels(Term):
    """Number of the item on each cell of the bin, float32 ``[N, W_B, D_B]``: 1 to M, 0 where empty.

    The numbers are those of :class:`Items`, so that 1 is the item that arrived first.
    """

    def bounds(self, cell, tallest):
        return Bounds(0, cell.bin_items, cell.bin_size[:2])

    def value(self, cell, state):
        return bin_labels_from_items(state.items, cell.bin_size)


class Items(Term):
    """Items in the bin in the order in which they arrived, int64 ``[N, M, 5]``: x, y, w, d in cells, h in height units.

    A row of zeros stands for no item.
    """

    def bounds(self, cell, tallest):
        return Bounds(0, max(tallest, *cell.bin_size[:2]), (cell.bin_items, 5), torch.int64)

    def value(self, cell, state):
        return state.items.cuboids


class Coming(Term):
    """The items that arrive next, in their order, int64 ``[N, p, 5]``: x, y, w, d in cells, h in height units.

    A row of zeros stands for no item: the stream is over. An item lies at x, y if it comes into an empty bin. In cells
    with ``handling`` the turns, the mass and the greatest load follow, as in :class:`Handling`: ``[N, p, 8]``.
    """

    def bounds(self, cell, tallest):
        high = NO_LIMIT if cell.handling else max(tallest, *cell.bin_size[:2])
        return Bounds(0, high, (cell.preview, 8 if cell.handling else 5), torch.int64)

    def value(self, cell, state):
        if state.coming is None:  # a robot's scene that shows no coming items
            return state.tote_height.new_zeros(len(state.tote_height), 0, 8 if cell.handling else 5)
        return torch.stack([*state.coming[:5], *(state.coming[6:] if cell.handling else ())], -1)


class SeenItems(Term):
    """All items that are seen, int64 ``[N, M + p, 5]``: those of :class:`Items`, then those that arrive next."""

    def bounds(self, cell, tallest):
        return Bounds(0, max(tallest, *cell.bin_size[:2]), (cell.bin_items + cell.preview, 5), torch.int64)

    def value(self, cell, state):
        return seen_items(state.items, state.coming)


class Handling(Term):
    """Handling instructions of the items in the bin, int64 ``[N, M, 3]``, in the order in which they arrived.

    The columns are a bit mask of the allowed turns, the mass, and the greatest load on top, both in grams. A row of
    zeros stands for no item. See :class:`~pickplace.rules.item.Item`.
    """

    def bounds(self, cell, tallest):
        return Bounds(0, NO_LIMIT, (cell.bin_items, 3), torch.int64)

    def value(self, cell, state):
        return torch.stack(state.items[6:], -1)


class PilePart(Term):
    """A part of the :class:`~pickplace.rules.pile.Pile` of the items in the tote, in cells with ``handling``.

    Args:
        key: name of the part: ``"labels"``, ``"spare"`` or ``"below"``.
    """

    def __init__(self, key: str):
        self.key = key

    def bounds(self, cell, tallest):
        room = cell.room
        return {
            "labels": Bounds(0, room, cell.tote_size[:2], torch.int64),
            "spare": Bounds(0, NO_LIMIT, (room,), torch.int64),
            "below": Bounds(0, 1, (room, room), torch.bool),
        }[self.key]

    def value(self, cell, state):
        return getattr(state.pile, self.key).clone()


class ToteBoxes(Term):
    """The items in the tote, int64 ``[N, L, 6]``, see :class:`~pickplace.rules.state.State`, in cells whose stability
    rule looks at them."""

    def bounds(self, cell, tallest):
        return Bounds(0, max(cell.tote_size), (cell.room, 6), torch.int64)

    def value(self, cell, state):
        return state.boxes.clone()


class ToteCapacity(Term):
    """The greatest load that each cell of the tote still bears, float32 ``[N, W_T, D_T]``, in kg; at most ``most``.

    An input for networks, in cells with ``handling``.

    Args:
        most: greatest value, kg; greater loads look alike.
    """

    def __init__(self, most: float = 100.0):
        self.most = number("observation.most", most, 1e-3, 1e6, "kg")

    def bounds(self, cell, tallest):
        return Bounds(-1e-3, self.most, cell.tote_size[:2])

    def value(self, cell, state):
        refuse_if(state.pile is None, "tote_capacity: there are no loads; expected env.handling=true.")
        return (state.pile.capacity / 1000).clamp(max=self.most).float()


class ToteDepth(Term):
    """Remaining height up to the rim, ``H_T - height``, float32 ``[N, W_T, D_T]``; height units."""

    def bounds(self, cell, tallest):
        return Bounds(0, cell.tote_size[2], cell.tote_size[:2])

    def value(self, cell, state):
        return (state.tote_height[:, None, None] - state.heights).float()


class ToteBearing(Term):
    """1 where a cell of the tote bears weight, else 0, float32 ``[N, W_T, D_T]``; all 1 unless ``support=bearing``."""

    def bounds(self, cell, tallest):
        return Bounds(0, 1, cell.tote_size[:2])

    def value(self, cell, state):
        return state.bearing.float()


class ToteHeight(Term):
    """Height ``H_T`` of the episode's tote, int64 ``[N, 1]``; height units."""

    def bounds(self, cell, tallest):
        return Bounds(tallest, cell.tote_size[2], (1,), torch.int64)

    def value(self, cell, state):
        return state.tote_height[:, None].clone()


class Rotations(Term):
    """Mask of the rotations that the episode allows, bool ``[N, R]``."""

    def bounds(self, cell, tallest):
        return Bounds(0, 1, (cell.rotations,), torch.bool)

    def value(self, cell, state):
        return flags_from_turns(state.episode.turns, cell.rotations)


class EpisodeNumber(Term):
    """A whole number in which episodes differ, int64 ``[N, 1]``.

    Args:
        key: the field of :class:`~pickplace.rules.state.EpisodeSettings`.
    """

    def __init__(self, key: str):
        self.key = key

    def bounds(self, cell, tallest):
        return Bounds(0, MAX_NUMBER, (1,), torch.int64)

    def value(self, cell, state):
        return getattr(state.episode, self.key)[:, None].clone()


#: Entries for the settings in which episodes may differ, in environments that let them vary.
EPISODE_TERMS: Mapping[str, Term] = {
    "rotations": Rotations(),
    **{key: EpisodeNumber(key) for key in ("item_mix", "bin_items", "refill", "preview", "level")},
}

#: Entries of every observation; the whole state can be read from them, see :meth:`State.from_observation`.
STANDARD_TERMS: Mapping[str, Term] = {
    "bin_depth": BinDepth(),
    "tote_depth": ToteDepth(),
    "tote_bearing": ToteBearing(),
    "tote_height": ToteHeight(),
}

#: Further entries of every observation in cells with ``handling``.
HANDLING_TERMS: Mapping[str, Term] = {
    "handling": Handling(),
    "tote_labels": PilePart("labels"),
    "pile_spare": PilePart("spare"),
    "pile_below": PilePart("below"),
}

#: Entries that only some cells have. From their presence the rules know the cell.
OPTIONAL_TERMS: Mapping[str, Term] = {
    "bin_labels": BinLabels(), "items": Items(), "coming": Coming(), "tote_boxes": ToteBoxes(), **HANDLING_TERMS,
    **EPISODE_TERMS,
}  # fmt: skip

#: Keys of the environment, the policies and the learner that no term may have.
RESERVED = (
    "action", "occupancy", "failure", "reward", "done", "terminated",
    "truncated", "next", "footprint", "grasp", "place_rotation", "logits", "log_prob", "candidates",
    "candidate_log_prob", "candidate_log_weight", "candidate_logits", "advantage", "state_value", "value_target",
    "taught", "_reset",
)  # fmt: skip


def standard_terms(cell: CellSpec) -> dict[str, Term]:
    """Return the terms that an observation of a cell always has."""
    several: dict[str, Term] = {"bin_labels": BinLabels(), "items": Items()} if cell.bin_items > 1 else {}
    coming = {"coming": Coming()} if cell.preview else {}
    handling = HANDLING_TERMS if cell.handling else {}
    boxes = {"tote_boxes": ToteBoxes()} if cell.support.sees_boxes else {}
    varied = {key: EPISODE_TERMS[key] for key in cell.varies}
    return {**STANDARD_TERMS, **several, **coming, **handling, **boxes, **varied}


def item_keys(bin_items: int) -> tuple[str, ...]:
    """Return the keys of the entries that list the items; none for one item, which the depth map shows."""
    return ("items",) if bin_items > 1 else ()


def seen_items(items: Item, coming: Item | None) -> Tensor:
    """Return the items in the bins, ``[N, M]``, and those that arrive next, ``[N, p]``, see :class:`SeenItems`."""
    return items.cuboids if coming is None else torch.cat([items.cuboids, coming.cuboids], 1)


def check_terms(terms: Mapping[str, Term] | None, cell: CellSpec = PAPER_CELL) -> dict[str, Term]:
    """Return the terms of an observation, the standard ones first; None gives those alone.

    Args:
        terms: by key.
        cell: decides which are standard.

    Raises:
        ValueError: naming the key, for a value that is no term, a key that is taken, or another term in place of a
            standard one.
    """
    standard, given = standard_terms(cell), {} if terms is None else terms
    expect(isinstance(given, Mapping), "observation", terms, "terms by their keys")
    for key, term in given.items():
        place = f"observation.{short_text(key)}"
        expect(isinstance(term, Term), place, term, "a Term, such as pickplace.rules.observation.ToteDepth")
        other = [name for name, each in OPTIONAL_TERMS.items() if name not in standard and type(term) is not type(each)]
        taken = [*RESERVED, *other]
        refuse_if(
            not isinstance(key, str) or key in taken or key.endswith("_mask") or not key.isidentifier(),
            f"{place}: expected another name; taken are *_mask, {', '.join(taken)}.",
        )
    found = {**standard, **given}
    for key, term in standard.items():
        expected = f"{type(term).__name__}, which is always there"
        expect(type(found[key]) is type(term), f"observation.{key}", found[key], expected)
    return found


def observe(
    terms: Mapping[str, Term], cell: CellSpec, state: State, keys: Collection[str] | None = None
) -> dict[str, Tensor]:
    """Return the observation of the states of ``N`` problems: each entry, ``[N, ...]``, by its key.

    Args:
        terms: the entries by key.
        keys: the entries that are needed; None: all.
    """
    return {key: term.value(cell, state) for key, term in terms.items() if keys is None or key in keys}
