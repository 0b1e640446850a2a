"""The problem that a robot's planner solves for items and a tote that were measured in metres."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple, cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pickplace.common.validate import number, refuse_if
from pickplace.robot.box import MILLIMETRE, Box, DepthMapError, HiddenBox
from pickplace.robot.loads import grams_of, read_loads
from pickplace.robot.measure import (
    ROUNDING,
    ToteMap,
    as_array,
    bounds,
    box_of_map,
    least_height,
    metric_map,
    overlap_mask,
    refuse_stacked,
    segments_of_map,
    turned_axes,
    whole_units,
)
from pickplace.robot.problem import Problem, check_longest, is_excluded, join_items, read_bearing
from pickplace.robot.scene import BinMap, Scene
from pickplace.rules.cell import MAX_SIDE, CellSpec
from pickplace.rules.checks import is_within_reach
from pickplace.rules.grasps import all_grasps, carry, footprint_index, split_flat
from pickplace.rules.gripper.base import effector_centre, reference_cell
from pickplace.rules.item import ALL_TURNS, Item
from pickplace.rules.maps import FAR
from pickplace.rules.masks import PlacingMaps, footprint_mask
from pickplace.rules.measured import MeasuredMaps, MeasuredTote, bearing_after, failures, floor_height, measured_maps
from pickplace.rules.reach.base import Limits
from pickplace.rules.state import State, surface_from


class MeasuredItem(NamedTuple):
    """An item on a grid along its sides, and the data that decide which actions succeed with it."""

    limits: Limits  # of the robot on this item, whichever item its picks take
    cell: CellSpec  # with the limits, without the picks that take another item
    measured: MeasuredMaps
    sides: tuple[float, float]  # of the item, in cells
    bin_clear: Tensor  # bool [P], see `failures`
    centres: np.ndarray  # of the end effector at each pick cell, in the bin's frame, [P, 2]; m
    grip: float  # height of the suction face when it grips the item, m


@dataclass(frozen=True, kw_only=True)
class MeasuredProblem(Problem):
    """Items and one tote, in metres; heights are counted in millimetres.

    Each item has a grid along its sides, with pick cells of its own, so that no two items share an action. The robot's
    limits forbid picks at which the end effector would touch another box in the bin that may be as high. A
    :class:`~pickplace.robot.box.HiddenBox` is an obstacle, not an item.
    """

    parts: list[MeasuredItem]
    tote: MeasuredTote
    taken: Tensor  # int64 [P], see `_taken_items`

    def taken_items(self, actions: Tensor) -> Tensor:
        return self.taken[split_flat(self.cell, actions)[0]].clamp(min=0)

    @property
    def insets(self) -> list[tuple[int, int]]:
        return [part.cell.item_inset for part in self.parts]

    def is_feasible_in_empty_tote(self) -> bool:
        flat = torch.zeros_like(self.tote.highest)
        empty = self.tote._replace(highest=flat, lowest=flat, bears=torch.ones_like(self.tote.bears))
        return any(
            _has_place(part, measured_maps(part.cell, empty, part.measured.maps.item, part.sides))
            for part in self.parts
        )

    def failures(self, actions: Tensor) -> Tensor:
        taken, codes = self.taken_items(actions), torch.empty_like(actions)
        for index, part in enumerate(self.parts):
            codes[taken == index] = failures(part.cell, part.measured, actions[taken == index], part.bin_clear)
        return codes

    def bearing_after(self, action: Tensor | None) -> Tensor:
        if action is None:
            return self.tote.bears
        part, item, footprint = self._placed(action)
        return bearing_after(part.cell, self.tote, item, part.sides, part.measured, footprint)

    def shares(self, number: int) -> tuple[float, float]:
        (wide, deep, _), box = self.cell.tote_size, self.boxes[number]
        share = box.w * box.d * box.h / (wide * deep * self.side**2 * self.tote.height * self.unit)
        return float(self.tote.highest.double().mean()) / self.tote.height, share

    def suction_face(self, number: int, x_bin: int, y_bin: int) -> tuple[float, float, float]:
        part = self.parts[number]
        return *part.centres[x_bin * self.cell.bin_size[1] + y_bin], part.grip

    def _placed(self, action: Tensor) -> tuple[MeasuredItem, Item, int]:
        """Return the measured item that an action takes, the same item on its grid, and its footprint in the tote."""
        part = self.parts[int(self.taken_items(action))]
        _, rotation, _, (x, y, *_) = carry(part.cell, part.measured.maps.item, action)
        return part, part.measured.maps.item, int(footprint_index(self.cell.tote_size, rotation % 2, x, y))


def read_metric(cell: CellSpec, scene: Scene, device, exclude: Sequence[Sequence[float]] = ()) -> Problem:
    """Return the problem of a scene in metres; see :meth:`Planner.plan` for arguments and errors."""
    cell_size = cast(float, scene.cell_size)
    by_name, clearance = _read_boxes(cell, scene, cell_size)
    coming = {f"coming[{at}]": box.upright() for at, box in enumerate(scene.coming or ())}
    _check_in_bin(cell, by_name | coming, cell_size)
    names, boxes = [*by_name], [*by_name.values()]
    error = clearance if scene.placement_error is None else scene.placement_error
    tote = _read_tote(cell, scene, cell_size * cell.height_unit, error / cell_size, device)
    numbers = [place for place, box in enumerate(boxes) if not isinstance(box, HiddenBox)]
    refuse_if(
        not numbers,
        f"items: got {len(boxes)} that are hidden in part or unknown, which are not picked; expected one that is seen.",
        DepthMapError,
    )
    each = [_on_grid(cell, boxes[place], cell_size, clearance, names[place], device) for place in numbers]
    items = join_items(each)
    # Only the area that an item surely covers decides where it is gripped, and what supports it.
    sides = [
        (max(box.w - 2 * box.edge_error, 0.0) / cell_size, max(box.d - 2 * box.edge_error, 0.0) / cell_size)
        for box in (boxes[place] for place in numbers)
    ]
    free = replace(
        cell,
        bin_size=(*cell.bin_size[:2], 1),
        tote_size=(*cell.tote_size[:2], tote.height),
        height_unit=MILLIMETRE / cell_size,
        bin_items=1,
        longest_side=cell.longest_side
        or (None if cell.has_known_offsets else max(int(side) for item in each for side in item[2:4])),
    )
    loads = read_loads(scene, tote, len(tote.highest) // cell.tote_size[0])
    insets = [_inset(item, side, clearance / cell_size) for item, side in zip(each, sides, strict=True)]
    parts = []
    for index, (place, item) in enumerate(zip(numbers, each, strict=True)):
        grip = int(item.h) + tote.accuracy
        centres = _effector_centres(free, item, boxes[place], cell_size)
        bin_clear = torch.from_numpy(_clear_picks(cell, scene, place, boxes, centres, clearance)).to(device)
        limits = _limits(cell, free, bin_clear, centres / cell_size, grip, 2 * tote.accuracy)
        allowed = torch.from_numpy(~is_excluded(exclude, centres, cell_size)).to(device)
        limits = replace(limits, pick_ok=limits.pick_ok & allowed)
        limited = replace(free, reach=limits, item_inset=insets[index])
        measured = measured_maps(limited, tote, item, sides[index], loads)
        parts.append(MeasuredItem(limits, limited, measured, sides[index], bin_clear, centres, grip * MILLIMETRE))
    taken = _taken_items(parts)
    for index, part in enumerate(parts):
        own = replace(part.limits, pick_ok=part.limits.pick_ok & (taken == index))
        parts[index] = part._replace(cell=replace(part.cell, reach=own))
    joint, maps = _join(parts, items, taken)
    # A policy sees heights as in training.
    ratio = cell_size * cell.height_unit / MILLIMETRE
    state, seen_rim = tote.state(free, each[0])._replace(items=items), max(1, round(tote.height / ratio))
    heights = (state.heights / ratio).round().clamp(max=seen_rim).int()

    def in_units(items: Item) -> Item:
        return items._replace(h=(items.h.double() / ratio).round().long().clamp(min=1))

    seen = State(surface_from(heights, tote.bears[None]), torch.tensor([seen_rim], device=device), in_units(items))
    if coming:
        arriving = [_on_grid(cell, box, cell_size, clearance, name, device) for name, box in coming.items()]
        seen = seen._replace(coming=in_units(join_items(arriving)))
    return MeasuredProblem(
        cell=joint, state=state, seen=seen, maps=maps, boxes=[boxes[place] for place in numbers], numbers=numbers,
        names=[names[place] for place in numbers], side=cell_size, unit=MILLIMETRE,
        release=2 * tote.accuracy * MILLIMETRE, parts=parts, tote=tote, taken=taken,
    )  # fmt: skip


def _join(parts: list[MeasuredItem], items: Item, taken: Tensor) -> tuple[CellSpec, PlacingMaps]:
    """Return the cell and the maps of all items ``[1, M]``; for several items, the maps forbid the picks that fail.

    The cell's inset is the least of all items, so that it excludes no pick that grips one of them.
    """
    cell, each = parts[0].cell, [part.measured.maps for part in parts]
    if len(parts) == 1:
        return cell, each[0]
    joined: dict[str, Any] = {
        key: torch.cat([getattr(maps, key) for maps in each]) for key in ("top", "clearance", "rest", "greatest_top")
    }
    blocked = ~torch.stack([part.limits.pick_ok & (taken == index) for index, part in enumerate(parts)])
    maps = each[0]._replace(**joined, item=items.rows(0), blocked=blocked, bin_items=len(parts))
    reach = replace(parts[0].limits, pick_ok=torch.ones_like(blocked[0]))
    inset_x, inset_y = (min(side) for side in zip(*(part.cell.item_inset for part in parts), strict=True))
    return replace(cell, reach=reach, bin_items=len(parts), item_inset=(inset_x, inset_y)), maps


def _inset(item: Item, sides: tuple[float, float], clearance: float) -> tuple[int, int]:
    """Return the number of cells at each edge that an item, narrowed by its clearance, does not cover in full; x, y."""
    x, y = (
        math.ceil((int(whole) - side) / 2 + clearance - ROUNDING) for whole, side in zip(item[2:4], sides, strict=True)
    )
    return x, y


def _taken_items(parts: list[MeasuredItem]) -> Tensor:
    """Return the number of the item that each pick cell takes, int64 ``[P]``; -1 if it grips none.

    Each item has a grid of its own, so a pick cell may grip several items, each at another point of the bin. It takes
    the highest that can be picked there and has a place in the tote, else the highest.
    """
    items = [part.measured.maps.item for part in parts]
    gripped = torch.cat(
        [all_grasps(replace(part.cell, reach=None), item)[0] for part, item in zip(parts, items, strict=True)]
    )  # [M, P]
    height = torch.cat([item.h for item in items])[:, None]
    if (gripped.sum(0) > 1).any():
        usable = [part.limits.pick_ok & _has_place(part, part.measured) for part in parts]
        height = height + torch.stack(usable) * FAR
    height = torch.where(gripped, height, 0)
    return torch.where(height.any(0), height.argmax(0), -1)


def _has_place(part: MeasuredItem, measured: MeasuredMaps) -> bool:
    """Return whether the item can be placed in a tote, whichever item its picks take."""
    return bool(footprint_mask(replace(part.cell, reach=part.limits), measured.maps).any())


def _effector_centres(cell: CellSpec, item: Item, box: Box, side: float) -> np.ndarray:
    """Return the centre of the end effector in the bin's frame at every pick cell of a grid along an item; m.

    Args:
        item: one item, on that grid.
        box: the same item, as measured.
        side: length of a cell, m.
    """
    (ee_w, ee_d), (x, y, w, d) = cell.gripper.size, map(int, item[:4])
    x_bin, y_bin = np.divmod(np.arange(cell.num_picks), cell.bin_size[1])
    along = np.stack([effector_centre(x_bin, ee_w) - (x + w / 2), effector_centre(y_bin, ee_d) - (y + d / 2)], -1)
    return np.array((box.x, box.y)) + side * along @ turned_axes(math.radians(box.yaw))


def _read_boxes(cell: CellSpec, scene: Scene, side: float) -> tuple[dict[str, Box], float]:
    """Return the boxes in the bin by their names in messages, and their clearance, m: 0 if a map with one value a cell
    shows them."""
    accuracy, clearance = scene.accuracy, scene.clearance
    if isinstance(scene.items, BinMap):
        least = -max(4 * accuracy, 0.01)
        heights = metric_map("bin_depth", scene.items.depth, cell.bin_size[:2], least, MAX_SIDE * MILLIMETRE)
        is_cell_map, square = len(heights) == cell.bin_size[0], side * cell.bin_size[0] / len(heights)
        clearance = 0.0 if is_cell_map else clearance
        labels = scene.items.labels
        boxes = {
            f"bin_depth{name}": box_of_map(
                heights if labels is None else np.where(segment, heights, 0.0), square, accuracy, is_cell_map, name
            )
            for name, segment in segments_of_map(labels, heights, least_height(accuracy)).items()
        }
    else:
        boxes = {f"items[{at}]": box.upright() for at, box in enumerate(scene.items)}
        refuse_stacked([*boxes.values()], max(clearance, accuracy))
    return boxes, clearance


def _check_in_bin(cell: CellSpec, boxes: dict[str, Box], side: float) -> None:
    """Refuse a box whose centre lies outside the bin, or that the robot cannot turn back."""
    for name, box in boxes.items():
        for key, size in zip("xy", cell.bin_size[:2], strict=True):
            if not 0 <= (at := getattr(box, key)) <= size * side:
                raise DepthMapError(f"{_field(name, key)}={at:g}: expected 0 to {size * side:g} m, in the bin.")
        refuse_if(
            cell.rotations == 1 and abs(box.yaw) > ROUNDING,
            f"{_field(name, 'yaw')}={box.yaw:g}: expected 0 with rotations=1: this robot turns nothing.",
            DepthMapError,
        )


def _field(name: str, key: str) -> str:
    """Return the name of a field of a box in messages: of one in a list, or of one that a map shows."""
    return f"{name}.{key}" if name.endswith("]") else f"{name}: {key}"


def _read_tote(cell: CellSpec, scene: Scene, unit: float, error: float, device) -> MeasuredTote:
    """Return the tote, in millimetres.

    Args:
        unit: length of a height unit, m.
        error: greatest distance between an item and its planned place, in cells.
    """
    grid, slack, height = cell.tote_size[:2], math.ceil(scene.accuracy / MILLIMETRE - ROUNDING), scene.tote_height
    if height is None:
        height = number("tote_height", cell.tote_size[2] * unit, MILLIMETRE, MAX_SIDE * MILLIMETRE, "metres")
    rim, over_rim = (int(whole_units(height, MILLIMETRE, up)) for up in (False, True))
    if isinstance(scene.tote, ToteMap):
        highest, lowest = (as_array("tote", part, grid) for part in (scene.tote.highest, scene.tote.lowest))
    else:
        beyond = max(4 * scene.accuracy, 0.01)  # a floor or a rim that noise puts a little out of range
        depth = metric_map("tote_depth", scene.tote, grid, -beyond, height + beyond)
        highest, lowest = bounds(height - depth, grid, scene.tote_samples)
    high, low = (whole_units(part.clip(0, None), MILLIMETRE, up) for part, up in ((highest, True), (lowest, False)))
    count = len(high) // grid[0]
    on_floor = (high <= floor_height(slack)).unflatten(0, (-1, count)).unflatten(2, (-1, count)).all(3).all(1)
    # One value a cell does not tell whether the cell is level.
    is_unknown = scene.tote_bearing is None and count == 1
    bears = on_floor if is_unknown else read_bearing(cell, scene.tote_bearing, on_floor).bool()
    return MeasuredTote(high.to(device), low.to(device), bears.to(device), rim, over_rim, slack, error)


def _on_grid(cell: CellSpec, box: Box, cell_size: float, clearance: float, name: str, device) -> Item:
    """Return an item at whole cells of a grid along its sides, its height in millimetres; refuse too large an item."""
    whole = [max(1, math.ceil((side + 2 * clearance) / cell_size - ROUNDING)) for side in (box.w, box.d)]
    for key, size, most_cells in zip("wd", whole, cell.bin_size[:2], strict=True):
        refuse_if(
            size > most_cells,
            f"{_field(name, key)}={getattr(box, key):g}: with its clearance it takes {size} cells; expected at most "
            f"{most_cells}, those of the bin.",
            DepthMapError,
        )
    x, y = (
        min(max(0, round(at / cell_size - size / 2)), most_cells - size)
        for at, size, most_cells in zip((box.x, box.y), whole, cell.bin_size[:2], strict=True)
    )
    columns = x, y, *whole, int(whole_units(box.h, MILLIMETRE, up=True)), -1, ALL_TURNS, grams_of(box)
    return check_longest(cell, Item(*(torch.tensor([part], device=device) for part in columns)), name)


def _clear_picks(
    cell: CellSpec, scene: Scene, index: int, boxes: list[Box], centres: np.ndarray, clearance: float
) -> np.ndarray:
    """Return a mask of the end effector's centres ``[P, 2]`` at which it hits nothing in the bin, bool ``[P]``.

    Its body, turned with the item, must miss the bin's walls or pass over them. It must not touch another box, widened
    by the clearance, that may be as high; boxes that are clearly lower are ignored.

    Args:
        index: of the item that is picked, among the boxes.
    """
    box, side, accuracy = boxes[index], cast(float, scene.cell_size), scene.accuracy
    wall = cell.bin_size[2] * (side * cell.height_unit) if scene.bin_height is None else scene.bin_height
    far, axes = np.array(cell.bin_size[:2]) * side, turned_axes(math.radians(box.yaw))
    body = [np.array(part) * side @ axes for part in cell.gripper.body_parts]
    corners = np.concatenate(body)
    clear = ((centres + corners.min(0) >= -ROUNDING) & (centres + corners.max(0) <= far + ROUNDING)).all(1)
    clear |= box.h - accuracy >= wall - ROUNDING
    for other in boxes[:index] + boxes[index + 1 :]:
        if other.h + accuracy >= box.h - accuracy - ROUNDING:
            wider = replace(other, w=other.w + 2 * clearance, d=other.d + 2 * clearance)
            clear &= ~np.any([overlap_mask(centres, part, wider) for part in body], axis=0)
    return clear


def _limits(cell: CellSpec, free: CellSpec, bin_clear: Tensor, centres: np.ndarray, grip: int, release: int) -> Limits:
    """Return the limits of the robot, with tops in millimetres; they forbid the picks that hit something in the bin.

    Args:
        cell: of the robot, with its limits, if any.
        free: the same cell with heights in millimetres; the limits of its reach were computed anew.
        bin_clear: bool ``[P]``, see :func:`_clear_picks`.
        centres: of the end effector in the bin at each pick cell, in cells, ``[P, 2]``.
        grip: height of the suction face when it grips the item, mm.
        release: height of the suction face above the item's planned top when it lets go, mm.
    """
    device, limits = bin_clear.device, free.limits
    if limits is None:
        return Limits.of_picks(cell, bin_clear)
    # Millimetres per height unit of the limits: a table has the height units of the cell.
    ratio = cell.height_unit / free.height_unit if isinstance(cell.reach, Limits) else 1.0
    return Limits(
        bin_clear & _reached_picks(free, limits, ratio, centres, torch.tensor(grip)).to(device),
        (limits.lowest_top * ratio - release).ceil().long().to(device),
        (limits.highest_top.clamp(max=FAR) * ratio - release).floor().clamp(max=FAR).long().to(device),
    )


def _reached_picks(cell: CellSpec, limits: Limits, ratio: float, centres: np.ndarray, face: Tensor) -> Tensor:
    """Return a mask of the end effector's centres ``[P, 2]`` in the bin that the robot reaches, bool ``[P]``.

    Args:
        limits: of picks at whole cells. A centre lies between these, and all its neighbours must be allowed.
        ratio: millimetres per height unit of the limits.
        face: height of the suction face, mm.
    """
    if cell.reach is not None and (exact := cell.reach.picks(cell, *torch.from_numpy(centres).unbind(1))):
        return is_within_reach(*exact, face)
    sides, reached = cell.bin_size[:2], limits.pick_ok
    if limits.lowest_pick is not None and limits.highest_pick is not None:
        reached = reached & is_within_reach(limits.lowest_pick * ratio, limits.highest_pick * ratio, face)
    allowed = F.pad(reached.view(sides), (1, 1, 1, 1), value=False).cpu().numpy()
    at = [centres[:, axis] - size / 2 + reference_cell(size) for axis, size in enumerate(cell.gripper.size)]
    near_x, near_y = (
        [rounded(part.round(6)).clip(-1, side).astype(int) + 1 for rounded in (np.floor, np.ceil)]
        for part, side in zip(at, sides, strict=True)
    )
    return torch.from_numpy(np.all([allowed[x, y] for x, y in product(near_x, near_y)], 0))
