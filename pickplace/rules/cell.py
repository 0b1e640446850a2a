"""The robot cell: every size and option of bin, tote and end effector, stated once and checked once."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pickplace.common.validate import excerpt, is_number, is_whole, number, one_of, short_text, size_tuple, whole_number
from pickplace.rules.effector import (
    Box,
    Mask,
    boxes,
    centred,
    check_cup_size,
    check_edges,
    read_shape,
    turned,
)
from pickplace.rules.support import Bearing, Support, read_support

PICK_RULES = ("contain", "overlap", "seal")

REFILLS = ("each", "batch")
MAX_BIN_ITEMS = 100

#: Greatest side of a grid or height, in cells or height units, and greatest side of an end effector.
MAX_SIDE, MAX_EFFECTOR = 2_000, 64
#: Greatest number of cells of a grid, of flat actions, and of entries in a table over offsets and place cells.
MAX_CELLS, MAX_ACTIONS, MAX_TABLE = 2**16, 2**27, 2**26


def reference_cell(side):
    """Return the end effector's reference cell along a side, counted from its minimum corner; an int or a tensor."""
    return (side - 1) // 2


def effector_centre(at, side):
    """Return the end effector's centre along a side, with its reference cell at ``at``; in cells, numbers or tensors.

    It comes from the rectangle: on even sides the reference cell is half a cell off.
    """
    return at - reference_cell(side) + side / 2


class EffectorShape(NamedTuple):
    """The end effector as it is turned: its sides, its reference cell and the rectangles of its body, in cells."""

    width: int
    depth: int
    ref_x: int
    ref_y: int
    body: tuple[Box, ...]


@dataclass(frozen=True)
class Limits:
    """Limits of the robot, as tables that masks and the single step read.

    Attributes:
        pick_ok: bool ``[P]``, whether the robot reaches each pick cell.
        lowest_top, highest_top: int ``[R, W_T, D_T]``, the range in which the item's top, where the suction face is,
            must be for each rotation and place cell; in height units. An empty range forbids the place cell.
        lowest_pick, highest_pick: int ``[P]``, the same range for each pick cell; None: any height.
    """

    pick_ok: Tensor
    lowest_top: Tensor
    highest_top: Tensor
    lowest_pick: Tensor | None = None
    highest_pick: Tensor | None = None

    def check(self, cell: "CellSpec") -> None:
        """Refuse tables of another shape or type than the cell needs, with a ``ValueError`` that names the table."""
        picks, places = (cell.num_picks,), (cell.rotations, *cell.tote_size[:2])
        shapes = {"pick_ok": picks, "lowest_top": places, "highest_top": places}
        if self.lowest_pick is not None or self.highest_pick is not None:
            shapes |= {"lowest_pick": picks, "highest_pick": picks}
        for name, shape in shapes.items():
            table = getattr(self, name)
            if table is None:
                raise ValueError(f"limits.{name}=None: expected a table, as the other one of the two.")
            if tuple(table.shape) != shape:
                raise ValueError(f"limits.{name}: got shape {list(table.shape)}, expected {list(shape)}.")
            if (table.dtype == torch.bool) != (name == "pick_ok") or table.dtype.is_floating_point:
                expected = "bool" if name == "pick_ok" else "integers"
                raise ValueError(f"limits.{name}: got {table.dtype}, expected {expected}.")

    def on(self, device) -> "Limits":
        """Return the tables on a device."""
        return replace(self, **{name: table.to(device) for name, table in vars(self).items() if table is not None})


class LimitsOfReach(Limits):
    """Limits that a cell computed from its reach: a cell of other sizes computes them anew."""


class Reach(ABC):
    """The robot's reach, a setting of the cell; two of the same reach are equal."""

    @abstractmethod
    def limits(self, cell: "CellSpec") -> Limits:
        """Return what a robot of this reach may do in a cell; the cell's own limits are not known yet."""

    def picks(self, cell: "CellSpec", x: Tensor, y: Tensor) -> tuple[Tensor, Tensor] | None:
        """Return the range of heights of the suction face for centres of the end effector anywhere in the bin.

        Args:
            x, y: from the bin's corner, in cells; float64 of one shape.

        Returns:
            Lowest and highest, in height units, integers of that shape, an empty range where the robot cannot go;
            None: only what lies between pick cells that are all reached is known to be reached.
        """
        return None


