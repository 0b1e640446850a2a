"""Pack whole orders: a place for each item, in a sequence that is chosen, too."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from pickplace.common.validate import refuse_any, refuse_if, reworded
from pickplace.config.registry import find
from pickplace.items.order_file import ORIENTATIONS, TURNS, OrderItem
from pickplace.planners.base import MapPlanner
from pickplace.rules.cell import MAX_SIDE, CellSpec
from pickplace.rules.gripper.rules import Overlap
from pickplace.rules.item import NO_LIMIT, Item
from pickplace.rules.masks import footprint_mask, placing_maps
from pickplace.rules.pile import Pile
from pickplace.rules.state import EMPTY, Failure, State, surface_from
from pickplace.rules.step import apply
from pickplace.rules.support.rules import RoundedUp
from pickplace.views.recording import Move, Recording, record_moves

LEAST_MARGIN = 20.0  # of an item's centre from the edge of what carries it, mm: piles are high

#: For each face of an item that may be the lowest one its orientations, as it lies and turned; first the one upright.
FACES = tuple(zip(ORIENTATIONS[::2], ORIENTATIONS[1::2], strict=True))

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
    orientation: str  #: its sides along x, y and z, one of :data:`~pickplace.items.order_file.ORIENTATIONS`

    @property
    def turned(self) -> bool:
        """Whether it is turned by 90 degrees about z, after it was tipped if it was."""
        return ORIENTATIONS.index(self.orientation) % 2 == 1

    @property
    def size(self) -> tuple[float, float, float]:
        """Its sides along x, y and z."""
        return _oriented(self.item, self.orientation)


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
        tipping: put items down on another side, too, where they allow it.

    Raises:
        ValueError: for a container that the grid does not divide, or a planner that does not choose among places.
    """

    def __init__(
        self,
        container: tuple[int, int, int],
        cell: int = 20,
        planner: str = "heightmap_minimisation",
        tipping: bool = False,
    ):
        self._faces = FACES if tipping else FACES[:1]
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
                tried.append(self._fill(cell, planner, sequence, len(containers), self._faces))
                if len(self._faces) > 1:  # what is tipped may stand in the way of more
                    tried.append(self._fill(cell, planner, sequence, len(containers), self._faces[:1]))
            # The most items, of these the greatest volume, of these the lowest pile.
            best, left = min(tried, key=lambda each: (len(each[1]), -each[0].occupancy, each[0].top))
            refuse_if(
                not best.items, f"planner={self._name}: it places none of {len(left)} items in an empty container."
            )
            left = sorted(left)
            containers.append(best)
        return replace(cell, bin_size=(cell.bin_size[0] // cell.bin_items, *cell.bin_size[1:]), bin_items=1), containers

    def check(self, items: Sequence[OrderItem]) -> None:
        """Refuse an item that fits into no container, with a ``ValueError`` that names its place in the file."""
        refuse_any((item for item in items if not self._variants(item, self._faces)), self._misfit)

    def _variants(self, item: OrderItem, faces: Sequence[tuple[str, str]]) -> list[tuple[tuple[str, str], list[int]]]:
        """Return the faces that an item may lie on in the container; and with it, as it then lies in the bin, its sides
        in cells and millimetres, rounded up, and the bit mask of its turns.

        Args:
            faces: the orientations of each face, as it lies and turned by 90 degrees.
        """
        wide, deep = (side // self.cell_mm for side in self.container[:2])
        variants: list[tuple[tuple[str, str], list[int]]] = []
        known: set[tuple[float, float, float]] = set()
        for face in faces:
            w, d = (max(1, math.ceil(side / self.cell_mm - 1e-6)) for side in _oriented(item, face[0])[:2])
            h = max(1, math.ceil(_oriented(item, face[0])[2] - 1e-6))
            fits = (w <= wide and d <= deep), (w <= deep and d <= wide)
            allowed = [name for name, fit in zip(face, fits, strict=True) if fit and name in item.orientations]
            new = {_oriented(item, name) for name in allowed} - known
            if h <= self.container[2] and new:
                turns = sum(TURNS[FACES[0][face.index(name)]] for name in allowed)
                variants.append((face, [w, d, h, -1, turns, item.grams, item.max_load]))
                known |= new
        return variants

    def _misfit(self, item: OrderItem) -> str:
        sizes = " x ".join(f"{side:g}" for side in (item.length, item.width, item.height))
        ways = "turned or tipped" if len(self._faces) > 1 else "turned"
        return (
            f"{item.place}: {sizes} mm; expected an item that fits the container of "
            f"{' x '.join(map(str, self.container))} mm, in cells of {self.cell_mm} mm, as it lies or {ways}, where it "
            "allows that."
        )

    def _cell_for(self, items: Sequence[OrderItem]) -> CellSpec:
        sides = [columns[:3] for item in items for _, columns in self._variants(item, self._faces)]
        wide, deep, high = (max(part) for part in zip(*sides, strict=True))
        length, width = (side // self.cell_mm for side in self.container[:2])
        bins = (len(self._faces) * wide, deep, high)  # an item on each of its faces, side by side
        with reworded(ValueError, lambda error: ValueError(f"cell={self.cell_mm} mm is too fine: {error}")):
            cell = CellSpec(bin_size=bins, tote_size=(length, width, self.container[2]), **self._settings)
        handling = any(item.has_limits for item in items)
        return replace(
            cell, bin_items=len(self._faces), longest_side=max(wide, deep), handling=handling, most_items=len(items)
        )

    def _fill(
        self, cell: CellSpec, planner: MapPlanner, sequence: Sequence[tuple[int, OrderItem]], number: int,
        faces: Sequence[tuple[str, str]],
    ) -> tuple[PackedContainer, list[tuple[int, OrderItem]]]:  # fmt: skip
        """Return an empty container after items were put down one by one, and those that found no place.

        An item lies in the bin on each of its faces at once, and the planner takes one of these.
        """
        recording, packed, left = Recording(number, cell.tote_size[2]), [], []
        surface = torch.full((1, *cell.tote_size[:2]), EMPTY, dtype=torch.int32)
        tops = np.zeros(cell.tote_size[:2])  # of the surface without rounding, mm
        height = torch.tensor([cell.tote_size[2]])
        pile = Pile.empty(1, cell.tote_size, cell.pile_room) if cell.handling else None
        for place, item in sequence:
            variants, step_x = self._variants(item, faces), cell.bin_size[0] // cell.bin_items
            table = torch.zeros(1, cell.bin_items, len(Item._fields), dtype=torch.int64)
            for row, (_, columns) in enumerate(variants):
                table[0, row] = torch.tensor([row * step_x, 0, *columns])
            state = State(surface, height, Item.from_table(table), pile=pile)
            maps = placing_maps(cell, state)
            if not footprint_mask(cell, maps).any():
                left.append((place, item))
                continue
            action = planner.choose(cell, state, maps, {})
            (move,), step = record_moves(cell, None, None, state, action), apply(cell, state, action)
            recording.moves.append(_alone(move))
            x, y, w, d = move.footprint
            below, face = float(tops[x : x + w, y : y + d].max()), variants[int(step.taken)][0]
            corner = x * self.cell_mm, y * self.cell_mm, round(below, 6)
            packed.append(PackedItem(item, place, corner, face[move.rotation % 2]))
            tops[x : x + w, y : y + d] = below + packed[-1].size[2]
            after, pile = state._replace(surface=step.surface), step.pile
            heights, bearing = after.heights, after.bearing
            # A top is rounded up once, not with each item of its pile: so level tops are level within a millimetre.
            heights[0, x : x + w, y : y + d] = math.ceil(below + packed[-1].size[2] - 1e-6)
            for axis, count in enumerate((w, d)):
                if packed[-1].size[axis] < count * self.cell_mm - 1e-6:  # it does not fill its last cells
                    bearing[0, x : x + w, y : y + d].select(axis, count - 1).fill_(False)
            surface = surface_from(heights, bearing)
        recording.ending = Failure.STUCK if left else Failure.NONE
        recording.occupancy = sum(math.prod(each.size) for each in packed) / math.prod(self.container)
        return PackedContainer(packed, recording), left


def _oriented(item: OrderItem, orientation: str) -> tuple[float, float, float]:
    """Return an item's sides along x, y and z, mm."""
    sides = {"l": item.length, "w": item.width, "h": item.height}
    x, y, z = (sides[letter] for letter in orientation)
    return x, y, z


def _alone(move: Move) -> Move:
    """Return a move with its item alone in the bin, in the corner."""
    x, y, *size = move.item
    w, d, h = size
    return replace(move, item=(0, 0, w, d, h), pick=(move.pick[0] - x, move.pick[1] - y), others=[])


def _sequences(items: Sequence[tuple[int, OrderItem]]) -> list[list[tuple[int, OrderItem]]]:
    """Return numbered items in each of :data:`SEQUENCES`."""
    found = []
    for rank in SEQUENCES:
        ranked = sorted((rank(item), place) for place, (_, item) in enumerate(items))
        found.append([items[place] for _, place in ranked])
    if any(item.max_load < NO_LIMIT for _, item in items):
        found += [sorted(each, key=lambda numbered: -numbered[1].max_load) for each in found]
    return found
