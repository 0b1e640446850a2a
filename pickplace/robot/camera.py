"""Turn depth images into the inputs of the planner: the heights in a tote, and the items in a bin.

A depth image ``[rows, columns]`` holds distances along the optical axis, in metres; 0 or NaN where nothing is known. In
the camera's frame x points to the right of the image, y down and z forward. Single wrong values are removed by a
median of 3x3 pixels. Obstacles are widened by a pixel; surfaces that may support an item are narrowed by one. Unknown
space counts as occupied, by the worst that may be there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pickplace.common.validate import excerpt, is_number, refuse_if
from pickplace.robot.bin_image import as_sizes, find_boxes
from pickplace.robot.box import ACCURACY, Box, DepthMapError
from pickplace.robot.depth_image import Heights, Room, read_heights
from pickplace.robot.measure import MAX_PATCHES, ToteMap
from pickplace.robot.room_check import check_room
from pickplace.robot.tote_image import read_tote
from pickplace.rules.cell import CellSpec

MIN_PIXELS = 2  # fewest pixels along a cell


@dataclass(frozen=True)
class Camera:
    """A pinhole camera above a bin or a tote.

    Args:
        fx, fy: focal lengths; pixels.
        cx, cy: point where the optical axis meets the image; pixels, from the centre of the first pixel.
        pose: transform ``[4, 4]`` from the camera's frame to the frame of the bin or the tote. Its last column is the
            camera's position, in metres.
        shape: of its images, ``(rows, columns)``.

    Raises:
        ValueError: for a focal length that is not above 0, a pose that is no rotation and translation, or a shape that
            is no number of rows and columns.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    pose: np.ndarray
    shape: Sequence[int]

    def __post_init__(self):
        for key, expected in (("fx", " above 0"), ("fy", " above 0"), ("cx", ""), ("cy", "")):
            value = getattr(self, key)
            good = is_number(value) and (value > 0 or not expected)
            refuse_if(not good, f"camera.{key}={excerpt(value)}: expected a number of pixels{expected}.")
        try:
            pose = np.asarray(self.pose, dtype=np.float64)
        except (TypeError, ValueError):
            pose = np.empty(0)  # which is refused below
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
        shape = np.asarray(self.shape)
        refuse_if(
            shape.shape != (2,) or shape.dtype.kind not in "iu" or min(shape) < 3,
            f"camera.shape={self.shape}: expected (rows, columns) of its images, each at least 3.",
        )
        object.__setattr__(self, "shape", tuple(shape.tolist()))

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
        return cls(focal, focal, (shape[1] - 1) / 2, (shape[0] - 1) / 2, pose, shape)

    def points(self, depth) -> np.ndarray:
        """Return the position of every pixel in the frame of the bin or tote, ``[rows, columns, 3]``; NaN if unknown.

        Raises:
            DepthMapError: if ``depth`` is no image, has another shape than :attr:`shape`, or is not in metres.
        """
        return self.rays() * self._distances(depth)[..., None] + self.pose[:3, 3]

    def rays(self) -> np.ndarray:
        """Return the ray of every pixel, one metre long along the optical axis, ``[rows, columns, 3]``."""
        row, column = np.indices(self.shape)
        return (
            np.stack([(column - self.cx) / self.fx, (row - self.cy) / self.fy, np.ones(self.shape)], -1)
            @ self.pose[:3, :3].T
        )

    def pixel(self, height: float = 0.0) -> float:
        """Return the length that a pixel shows of a level surface at a height, where the optical axis meets it, m."""
        return float((self.pose[2, 3] - height) / min(self.fx, self.fy) / self.pose[2, 2] ** 2)

    def tote_map(
        self, depth, cell: CellSpec, cell_size: float, tote_height: float | None = None, accuracy: float = ACCURACY,
        placed: Sequence[Box] = (),
    ) -> ToteMap:  # fmt: skip
        """Return the heights in the tote, for a :class:`~pickplace.robot.scene.Scene`.

        A place hidden by a higher one counts as equally high. A place that pixels without depth may show counts up to
        the rim, unless an item placed before explains these pixels. Both support nothing.

        Args:
            depth: an image.
            cell: the sizes.
            cell_size: side of a cell, m.
            tote_height: of the rim, m; None: from ``cell.tote_size``.
            accuracy: greatest error of a height, m.
            placed: the items that this planner put into the tote before: :attr:`Plan.placed` of each plan that was
                carried out.

        Raises:
            DepthMapError: for an image that shows too little of the tote, or a floor that is not where the camera's
                pose says.
        """
        rim = cell.tote_size[2] * cell.height_unit * cell_size if tote_height is None else tote_height
        pixel = self.pixel()
        refuse_if(
            pixel * MIN_PIXELS > cell_size,
            f"depth: a cell is {cell_size / pixel:.1f} pixels wide, expected at least {MIN_PIXELS}.",
            DepthMapError,
        )
        room = self._room("tote", cell.tote_size, cell_size, rim)
        seen = self._look(depth, room, accuracy, placed)
        along = min(MAX_PATCHES, int(cell_size / (MIN_PIXELS * pixel)))
        return read_tote(seen, room, self._wall(), accuracy, cell.tote_size[:2], along)

    def items(
        self, depth, cell: CellSpec, cell_size: float, labels=None, accuracy: float = ACCURACY, sizes=None,
        greatest_height: float | None = None, bin_height: float | None = None,
    ) -> list[Box]:  # fmt: skip
        """Return the items in the bin, for a :class:`~pickplace.robot.scene.Scene`.

        An item that a higher one hides in part is a :class:`~pickplace.robot.box.HiddenBox` of its greatest possible
        size; the planner takes others first. A wholly hidden item is not noticed. A place that pixels without depth
        may show is a :class:`~pickplace.robot.box.UnknownBox` of the greatest possible size and height.

        Args:
            depth: an image.
            cell: the sizes.
            cell_size: side of a cell, m.
            labels: an image of whole numbers: 0 for the background, another number for each item; None: steps of the
                depth tell items apart.
            accuracy: greatest error of a height, m.
            sizes: the sizes of the items, ``(w, d, h)`` in metres; None: not known. Two items that touch and are
                equally high look like one in a depth image; their sizes reveal it.
            greatest_height: of an item, m; None: from ``cell.tote_size``, as a higher item fits into no tote.
            bin_height: of the bin's walls, m; None: from ``cell.bin_size``.

        Raises:
            ValueError: for sizes that are no lengths.
            DepthMapError: for an image that does not show the bin, a floor that is not where the camera's pose says,
                something that is not one item, or if no item is seen well enough.
        """
        rim = cell.bin_size[2] * cell.height_unit * cell_size if bin_height is None else bin_height
        room = self._room("bin", cell.bin_size, cell_size, rim)
        if labels is not None:
            labels = np.asarray(labels)
            refuse_if(
                labels.shape != self.shape or labels.dtype.kind not in "iu",
                f"labels: got shape {list(labels.shape)} of {labels.dtype}, expected whole numbers, "
                f"{list(self.shape)} as of depth.",
                DepthMapError,
            )
        if sizes is not None:
            sizes = as_sizes(sizes)
        seen = self._look(depth, room, accuracy)
        if labels is not None:
            row, column = seen.corner
            labels = labels[row : row + seen.raw.shape[0], column : column + seen.raw.shape[1]]
        greatest = cell.tote_size[2] * cell.height_unit * cell_size if greatest_height is None else greatest_height
        return find_boxes(seen, room, self._wall(), accuracy, greatest, labels, sizes)

    def _room(self, name: str, size: Sequence[int], cell_size: float, rim: float) -> Room:
        """Return the room between the walls of a bin or a tote."""
        return Room(name, (size[0] * cell_size, size[1] * cell_size), rim)

    def _look(self, depth, room: Room, accuracy: float, placed: Sequence[Box] = ()) -> Heights:
        """Return the heights that an image shows in a room; refuse an image that does not show the room."""
        distances, origin = self._distances(depth), self.pose[:3, 3]
        seen = read_heights(self.rays(), origin, distances, room, self.pixel(), accuracy, placed)
        within = seen.is_within(room, self._wall())
        refuse_if(
            not within.any(),
            f"depth: no pixel shows the inside of the {room.name}, expected most of them to: check the camera's pose, "
            "which is relative to the floor, and the unit of the image.",
            DepthMapError,
        )
        middle = float(np.median(seen.height[within]))
        refuse_if(
            not -0.05 < middle < room.rim + 0.5,
            f"depth: the {room.name} is seen at a height of {middle:.3f} m, expected 0 to {room.rim:g} m: check the "
            "camera's pose, which is relative to the floor, and the unit of the image.",
            DepthMapError,
        )
        check_room(seen, room, accuracy, self._wall())
        return seen

    def _distances(self, depth) -> np.ndarray:
        """Check an image, and return it as float64, NaN where nothing is known."""
        image = np.asarray(depth.filled(0) if isinstance(depth, np.ma.MaskedArray) else depth)
        refuse_if(
            image.ndim != 2 or image.dtype.kind not in "fiu",
            f"depth: got shape {list(image.shape)} of {image.dtype}, expected an image of distances, [rows, columns].",
            DepthMapError,
        )
        refuse_if(
            image.shape != self.shape,
            f"depth: got shape {list(image.shape)}, expected {list(self.shape)}, the camera's rows and columns"
            f"{'; the image is transposed' if image.shape == self.shape[::-1] else ''}.",
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
        return image

    def _wall(self) -> float:
        """Return the width of the border along the walls, m; a point in it may belong to a wall."""
        return max(2 * self.pixel(), 0.004)
