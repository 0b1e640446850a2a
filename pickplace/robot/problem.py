"""The problem that a robot's planner solves for the items in a bin, and how it is read from the maps of a grid."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pickplace.robot.box import Box, DepthMapError
from pickplace.robot.measure import labels_of_map, refuse, whole_map
from pickplace.robot.scene import BinMap, Scene
from pickplace.rules.bin import taken_item
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import split_action
from pickplace.rules.gripper.base import effector_centre
from pickplace.rules.item import Item
from pickplace.rules.maps import FAR
from pickplace.rules.masks import PlacingMaps, footprint_mask, placing_maps
from pickplace.rules.state import EMPTY, State, surface_from
from pickplace.rules.step import apply


@dataclass(frozen=True)
class Pose:
    """Pose of the end effector, in the frame of the bin or of the tote."""

    cell: tuple[int, int]  #: grid cell of the end effector's reference cell
    center: tuple[float, float, float]  #: centre of its suction face: x, y, z
    yaw: float = 0.0  #: turn about the vertical axis, counter-clockwise seen from above; degrees


@dataclass(frozen=True, kw_only=True)
class Problem:
    """The items in a bin, one tote, and what decides which actions succeed: on the grid, by the rules of training.

    The states have items ``[1, M]``. What needs one item is asked of :meth:`of_item`.
    """

    cell: CellSpec
    state: State  # heights in the height units of `cell`
    maps: PlacingMaps
    seen: State  # the state as a policy sees it, in the height units of its training
    yaw: float = 0.0  # of the item, degrees
    side: float = 1.0  # length of a cell
    unit: float = 1.0  # length of a height unit
    release: float = 0.0  # height of the suction face above the item's planned top when it lets go
    box: Box | None = None

    @property
    def bin_items(self) -> int:
        """``M``, the number of items in the bin."""
        return self.maps.bin_items

    def taken_items(self, actions: Tensor) -> Tensor:
        """Return the number of the item that each flat action takes, int64 ``[A]``; 0 for a pick that grips none."""
        items = self.state.items.map(lambda part: part.expand(len(actions), -1))
        return taken_item(self.cell, items, *split_action(self.cell, actions)[:2])

    def of_item(self, number: int) -> "Problem":
        """Return the problem of one item, as if it lay alone."""
        at = torch.tensor([number], device=self.state.surface.device)
        maps, _ = self.maps.of_choice(self.cell, at * self.cell.num_footprints)
        state, seen = (each._replace(items=each.items.rows((slice(None), at))) for each in (self.state, self.seen))
        return replace(self, state=state, seen=seen, maps=maps._replace(blocked=None))

    def is_feasible(self) -> bool:
        """Return whether any action succeeds."""
        return bool(footprint_mask(self.cell, self.maps).any())

    def is_feasible_in_an_empty_tote(self) -> bool:
        """Return whether any action would succeed in an empty tote."""
        empty = self.state._replace(surface=torch.full_like(self.state.surface, EMPTY))
        return bool(footprint_mask(self.cell, placing_maps(self.cell, empty)).any())

    def failures(self, actions: Tensor) -> Tensor:
        """Return the failure codes of flat actions, int64 ``[A]``."""
        parts = actions.split(4096)  # a few thousand at a time, to save memory
        return torch.cat([apply(self.cell, self.state.repeat(len(part)), part).failure for part in parts])

    def bearing_after(self, action: Tensor | None) -> Tensor:
        """Return where the tote bears weight after an action that succeeds, bool ``[W_T, D_T]``."""
        surface = self.state.surface if action is None else apply(self.cell, self.state, action).surface
        return (surface[0] & 1).bool()

    def filled(self) -> float:
        """Return the share of the tote's volume below its surface, 0 to 1."""
        return int(self.state.heights.sum()) / self.cell.tote_volume(int(self.state.tote_height))

    def item_share(self) -> float:
        """Return the item's share of the tote's volume."""
        return int(self.state.items.volume) / self.cell.tote_volume(int(self.state.tote_height))

    def drop_height(self, top: int) -> float:
        """Return the height of the item's underside once it rests with its top at ``top`` height units."""
        return self._length((top - int(self.state.items.h)) * self.unit)

    def poses(self, action: Tensor) -> tuple[Pose, Pose, float, int]:
        """Return the poses at pick and place, the turn in degrees, and the item's top in height units."""
        cell = self.cell
        x_bin, y_bin, x_tote, y_tote, rotation = (int(part) for part in split_action(cell, action))
        shape = cell.effector(rotation)
        x, y, z = self._suction_face(x_bin, y_bin)
        pick = Pose((x_bin, y_bin), (self._length(x), self._length(y), self._length(z)), round(self.yaw, 6))
        top = self._top(action)
        centre = (
            self._length(effector_centre(x_tote, shape.width) * self.side),
            self._length(effector_centre(y_tote, shape.depth) * self.side),
            self._length(top * self.unit + self.release),
        )
        turn = round(90 * rotation - self.yaw, 6)
        return pick, Pose((x_tote, y_tote), centre, 90.0 * rotation), turn, top

    def _suction_face(self, x_bin: int, y_bin: int) -> tuple[float, float, float]:
        """Return the centre of the suction face over a pick cell when it grips the item."""
        wide, deep = self.cell.gripper.size
        return effector_centre(x_bin, wide), effector_centre(y_bin, deep), int(self.state.items.h)

    def _top(self, action: Tensor) -> int:
        return int(apply(self.cell, self.state, action).top[0])

    @staticmethod
    def _length(value: float) -> float:
        return round(float(value), 9)  # without the tail of binary fractions


