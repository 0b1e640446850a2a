"""Check that an image shows the expected bin or tote, where the camera's pose says it is."""

import numpy as np
from scipy import ndimage

from pickplace.common.validate import refuse_if
from pickplace.robot.box import DepthMapError
from pickplace.robot.depth_image import EIGHT_NEIGHBOURS, Heights, Room, distance_outside, level_range

MAX_WRONG_PIXELS = 12  # number of pixels that may be wrong
MIN_FLOOR = 0.02  # least share of the seen pixels on the floor; with less, the rim is checked instead
MIN_RIM = 0.25  # least share of the rim, taken as a pixel wide, that must be seen then
MAX_SHARE_BELOW = 0.01  # greatest share of the seen pixels that may be below the floor
MAX_OPEN_SHARE = 0.2  # greatest share of a wall that may be open
RIM_WIDTH = 0.015  # width of the strip of the rim that is checked, m
HINT = "check the camera's pose, its calibration, and that this is the image of the {}"


def check_room(seen: Heights, room: Room, accuracy: float, margin: float) -> None:
    """Check that the floor is level, at height 0 and ends at the walls, and that nothing reaches over them.

    Args:
        margin: width of the border along the walls, m; a point in it may belong to a wall.

    Raises:
        DepthMapError: naming what is wrong.
    """
    within, band = seen.is_within(room, margin), level_range(accuracy)
    _refuse_over_wall(seen, room, band)
    _check_walls(seen, room)
    below = within & (seen.height < -band)
    refuse_if(
        below.sum() > max(MAX_WRONG_PIXELS, MAX_SHARE_BELOW * within.sum()),
        f"depth: {below.sum() / max(1, within.sum()):.0%} of what is seen in the {room.name} lies below its floor, at "
        f"{float(np.median(seen.height[below])) if below.any() else 0:.3f} m, expected 0 m: {HINT.format(room.name)}.",
        DepthMapError,
    )
    at_floor = np.abs(np.nan_to_num(seen.height, nan=np.inf)) <= band
    floor = within & ndimage.binary_erosion(at_floor, EIGHT_NEIGHBOURS)  # not the feet of items
    if floor.sum() >= max(MAX_WRONG_PIXELS, MIN_FLOOR * within.sum()):
        _check_level(seen, room, floor, accuracy)
        _check_size(seen, room, floor, band, accuracy)
    else:
        _check_rim(seen, room, band, accuracy)


def _check_level(seen: Heights, room: Room, floor: np.ndarray, accuracy: float) -> None:
    """Refuse a floor that is not level and flat at height 0."""
    points, heights = seen.points[floor], seen.height[floor]
    plane = fit_plane(points, heights)
    at = f"the floor of the {room.name}"
    refuse_if(
        abs(height := float(np.median(heights))) > accuracy,
        f"depth: {at} is seen at a height of {height:.3f} m, expected 0 m, or {accuracy:g} m more or less: "
        f"{HINT.format(room.name)}.",
        DepthMapError,
    )
    refuse_if(
        float(np.abs(plane).max()) > accuracy,
        f"depth: {at} is not level: it is seen from {plane.min():.3f} to {plane.max():.3f} m, expected 0 m, or "
        f"{accuracy:g} m more or less: {HINT.format(room.name)}.",
        DepthMapError,
    )
    refuse_if(
        (uneven := float(np.quantile(np.abs(heights - plane), 0.95))) > accuracy,
        f"depth: {at} is not flat: it is seen {uneven:.3f} m off its plane, expected {accuracy:g} m at most.",
        DepthMapError,
    )


