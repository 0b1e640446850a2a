"""The problem that a robot's planner solves for the items in a bin, and its version in whole cells of a grid."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pickplace.common.validate import excerpt, expect, is_number, refuse_if
from pickplace.robot.box import Box, DepthMapError
from pickplace.robot.measure import LABEL_HINT, refuse, segments_of_map, whole_map
from pickplace.robot.scene import BinMap, Scene
from pickplace.rules.bin import select_item, taken_item
from pickplace.rules.cell import CellSpec
from pickplace.rules.failures import FailureMaps
from pickplace.rules.grasps import carry, footprint_index, split_action
from pickplace.rules.gripper.base import effector_centre
from pickplace.rules.item import Item
from pickplace.rules.maps import FAR
from pickplace.rules.masks import PlacingMaps, footprint_mask, placing_maps
from pickplace.rules.reach.base import Limits
from pickplace.rules.state import EMPTY, State, surface_from
from pickplace.rules.step import apply

MAX_EXCLUDED = 1_000  # points of picks that failed


@dataclass(frozen=True)
class Pose:
    """Pose of the end effector, in the frame of the bin or of the tote."""

    cell: tuple[int, int]  #: grid cell of the end effector's reference cell
    #: tool centre point, x, y, z: twice the accuracy above the middle of the lip at rest; m with cell_size, else x and
    #: y in cells and z in height units
    center: tuple[float, float, float]
    #: turn about the vertical axis, counter-clockwise seen from above, degrees: the angle from the frame's x to the
    #: end effector's width
    yaw: float = 0.0

    @property
    def matrix(self) -> np.ndarray:
        """The tool frame in the frame of the bin or of the tote, ``[4, 4]``, in the unit of :attr:`center`.

        Its origin is the tool centre point, x runs along the end effector's width, and z downwards.
        """
        cos, sin = math.cos(math.radians(self.yaw)), math.sin(math.radians(self.yaw))
        x, y, z = self.center
        return np.array([(cos, sin, 0, x), (sin, -cos, 0, y), (0, 0, -1, z), (0, 0, 0, 1)])


@dataclass(frozen=True, kw_only=True)
class Problem(ABC):
    """The items in a bin, one tote, and the data that decide which actions succeed.

    The states have items ``[1, M]``.
    """

    cell: CellSpec
    state: State  # heights in the height units of `cell`
    maps: PlacingMaps
    seen: State  # the state as a policy sees it, in the height units of its training
    boxes: Sequence[Box] = ()  # the items as they were measured; none on the grid
    numbers: Sequence[int]  # of the items, in the scene
    names: Sequence[str]  # of the items, in messages
    side: float = 1.0  # length of a cell
    unit: float = 1.0  # length of a height unit
    release: float = 0.0  # height of the suction face above the item's planned top when it lets go

    @abstractmethod
    def is_feasible_in_empty_tote(self) -> bool:
        """Return whether any action would succeed in an empty tote."""

    @abstractmethod
    def failures(self, actions: Tensor) -> Tensor:
        """Return the failure codes of flat actions, int64 ``[A]``."""

    @abstractmethod
    def bearing_after(self, action: Tensor | None) -> Tensor:
        """Return a mask of the cells that bear weight after a successful action; None: now; bool ``[W_T, D_T]``."""

    @abstractmethod
    def shares(self, number: int) -> tuple[float, float]:
        """Return two shares of the tote's volume, 0 to 1: the part below its surface, and the volume of an item."""

    @abstractmethod
    def suction_face(self, number: int, x_bin: int, y_bin: int) -> tuple[float, float, float]:
        """Return the centre of the suction face over a pick cell when it grips an item."""

    def taken_items(self, actions: Tensor) -> Tensor:
        """Return the number of the item that each flat action takes, int64 ``[A]``; 0 for a pick that grips none."""
        items = self.state.items.map(lambda part: part.expand(len(actions), -1))
        return taken_item(self.cell, items, *split_action(self.cell, actions)[:2])

    def choice_of(self, action: Tensor) -> Tensor:
        """Return the choice that a flat action ``[1]`` makes: ``item * num_footprints + footprint``, int64 ``[1]``."""
        number = self.taken_items(action)
        item = select_item(self.state.items, number)
        _, rotation, _, (x, y, *_) = carry(self.cell, item, action)
        quarter_turned = rotation % 2 * (item.w != item.d)  # masks list a square footprint as not turned
        return number * self.cell.num_footprints + footprint_index(self.cell.tote_size, quarter_turned, x, y)

    @property
    def insets(self) -> list[tuple[int, int]]:
        """The ``item_inset`` of each item, see :class:`~pickplace.rules.cell.CellSpec`."""
        return [self.cell.item_inset] * self.state.items.w.shape[1]

    def hints(self) -> list[str]:
        """Return a sentence for each item that the gripper cannot grip, wherever it lies."""
        gripper, sides = self.cell.gripper, zip(*(part[0].tolist() for part in self.state.items[2:4]), strict=True)
        scale = f", with cells of {1000 * self.side:g} mm" if self.boxes else ""
        return [
            f"{name}: {gripper.misfit}{scale}; no pick takes it."
            for name, (w, d), inset in zip(self.names, sides, self.insets, strict=True)
            if not gripper.can_grip(w, d, inset)
        ]

    def motion(self, action: Tensor) -> tuple[Pose, Pose, float, float]:
        """Return the poses at pick and place, the turn in degrees, and the height of the item's underside at rest."""
        x_bin, y_bin, x_tote, y_tote, rotation = (int(part) for part in split_action(self.cell, action))
        number, shape = int(self.taken_items(action)), self.cell.effector(rotation)
        rest, height = int(self.maps.rest.flatten()[self.choice_of(action)]), int(self.state.items.h[0, number])
        yaw = self.boxes[number].yaw if self.boxes else 0.0
        x, y = effector_centre(x_tote, shape.width) * self.side, effector_centre(y_tote, shape.depth) * self.side
        pick = Pose((x_bin, y_bin), _point(*self.suction_face(number, x_bin, y_bin)), round(yaw, 6))
        place = Pose((x_tote, y_tote), _point(x, y, (rest + height) * self.unit + self.release), 90.0 * rotation)
        return pick, place, round(90 * rotation - yaw, 6), round(rest * self.unit, 9)


