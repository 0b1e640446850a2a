"""An episode that a physics engine carried out: its end, and the poses of the bodies, picture by picture."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

INTERVAL = 0.05  # time between two pictures, s
STILL = np.repeat((1e-4, 1e-3), (3, 4))  # change below which a body has not moved: position, m, and quaternion


@dataclass
class Motion:
    """Recorded poses.

    A pose is a picture's number, a position in m, and a quaternion ``(w, x, y, z)``. Poses of pictures in which a body
    has not moved are left out.

    Attributes:
        bin: near corner of the bin, ``[2]``, m; None without a gantry.
        pictures: number of pictures, at most :data:`INTERVAL` apart.
        plate: poses of the end effector: of the middle of its lower face.
        boxes: poses of each box: of its middle. First the boxes that were carried, in that order.
        left: sides of the other ones, which stayed in the bin, m.
        ends: number of pictures when each placement had ended.
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
            plate: those of the end effector, ``[7]``, if there is one.
        """
        self.boxes += [[] for _ in range(len(boxes) - len(self.boxes))]
        bodies = list(zip(self.boxes, boxes, strict=True))
        for poses, pose in bodies if plate is None else [*bodies, (self.plate, plate)]:
            if not poses or (np.abs(pose - poses[-1][1:]) > STILL).any():
                poses.append((self.pictures, *pose.tolist()))
        self.pictures += 1


@dataclass(frozen=True)
class Outcome:
    """The end of an episode that a physics engine carried out."""

    episode: int
    ending: str  # "done", or the reason of the first loss
    lost: int | None  # number of the lost item, from 0
    during: int | None  # number of the placement during which it was lost; the number of placements: at the end
    placed: int  # items placed before the loss
    occupancy: float  # share of the tote that they fill
    drift: float = 0.0  # greatest distance of a placed item that was not lost from its planned pose, m
    cpu_seconds: float = 0.0
    sentence: str = ""  # the ending for the reader of a replay
    label: str = ""  # the same in a word or two
    motion: Motion | None = field(default=None, repr=False)  # of an episode that was to be recorded

    def facts(self) -> dict[str, Any]:
        """Return the figures, as ``pickplace-physics`` prints them."""
        return {key: value for key, value in vars(self).items() if key not in ("sentence", "label", "motion")}
