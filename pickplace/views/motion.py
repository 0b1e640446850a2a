"""The end of an episode that a physics engine carried out, and the poses of the bodies, picture by picture."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

INTERVAL = 0.05  # time between two pictures, s
POSE_TOLERANCE = np.repeat((1e-4, 1e-3), (3, 4))  # change below which a body has not moved: position, m, and quaternion


@dataclass
class Motion:
    """Recorded poses.

    A pose is a picture's number, a position in m, and a quaternion ``(w, x, y, z)``. A body has no pose for a picture
    in which it has not moved.

    Attributes:
        bin: near corner of the bin, ``[2]``, m; None without a gantry.
        pictures: number of pictures, at most :data:`INTERVAL` apart.
        plate: poses of the middle of the end effector's lower face.
        boxes: poses of the middle of each box: first the boxes that were carried, in order, then those left in the bin.
        left: sides of the boxes that stayed in the bin, m.
        ends: number of pictures at the end of each placement.
    """

    bin: tuple[float, float] | None = None
    pictures: int = 0
    plate: list[tuple[float, ...]] = field(default_factory=list)
    boxes: list[list[tuple[float, ...]]] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    left: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, boxes: np.ndarray, plate: np.ndarray | None) -> None:
        """Add a picture.

        Args:
            boxes: position and quaternion of every box, ``[n, 7]``.
            plate: position and quaternion of the end effector, ``[7]``; None without one.
        """
        self.boxes += [[] for _ in range(len(boxes) - len(self.boxes))]
        bodies = list(zip(self.boxes, boxes, strict=True))
        for poses, pose in bodies if plate is None else [*bodies, (self.plate, plate)]:
            if not poses or (np.abs(pose - poses[-1][1:]) > POSE_TOLERANCE).any():
                poses.append((self.pictures, *pose.tolist()))
        self.pictures += 1


@dataclass(frozen=True)
class Outcome:
    """The end of an episode that a physics engine carried out."""

    episode: int
    ending: str  # "done", or the reason of the first loss
    lost: int | None  # number of the lost item, from 0
    during: int | None  # number of the placement during which it was lost; after the last: the number of placements
    placed: int  # number of items placed before the loss
    occupancy: float  # share of the tote that they fill
    drift: float = 0.0  # greatest distance of a placed item, other than the lost one, from its planned place, m
    cpu_seconds: float = 0.0
    sentence: str = ""  # the ending for the reader of a replay
    label: str = ""  # the same in a word or two
    motion: Motion | None = field(default=None, repr=False)  # None if the episode was not recorded

    def facts(self) -> dict[str, Any]:
        """Return the values that ``pickplace-physics`` prints."""
        return {key: value for key, value in vars(self).items() if key not in ("sentence", "label", "motion")}
