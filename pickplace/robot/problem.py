"""The problem that a robot's planner solves for one item: on the grid as in training, or as it was measured."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pickplace.robot.camera import ToteMap
from pickplace.robot.measure import (
    MILLIMETRE,
    ROUNDING,
    Box,
    DepthMapError,
    as_array,
    box_of_map,
    checked_box,
    checked_number,
    flags_of_map,
    metric_map,
    patches,
    whole_map,
    whole_units,
)
from pickplace.task.cell import MAX_SIDE, CellSpec, Limits, effector_centre, reference_cell
from pickplace.task.feasibility import PlacingMaps, footprint_mask, placing_maps
from pickplace.task.grasps import carry, footprint_index, split_action
from pickplace.task.maps import FAR
from pickplace.task.measured import MeasuredMaps, MeasuredTote, bearing_after, failures, floor_height, measured_maps
from pickplace.task.placing import is_within_reach
from pickplace.task.state import EMPTY, Item, State, item_from_depth, surface_from
from pickplace.task.transition import apply


@dataclass(frozen=True)
class Pose:
    """Pose of the end effector, in the frame of the bin or of the tote."""

    cell: tuple[int, int]  #: grid cell of the end effector's reference cell
    center: tuple[float, float, float]  #: centre of its suction face: x, y, z
    yaw: float = 0.0  #: turn about the vertical axis, counter-clockwise seen from above; degrees


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One item, one tote, and what decides which actions succeed: on the grid, by the rules of training."""

    cell: CellSpec
    state: State  # heights in the height units of `cell`
    maps: PlacingMaps
    seen: State  # the state as a policy sees it, in the height units of its training
    centre: tuple[float, float]  # of the item in the bin
    yaw: float = 0.0  # of the item, degrees
    side: float = 1.0  # length of a cell
    unit: float = 1.0  # length of a height unit
    grip: float  # height of the suction face when it grips the item
    release: float = 0.0  # height of the suction face above the item's planned top when it lets go
    box: Box | None = None

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
        return int(self.state.item.volume) / self.cell.tote_volume(int(self.state.tote_height))

    def drop_height(self, top: int) -> float:
        """Return the height of the item's underside once it rests with its top at ``top`` height units."""
        return self._length((top - int(self.state.item.h)) * self.unit)

    def poses(self, action: Tensor) -> tuple[Pose, Pose, float, int]:
        """Return the poses at pick and place, the turn in degrees, and the item's top in height units."""
        cell = self.cell
        x_bin, y_bin, x_tote, y_tote, rotation = (int(part) for part in split_action(cell, action))
        shape = cell.effector(rotation)
        x, y = effector_centres(cell, self.state.item, self.centre, self.yaw, self.side)[
            x_bin * cell.bin_size[1] + y_bin
        ]
        pick = Pose((x_bin, y_bin), (self._length(x), self._length(y), self._length(self.grip)), round(self.yaw, 6))
        top = self._top(action)
        centre = (
            self._length(effector_centre(x_tote, shape.width) * self.side),
            self._length(effector_centre(y_tote, shape.depth) * self.side),
            self._length(top * self.unit + self.release),
        )
        turn = round(90 * rotation - self.yaw, 6)
        return pick, Pose((x_tote, y_tote), centre, 90.0 * rotation), turn, top

    def _top(self, action: Tensor) -> int:
        return int(apply(self.cell, self.state, action).top[0])

    @staticmethod
    def _length(value: float) -> float:
        return round(float(value), 9)  # without the tail of binary fractions


