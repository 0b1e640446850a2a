"""Item distributions: the item that arrives next, and its place in the bin.

An item is a counter-based hash of (stream, seed, episode, step). So there is no generator to save, the items do not
depend on the batch size, and every method that plays an episode gets the same items.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from inspect import signature
from itertools import product
from typing import Any

import torch
from torch import Tensor
from typing_extensions import Self

from pickplace.common.capture import constant_on
from pickplace.common.files import read_table
from pickplace.common.validate import excerpt, expect, flag, is_number, is_whole, refuse_above, refuse_any, whole_number
from pickplace.rules.item import ALL_TURNS, MAX_GRAMS, NO_LIMIT, Item

#: Families of item streams that share no episodes: to train, to select the best checkpoint, and to report results.
STREAMS = ("train", "validation", "test")
MAX_SEED = 2**62  # above it, seeds of two families could coincide

MAX_LENGTH = 2**31 - 1  # of a side, in cells or height units
MAX_KINDS = 100_000  # of items: more would fill the memory

#: The kinds of items in the paper, (w, d, h).
PAPER_KINDS = ((1, 1, 1), (2, 1, 1), (1, 2, 1), (2, 2, 1))


def check_seed(seed, key: str = "seed") -> int:
    """Return the seed, or raise a ``ValueError`` that names the ``key`` if it is not valid."""
    expect(is_whole(seed) and 0 <= seed < MAX_SEED, key, seed, "a whole number >= 0 and < 2**62")
    return int(seed)


def _mix(x: Tensor) -> Tensor:
    """Return scrambled int64 counters (the finalizer of MurmurHash3, Appleby 2011)."""
    for factor in (-0x00AE502812AA7333, -0x3B314601E57A13AD):
        x = _shifted(x).mul_(factor)
    return _shifted(x)


def _shifted(x: Tensor) -> Tensor:
    return (x >> 33).bitwise_and_(0x7FFFFFFF).bitwise_xor_(x)


def hashed_uniform(stream: str, seed: Tensor, episode: Tensor, step: Tensor, count: int) -> Tensor:
    """Return uniform numbers in [0, 1), float64 ``[count, N]``, that depend only on the item's address."""
    factor, offset = 0x2545F4914F6CDD1D, 0x1B873593
    key = _mix(seed * factor + (STREAMS.index(stream) + 1 + offset))
    for part in (episode, step):
        key = _mix(torch.add(part, key, alpha=factor).add_(offset))
    number = torch.arange(1, count + 1, device=key.device)[:, None]
    key = _mix(torch.add(key, number, alpha=0x1E3779B97F4A7C15))
    return ((key >> 11) & ((1 << 53) - 1)).double() / float(1 << 53)


def place_at_random(size: Tensor, across: Tensor, along: Tensor, bin_size, kind: Tensor | None = None) -> Item:
    """Return items of given sizes, int64 ``[N, 3]``, at places in the bin that two uniform numbers select, ``[N]``."""
    w, d, h = size.unbind(-1)
    x, y = (across * (bin_size[0] + 1 - w)).long(), (along * (bin_size[1] + 1 - d)).long()
    return Item(x, y, w, d, h, kind)


def _are_lengths(values, count: int) -> bool:
    return (
        isinstance(values, (list, tuple))
        and len(values) == count
        and all(is_whole(value) and 1 <= value <= MAX_LENGTH for value in values)
    )


def check_range(key: str, limits) -> tuple[int, int]:
    """Return ``(least, greatest)``, or raise a ``ValueError`` that names the ``key``."""
    good = _are_lengths(limits, 2) and limits[0] <= limits[1]
    expect(good, key, limits, "[least, greatest], whole cells with 1 <= least <= greatest")
    return int(limits[0]), int(limits[1])


