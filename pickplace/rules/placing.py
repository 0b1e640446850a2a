"""Placing: how high an item rests on a footprint, whether it is stable there, and what the end effector must clear.

Surfaces, see :func:`~pickplace.rules.state.surface_from`, are halved where heights are needed.
"""

from collections.abc import Iterable, Iterator
from functools import cached_property, lru_cache, reduce

import torch
from torch import Tensor

from pickplace.rules.cell import CellSpec
from pickplace.rules.checks import FOOTPRINT, Over, Resting, combine
from pickplace.rules.grasps import is_outside
from pickplace.rules.gripper.base import EffectorShape
from pickplace.rules.item import Item
from pickplace.rules.maps import FAR, NEVER, is_under, rectangle_sums, surround, windows
from pickplace.rules.state import surface_from
from pickplace.rules.support.contact import Contact

LEAST_SIDE = 8  # of the square under an item; from there on :class:`LargeItems` is faster
MAX_ENTRIES = 2**22  # of its tables; more problems are looked at in turn


def resting_top(cell: CellSpec, surface: Tensor, tote_height: Tensor, item: Item) -> tuple[Tensor, Tensor]:
    """Return the height of the item's top for every footprint, and what it rests on; int32 ``[N, Q, W_T, D_T]`` each.

    Arguments as of :meth:`~pickplace.rules.state.State.each_item`.

    The top is ``NEVER`` where the item cannot rest: the footprint leaves the tote, the top passes the rim, or the
    support is too small. The height below it is that on which it would lie, stable or not; ``FAR`` outside the tote.
    """
    w, d = footprint_sizes(cell, item)
    if cell.max_side < LEAST_SIDE:
        contacts: Iterable[OnFootprints] = [OnFootprints(cell, surface, w, d)]
    else:
        at_once = max(1, MAX_ENTRIES // (len(surface.unique()) * cell.num_places))
        parts = zip(surface.split(at_once), w.split(at_once, -1), d.split(at_once, -1), strict=True)
        contacts = (LargeItems(cell, *part) for part in parts)  # one at a time, for the memory
    found = [(on.z, cell.support.stable(on)) for on in contacts]
    z, stable = found[0] if len(found) == 1 else (torch.cat(each, -1) for each in zip(*found, strict=True))
    top = z + item.h.to(z.dtype)
    good = combine(FOOTPRINT, Resting(None, top, tote_height, stable)) & item.exists
    return torch.where(good, top, NEVER).permute(3, 0, 1, 2), z.permute(3, 0, 1, 2)


def unchecked_top(cell: CellSpec, surface: Tensor, tote_height: Tensor, item: Item) -> tuple[Tensor, Tensor]:
    """Return the same as :func:`resting_top`, but for every footprint in the tote, stable or not."""
    z = OnFootprints(cell, surface, *footprint_sizes(cell, item)).z
    return (z + item.h.to(z.dtype)).permute(3, 0, 1, 2), z.permute(3, 0, 1, 2)


def footprint_sizes(cell: CellSpec, item: Item) -> tuple[Tensor, Tensor]:
    """Return width and depth of the item's footprint in each parity, int64 ``[Q, 1, 1, N]`` each."""
    sides = torch.stack([item.w, item.d])[:, None, None]
    return sides[: cell.parities], sides.flip(0)[: cell.parities]


class OnFootprints(Contact):
    """The supporting cells under an item at rest on every footprint; quantities are ``[Q, W_T, D_T, N]``.

    Footprints that leave the tote rest higher than any rim.

    Args:
        surface: int32 ``[N, W_T, D_T]``.
        w, d: as of :func:`footprint_sizes`.
    """

    def __init__(self, cell: CellSpec, surface: Tensor, w: Tensor, d: Tensor):
        self.surface, self.side, self.w, self.d = surface.permute(1, 2, 0), cell.max_side, w, d
        self.padded = surround(self.surface, (0, self.side - 1, 0, self.side - 1), 2 * FAR)
        highest = self.padded[None]
        # The maximum over a rectangle is a maximum along one axis, then along the other.
        for axis, size, grid in ((1, w, cell.tote_size[0]), (2, d, cell.tote_size[1])):
            parts = (torch.where(step < size, highest.narrow(axis, step, grid), NEVER) for step in range(self.side))
            highest = reduce(torch.maximum, parts)
        self.z = highest >> 1
        self.supporting = surface_from(self.z)

    @cached_property
    def surfaces(self):  # type: ignore[override]
        return [cells for row in windows(self.padded, self.side).unbind(0) for cells in row.unbind(0)]

    @cached_property
    def under(self):  # type: ignore[override]
        return is_under(self.w, self.d, self.side)


class LargeItems(OnFootprints):
    """The same for large items on fine grids, where the work must not grow with the area of an item.

    For each height in a tote tables are made of the cells that have it, in which a row of any footprint is looked up.
    """

    @cached_property
    def _levels(self) -> tuple[Tensor, Tensor]:
        """Whether a cell has a height, bool ``[levels, W_T, D_T, N]``, and the index of the supporting cells' height.

        Where no cell bears weight it is the index of a greater height, which no cell under the item has.
        """
        levels = torch.cat([self.surface.unique(), self.surface.new_tensor([4 * FAR])])
        return self.surface == levels.view(-1, 1, 1, 1), torch.searchsorted(levels, self.supporting)

    @property
    def count(self) -> Tensor:
        has_level, level = self._levels
        return rectangle_sums(has_level, self.w, self.d, level)

    def rows(self) -> Iterator[tuple[Tensor, Tensor]]:
        (has_level, level), side = self._levels, self.side
        _, wide, deep, count = has_level.shape
        x_at, y_at, number = (torch.arange(size, device=level.device) for size in (wide, deep, count))
        start = ((level * wide + x_at.view(-1, 1, 1)) * deep + y_at.view(-1, 1)) * count + number
        y = y_at.view(-1, 1).short()
        after = torch.where(has_level, y, deep).flip(2).cummin(2).values.flip(2)  # first of the level from y on
        before = torch.where(has_level, y, -1).cummax(2).values
        end = start + (self.d - 1) * count
        for x in range(side):
            row, most = x * deep * count, after.numel() - 1
            first, last = after.take((start + row).clamp_(max=most)) - y, before.take((end + row).clamp_(max=most)) - y
            held = (x < self.w) & (first < self.d)
            yield torch.where(held, first, side), torch.where(held, last, -1)


@lru_cache(maxsize=64)
def leaving_places(shapes: tuple[EffectorShape, ...], grid: tuple[int, int], device: torch.device) -> Tensor:
    """Return the place cells at which the end effector leaves the tote, bool ``[B, W_T, D_T, 1]``, for each shape."""
    x, y = torch.arange(grid[0], device=device)[:, None], torch.arange(grid[1], device=device)
    leaves = [
        is_outside(x - shape.ref_x, shape.width, grid[0]) | is_outside(y - shape.ref_y, shape.depth, grid[1])
        for shape in shapes
    ]
    return torch.stack(leaves)[..., None]


def over_tote(cell: CellSpec, surface: Tensor, rim: Tensor) -> Over:
    """Return the facts of the end effector over every place cell; each ``[T, W_T, D_T, N]``, or broadcasts to that.

    ``T`` counts :attr:`~pickplace.rules.cell.CellSpec.effectors`; with limits of the robot, rotations.

    Args:
        surface: int32 ``[N, W_T, D_T]``.
        rim: height of the tote, ``[N]``.
    """
    (tote_w, tote_d, _), device = cell.tote_size, surface.device
    obstacle = surface.new_empty(len(cell.effectors), tote_w, tote_d, len(surface))
    for number, shape in enumerate(cell.effectors):
        after_x, after_y = shape.width - 1 - shape.ref_x, shape.depth - 1 - shape.ref_y
        walled = surround(surface.permute(1, 2, 0), (shape.ref_x, after_x, shape.ref_y, after_y), 0)
        highest = []
        for box in shape.body:
            under = walled
            # The maximum over a rectangle is a maximum along one axis, then along the other.
            for axis, begin, size, grid in ((0, box.x, box.width, tote_w), (1, box.y, box.depth, tote_d)):
                under = reduce(torch.maximum, [under.narrow(axis, begin + i, grid) for i in range(size)])
            highest.append(under)
        obstacle[number] = reduce(torch.maximum, highest) >> 1
    over = Over(leaving_places(cell.effectors, (tote_w, tote_d), device), rim.int(), obstacle)
    if cell.limits is None:
        return over
    turns, limits = [turn % len(cell.effectors) for turn in range(cell.rotations)], cell.limits.on(device)
    bounds = limits.lowest_top[..., None], limits.highest_top[..., None]
    return Over(over.leaves[turns], over.rim, obstacle[turns], *bounds)
