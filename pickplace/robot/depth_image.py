"""Convert a depth image to heights above a floor: remove noise, fill single gaps, and mark what stays unknown.

A pixel without depth is *unknown*. A gap of at most three pixels, such as at the edge of an item, is too narrow to hide
a thing that matters. In a level top it is filled with the top's height; elsewhere it has bounds of the height. A wider
gap is a *hole*, and may hide anything.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from pickplace.common.validate import refuse_if
from pickplace.robot.box import Box, DepthMapError

MAX_MISSING_SHARE = 0.12  # greatest share of the pixels of level surfaces that may lack a depth
SEAM = 5  # longest gap in a level top that is filled, pixels; a longer one may part two items
MARGIN = 24  # width of the border around the room that is read, too, pixels
HOLE = np.ones((4, 4), dtype=bool)  # the smallest hole, pixels
HOLE[::3, ::3] = False
SQUARE = 1.25  # side of the squares of a seen surface, pixels
EIGHT_NEIGHBOURS = np.ones((3, 3), dtype=bool)
RECORD_MARGIN = 0.008  # greatest distance of an item in the tote from its recorded place, m


class Room(NamedTuple):
    """The inside of a bin or a tote, from ``(0, 0, 0)`` to its sides and its rim; m."""

    name: str
    sides: tuple[float, float]
    rim: float

    @property
    def corners(self) -> np.ndarray:
        """Of the floor, ``[4, 2]``; m."""
        return np.array([(x, y) for x in (0.0, self.sides[0]) for y in (0.0, self.sides[1])])


@dataclass(frozen=True, eq=False)
class Heights:
    """The heights that an image shows in a room, for each pixel; arrays are ``[rows, columns]``."""

    origin: np.ndarray  # of all rays, [3]
    rays: np.ndarray  # way along each pixel's ray, [rows, columns, 3]
    corner: tuple[int, int]  # row and column of the first pixel in the whole image
    pixel: float  # side of a pixel's square on the floor, m
    raw: np.ndarray  # height as it was measured; NaN if unknown
    height: np.ndarray  # the same without noise, and with single gaps in level surfaces filled; NaN if unknown
    highest: np.ndarray  # the greatest height that a pixel may have; NaN in holes
    lowest: np.ndarray  # the least height that a pixel may have; NaN in holes
    holes: np.ndarray  # bool: pixels of holes

    def points_at_height(self, height) -> np.ndarray:
        """Return the point where each pixel's ray passes a height, one for all or one each, ``[rows, columns, 2]``."""
        way = (height - self.origin[2]) / self.rays[..., 2]
        return np.stack([self.origin[axis] + self.rays[..., axis] * way for axis in (0, 1)], -1)

    @cached_property
    def points(self) -> np.ndarray:
        """The place that each pixel shows, ``[rows, columns, 2]``; NaN if unknown."""
        return self.points_at_height(self.height)

    def surface(self, room: Room) -> np.ndarray:
        """Return the greatest height that is seen in each square of :data:`SQUARE` pixels, -inf where none is seen."""
        side = SQUARE * self.pixel
        highest = np.full([math.ceil(length / side) for length in room.sides], -np.inf)
        known = distance_outside(self.points, room) < 0
        np.maximum.at(highest, tuple((self.points[known] / side).astype(int).T), self.height[known])
        return highest

    def holes_above(
        self, height: float, surface: np.ndarray, room: Room, accuracy: float, where: np.ndarray | bool = True
    ) -> np.ndarray:
        """Return a mask of the hole pixels that may show a thing on a surface at the given height, bool.

        Such a thing hides the whole surface below it. Pixels are left out if they can show only walls, or the sides of
        boxes whose tops are seen, or a strip that is narrower than a hole.

        Args:
            surface: see :meth:`surface`.
            where: bool: the pixels to consider; the others show no such thing.
        """
        points = self.points_at_height(height)
        inside = self.holes & where & (distance_outside(points, room) < 0)
        seen = surface[tuple((points[inside] / (SQUARE * self.pixel)).astype(int).T)]
        inside[inside] = np.isinf(seen) | (np.abs(seen - height) <= level_range(accuracy))
        return holes_in(inside)

    def is_within(self, room: Room, margin: float) -> np.ndarray:
        """Return a mask of the pixels that show something inside the room, at least ``margin`` from its walls, bool."""
        return distance_outside(self.points, room) < -margin


def holes_in(unknown: np.ndarray) -> np.ndarray:
    """Return a mask of the unknown pixels that belong to a hole, bool ``[rows, columns]``."""
    holes = np.zeros_like(unknown)
    for part in ndimage.find_objects(unknown.astype(np.uint8)):  # most images have few unknown pixels, or none
        holes[part] = ndimage.binary_opening(unknown[part], HOLE)
    return holes


def distance_outside(points: np.ndarray, room: Room) -> np.ndarray:
    """Return the distance of points ``[..., 2]`` beyond the nearest wall, m; below 0 inside."""
    x, y = points[..., 0], points[..., 1]
    return np.maximum(np.maximum(-x, x - room.sides[0]), np.maximum(-y, y - room.sides[1]))