class ItemDistribution:
    """Base class of item distributions.

    Attributes:
        sizes: int64 ``[K, 3]``, every size ``(w, d, h)`` that may arrive, in cells and height units.
        varies: whether episodes differ at all.
        sequential: whether the order of an episode must be hidden from a search, which then samples from ``sizes``.
        has_corners: whether items have fixed places in the bin. An item whose place is not free then waits.
        mixes: number of mixes of the sizes that an episode may have, see :meth:`mixed`.
        volumes: float64 ``[K]``, the true volume of each kind, in cells times height units, if ``sizes`` are rounded
            up; None: the sizes are exact.
        handling: int64 ``[K, 3]``, columns ``turns``, ``grams`` and ``max_load`` of each kind, see
            :class:`~pickplace.rules.item.Item`; None: any turn, no mass, any load.
        tipped_turns: int64 ``[K, 2]``, the ``turns`` of each kind on its two other pairs of faces, see
            :mod:`pickplace.items.tipping`; None: those of the upright item.
        longest_episode: greatest number of items in an episode; None: episodes do not end.
    """

    sizes: Tensor
    varies: bool = True
    sequential: bool = False
    has_corners: bool = False
    mixes: int = 1
    volumes: Tensor | None = None
    handling: Tensor | None = None
    tipped_turns: Tensor | None = None
    longest_episode: int | None = None

    def sample(
        self, stream: str, seed: Tensor, episode: Tensor, step: Tensor, bin_size, mix: Tensor | None = None
    ) -> Item:
        """Return the ``step``-th item (from 0) of each ``episode``, int64 ``[N]``; size 0 after the last one.

        Args:
            stream: family of item streams.
            seed, episode, step: int64 ``[N]``.
            bin_size: ``(W_B, D_B, ...)``.
            mix: int64 ``[N]``, the mix of each episode; None: mix 0. Given only if :attr:`mixes` is above 1.
        """
        uniform, across, along = hashed_uniform(stream, seed, episode, step, 3)
        return self.of_kind(self._index(uniform, step, mix), across, along, bin_size)

    def of_kind(self, kind: Tensor, across: Tensor, along: Tensor, bin_size) -> Item:
        """Return items of kinds, int64 ``[N]``, at places in the bin that two uniform numbers select, ``[N]``."""
        item = place_at_random(constant_on(self.sizes, kind.device)[kind], across, along, bin_size, kind)
        if self.handling is None:
            return item
        turns, grams, max_load = constant_on(self.handling, kind.device)[kind].unbind(-1)
        return item._replace(turns=turns, grams=grams, max_load=max_load)

    @property
    def has_limits(self) -> bool:
        """Whether some kind forbids a turn, or bears only a limited load."""
        if self.handling is None:
            return False
        turns, _, max_load = self.handling.unbind(-1)
        return bool(((turns != ALL_TURNS) | (max_load < NO_LIMIT)).any())

    def turns(self, kind: int) -> int:
        """Return the bit mask of the turns that kind number ``kind`` allows."""
        return ALL_TURNS if self.handling is None else int(self.handling[kind, 0])

    def _index(self, uniform: Tensor, step: Tensor, mix: Tensor | None = None) -> Tensor:
        """Return the row of ``sizes`` that arrives, int64 ``[N]``."""
        raise NotImplementedError

    def num_episodes(self, stream: str) -> int | None:
        """Return the number of different episodes of a stream; later ones repeat them. None: all are different."""

    def num_items(self, stream: str, seed: Tensor, episode: Tensor) -> Tensor:
        """Return the number of items that arrive in each episode, int64 ``[N]``; 0: the episodes do not end."""
        return torch.zeros_like(episode)

    def mix_arguments(self, mix: Tensor | None) -> dict[str, Tensor]:
        """Return the argument ``mix`` of :meth:`sample` and :meth:`spread`; an empty dict without mixes."""
        return {} if mix is None or self.mixes == 1 else {"mix": mix}

    def mixed(self, changes: Sequence[Mapping]) -> Self:
        """Return this distribution with further mixes of its sizes, numbered from 1; mix 0 is itself.

        Args:
            changes: settings of each mix.

        Raises:
            ValueError: for a bad setting, or a distribution whose episodes cannot differ in their mix.
        """
        raise ValueError(f"items: {type(self).__name__} has no mixes; expected items=kinds or items=mixed.")

    def arrival_mask(self, mix: int = 0) -> Tensor:
        """Return a mask of the rows of ``sizes`` that may arrive in a mix, bool ``[K]``."""
        return torch.ones(len(self.sizes), dtype=torch.bool)

    def tallest(self, mix: int = 0) -> int:
        """Return the height of the tallest item of a mix."""
        return int(self.sizes[self.arrival_mask(mix), 2].max())

    def spread(self, seed: Tensor, rank: Tensor, count: int, bin_size, mix: Tensor | None = None) -> Item:
        """Return the ``rank``-th of ``count`` items for each seed, int64 ``[N]``; here they are independent."""
        return self.sample("train", seed, rank, torch.zeros_like(rank), bin_size, **self.mix_arguments(mix))

    def corners(self, kind: int, bin_size) -> list[tuple[int, int]]:
        """Return every bin position ``(x, y)`` at which kind number ``kind`` may arrive."""
        w, d, _ = self.sizes[kind].tolist()
        return list(product(range(bin_size[0] - w + 1), range(bin_size[1] - d + 1)))

    def label(self, kind: int) -> str:
        """Return the name of kind number ``kind`` for a message."""
        return "item {}x{}x{}".format(*self.sizes[kind].tolist())


