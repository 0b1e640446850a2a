"""Corners: the feasible footprints that a search on a fine grid may be content with."""

import torch
from torch import Tensor

from pickplace.common.capture import any_of
from pickplace.rules.cell import CellSpec
from pickplace.rules.maps import FAR
from pickplace.rules.masks import PlacingMaps, footprint_mask


def corner_mask(cell: CellSpec, maps: PlacingMaps) -> Tensor:
    """Return a mask of the feasible footprints in corners, bool ``[N, Q, W_T, D_T]``; not empty if any is feasible.

    A footprint occupies a corner if the item there is blocked in at least one direction along x and one along y. A
    direction is blocked if one step further would raise the item, take it out of the tote, or make the end effector hit
    something. On a fine grid, some dozens of the hundreds of feasible footprints do. Among them are the
    bottom-left-stable ones, which are blocked in both directions to the tote's first corner (for both terms see Zhao,
    Bennell, Bektas and Dowsland 2016, "A comparative review of 3D container loading algorithms").

    If no feasible footprint occupies a corner, a direction is also blocked if one step further is infeasible. Then one
    exists: any feasible item slides on until it is blocked.

    Args:
        cell: the sizes.
        maps: what decides which actions succeed.
    """
    feasible = footprint_mask(cell, maps)
    top = maps.rest + maps.item.h.to(maps.rest.dtype).view(-1, 1, 1, 1)
    mask = feasible & _in_corner(maps, footprint_mask(cell, maps._replace(top=top)))
    bare = feasible.flatten(1).any(1) & ~mask.flatten(1).any(1)
    if any_of(bare):  # rarely
        mask = torch.where(bare.view(-1, 1, 1, 1), feasible & _in_corner(maps, feasible), mask)
    return mask


def _in_corner(maps: PlacingMaps, free: Tensor) -> Tensor:
    """Return a mask of footprints that are blocked along x and y: the next one is not free, or raises the item."""
    rest, level = maps.rest, maps.rest + maps.level_step
    before_x, after_x, before_y, after_y = (
        (_neighbours(rest, axis, step, FAR) > level) | ~_neighbours(free, axis, step, False)
        for axis in (2, 3)
        for step in (-1, 1)
    )
    return (before_x | after_x) & (before_y | after_y)


def _neighbours(maps: Tensor, axis: int, step: int, beyond) -> Tensor:
    """Return the value of each footprint's neighbour, a step further along an axis; ``beyond`` outside the grid."""
    moved = maps.roll(-step, axis)
    moved.select(axis, -1 if step > 0 else 0).fill_(beyond)
    return moved
