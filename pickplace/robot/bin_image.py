"""Read the items in a bin from a depth image: boxes that can be picked, and obstacles."""

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np
from scipy import ndimage

from pickplace.common.validate import expect, refuse_if
from pickplace.robot.box import Box, DepthMapError, HiddenBox, UnknownBox
from pickplace.robot.depth_image import EIGHT_NEIGHBOURS, Heights, Room, distance_outside, level_range
from pickplace.robot.measure import PARALLEL_TOLERANCE, is_inside, smallest_rectangle, turned_axes
from pickplace.robot.room_check import fit_plane

MAX_FREE_SHARE = 0.01  # greatest share of the inside of its rectangle that an item's top may leave free
BORDER = 2.5  # width of the rectangle's border, pixels; the rest is its inside
LONGEST_GAP = 3.5  # longest gap beyond the seen edge of an item, pixels; a wall that hides more allows more
HIDDEN_PIXELS = 1.5  # distance from a box at which its edge should be seen, pixels
EDGE_POINTS = 32  # number of points along each side of a box, and along each ray
MIN_ITEM_PIXELS = 9  # fewest pixels of a thing in a bin; smaller ones are ignored
MAX_HIDDEN_SHARE = 0.25  # greatest share of the bin's floor that holes may hide


def find_boxes(
    seen: Heights,
    room: Room,
    margin: float,
    accuracy: float,
    greatest: float,
    labels: np.ndarray | None,
    sizes: list[tuple[float, float, float]] | None,
) -> list[Box]:
    """Return the items in a bin, and an :class:`UnknownBox` for each place that may hold one; see :meth:`Camera.items`.

    Args:
        seen: the heights of an image that was checked.
        margin: width of the border along the walls, m; a point in it may belong to a wall.
        greatest: height of the highest item that may lie there, m.
        labels: the item of each pixel, in the shape of ``seen``; None: steps of the height tell items apart.
    """
    within, band = seen.is_within(room, margin), level_range(accuracy)
    above = within & (seen.height > band)
    too_high = above & (seen.height > greatest + band)
    refuse_if(
        too_high.sum() >= MIN_ITEM_PIXELS,
        f"depth: something {float(np.quantile(seen.height[too_high], 0.95)) if too_high.any() else 0:.3f} m high is "
        f"seen in the bin, expected items up to {greatest:g} m, see greatest_height: is a hand or a tool in the way?",
        DepthMapError,
    )
    surface = seen.surface(room)
    reach = _step_reach(seen, room, above, accuracy) if labels is None else 0
    segments = _segments(seen, above, accuracy, reach, labels)
    numbers, counts = np.unique(segments[segments > 0], return_counts=True)
    boxes, floor, free = [], seen.points_at_height(0.0), np.ones_like(seen.holes)
    for number in numbers[counts >= MIN_ITEM_PIXELS]:
        box, seen_top = _read_box(seen, room, margin, surface, segments, number, above, accuracy, reach)
        boxes.append(box)
        if not isinstance(box, UnknownBox):
            free &= ~is_inside(floor, *seen_top)
    hidden = [0.0 if isinstance(box, UnknownBox) else _hidden_length(seen, box, boxes) for box in boxes]
    for box, length in zip(boxes, hidden, strict=True):
        if sizes is not None and not length and not isinstance(box, UnknownBox):
            _check_reading(box, sizes, 2 * (seen.pixel + accuracy + box.edge_error))
    boxes = [
        HiddenBox(box.x, box.y, box.w + 2 * length, box.d + 2 * length, box.h, box.yaw) if length else box
        for box, length in zip(boxes, hidden, strict=True)
    ]
    boxes += [*_rest(seen, above, boxes), *_behind_holes(seen, room, surface, accuracy, free, greatest)]
    refuse_if(
        bool(boxes) and all(isinstance(box, UnknownBox) for box in boxes),
        f"depth: {len(boxes)} places in the bin are not seen well enough to tell where an item ends, the first at "
        f"[{boxes[0].x if boxes else 0:.3f}, {boxes[0].y if boxes else 0:.3f}]; expected one item that is seen with "
        "its whole edge: take another image.",
        DepthMapError,
    )
    return boxes


def _step(seen: Heights, accuracy: float) -> float:
    """Return the least difference of heights that parts two items, m."""
    return 4 * accuracy + seen.pixel


