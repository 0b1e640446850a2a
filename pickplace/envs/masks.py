"""The masks that an environment can emit, and their computation."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.rules.cell import CellSpec
from pickplace.rules.corners import corner_mask
from pickplace.rules.masks import PlacingMaps, action_mask, choice_mask, placing_maps
from pickplace.rules.state import State

CACHE_BYTES = 64 * 2**20  # of masks kept for the beginnings of episodes


class Mask(NamedTuple):
    """A mask that the environment can emit, bool ``[N, size]``."""

    size: Callable[[CellSpec], int]
    make: Callable[[CellSpec, PlacingMaps], Tensor]


MASKS = {
    "action": Mask(lambda cell: cell.num_actions, action_mask),
    "footprint": Mask(lambda cell: cell.num_choices, choice_mask),
    "corner": Mask(lambda cell: cell.num_choices, lambda cell, maps: maps.join(corner_mask(cell, maps))),
}


class MaskMaker:
    """Makes masks of states.

    Args:
        cell: the sizes.
        names: the masks, of :data:`MASKS`; without any, ``"footprint"``, from which one sees whether a state goes on.
    """

    def __init__(self, cell: CellSpec, names: Sequence[str]):
        self.cell, self.names = cell, tuple(names) or ("footprint",)
        self._starts: dict[tuple, tuple[Tensor, ...]] = {}

    def of(self, state: State) -> dict[str, Tensor]:
        """Return the masks of ``M`` problems, bool ``[M, size]``, by their names."""
        maps = placing_maps(self.cell, state)
        return {name: MASKS[name].make(self.cell, maps) for name in self.names}

    def of_empty_totes(self, state: State) -> dict[str, Tensor]:
        """Return the same as :meth:`of`, on a CPU, from a cache: episodes begin in few different states."""
        item, tote_height = state.items.table.flatten(1), state.tote_height[:, None]
        keys = [tuple(key) for key in torch.cat([item, tote_height], 1).tolist()]
        if unseen := {key: row for row, key in enumerate(keys) if key not in self._starts}:
            rows = torch.tensor(list(unseen.values()))
            masks = self.of(state.rows(rows))
            if len(self._starts) * sum(mask.shape[1] for mask in masks.values()) > CACHE_BYTES:
                self._starts = {key: self._starts[key] for key in keys if key in self._starts}
            # Copies, since a view would keep all of its batch in memory.
            parts = zip(*([row.clone() for row in mask] for mask in masks.values()), strict=True)
            self._starts.update(zip(unseen, parts, strict=True))
        columns = zip(*(self._starts[key] for key in keys), strict=True)
        return dict(zip(self.names, map(torch.stack, columns), strict=True))
