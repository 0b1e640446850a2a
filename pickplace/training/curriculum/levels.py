"""Levels of a curriculum: the settings of their episodes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.common.validate import expect, refuse_above, reword_errors
from pickplace.envs.checks import check_items
from pickplace.envs.episode import RESET_ENTRIES, SETTINGS
from pickplace.items.distributions import ItemDistribution
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import ALL_TURNS
from pickplace.training.curriculum.keys import check_keys

MAX_LEVELS = 1_000


class Levels(NamedTuple):
    """The levels of a run, numbered one after the other.

    Attributes:
        first: number of the first level.
        key: entry of an observation that has the number of the episode's level.
        entries: values that episodes of each level get at a reset, by entry: ``[L, width]``.
        items: the item distribution with the mixes of the levels; None: that of the run.
        is_full: whether the last level is the full task.
    """

    first: int
    key: str
    entries: dict[str, Tensor]
    items: ItemDistribution | None = None
    is_full: bool = True

    @property
    def last(self) -> int:
        """Number of the last level."""
        return self.first + len(self.entries[self.key]) - 1

    @property
    def varies(self) -> tuple[str, ...]:
        """Settings in which episodes of the environment may differ, see :data:`~pickplace.envs.episode.SETTINGS`."""
        return tuple(key for key in self.entries if key in SETTINGS)


def heights(first: int, last: int, full: int) -> Levels:
    """Return levels that set the height of the tote alone; their numbers are the heights, in height units."""
    return Levels(first, "tote_height", {"tote_height": torch.arange(first, last + 1)[:, None]}, is_full=last == full)


def read_levels(given: Sequence[Mapping], cell: CellSpec, items: ItemDistribution) -> Levels:
    """Return levels that are listed in a config, numbered from 1.

    Args:
        given: settings of each level, see :mod:`pickplace.training.curriculum.keys`; the rest is that of the full task.
        cell, items: of the full task.

    Raises:
        ValueError: naming the level and the key.
    """
    good = isinstance(given, Sequence) and given and all(isinstance(level, Mapping) for level in given)
    expect(good, "curriculum.levels", given, "a list of mappings, such as [{tote_height: 2}, {}]")
    refuse_above("curriculum.levels: the list has", len(given), "levels", MAX_LEVELS)
    check_keys(given)
    places = [f"curriculum.levels[{number}]" for number in range(len(given))]
    mixes: list[Mapping] = []
    rows: list[dict[str, int]] = []
    for place, level in zip(places, given, strict=True):
        row = {"tote_height": cell.tote_size[2], "level": len(rows) + 1}
        for key, value in level.items():
            if key == "items":  # the environment gets the number of the mix
                with _prefixed(place):
                    items.mixed([value])
                mixes += [value] * (value not in mixes)
                row["item_mix"] = mixes.index(value) + 1
            else:
                row[key] = RESET_ENTRIES[key].read(f"{place}.{key}", value, cell)
        rows.append(row)
    items = items.mixed(mixes) if mixes else items
    full = {key: entry.full(cell) for key, entry in RESET_ENTRIES.items() if any(key in row for row in rows)}
    rows = [full | row for row in rows]
    cell, checked = replace(cell, varies=tuple(key for key in full if key in SETTINGS)), set()
    for place, row in zip(places, rows, strict=True):
        mix, turns = start = row.get("item_mix", 0), row.get("rotations", ALL_TURNS)
        tallest, height = items.tallest(mix), row["tote_height"]
        expect(height >= tallest, f"{place}.tote_height", height, f"at least {tallest}, the height of its tallest item")
        if start not in checked:
            with _prefixed(place):
                check_items(cell, items, mix, turns)
        checked.add(start)
    entries = {key: RESET_ENTRIES[key].decode(torch.tensor([row[key] for row in rows]), cell) for key in full}
    return Levels(1, "level", entries, items, is_full=all(rows[-1][key] == full[key] for key in full if key != "level"))


def _prefixed(place: str):
    """Add the place of a level to an error."""
    return reword_errors(ValueError, lambda error: ValueError(f"{place}: {error}"))
