"""Pack whole orders: a place for each item, in a sequence that is chosen, too."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from pickplace.common.validate import refuse_any, refuse_if, reworded
from pickplace.config.registry import find
from pickplace.items.order_file import OrderItem
from pickplace.planners.base import MapPlanner
from pickplace.rules.cell import MAX_SIDE, CellSpec
from pickplace.rules.gripper.rules import Overlap
from pickplace.rules.item import NO_LIMIT, Item
from pickplace.rules.masks import footprint_mask, placing_maps
from pickplace.rules.pile import Pile
from pickplace.rules.state import EMPTY, Failure, State, surface_from
from pickplace.rules.step import apply
from pickplace.rules.support.rules import RoundedUp
from pickplace.views.recording import Recording, record_moves

LEAST_MARGIN = 20.0  # of an item's centre from the edge of what carries it, mm: piles are high

#: Sequences that are tried, by what comes first: the largest base, volume, height. If some item bears a limited load,
#: also those in which what bears more comes first.
SEQUENCES: tuple[Callable[[OrderItem], float], ...] = (
    lambda item: -item.length * item.width,
    lambda item: -item.length * item.width * item.height,
    lambda item: -item.height,
)


@dataclass(frozen=True)
class PackedItem:
    """An item at its place; millimetres from the container's corner."""

    item: OrderItem
    number: int  #: of the item in its order, from 1
    corner: tuple[int, int, float]  #: least x, y and z
    turned: bool  #: whether its length is along y

    @property
    def size(self) -> tuple[float, float, float]:
        """Its sides along x, y and z."""
        sides = (self.item.width, self.item.length) if self.turned else (self.item.length, self.item.width)
        return *sides, self.item.height


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


