"""Item distributions: which item arrives next, and where it lies in its bin.

An item is a counter-based hash of (stream, seed, episode, step), so there is no generator to save, the items do not
depend on the batch size, and every method that plays an episode meets the same ones.
"""

import csv
import io
import math
from itertools import product
from pathlib import Path

import torch
from torch import Tensor

from pickplace.common.files import read_text
from pickplace.common.validate import excerpt, flag, is_number, is_whole
from pickplace.rules.item import Item

#: Families of item streams that never meet: what is trained on, what picks the best checkpoint, what is reported.
STREAMS = ("train", "validation", "test")
MAX_SEED = 2**62  # beyond it, seeds of two families could meet

#: The kinds of items in the paper, (w, d, h).
PAPER_KINDS = ((1, 1, 1), (2, 1, 1), (1, 2, 1), (2, 2, 1))


def check_seed(seed, key: str = "seed") -> int:
    """Return the seed, or raise a ``ValueError`` that names the ``key`` if it is none."""
    if not is_whole(seed) or not 0 <= seed < MAX_SEED:
        raise ValueError(f"{key}={excerpt(seed)}: expected a whole number >= 0 and < 2**62.")
    return int(seed)


def _mix(x: Tensor) -> Tensor:
    """Return int64 counters scrambled (the finalizer of MurmurHash3, Appleby 2011)."""
    for factor in (-0x00AE502812AA7333, -0x3B314601E57A13AD):
        x = x ^ ((x >> 33) & 0x7FFFFFFF)
        x = x * factor
    return x ^ ((x >> 33) & 0x7FFFFFFF)


def hashed_uniform(stream: str, seed: Tensor, episode: Tensor, step: Tensor, count: int) -> Tensor:
    """Return uniform numbers in [0, 1), float64 ``[count, N]``, that depend on the item's address alone."""
    family = STREAMS.index(stream) + 1
    key = seed
    for part in (family, episode, step):
        key = _mix(key * 0x2545F4914F6CDD1D + part + 0x1B873593)
    key = _mix(key + torch.arange(1, count + 1, device=key.device)[:, None] * 0x1E3779B97F4A7C15)
    return ((key >> 11) & ((1 << 53) - 1)).double() / float(1 << 53)


def place_at_random(size: Tensor, across: Tensor, along: Tensor, bin_size, kind: Tensor | None = None) -> Item:
    """Return items of given sizes, int64 ``[N, 3]``, in the bin, at places that two uniform numbers decide, ``[N]``."""
    w, d, h = size.unbind(-1)
    x = (across * (bin_size[0] - w + 1)).long()
    y = (along * (bin_size[1] - d + 1)).long()
    return Item(x, y, w, d, h, kind)


def _is_length(value) -> bool:
    """Return whether a value is a positive whole number that fits the tensors."""
    return is_whole(value) and 1 <= int(value) < 2**31


def check_range(key: str, limits) -> tuple[int, int]:
    """Return ``(least, greatest)``, or raise a ``ValueError`` that names the ``key``."""
    pair = isinstance(limits, (list, tuple)) and len(limits) == 2 and all(map(_is_length, limits))
    if not pair or limits[0] > limits[1]:
        expected = "[least, greatest], whole cells with 1 <= least <= greatest"
        raise ValueError(f"{key}={excerpt(limits)}: expected {expected}.")
    return int(limits[0]), int(limits[1])


def check_count(words: str, count: int) -> None:
    """Refuse more than :data:`MAX_KINDS` kinds; the message begins with ``words``."""
    if count > MAX_KINDS:
        raise ValueError(f"{words} {count:,} kinds of items; expected at most {MAX_KINDS:,}.")