@dataclass(frozen=True, kw_only=True)
class MeasuredProblem(Problem):
    """A problem of measured maps, in metres; heights are counted in millimetres."""

    measured: MeasuredMaps
    tote: MeasuredTote
    sides: tuple[float, float]  # of the item, in cells
    bin_clear: Tensor  # bool [P], see `failures`
    box: Box

    def is_feasible_in_an_empty_tote(self) -> bool:
        flat = torch.zeros_like(self.tote.highest)
        empty = self.tote._replace(highest=flat, lowest=flat, bears=torch.ones_like(self.tote.bears))
        maps = measured_maps(self.cell, empty, self.state.item, self.sides).maps
        return bool(footprint_mask(self.cell, maps).any())

    def failures(self, actions: Tensor) -> Tensor:
        return failures(self.cell, self.measured, actions, self.bin_clear)

    def bearing_after(self, action: Tensor | None) -> Tensor:
        if action is None:
            return self.tote.bears
        footprint = self._footprint(action)
        return bearing_after(self.cell, self.tote, self.state.item, self.sides, self.measured, footprint)

    def filled(self) -> float:
        return float(self.tote.highest.double().mean()) / self.tote.height

    def item_share(self) -> float:
        wide, deep, _ = self.cell.tote_size
        box = self.box
        return box.w * box.d * box.h / (wide * deep * self.side**2 * self.tote.height * self.unit)

    def _top(self, action: Tensor) -> int:
        return int(self.measured.maps.rest.flatten()[self._footprint(action)] + self.state.item.h)

    def _footprint(self, action: Tensor) -> int:
        carried = carry(self.cell, self.state.item, action)
        return int(footprint_index(self.cell.tote_size, carried.rotation % 2, carried.x, carried.y))


def effector_centres(cell: CellSpec, item: Item, centre: tuple[float, float], yaw: float, side: float) -> np.ndarray:
    """Return the centre of the end effector in the bin's frame at every pick cell, ``[P, 2]``.

    The cells are those of a grid along the item, in which it lies at whole cells.

    Args:
        item: of one problem.
        centre: of the item in the bin's frame; in the unit of ``side``, the length of a cell.
        yaw: of the item, degrees.
    """
    (ee_w, ee_d), (x, y, w, d, _) = cell.effector_size, (int(part) for part in item)
    number = np.arange(cell.num_picks)
    x_bin, y_bin = number // cell.bin_size[1], number % cell.bin_size[1]
    along = np.stack([effector_centre(x_bin, ee_w) - (x + w / 2), effector_centre(y_bin, ee_d) - (y + d / 2)], -1)
    turn = math.radians(yaw)
    axes = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    return np.array(centre) + side * along @ axes


def unit_of(cell: CellSpec) -> str:
    """Return the name of a cell's height units, for messages."""
    return "cells" if cell.height_unit == 1 else "height units"


def check_tote_height(cell: CellSpec, height, cell_size: float | None) -> float:
    """Return the height of a tote's rim if it is possible; arguments and errors as of :meth:`Planner.plan`."""
    if cell_size is None:
        wanted = f"a whole number of {unit_of(cell)}, 1 to {FAR - 1}"
        return checked_number("tote_height", height, wanted, lambda value: 1 <= value < FAR and value == round(value))
    most = MAX_SIDE * MILLIMETRE
    return checked_number("tote_height", height, f"metres, 0.001 to {most:g}", lambda value: 1e-3 <= value <= most)


def read_grid(cell: CellSpec, bin_depth, tote_depth, tote_height: int | None, tote_bearing, device) -> Problem:
    """Return the problem of maps in whole height units; arguments and errors as of :meth:`Planner.plan`."""
    unit_name, height = unit_of(cell), cell.tote_size[2]
    if tote_height is not None:
        height = round(check_tote_height(cell, tote_height, None))
    bin_map = whole_map("bin_depth", bin_depth, cell.bin_size[:2], FAR, unit_name)
    tote_map = whole_map("tote_depth", tote_depth, cell.tote_size[:2], height, unit_name)
    _check_one_cuboid(bin_map, unit_name)
    item = Item(*(part.to(device) for part in item_from_depth(bin_map[None].float())))
    _check_longest(cell, item, "bin_depth")
    bearing = _read_bearing(cell, tote_bearing, tote_map == height)
    state = State(
        surface_from(height - tote_map, bearing)[None].to(device), torch.tensor([height], device=device), item
    )
    x, y, w, d, h = (int(part) for part in item)
    centre = (x + w / 2, y + d / 2)
    return Problem(cell=cell, state=state, maps=placing_maps(cell, state), seen=state, centre=centre, grip=h)