@dataclass(frozen=True, kw_only=True)
class GridProblem(Problem):
    """A problem on the grid, by the rules of training."""

    facts: FailureMaps

    def is_feasible_in_empty_tote(self) -> bool:
        empty = self.state._replace(surface=torch.full_like(self.state.surface, EMPTY))
        return bool(footprint_mask(self.cell, placing_maps(self.cell, empty)).any())

    def failures(self, actions: Tensor) -> Tensor:
        return self.facts.codes(self.cell, actions)

    def bearing_after(self, action: Tensor | None) -> Tensor:
        surface = self.state.surface if action is None else apply(self.cell, self.state, action).surface
        return (surface[0] & 1).bool()

    def shares(self, number: int) -> tuple[float, float]:
        total = self.cell.tote_volume(int(self.state.tote_height))
        return int(self.state.heights.sum()) / total, int(self.state.items.volume[0, number]) / total

    def suction_face(self, number: int, x_bin: int, y_bin: int) -> tuple[float, float, float]:
        wide, deep = self.cell.gripper.size
        return effector_centre(x_bin, wide), effector_centre(y_bin, deep), int(self.state.items.h[0, number])


def _point(x: float, y: float, z: float) -> tuple[float, float, float]:
    return round(float(x), 9), round(float(y), 9), round(float(z), 9)  # without the rounding errors of floating point


def is_excluded(exclude: Sequence[Sequence[float]], centres: np.ndarray, side: float) -> np.ndarray:
    """Return a mask of the centres ``[P, 2]`` of the suction face within half a cell of a point, bool ``[P]``.

    Args:
        exclude: points ``(x, y, ...)``, in the unit of the centres.
        side: of a cell, in the same.

    Raises:
        ValueError: naming the first entry that is no point.
    """
    refuse_if(
        not isinstance(exclude, (list, tuple)) or len(exclude) > MAX_EXCLUDED,
        f"exclude={excerpt(exclude)}: expected a list of at most {MAX_EXCLUDED:,} points.",
    )
    found = np.zeros(len(centres), dtype=bool)
    for number, point in enumerate(exclude):
        good = isinstance(point, (list, tuple)) and len(point) in (2, 3) and all(map(is_number, point))
        expect(good, f"exclude[{number}]", point, "numbers x, y or x, y, z, such as the pick.center of a plan")
        found |= np.hypot(*(centres - np.array(point[:2], dtype=np.float64)).T) < side / 2
    return found


def without_excluded(cell: CellSpec, exclude: Sequence[Sequence[float]]) -> CellSpec:
    """Return the cell, with excluded picks out of the robot's reach; see :func:`is_excluded`, with points in cells."""
    x_bin, y_bin = np.divmod(np.arange(cell.num_picks), cell.bin_size[1])
    (wide, deep), limits = cell.gripper.size, cell.limits
    centres = np.stack([effector_centre(x_bin, wide), effector_centre(y_bin, deep)], -1)
    if not (excluded := torch.from_numpy(is_excluded(exclude, centres, 1.0))).any():
        return cell
    if limits is None:
        return replace(cell, reach=Limits.of_picks(cell, ~excluded))
    return replace(cell, reach=replace(limits, pick_ok=limits.pick_ok & ~excluded.to(limits.pick_ok.device)))