def _step_reach(seen: Heights, room: Room, above: np.ndarray, accuracy: float) -> int:
    """Return the number of pixels on each side within which a step of the height is looked for.

    A camera that looks at an item from the side also sees its side, whose pixels are lower the further out they are.
    The reach is so long that any side has the whole step within it, with a quarter more for noise.
    """
    heights, camera = seen.height[above], seen.origin[2]
    if len(heights) < MIN_ITEM_PIXELS:
        return 1
    highest = np.partition(heights, -MIN_ITEM_PIXELS)[-MIN_ITEM_PIXELS]
    way = camera - min(highest, camera / 2)  # down to the highest item, where the pixels are smallest
    slant = np.linalg.norm(room.corners - seen.origin[:2], axis=1).max() / way
    pixel = seen.pixel * way / camera
    return max(1, math.ceil(1.25 * _step(seen, accuracy) * slant / (2 * pixel)))


def _segments(seen: Heights, above: np.ndarray, accuracy: float, reach: int, labels: np.ndarray | None) -> np.ndarray:
    """Return the number of the item that each pixel shows, 0 for none; see :func:`_step_reach`."""
    if labels is None:
        known, width = ~np.isnan(seen.height), 2 * reach + 1
        high = ndimage.maximum_filter(np.where(known, seen.height, -np.inf), width)
        low = ndimage.minimum_filter(np.where(known, seen.height, np.inf), width)
        return ndimage.label(above & (high - low < _step(seen, accuracy)))[0]
    named = ndimage.binary_dilation(labels > 0, EIGHT_NEIGHBOURS, iterations=2)
    if (left := above & ~named).sum() >= MIN_ITEM_PIXELS:
        row, column = np.argwhere(left)[0].tolist()
        raise DepthMapError(
            f"labels[{row + seen.corner[0]}, {column + seen.corner[1]}]: got 0, but something "
            f"{seen.height[row, column]:.3f} m high lies there; expected a label for each item."
        )
    return np.where(above & (labels > 0), labels, 0)


def _read_box(
    seen: Heights, room: Room, margin: float, surface: np.ndarray, segments: np.ndarray, number: int,
    above: np.ndarray, accuracy: float, reach: int,
) -> tuple[Box, tuple]:  # fmt: skip
    """Return the cuboid whose top fills a segment, and the seen part of its top: centre, sides and yaw.

    The cuboid is an :class:`UnknownBox` if it may go on where nothing is seen.

    Args:
        margin: width of the border along the walls in which no top is seen, m.
        surface: see :meth:`Heights.surface`.
        reach: number of the segment's outermost pixels that the search for steps removed; 0 if labels made it.
    """
    top, band = segments == number, level_range(accuracy)
    height = float(np.quantile(seen.height[top], 0.95))
    if reach:
        level = above & (segments == 0) & (np.abs(seen.height - height) <= band)
        # Twice as far, as the square of the search removes more at the corners of a turned item.
        top = ndimage.binary_dilation(top, EIGHT_NEIGHBOURS, iterations=2 * reach - 1, mask=level | top)
    points, pixel = seen.points_at_height(height), seen.pixel * (seen.origin[2] - height) / seen.origin[2]
    # A pixel more than ``accuracy`` below the top shows the item's side: where it lies is nearer to the edge than where
    # its ray passes the height of the top.
    places = seen.points_at_height(np.fmin(height, seen.height + accuracy))
    x, y, w, d, yaw = smallest_rectangle(places[top])
    _check_top(seen, (x, y, w, d, yaw), points, top, pixel, accuracy)
    # Each side may be as far out as the first ray in front of it that passes the height of the top.
    known = ~np.isnan(seen.height)
    passed = known & ~top & (np.abs(seen.height - height) > band)
    # One that ends at a wall before it would have come there, inside the room, tells nothing.
    at_wall = known & (seen.height > height) & (distance_outside(seen.points, room) > -margin)
    passed &= ~(at_wall & (distance_outside(points, room) < 0))
    if not reach:  # labels separate it from others of the same height
        passed |= (segments > 0) & ~top
    # Nor can the box stand on a place that is seen.
    axes = turned_axes(math.radians(yaw))
    free = np.concatenate([points[passed], seen.points[passed & (seen.height < height)]]) - (x, y)
    beyond, corners = ([each @ axis for axis in axes] for each in (free, room.corners - (x, y)))
    sides = [(axis, sign) for axis in (0, 1) for sign in (-1, 1)]
    free_gaps = np.array([_least_beyond(beyond, (w, d), axis, sign, pixel) for axis, sign in sides])
    wall_gaps = np.array([(sign * corners[axis]).max() - (w, d)[axis] / 2 + pixel / 2 for axis, sign in sides])
    free_gaps[wall_gaps <= margin + 1.5 * pixel] = np.inf  # the border hides where the item ends
    outer = np.maximum(0.5 * pixel, np.minimum(free_gaps, wall_gaps) - pixel)  # beyond the outermost pixels' centres
    longest = np.where(wall_gaps <= free_gaps, max(LONGEST_GAP * pixel, margin + pixel), LONGEST_GAP * pixel)

    def grown(by: np.ndarray) -> dict:
        shift = np.array([by[1] - by[0], by[3] - by[2]]) / 2 @ axes
        return {"x": float(x + shift[0]), "y": float(y + shift[1]), "w": float(w + by[0] + by[1]),
                "d": float(d + by[2] + by[3]), "h": height, "yaw": yaw}  # fmt: skip

    # The uppermost part of a side, as high as ``accuracy``, looks like the top.
    slant = float(np.hypot(*(seen.origin[:2] - (x, y)))) / (seen.origin[2] - height)
    error = float(max(0.0, outer.max() - pixel, accuracy * slant - pixel / 2))
    on_top = is_inside(points, (x, y), (w, d), yaw)
    if (outer <= longest).all() and not seen.holes_above(height, surface, room, accuracy, on_top).any():
        return Box(**grown(outer), edge_error=error).upright(), ((x, y), (w + 2 * pixel, d + 2 * pixel), yaw)
    return UnknownBox(**grown(outer)).upright(), ((x, y), (w, d), yaw)