def read_heights(
    rays: np.ndarray, origin: np.ndarray, depth: np.ndarray, room: Room, pixel: float, accuracy: float,
    record: Sequence[Box] = (),
) -> Heights:  # fmt: skip
    """Return the heights in the part of an image that shows a room.

    Args:
        rays: of every pixel, see :meth:`Camera.rays`.
        origin: of the rays, the camera's position.
        depth: distances along the optical axis, NaN if unknown, ``[rows, columns]``; m.
        room: the bin or the tote.
        pixel: side of a pixel's square on the floor, m.
        accuracy: greatest error of a height, m.
        record: boxes that are known to stand in the room; they explain the holes whose rays meet one.

    Raises:
        DepthMapError: if the image does not show the whole room, or lacks too many pixels.
    """
    rows, columns = _window(rays, origin, room)
    rays = rays[rows, columns]
    raw = depth[rows, columns] * rays[..., 2] + origin[2]
    known, recorded = ~np.isnan(raw), np.full_like(raw, np.nan)
    if record and (lost := holes_in(~known)).any():  # holes only, as an item may be off its recorded place
        recorded[lost] = np.fmax.reduce([_entered(rays[lost], origin, box, accuracy) for box in record])
    is_recorded = ~np.isnan(recorded)
    # Unknown pixels must not shift the median: there each has the height of the nearest known one.
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    smooth = median_of_nine(raw[tuple(nearest)])
    height = np.where(is_recorded, recorded, np.where(known, smooth, np.nan))
    unknown = np.isnan(height)
    holes = holes_in(unknown)
    gaps = unknown & ~holes
    high = _greatest_beside(np.where(unknown, -np.inf, height), gaps)
    low = -_greatest_beside(np.where(unknown, -np.inf, np.where(is_recorded, 0.0, -height)), gaps)
    level = gaps & (high - low <= level_range(accuracy))
    seen = Heights(origin, rays, (rows.start, columns.start), pixel, raw, height, height, height, holes)
    shown = distance_outside(seen.points_at_height(0.0), room) < 0
    missing = (level & shown).sum() / max(1, ((level | known) & shown).sum())
    refuse_if(
        missing > MAX_MISSING_SHARE,
        f"depth: {missing:.0%} of the pixels on level surfaces in the {room.name} have no depth, expected "
        f"{MAX_MISSING_SHARE:.0%} at most: take another image.",
        DepthMapError,
    )
    single = level & _is_short(gaps)
    height = np.where(single, smooth, height)
    highest, lowest = (np.where(gaps & ~single, bound, height) for bound in (high, low))
    return replace(seen, height=height, highest=highest, lowest=np.where(is_recorded, 0.0, lowest))


def level_range(accuracy: float) -> float:
    """Return the greatest difference of heights between neighbouring pixels on a level top, m."""
    return max(3 * accuracy, 0.005)


def _window(rays: np.ndarray, origin: np.ndarray, room: Room) -> tuple[slice, slice]:
    """Return the rows and columns that show a room and a border around it."""
    shown = np.zeros(rays.shape[:2], dtype=bool)
    for height in (0.0, min(room.rim, 0.9 * origin[2])):
        way = (height - origin[2]) / rays[..., 2]
        x, y = (origin[axis] + rays[..., axis] * way for axis in (0, 1))
        shown |= (x > 0) & (x < room.sides[0]) & (y > 0) & (y < room.sides[1])
    border = np.concatenate([shown[0], shown[-1], shown[:, 0], shown[:, -1]])
    refuse_if(
        border.any() or not shown.any(),
        f"depth: the image shows {'a part' if shown.any() else 'nothing'} of the {room.name}, expected the whole "
        f"{room.name} in the image, up to its rim: check the camera's pose and its focal lengths.",
        DepthMapError,
    )
    rows, columns = ndimage.find_objects(shown.astype(np.uint8))[0]
    return (
        slice(max(0, rows.start - MARGIN), rows.stop + MARGIN),
        slice(max(0, columns.start - MARGIN), columns.stop + MARGIN),
    )


def _entered(rays: np.ndarray, origin: np.ndarray, box: Box, accuracy: float) -> np.ndarray:
    """Return the height at which each ray enters a box, widened by the error of its place; NaN if it misses it."""
    angle = math.radians(box.yaw)
    cos, sin = math.cos(angle), math.sin(angle)
    axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    half = np.array([box.w / 2 + RECORD_MARGIN, box.d / 2 + RECORD_MARGIN, (box.h + accuracy) / 2])
    start, way = axes @ (origin - (box.x, box.y, half[2])), rays @ axes.T
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(-half - start) / way, (half - start) / way])
    enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
    return np.where(enter < leave, origin[2] + enter * rays[..., 2], np.nan)


def median_of_nine(image: np.ndarray) -> np.ndarray:
    """Return the median of the 3x3 pixels around each pixel of an image without NaN, faster than SciPy's filter.

    It is the median of three numbers: the greatest of the columns' least values, the median of their medians, and the
    least of their greatest values.
    """

    def least(a, b, c):
        return np.minimum(np.minimum(a, b), c)

    def median(a, b, c):
        return np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))

    def greatest(a, b, c):
        return np.maximum(np.maximum(a, b), c)

    padded = np.pad(image, 1, mode="edge")
    parts = []
    for of_column, of_row in ((least, greatest), (median, median), (greatest, least)):
        column = of_column(padded[:-2], padded[1:-1], padded[2:])
        parts.append(of_row(column[:, :-2], column[:, 1:-1], column[:, 2:]))
    return median(*parts)


def _greatest_beside(heights: np.ndarray, gaps: np.ndarray) -> np.ndarray:
    """Return the greatest height beside each pixel of a gap of up to three pixels, or on the other side of the gap.

    Args:
        heights: -inf if unknown.
    """
    near = ndimage.maximum_filter(heights, 3)
    return np.maximum(near, ndimage.maximum_filter(np.where(gaps, near, -np.inf), 3))


def _is_short(gaps: np.ndarray) -> np.ndarray:
    """Return a mask of the single gaps: at most :data:`SEAM` pixels long, so they do not part two items; bool."""
    numbers, _ = ndimage.label(gaps, EIGHT_NEIGHBOURS)
    short = [False, *(max(side.stop - side.start for side in part) <= SEAM for part in ndimage.find_objects(numbers))]
    return np.array(short)[numbers]
