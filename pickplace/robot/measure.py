"""Check measured boxes, depth maps and lengths, and convert lengths to whole height units."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from pickplace.common.validate import refuse_if
from pickplace.robot.box import MILLIMETRE, Box, DepthMapError, EmptyBinError, HiddenBox
from pickplace.rules.cell import MAX_BIN_ITEMS

#: Greatest difference from a whole number of units at which a length counts as that number. In floating point, three
#: cells of 0.05 m are not exactly 0.15 m.
ROUNDING = 1e-6
MAX_PATCHES = 8  # greatest number of patches along a cell; finer maps are reduced to it
MAX_LABEL = 2**31 - 1
LABEL_HINT = "; of several items give bin_labels, too"
#: Width of an item's border, as a share of its side, if the item counts as parallel to the walls: sine of a degree.
PARALLEL_TOLERANCE = 0.02


class ToteMap(NamedTuple):
    """The greatest and the least height in each patch of a tote, ``[k W_T, k D_T]``; metres."""

    highest: np.ndarray
    lowest: np.ndarray
    likely: "ToteMap | None" = None  #: the map if each place without depth is like those beside it
    has_holes: bool = False  #: whether some places are unknown, and so count up to the rim


def refuse(name: str, bad: np.ndarray, values: np.ndarray, unit: str, expected: str) -> None:
    """Raise a :class:`DepthMapError` that names the first bad cell of a map, if there is one.

    Args:
        bad: bool, in the shape of the map's values.
        unit: of a value, for the message; may include a remark on it.
        expected: what a good cell has.
    """
    if bad.any():
        x, y = np.argwhere(bad)[0].tolist()
        raise DepthMapError(f"{name}[{x}, {y}]: got {values[x, y]:g}{unit}, expected {expected}.")


def as_array(name: str, values, grid: Sequence[int], kinds: str = "iuf") -> np.ndarray:
    """Return a map as a numpy array; ``kinds`` are the kinds of numpy's types that are accepted.

    Args:
        grid: the expected shape; the map may be finer by a whole factor, the same along both sides.
    """
    try:
        if isinstance(values, Tensor):
            # numpy has no bfloat16
            values = values.detach().cpu().to(torch.float32 if values.dtype == torch.bfloat16 else values.dtype)
        array = np.asarray(values)
    except (TypeError, ValueError) as error:
        raise DepthMapError(f"{name}: expected an array of {grid[0]}x{grid[1]} numbers ({error}).") from error
    count = array.shape[0] // grid[0] if array.ndim else 0
    refuse_if(
        not count or array.shape != (count * grid[0], count * grid[1]),
        f"{name}: got shape {list(array.shape)}, expected {list(grid)}, the grid that the planner was loaded for, "
        "or a multiple of it.",
        DepthMapError,
    )
    refuse_if(
        array.dtype.kind not in kinds, f"{name}: got values of type {array.dtype}, expected numbers.", DepthMapError
    )
    if isinstance(values, np.ma.MaskedArray):
        refuse(name, np.ma.getmaskarray(values), array, ", which is masked", "a measured value")
    return array


def whole_map(name: str, values, grid: Sequence[int], most: int, unit: str = "", kinds: str = "iuf") -> np.ndarray:
    """Return a map of whole numbers from 0 to ``most``, int64 ``grid``.

    Args:
        name: the argument's name, for messages.
        values: numpy, torch or lists.
        grid: the expected shape.
        unit: of the numbers, for messages.
        kinds: see :func:`as_array`.

    Raises:
        DepthMapError: naming the first cell that is out of range, or no whole number.
    """
    array = as_array(name, values, grid, kinds)
    hint = unit and "; finer maps are in metres, with cell_size"
    refuse_if(
        array.shape != tuple(grid),
        f"{name}: got shape {list(array.shape)}, expected {list(grid)}{hint}.",
        DepthMapError,
    )
    units = array.astype(np.float64)
    with np.errstate(all="ignore"):
        whole = np.round(units)
        near = np.abs(units - whole) <= ROUNDING * np.maximum(1, np.abs(units))  # False for NaN
    hint = unit and f" of{unit}; measured heights are in metres, with cell_size"
    refuse(name, ~near, units, unit, f"a whole number{hint}")
    refuse(name, (whole < 0) | (whole > most), units, unit, f"0 to {most:,}{unit}")
    return whole.astype(np.int64)


def metric_map(name: str, values, grid: Sequence[int], least: float, most: float) -> np.ndarray:
    """Return a map of metres, float64, in the shape of the grid or finer.

    Args:
        least, most: the range of its values, m.

    Raises:
        DepthMapError: naming the first value that is out of range.
    """
    array = as_array(name, values, grid).astype(np.float64)
    # Negated, so that NaN is refused, too: each comparison with it is False.
    refuse(name, ~((array >= least - ROUNDING) & (array <= most + ROUNDING)), array, " m", f"{least:g} to {most:g} m")
    return array


def bounds(array: np.ndarray, grid: Sequence[int], samples: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the greatest and the least value of each patch of a map of heights; see :func:`patches`.

    Args:
        samples: "area": a value is the greatest in its square, and a thing that ends in the square may cover little of
            it. Then a neighbour that it does not reach is lower. So only what all eight neighbours have, too, counts as
            covering the square. A gap narrower than two squares is not seen. With one value a cell the neighbours do
            not count: ``tote_bearing`` says what carries.
            "centre": a value was measured in the middle of its square. An edge may pass between two middles, so a
            square may have its own value or the value of any of its eight neighbours. A thing narrower than two squares
            may be missed.
    """
    is_area, near = samples == "area", sliding_window_view(np.pad(array, 1, mode="edge"), (3, 3))
    if is_area and array.shape[0] == grid[0]:
        return patches(array, grid)
    return patches(array if is_area else near.max((2, 3)), grid)[0], patches(near.min((2, 3)), grid)[1]