def fit_plane(points: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Fit a plane to heights ``[M]`` at points ``[M, 2]``, and return its heights at these points, ``[M]``."""
    matrix = np.column_stack([points - points.mean(0), np.ones(len(points))])
    return matrix @ np.linalg.lstsq(matrix, heights, rcond=None)[0]


def _check_size(seen: Heights, room: Room, floor: np.ndarray, band: float, accuracy: float) -> None:
    """Refuse a floor that goes on beyond the walls. It may end before them, as something may stand at a wall."""
    if room.rim <= 2 * band:  # such walls are not seen
        return
    raw = np.nan_to_num(seen.raw, nan=np.inf)
    parts, _ = ndimage.label(np.abs(raw) <= band)  # the median filter would remove a thin wall
    joined = np.isin(parts, np.unique(parts[floor & (parts > 0)])) & (parts > 0)
    outside = distance_outside(seen.points_at_height(np.where(joined, raw, 0.0)), room)
    beyond = joined & (outside > max(2 * seen.pixel, accuracy))
    refuse_if(
        beyond.sum() > MAX_WRONG_PIXELS,
        f"depth: the floor of the {room.name} goes on {float(outside[beyond].max(initial=0.0)):.3f} m beyond its "
        f"walls, expected {room.sides[0]:g} x {room.sides[1]:g} m: {HINT.format(room.name)}.",
        DepthMapError,
    )


def _check_walls(seen: Heights, room: Room) -> None:
    """Refuse an image in which rays that should end at a wall end far below."""
    ways = []
    for axis, length in enumerate(room.sides):
        ray = seen.rays[..., axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            ways.append(np.where(ray == 0, np.inf, (np.where(ray > 0, length, 0.0) - seen.origin[axis]) / ray))
    side, first = ways[1] < ways[0], np.minimum(*ways)
    leaves = np.where(np.isfinite(first), seen.origin[2] + first * seen.rays[..., 2], 0.0)
    at_wall = distance_outside(seen.points_at_height(leaves), room) < 1e-6
    known = ~np.isnan(seen.raw) & at_wall & (first > 0)
    known &= (leaves > max(0.03, 0.3 * room.rim)) & (leaves < 0.9 * room.rim)
    for axis in (0, 1):
        for way_up in (False, True):
            wall = known & (side == axis) & ((seen.rays[..., axis] > 0) == way_up)
            through = wall & (seen.raw < leaves / 4)
            refuse_if(
                through.sum() > max(MAX_WRONG_PIXELS, MAX_OPEN_SHARE * wall.sum()),
                f"depth: no wall of the {room.name} is seen at {'xy'[axis]}={room.sides[axis] * way_up:g} m, expected "
                f"one that is {room.rim:g} m high: {HINT.format(room.name)}.",
                DepthMapError,
            )


def _refuse_over_wall(seen: Heights, room: Room, band: float) -> None:
    """Refuse a thing, such as an arm, that is seen above the rim on both sides of a wall's inner face."""
    outside = distance_outside(seen.points, room)
    parts, count = ndimage.label(seen.height > room.rim + band, EIGHT_NEIGHBOURS)
    beyond = parts * ((outside > 1.5 * seen.pixel) & (outside < 1.5 * seen.pixel + 0.006))
    within = parts * (outside < -1.5 * seen.pixel)
    for number in range(1, count + 1):
        refuse_if(
            min((beyond == number).sum(), (within == number).sum()) > MAX_WRONG_PIXELS,
            f"depth: something {float(np.median(seen.height[parts == number])):.3f} m high reaches over a wall of the "
            f"{room.name}, whose rim is at {room.rim:g} m; expected nothing there: is a hand or a tool in the way?",
            DepthMapError,
        )


def _check_rim(seen: Heights, room: Room, band: float, accuracy: float) -> None:
    """Check the height of the rim, where too little of the floor is seen."""
    outside = distance_outside(seen.points, room)
    rim = (outside > 0) & (outside < RIM_WIDTH) & (np.abs(seen.height - room.rim) <= band)
    height = float(np.median(seen.height[rim])) if rim.any() else 0.0
    refuse_if(
        rim.sum() < MIN_RIM * 2 * sum(room.sides) / seen.pixel or abs(height - room.rim) > accuracy,
        f"depth: neither the floor of the {room.name} is seen at 0 m, nor its rim at {room.rim:g} m: "
        f"{HINT.format(room.name)}.",
        DepthMapError,
    )
