"""Placing: how high an item rests on a footprint, whether it is stable there, and what the end effector must clear.

Surfaces, see :func:`~pickplace.rules.state.surface_from`, are halved where heights are needed.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache, reduce
from itertools import product

import torch
from torch import Tensor

from pickplace.rules.cell import CellSpec
from pickplace.rules.checks import FOOTPRINT, EffectorOverTote, Resting, combine
from pickplace.rules.grasps import is_outside
from pickplace.rules.gripper.base import EffectorShape
from pickplace.rules.item import Item
from pickplace.rules.maps import FAR, NEVER, is_under, rectangle_sums, surround, windows
from pickplace.rules.state import surface_from
from pickplace.rules.support.contact import Contact, Neighbours

MIN_SIDE = 8  # side of the square under an item from which :class:`LargeFootprintContact` is faster
MAX_LEVELS = 2**22  # entries of its tables; further problems follow in turn
FOOTPRINTS_AT_ONCE = {"cpu": 2**17, "cuda": 2**24}  # as many as a CPU's caches hold; 100 bytes each on a GPU


def resting_top(
    cell: CellSpec, surface: Tensor, tote_height: Tensor, item: Item, capacity: Tensor | None = None,
    boxes: Tensor | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return the height of the item's top on every footprint, and of its underside, int32 ``[N, Q, W_T, D_T]`` each.

    Arguments: see :meth:`~pickplace.rules.state.State.each_item` and :attr:`~pickplace.rules.state.State.capacity`.
    ``boxes`` are those in the tote, int64 ``[N, L, 6]``, for rules with ``sees_boxes``.

    The top is ``NEVER`` where the item cannot rest: the footprint leaves the tote, the top passes the rim, the support
    is too small, or something below would be overloaded. The underside is given whether the item is stable or not, and
    ``FAR`` outside the tote.
    """
    w, d = footprint_sizes(cell, item)
    at_once = max(1, FOOTPRINTS_AT_ONCE.get(surface.device.type, 2**24) // cell.num_footprints)
    around: Sequence = [None] * -(-len(surface) // at_once)
    if boxes is not None:
        pairs = zip(boxes.split(at_once), item.h.split(at_once), strict=True)
        corner = (torch.arange(side, device=surface.device) for side in surface.shape[1:])
        x, y = (each[..., None] for each in torch.meshgrid(*corner, indexing="ij"))
        around = [Neighbours(some, x, y, h) for some, h in pairs]
    parts = zip(surface.split(at_once), w.split(at_once, -1), d.split(at_once, -1), around, strict=True)
    kind = FootprintContact if cell.max_side < MIN_SIDE else LargeFootprintContact
    contacts = (kind(cell, *part) for part in parts)  # one at a time, for the memory
    found: list[tuple[Tensor, ...]]
    if capacity is None:
        found = [(on.z, cell.support.stable(on)) for on in contacts]
    else:
        some = zip(contacts, capacity.split(at_once), strict=True)
        found = [(on.z, cell.support.stable(on), on.least(borne)) for on, borne in some]
    z, stable, *least = found[0] if len(found) == 1 else (torch.cat(each, -1) for each in zip(*found, strict=True))
    top = z + item.h.to(z.dtype)
    resting = Resting(None, top, tote_height, stable, least[0] >= item.grams if least else None)
    good = combine(FOOTPRINT, resting) & item.exists
    return torch.where(good, top, NEVER).permute(3, 0, 1, 2), z.permute(3, 0, 1, 2)


def unchecked_top(cell: CellSpec, surface: Tensor, tote_height: Tensor, item: Item, *_) -> tuple[Tensor, Tensor]:
    """Return the same as :func:`resting_top`, but the top of every footprint in the tote, without any check."""
    z = FootprintContact(cell, surface, *footprint_sizes(cell, item)).z
    return (z + item.h.to(z.dtype)).permute(3, 0, 1, 2), z.permute(3, 0, 1, 2)


def footprint_sizes(cell: CellSpec, item: Item) -> tuple[Tensor, Tensor]:
    """Return width and depth of the item's footprint not turned and turned, int64 ``[Q, 1, 1, N]`` each."""
    sides = torch.stack([item.w, item.d])[:, None, None]
    return sides[: cell.footprint_turns], sides.flip(0)[: cell.footprint_turns]


class FootprintContact(Contact):
    """The supporting cells under an item at rest on every footprint; quantities are ``[Q, W_T, D_T, N]``.

    Footprints that leave the tote rest higher than any rim.

    Args:
        surface: int32 ``[N, W_T, D_T]``.
        w, d: see :func:`footprint_sizes`.
        recorded: see :class:`~pickplace.rules.support.contact.Contact`.
    """

    def __init__(self, cell: CellSpec, surface: Tensor, w: Tensor, d: Tensor, recorded: Neighbours | None = None):
        self.surface, self.side, self.w, self.d = surface.permute(1, 2, 0), cell.max_side, w, d
        self.recorded = recorded
        self.padded = surround(self.surface, (0, self.side - 1, 0, self.side - 1), 2 * FAR)
        # The maximum over a rectangle is a maximum along one axis, then along the other.
        self.z = self._highest(self._highest(self.padded[None], -3, w), -2, d) >> 1
        self.supporting = surface_from(self.z)

    def _highest(self, maps: Tensor, axis: int, size: Tensor) -> Tensor:
        """Return for each cell the maximum over ``size`` cells from there along an axis, without the padding."""
        step, count = torch.arange(self.side, device=size.device), maps.shape[axis] - self.side + 1
        # torch.minimum is far faster than torch.where.
        limits = torch.where(step.view(-1, 1, 1, 1, 1) < size, torch.iinfo(maps.dtype).max, NEVER).to(maps.dtype)
        parts = (torch.minimum(maps.narrow(axis, at, count), limit) for at, limit in enumerate(limits.unbind(0)))
        return reduce(torch.maximum, parts)

    def least(self, values: Tensor) -> Tensor:
        """Return the least value on the highest cells under the item, on which it rests, int64 of the shape of ``z``.

        Each height and value are packed into one number. Its maximum belongs to the highest cells, and among these to
        the least value.

        Args:
            values: int64 ``[N, W_T, D_T]``, from -1 to 2**31 - 1.
        """
        most = 2**32 - 1
        marked = (self.surface >> 1).long() * 2**32 + (most - 1 - values.permute(1, 2, 0))
        padded = surround(marked, (0, self.side - 1, 0, self.side - 1), FAR * 2**32)
        return most - 1 - (self._highest(self._highest(padded[None], -3, self.w), -2, self.d) & most)

    @cached_property
    def surfaces(self):  # type: ignore[override]
        return [cells for row in windows(self.padded, self.side).unbind(0) for cells in row.unbind(0)]

    @cached_property
    def under(self):  # type: ignore[override]
        return is_under(self.w, self.d, self.side)

    def corner_surfaces(self) -> Iterator[Tensor]:
        wide, deep, batch = self.surface.shape
        place = torch.arange(self.padded.numel(), device=self.z.device).view(self.padded.shape)[:wide, :deep]
        along_x, along_y = ((size.clamp(1, self.side) - 1) * batch for size in (self.w, self.d))
        for x, y in product((0 * along_x, along_x), (0 * along_y, along_y)):
            yield self.padded.take((place + x * self.padded.shape[1] + y).expand_as(self.z))

    def ends(self) -> Iterator[Tensor]:
        """Yield the same as :meth:`Contact.ends`.

        Each surface and its place along y are packed into one number, so that one maximum over a row of the footprint
        finds both. All footprints that begin at this y share the maximum of a row.
        """
        wide, deep, _ = self.surface.shape
        places = 2 ** (deep - 1).bit_length()
        whole = torch.int32 if 4 * FAR * places < 2**31 else torch.int64
        y = torch.arange(deep, dtype=whole, device=self.z.device)[:, None]
        surface, margins = self.surface.to(whole) * places, (0, self.side - 1, 0, self.side - 1)
        marked = torch.stack([surround(surface + at, margins, 2 * FAR * places) for at in (y, deep - 1 - y)])
        highest = self._highest(marked[:, None], -2, self.d)  # [2, Q, W_T + S - 1, D_T, N]
        # The reach of a supporting cell is the excess over this; other cells have no excess.
        before = torch.stack(torch.broadcast_tensors(y, deep - self.d.to(whole) - y))
        none = self.supporting.to(whole) * places - 1 + before
        for x in range(self.side):
            most = torch.where(x < self.w, self.side, 0).int()
            yield (highest.narrow(2, x, wide) - none).clamp_(min=0).int().minimum(most)


class LargeFootprintContact(FootprintContact):
    """The same for large items on fine grids: the work does not grow with the area of an item.

    Supporting cells are counted by a table of sums for each surface value in the totes.
    """

    @property
    def count(self) -> Tensor:
        levels = torch.cat([self.surface.unique(), self.surface.new_tensor([4 * FAR])])
        # Where no cell bears weight, the level is that of a greater surface, which no cell under the item has.
        level = torch.searchsorted(levels, self.supporting)
        at_once = max(1, MAX_LEVELS // (len(levels) * self.surface.shape[0] * self.surface.shape[1]))
        parts = zip(*(part.split(at_once, -1) for part in (self.surface, self.w, self.d, level)), strict=True)
        levels = levels.view(-1, 1, 1, 1)
        return torch.cat([rectangle_sums(cells == levels, w, d, number) for cells, w, d, number in parts], -1)


@lru_cache(maxsize=64)
def leaving_places(shapes: tuple[EffectorShape, ...], grid: tuple[int, int], device: torch.device) -> Tensor:
    """Return a mask of the place cells at which each shape leaves the tote, bool ``[B, W_T, D_T, 1]``."""
    x, y = torch.arange(grid[0], device=device)[:, None], torch.arange(grid[1], device=device)
    leaves = [
        is_outside(x - shape.ref_x, shape.width, grid[0]) | is_outside(y - shape.ref_y, shape.depth, grid[1])
        for shape in shapes
    ]
    return torch.stack(leaves)[..., None]


def effector_over_tote(cell: CellSpec, surface: Tensor, rim: Tensor) -> EffectorOverTote:
    """Return the facts of the end effector over every place cell; each broadcasts to ``[T, W_T, D_T, N]``.

    ``T`` is the number of :attr:`~pickplace.rules.cell.CellSpec.effectors`; with limits of the robot, of rotations.

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
    effector = EffectorOverTote(leaving_places(cell.effectors, (tote_w, tote_d), device), rim.int(), obstacle)
    if cell.limits is None:
        return effector
    turns, limits = [turn % len(cell.effectors) for turn in range(cell.rotations)], cell.limits.to(device)
    bounds = limits.lowest_top[..., None], limits.highest_top[..., None]
    leaves, obstacle = (torch.stack([part[turn] for turn in turns]) for part in (effector.leaves_tote, obstacle))
    return EffectorOverTote(leaves, effector.rim, obstacle, *bounds)
