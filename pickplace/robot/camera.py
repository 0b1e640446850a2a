"""From depth images to what the planner takes: the heights in a tote, and the items in a bin.

A depth image ``[rows, columns]`` holds distances along the optical axis, in metres; 0 or NaN where nothing is known. In
the camera's frame x points to the right of the image, y down and z forward. Single wrong values are removed by a
median of 3x3 pixels. What must not be hit is widened by a pixel, what may support an item is narrowed by one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy import ndimage

from pickplace.common.validate import refuse_if
from pickplace.robot.box import ACCURACY, Box, DepthMapError, HiddenBox
from pickplace.robot.measure import MAX_PATCHES, SNAPPED, ToteMap, is_inside, smallest_rectangle, turned_axes
from pickplace.rules.cell import CellSpec

#: Greatest share of a tote that the camera may not see.
MOST_UNSEEN = 0.25
MOST_MISSING = 0.01  # greatest share of the inside of its rectangle that an item's top leaves free
BORDER = 2.5  # width of the part of the rectangle that is not its inside, pixels
#: Fewest pixels along a cell.
LEAST_PIXELS = 2
HIDDEN_PIXELS = 1.5  # distance from a box at which its edge should be seen, pixels
EDGE_POINTS = 32  # along each side of a box, and along each ray
MIN_ITEM_PIXELS = 9  # pixels of the smallest thing in a bin that counts


@dataclass(frozen=True)
class Camera:
    """A pinhole camera above a bin or a tote.

    Args:
        fx, fy: focal lengths; pixels.
        cx, cy: where the optical axis meets the image; pixels, from the centre of the first one.
        pose: ``[4, 4]``, from the camera's frame to that of the bin or the tote: its last column is the camera's
            position, in metres.

    Raises:
        ValueError: for a focal length that is not above 0, or a pose that is no rotation and translation.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    pose: np.ndarray

    def __post_init__(self):
        for key in ("fx", "fy"):
            refuse_if(
                not 0 < getattr(self, key) < math.inf,
                f"camera.{key}={getattr(self, key)}: expected a number of pixels above 0.",
            )
        pose = np.asarray(self.pose, dtype=np.float64)
        object.__setattr__(self, "pose", pose)
        good = pose.shape == (4, 4) and np.isfinite(pose).all() and np.allclose(pose[3], (0, 0, 0, 1))
        turn = pose[:3, :3] if good else np.zeros((3, 3))
        refuse_if(
            not np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) or np.linalg.det(turn) < 0,
            "camera.pose: expected [4, 4]: a rotation, a position in metres, and the row 0 0 0 1.",
        )
        refuse_if(
            turn[2, 2] > -0.5,
            "camera.pose: the camera does not look down: its z axis, the optical axis, should point to -z of the "
            "bin or tote; expected the pose of the camera in that frame, not the inverse.",
        )

    @classmethod
    def looking_down(cls, centre: Sequence[float], height: float, focal: float, shape: Sequence[int]) -> "Camera":
        """Return a camera that looks straight down; its image's right is +x, and its top is +y.

        Args:
            centre: position above the bin or tote, ``(x, y)``; m.
            height: above its floor; m.
            focal: both focal lengths; pixels.
            shape: of its images, ``(rows, columns)``.
        """
        pose = np.diag((1.0, -1.0, -1.0, 1.0))
        pose[:3, 3] = (*centre, height)
        return cls(focal, focal, (shape[1] - 1) / 2, (shape[0] - 1) / 2, pose)

    def points(self, depth) -> np.ndarray:
        """Return the position of every pixel in the frame of the bin or tote, ``[rows, columns, 3]``; NaN if unknown.

        Raises:
            DepthMapError: for an image that is none, or not in metres.
        """
        image = np.asarray(depth)
        refuse_if(
            image.ndim != 2 or min(image.shape) < 3 or image.dtype.kind not in "fiu",
            f"depth: got shape {list(image.shape)} of {image.dtype}, expected an image of distances, [rows, columns].",
            DepthMapError,
        )
        image = np.where((image > 0) & np.isfinite(image), image, np.nan).astype(np.float64)
        refuse_if(
            np.isnan(image).all(),
            "depth: got no distance above 0; expected metres, and 0 or NaN where nothing is known.",
            DepthMapError,
        )
        far = np.nanmedian(image)
        refuse_if(
            far > 20, f"depth: got distances of {far:g}, expected metres; divide millimetres by 1000.", DepthMapError
        )
        return self.rays(image.shape) * image[..., None] + self.pose[:3, 3]

    def rays(self, shape: Sequence[int]) -> np.ndarray:
        """Return the way along every pixel's ray that goes one metre along the optical axis, ``[rows, columns, 3]``."""
        row, column = np.indices(shape)
        return (
            np.stack([(column - self.cx) / self.fx, (row - self.cy) / self.fy, np.ones(shape)], -1)
            @ self.pose[:3, :3].T
        )

    def pixel(self, height: float = 0.0) -> float:
        """Return the side of a pixel's square at a height above the floor, in metres."""
        return (self.pose[2, 3] - height) / min(self.fx, self.fy)

    def tote_map(self, depth, cell: CellSpec, cell_size: float, tote_height: float | None = None) -> ToteMap:
        """Return the heights in the tote, for a :class:`~pickplace.robot.scene.Scene`.

        Where the camera sees nothing there may be as much as beside it, and it supports nothing.

        Args:
            depth: an image.
            cell: the sizes.
            cell_size: side of a cell, m.
            tote_height: of the rim, m; None: that of ``cell.tote_size``.

        Raises:
            DepthMapError: for an image that does not show the tote, or too little of it.
        """
        rim = cell.tote_size[2] * cell.height_unit * cell_size if tote_height is None else tote_height
        pixel = self.pixel()
        refuse_if(
            pixel * LEAST_PIXELS > cell_size,
            f"depth: a cell is {cell_size / pixel:.1f} pixels wide, expected at least {LEAST_PIXELS}.",
            DepthMapError,
        )
        points = self._inside(depth, cell.tote_size, cell_size, rim, "tote")
        along = min(MAX_PATCHES, int(cell_size / (LEAST_PIXELS * pixel)))
        shape = [side * along for side in cell.tote_size[:2]]
        known = ~np.isnan(points[..., 2])
        high = ndimage.maximum_filter(np.where(known, points[..., 2], -np.inf), 3)
        low = ndimage.minimum_filter(np.where(known, points[..., 2], np.inf), 3)
        patch = (points[known][:, :2] * along / cell_size).astype(int).clip(0, np.array(shape) - 1)
        highest, lowest = np.full(shape, -np.inf), np.full(shape, np.inf)
        np.maximum.at(highest, tuple(patch.T), high[known])
        np.minimum.at(lowest, tuple(patch.T), low[known])
        unseen = np.isinf(highest)
        refuse_if(
            unseen.mean() > MOST_UNSEEN,
            f"depth: {unseen.mean():.0%} of the tote are not seen, expected {MOST_UNSEEN:.0%} at most.",
            DepthMapError,
        )
        # At the walls the nearest place that is seen; there the camera sees the wall, not what is beside it.
        border = np.ones(shape, dtype=bool)
        edge = math.ceil(self._wall() * along / cell_size)
        border[edge:-edge, edge:-edge] = False
        holes, count = ndimage.label(unseen & ~border, np.ones((3, 3)))
        for hole in (holes == number for number in range(1, count + 1)):
            around = ndimage.binary_dilation(hole, np.ones((3, 3))) & ~unseen
            highest[hole], lowest[hole] = highest[around].max(initial=rim if not around.any() else 0.0), 0.0
        at_wall = np.isinf(highest)
        nearest = ndimage.distance_transform_edt(at_wall, return_distances=False, return_indices=True)
        highest, lowest = highest[tuple(nearest)], np.where(at_wall, 0.0, lowest)
        return ToteMap(highest.clip(0, None), lowest.clip(0, None))

    def items(
        self, depth, cell: CellSpec, cell_size: float, labels=None, accuracy: float = ACCURACY, sizes=None
    ) -> list[Box]:
        """Return the items in the bin, for a :class:`~pickplace.robot.scene.Scene`.

        What a higher item hides in part is a :class:`~pickplace.robot.measure.HiddenBox`, as large as it may be: the
        planner takes others first. An item that is wholly hidden is not known of.

        Args:
            depth: an image.
            cell: the sizes.
            cell_size: side of a cell, m.
            labels: an image of whole numbers, 0 for the background, another one for each item; None: items are told
                apart by steps of the depth.
            accuracy: greatest error of a height, m.
            sizes: known sizes of items, ``(w, d, h)`` in metres, if they are known. Two items that touch and are
                equally high look like one to a depth image; with their sizes this is noticed.

        Raises:
            DepthMapError: for an image that does not show the bin, or something that could be two items.
        """
        rim = cell.bin_size[2] * cell.height_unit * cell_size
        points = self._inside(depth, cell.bin_size, cell_size, rim, "bin")
        height = np.nan_to_num(points[..., 2], nan=0.0)
        above = height > max(3 * accuracy, 0.005)
        if labels is None:
            steps = ndimage.maximum_filter(height, 3) - ndimage.minimum_filter(height, 3)
            segments, _ = ndimage.label(above & (steps < 4 * accuracy + self.pixel()))
        else:
            labels = np.asarray(labels)
            refuse_if(
                labels.shape != above.shape or labels.dtype.kind not in "iu",
                f"labels: got shape {list(labels.shape)} of {labels.dtype}, expected whole numbers, "
                f"{list(above.shape)} as of depth.",
                DepthMapError,
            )
            segments = np.where(above & (labels > 0), labels, 0)
            known = ndimage.binary_dilation(labels > 0, np.ones((3, 3)), iterations=2)
            if (left := above & ~known & ~np.isnan(points[..., 2])).sum() >= MIN_ITEM_PIXELS:
                row, column = np.argwhere(left)[0].tolist()
                raise DepthMapError(
                    f"labels[{row}, {column}]: got 0, but something {height[row, column]:.3f} m high lies there; "
                    "expected a label for each item."
                )
        numbers, counts = np.unique(segments[segments > 0], return_counts=True)
        boxes = [
            self._box(points, segments == number, narrowed=labels is None)
            for number in numbers[counts >= MIN_ITEM_PIXELS]
        ]
        hidden = [self._hidden_length(box, boxes) for box in boxes]
        for box, length in zip(boxes, hidden, strict=True):
            if sizes is not None and not length:
                _check_reading(box, sizes, 2 * self.pixel() + 2 * accuracy)
        return [
            HiddenBox(box.x, box.y, box.w + 2 * length, box.d + 2 * length, box.h, box.yaw) if length else box
            for box, length in zip(boxes, hidden, strict=True)
        ]

    def _inside(self, depth, size: Sequence[int], cell_size: float, rim: float, name: str) -> np.ndarray:
        """Return the points between the walls, median-filtered, NaN elsewhere, ``[rows, columns, 3]``."""
        points, wall, sides = self.points(depth), self._wall(), [side * cell_size for side in size[:2]]
        unknown = np.isnan(points[..., 2])
        filled = np.where(unknown, np.nanmax(points[..., 2]), points[..., 2])
        points[..., 2] = np.where(unknown, np.nan, ndimage.median_filter(filled, 3, mode="nearest"))
        within = np.all((points[..., :2] > wall) & (points[..., :2] < np.subtract(sides, wall)), axis=-1)
        refuse_if(
            within.sum() < 0.5 * (sides[0] / self.pixel()) * (sides[1] / self.pixel()) * (1 - MOST_UNSEEN),
            f"depth: {within.sum()} pixels lie inside the {name}, which is too few; expected the whole {name} in "
            "the image: check the camera's pose, its focal lengths, and the unit of the image.",
            DepthMapError,
        )
        middle = float(np.median(points[within][:, 2]))
        refuse_if(
            not -0.05 < middle < rim + 0.5,
            f"depth: the {name} is seen at a height of {middle:.3f} m, expected 0 to {rim:g} m: check the camera's "
            "pose, which is relative to the floor, and the unit of the image.",
            DepthMapError,
        )
        return np.where(within[..., None], points, np.nan)

    def _wall(self) -> float:
        """Return the distance from a wall up to which a point may be one of the wall, not of the contents; m."""
        return max(2 * self.pixel(), 0.004)

    def _box(self, points: np.ndarray, segment: np.ndarray, narrowed: bool) -> Box:
        """Return the cuboid whose top fills a segment, bool ``[rows, columns]``."""
        height = float(np.quantile(points[segment][:, 2], 0.95))
        pixel = self.pixel(height)
        x, y, w, d, yaw = smallest_rectangle(points[segment][:, :2])
        # Every pixel that shows a place well inside the rectangle must show the top.
        border = BORDER * pixel + SNAPPED * max(w, d) * (yaw == 0)
        rays = self.rays(segment.shape)
        # The place where the ray of every pixel passes the height, [rows, columns, 2].
        at_height = self.pose[:2, 3] + rays[..., :2] * ((height - self.pose[2, 3]) / rays[..., 2])[..., None]
        inside = is_inside(at_height, (x, y), (w - 2 * border, d - 2 * border), yaw)
        grown = (3 if narrowed else 1) * pixel  # what the steps' filter took off, and half a pixel on each side
        if inside.any() and (missing := 1 - segment[inside].mean()) > MOST_MISSING:
            raise DepthMapError(
                f"depth: what lies at [{x:.3f}, {y:.3f}] leaves {missing:.0%} of its rectangle of {w + grown:.3f} x "
                f"{d + grown:.3f} m free: it could be two items that touch, or one that is no cuboid; separate them, "
                "or pass labels."
            )
        return Box(x, y, float(w + grown), float(d + grown), height, yaw).upright()

    def _hidden_length(self, box: Box, boxes: Sequence[Box]) -> float:
        """Return how far a box may go on where higher ones hide what is beside it, m; 0 if its whole edge is seen."""
        side, grown = np.linspace(-1, 1, EDGE_POINTS), HIDDEN_PIXELS * self.pixel(box.h)
        one = np.ones_like(side)
        edge = np.concatenate([[side, one], [side, -one], [one, side], [-one, side]], 1).T
        edge = edge * (box.w / 2 + grown, box.d / 2 + grown) @ turned_axes(math.radians(box.yaw)) + (box.x, box.y)
        to_camera, longest = self.pose[:2, 3] - edge, 0.0
        for other in (each for each in boxes if each.h > box.h):
            share = (other.h - box.h) / (self.pose[2, 3] - box.h)  # of the ray that runs below the other's top
            ray = edge + np.linspace(0, share, EDGE_POINTS)[:, None, None] * to_camera
            inside = is_inside(ray, (other.x, other.y), (other.w, other.d), other.yaw)
            hidden = to_camera[inside.any(0) & ~inside[0]]  # what lies in the other is no part of the box
            longest = max(longest, float((share * np.linalg.norm(hidden, axis=1)).max(initial=0.0)))
        return longest if longest > self.pixel(box.h) / 2 else 0.0


