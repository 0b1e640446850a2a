"""Corner-occupying placements: the few footprints that are worth considering where the grid is fine.

A footprint occupies a corner if the item there can slide on neither along x nor along y: in one direction of each axis,
one step further would raise it, or something would be hit: the tote, or the end effector would hit what is beside the
item. Of hundreds of feasible footprints some dozens do. Among them are the bottom-left-stable ones, where both
directions are those to the tote's first corner (Zhao, Bennell, Bektas and Dowsland 2016, "A comparative review of 3D
container loading algorithms", have both terms).
"""

from torch import Tensor

from pickplace.rules.cell import CellSpec
from pickplace.rules.maps import FAR
from pickplace.rules.masks import PlacingMaps, footprint_mask


def corner_mask(cell: CellSpec, maps: PlacingMaps) -> Tensor:
    """Return the feasible footprints that occupy a corner, bool ``[N, Q, W_T, D_T]``; some, if any is feasible.

    Where none of them is stable, an unstable footprint a step further counts as blocked, too. Then there is one:
    whatever is feasible slides on until it is there.

    Args:
        cell: the sizes.
        maps: what decides which actions succeed.
    """
    feasible = footprint_mask(cell, maps)
    top = maps.rest + maps.item.h.to(maps.rest.dtype).view(-1, 1, 1, 1)
    mask = feasible & _in_corner(maps, footprint_mask(cell, maps._replace(top=top)))
    bare = feasible.flatten(1).any(1) & ~mask.flatten(1).any(1)
    if bare.any():
        mask[bare] = feasible[bare] & _in_corner(maps, feasible)[bare]
    return mask


def _in_corner(maps: PlacingMaps, free: Tensor) -> Tensor:
    """Return where a step along x and one along y would raise the item, or end on a footprint that is not free."""
    rest, level = maps.rest, maps.rest + maps.level_step
    before_x, after_x, before_y, after_y = (
        (_neighbours(rest, axis, step, FAR) > level) | ~_neighbours(free, axis, step, False)
        for axis in (2, 3)
        for step in (-1, 1)
    )
    return (before_x | after_x) & (before_y | after_y)


def _neighbours(maps: Tensor, axis: int, step: int, beyond) -> Tensor:
    """Return for each footprint the value of the one a step further along an axis; ``beyond`` outside the grid."""
    moved = maps.roll(-step, axis)
    moved.select(axis, -1 if step > 0 else 0).fill_(beyond)
    return moved
