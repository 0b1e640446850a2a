"""Items in bins: their columns, and how an observation shows them."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import torch
from torch import Tensor

from pickplace.rules.maps import rectangle

if TYPE_CHECKING:
    from tensordict import TensorDictBase  # its import takes longer than that of all the rules

#: An observation ``[N]``: a TensorDict, or a dict of its entries.
Observation: TypeAlias = "TensorDictBase | Mapping[str, Tensor]"

ALL_TURNS = 0b1111  # a bit for each quarter turn
NO_LIMIT = 2**31 - 1  # grams
MAX_GRAMS = 10_000_000  # greatest mass of an item


DEFAULTS = (-1, ALL_TURNS, 0, NO_LIMIT)  # of the columns kind, turns, grams and max_load


class _Columns(NamedTuple):
    """The columns of a table of items."""

    x: Tensor
    y: Tensor
    w: Tensor
    d: Tensor
    h: Tensor
    kind: Tensor
    turns: Tensor
    grams: Tensor
    max_load: Tensor


class Item(_Columns):
    """Items, column by column: int64 tensors of one shape.

    The items in the bins of a :class:`~pickplace.rules.state.State` have columns ``[N, M]``: ``M`` places in each bin,
    filled in the order of arrival. One item for each of ``N`` problems has columns ``[N]``. A size of
    ``(0, 0, 0)`` stands for no item.

    Args:
        x, y: minimum corner in the bin; cells.
        w, d, h: width and depth in cells, height in height units.
        kind: row of the size in :attr:`~pickplace.items.distributions.ItemDistribution.sizes`; -1: unknown.
        turns: bit mask of the allowed quarter turns, bit ``r`` for rotation ``r``.
        grams: mass.
        max_load: greatest mass that may rest on the item, grams.
    """

    _table: Tensor | None = None  # the columns are views of it, if there is one

    def __new__(cls, x, y, w, d, h, kind=None, turns=None, grams=None, max_load=None):
        given = zip((kind, turns, grams, max_load), DEFAULTS, strict=True)
        rest = (torch.full_like(x, default) if part is None else part for part, default in given)
        return super().__new__(cls, x, y, w, d, h, *rest)

    @classmethod
    def from_table(cls, table: Tensor) -> "Item":
        """Return the items of a table ``[..., 9]``, as views of it, or ``[..., 5]`` with only x, y, w, d and h."""
        columns = table.unbind(-1)
        if len(columns) < len(cls._fields):
            return cls(*columns)
        items = cls._make(columns)
        items._table = table
        return items

    @property
    def table(self) -> Tensor:
        """All columns, int64 ``[..., 9]``; no copy if the items were made from a table."""
        return torch.stack(self, -1) if self._table is None else self._table

    @property
    def cuboids(self) -> Tensor:
        """The columns x, y, w, d and h, int64 ``[..., 5]``."""
        return torch.stack(self[:5], -1)

    @property
    def volume(self) -> Tensor:
        """The volume, in cells times height units, int64."""
        return self.w * self.d * self.h

    @property
    def exists(self) -> Tensor:
        """Whether there is an item, bool."""
        return self.h > 0

    def map(self, function: Callable[[Tensor], Tensor]) -> "Item":
        """Return the items with a function applied to each column."""
        return Item(*map(function, self))

    def rows(self, index) -> "Item":
        """Return some of the items, by an index into each column."""
        return Item.from_table(self.table[index])

    def flatten(self) -> "Item":
        """Return the items of bins ``[N, M]`` one after the other, ``[N * M]``."""
        return Item.from_table(self.table.flatten(0, 1))


def bin_depth_from_items(items: Item, bin_size: Sequence[int]) -> Tensor:
    """Return the height above the bin's floor, float32 ``[N, W_B, D_B]``: the height of the item there, or 0."""
    return _bin_map(items, items.h, bin_size)


def bin_labels_from_items(items: Item, bin_size: Sequence[int]) -> Tensor:
    """Return the number of the item on each cell of the bin, float32 ``[N, W_B, D_B]``: 1 to ``M``, 0 where empty."""
    return _bin_map(items, torch.arange(1, items.x.shape[1] + 1, device=items.x.device).expand_as(items.x), bin_size)


def _bin_map(items: Item, value: Tensor, bin_size: Sequence[int]) -> Tensor:
    """Return a map of a value of each item on its cells, 0 elsewhere, float32 ``[N, W_B, D_B]``."""
    inside = rectangle(bin_size, *items.flatten()[:4])  # [W_B, D_B, N * M]
    maps = inside * value.reshape(-1).float()
    if items.x.shape[1] > 1:
        maps = maps.unflatten(2, items.x.shape).sum(3)
    return maps.permute(2, 0, 1).contiguous()


def read_items(bin_depth: Tensor, table: Tensor | None = None, rotations: Tensor | None = None) -> Item:
    """Return the items in the bins, ``[N, M]``, from a table, or the single item that the depth map shows.

    Args:
        bin_depth: ``[N, W_B, D_B]``.
        table: int64 ``[N, M, 5]``, the entry of observations of bins with several items.
        rotations: bool ``[N, R]``, the allowed ones; the entry of observations of episodes that forbid some.
    """
    items = item_from_depth(bin_depth).rows((slice(None), None)) if table is None else Item.from_table(table)
    if rotations is None:
        return items
    return Item(*items[:6], turns_from_flags(rotations)[:, None].expand_as(items.x))


def items_from_observation(observation: Observation) -> Item:
    """Return the items in the bins, ``[N, M]``; see :func:`read_items`."""
    items = read_items(observation["bin_depth"], observation.get("items", None), observation.get("rotations", None))
    handling = observation.get("handling", None)
    return items if handling is None else Item(*items[:6], *handling.unbind(-1))


def coming_from_observation(observation: Observation) -> Item | None:
    """Return the items that arrive next, ``[N, p]``, in their order; None where none are shown.

    The table ``coming``, int64 ``[N, p, 5]``, has x, y, w, d and h. With handling, ``[N, p, 8]``, it also has turns,
    mass and greatest load.
    """
    if (table := observation.get("coming", None)) is None or table.shape[1] == 0:
        return None
    x, y, w, d, h, *handling = table.unbind(-1)
    rotations = observation.get("rotations", None)
    if rotations is not None and not handling:
        handling = [turns_from_flags(rotations)[:, None].expand_as(x)]
    return Item(x, y, w, d, h, None, *handling)


def turns_from_flags(flags: Tensor) -> Tensor:
    """Return flags of the allowed rotations, bool ``[..., R]``, as bit masks, int64 ``[...]``."""
    return (flags.long() << torch.arange(flags.shape[-1], device=flags.device)).sum(-1)


def flags_from_turns(turns: Tensor, rotations: int) -> Tensor:
    """Return whether bit masks allow each rotation, bool ``[..., R]``: the inverse of :func:`turns_from_flags`."""
    return (turns[..., None] >> torch.arange(rotations, device=turns.device) & 1).bool()


def item_from_depth(bin_depth: Tensor) -> Item:
    """Return the item that a depth map ``[N, W_B, D_B]`` shows, ``[N]``: the bounding box of its non-zero cells."""
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