@dataclass(frozen=True)
class CellSpec:
    """Sizes and options of a robot cell.

    Lengths along x and y are in cells. Heights are whole numbers of a height unit, which is a cell unless
    ``height_unit`` says otherwise.

    Args:
        bin_size: ``(W_B, D_B, H_B)``, grid of the bin and height of its walls.
        tote_size: ``(W_T, D_T, H_T)``; an episode's tote height may be lower than ``H_T``.
        effector_size: ``(W_E, D_E)`` of the rectangle around the end effector.
        rotations: ``R``, the number of quarter turns to choose from, 1 to 4.
        pick_rule: on the cup's cells that lie on the item: ``"contain"`` (they cover the whole item), ``"overlap"``
            (there is one) or ``"seal"`` (they are the share ``min_seal`` of the cup, or more).
        support: the stability rule, an object of :mod:`pickplace.rules.support`; or a short form of it, the name of one
            of :data:`~pickplace.rules.support.RULES` or the least share of the footprint.
        height_unit: length of a height unit, in sides of a cell. The rules only count units; what converts heights to
            lengths (the robot's planner, the replay page) multiplies by it.
        body: the cells of ``effector_size`` that must not hit anything: ``"rectangle"``, all; ``"disc"``, those that
            the ellipse inscribed in it touches; or a mask, ``W_E`` lists of ``D_E`` times 0 or 1, with a 1 on each
            edge.
        cup: the cells that grip the item: ``"rectangle"`` or ``"disc"`` of ``cup_size``, or a mask as ``body``'s. They
            must be cells of the body.
        cup_size: ``(w, d)`` of the cup, in the middle of the body; None: ``effector_size``. None with a mask.
        min_seal: with ``pick_rule="seal"``: least share of the cup's cells that must lie on the item, above 0.
        reach: of the robot, such as :class:`~pickplace.rules.reach.Annulus`; None: it reaches everything.
        bin_items: ``M``, how many items a bin holds at most.
        refill: of several items: a new one arrives after ``"each"`` pick, or a ``"batch"`` when the bin is empty.
        longest_side: longest side of any item, where it is known: no item may be longer. It saves time, and unless an
            item must be contained it also sets the number of offsets.
        limits: of the robot, see :class:`Limits`; None: those of ``reach``.
        item_inset: for ``"overlap"`` and ``"seal"``: cells at each edge of the item, along x and y, on which no cell of
            the cup counts. A measured item may cover them in part only.

    Raises:
        ValueError: naming the argument, the value received and what was expected.
    """

    bin_size: tuple[int, int, int] = (5, 5, 1)
    tote_size: tuple[int, int, int] = (6, 6, 5)
    effector_size: tuple[int, int] = (3, 3)
    rotations: int = 4
    pick_rule: str = "contain"
    support: Support = Bearing()
    height_unit: float = 1.0
    body: str | Mask = "rectangle"
    cup: str | Mask = "rectangle"
    cup_size: tuple[int, int] | None = None
    min_seal: float = 1.0
    reach: Reach | None = None
    bin_items: int = 1
    refill: str = "each"
    longest_side: int | None = field(default=None, metadata={"derived": True})
    limits: Limits | None = field(default=None, compare=False, metadata={"derived": True})
    item_inset: tuple[int, int] = field(default=(0, 0), metadata={"derived": True})

    def __post_init__(self):
        object.__setattr__(self, "bin_size", size_tuple("bin_size", self.bin_size, 3, MAX_SIDE))
        object.__setattr__(self, "tote_size", size_tuple("tote_size", self.tote_size, 3, MAX_SIDE))
        object.__setattr__(self, "effector_size", size_tuple("effector_size", self.effector_size, 2, MAX_EFFECTOR))
        if not is_whole(self.rotations) or not 1 <= self.rotations <= 4:
            raise ValueError(
                f"rotations={excerpt(self.rotations)}: expected 1, 2, 3 or 4 (quarter turns to choose from)."
            )
        one_of("pick_rule", self.pick_rule, PICK_RULES)
        object.__setattr__(self, "support", read_support(self.support))
        object.__setattr__(self, "height_unit", float(number("height_unit", self.height_unit, 1e-3, 1e3)))
        whole_number("bin_items", self.bin_items, most=MAX_BIN_ITEMS)
        one_of("refill", self.refill, REFILLS)
        if self.longest_side is not None:
            whole_number("longest_side", self.longest_side)
        self._check_effector()
        self._check_products()
        self._find_limits()

    def _find_limits(self) -> None:
        """Compute the limits of the reach, or check those that were given."""
        if isinstance(self.limits, LimitsOfReach):  # of the cell from which ``dataclasses.replace`` made this one
            object.__setattr__(self, "limits", None)
        if self.reach is not None:
            if not isinstance(self.reach, Reach):
                raise ValueError(f"reach={excerpt(self.reach)}: expected a Reach, such as an Annulus, or None.")
            if self.limits is not None:
                raise ValueError(f"limits, reach={excerpt(self.reach)}: got both, expected one of the two.")
            object.__setattr__(self, "limits", LimitsOfReach(**vars(self.reach.limits(self))))
        if self.limits is not None:
            self.limits.check(self)

    def _check_effector(self) -> None:
        """Refuse a body or a cup that is impossible, or a cup that is not part of the body."""
        for key in ("body", "cup"):
            object.__setattr__(self, key, read_shape(key, getattr(self, key), self.effector_size))
        check_edges("body", self.body_mask)
        if self.cup_size is not None:
            object.__setattr__(self, "cup_size", size_tuple("cup_size", self.cup_size, 2, MAX_EFFECTOR))
            if not isinstance(self.cup, str):
                raise ValueError(f"cup_size={[*self.cup_size]}: expected null, as cup is a mask.")
            check_cup_size(self.cup_size, self.effector_size)
        for x, (body, cup) in enumerate(zip(self.body_mask, self.cup_mask, strict=True)):
            for y in range(len(body)):
                if cup[y] > body[y]:
                    raise ValueError(
                        f"cup={excerpt(self.cup)}, cup_size={excerpt(self.cup_size)}: cell ({x}, {y}) of the cup is "
                        f"not in body={excerpt(self.body)}; expected a cup that is part of the body."
                    )
        if not is_number(self.min_seal) or not 0 < self.min_seal <= 1:
            raise ValueError(f"min_seal={excerpt(self.min_seal)}: expected a number > 0 and <= 1.")

    def _check_products(self) -> None:
        """Refuse sizes each of which is possible, but whose products would fill the memory."""
        bin_size, tote_size = f"bin_size={[*self.bin_size]}", f"tote_size={[*self.tote_size]}"
        products = [
            (f"{bin_size}: the bin has", self.num_picks, "cells", MAX_CELLS),
            (f"{tote_size}: the tote has", self.num_places, "cells", MAX_CELLS),
            (f"{bin_size}, {tote_size}: the cell has", self.num_actions, "actions", MAX_ACTIONS),
        ]
        if self.has_known_offsets:  # else the items will say how many
            table = self.rotations * self.num_offsets**2 * self.num_places
            key = f"effector_size={[*self.effector_size]}, {tote_size}: the table of offsets has"
            products.append((key, table, "entries", MAX_TABLE))
        for words, count, what, most in products:
            if count > most:
                raise ValueError(f"{words} {count:,} {what}; expected at most {most:,}.")

    @property
    def num_picks(self) -> int:
        """``P``, the number of pick cells."""
        return self.bin_size[0] * self.bin_size[1]

    @property
    def num_places(self) -> int:
        """The number of place cells, ``W_T * D_T``."""
        return self.tote_size[0] * self.tote_size[1]

    def tote_volume(self, tote_height):
        """Return the volume of a tote of some height, in cells times height units; an int or a tensor."""
        return self.num_places * tote_height

    @property
    def num_actions(self) -> int:
        """``N_a``, the number of flat actions."""
        return self.num_picks * self.num_places * self.rotations

    @property
    def parities(self) -> int:
        """``Q``: 1 if items are never turned, else 2; parity 1 turns footprint and end effector by 90 degrees."""
        return 1 if self.rotations == 1 else 2

    @property
    def num_footprints(self) -> int:
        """The number of footprints ``(parity, x, y)``; what an action leaves in the tote is one of them."""
        return self.parities * self.num_places

    @property
    def num_choices(self) -> int:
        """The number of pairs of an item in the bin and a footprint, ``item * num_footprints + footprint``."""
        return self.bin_items * self.num_footprints

    @cached_property
    def body_mask(self) -> Mask:
        """The cells of the body, before turning."""
        return self._mask(self.body, self.effector_size)

    @cached_property
    def cup_mask(self) -> Mask:
        """The cells of the cup, before turning."""
        return self._mask(self.cup, self.cup_size or self.effector_size)

    def _mask(self, shape: Any, size: tuple[int, int]) -> Mask:
        return centred(shape, size, self.effector_size) if isinstance(shape, str) else shape

    @cached_property
    def cup_boxes(self) -> tuple[Box, ...]:
        """Rectangles that do not overlap and make up the cup, before turning."""
        return boxes(self.cup_mask)

    @cached_property
    def least_sealed(self) -> int:
        """The least number of the cup's cells on an item, whatever its size, with which the cup may grip it."""
        total = sum(map(sum, self.cup_mask))
        return next(n for n in range(1, total + 1) if self.pick_rule != "seal" or n / total >= self.min_seal)

    @property
    def cup_bounds(self) -> tuple[tuple[int, int], ...]:
        """The cup's bounding rectangle: its begin and end along x, and along y; in cells of ``effector_size``."""
        filled = [[at for at, line in enumerate(lines) if any(line)] for lines in self._cup_lines]
        return tuple((line[0], line[-1] + 1) for line in filled)

    @property
    def _cup_lines(self) -> tuple[Mask, Mask]:
        """The cup's lines across x, and across y."""
        return self.cup_mask, tuple(zip(*self.cup_mask, strict=True))

    @cached_property
    def max_side(self) -> int:
        """``S``: the longest item side that fits the bin and, where it must be contained, the cup."""
        limits = [end - begin for begin, end in self.cup_bounds] if self.pick_rule == "contain" else self.bin_size[:2]
        longest = max(min(a, b) for a, b in zip(limits, self.bin_size[:2], strict=True))
        return longest if self.longest_side is None else min(longest, self.longest_side)

    @property
    def has_known_offsets(self) -> bool:
        """Whether the number of offsets does not depend on an unknown longest item."""
        return self.pick_rule == "contain" or self.longest_side is not None

    @cached_property
    def _offsets(self) -> range:
        """The offsets of an item under the end effector with which it may be gripped, along either axis, at any turn.

        A contained item begins in a line of cells with a cell of the cup; any other covers lines with enough of them.
        """
        side = 1 if self.pick_rule == "contain" else self.max_side
        found = []
        for lines in self._cup_lines:
            counts = [sum(line) for line in lines]
            for part in (counts, counts[::-1]) if self.rotations > 1 else (counts,):
                held = range(1 - side, len(part))
                found += [at for at in held if sum(part[max(at, 0) : at + side]) >= self.least_sealed]
        return range(min(found), max(found) + 1) if found else range(1)

    @cached_property
    def min_offset(self) -> int:
        """The lowest offset of an item under the end effector along either axis."""
        return self._offsets[0]

    @cached_property
    def num_offsets(self) -> int:
        """``O``: how many offsets there are along one axis."""
        return len(self._offsets)

    @cached_property
    def effectors(self) -> tuple[EffectorShape, ...]:
        """The distinct shapes of the turned body: 1, 2 or ``R`` of them; see :meth:`effector`."""
        masks = [self.body_mask]
        for _ in range(self.rotations - 1):
            masks.append(turned(masks[-1]))
        count = next(n for n in (1, 2, len(masks)) if masks == [masks[r % n] for r in range(len(masks))])
        return tuple(_effector_shape(mask) for mask in masks[:count])

    def effector(self, rotation: int) -> EffectorShape:
        """Return the shape of the end effector in a rotation."""
        return self.effectors[rotation % len(self.effectors)]

    def describe(self) -> str:
        """Return the sizes in one short line, for messages."""
        bin_size, tote_size, effector_size = (
            "x".join(map(str, size)) for size in (self.bin_size, self.tote_size, self.effector_size)
        )
        return f"bin {bin_size}, tote {tote_size}, end effector {effector_size}, R={self.rotations}"


#: The settings of a cell, by the names that configs, checkpoints and evaluations use.
CELL_SETTINGS = tuple(item.name for item in fields(CellSpec) if not item.metadata.get("derived"))


def cell_from_settings(settings: dict) -> CellSpec:
    """Return the cell of settings by name, such as a config's; raises ``ValueError`` for a name that there is not."""
    known = {item.name for item in fields(CellSpec)}
    if unknown := [name for name in settings if name not in known]:
        value = excerpt(settings[unknown[0]])
        raise ValueError(f"{short_text(unknown[0])}={value}: expected one of {', '.join(CELL_SETTINGS)}.")
    return CellSpec(**settings)


def _effector_shape(mask: Mask) -> EffectorShape:
    """Return the shape of an end effector whose body is a mask."""
    width, depth = len(mask), len(mask[0])
    return EffectorShape(width, depth, reference_cell(width), reference_cell(depth), boxes(mask))