class Kinds(ItemDistribution):
    """A list of kinds with weights.

    Args:
        kinds: ``(w, d, h)`` triples, in cells and height units.
        weights: a relative frequency for each kind; None means equally likely.
        grams: mass of each kind; None: 0.
        max_load: for each kind the greatest mass that may lie on it, grams, or None for any; 0: nothing on top.
        turns: for each kind the rotations that are allowed, such as ``[0, 2]``, or None for all.

    Raises:
        ValueError: an empty list, a size that is not a positive whole number, or lists that do not fit the kinds.
    """

    def __init__(self, kinds, weights=None, grams=None, max_load=None, turns=None):
        expect(isinstance(kinds, (list, tuple)) and kinds, "items.kinds", kinds, "a list of at least one (w, d, h)")
        refuse_above("items.kinds: the list has", len(kinds), "kinds of items", MAX_KINDS)
        if bad := [kind for kind in kinds if not _are_lengths(kind, 3)]:
            raise ValueError(f"items.kinds: got {excerpt(bad[0])}, expected (w, d, h) in positive whole cells.")
        weights = [1.0] * len(kinds) if weights is None else weights
        is_list = isinstance(weights, (list, tuple)) and len(weights) == len(kinds)
        expect(is_list, "items.weights", weights, f"{len(kinds)} numbers, one for each of items.kinds")
        good = all(is_number(v) and v >= 0 for v in weights) and is_number(total := sum(weights)) and total > 0
        expect(good, "items.weights", weights, "finite numbers >= 0 that are not all 0")
        self._listed, self._used = len(weights), [i for i, v in enumerate(weights) if v > 0]
        self.sizes = torch.tensor([list(kinds[i]) for i in self._used], dtype=torch.int64)
        self._share = torch.tensor([[weights[i] for i in self._used]], dtype=torch.float64)  # [mixes, K]
        self._edges = self._edges_of(self._share)
        if not grams is max_load is turns is None:
            self.handling = _read_handling(len(kinds), turns, grams, max_load)[self._used]

    @staticmethod
    def _edges_of(share: Tensor) -> Tensor:
        """Return the cumulative frequencies that separate the kinds, one mix after the other, ``[mixes * (K - 1)]``.

        Those of mix ``m`` are shifted by ``m``, so that one search serves all mixes.
        """
        edges = (share.cumsum(1) / share.sum(1, keepdim=True))[:, :-1]
        return (edges + torch.arange(len(edges))[:, None]).flatten()

    def _index(self, uniform, step, mix=None):
        edges = constant_on(self._edges, uniform.device)
        if mix is None:
            return torch.searchsorted(edges[: len(self.sizes) - 1], uniform, right=True)
        # The clamp keeps the number below the next mix, in spite of rounding.
        place = torch.searchsorted(edges, uniform.clamp(max=1 - 2**-32) + mix, right=True)
        return place - mix * (len(self.sizes) - 1)

    def mixed(self, changes: Sequence[Mapping]) -> Self:
        """Return this distribution with further mixes of its kinds, numbered from 1; mix 0 is itself.

        Args:
            changes: for each mix ``weights``, a relative frequency for each kind; or any of ``width``, ``depth`` and
                ``height``, ``[least, greatest]``: only the kinds in these ranges, in the proportions of mix 0.

        Raises:
            ValueError: naming the setting.
        """
        takes_mix = "mix" in signature(self.sample).parameters
        expect(takes_mix, "items", type(self).__name__, "a class with sample(stream, ..., bin_size, mix=None)")
        share = torch.stack([self._share[0], *(self._share_of(change) for change in changes)])
        other = copy(self)
        other.mixes, other._share, other._edges = len(share), share, self._edges_of(share)
        return other

    def _share_of(self, change: Mapping) -> Tensor:
        ranges = {"width": 0, "depth": 1, "height": 2}
        good = isinstance(change, Mapping) and (set(change) == {"weights"} or (change and set(change) <= set(ranges)))
        expect(
            good, "items", change, "{weights: [...]}, or some of {width: [least, greatest], depth: ..., height: ...}"
        )
        if "weights" in change:
            given = Kinds([(1, 1, 1)] * self._listed, change["weights"])  # checks them
            unused = sorted({*given._used} - {*self._used})
            refuse_any(unused, lambda kind: f"items.weights: kind {kind} never arrives in the full task.")
            return torch.tensor([change["weights"][kind] for kind in self._used], dtype=torch.float64)
        share = self._share[0].clone()
        for key, limits in change.items():
            low, high = check_range(f"items.{key}", limits)
            share *= (self.sizes[:, ranges[key]] >= low) & (self.sizes[:, ranges[key]] <= high)
        expect(bool(share.any()), "items", dict(change), "sizes that some kind of the full task has")
        return share

    def arrival_mask(self, mix: int = 0) -> Tensor:
        return self._share[mix] > 0

    def spread(self, seed: Tensor, rank: Tensor, count: int, bin_size, mix: Tensor | None = None) -> Item:
        """Return the ``rank``-th of ``count`` items for each seed, int64 ``[N]``: a systematic sample of the kinds.

        The number of items of each kind is in proportion to its frequency, up to rounding. So with as many items as
        there are equally likely kinds, each kind comes once.
        """
        first = torch.zeros_like(rank)
        start = hashed_uniform("train", seed, torch.full_like(rank, count), first, 1)[0]
        across, along = hashed_uniform("train", seed, rank, first, 2)
        return self.of_kind(self._index((start + rank / count) % 1, first, mix), across, along, bin_size)