def read_metric(
    cell: CellSpec, cell_size: float, accuracy: float, clearance: float, bin_depth, items, tote_depth, tote_height,
    tote_bearing, device,
) -> MeasuredProblem:  # fmt: skip
    """Return the problem of maps and boxes in metres; arguments and errors as of :meth:`Planner.plan`."""
    grid, unit = cell.tote_size[:2], cell_size * cell.height_unit
    slack = math.ceil(accuracy / MILLIMETRE - ROUNDING)
    box, clearance = _read_box(cell, cell_size, accuracy, clearance, bin_depth, items)
    if cell.rotations == 1 and abs(box.yaw) > ROUNDING:
        raise DepthMapError(f"items[0].yaw={box.yaw:g}: expected 0 with rotations=1: this robot turns nothing.")
    height = check_tote_height(cell, cell.tote_size[2] * unit if tote_height is None else tote_height, cell_size)
    rim, over_rim = (int(whole_units(height, MILLIMETRE, up)) for up in (False, True))

    # The tote.
    if isinstance(tote_depth, ToteMap):
        highest, lowest = (as_array("tote", part, grid) for part in (tote_depth.highest, tote_depth.lowest))
    else:
        beyond = max(4 * accuracy, 0.01)  # a floor or a rim that noise puts a little out of range
        depth = metric_map("tote_depth", tote_depth, grid, -beyond, height + beyond)
        highest, lowest = patches(height - depth, grid)
    high, low = (whole_units(part.clip(0, None), MILLIMETRE, up) for part, up in ((highest, True), (lowest, False)))
    count = len(high) // grid[0]
    on_floor = (high <= floor_height(slack)).unflatten(0, (-1, count)).unflatten(2, (-1, count)).all(3).all(1)
    bears = _read_bearing(cell, tote_bearing, on_floor).bool()
    if tote_bearing is None and count == 1:
        bears = on_floor  # one value a cell does not tell whether the cell is level
    tote = MeasuredTote(high.to(device), low.to(device), bears.to(device), rim, over_rim, slack)

    # The item, at whole cells of a grid that lies along it.
    sides = box.w / cell_size, box.d / cell_size
    whole = [max(1, math.ceil((side + 2 * clearance) / cell_size - ROUNDING)) for side in (box.w, box.d)]
    for key, size, most_cells in zip("wd", whole, cell.bin_size[:2], strict=True):
        if size > most_cells:
            raise DepthMapError(
                f"items[0].{key}={getattr(box, key):g}: with its clearance it takes {size} cells; expected at most "
                f"{most_cells}, those of the bin."
            )
    h = int(whole_units(box.h, MILLIMETRE, up=True))
    corner = [
        min(max(0, round(at / cell_size - size / 2)), most_cells - size)
        for at, size, most_cells in zip((box.x, box.y), whole, cell.bin_size[:2], strict=True)
    ]
    item = Item(*(torch.tensor([part], device=device) for part in (*corner, *whole, h)))
    _check_longest(cell, item, "items[0]")
    # Cells at each edge that the item, narrower by its clearance, does not cover as a whole.
    inset = [
        math.ceil((size - side) / 2 + clearance / cell_size - ROUNDING) for size, side in zip(whole, sides, strict=True)
    ]

    ratio = unit / MILLIMETRE
    free = replace(
        cell,
        bin_size=(*cell.bin_size[:2], 1),
        tote_size=(*grid, rim),
        height_unit=MILLIMETRE / cell_size,
        limits=None,
        item_inset=(inset[0], inset[1]),
        longest_side=cell.longest_side or (None if cell.has_known_offsets else max(whole)),
    )
    centres = effector_centres(free, item, (box.x, box.y), box.yaw, cell_size)
    above_walls = box.h - accuracy >= cell.bin_size[2] * unit - ROUNDING
    clear = torch.from_numpy(above_walls | _misses_walls(centres, cell, box.yaw, cell_size)).to(device)
    limits = _limits(cell, free, clear, centres / cell_size, h + slack, 2 * slack)
    limited = replace(free, reach=None, limits=limits)
    measured = measured_maps(limited, tote, item, sides)
    # A policy sees heights as in training.
    state, seen_rim = tote.state(limited, item), max(1, round(rim / ratio))
    heights = (state.heights / ratio).round().clamp(max=seen_rim).int()
    seen_item = item._replace(h=torch.tensor([max(1, round(h / ratio))], device=device))
    seen = State(surface_from(heights, tote.bears[None]), torch.tensor([seen_rim], device=device), seen_item)
    return MeasuredProblem(
        cell=limited, state=state, maps=measured.maps, seen=seen, centre=(box.x, box.y), yaw=box.yaw, side=cell_size,
        unit=MILLIMETRE, grip=(h + slack) * MILLIMETRE, release=2 * slack * MILLIMETRE, box=box, measured=measured,
        tote=tote, sides=sides, bin_clear=clear,
    )  # fmt: skip