def read_grid(cell: CellSpec, scene: Scene, device) -> Problem:
    """Return the problem of a scene in whole cells; errors as of :meth:`Planner.plan`."""
    assert isinstance(scene.items, BinMap)
    unit = " cells" if cell.height_unit == 1 else " height units"
    height = cell.tote_size[2] if scene.tote_height is None else round(scene.tote_height)
    bin_map = whole_map("bin_depth", scene.items.depth, cell.bin_size[:2], FAR, unit)
    tote_map = torch.from_numpy(whole_map("tote_depth", scene.tote, cell.tote_size[:2], height, unit))
    items = _read_items(bin_map, scene.items.labels, unit)
    for item in items:
        check_longest(cell, item, "bin_depth")
    bearing = read_bearing(cell, scene.tote_bearing, tote_map == height)
    state = State(
        surface_from(height - tote_map, bearing)[None].to(device),
        torch.tensor([height], device=device),
        join_items(items).map(lambda part: part.to(device)),
    )
    cell = replace(cell, bin_items=len(items))
    return Problem(cell=cell, state=state, maps=placing_maps(cell, state), seen=state)


def join_items(items: list[Item]) -> Item:
    """Return items ``[1]`` as those of one bin, ``[1, M]``."""
    return Item(*(torch.stack(parts, 1) for parts in zip(*items, strict=True)))


def _read_items(bin_map: np.ndarray, bin_labels, unit: str) -> list[Item]:
    """Return the items in a bin ``[W_B, D_B]``, each with parts ``[1]``; in the order of their labels, if any."""
    if bin_labels is None:
        if not bin_map.any():
            raise DepthMapError("bin_depth: got no cell above 0, expected one item.")
        return [_read_cuboid(bin_map, bin_map > 0, unit, "; of several items give bin_labels, too")]
    segments = labels_of_map(bin_labels, bin_map, 0)
    return [_read_cuboid(bin_map, segment, f"{unit} with label {label}") for label, segment in segments.items()]


def _read_cuboid(bin_map: np.ndarray, segment: np.ndarray, unit: str, hint: str = "") -> Item:
    """Return the item of a segment of the bin, bool ``[W_B, D_B]``; refuse all but a box filled at one height."""
    heights, filled = np.where(segment, bin_map, 0), np.argwhere(segment)
    (x, y), (w, d), h = filled.min(0), np.ptp(filled, 0) + 1, heights.max()
    bad = np.zeros_like(segment)
    bad[x : x + w, y : y + d] = heights[x : x + w, y : y + d] != h
    expected = f"{h}: one cuboid that fills its bounding box, {w}x{d} cells from [{x}, {y}]{hint}"
    refuse("bin_depth", bad, heights, unit, expected)
    return Item(*(torch.tensor([int(value)]) for value in (x, y, w, d, h)))


def check_longest(cell: CellSpec, item: Item, key: str) -> None:
    """Refuse an item that is longer than the tables of grasps hold."""
    longest = max(int(item.w), int(item.d))
    if cell.gripper.largest_item is None and longest > cell.max_side:
        raise DepthMapError(
            f"{key}: the item is {longest} cells long, longer than any in training; expected at most {cell.max_side}."
        )


def read_bearing(cell: CellSpec, tote_bearing, on_floor: Tensor) -> Tensor:
    """Return where the tote bears weight, int64 ``[W_T, D_T]``: as plans before say, and on the floor."""
    if tote_bearing is None:
        return torch.ones_like(on_floor, dtype=torch.int64)
    bearing = torch.from_numpy(whole_map("tote_bearing", tote_bearing, cell.tote_size[:2], 1, kinds="biuf"))
    bearing = torch.where(on_floor, 1, bearing)  # this may be another tote
    if not cell.support.marks_bearing and not bearing.all():
        raise DepthMapError(f"tote_bearing: got a 0 with support={cell.support}, expected support=bearing.")
    return bearing
