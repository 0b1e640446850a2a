"""Orders: an episode is an order of a file, or a new one, drawn from the lines of these."""

import math
from collections.abc import Sequence
from itertools import groupby

import torch
from torch import Tensor

from pickplace.common.validate import expect, flag, is_name, number, one_of, refuse_above, refuse_if
from pickplace.items.distributions import MAX_KINDS, MAX_LENGTH, ItemDistribution, hashed_uniform
from pickplace.items.kept import EpisodeCache
from pickplace.items.order_file import MILLIMETRES, OrderItem, read_orders

#: Shares of the orders for validation and test; the others are for training. Each stream has at least one.
SHARES = {"validation": 0.1, "test": 0.2}
ROUNDING = 1e-6  # of a cell: three cells of 0.05 m are not exactly 0.15 m in binary fractions


class Orders(ItemDistribution):
    """The orders of a file: an episode is one order, and its items arrive in the order's sequence.

    Train, validation and test have different orders, by a random split that is always the same; or test has all. An
    order that is in the file twice counts once. Validation and test play each of their orders once.

    Sides are rounded up to whole cells and height units; :attr:`volumes` has the true volumes.

    Args:
        path: the file, see :func:`~pickplace.items.order_file.read_orders`.
        cell_size: side of a cell, m.
        height_unit: unit of heights, in cells.
        unit: unit of lengths in the file that have none in the header, ``"mm"``, ``"cm"`` or ``"m"``.
        generate: train with new orders, drawn from the lines of the training orders. A line is a run of one article; it
            is as early or late as in its own order. False: train with the orders as they are.
        target: only the orders for this target, see :func:`~pickplace.items.order_file.read_orders`; None: all.
        split: False: test has all orders, and there are none for training and validation.

    Attributes:
        volumes: float64 ``[K]``, the true volume of each kind, in cells times height units.

    Raises:
        ValueError: for a file that cannot be used, or with too few orders to split.
    """

    sequential = True

    def __init__(
        self, path, cell_size, height_unit: float = 1.0, unit: str = "mm", generate: bool = True,
        target: str | None = None, split: bool = True,
    ):  # fmt: skip
        refuse_if(
            cell_size is None,
            "items.cell_size=null: expected the side of a cell in metres, such as env.cell_size=0.02.",
        )
        self._cell = 1000 * number("items.cell_size", cell_size, 1e-4, 10, "metres")
        self._unit = self._cell * number("items.height_unit", height_unit, 1e-3, 1000, "cells")
        expect(target is None or is_name(target), "items.target", target, "a name in the file, such as euro-pallet")
        orders = read_orders(path, one_of("items.unit", unit, MILLIMETRES), target=target)
        self.generate = flag("items.generate", generate)
        kinds: dict[tuple, int] = {}
        self._examples: list[OrderItem] = []  # of each kind
        numbered = [[self._number(item, kinds) for item in order.items] for order in orders]
        distinct = list(dict.fromkeys(map(tuple, numbered)))
        alike: dict[tuple, list[tuple[int, ...]]] = {}  # orders with the same sizes, in any sequence
        for order in distinct:
            alike.setdefault(tuple(sorted(self._examples[kind][1:4] for kind in order)), []).append(order)
        refuse_if(
            flag("items.split", split) and len(alike) < 3,
            f"items.path={str(path)!r}: the file has {len(alike)} orders of different sizes; expected three at least, "
            "for train, validation and test, or items.split=false, which tests with all orders.",
        )
        refuse_above(f"items.path={str(path)!r}: the file has", len(kinds), "kinds of items", MAX_KINDS)
        self.sizes = torch.tensor([self.cells(item) for item in self._examples])
        columns = [(item.turns, item.grams, item.max_load) for item in self._examples]
        self.handling = torch.tensor(columns)
        self.tipped_turns = torch.tensor([item.tipped_turns for item in self._examples])
        self.longest_episode = max(map(len, distinct))
        sides = torch.tensor([item[1:4] for item in self._examples], dtype=torch.float64)
        self.volumes = sides.prod(1) / (self._cell**2 * self._unit)
        self._orders = _split([*alike.values()]) if split else {"train": [], "validation": [], "test": distinct}
        self._lines = _Lines(self._orders["train"] or distinct)
        self._kept = EpisodeCache(self._play, max(1, 2**22 // self._lines.most))

    def _number(self, item: OrderItem, kinds: dict) -> int:
        """Return the number of an item's kind: its sides, weight, greatest load and orientations."""
        refuse_if(
            not item.turns,
            f"{item.place}: orientations={' '.join(item.orientations)}: expected lwh or wlh among them; with "
            "items=orders each item must be able to stand upright.",
        )
        kind = kinds.setdefault(item.kind, len(kinds))
        if kind == len(self._examples):
            self._examples.append(item)
        return kind

    def cells(self, item: OrderItem) -> tuple[int, int, int]:
        """Return the sides of an item in cells and height units, rounded up."""
        units = (self._cell, self._cell, self._unit)
        w, d, h = (max(1, math.ceil(side / unit - ROUNDING)) for side, unit in zip(item[1:4], units, strict=True))
        refuse_if(
            max(w, d, h) > MAX_LENGTH, f"{item.place}: {w} x {d} x {h} cells; expected at most {MAX_LENGTH:,} each."
        )
        return w, d, h

    def num_episodes(self, stream: str) -> int | None:
        return None if stream == "train" else len(self._orders[stream])

    def num_items(self, stream, seed, episode):
        return torch.tensor([*map(len, self._kept.sequences(stream, seed, episode))], device=episode.device)

    def sample(self, stream, seed, episode, step, bin_size, mix=None):
        kind = torch.tensor(self._kept.step_elements(stream, seed, episode, step, end=-1), device=step.device)
        _, across, along = hashed_uniform(stream, seed, episode, step, 3)
        item = self.of_kind(kind, across, along, bin_size)
        return item.map(lambda part: torch.where(kind >= 0, part, 0))

    def _play(self, stream: str, seed: Tensor, episode: Tensor) -> Sequence[Sequence[int]]:
        """Return the kinds that arrive in each of some episodes, int64 ``[E]``, in their order."""
        orders = self._orders[stream]
        refuse_if(
            not orders, f"items.split=false: all orders are to test on; expected true, to have some for {stream}."
        )
        if stream != "train":
            return [orders[number % len(orders)] for number in episode.tolist()]
        if self.generate:
            return self._lines.draw(seed, episode)
        drawn = hashed_uniform(stream, seed, episode, torch.full_like(episode, -1), 1)[0]
        return [orders[number] for number in (drawn * len(orders)).long().tolist()]

    def label(self, kind: int) -> str:
        item = self._examples[kind]
        return f"{item.place}: {super().label(kind)}, {item.length:g} x {item.width:g} x {item.height:g} mm,"


class _Lines:
    """Orders drawn from the lines of others.

    A line is a run of one article. It has a place in its order, from 0 at the beginning to 1.
    """

    def __init__(self, orders: Sequence[Sequence[int]]):
        lines = []
        for order in orders:
            start = 0
            for kind, run in groupby(order):
                count = len(list(run))
                lines.append((kind, count, start / len(order)))
                start += count
        kinds, counts, places = zip(*lines, strict=True)
        self.kinds, self.counts = torch.tensor(kinds), torch.tensor(counts)
        self.places = torch.tensor(places, dtype=torch.float64)
        self.lengths = torch.tensor([len(order) for order in orders])
        self.most = int(self.lengths.max())

    def draw(self, seed: Tensor, episode: Tensor) -> list[list[int]]:
        """Return the kinds of an order for each episode, int64 ``[E]``."""
        # Below 0: the steps from 0 decide where the items lie in the bin.
        numbers = torch.arange(-1, -2 - self.most, -1).repeat(len(episode))
        seed, episode = (part.repeat_interleave(self.most + 1) for part in (seed, episode))
        uniform = hashed_uniform("train", seed, episode, numbers, 1).view(-1, self.most + 1)
        length = self.lengths[(uniform[:, :1] * len(self.lengths)).long()]
        line = (uniform[:, 1:] * len(self.kinds)).long()  # as many as may be needed: each has at least one item
        counts = self.counts[line]
        taken = torch.minimum(counts, (length - counts.cumsum(1) + counts).clamp(min=0))
        rank = torch.where(taken > 0, self.places[line], torch.inf).argsort(dim=1, stable=True)
        rows = zip(self.kinds[line].gather(1, rank), taken.gather(1, rank), strict=True)
        return [kinds.repeat_interleave(count).tolist() for kinds, count in rows]


def _split(groups: Sequence[Sequence[Sequence[int]]]) -> dict[str, list[Sequence[int]]]:
    """Return the orders for training, validation and test; a group of orders that are alike stays together."""
    zeros = torch.zeros(len(groups), dtype=torch.int64)
    numbers = hashed_uniform("train", zeros, zeros, torch.arange(len(groups)), 1)[0].argsort().tolist()
    parts, start = {}, 0
    for name, share in SHARES.items():
        stop = start + max(1, round(share * len(groups)))
        parts[name], start = numbers[start:stop], stop
    parts["train"] = numbers[start:]
    return {name: [order for number in part for order in groups[number]] for name, part in parts.items()}
