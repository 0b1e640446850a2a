"""Pack whole orders: choose a sequence of the items, and a place for each."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, TypeAlias, cast

import numpy as np
import torch
from torch import Tensor

from pickplace.common.validate import check_bytes, refuse_if, reword_errors, size_tuple, whole_number
from pickplace.config.registry import find, names_at
from pickplace.evaluation.filling import Filling, Numbered, PackedContainer, oriented
from pickplace.items.order_file import ORIENTATIONS, TURNS, OrderItem
from pickplace.planners.base import MapPlanner
from pickplace.rules.bin import take_item
from pickplace.rules.cell import MAX_CELLS, MAX_SIDE, POSES, CellSpec
from pickplace.rules.grasps import carry
from pickplace.rules.gripper.rules import Overlap
from pickplace.rules.item import NO_LIMIT, Item
from pickplace.rules.maps import NEVER
from pickplace.rules.masks import PlacingMaps, placing_maps
from pickplace.rules.pile import Pile
from pickplace.rules.state import EMPTY, State, surface_from
from pickplace.rules.step import apply
from pickplace.rules.support.rules import RoundedUp
from pickplace.views.recording import Recording, record_moves

Faces: TypeAlias = Sequence[tuple[str, str]]  # the orientations of each face, as it lies and turned by 90 degrees
Variant: TypeAlias = tuple[tuple[str, str], list[int]]  # an item on one of its faces, as a row of a table of items

MAX_CELL = 1_000  # side of a cell, mm: heights are in mm, and a cell has at most 1,000 height units
MIN_MARGIN = 10.0  # of an item's centre from the edge of its support, mm
CELL_MARGIN = 20.0  # the same for the cells that it takes, mm; large, as piles are high

#: Orientations of an item on each face on which it may lie, as it lies and turned by 90 degrees; first the upright one.
FACES = tuple(zip(ORIENTATIONS[::2], ORIENTATIONS[1::2], strict=True))

#: The default planner minimises gaps, so it may build towers; the other one keeps piles low.
PLANNER, LOW_PLANNER = "heightmap_minimisation", "joint_dbl"

#: Sequences that are tried: largest base first, largest volume first, greatest height first. If some item has a load
#: limit, also each of these with the greatest limits first.
SEQUENCES: tuple[Callable[[OrderItem], float], ...] = (
    lambda item: -item.length * item.width,
    lambda item: -item.length * item.width * item.height,
    lambda item: -item.height,
)


class PackingCell(CellSpec):
    """A cell whose bin is made up for the items. Its flat actions are not limited: packing lists none of them."""

    max_picks = POSES * MAX_CELLS  # an item lies in it on each of its faces
    max_actions = 2 * POSES * MAX_CELLS**2


class OrderPacker:
    """Packs orders into containers of one size, without a gripper.

    Within its cells, an item lies in the corner with the least x and y. Items that carry another one together
    are level within a millimetre. By the items' true sides, all four corners of an item lie in the hull of its support,
    or its centre does, :data:`MIN_MARGIN` from the edge; only what lies in the hull of its own support carries
    others, down to the floor. Nothing sticks out of the container, or passes its rim. An item is turned only as it
    allows, and no item carries more than it bears: the full mass of an item counts on each one below it in the pile.

    Args:
        container: length, width and height, mm; a strip narrower than a cell at the far walls stays empty.
        cell: side of a cell of the grid, mm, at most :data:`MAX_CELL`.
        planner: name of the planner that chooses places, such as ``"joint_dbl"``; it must need no training. None:
            :data:`PLANNER`, and :data:`LOW_PLANNER` for a container that takes all that is left, if its pile is lower.
        tipping: whether to put items down on another side, too, if they allow it.

    Raises:
        ValueError: for a container smaller than a cell, or a planner that does not choose among places.
    """

    def __init__(
        self,
        container: tuple[int, int, int],
        cell: int = 20,
        planner: str | None = None,
        tipping: bool = False,
    ):
        whole_number("cell", cell, most=MAX_CELL)
        container = cast(tuple[int, int, int], size_tuple("container", container, 3, 10**6))
        self._faces = FACES if tipping else FACES[:1]
        self.container, self.cell_mm, size = container, cell, "x".join(map(str, container))
        refuse_if(min(container[:2]) < cell, f"container={size}: expected a length and a width of at least {cell} mm.")
        refuse_if(
            not 1 <= container[2] <= MAX_SIDE,
            f"container={size}: expected a height of 1 to {MAX_SIDE:,} mm.",
        )
        self._settings: dict[str, Any] = {
            "gripper": Overlap(size=(1, 1)), "rotations": 2, "height_unit": 1 / cell, "cell_size": cell / 1000,
        }  # fmt: skip
        self._name = PLANNER if planner is None else planner
        is_known = self._name in names_at("planner") or "." in self._name
        if not is_known or not _packs(find("planner", self._name)):
            names = [name for name in names_at("planner") if _packs(find("planner", name))]
            own = f"a subclass of {MapPlanner.__module__}.MapPlanner that needs no training"
            raise ValueError(f"planner={planner}: expected {', '.join(names)}, or {own}.")
        self._make = find("planner", self._name)
        self._make_low = find("planner", LOW_PLANNER) if planner is None else None

    def pack(self, items: Sequence[OrderItem], keep_sequence: bool = False) -> tuple[CellSpec, list[PackedContainer]]:
        """Return the cell and the containers that hold all items, as many as are needed.

        Args:
            items: of an order.
            keep_sequence: whether to keep the order's sequence, instead of the best of :data:`SEQUENCES`.

        Raises:
            ValueError: as of :meth:`check`.
        """
        cell = self._cell_for(items)
        planner, left = self._make(cell), list(enumerate(items, 1))
        containers: list[PackedContainer] = []
        while left:
            # Tipped items may leave less room for others.
            faces = [self._faces, self._faces[:1]] if len(self._faces) > 1 else [self._faces]
            tries = [*product([left] if keep_sequence else _sequences(left), faces)]
            tried = self._fill(cell, planner, tries, len(containers))
            if self._make_low and not all(others for _, others in tried):
                tried += self._fill(cell, self._make_low(cell), tries, len(containers))
            # The most items, of these the greatest volume, of these the lowest pile.
            best, left = min(tried, key=lambda each: (len(each[1]), -each[0].occupancy, each[0].top))
            refuse_if(
                not best.items, f"planner={self._name}: it places none of {len(left)} items in an empty container."
            )
            left = sorted(left)
            containers.append(best)
        return replace(cell, bin_size=(cell.bin_size[0] // cell.bin_items, *cell.bin_size[1:]), bin_items=1), containers

    def check(self, items: Sequence[OrderItem]) -> None:
        """Raise ``ValueError`` for items that cannot be packed.

        The message names the place in the file of an item that fits into no container, or the cell if it is too fine.
        """
        self._make(self._cell_for(items))

    def _variants(self, item: OrderItem, faces: Faces) -> list[Variant]:
        """Return the faces on which an item may lie in the container, each with the columns ``w`` to ``max_load`` of an
        :class:`Item`; w and d in cells, h in millimetres, rounded up.

        Args:
            faces: the orientations of each face, as it lies and turned by 90 degrees.
        """
        wide, deep = (side // self.cell_mm for side in self.container[:2])
        variants: list[Variant] = []
        known: set[tuple[float, float, float]] = set()
        for face in faces:
            w, d = (max(1, math.ceil(side / self.cell_mm - 1e-6)) for side in oriented(item, face[0])[:2])
            h = max(1, math.ceil(oriented(item, face[0])[2] - 1e-6))
            fits = (w <= wide and d <= deep), (w <= deep and d <= wide)
            allowed = [name for name, fit in zip(face, fits, strict=True) if fit and name in item.orientations]
            new = {oriented(item, name) for name in allowed} - known
            if h <= self.container[2] and new:
                turns = sum(TURNS[FACES[0][face.index(name)]] for name in allowed)
                variants.append((face, [w, d, h, -1, turns, item.grams, item.max_load]))
                known |= new
        return variants

    def _misfit(self, items: Sequence[OrderItem]) -> str:
        """Return the error for items that do not fit the container; it names the first one."""
        item, more = items[0], len({each.place for each in items}) - 1
        sizes = " x ".join(f"{side:g}" for side in (item.length, item.width, item.height))
        others = f", and {more} more line{'s' * (more > 1)} of this order" if more else ""
        ways = "turned or tipped" if len(self._faces) > 1 else "turned"
        return (
            f"{item.place}: {sizes} mm{others}; expected an item that fits the container of "
            f"{' x '.join(map(str, self.container))} mm, in cells of {self.cell_mm} mm, as it lies or {ways}, where it "
            "allows that."
        )

    def _cell_for(self, items: Sequence[OrderItem]) -> CellSpec:
        refuse_if(not items, "items: the order has none; expected at least one.")
        if misfits := [item for item in items if not self._variants(item, self._faces)]:
            raise ValueError(self._misfit(misfits))
        variants = [(item, *each) for item in items for each in self._variants(item, self._faces)]
        sides = [columns[:3] for _, _, columns in variants]
        # An item's true centre may be this much nearer to the edge of its support than the centre of its cells.
        lost = max(
            math.dist([side * self.cell_mm for side in columns[:2]], oriented(item, face[0])[:2]) / 2
            for item, face, columns in variants
        )
        wide, deep, high = (max(part) for part in zip(*sides, strict=True))
        length, width = (side // self.cell_mm for side in self.container[:2])
        bins = (len(self._faces) * wide, deep, high)  # an item on each of its faces, side by side
        with reword_errors(ValueError, lambda error: ValueError(f"cell={self.cell_mm} mm is too fine: {error}")):
            support = RoundedUp(max(CELL_MARGIN, MIN_MARGIN + lost) / self.cell_mm)
            cell = PackingCell(
                support=support, bin_size=bins, tote_size=(length, width, self.container[2]), **self._settings
            )
        handling = any(item.has_limits for item in items)
        least = min(w * d * oriented(item, face[0])[2] for item, face, (w, d, *_) in variants)
        most = min(len(items), int(length * width * self.container[2] / least + 1e-6))
        tries = 2 * len(SEQUENCES) * (1 + (len(self._faces) > 1))
        words = f"{items[0].place}: the order has {len(items):,} items, some with limits; {most:,} fit by volume"
        check_bytes(words, handling * 3 * tries * most**2)  # tables of the items below one another, while one is added
        return replace(
            cell, bin_items=len(self._faces), longest_side=max(wide, deep), handling=handling, most_items=most
        )

    def _fill(
        self, cell: CellSpec, planner: MapPlanner, tries: Sequence[tuple[Numbered, Faces]], number: int
    ) -> list[tuple[PackedContainer, Numbered]]:
        """Fill an empty container for each try, item by item; return the containers, and the items that found no place.

        An item lies in the bin on each of its faces at once, and the planner takes one of these. The tries are problems
        of one batch, which takes little more time than a single try.

        Args:
            tries: the same items in a sequence, and the orientations of the faces on which they may lie.
        """
        recordings = (Recording(number, cell.tote_size[2]) for _ in tries)
        fills = [Filling(each, self.cell_mm, np.zeros(cell.tote_size[:2])) for each in recordings]
        surface = torch.full((len(tries), *cell.tote_size[:2]), EMPTY, dtype=torch.int32)
        height = torch.full((len(tries),), cell.tote_size[2])
        pile = Pile.empty(len(tries), cell.tote_size, cell.room) if cell.handling else None
        # Of each try: the kinds of items that found no place since an item was last put down.
        placeless: list[set[tuple]] = [set() for _ in tries]
        for items in zip(*(sequence for sequence, _ in tries), strict=True):
            if all(item.kind in kinds for (_, item), kinds in zip(items, placeless, strict=True)):
                for fill, each in zip(fills, items, strict=True):
                    fill.left.append(each)
                continue
            variants = [self._variants(item, faces) for (_, item), (_, faces) in zip(items, tries, strict=True)]
            state = State(surface, height, _in_bins(cell, variants), pile=pile)
            maps = placing_maps(cell, state)
            on_one = _allow_places_on_one(fills, items, variants, state, maps)
            if (maps.top == NEVER).all():
                for fill, each, kinds in zip(fills, items, placeless, strict=True):
                    fill.left.append(each)
                    kinds.add(each[1].kind)
                continue
            action = planner.choose(cell, state, maps, {})
            turns, alone = _turns_on_one(cell, state, action, on_one)
            # For an item that lies wholly on another one, all cells bear. Those that it does not cover are restored.
            bearing_all = torch.where(alone[:, None, None], surface | 1, surface)
            step = apply(cell, state._replace(surface=bearing_all), action)
            same = step.surface >> 1 == surface >> 1
            after, pile = state._replace(surface=torch.where(same, surface, step.surface)), step.pile
            heights, bearing = after.heights, after.bearing
            for row, move in enumerate(record_moves(cell, None, None, state, action, step)):
                if move.failure:
                    fills[row].left.append(items[row])
                    placeless[row].add(items[row][1].kind)
                    continue
                placeless[row].clear()
                face = variants[row][int(step.taken[row])][0]
                move = replace(move, rotation=(turn := turns[row]))
                fills[row].put_down(items[row], face[turn], move, heights[row], bearing[row])
            surface = surface_from(heights, bearing)
        return [fill.closed(math.prod(self.container)) for fill in fills]


def _packs(planner: Any) -> bool:
    """Return whether a class of planners chooses among places, and needs nothing but the cell."""
    return isinstance(planner, type) and issubclass(planner, MapPlanner) and not hasattr(planner, "needs")


def _in_bins(cell: CellSpec, variants: Sequence[Sequence[Variant]]) -> Item:
    """Return the items of bins ``[N, M]`` in which the variants of an item lie side by side along x."""
    table = torch.zeros(len(variants), cell.bin_items, len(Item._fields), dtype=torch.int64)
    for row, each in enumerate(variants):
        for place, (_, columns) in enumerate(each):
            table[row, place] = torch.tensor([place * (cell.bin_size[0] // cell.bin_items), 0, *columns])
    return Item.from_table(table)


def _allow_places_on_one(
    fills: Sequence[Filling],
    items: Sequence[tuple[int, OrderItem]],
    variants: Sequence[Sequence[Variant]],
    state: State,
    maps: PlacingMaps,
) -> Tensor:
    """Allow the places where an item lies wholly on another one, in place; return a mask of them, as ``maps.top``.

    The rules list a square footprint as not turned only. So it is allowed if the item fits in either turn.

    Args:
        fills: the containers.
        items: the next one of each container.
        variants: faces on which it may lie.
        state: heights and loads of the containers.
        maps: of the variants.
    """
    on_one = torch.zeros_like(maps.top, dtype=torch.bool)
    places = on_one.numpy()  # small parts of arrays take less time than those of tensors
    bears = None if state.capacity is None else (state.capacity >= maps.item.grams.view(-1, 1, 1)).numpy()
    for row, (fill, (_, item), each) in enumerate(zip(fills, items, variants, strict=True)):
        for place, (face, (_, _, h, *_)) in enumerate(each):
            number = row * maps.bin_items + place
            for turn in [turn for turn in (0, 1) if face[turn] in item.orientations]:
                for cells, free, z in fill.places_on_one(oriented(item, face[turn])):
                    if z + h <= state.tote_height[row]:
                        places[number, turn][cells] |= free & (True if bears is None else bears[number][cells])
    square = (maps.item.w == maps.item.d).view(-1, 1, 1, 1)
    allowed = on_one | (square & on_one.flip(1))
    torch.where(allowed, maps.rest + maps.item.h.int().view(-1, 1, 1, 1), maps.top, out=maps.top)
    return on_one


def _turns_on_one(cell: CellSpec, state: State, action: Tensor, on_one: Tensor) -> tuple[list[int], Tensor]:
    """Return how actions, int64 ``[N]``, turn their items, and whether these lie wholly on another one, bool ``[N]``.

    An item with a square footprint is turned so that it does.

    Args:
        on_one: see :func:`_allow_places_on_one`.
    """
    taken, item, blocked = take_item(cell, state.items, action)
    _, rotation, _, (x, y, _, _) = carry(cell, item, action, blocked)
    number = torch.arange(len(action)) * state.items.x.shape[1] + taken
    wide, deep = cell.tote_size[:2]
    here = on_one[number, :, x.clamp(0, wide - 1), y.clamp(0, deep - 1)]  # [N, 2]
    turn = rotation % 2
    own, other = (here.gather(1, each[:, None])[:, 0] for each in (turn, 1 - turn))
    other &= item.w == item.d
    return torch.where(other & ~own, 1 - turn, turn).tolist(), own | other


def _sequences(items: Numbered) -> list[Numbered]:
    """Return numbered items in each of :data:`SEQUENCES`."""
    found = []
    for rank in SEQUENCES:
        ranked = sorted((rank(item), place) for place, (_, item) in enumerate(items))
        found.append([items[place] for _, place in ranked])
    if any(item.max_load < NO_LIMIT for _, item in items):
        found += [sorted(each, key=lambda numbered: -numbered[1].max_load) for each in found]
    return found