class Uniform(Kinds):
    """Cuboids whose sides and heights are drawn uniformly and independently from closed ranges.

    Args:
        width, depth, height: ``(least, greatest)``, in units.
        unit: number of cells, and of height units, in a unit.
    """

    def __init__(self, width=(1, 3), depth=(1, 3), height=(1, 3), unit=1):
        ranges = {"width": width, "depth": depth, "height": height}
        pairs = (check_range(f"items.{name}", limits) for name, limits in ranges.items())
        lengths = [range(low, high + 1) for low, high in pairs]
        words = ", ".join(f"items.{name}={[*limits]}" for name, limits in ranges.items())
        refuse_above(f"{words}: the ranges have", math.prod(map(len, lengths)), "kinds of items", MAX_KINDS)
        whole_number("items.unit", unit, most=MAX_LENGTH)
        super().__init__([tuple(unit * side for side in sides) for sides in product(*lengths)])


def _read_handling(count: int, turns, grams, max_load) -> Tensor:
    """Return the ``handling`` of kinds from a list, or None, for each column; raise ``ValueError`` for other values."""

    def column(key: str, values, default, expected: str, is_good: Callable[[Any], bool]) -> list:
        values = [default] * count if values is None else values
        good = isinstance(values, (list, tuple)) and len(values) == count and all(map(is_good, values))
        expect(good, f"items.{key}", values, f"{count} {expected}, one for each kind")
        return [*values]

    def are_turns(value) -> bool:
        turns = value if isinstance(value, (list, tuple)) else ()
        return value is None or (len(turns) > 0 and all(is_whole(turn) and 0 <= turn < 4 for turn in turns))

    given = column("turns", turns, None, "lists of some of [0, 1, 2, 3], or null", are_turns)
    masks = [ALL_TURNS if each is None else sum(1 << turn for turn in {*each}) for each in given]
    mass = column(
        "grams", grams, 0, f"whole numbers from 0 to {MAX_GRAMS:,}",
        lambda value: is_whole(value) and 0 <= value <= MAX_GRAMS,
    )  # fmt: skip
    loads = column(
        "max_load", max_load, None, "whole numbers of grams >= 0, or null for any load",
        lambda value: value is None or (is_whole(value) and 0 <= value < NO_LIMIT),
    )  # fmt: skip
    loads = [NO_LIMIT if load is None else load for load in loads]
    return torch.tensor([masks, mass, loads]).t().contiguous()


