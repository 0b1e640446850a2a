"""Individual planning by heuristics: the pick is decided first, and without a look at the tote."""

import torch
import torch.nn.functional as F
from torch import Tensor

from pickplace.common.validate import one_of
from pickplace.planners.base import MapPlanner, pick_first, restrict_items
from pickplace.planners.heuristics import dbl_order
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import PICKS, all_grasps, join_pick
from pickplace.rules.item import Observation
from pickplace.rules.maps import FAR
from pickplace.rules.masks import PlacingMaps
from pickplace.rules.state import State

CANDIDATES = ("corners", "cells")


class IndividualHeuristic(MapPlanner):
    """A pick that does not look at the tote, then deepest-bottom-left over the corners of the tote's free rectangles.

    A candidate is a footprint in a corner of a maximal rectangle (MaxRects, Jylanki 2010) of the cells that are not
    higher than the level on which the item would rest; the first in the order (top, footprint y, footprint x) that
    succeeds in a forward simulation is played, ties by the lowest flat index. If none does, the first is played, and
    fails.

    Of several items in the bin it takes the first that can be picked.

    Args:
        cell: the sizes.
        candidates: ``"corners"``, or ``"cells"`` for every footprint.
        item: which item is the first: ``"first"``, the one that arrived first, or ``"nearest"``, the one nearest to the
            bin's origin.
        pick: which pick of it: ``"least_offset"``, the paper's (:func:`~pickplace.rules.grasps.heuristic_pick`), or
            ``"middle"``, the one nearest to the middle of the item.
    """

    name = "individual_heuristic"

    def __init__(self, cell: CellSpec, candidates: str = "corners", item: str = "first", pick: str = "least_offset"):
        self.cell, self.candidates = cell, one_of("planner.candidates", candidates, CANDIDATES)
        self.item = one_of("planner.item", item, ("first", "nearest"))
        self.pick = one_of("planner.pick", pick, PICKS)

    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        lifted = all_grasps(cell, maps.item, maps.blocked)[0]  # [N * M, P]
        lifted = restrict_items(self.item, state, lifted.reshape(len(state.surface), -1))
        number = lifted.unflatten(1, (maps.bin_items, -1)).any(2).int().argmax(1)
        maps, _ = maps.of_choice(cell, number * cell.num_footprints)
        pick, footprint, succeeds = pick_first(cell, maps, self.pick)
        allowed, footprint = footprint >= 0, footprint.clamp(min=0)
        if self.candidates == "corners":
            allowed &= corner_footprints(cell, state.heights, maps).flatten(1).gather(1, footprint)
        order = dbl_order(cell, maps.top).flatten(1).gather(1, footprint)
        # Those that succeed, in order; then those that fail, in order; ties by the lowest flat index.
        order = torch.where(allowed, order + FAR * ~(succeeds & allowed) * cell.num_places, FAR**2)
        return join_pick(cell, pick, order.argmin(1))


def corner_footprints(cell: CellSpec, heights: Tensor, maps: PlacingMaps) -> Tensor:
    """Return which footprints lie in a corner of a maximal free rectangle of their level, bool ``[N, Q, W_T, D_T]``.

    Free on a level are the cells that are not higher than it; a footprint's level is the height on which it rests.

    Args:
        heights: int32 ``[N, W_T, D_T]``.
        maps: of this state; footprints on which the item cannot rest are in no corner.
    """
    top, item = maps.top, maps.item
    found = torch.zeros_like(top, dtype=torch.bool)
    level = top - item.h[:, None, None, None]
    sides = item.w[:, None, None], item.d[:, None, None]
    for z in level[top >= 0].unique().tolist():
        free = heights <= z
        for parity, (w, d) in enumerate((sides, sides[::-1])[: cell.parities]):
            on_level = (level[:, parity] == z) & (top[:, parity] >= 0)
            for axes in ((), (1,), (2,), (1, 2)):
                # The corner at which both coordinates are least, after flipping the tote.
                corner = _least_corners(free.flip(axes), w, d).flip(axes)
                for axis in axes:  # from the footprint's last cell to its first
                    corner = _shift(corner, axis, (w, d)[axis - 1] - 1)
                found[:, parity] |= corner & on_level
    return found


def _least_corners(free: Tensor, w: Tensor, d: Tensor) -> Tensor:
    """Return the cells at which a maximal rectangle of free cells, at least ``w x d``, begins, bool ``[N, W, D]``."""
    tote_w, tote_d = free.shape[1:]
    x = torch.arange(tote_w, device=free.device)[:, None]
    # How many cells are free from each one on along x; the same in the row before; is the cell before it not free?
    run = torch.where(free, tote_w, x).flip(1).cummin(1).values.flip(1) - x
    before = F.pad(run[:, :, :-1], (1, 0))
    blocked_left = F.pad(~free[:, :-1], (0, 0, 1, 0), value=True)
    # Of the rectangles that begin at a cell, the widest of every depth; each is maximal if no side can move outwards.
    corner, width, closed = torch.zeros_like(free), run, blocked_left
    for depth in range(1, tote_d + 1):
        longer = torch.minimum(width, F.pad(run[:, :, depth:], (0, depth)))  # the width that one row more would leave
        fits = (width >= w) & (d <= depth)
        corner |= fits & closed & (before < width) & (longer < width) & (width > 0)
        width, closed = longer, closed | F.pad(blocked_left[:, :, depth:], (0, depth))
    return corner


def _shift(maps: Tensor, axis: int, by: Tensor) -> Tensor:
    """Return maps ``[N, W, D]`` shifted towards 0 along an axis, by ``[N, 1, 1]`` cells; zeros come in."""
    size = maps.shape[axis]
    cell = torch.arange(size, device=maps.device).view(*[-1 if a == axis else 1 for a in range(3)])
    source = (cell + by).expand_as(maps)
    return maps.gather(axis, source.clamp(max=size - 1)) & (source < size)
