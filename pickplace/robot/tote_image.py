"""Read the heights in a tote from a depth image."""

import math
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from pickplace.common.validate import refuse_if
from pickplace.robot.box import DepthMapError
from pickplace.robot.depth_image import EIGHT_NEIGHBOURS, Heights, Room, distance_outside, level_range
from pickplace.robot.measure import ToteMap
from pickplace.robot.room_check import MAX_WRONG_PIXELS

MAX_UNSEEN_SHARE = 0.25  # greatest share of a tote that may be unseen
THICKEST = 0.02  # greatest thickness of the walls, m
NARROWEST = 0.02  # least width of a hand or a tool, m


def read_tote(seen: Heights, room: Room, margin: float, accuracy: float, grid: Sequence[int], along: int) -> ToteMap:
    """Return the heights in each patch of a tote.

    Args:
        seen: the heights of an image that was checked.
        margin: width of the border along the walls, m; a point in it may belong to a wall.
        grid: of the tote, in cells.
        along: number of patches along a cell.

    Raises:
        DepthMapError: for something above the rim, or too much that is not seen.
    """
    within = distance_outside(seen.points_at_height(seen.highest), room) < -margin
    over = within & (seen.height > room.rim + level_range(accuracy))
    refuse_if(
        over.sum() > MAX_WRONG_PIXELS,
        f"depth: something {float(np.median(seen.height[over])) if over.any() else 0:.3f} m high is seen in the tote, "
        f"expected up to {room.rim:g} m, its rim: is a hand or a tool in the way?",
        DepthMapError,
    )
    shape = np.array(grid) * along
    unknown = _behind_holes(seen, room, margin, accuracy, shape)
    lowest_seen = np.where(seen.holes, 0.0, np.nan_to_num(seen.lowest, nan=np.inf))
    highest, lowest = _patch_heights(seen, room, margin, shape, seen.highest, lowest_seen)
    refuse_if(
        (share := float((unknown | np.isinf(highest)).mean())) > MAX_UNSEEN_SHARE,
        f"depth: {share:.0%} of the tote are not seen, expected {MAX_UNSEEN_SHARE:.0%} at most.",
        DepthMapError,
    )
    _check_rim(seen, room)
    highest[unknown] = room.rim
    lowest[np.isinf(lowest)] = 0.0
    # At the walls the nearest seen place counts: there the camera sees the wall instead of the contents.
    border = np.ones(shape, dtype=bool)
    edge = math.ceil(margin * shape[0] / room.sides[0])
    border[edge:-edge, edge:-edge] = False
    unseen = np.isinf(highest)
    hidden, count = ndimage.label(unseen & ~border, EIGHT_NEIGHBOURS)
    for part in (hidden == number for number in range(1, count + 1)):
        around = ndimage.binary_dilation(part, EIGHT_NEIGHBOURS) & ~unseen
        highest[part] = highest[around].max(initial=0.0 if around.any() else room.rim)
    return ToteMap(
        _nearest(highest, np.isinf(highest)).clip(0, None),
        lowest.clip(0, None),
        _likely(seen, room, margin, shape) if (within & np.isnan(seen.height)).any() else None,
        bool(unknown.any()),
    )


def _check_rim(seen: Heights, room: Room) -> None:
    """Refuse an image in which a wide hole goes from the inside of a tote over its wall to the outside.

    The contents of a tote cannot hide its rim. A thing that does is above the rim, and the hole does not tell where.
    """
    if not seen.holes.any():
        return
    pixel = seen.pixel * (1 - room.rim / seen.origin[2])
    side = 2 * math.ceil(NARROWEST / pixel / 2) - 1
    wide, _ = ndimage.label(ndimage.maximum_filter(ndimage.minimum_filter(seen.holes, side), side), EIGHT_NEIGHBOURS)
    beyond = distance_outside(seen.points_at_height(room.rim), room)
    over = np.intersect1d(wide[beyond < 0], wide[beyond > THICKEST])
    refuse_if(
        over.any(),
        f"depth: the rim of the {room.name} has no depth over {NARROWEST * 1000:g} mm or more, expected to see it: is "
        "a hand or a tool in the way?",
        DepthMapError,
    )


def _patch_heights(
    seen: Heights, room: Room, margin: float, shape: np.ndarray, highest: np.ndarray, lowest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the greatest and the least height in each patch, ``shape``; -inf and inf where nothing is seen.

    Args:
        highest: of each pixel, NaN if unknown; widened by a pixel.
        lowest: of each pixel, inf if unknown; narrowed by a pixel.
    """
    # A gap is already as wide as a thing in it may be; a seen thing may end up to a pixel further out.
    high = np.where(np.isnan(highest), -np.inf, highest)
    high = np.maximum(high, ndimage.maximum_filter(np.where(np.isnan(seen.height), -np.inf, seen.height), 3))
    low = ndimage.minimum_filter(lowest, 3)
    greatest, least = np.full(shape, -np.inf), np.full(shape, np.inf)
    for places, is_own in ((highest, True), (np.where(np.isinf(high), np.nan, high), False)):
        # A pixel beside a higher one also stands for the place at that height.
        points = seen.points_at_height(places)
        within = distance_outside(points, room) < -margin
        at = tuple((points[within] / (room.sides[0] / shape[0])).astype(int).clip(0, shape - 1).T)
        np.maximum.at(greatest, at, high[within])
        np.minimum.at(least, at, low[within] if is_own else np.inf)
    return greatest, least


def _nearest(heights: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return a map in which each missing patch has the value of the nearest other one."""
    return heights[tuple(ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True))]


def _likely(seen: Heights, room: Room, margin: float, shape: np.ndarray) -> ToteMap:
    """Return the map in which each place without depth is like those beside it."""
    high, low = _patch_heights(seen, room, margin, shape, seen.height, np.nan_to_num(seen.height, nan=np.inf))
    missing = np.isinf(high) | np.isinf(low)
    return ToteMap(_nearest(high, missing).clip(0, None), _nearest(low, missing).clip(0, None))


def _behind_holes(seen: Heights, room: Room, margin: float, accuracy: float, shape: np.ndarray) -> np.ndarray:
    """Return a mask of the patches where a hole in the image could hide a thing on a surface, bool ``shape``.

    The rays of the hole's pixels are followed up to the rim, as the surface itself may not be seen.
    """
    unknown = np.zeros(shape, dtype=bool)
    if not seen.holes.any():
        return unknown
    surface, step, patch = seen.surface(room), level_range(accuracy), room.sides[0] / shape[0]
    away = np.linalg.norm(room.corners - seen.origin[:2], axis=1).max()
    shift = away * room.rim / seen.origin[2]  # of a ray between rim and floor, at most
    for level in np.unique(np.round(seen.height[seen.is_within(room, margin)] / step)) * step:
        if not (holes := seen.holes_above(level, surface, room, accuracy)).any():
            continue
        rays = seen.rays[ndimage.binary_dilation(holes, EIGHT_NEIGHBOURS)]
        for height in np.linspace(level, max(level, room.rim), math.ceil(shift / (patch / 2)) + 2):
            points = seen.origin[:2] + rays[:, :2] * ((height - seen.origin[2]) / rays[:, 2])[:, None]
            index = np.floor(points / patch).astype(int)
            unknown[tuple(index[((index >= 0) & (index < shape)).all(1)].T)] = True
    return unknown