class ItemDistribution:
    """Base class of item distributions.

    Attributes:
        sizes: int64 ``[K, 3]``, every size ``(w, d, h)`` that may arrive, in cells and height units.
        length: number of items in each episode, or None if they never end, or if it differs between episodes.
        varies: whether episodes differ at all.
        sequential: whether an episode is a sequence whose order a search must not know: it samples from ``sizes``.
        has_corners: whether each item has one place in the bin, so that of several items one waits for its place.
    """

    sizes: Tensor
    length: int | None = None
    varies: bool = True
    sequential: bool = False
    has_corners: bool = False

    def sample(self, stream: str, seed: Tensor, episode: Tensor, step: Tensor, bin_size) -> Item:
        """Return the ``step``-th item (from 0) of each ``episode``, int64 ``[N]``; size 0 after the last one."""
        uniform, across, along = hashed_uniform(stream, seed, episode, step, 3)
        kind = self._index(uniform, step)
        return place_at_random(self.sizes.to(step.device)[kind], across, along, bin_size, kind)

    def _index(self, uniform: Tensor, step: Tensor) -> Tensor:
        """Return which row of ``sizes`` arrives, int64 ``[N]``."""
        raise NotImplementedError

    def spread(self, seed: Tensor, rank: Tensor, count: int, bin_size) -> Item:
        """Return the ``rank``-th of ``count`` items for each seed, int64 ``[N]``; here simply independent ones."""
        return self.sample("train", seed, rank, torch.zeros_like(rank), bin_size)

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

    Raises:
        ValueError: an empty list, a size that is not a positive whole number, or weights that do not fit the kinds.
    """

    def __init__(self, kinds, weights=None):
        if not isinstance(kinds, (list, tuple)) or not kinds:
            raise ValueError(f"items.kinds={excerpt(kinds)}: expected a list of at least one (w, d, h).")
        check_count("items.kinds: the list has", len(kinds))
        for kind in kinds:
            if not isinstance(kind, (list, tuple)) or len(kind) != 3 or not all(map(_is_length, kind)):
                raise ValueError(f"items.kinds: got {excerpt(kind)}, expected (w, d, h) in positive whole cells.")
        if weights is None:
            weights = [1.0] * len(kinds)
        if not isinstance(weights, (list, tuple)) or len(weights) != len(kinds):
            raise ValueError(f"items.weights={excerpt(weights)}: expected {len(kinds)} numbers, one for each kind.")
        if not all(is_number(v) and v >= 0 for v in weights) or not is_number(total := sum(weights)) or total <= 0:
            raise ValueError(f"items.weights={excerpt(weights)}: expected finite numbers >= 0 that are not all 0.")
        used = [i for i, v in enumerate(weights) if v > 0]
        self.sizes = torch.tensor([list(kinds[i]) for i in used], dtype=torch.int64)
        share = torch.tensor([weights[i] for i in used], dtype=torch.float64)
        self._edges = (share.cumsum(0) / share.sum())[:-1]

    def _index(self, uniform, step):
        return torch.searchsorted(self._edges.to(uniform.device), uniform, right=True)

    def spread(self, seed: Tensor, rank: Tensor, count: int, bin_size) -> Item:
        """Return the ``rank``-th of ``count`` items for each seed, int64 ``[N]``: a systematic sample of the kinds.

        Each kind is there in proportion to its frequency, up to a whole number. So with as many items as there are
        equally likely kinds each comes once.
        """
        first = torch.zeros_like(rank)
        start = hashed_uniform("train", seed, torch.full_like(rank, count), first, 1)[0]
        across, along = hashed_uniform("train", seed, rank, first, 2)
        kind = self._index((start + rank / count) % 1, first)
        return place_at_random(self.sizes.to(rank.device)[kind], across, along, bin_size, kind)


#: Greatest size of a recorded file, in bytes, and number of kinds: more would fill the memory.
MAX_TEXT, MAX_KINDS = 100_000_000, 100_000


class Uniform(Kinds):
    """Cuboids whose sides and heights are drawn uniformly and independently from closed ranges.

    Args:
        width, depth, height: ``(least, greatest)``, in units.
        unit: number of cells, and of height units, in a unit.
    """

    def __init__(self, width=(1, 3), depth=(1, 3), height=(1, 3), unit=1):
        ranges = {"width": width, "depth": depth, "height": height}
        for name, limits in ranges.items():
            check_range(f"items.{name}", limits)
        words = ", ".join(f"items.{name}={[*limits]}" for name, limits in ranges.items())
        check_count(f"{words}: the ranges have", math.prod(high - low + 1 for low, high in ranges.values()))
        if not _is_length(unit):
            raise ValueError(f"items.unit={excerpt(unit)}: expected a whole number >= 1.")
        sides = ([unit * length for length in range(low, high + 1)] for low, high in ranges.values())
        super().__init__(list(product(*sides)))


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
        self.path = Path(str(path))
        if not self.path.exists():
            raise ValueError(f"items.path={str(path)!r}: no such file; expected a CSV with columns w,d,h (and x,y).")
        try:
            reader = csv.reader(io.StringIO(read_text(path, MAX_TEXT, "utf-8-sig", empty=False), newline=""))
            table = [(reader.line_num, [field.strip() for field in row]) for row in reader]
        except csv.Error as error:
            raise ValueError(f"{path}: {error}; expected a CSV in UTF-8.") from error
        header = table[0][1] if table else []
        if header not in (["w", "d", "h"], ["w", "d", "h", "x", "y"]):
            raise ValueError(f"{path}: the header is {excerpt(','.join(header))}, expected 'w,d,h' or 'w,d,h,x,y'.")
        rows = [self._row(line, row, header) for line, row in table[1:] if any(row)]
        if not rows:
            raise ValueError(f"{path}: no items, expected at least one row below the header.")
        numbers = torch.tensor(rows, dtype=torch.int64)
        self.sizes = numbers[:, :3]
        self._corner = numbers[:, 3:] if len(header) == 5 else None
        self.has_corners = self._corner is not None
        self.varies = not self.has_corners  # else not even where the items lie
        self._lines = [line for line, row in table[1:] if any(row)]
        self._loop = loop
        self.length = None if loop else len(rows)

    def _row(self, line, row, header):
        whole = all(field.isdecimal() and len(field) < 10 for field in row)
        values = [int(field) for field in row] if whole else []
        if len(values) != len(header) or min(values[:3]) < 1:
            raise ValueError(
                f"{self.path}, line {line}: got {excerpt(','.join(row))}, expected {','.join(header)} as whole numbers "
                "with w, d, h >= 1 and x, y >= 0."
            )
        return values

    def sample(self, stream, seed, episode, step, bin_size):
        item = super().sample(stream, seed, episode, step, bin_size)
        if self._corner is not None:
            x, y = self._corner.to(step.device)[item.kind].unbind(-1)
            item = item._replace(x=x, y=y)
        if self.length is None:
            return item
        left = step < self.length
        return item.map(lambda part: torch.where(left, part, 0))

    def _index(self, uniform, step):
        return step % len(self.sizes) if self._loop else step.clamp(max=len(self.sizes) - 1)

    def corners(self, kind, bin_size):
        if self._corner is None:
            return super().corners(kind, bin_size)
        return [tuple(self._corner[kind].tolist())]

    def label(self, kind):
        return f"{self.path}, line {self._lines[kind]}: " + super().label(kind)


def search_items(items: ItemDistribution) -> ItemDistribution:
    """Return the distribution that a search samples from: of a sequence only its sizes, equally likely."""
    return Kinds(items.sizes.tolist()) if items.sequential else items