def read_grid(cell: CellSpec, scene: Scene, device, exclude: Sequence[Sequence[float]] = ()) -> Problem:
    """Return the problem of a scene in whole cells; see :meth:`Planner.plan` for arguments and errors."""
    assert isinstance(scene.items, BinMap)
    unit = " cells" if cell.height_unit == 1 else " height units"
    height = cell.tote_size[2] if scene.tote_height is None else round(scene.tote_height)
    bin_map = whole_map("bin_depth", scene.items.depth, cell.bin_size[:2], FAR, unit)
    tote_map = torch.from_numpy(whole_map("tote_depth", scene.tote, cell.tote_size[:2], height, unit))
    segments = segments_of_map(scene.items.labels, bin_map, 0)
    names = [f"bin_depth{name}" for name in segments]
    items = [
        check_longest(cell, _read_cuboid(bin_map, segment, unit, name), f"bin_depth{name}")
        for name, segment in segments.items()
    ]
    state = State(
        surface_from(height - tote_map, read_bearing(cell, scene.tote_bearing, tote_map == height))[None].to(device),
        torch.tensor([height], device=device),
        join_items(items).map(lambda part: part.to(device)),
    )
    wall = cell.bin_size[2] if scene.bin_height is None else round(scene.bin_height)
    cell = without_excluded(replace(cell, bin_items=len(items), bin_size=(*cell.bin_size[:2], wall)), exclude)
    facts = FailureMaps.of(cell, state)
    return GridProblem(
        cell=cell, state=state, maps=facts.placing_maps(cell), seen=state, numbers=range(len(items)), names=names,
        facts=facts,
    )  # fmt: skip


def check_robot_cell(cell: CellSpec) -> None:
    """Refuse a cell that no robot can have; raise ``ValueError``."""
    refuse_if(cell.tipping, "env.tipping=true: a robot's gripper does not tip items; expected false.")
    refuse_if(
        cell.support.sees_boxes,
        f"env.support={cell.support}: it looks at all boxes in the tote, which images do not show; expected another "
        "rule, such as bearing.",
    )


def join_items(items: list[Item]) -> Item:
    """Join items ``[1]`` to the items of one bin, ``[1, M]``."""
    return Item(*(torch.stack(parts, 1) for parts in zip(*items, strict=True)))


def _read_cuboid(bin_map: np.ndarray, segment: np.ndarray, unit: str, name: str) -> Item:
    """Return the item of a segment of the bin, bool ``[W_B, D_B]``; refuse one that is no box of a single height."""
    heights, filled = np.where(segment, bin_map, 0), np.argwhere(segment)
    (x, y), (w, d), h = filled.min(0), np.ptp(filled, 0) + 1, heights.max()
    bad = np.zeros_like(segment)
    bad[x : x + w, y : y + d] = heights[x : x + w, y : y + d] != h
    refuse(
        "bin_depth", bad, heights, unit + name,
        f"{h}: one cuboid that fills its bounding box, {w}x{d} cells from [{x}, {y}]{'' if name else LABEL_HINT}",
    )  # fmt: skip
    return Item(*(torch.tensor([int(value)]) for value in (x, y, w, d, h)))


def check_longest(cell: CellSpec, item: Item, key: str) -> Item:
    """Return the item; refuse it if it is too long for the tables of grasps."""
    longest = max(int(item.w), int(item.d))
    refuse_if(
        cell.gripper.largest_item is None and longest > cell.max_side,
        f"{key}: the item is {longest} cells long, longer than any in training; expected at most {cell.max_side}.",
        DepthMapError,
    )
    return item


def read_bearing(cell: CellSpec, tote_bearing, on_floor: Tensor) -> Tensor:
    """Return 1 where the tote bears weight, int64 ``[W_T, D_T]``: on the floor, and where earlier plans say so."""
    if tote_bearing is None:
        return torch.ones_like(on_floor, dtype=torch.int64)
    bearing = torch.from_numpy(whole_map("tote_bearing", tote_bearing, cell.tote_size[:2], 1, kinds="biuf"))
    bearing = torch.where(on_floor, 1, bearing)  # the map may be of an earlier tote
    refuse_if(
        not cell.support.marks_bearing and not bearing.all(),
        f"tote_bearing: got a 0 with support={cell.support}, expected support=bearing.",
        DepthMapError,
    )
    return bearing
