"""The problem that a robot's planner solves for items and a tote that were measured in metres."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pickplace.common.validate import number as checked_number
from pickplace.robot.box import MILLIMETRE, Box, DepthMapError, HiddenBox
from pickplace.robot.measure import (
    ROUNDING,
    ToteMap,
    as_array,
    boxes_of_map,
    metric_map,
    patches,
    refuse_stacked,
    touches,
    whole_units,
)
from pickplace.robot.problem import Problem, check_longest, join_items, read_bearing
from pickplace.robot.scene import BinMap, Scene
from pickplace.rules.bin import taken_item
from pickplace.rules.cell import MAX_SIDE, CellSpec
from pickplace.rules.checks import is_within_reach
from pickplace.rules.grasps import carry, footprint_index
from pickplace.rules.gripper.base import effector_centre, reference_cell
from pickplace.rules.item import Item
from pickplace.rules.maps import FAR
from pickplace.rules.masks import PlacingMaps, footprint_mask
from pickplace.rules.measured import MeasuredMaps, MeasuredTote, bearing_after, failures, floor_height, measured_maps
from pickplace.rules.reach.base import Limits
from pickplace.rules.state import State, surface_from


@dataclass(frozen=True, kw_only=True)
class MeasuredProblem(Problem):
    """One item and one tote, in metres; heights are counted in millimetres.

    The pick cells are those of a grid along the item. Where other items lie in the bin, the robot's limits forbid the
    picks at which the end effector would touch one that may be as high.
    """

    measured: MeasuredMaps
    tote: MeasuredTote
    sides: tuple[float, float]  # of the item, in cells
    bin_clear: Tensor  # bool [P], see `failures`
    grip: float  # height of the suction face when it grips the item
    box: Box

    def is_feasible_in_an_empty_tote(self) -> bool:
        flat = torch.zeros_like(self.tote.highest)
        empty = self.tote._replace(highest=flat, lowest=flat, bears=torch.ones_like(self.tote.bears))
        maps = measured_maps(self.cell, empty, self.maps.item, self.sides).maps
        return bool(footprint_mask(self.cell, maps).any())

    def failures(self, actions: Tensor) -> Tensor:
        return failures(self.cell, self.measured, actions, self.bin_clear)

    def bearing_after(self, action: Tensor | None) -> Tensor:
        if action is None:
            return self.tote.bears
        footprint = self._footprint(action)
        return bearing_after(self.cell, self.tote, self.maps.item, self.sides, self.measured, footprint)

    def filled(self) -> float:
        return float(self.tote.highest.double().mean()) / self.tote.height

    def item_share(self) -> float:
        wide, deep, _ = self.cell.tote_size
        box = self.box
        return box.w * box.d * box.h / (wide * deep * self.side**2 * self.tote.height * self.unit)

    def _suction_face(self, x_bin: int, y_bin: int) -> tuple[float, float, float]:
        centres = effector_centres(self.cell, self.maps.item, self.box, self.side)
        return *centres[x_bin * self.cell.bin_size[1] + y_bin], self.grip

    def _top(self, action: Tensor) -> int:
        return int(self.measured.maps.rest.flatten()[self._footprint(action)] + self.maps.item.h)

    def _footprint(self, action: Tensor) -> int:
        carried = carry(self.cell, self.maps.item, action)
        return int(footprint_index(self.cell.tote_size, carried.rotation % 2, carried.x, carried.y))


@dataclass(frozen=True, kw_only=True)
class MeasuredBin(Problem):
    """Several items and one tote, in metres: a problem for each item, none of which shares an action with another."""

    parts: list[MeasuredProblem]

    @classmethod
    def of(cls, parts: list[MeasuredProblem]) -> "MeasuredBin":
        """Return what joins the problems of the items in a bin."""
        limits = parts[0].cell.limits
        assert limits is not None
        everywhere = replace(limits, pick_ok=torch.ones_like(limits.pick_ok))  # each item has its own picks
        cell = replace(parts[0].cell, reach=everywhere, bin_items=len(parts))
        keys = ("top", "clearance", "rest", "greatest_top")
        joined = {key: torch.cat([getattr(part.maps, key) for part in parts]) for key in keys}
        step = parts[0].maps.level_step
        items = join_items([part.maps.item for part in parts])
        seen_items = join_items([part.seen.items.rows(0) for part in parts])
        blocked = ~torch.stack([part.cell.limits.pick_ok for part in parts if part.cell.limits is not None])
        state, seen = parts[0].state._replace(items=items), parts[0].seen._replace(items=seen_items)
        maps = PlacingMaps(**joined, item=items.rows(0), blocked=blocked, bin_items=len(parts), level_step=step)
        return cls(cell=cell, state=state, seen=seen, maps=maps, parts=parts)

    def of_item(self, number: int) -> Problem:
        return self.parts[number]

    def is_feasible_in_an_empty_tote(self) -> bool:
        return any(part.is_feasible_in_an_empty_tote() for part in self.parts)

    def failures(self, actions: Tensor) -> Tensor:
        taken, codes = self.taken_items(actions), torch.empty_like(actions)
        for number, part in enumerate(self.parts):
            codes[taken == number] = part.failures(actions[taken == number])
        return codes

    def bearing_after(self, action: Tensor | None) -> Tensor:
        part = self.parts[0 if action is None else int(self.taken_items(action))]
        return part.bearing_after(action)

    def filled(self) -> float:
        return self.parts[0].filled()


def effector_centres(cell: CellSpec, item: Item, box: Box, side: float) -> np.ndarray:
    """Return the centre of the end effector in the bin's frame at every pick cell, ``[P, 2]``; m.

    The cells are those of a grid along the item, in which it lies at whole cells.

    Args:
        item: of one problem, on that grid.
        box: the same as it was measured.
        side: length of a cell, m.
    """
    (ee_w, ee_d), (x, y, w, d) = cell.gripper.size, map(int, item[:4])
    number = np.arange(cell.num_picks)
    x_bin, y_bin = number // cell.bin_size[1], number % cell.bin_size[1]
    along = np.stack([effector_centre(x_bin, ee_w) - (x + w / 2), effector_centre(y_bin, ee_d) - (y + d / 2)], -1)
    turn = math.radians(box.yaw)
    axes = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    return np.array((box.x, box.y)) + side * along @ axes


class _PlacedItem(NamedTuple):
    """An item as it was measured, and at whole cells of a grid that lies along it."""

    box: Box
    item: Item  # of one problem; its height in millimetres
    sides: tuple[float, float]  # in cells
    inset: tuple[int, int]  # cells at each edge that the item, narrower by its clearance, does not cover as a whole


def read_metric(cell: CellSpec, scene: Scene, device) -> Problem:
    """Return the problem of a scene in metres; errors as of :meth:`Planner.plan`."""
    cell_size, accuracy = scene.cell_size, scene.accuracy
    assert cell_size is not None
    unit = cell_size * cell.height_unit
    boxes, clearance = _read_boxes(cell, scene, cell_size)
    tote = _read_tote(cell, scene, unit, device)
    placed = [_place(cell, box, cell_size, clearance, f"items[{number}]", device) for number, box in enumerate(boxes)]

    ratio = unit / MILLIMETRE
    longest = max(int(side) for one in placed for side in one.item[2:4])
    free = replace(
        cell,
        bin_size=(*cell.bin_size[:2], 1),
        tote_size=(*cell.tote_size[:2], tote.height),
        height_unit=MILLIMETRE / cell_size,
        bin_items=1,
        item_inset=(max(one.inset[0] for one in placed), max(one.inset[1] for one in placed)),
        longest_side=cell.longest_side or (None if cell.has_known_offsets else longest),
    )
    # A policy sees heights as in training.
    state, seen_rim = tote.state(free, placed[0].item), max(1, round(tote.height / ratio))
    heights = (state.heights / ratio).round().clamp(max=seen_rim).int()
    seen = State(surface_from(heights, tote.bears[None]), torch.tensor([seen_rim], device=device), state.items)
    parts, taken = [], _item_of_each_pick(free, placed)
    for number, (box, item, sides, _) in enumerate(placed):
        h = int(item.h)
        centres = effector_centres(free, item, box, cell_size)
        above_walls = box.h - accuracy >= cell.bin_size[2] * unit - ROUNDING
        clear = above_walls | _misses_walls(centres, cell, box.yaw, cell_size)
        if isinstance(box, HiddenBox):
            clear = np.zeros_like(clear)
        clear &= ~_hits_others(centres, cell, number, boxes, cell_size, accuracy, clearance)
        bin_clear = torch.from_numpy(clear).to(device)
        limits = _limits(cell, free, bin_clear, centres / cell_size, h + tote.accuracy, 2 * tote.accuracy)
        limits = replace(limits, pick_ok=limits.pick_ok & (taken == number))
        limited = replace(free, reach=limits)
        measured = measured_maps(limited, tote, item, sides)
        alone = item.rows((slice(None), None))
        seen_item = alone._replace(h=torch.tensor([[max(1, round(h / ratio))]], device=device))
        parts.append(MeasuredProblem(
            cell=limited, state=state._replace(items=alone), maps=measured.maps, seen=seen._replace(items=seen_item),
            yaw=box.yaw, side=cell_size, unit=MILLIMETRE, grip=(h + tote.accuracy) * MILLIMETRE,
            release=2 * tote.accuracy * MILLIMETRE, box=box, measured=measured, tote=tote, sides=sides,
            bin_clear=bin_clear,
        ))  # fmt: skip
    return parts[0] if len(parts) == 1 else MeasuredBin.of(parts)


def _read_boxes(cell: CellSpec, scene: Scene, side: float) -> tuple[list[Box], float]:
    """Return the items, and the clearance that they need: none if a map with one value a cell shows them."""
    accuracy, clearance = scene.accuracy, scene.clearance
    if isinstance(scene.items, BinMap):
        least = -max(4 * accuracy, 0.01)
        heights = metric_map("bin_depth", scene.items.depth, cell.bin_size[:2], least, MAX_SIDE * MILLIMETRE)
        is_cell_map, square = len(heights) == cell.bin_size[0], side * cell.bin_size[0] / len(heights)
        clearance = 0.0 if is_cell_map else clearance
        boxes = boxes_of_map(heights, scene.items.labels, square, accuracy, is_cell_map)
    else:
        boxes = [box.upright() for box in scene.items]
        for number, box in enumerate(boxes):
            for key, size in zip("xy", cell.bin_size[:2], strict=True):
                if not 0 <= (at := getattr(box, key)) <= size * side:
                    raise DepthMapError(f"items[{number}].{key}={at:g}: expected 0 to {size * side:g} m, in the bin.")
        refuse_stacked(boxes, max(clearance, accuracy))
    for number, box in enumerate(boxes):
        if cell.rotations == 1 and abs(box.yaw) > ROUNDING:
            raise DepthMapError(
                f"items[{number}].yaw={box.yaw:g}: expected 0 with rotations=1: this robot turns nothing."
            )
    return boxes, clearance


def _read_tote(cell: CellSpec, scene: Scene, unit: float, device) -> MeasuredTote:
    """Return the tote, in millimetres; ``unit`` is the length of a height unit, in metres."""
    grid, slack, height = cell.tote_size[:2], math.ceil(scene.accuracy / MILLIMETRE - ROUNDING), scene.tote_height
    if height is None:
        height = checked_number("tote_height", cell.tote_size[2] * unit, MILLIMETRE, MAX_SIDE * MILLIMETRE, "metres")
    rim, over_rim = (int(whole_units(height, MILLIMETRE, up)) for up in (False, True))
    if isinstance(scene.tote, ToteMap):
        highest, lowest = (as_array("tote", part, grid) for part in scene.tote)
    else:
        beyond = max(4 * scene.accuracy, 0.01)  # a floor or a rim that noise puts a little out of range
        depth = metric_map("tote_depth", scene.tote, grid, -beyond, height + beyond)
        highest, lowest = patches(height - depth, grid)
    high, low = (whole_units(part.clip(0, None), MILLIMETRE, up) for part, up in ((highest, True), (lowest, False)))
    count = len(high) // grid[0]
    on_floor = (high <= floor_height(slack)).unflatten(0, (-1, count)).unflatten(2, (-1, count)).all(3).all(1)
    bears = read_bearing(cell, scene.tote_bearing, on_floor).bool()
    if scene.tote_bearing is None and count == 1:
        bears = on_floor  # one value a cell does not tell whether the cell is level
    return MeasuredTote(high.to(device), low.to(device), bears.to(device), rim, over_rim, slack)


def _place(cell: CellSpec, box: Box, cell_size: float, clearance: float, name: str, device) -> _PlacedItem:
    """Return an item at whole cells of a grid that lies along it; refuse one that is too large."""
    sides = box.w / cell_size, box.d / cell_size
    whole = [max(1, math.ceil((side + 2 * clearance) / cell_size - ROUNDING)) for side in (box.w, box.d)]
    for key, size, most_cells in zip("wd", whole, cell.bin_size[:2], strict=True):
        if size > most_cells:
            raise DepthMapError(
                f"{name}.{key}={getattr(box, key):g}: with its clearance it takes {size} cells; expected at most "
                f"{most_cells}, those of the bin."
            )
    h = int(whole_units(box.h, MILLIMETRE, up=True))
    least = [
        min(max(0, round(at / cell_size - size / 2)), most_cells - size)
        for at, size, most_cells in zip((box.x, box.y), whole, cell.bin_size[:2], strict=True)
    ]
    item = Item(*(torch.tensor([part], device=device) for part in (*least, *whole, h)))
    check_longest(cell, item, name)
    inset = [
        math.ceil((size - side) / 2 + clearance / cell_size - ROUNDING) for size, side in zip(whole, sides, strict=True)
    ]
    return _PlacedItem(box, item, sides, (inset[0], inset[1]))


def _item_of_each_pick(cell: CellSpec, placed: Sequence[_PlacedItem]) -> Tensor:
    """Return the number of the item that each pick cell takes, int64 ``[P]``, so that an action means one pose.

    Each item has a grid of its own. A pick cell that grips several of them stands for the highest, as on the grid.
    """
    pick = torch.arange(cell.num_picks, device=placed[0].item.x.device)
    items = join_items([one.item for one in placed]).map(lambda part: part.expand(len(pick), -1))
    return taken_item(cell, items, pick // cell.bin_size[1], pick % cell.bin_size[1])


def _misses_walls(centres: np.ndarray, cell: CellSpec, yaw: float, side: float) -> np.ndarray:
    """Return at which of its centres ``[P, 2]`` the end effector misses the bin's walls, bool ``[P]``.

    The rectangle around it decides.
    """
    turn, (wide, deep) = math.radians(yaw), (size * side / 2 for size in cell.gripper.size)
    cos, sin = abs(math.cos(turn)), abs(math.sin(turn))
    reach, far = np.array([wide * cos + deep * sin, wide * sin + deep * cos]), np.array(cell.bin_size[:2]) * side
    return ((centres >= reach - ROUNDING) & (centres <= far - reach + ROUNDING)).all(1)


def _hits_others(
    centres: np.ndarray, cell: CellSpec, number: int, boxes: list[Box], side: float, accuracy: float, clearance: float
) -> np.ndarray:
    """Return at which of its centres ``[P, 2]`` the end effector touches another box that may be as high, ``[P]``.

    The rectangle around it decides, which is turned with the item; other boxes are wider by the clearance. Boxes that
    are clearly lower are ignored.

    Args:
        number: of the item that is picked, among the boxes.
    """
    box = boxes[number]
    sides = cell.gripper.size[0] * side, cell.gripper.size[1] * side
    wide = [
        replace(other, w=other.w + 2 * clearance, d=other.d + 2 * clearance)
        for other in boxes[:number] + boxes[number + 1 :]
        if other.h + accuracy >= box.h - accuracy - ROUNDING
    ]
    return np.any([np.zeros(len(centres)), *(touches(centres, sides, box.yaw, other) for other in wide)], 0)


def _limits(cell: CellSpec, free: CellSpec, bin_clear: Tensor, centres: np.ndarray, grip: int, release: int) -> Limits:
    """Return the limits of the robot, with tops in millimetres, and the picks at which no wall is hit.

    Args:
        cell: of the robot, with its limits, if any.
        free: the same with heights in millimetres, for which those of a reach were computed anew.
        bin_clear: bool ``[P]``.
        centres: of the end effector in the bin at each pick cell, in cells, ``[P, 2]``.
        grip: height of the suction face when it grips the item, mm.
        release: height of the suction face above the item's planned top when it lets go, mm.
    """
    device, limits, ratio = bin_clear.device, free.limits, 1.0
    if isinstance(cell.reach, Limits):  # tables in the height units of the cell
        ratio = cell.height_unit / free.height_unit
    if limits is None:
        places = torch.zeros(cell.rotations, *cell.tote_size[:2], dtype=torch.int64, device=device)
        return Limits(bin_clear, places, places + FAR)
    return Limits(
        bin_clear & _reached_picks(cell, free, limits, ratio, centres, grip).to(device),
        (limits.lowest_top * ratio - release).ceil().long().to(device),
        (limits.highest_top.clamp(max=FAR) * ratio - release).floor().clamp(max=FAR).long().to(device),
    )


def _reached_picks(
    cell: CellSpec, free: CellSpec, limits: Limits, ratio: float, centres: np.ndarray, grip: int
) -> Tensor:
    """Return at which of its centres ``[P, 2]`` in the bin the robot reaches the item, bool ``[P]``.

    Args:
        limits: of picks at whole cells; the centres lie between these, and all neighbours must be allowed.
        ratio: millimetres of their height unit.
        cell, free, grip: as of :func:`_limits`.
    """
    face = torch.tensor(grip)
    if cell.reach is not None and (exact := cell.reach.picks(free, *torch.from_numpy(centres).unbind(1))):
        return is_within_reach(*exact, face)
    (bin_w, bin_d, _), reached = cell.bin_size, limits.pick_ok
    if limits.lowest_pick is not None and limits.highest_pick is not None:
        reached = reached & is_within_reach(limits.lowest_pick * ratio, limits.highest_pick * ratio, face)
    allowed = F.pad(reached.view(bin_w, bin_d), (1, 1, 1, 1), value=False).cpu().numpy()
    at = [centres[:, axis] - side / 2 + reference_cell(side) for axis, side in enumerate(cell.gripper.size)]
    good = np.ones(len(centres), dtype=bool)
    for round_x in (np.floor, np.ceil):
        for round_y in (np.floor, np.ceil):
            x, y = (part.round(6) for part in at)
            x, y = round_x(x).clip(-1, bin_w).astype(int) + 1, round_y(y).clip(-1, bin_d).astype(int) + 1
            good &= allowed[x, y]
    return torch.from_numpy(good)