def patches(array: np.ndarray, grid: Sequence[int], most: int = MAX_PATCHES) -> tuple[np.ndarray, np.ndarray]:
    """Return the greatest and the least value of each patch of a map, with at most ``most`` patches along a cell."""
    along, highest, lowest = array.shape[0] // grid[0], array, array
    count = min(along, most)
    for axis, cells in enumerate(grid):
        edges = np.arange(cells * count) * along  # divided by `count`: where a patch begins, in values
        # A value that lies in two patches belongs to both.
        parts = [range(*part) for part in zip(edges // count, -(-(edges + along) // count), strict=True)]
        highest = np.stack([highest.take(part, axis).max(axis) for part in parts], axis)
        lowest = np.stack([lowest.take(part, axis).min(axis) for part in parts], axis)
    return highest, lowest


def whole_units(lengths, unit: float, up: bool) -> Tensor:
    """Return lengths in whole units, int32, rounded up or down."""
    units = np.asarray(lengths, dtype=np.float64) / unit
    return torch.from_numpy(np.asarray(np.ceil(units - ROUNDING) if up else np.floor(units + ROUNDING))).int()


def segments_of_map(labels, heights: np.ndarray, least: float) -> dict[str, np.ndarray]:
    """Return a mask of each item in a bin, bool in the shape of ``heights``; by ascending labels.

    The keys name the items in messages, such as ``" with label 3"``. Without labels there is one item, its key is "".

    Args:
        labels: ``bin_labels``: whole numbers, 0 where the bin is empty; or None.
        heights: ``bin_depth``.
        least: a cell above this height belongs to an item and needs a label; each label needs such a cell.

    Raises:
        EmptyBinError: for an empty bin.
        DepthMapError: naming the first label that is no such number, or does not fit the heights.
    """
    is_item = heights > least
    refuse_if(labels is None and not is_item.any(), "bin_depth: got no cell above 0, expected one item.", EmptyBinError)
    if labels is None:
        return {"": is_item}
    array = whole_map("bin_labels", labels, heights.shape, MAX_LABEL)
    refuse("bin_labels", is_item & (array == 0), array, "", "a label, as bin_depth shows an item")
    refuse("bin_labels", (array > 0) & ~np.isin(array, array[is_item]), array, "", "0, as bin_depth shows no item")
    found = np.unique(array[is_item]).tolist()
    refuse_if(
        not 1 <= len(found) <= MAX_BIN_ITEMS,
        f"bin_labels: got {len(found)} labels, expected 1 to {MAX_BIN_ITEMS}, one for each item.",
        DepthMapError if found else EmptyBinError,
    )
    return {f" with label {label}": array == label for label in found}


def turned_axes(angle: float) -> np.ndarray:
    """Return the unit vectors along x and y after a counter-clockwise turn in radians, ``[2, 2]``."""
    return np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])