class Recorded(ItemDistribution):
    """A recorded stream: the items of a CSV file in their order; every episode starts at the first row.

    Args:
        path: a file with a header ``w,d,h`` and optionally ``x,y`` (the item's min corner in the bin), one item a row.
            Without ``x,y`` the position is random.
        loop: after the last row start over, instead of ending (truncating) the episode.

    Raises:
        ValueError: a missing file or column, or a value that is not a whole number, naming the line.
    """

    sequential = True

    def __init__(self, path, loop=False):
        flag("items.loop", loop)
        self.path, self._loop = str(path), loop
        header, table = read_table("items.path", self.path, "w,d,h", "w,d,h,x,y")
        for line, row in table:
            whole = all(field.isdecimal() and len(field) < 10 for field in row)
            if len(row) != len(header.split(",")) or not whole or min(map(int, row[:3])) < 1:
                raise ValueError(
                    f"{path}, line {line}: got {excerpt(','.join(row))}, expected {header} as whole numbers with "
                    "w, d, h >= 1 and x, y >= 0."
                )
        self._lines = [line for line, _ in table]
        self.longest_episode = None if loop else len(self._lines)
        numbers = torch.tensor([[int(field) for field in row] for _, row in table])
        self.sizes, self._corner = numbers[:, :3], numbers[:, 3:]
        self.has_corners = self._corner.numel() > 0
        self.varies = not self.has_corners  # with corners, even the places of the items are the same

    def sample(self, stream, seed, episode, step, bin_size, mix=None):
        item = super().sample(stream, seed, episode, step, bin_size, mix)
        if self.has_corners:
            x, y = constant_on(self._corner, step.device)[item.kind].unbind(-1)
            item = item._replace(x=x, y=y)
        return item if self._loop else item.map(lambda part: torch.where(step < len(self.sizes), part, 0))

    def num_items(self, stream: str, seed: Tensor, episode: Tensor) -> Tensor:
        return torch.full_like(episode, 0 if self._loop else len(self.sizes))

    def _index(self, uniform, step, mix=None):
        return step % len(self.sizes)

    def corners(self, kind, bin_size):
        return [tuple(self._corner[kind].tolist())] if self.has_corners else super().corners(kind, bin_size)

    def label(self, kind):
        return f"{self.path}, line {self._lines[kind]}: " + super().label(kind)


def search_items(items: ItemDistribution) -> ItemDistribution:
    """Return the distribution from which a search samples: for a sequence, its sizes with equal probability."""
    if not items.sequential:
        return items
    kinds = Kinds(items.sizes.tolist())
    kinds.handling, kinds.tipped_turns = items.handling, items.tipped_turns
    return kinds
