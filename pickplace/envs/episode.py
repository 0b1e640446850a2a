"""Episode settings, in which episodes of one environment may differ besides the height of the tote.

Each is a whole number for each problem. A curriculum, or ``options`` of Gymnasium, gives it with a reset; an episode
keeps it to its end. Settings that are not given are those of the full task. A TorchRL rollout that resets itself passes
on the entries of the episode that ended, so that the next one has the same settings.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from pickplace.common.validate import expect, integral_number, is_whole, one_of, reword_errors
from pickplace.items.distributions import ItemDistribution
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import flags_from_turns, turns_from_flags
from pickplace.rules.observation import MAX_NUMBER
from pickplace.rules.state import REFILLS


class Setting(NamedTuple):
    """One setting.

    Attributes:
        field: its name in an :class:`~pickplace.rules.state.EpisodeSettings`.
        full: ``full(cell)``, its number in the full task.
        limits: ``limits(cell, items)``, the least and the greatest number.
        read: ``read(key, value, cell)``, the number that stands for a value in a config; ``ValueError`` for a bad one.
        encode: from an entry of an observation, ``[N, ...]``, to numbers, int64 ``[N]``.
        decode: ``decode(numbers, cell)``, the inverse of ``encode``.
    """

    field: str
    full: Callable[[CellSpec], int]
    limits: Callable[[CellSpec, ItemDistribution], tuple[int, int]]
    read: Callable[[str, Any, CellSpec], int]
    encode: Callable[[Tensor], Tensor] = lambda entry: entry.reshape(-1)
    decode: Callable[[Tensor, CellSpec], Tensor] = lambda numbers, cell: numbers[:, None]


def _read_rotations(key: str, value: Any, cell: CellSpec) -> int:
    turns = range(value) if is_whole(value) and 1 <= value <= cell.rotations else value
    good = (
        isinstance(turns, Sequence) and turns and all(is_whole(turn) and 0 <= turn < cell.rotations for turn in turns)
    )
    most = cell.rotations
    expect(
        good, key, value, f"how many quarter turns, 1 to {most} (env.rotations), or a list of some of {[*range(most)]}"
    )
    return sum(1 << turn for turn in set(turns))


def _read_up_to(most: Callable[[CellSpec], int], origin: str, least: int = 1) -> Callable[[str, Any, CellSpec], int]:
    """Return a function that reads a whole number from ``least`` to a limit of the cell."""

    def read(key: str, value: Any, cell: CellSpec) -> int:
        with reword_errors(ValueError, lambda error: ValueError(f"{str(error).rstrip('.')}, {origin}.")):
            return integral_number(key, value, least, most(cell))

    return read


#: The settings, by the names of their entries in an observation.
SETTINGS: dict[str, Setting] = {
    "rotations": Setting(
        "turns", lambda cell: 2**cell.rotations - 1, lambda cell, items: (1, 2**cell.rotations - 1), _read_rotations,
        turns_from_flags, lambda numbers, cell: flags_from_turns(numbers, cell.rotations),
    ),
    "bin_items": Setting(
        "bin_items", lambda cell: cell.bin_items, lambda cell, items: (1, cell.bin_items),
        _read_up_to(lambda cell: cell.bin_items, "env.bin_items"),
    ),
    "refill": Setting(
        "refill", lambda cell: REFILLS.index(cell.refill), lambda cell, items: (0, len(REFILLS) - 1),
        lambda key, value, cell: REFILLS.index(one_of(key, value, REFILLS)),
    ),
    "preview": Setting(
        "preview", lambda cell: cell.preview, lambda cell, items: (0, cell.preview),
        _read_up_to(lambda cell: cell.preview, "env.preview", 0),
    ),
    "item_mix": Setting(
        "item_mix", lambda cell: 0, lambda cell, items: (0, items.mixes - 1),
        lambda key, value, cell: integral_number(key, value, 0, MAX_NUMBER),
    ),
    "level": Setting(
        "level", lambda cell: 0, lambda cell, items: (0, MAX_NUMBER),
        lambda key, value, cell: integral_number(key, value, 0, MAX_NUMBER),
    ),
}  # fmt: skip

#: The entries that a reset accepts: the height of the tote, in which episodes may always differ, and the settings.
RESET_ENTRIES: dict[str, Setting] = {
    "tote_height": Setting(
        "tote_height", lambda cell: cell.tote_size[2],
        lambda cell, items: (min(map(items.tallest, range(items.mixes))), cell.tote_size[2]),
        _read_up_to(lambda cell: cell.tote_size[2], "env.tote_size[2]"),
    ),
    **SETTINGS,
}  # fmt: skip