def is_inside(points: np.ndarray, centre: Sequence[float], sides: Sequence[float], yaw: float) -> np.ndarray:
    """Return a mask of the points ``[..., 2]`` that lie in a rectangle with a yaw in degrees, bool ``[...]``."""
    axes, away = turned_axes(math.radians(yaw)), points - centre
    return (np.abs(away @ axes[0]) < sides[0] / 2) & (np.abs(away @ axes[1]) < sides[1] / 2)


def rectangle(w: float, d: float, yaw: float) -> np.ndarray:
    """Return the corners of a rectangle from its centre, counter-clockwise, ``[4, 2]``; the yaw is in degrees."""
    return np.array([(-w, -d), (w, -d), (w, d), (-w, d)]) / 2 @ turned_axes(math.radians(yaw))


def overlap_mask(centres: np.ndarray, corners: np.ndarray, box: Box) -> np.ndarray:
    """Return a mask of the centres ``[P, 2]`` at which a convex polygon overlaps a box in plan view, bool ``[P]``.

    Two that only touch do not overlap. Convex polygons are apart if they are apart along the normal of one side.

    Args:
        corners: of the polygon from its centre, counter-clockwise, ``[n, 2]``; m.
    """
    other, away, apart = rectangle(box.w, box.d, box.yaw), centres - (box.x, box.y), np.zeros(len(centres), dtype=bool)
    for one, next_one, sign in ((corners, other, 1), (other, corners, -1)):
        edges = np.roll(one, -1, 0) - one
        normals = np.stack([edges[:, 1], -edges[:, 0]]) / np.hypot(*edges.T)  # [2, n], outwards
        gap = (next_one @ normals).min(0) - (one.T * normals).sum(0) - sign * (away @ normals)  # [P, n]
        apart |= (gap > -ROUNDING).any(1)
    return ~apart


def refuse_stacked(boxes: list[Box], tolerance: float) -> None:
    """Refuse a box that stands on another: each box counts as standing on the bin's floor.

    Boxes that a camera sees only in part are not checked: they may seem to reach below others.

    Args:
        boxes: the items.
        tolerance: greatest distance by which a side may be measured too far out, m.
    """
    seen = [
        (number, replace(box, **{key: max(getattr(box, key) - 2 * tolerance, MILLIMETRE) for key in "wd"}))
        for number, box in enumerate(boxes)
        if not isinstance(box, HiddenBox)
    ]
    for index, (number, box) in enumerate(seen):
        for other_number, other in seen[:index]:
            refuse_if(
                overlap_mask(np.array([[box.x, box.y]]), rectangle(box.w, box.d, box.yaw), other).any(),
                f"items[{number}] overlaps items[{other_number}] in plan view; expected items that stand side by side "
                "on the bin's floor, none on another.",
                DepthMapError,
            )


def least_height(accuracy: float) -> float:
    """Return the height up to which a bin's map shows its floor, m."""
    return max(2 * accuracy, MILLIMETRE / 2)


