"""Levels: what the episodes of a level set; and where a run has ladders of them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pickplace.common.errors import unknown_key
from pickplace.common.validate import at_most, expect, integral_number, reworded, short_text
from pickplace.envs.checks import check_items
from pickplace.envs.episode import SETTINGS
from pickplace.items.distributions import ItemDistribution
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import ALL_TURNS

MAX_LEVELS = 1_000

#: What a level may set, and what stands for it in the environment. A mix of ``items`` is numbered.
KEYS = {"tote_height": "tote_height", "items": "item_mix"} | {
    key: key for key in SETTINGS if key not in ("item_mix", "level")
}


class Levels(NamedTuple):
    """The levels of a run, numbered one after the other.

    Attributes:
        first: number of the first level.
        key: entry of an observation that has the number of the episode's level.
        entries: what an episode of each level is given at its reset, by entry: ``[L, width]``.
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
        """What the environment must let vary, see :data:`~pickplace.envs.episode.SETTINGS`."""
        return tuple(key for key in self.entries if key in SETTINGS)


def heights(first: int, last: int, full: int) -> Levels:
    """Return levels that set the height of the tote alone; their numbers are the heights, in height units."""
    return Levels(first, "tote_height", {"tote_height": torch.arange(first, last + 1)[:, None]}, is_full=last == full)


def read_levels(given: Sequence[Mapping], cell: CellSpec, items: ItemDistribution) -> Levels:
    """Return levels that are listed in a config, numbered from 1.

    Args:
        given: of each level what it sets, by a key of :data:`KEYS`; the rest is that of the full task.
        cell, items: of the full task.

    Raises:
        ValueError: naming the level and the key.
    """
    good = isinstance(given, Sequence) and given and all(isinstance(level, Mapping) for level in given)
    expect(good, "curriculum.levels", given, "a list of mappings, such as [{tote_height: 2}, {}]")
    at_most("curriculum.levels: the list has", len(given), "levels", MAX_LEVELS)
    for number, level in enumerate(given):
        for key in level:
            if key not in KEYS:
                raise ValueError(_refusal(f"curriculum.levels[{number}].{short_text(key)}", key))
    mixes: list[Mapping] = []
    rows: list[dict[str, Any]] = []
    for number, level in enumerate(given):
        place = f"curriculum.levels[{number}]"
        row = {"level": number + 1, "tote_height": level.get("tote_height", cell.tote_size[2])}
        integral_number(f"{place}.tote_height", row["tote_height"], 1, cell.tote_size[2])
        if mix := level.get("items"):
            mixes += [mix] * (mix not in mixes)
            row["item_mix"] = mixes.index(mix) + 1
            with _at(place):
                items.mixed([mix])
        named = {key: KEYS[key] for key in level if KEYS[key] in SETTINGS and key != "items"}
        row |= {entry: SETTINGS[entry].read(f"{place}.{key}", level[key], cell) for key, entry in named.items()}
        rows.append(row)
    full = {"tote_height": cell.tote_size[2], **{key: setting.full(cell) for key, setting in SETTINGS.items()}}
    varies = [key for key in full if any(key in row for row in rows)]
    rows = [{key: row.get(key, full[key]) for key in varies} for row in rows]
    items = items.mixed(mixes) if mixes else items
    _check_starts(rows, replace(cell, varies=tuple(key for key in varies if key in SETTINGS)), items)
    numbers = {key: torch.tensor([row[key] for row in rows]) for key in varies}
    entries = {
        key: SETTINGS[key].decode(column, cell) if key in SETTINGS else column[:, None]
        for key, column in numbers.items()
    }
    is_full = all(rows[-1][key] == full[key] for key in varies if key != "level")
    return Levels(1, "level", entries, items, is_full)


def _at(place: str):
    return reworded(ValueError, lambda error: ValueError(f"{place}: {error}"))


def _check_starts(rows: list[dict[str, int]], cell: CellSpec, items: ItemDistribution) -> None:
    """Refuse a level whose episodes could not begin."""
    for row in rows:
        place, mix = f"curriculum.levels[{row['level'] - 1}]", row.get("item_mix", 0)
        tallest, height = items.tallest(mix), row["tote_height"]
        expect(height >= tallest, f"{place}.tote_height", height, f"at least {tallest}, the height of its tallest item")
        with _at(place):
            check_items(cell, items, mix, row.get("rotations", ALL_TURNS))


def _refusal(place: str, key: str) -> str:
    """Return why a level cannot set a key."""
    refused = f"{place}: a level sets {', '.join(KEYS)}"
    if key in ("bin_size", "tote_size", "gripper", "support", "reach", "height_unit"):
        return (
            f"{refused}. {key} stays the same in a run; for another one chain two runs: pickplace-train ... "
            "hydra.run.dir=outputs/first, then pickplace-train ... warm_start.weights=outputs/first."
        )
    return unknown_key(place, {f"{place.rpartition('.')[0]}": 0, **KEYS}, f"{place.rpartition('.')[0]}.")
