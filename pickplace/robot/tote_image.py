"""The heights in a tote, read from a depth image."""

import math
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from pickplace.common.validate import refuse_if
from pickplace.robot.box import DepthMapError
from pickplace.robot.depth_image import AROUND, Heights, Room, distance_outside, level_range
from pickplace.robot.measure import ToteMap
from pickplace.robot.room_check import FEW

MOST_UNSEEN = 0.25  # greatest share of a tote that the camera may not see


def read_tote(seen: Heights, room: Room, margin: float, accuracy: float, grid: Sequence[int], along: int) -> ToteMap:
    """Return the heights in each patch of a tote.

    Args:
        seen: of an image that was checked.
        margin: width of the border along the walls in which a point may be one of the wall, m.
        grid: of the tote, in cells.
        along: patches along a cell.

    Raises:
        DepthMapError: for something above the rim, or too much that is not seen.
    """
    within = distance_outside(seen.at(seen.highest), room) < -margin
    over = within & (seen.height > room.rim + level_range(accuracy))
    refuse_if(
        over.sum() > FEW,
        f"depth: something {float(np.median(seen.height[over])) if over.any() else 0:.3f} m high is seen in the tote, "
        f"expected up to {room.rim:g} m, its rim: is a hand or a tool in the way?",
        DepthMapError,
    )
    shape = np.array(grid) * along
    patch = room.sides[0] / shape[0]  # side of a patch, m
    holes = _holes_inside(seen, room, margin, accuracy)
    unknown = _patches_behind(seen, room, holes, shape, patch)
    lowest_seen = np.where(holes, 0.0, np.nan_to_num(seen.lowest, nan=np.inf))
    highest, lowest = _patch_heights(seen, room, margin, shape, seen.highest, lowest_seen)
    refuse_if(
        (share := float((unknown | np.isinf(highest)).mean())) > MOST_UNSEEN,
        f"depth: {share:.0%} of the tote are not seen, expected {MOST_UNSEEN:.0%} at most.",
        DepthMapError,
    )
    highest[unknown], lowest[unknown] = room.rim, 0.0
    # At the walls the nearest place that is seen; there the camera sees the wall, not what is beside it.
    border = np.ones(shape, dtype=bool)
    edge = math.ceil(margin / patch)
    border[edge:-edge, edge:-edge] = False
    unseen = np.isinf(highest)
    hidden, count = ndimage.label(unseen & ~border, AROUND)
    for part in (hidden == number for number in range(1, count + 1)):
        around = ndimage.binary_dilation(part, AROUND) & ~unseen
        highest[part], lowest[part] = highest[around].max(initial=0.0 if around.any() else room.rim), 0.0
    at_wall = np.isinf(highest)
    return ToteMap(
        _nearest(highest, at_wall).clip(0, None),
        np.where(at_wall, 0.0, lowest).clip(0, None),
        _likely(seen, room, margin, shape) if (within & np.isnan(seen.height)).any() or holes.any() else None,
    )


def _patch_heights(
    seen: Heights, room: Room, margin: float, shape: np.ndarray, highest: np.ndarray, lowest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the greatest and the least height in each patch, ``shape``; -inf and inf where nothing is seen.

    Args:
        highest: of each pixel, NaN if unknown; widened by a pixel.
        lowest: of each pixel, inf if unknown; narrowed by a pixel.
    """
    points = seen.at(highest)
    within = distance_outside(points, room) < -margin
    high = ndimage.maximum_filter(np.where(np.isnan(highest), -np.inf, highest), 3)
    low = ndimage.minimum_filter(lowest, 3)
    at = tuple((points[within] / (room.sides[0] / shape[0])).astype(int).clip(0, shape - 1).T)
    greatest, least = np.full(shape, -np.inf), np.full(shape, np.inf)
    np.maximum.at(greatest, at, high[within])
    np.minimum.at(least, at, low[within])
    return greatest, least


def _nearest(heights: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return a map in which each missing patch has the value of the nearest other one."""
    return heights[tuple(ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True))]


def _likely(seen: Heights, room: Room, margin: float, shape: np.ndarray) -> ToteMap:
    """Return the map if all that has no depth is like what is beside it."""
    high, low = _patch_heights(seen, room, margin, shape, seen.height, np.nan_to_num(seen.height, nan=np.inf))
    return ToteMap(*(_nearest(part, np.isinf(high)).clip(0, None) for part in (high, low)))


def _holes_inside(seen: Heights, room: Room, margin: float, accuracy: float) -> np.ndarray:
    """Return the pixels of holes that may show something that stands in the tote, bool; others show its walls."""
    holes, surface = np.zeros_like(seen.holes), seen.surface(room)
    step = level_range(accuracy)
    levels = np.unique(np.round(seen.height[seen.is_within(room, margin)] / step)) * step
    for height in levels if seen.holes.any() else ():
        holes |= seen.holes_above(height, surface, room, accuracy)
    if not holes.any():
        return holes
    # A thing at the wall goes on in front of it.
    at_wall = math.ceil(_greatest_shift(seen, room) / seen.pixel)
    return ndimage.binary_dilation(holes, AROUND, iterations=max(1, at_wall), mask=seen.holes)


def _greatest_shift(seen: Heights, room: Room) -> float:
    """Return how far a ray goes sideways at most between the rim and the floor, m."""
    away = max(math.dist(seen.origin[:2], (x, y)) for x in (0.0, room.sides[0]) for y in (0.0, room.sides[1]))
    return away * room.rim / seen.origin[2]


def _patches_behind(seen: Heights, room: Room, holes: np.ndarray, shape: np.ndarray, patch: float) -> np.ndarray:
    """Return which patches the rays of holes pass between the rim and the floor, bool ``shape``."""
    unknown = np.zeros(shape, dtype=bool)
    wide = ndimage.binary_dilation(holes, AROUND)
    origin, rays = seen.origin, seen.rays[wide]
    steps = math.ceil(_greatest_shift(seen, room) / (patch / 2)) + 2
    for height in np.linspace(0.0, room.rim, steps) if wide.any() else ():
        points = origin[:2] + rays[:, :2] * ((height - origin[2]) / rays[:, 2])[:, None]
        index = np.floor(points / patch).astype(int)
        unknown[tuple(index[((index >= 0) & (index < shape)).all(1)].T)] = True
    return unknown
