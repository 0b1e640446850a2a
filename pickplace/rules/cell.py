"""The robot cell: all sizes and options of bin, tote and end effector, and their checks."""

from dataclasses import InitVar, dataclass, field, fields
from functools import cached_property
from inspect import signature
from typing import ClassVar

from pickplace.common.validate import (
    expect,
    flag,
    is_whole,
    number,
    one_of,
    or_null,
    refuse_above,
    short_text,
    size_tuple,
    whole_number,
)
from pickplace.rules.gripper.base import EffectorShape, Gripper
from pickplace.rules.gripper.rules import Contain, changed_gripper
from pickplace.rules.gripper.shapes import Mask
from pickplace.rules.reach.base import Limits, Reach
from pickplace.rules.state import REFILLS
from pickplace.rules.support.rules import Bearing, Support, read_support

MAX_BIN_ITEMS = 100
POSES = 3  # of an item that may be tipped: one for each pair of its faces

MAX_SIDE = 2_000  # greatest side of a grid or height, in cells or height units
MAX_CELLS, MAX_ACTIONS = 2**16, 2**27  # greatest number of cells of a grid, and of flat actions


@dataclass(frozen=True)
class CellSpec:
    """Sizes and options of a robot cell.

    Lengths along x and y are in cells. Heights are whole numbers of a height unit, which is a cell unless
    ``height_unit`` says otherwise.

    Args:
        bin_size: ``(W_B, D_B, H_B)``, grid of the bin and height of its walls.
        tote_size: ``(W_T, D_T, H_T)``; an episode's tote height may be lower than ``H_T``.
        gripper: body, cup and grip rule, such as :class:`~pickplace.rules.gripper.rules.Seal`.
        rotations: ``R``, the number of quarter turns to choose from, 1 to 4.
        support: the stability rule, an object of :mod:`pickplace.rules.support.rules`; or a short form of it, the name
            of one of :data:`~pickplace.rules.support.rules.RULES` or the least share of the footprint.
        height_unit: length of a height unit, in sides of a cell. The rules only count units. Code that converts heights
            to lengths (the robot's planner, the replay page) multiplies by it.
        cell_size: length of a cell, m. The rules only count cells; simulated physics and ``plans.jsonl`` need lengths.
        reach: reach of the robot, such as an :class:`~pickplace.rules.reach.annulus.Annulus` or tables of
            :class:`~pickplace.rules.reach.base.Limits`; None: it reaches everything.
        bin_items: ``M``, greatest number of items in a bin.
        refill: with several items, ``"each"``: a new item arrives after each pick; ``"batch"``: new items arrive when
            the bin is empty.
        preview: number of the next items that are seen before they arrive, in their order. It does not change which
            actions are feasible.
        handling: whether each item has its own handling instructions: the greatest load that may lie on it, and the
            turns that are allowed. The rules then record which items lie on which.
        tipping: whether items may also be put down on another side, for cells in which the gripper does not matter. An
            item then lies in the bin once in each of its three poses, side by side, and takes three places. A pick of
            one pose takes the item. Heights are in cells.
        longest_side: longest side of any item, if known; no item may be longer. It saves time. Unless the gripper
            limits the size of items, it also sets the number of offsets.
        most_items: greatest number of items in a tote, if known; else there is room for one in each cell and height
            unit. Used only with ``handling``, or if the stability rule looks at the boxes in the tote.
        varies: settings in which episodes may differ, besides the height of the tote: names of
            :data:`~pickplace.rules.observation.EPISODE_TERMS`. The observation has an entry for each.
        item_inset: cells at each edge of the item, along x and y, that a measured item may cover only in part; see
            :meth:`Gripper.is_gripped <pickplace.rules.gripper.base.Gripper.is_gripped>`.
        effector_size, body, cup, cup_size, pick_rule, min_seal: a short form that changes ``gripper``: its size, shapes
            and settings, and its rule by name. Read the resulting values from ``gripper``.

    Raises:
        ValueError: naming the argument, the value received and what was expected.
    """

    bin_size: tuple[int, int, int] = (5, 5, 1)
    tote_size: tuple[int, int, int] = (6, 6, 5)
    gripper: Gripper = Contain()
    rotations: int = 4
    support: Support = Bearing()
    height_unit: float = 1.0
    cell_size: float = 0.05
    reach: Reach | None = None
    bin_items: int = 1
    refill: str = "each"
    preview: int = 0
    handling: bool = False
    tipping: bool = False
    longest_side: int | None = field(default=None, metadata={"derived": True})
    most_items: int | None = field(default=None, metadata={"derived": True})
    varies: tuple[str, ...] = field(default=(), metadata={"derived": True})
    item_inset: tuple[int, int] = field(default=(0, 0), metadata={"derived": True})
    effector_size: InitVar[tuple[int, int] | None] = None
    body: InitVar[str | Mask | None] = None
    cup: InitVar[str | Mask | None] = None
    cup_size: InitVar[tuple[int, int] | None] = None
    pick_rule: InitVar[str | None] = None
    min_seal: InitVar[float | None] = None

    max_picks: ClassVar[int] = MAX_CELLS  # greatest number of cells of the bin
    max_actions: ClassVar[int] = MAX_ACTIONS  # greatest number of flat actions

    def __post_init__(self, effector_size, body, cup, cup_size, pick_rule, min_seal):
        expect(isinstance(self.gripper, Gripper), "gripper", self.gripper, "a Gripper, such as Contain(size=(3, 3))")
        read = {
            "bin_size": size_tuple("bin_size", self.bin_size, 3, MAX_SIDE),
            "tote_size": size_tuple("tote_size", self.tote_size, 3, MAX_SIDE),
            "gripper": changed_gripper(
                self.gripper, pick_rule, size=effector_size, body=body, cup=cup, cup_size=cup_size, min_seal=min_seal
            ),
            "support": read_support(self.support),
            "height_unit": float(number("height_unit", self.height_unit, 1e-3, 1e3)),
            "cell_size": float(number("cell_size", self.cell_size, 1e-3, 10, "metres")),
        }
        for key, value in read.items():
            object.__setattr__(self, key, value)
        good = is_whole(self.rotations) and 1 <= self.rotations <= 4
        expect(good, "rotations", self.rotations, "1, 2, 3 or 4 (quarter turns to choose from)")
        whole_number("bin_items", self.bin_items, most=MAX_BIN_ITEMS)
        one_of("refill", self.refill, REFILLS)
        whole_number("preview", self.preview, 0, MAX_BIN_ITEMS)
        flag("handling", self.handling)
        if flag("tipping", self.tipping):
            expect(self.bin_items % POSES == 0, "bin_items", self.bin_items, "a multiple of 3 with tipping=true")
            expect(self.height_unit == 1, "height_unit", self.height_unit, "1 with tipping=true")
            expect(self.preview == 0, "preview", self.preview, "0 with tipping=true")
        or_null(whole_number, "longest_side", self.longest_side)
        or_null(whole_number, "most_items", self.most_items)
        expect(isinstance(self.reach, Reach | None), "reach", self.reach, "a Reach, such as an Annulus, or None")
        # Each size is valid alone, but their products may exceed the memory.
        bin_size, tote_size = f"bin_size={[*self.bin_size]}", f"tote_size={[*self.tote_size]}"
        refuse_above(f"{bin_size}: the bin has", self.num_picks, "cells", self.max_picks)
        refuse_above(f"{tote_size}: the tote has", self.num_places, "cells", MAX_CELLS)
        refuse_above(f"{bin_size}, {tote_size}: the cell has", self.num_actions, "actions", self.max_actions)
        if self.limits is not None:
            self.limits.check(self)

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
    def footprint_turns(self) -> int:
        """``Q``: 1 if items are never turned, else 2: footprint and effector as they are, or turned by 90 degrees."""
        return 1 if self.rotations == 1 else 2

    @property
    def num_footprints(self) -> int:
        """The number of footprints ``(quarter_turned, x, y)``; an action leaves the item on one of them."""
        return self.footprint_turns * self.num_places

    @property
    def num_choices(self) -> int:
        """The number of choices of an item in the bin and a footprint, ``item * num_footprints + footprint``."""
        return self.bin_items * self.num_footprints

    @property
    def poses(self) -> int:
        """The number of places in the bin that an item takes, see ``tipping``."""
        return POSES if self.tipping else 1

    @property
    def forbids_turns(self) -> bool:
        """Whether some rotations may be forbidden; see ``turns`` of an :class:`~pickplace.rules.item.Item`."""
        return self.handling or "rotations" in self.varies

    @property
    def room(self) -> int:
        """``L``, the number of items that a tote has room for."""
        return self.most_items or self.tote_volume(self.tote_size[2])

    @property
    def record_bytes(self) -> int:
        """About the bytes of what a state records of the items in a tote: what lies on what, and their boxes."""
        return self.handling * self.room**2 + self.support.sees_boxes * 48 * self.room

    @cached_property
    def limits(self) -> Limits | None:
        """The limits of the robot on this cell's grids, see :class:`Limits`; None: no limits."""
        return None if self.reach is None else self.reach.limits(self)

    @cached_property
    def max_side(self) -> int:
        """``S``: the longest item side that fits the bin, and that the gripper can hold."""
        largest = self.gripper.largest_item or self.bin_size[:2]
        longest = max(min(a, b) for a, b in zip(largest, self.bin_size[:2], strict=True))
        return longest if self.longest_side is None else min(longest, self.longest_side)

    @property
    def has_known_offsets(self) -> bool:
        """Whether the number of offsets does not depend on an unknown longest item."""
        return self.gripper.largest_item is not None or self.longest_side is not None

    @cached_property
    def _offsets(self) -> range:
        return self.gripper.offsets(self.max_side, self.rotations)

    @cached_property
    def min_offset(self) -> int:
        """The lowest offset of an item under the end effector along either axis."""
        return self._offsets[0]

    @cached_property
    def num_offsets(self) -> int:
        """``O``, the number of offsets along one axis."""
        return len(self._offsets)

    @cached_property
    def effectors(self) -> tuple[EffectorShape, ...]:
        """The distinct shapes of the turned body: 1, 2 or ``R`` of them; see :meth:`effector`."""
        return self.gripper.shapes(self.rotations)

    def effector(self, rotation: int) -> EffectorShape:
        """Return the shape of the end effector in a rotation."""
        return self.effectors[rotation % len(self.effectors)]

    def describe(self) -> str:
        """Return the sizes in one short line, for messages."""
        bin_size, tote_size, size = (
            "x".join(map(str, sides)) for sides in (self.bin_size, self.tote_size, self.gripper.size)
        )
        return f"bin {bin_size}, tote {tote_size}, gripper {type(self.gripper).__name__} {size}, R={self.rotations}"


#: The settings of a cell, by the names that configs, checkpoints and evaluations use.
CELL_SETTINGS = tuple(item.name for item in fields(CellSpec) if not item.metadata.get("derived"))


def cell_from_settings(settings: dict) -> CellSpec:
    """Return the cell with the settings of a config, by name; raise ``ValueError`` for an unknown name."""
    for name, value in settings.items():
        expect(name in signature(CellSpec).parameters, short_text(name), value, f"one of {', '.join(CELL_SETTINGS)}")
    return CellSpec(**settings)