def _least_beyond(
    points: Sequence[np.ndarray], sides: Sequence[float], axis: int, sign: int, pixel: float
) -> float:  # fmt: skip
    """Return the distance from a side of a rectangle to the nearest point in front of it, m; inf if there is none.

    Args:
        points: x and y of each point in the frame of the rectangle.
        axis, sign: select one of its four sides.
    """
    other = sides[1 - axis] / 2
    beyond = sign * points[axis] - sides[axis] / 2
    in_front = (np.abs(points[1 - axis]) < max(other - 1.5 * pixel, other / 2)) & (beyond > -0.5 * pixel)
    return float(beyond[in_front].min(initial=np.inf))


def _check_top(
    seen: Heights, rectangle: tuple, points: np.ndarray, top: np.ndarray, pixel: float, accuracy: float
) -> None:
    """Refuse a top that does not fill its rectangle, or is not level and flat.

    Args:
        points: where each pixel's ray passes the height of the top, ``[rows, columns, 2]``.
        top: bool ``[rows, columns]``.
    """
    x, y, w, d, yaw = rectangle
    border = (BORDER - 1) * pixel + PARALLEL_TOLERANCE * max(w, d) * (yaw == 0)
    inside = is_inside(points, (x, y), (w - 2 * border, d - 2 * border), yaw)
    found = f"depth: what lies at [{x:.3f}, {y:.3f}]"
    if (
        inside.any()
        and (missing := float((inside & ~top & ~np.isnan(seen.height)).sum() / inside.sum())) > MAX_FREE_SHARE
    ):
        raise DepthMapError(
            f"{found} leaves {missing:.0%} of its rectangle of {w + pixel:.3f} x {d + pixel:.3f} m free: it could be "
            "two items that touch, or one that is no cuboid; separate them, or pass labels."
        )
    inner = ndimage.binary_erosion(top, EIGHT_NEIGHBOURS)
    inner = inner if inner.sum() >= MIN_ITEM_PIXELS else top
    heights = seen.height[inner]
    plane = fit_plane(points[inner], heights)
    refuse_if(
        (slope := float(np.ptp(plane))) > 2 * accuracy,
        f"{found} has a top that slopes by {slope:.3f} m, expected a level one, {2 * accuracy:g} m at most: is it "
        "tilted, or two items that touch, or the camera's pose wrong?",
        DepthMapError,
    )
    refuse_if(
        (uneven := float(np.quantile(np.abs(heights - plane), 0.95))) > 2 * accuracy,
        f"{found} has a top that is {uneven:.3f} m off a plane, expected a flat one, {2 * accuracy:g} m at most.",
        DepthMapError,
    )


def _rest(seen: Heights, above: np.ndarray, boxes: Sequence[Box]) -> list[Box]:
    """Return an :class:`UnknownBox` around each thing in the bin that lies outside the boxes."""
    left, points = above.copy(), seen.points
    for box in boxes:
        left &= ~is_inside(points, (box.x, box.y), (box.w + 5 * seen.pixel, box.d + 5 * seen.pixel), box.yaw)
    parts, count = ndimage.label(left, EIGHT_NEIGHBOURS)
    found = (parts == number for number in range(1, count + 1))
    return [
        _around(points[part], seen.pixel, float(seen.height[part].max()))
        for part in found
        if part.sum() >= MIN_ITEM_PIXELS
    ]