class OrderPacker:
    """Packs orders into containers of one size, without a gripper.

    An item lies in the corner with the least x and y of the cells that it takes. Items that carry another one together
    are level within a millimetre. Nothing sticks out of the container, or passes its rim. An item is turned only as it
    allows, and no item carries more than it bears: the full mass of an item counts on each one below it in the pile.

    Args:
        container: length, width and height, mm.
        cell: side of a cell of the grid, mm.
        planner: name of what chooses a place, such as ``"joint_dbl"``: one that needs no training.

    Raises:
        ValueError: for a container that the grid does not divide, or a planner that does not choose among places.
    """

    def __init__(
        self,
        container: tuple[int, int, int],
        cell: int = 20,
        planner: str = "heightmap_minimisation",
    ):
        self.container, self.cell_mm, size = container, cell, "x".join(map(str, container))
        refuse_any(
            (side for side in container[:2] if side % cell),
            lambda _: f"container={size}: expected a length and a width that are multiples of cell={cell} mm.",
        )
        refuse_if(
            not 1 <= container[2] <= MAX_SIDE,
            f"container={size}: expected a height of 1 to {MAX_SIDE:,} mm.",
        )
        self._settings: dict[str, Any] = {
            "gripper": Overlap(size=(1, 1)), "rotations": 2, "height_unit": 1 / cell, "cell_size": cell / 1000,
            "support": RoundedUp(max(0.75, LEAST_MARGIN / cell)),
        }  # fmt: skip
        self._make, self._name = find("planner", planner), planner
        refuse_if(
            not isinstance(self._make, type) or not issubclass(self._make, MapPlanner) or hasattr(self._make, "needs"),
            f"planner={planner}: expected one that needs no training, such as joint_dbl.",
        )

    def pack(self, items: Sequence[OrderItem], keep_sequence: bool = False) -> tuple[CellSpec, list[PackedContainer]]:
        """Return the cell and the containers that hold all items, as many as are needed.

        Args:
            items: of an order.
            keep_sequence: put the items down in the order's sequence, instead of the best of :data:`SEQUENCES`.

        Raises:
            ValueError: for an item that fits into no container, naming its place in the file.
        """
        self.check(items)
        cell = self._cell_for(items)
        planner, left = self._make(cell), list(enumerate(items, 1))
        containers: list[PackedContainer] = []
        while left:
            tried = []
            for sequence in [left] if keep_sequence else _sequences(left):
                tried.append(self._fill(cell, planner, sequence, len(containers)))
            # The most items, of these the greatest volume, of these the lowest pile.
            best, left = min(tried, key=lambda each: (len(each[1]), -each[0].occupancy, each[0].top))
            refuse_if(
                not best.items, f"planner={self._name}: it places none of {len(left)} items in an empty container."
            )
            left = sorted(left)
            containers.append(best)
        return cell, containers

    def check(self, items: Sequence[OrderItem]) -> None:
        """Refuse an item that fits into no container, with a ``ValueError`` that names its place in the file."""
        refuse_any((item for item in items if not self._fits(item)), self._misfit)

    def _sides(self, item: OrderItem) -> tuple[int, int, int]:
        """Return an item's sides in cells and millimetres, rounded up."""
        w, d = (max(1, math.ceil(side / self.cell_mm - 1e-6)) for side in (item.length, item.width))
        return w, d, max(1, math.ceil(item.height - 1e-6))

    def _fits(self, item: OrderItem) -> bool:
        (w, d, h), (wide, deep) = self._sides(item), (side // self.cell_mm for side in self.container[:2])
        as_it_lies, turned = (bool(item.turns >> turn & 1) for turn in range(2))
        return h <= self.container[2] and (
            (as_it_lies and w <= wide and d <= deep) or (turned and w <= deep and d <= wide)
        )

    def _misfit(self, item: OrderItem) -> str:
        sizes = " x ".join(f"{side:g}" for side in (item.length, item.width, item.height))
        return (
            f"{item.place}: {sizes} mm; expected an item that fits the container of "
            f"{' x '.join(map(str, self.container))} mm, in cells of {self.cell_mm} mm, as it lies or turned, "
            "where it may be turned."
        )

    def _cell_for(self, items: Sequence[OrderItem]) -> CellSpec:
        sides = [self._sides(item) for item in items]
        wide, deep, high = (max(part) for part in zip(*sides, strict=True))
        length, width = (side // self.cell_mm for side in self.container[:2])
        with reworded(ValueError, lambda error: ValueError(f"cell={self.cell_mm} mm is too fine: {error}")):
            cell = CellSpec(bin_size=(wide, deep, high), tote_size=(length, width, self.container[2]), **self._settings)
        handling = any(item.has_limits for item in items)
        return replace(cell, longest_side=max(wide, deep), handling=handling, most_items=len(items))

    def _fill(
        self, cell: CellSpec, planner: MapPlanner, sequence: Sequence[tuple[int, OrderItem]], number: int
    ) -> tuple[PackedContainer, list[tuple[int, OrderItem]]]:  # fmt: skip
        """Return an empty container after items were put down one by one, and those that found no place."""
        recording, packed, left = Recording(number, cell.tote_size[2]), [], []
        surface = torch.full((1, *cell.tote_size[:2]), EMPTY, dtype=torch.int32)
        tops = np.zeros(cell.tote_size[:2])  # of the surface without rounding, mm
        height = torch.tensor([cell.tote_size[2]])
        pile = Pile.empty(1, cell.tote_size, cell.pile_room) if cell.handling else None
        for place, item in sequence:
            columns = (0, 0, *self._sides(item), -1, item.turns, item.grams, item.max_load)
            state = State(surface, height, Item(*(torch.tensor([[value]]) for value in columns)), pile=pile)
            maps = placing_maps(cell, state)
            if not footprint_mask(cell, maps).any():
                left.append((place, item))
                continue
            action = planner.choose(cell, state, maps, {})
            recording.moves += record_moves(cell, None, None, state, action)
            x, y, w, d = recording.moves[-1].footprint
            below = float(tops[x : x + w, y : y + d].max())
            tops[x : x + w, y : y + d] = below + item.height
            corner = x * self.cell_mm, y * self.cell_mm, round(below, 6)
            packed.append(PackedItem(item, place, corner, recording.moves[-1].rotation % 2 == 1))
            step = apply(cell, state, action)
            after, pile = state._replace(surface=step.surface), step.pile
            heights, bearing = after.heights, after.bearing
            # A top is rounded up once, not with each item of its pile: so level tops are level within a millimetre.
            heights[0, x : x + w, y : y + d] = math.ceil(below + item.height - 1e-6)
            for axis, count in enumerate((w, d)):
                if packed[-1].size[axis] < count * self.cell_mm - 1e-6:  # it does not fill its last cells
                    bearing[0, x : x + w, y : y + d].select(axis, count - 1).fill_(False)
            surface = surface_from(heights, bearing)
        recording.ending = Failure.STUCK if left else Failure.NONE
        recording.occupancy = sum(math.prod(each.size) for each in packed) / math.prod(self.container)
        return PackedContainer(packed, recording), left


def _sequences(items: Sequence[tuple[int, OrderItem]]) -> list[list[tuple[int, OrderItem]]]:
    """Return numbered items in each of :data:`SEQUENCES`."""
    found = []
    for rank in SEQUENCES:
        ranked = sorted((rank(item), place) for place, (_, item) in enumerate(items))
        found.append([items[place] for _, place in ranked])
    if any(item.max_load < NO_LIMIT for _, item in items):
        found += [sorted(each, key=lambda numbered: -numbered[1].max_load) for each in found]
    return found
