"""Published sequences of items, on which papers test: read from a user's own copy of the authors' file."""

import io
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from pickplace.common.capture import constant_on
from pickplace.common.files import MAX_TABLE_BYTES, read_file
from pickplace.common.validate import (
    excerpt,
    expect,
    is_whole,
    or_null,
    refuse_above,
    refuse_if,
    reword_errors,
    size_tuple,
)
from pickplace.items.distributions import MAX_KINDS, MAX_LENGTH, ItemDistribution, hashed_uniform, place_at_random

MAX_ITEMS = 2_000_000  # of a file
EXPECTED = "a list of sequences of items [w, d, h], as .json, or as the .pt of the authors"


def published(drawn: ItemDistribution, path=None, end=None) -> ItemDistribution:
    """Return the items of a paper: with a file, its sequences on the test stream; drawn items elsewhere.

    Args:
        drawn: the distribution for training and validation, and for tests without a file.
        path: the file, see :func:`read_sequences`; None: there is none.
        end: see :func:`read_sequences`.

    Raises:
        ValueError: for a file that cannot be used.
    """
    good = isinstance(drawn, ItemDistribution)
    expect(good, "items.drawn", drawn, "an item distribution, such as {_target_: uniform, width: [2, 5]}")
    end = or_null(size_tuple, "items.end", end, 3, MAX_LENGTH)
    return drawn if path is None else Published(drawn, path, end)


class Published(ItemDistribution):
    """The sequences of a file on the test stream, and the items of another distribution on the others.

    The test stream has an episode for each sequence, whatever the seed. A search samples from the other distribution,
    and does not know the sequences.

    For the arguments see :func:`published`.
    """

    def __init__(self, drawn: ItemDistribution, path, end: Sequence[int] | None = None):
        self.drawn, self.path = drawn, str(path)
        self.sequential, self.mixes = drawn.sequential, drawn.mixes
        sequences = read_sequences(path, end)
        sizes = [tuple(size) for size in drawn.sizes.tolist()]
        kinds = {size: kind for kind, size in reversed([*enumerate(sizes)])}
        self._first: dict[int, str] = {}  # place in the file of kinds that are not drawn
        numbers = []
        for row, sequence in enumerate(sequences, start=1):
            for column, size in enumerate(sequence, start=1):
                if size not in kinds:
                    kinds[size] = len(sizes)
                    self._first[len(sizes)] = f"{self.path}, sequence {row}, item {column}"
                    sizes.append(size)
                numbers.append(kinds[size])
        refuse_above(f"{path}: the file and the drawn items have", len(sizes), "kinds of items", MAX_KINDS)
        self.sizes, self._kinds = torch.tensor(sizes), torch.tensor(numbers)
        self._lengths = torch.tensor([*map(len, sequences)])
        self._starts = self._lengths.cumsum(0) - self._lengths

    def num_episodes(self, stream):
        return len(self._lengths) if stream == "test" else self.drawn.num_episodes(stream)

    def num_items(self, stream, seed, episode):
        if stream != "test":
            return self.drawn.num_items(stream, seed, episode)
        return constant_on(self._lengths, episode.device)[episode % len(self._lengths)]

    def sample(self, stream, seed, episode, step, bin_size, mix=None):
        if stream != "test":
            return self.drawn.sample(stream, seed, episode, step, bin_size, **self.mix_arguments(mix))
        device, number = step.device, episode % len(self._lengths)
        left = constant_on(self._lengths, device)[number] - step
        index = torch.where(left > 0, constant_on(self._starts, device)[number] + step, 0)
        kind = torch.where(left > 0, constant_on(self._kinds, device)[index], -1)
        _, across, along = hashed_uniform(stream, seed, episode, step, 3)
        item = place_at_random(constant_on(self.sizes, device)[kind], across, along, bin_size, kind)
        return item.map(lambda part: torch.where(kind >= 0, part, 0))

    def mixed(self, changes):
        other = object.__new__(Published)
        other.__dict__ |= self.__dict__ | {"drawn": (drawn := self.drawn.mixed(changes)), "mixes": drawn.mixes}
        return other

    def arrival_mask(self, mix=0):
        return torch.cat([self.drawn.arrival_mask(mix), torch.ones(len(self._first), dtype=torch.bool)])

    def spread(self, seed, rank, count, bin_size, mix=None):
        return self.drawn.spread(seed, rank, count, bin_size, **self.mix_arguments(mix))

    def label(self, kind):
        known = kind not in self._first
        return self.drawn.label(kind) if known else f"{self._first[kind]}: {super().label(kind)}"


def read_sequences(path, end: Sequence[int] | None = None) -> list[list[tuple[int, int, int]]]:
    """Return the sequences of a file, each the sizes of its items ``(w, d, h)``, in cells and height units.

    Args:
        path: JSON, ``[[[w, d, h], ...], ...]``; or ``.pt``, the same as a file of torch's, which the authors publish.
        end: size of the item that ends each sequence of the authors' files; it is left out.

    Raises:
        ValueError: naming the file, and the line, or the sequence and the item, that cannot be used.
    """
    expect(os.path.exists(str(path)), "items.path", str(path), f"a file, {EXPECTED}")
    path = Path(path)
    rows = _load(path, read_file(path, MAX_TABLE_BYTES, empty=False))
    refuse_if(not _is_list(rows), f"{path}: got {excerpt(rows)}, expected {EXPECTED}.")
    sequences, total = [], 0
    for number, row in enumerate(rows, start=1):
        place = f"{path}, sequence {number}"
        refuse_if(not _is_list(row), f"{place}: got {excerpt(row)}, expected a list of items [w, d, h].")
        sequence = [_size(f"{place}, item {column}", size) for column, size in enumerate(row, start=1)]
        if end is not None and sequence and sequence[-1] == tuple(end):
            del sequence[-1]
        refuse_if(not sequence, f"{place}: no items, expected at least one.")
        refuse_above(f"{path}:", total := total + len(sequence), "items", MAX_ITEMS)
        sequences.append(sequence)
    refuse_if(not sequences, f"{path}: no sequences, expected at least one.")
    return sequences


def _load(path: Path, content: bytes) -> Any:
    """Return the content of a file; from a ``.pt`` only plain data, as it could run any code otherwise."""
    if path.suffix.lower() == ".pt":
        with reword_errors(
            Exception, lambda error: ValueError(f"{path}: it is not read by torch; expected {EXPECTED}.")
        ):
            return torch.load(io.BytesIO(content), weights_only=True)
    with reword_errors(
        (ValueError, RecursionError),
        lambda error: ValueError(
            f"{path}, line {getattr(error, 'lineno', 1)}: {getattr(error, 'msg', error)}; expected {EXPECTED}."
        ),
    ):
        return json.loads(content)


def _is_list(value) -> bool:
    return isinstance(value, (list, tuple))


def _size(place: str, size) -> tuple[int, int, int]:
    good = _is_list(size) and len(size) == 3 and all(is_whole(side) and 1 <= side <= MAX_LENGTH for side in size)
    refuse_if(not good, f"{place}: got {excerpt(size)}, expected [w, d, h] in whole cells, each 1 or more.")
    return (size[0], size[1], size[2])
