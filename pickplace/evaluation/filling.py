"""A container that is being filled: the items in it, by their true sides."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor

from pickplace.items.order_file import ORIENTATIONS, OrderItem
from pickplace.rules.state import Failure
from pickplace.views.recording import Move, Recording

Numbered: TypeAlias = list[tuple[int, OrderItem]]  # items with their numbers in the order


@dataclass(frozen=True)
class PackedItem:
    """An item at its place; millimetres from the container's corner."""

    item: OrderItem
    number: int  #: of the item in its order, from 1
    corner: tuple[int, int, float]  #: least x, y and z
    orientation: str  #: its sides along x, y and z, one of :data:`~pickplace.items.order_file.ORIENTATIONS`

    @property
    def turned(self) -> bool:
        """Whether it is turned by 90 degrees about z, after any tipping."""
        return ORIENTATIONS.index(self.orientation) % 2 == 1

    @property
    def size(self) -> tuple[float, float, float]:
        """Sides along x, y and z, mm."""
        return oriented(self.item, self.orientation)


@dataclass(frozen=True)
class PackedContainer:
    """One container with its items, in the sequence in which they are put down."""

    items: list[PackedItem]
    recording: Recording  #: for the replay page

    @property
    def occupancy(self) -> float:
        """Share of its volume that the items fill."""
        return self.recording.occupancy

    @property
    def top(self) -> float:
        """Height of the highest item, mm."""
        return max((packed.corner[2] + packed.size[2] for packed in self.items), default=0.0)


class Carrier(NamedTuple):
    """An item that is carried at all four corners, so that it carries others everywhere."""

    x: int  # least cell
    y: int
    sides: tuple[float, float]  # true ones along x and y, mm
    top: float  # mm
    z: int  # its top, rounded up
    tops: np.ndarray  # the part of Filling.tops over its cells; a view


@dataclass
class Filling:
    """A container that is being filled, on a grid whose cells the items need not fill.

    An item bears nothing on a last cell that it does not fill, as other items take such cells to be full. But an item
    that lies wholly on another one, by their true sides, is carried by it in such cells, too.
    """

    recording: Recording
    cell_mm: int  # side of a cell
    tops: np.ndarray  # of the contents, without rounding, mm, [W_T, D_T]
    items: list[PackedItem] = field(default_factory=list)
    carriers: list[Carrier] = field(default_factory=list)  # those that nothing covers wholly
    left: Numbered = field(default_factory=list)  # those that found no place

    def places_on_one(
        self, size: tuple[float, float, float]
    ) -> Iterator[tuple[tuple[slice, slice], np.ndarray | bool, int]]:
        """Yield the places where an item would lie wholly on another one.

        Args:
            size: true sides of the item along x, y and z, mm.

        Yields:
            for each item that is large enough: a rectangle of cells for the corner of the new one; which of them leave
            it nothing else to lie on; and the height of its underside, mm, rounded up.
        """
        w, d = (max(1, math.ceil(side / self.cell_mm - 1e-6)) for side in size[:2])
        for x, y, sides, top, z, tops in self.carriers:
            spare = [side - own + 1e-6 for side, own in zip(sides, size, strict=False)]
            if min(spare) < 0:
                continue
            nx, ny = (min(1 + int(spare[a] // self.cell_mm), tops.shape[a] + 1 - own) for a, own in enumerate((w, d)))
            free: np.ndarray | bool = bool(tops.max() <= top)  # everywhere
            if not free:
                free = (sliding_window_view(tops, (w, d)).max((2, 3)) <= top)[:nx, :ny]
            yield (slice(x, x + nx), slice(y, y + ny)), free, z

    def put_down(
        self, numbered: tuple[int, OrderItem], orientation: str, move: Move, heights: Tensor, bearing: Tensor
    ) -> None:
        """Add an item; correct the heights of its cells, and whether they bear weight, in place.

        Args:
            numbered: the item with its number in the order.
            orientation: of the item.
            move: puts it down.
            heights: int32 ``[W_T, D_T]``, after the move.
            bearing: bool ``[W_T, D_T]``.
        """
        (number, item), (x, y, w, d) = numbered, move.footprint
        below = float(self.tops[x : x + w, y : y + d].max())
        packed = PackedItem(item, number, (x * self.cell_mm, y * self.cell_mm, round(below, 6)), orientation)
        self.recording.moves.append(_alone(move))
        self.items.append(packed)
        self.tops[x : x + w, y : y + d] = top = below + packed.size[2]
        # A top is rounded up once, not with each item of its pile: so level tops are level within a millimetre.
        heights[x : x + w, y : y + d] = z = math.ceil(top - 1e-6)
        part = bearing[x : x + w, y : y + d]
        if part.all():
            self.carriers.append(Carrier(x, y, packed.size[:2], top, z, self.tops[x : x + w, y : y + d]))
        self.carriers = [each for each in self.carriers if each.tops.min() <= each.top]
        # Something may support it in cells that it does not fill. Then its true support ends up to a cell earlier than
        # on the grid. So any other cell bears only if the cell after it does, too.
        unfilled = [axis for axis, count in enumerate((w, d)) if packed.size[axis] < count * self.cell_mm - 1e-6]
        for axis in [axis for axis in unfilled if part.select(axis, part.shape[axis] - 1).any()]:
            count = part.shape[axis] - 1
            part.narrow(axis, 0, count).logical_and_(part.narrow(axis, 1, count).clone())
        for axis in unfilled:
            part.select(axis, part.shape[axis] - 1).fill_(False)

    def closed(self, volume: int) -> tuple[PackedContainer, Numbered]:
        """Return the container, which gets no more items, and those that found no place in it.

        Args:
            volume: of the container, mm^3.
        """
        self.recording.ending = Failure.STUCK if self.left else Failure.NONE
        self.recording.occupancy = math.fsum(math.prod(each.size) for each in self.items) / volume  # in any sequence
        return PackedContainer(self.items, self.recording), self.left


def oriented(item: OrderItem, orientation: str) -> tuple[float, float, float]:
    """Return an item's sides along x, y and z, mm."""
    sides = {"l": item.length, "w": item.width, "h": item.height}
    x, y, z = (sides[letter] for letter in orientation)
    return x, y, z


def _alone(move: Move) -> Move:
    """Return a move with its item alone in the bin, in the corner."""
    x, y, *size = move.item
    w, d, h = size
    return replace(move, item=(0, 0, w, d, h), pick=(move.pick[0] - x, move.pick[1] - y), others=[])