def _behind_holes(
    seen: Heights, room: Room, surface: np.ndarray, accuracy: float, free: np.ndarray, greatest: float
) -> list[Box]:  # fmt: skip
    """Return an :class:`UnknownBox`, as high as an item may be, for each place on the floor that a hole may hide.

    Args:
        free: bool, False where an item stands: a hole there shows the item's side.
    """
    floor = seen.points_at_height(0.0)
    holes = seen.holes_above(0.0, surface, room, accuracy, free)
    refuse_if(
        (share := holes.sum() / (distance_outside(floor, room) < 0).sum()) > MAX_HIDDEN_SHARE,
        f"depth: {share:.0%} of the bin are not seen, expected {MAX_HIDDEN_SHARE:.0%} at most: take another image.",
        DepthMapError,
    )
    parts, count = ndimage.label(holes, EIGHT_NEIGHBOURS)
    found = [_around(floor[parts == number], seen.pixel, greatest) for number in range(1, count + 1)]
    for box in found:
        refuse_if(
            max(box.w, box.d) > 0.8 * min(room.sides),
            f"depth: a part of the bin of {box.w:.3f} x {box.d:.3f} m at [{box.x:.3f}, {box.y:.3f}] is not seen, "
            f"expected sides of {0.8 * min(room.sides):.3f} m at most: take another image.",
            DepthMapError,
        )
    return found


def _around(points: np.ndarray, pixel: float, height: float) -> Box:
    """Return an :class:`UnknownBox` around points ``[M, 2]``, wider than they are by a pixel on each side."""
    x, y, w, d, yaw = smallest_rectangle(points)
    return UnknownBox(x, y, float(w + 2 * pixel), float(d + 2 * pixel), height, yaw).upright()


def _hidden_length(seen: Heights, box: Box, boxes: Sequence[Box]) -> float:
    """Return the length by which a box may go on behind higher ones, m; 0 if its whole edge is seen."""
    camera = seen.origin
    pixel = seen.pixel * (camera[2] - box.h) / camera[2]
    side, grown = np.linspace(-1, 1, EDGE_POINTS), HIDDEN_PIXELS * pixel
    one = np.ones_like(side)
    edge = np.concatenate([[side, one], [side, -one], [one, side], [-one, side]], 1).T
    edge = edge * (box.w / 2 + grown, box.d / 2 + grown) @ turned_axes(math.radians(box.yaw)) + (box.x, box.y)
    to_camera, longest = camera[:2] - edge, 0.0
    for other in (each for each in boxes if each.h > box.h):
        share = (other.h - box.h) / (camera[2] - box.h)  # of the ray that runs below the other's top
        ray = edge + np.linspace(0, share, EDGE_POINTS)[:, None, None] * to_camera
        inside = is_inside(ray, (other.x, other.y), (other.w, other.d), other.yaw)
        hidden = to_camera[inside.any(0) & ~inside[0]]  # a point in the other box is not in this one
        longest = max(longest, float((share * np.linalg.norm(hidden, axis=1)).max(initial=0.0)))
    return longest if longest > pixel / 2 else 0.0


def as_sizes(sizes) -> list[tuple[float, float, float]]:
    """Return the sizes of items as triples ``(w, d, h)``, m; refuse what is none with a ``ValueError``."""
    try:
        array = np.asarray(sizes, dtype=float)
    except (TypeError, ValueError):
        array = np.empty(0)
    good = array.ndim == 2 and array.shape[1] == 3 and len(array) and (np.isfinite(array) & (array > 0)).all()
    expect(good, "sizes", sizes, "a list of (w, d, h), lengths above 0 in metres")
    return [(w, d, h) for w, d, h in array.tolist()]


def _check_reading(box: Box, sizes: list[tuple[float, float, float]], tolerance: float) -> None:
    """Refuse a box that could be two items of known sizes, or has no known size; the message names both readings."""
    tall = [(w, d) for a, b, h in sizes for w, d in {(a, b), (b, a)} if abs(box.h - h) <= tolerance]

    def is_like(w: float, d: float) -> bool:
        return abs(box.w - w) <= tolerance and abs(box.d - d) <= tolerance

    def side_by_side(a: tuple, b: tuple, along: int) -> bool:
        sides = [0.0, 0.0]
        sides[along], sides[1 - along] = a[along] + b[along], max(a[1 - along], b[1 - along])
        return is_like(*sides) and abs(a[1 - along] - b[1 - along]) <= tolerance

    one = [(w, d) for w, d in tall if is_like(w, d)]
    pairs = combinations_with_replacement(tall, 2)
    two = [(a, b) for a, b in pairs if side_by_side(a, b, 0) or side_by_side(a, b, 1)]
    found = f"depth: what lies at [{box.x:.3f}, {box.y:.3f}], {box.w:.3f} x {box.d:.3f} x {box.h:.3f} m,"
    if two:
        pair = " and ".join(f"{w:g} x {d:g}" for w, d in two[0])
        single = f"one item of {one[0][0]:g} x {one[0][1]:g} m or " if one else ""
        raise DepthMapError(f"{found} is {single}two of {pair} m that touch; separate them, or pass labels.")
    refuse_if(not one, f"{found} is no item of the given sizes.", DepthMapError)