def box_of_map(heights: np.ndarray, side: float, accuracy: float, is_cell_map: bool = False, name: str = "") -> Box:
    """Return the one cuboid that a bin's map shows.

    Args:
        heights: above the bin's floor, m; at least one is an item's.
        side: of a value's square, m.
        accuracy: greatest error of a height, m.
        is_cell_map: whether the map has one value a cell: then the item fills each cell in which it lies.
        name: of the item, see :func:`segments_of_map`.

    Raises:
        DepthMapError: for anything but one cuboid.
    """
    is_item = heights > least_height(accuracy)
    where = np.argwhere(is_item)
    corners = np.unique(np.concatenate([where + step for step in product((0, 1), repeat=2)]), axis=0)
    x, y, w, d, yaw = smallest_rectangle(corners * side)
    box = Box(x, y, w, d, float(heights.max()), yaw)
    # All that lies well inside the rectangle must be the item's top.
    centres = (np.indices(heights.shape).transpose(1, 2, 0) + 0.5) * side
    border = 0.0 if is_cell_map else 2 * side + PARALLEL_TOLERANCE * max(w, d) * (yaw == 0)
    inside = is_inside(centres, (x, y), (w - 2 * border, d - 2 * border), yaw)
    expected = f"{box.h:g} m: one cuboid, {w:g} x {d:g} m with its centre at [{x:g}, {y:g}]{'' if name else LABEL_HINT}"
    refuse("bin_depth", inside & (heights < box.h - 2 * accuracy - ROUNDING), heights, f" m{name}", expected)
    return box.upright() if is_cell_map else replace(box, edge_error=_edge_error(is_item, side, box)).upright()


def _edge_error(is_item: np.ndarray, side: float, box: Box) -> float:
    """Return how far inside its measured sides a box begins that surely lies on the item; m.

    Args:
        is_item: whether a square of a map shows the item, which may only touch that square; bool ``[X, Y]``.
        side: of a square, m.
        box: the measured one.
    """
    # The item is convex: with the four squares at the corners of a square it covers that square.
    padded = np.pad(is_item, 1)
    covered = padded[:-2, :-2] & padded[:-2, 2:] & padded[2:, :-2] & padded[2:, 2:]
    unsure, square = (np.argwhere(~covered) + 0.5) * side, rectangle(side, side, 0.0)
    unsure, half = unsure[overlap_mask(unsure, square, box)], min(box.w, box.d) / 2
    for error in np.arange(0.0, half, side / 4):
        if not overlap_mask(unsure, square, replace(box, w=box.w - 2 * error, d=box.d - 2 * error)).any():
            return float(error)
    return half


def smallest_rectangle(points: np.ndarray) -> tuple[float, float, float, float, float]:
    """Return the smallest rectangle around points ``[M, 2]``: centre, sides, and yaw in degrees, in [0, 90).

    A rectangle along the axes is preferred if it is hardly larger, such as for a turn of a degree.
    """
    try:
        hull = points[ConvexHull(points).vertices]
    except QhullError:  # all lie on a line
        hull = points
    hull = np.roll(hull, -np.lexsort(hull.T[::-1])[0], 0)  # so that the choice of equals is always the same
    edges = np.roll(hull, -1, 0) - hull
    least, best = math.inf, (0.0, 0.0, 0.0, 0.0, 0.0)
    for angle in [0.0, *(np.arctan2(edges[:, 1], edges[:, 0]) % (math.pi / 2)).tolist()]:
        axes = turned_axes(angle)
        turned = hull @ axes.T
        low, high = turned.min(0), turned.max(0)
        area = float(np.prod(high - low))
        if area < 0.97 * least or (area < least and best[4] != 0.0):
            x, y = ((low + high) / 2 @ axes).tolist()
            least, best = area, (x, y, *(high - low).tolist(), math.degrees(angle))
    return best