def _check_reading(box: Box, sizes, tolerance: float) -> None:
    """Refuse a box that could be two items of known sizes, or is none; both readings are named."""
    tall = [(w, d) for a, b, h in sizes for w, d in {(a, b), (b, a)} if abs(box.h - h) <= tolerance]

    def is_like(w: float, d: float) -> bool:
        return abs(box.w - w) <= tolerance and abs(box.d - d) <= tolerance

    one = [(w, d) for w, d in tall if is_like(w, d)]
    two = [
        (a, b)
        for a, b in combinations_with_replacement(tall, 2)
        if (is_like(a[0] + b[0], a[1]) and a[1] == b[1]) or (is_like(a[0], a[1] + b[1]) and a[0] == b[0])
    ]
    found = f"depth: what lies at [{box.x:.3f}, {box.y:.3f}], {box.w:.3f} x {box.d:.3f} x {box.h:.3f} m,"
    if two:
        pair = " and ".join(f"{w:g} x {d:g}" for w, d in two[0])
        single = f"one item of {one[0][0]:g} x {one[0][1]:g} m or " if one else ""
        raise DepthMapError(f"{found} is {single}two of {pair} m that touch; separate them, or pass labels.")
    refuse_if(not one, f"{found} is no item of the given sizes.", DepthMapError)