def _read_box(cell: CellSpec, side: float, accuracy: float, clearance: float, bin_depth, items) -> tuple[Box, float]:
    """Return the item, and the clearance that it needs: none if a map with one value a cell shows it."""
    bin_sides = [size * side for size in cell.bin_size[:2]]
    if (bin_depth is None) == (items is None):
        got = "neither" if items is None else "both"
        raise DepthMapError(f"bin_depth, items: got {got}, expected one of the two.")
    if items is not None:
        return checked_box(items, bin_sides), clearance
    heights = metric_map("bin_depth", bin_depth, cell.bin_size[:2], -max(4 * accuracy, 0.01), MAX_SIDE * MILLIMETRE)
    is_cell_map = len(heights) == cell.bin_size[0]
    box = box_of_map(heights, side * cell.bin_size[0] / len(heights), accuracy, is_cell_map)
    return box, 0.0 if is_cell_map else clearance


def _misses_walls(centres: np.ndarray, cell: CellSpec, yaw: float, side: float) -> np.ndarray:
    """Return at which of its centres ``[P, 2]`` the end effector misses the bin's walls, bool ``[P]``.

    The rectangle around it decides.
    """
    turn, (wide, deep) = math.radians(yaw), (size * side / 2 for size in cell.effector_size)
    cos, sin = abs(math.cos(turn)), abs(math.sin(turn))
    reach, far = np.array([wide * cos + deep * sin, wide * sin + deep * cos]), np.array(cell.bin_size[:2]) * side
    return ((centres >= reach - ROUNDING) & (centres <= far - reach + ROUNDING)).all(1)


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
    if cell.reach is None:
        limits, ratio = cell.limits, cell.height_unit / free.height_unit
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
    at = [centres[:, axis] - side / 2 + reference_cell(side) for axis, side in enumerate(cell.effector_size)]
    good = np.ones(len(centres), dtype=bool)
    for round_x in (np.floor, np.ceil):
        for round_y in (np.floor, np.ceil):
            x, y = (part.round(6) for part in at)
            x, y = round_x(x).clip(-1, bin_w).astype(int) + 1, round_y(y).clip(-1, bin_d).astype(int) + 1
            good &= allowed[x, y]
    return torch.from_numpy(good)


def _check_one_cuboid(bin_map: Tensor, unit_name: str) -> None:
    """Refuse a bin ``[W_B, D_B]`` that does not show one cuboid: its bounding box, filled at one height."""
    if not (bin_map > 0).any():
        raise DepthMapError("bin_depth: got no cell above 0, expected one item.")
    x, y, w, d, h = (int(value) for value in item_from_depth(bin_map[None].float()))
    box = bin_map[x : x + w, y : y + d]
    if (box != h).any():
        i, j = (box != h).nonzero()[0].tolist()
        raise DepthMapError(
            f"bin_depth[{x + i}, {y + j}]: got {int(box[i, j])} {unit_name}, expected {h}: one cuboid that fills its "
            f"bounding box, {w}x{d} cells from [{x}, {y}]."
        )


def _check_longest(cell: CellSpec, item: Item, key: str) -> None:
    """Refuse an item that is longer than the tables of grasps hold."""
    longest = max(int(item.w), int(item.d))
    if cell.pick_rule != "contain" and longest > cell.max_side:
        raise DepthMapError(
            f"{key}: the item is {longest} cells long, longer than any in training; expected at most {cell.max_side}."
        )


def _read_bearing(cell: CellSpec, tote_bearing, on_floor: Tensor) -> Tensor:
    """Return where the tote bears weight, int64 ``[W_T, D_T]``: as plans before say, and on the floor."""
    if tote_bearing is None:
        return torch.ones_like(on_floor, dtype=torch.int64)
    bearing = flags_of_map("tote_bearing", tote_bearing, cell.tote_size[:2])
    bearing = torch.where(on_floor, 1, bearing)  # this may be another tote
    if cell.support != "bearing" and not bearing.all():
        raise DepthMapError(f"tote_bearing: got a 0 with support={cell.support}, expected support=bearing.")
    return bearing
