"""A robot for robot_loop.py, in MuJoCo. Base, bin and tote have frames that are not parallel: as in a real cell."""

import math
from collections.abc import Collection, Sequence

import numpy as np
from simulated_cell import SimulatedCell

from pickplace import Camera, Planner
from pickplace.physics.simulation import wait


def frame(yaw: float, x: float, y: float, z: float = 0.0) -> np.ndarray:
    """Return a frame that is turned about z, ``[4, 4]``; degrees and metres."""
    cos, sin = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    return np.array([(cos, -sin, 0, x), (sin, cos, 0, y), (0, 0, 1, z), (0, 0, 0, 1)])


class SimulatedRobot:
    """The gantry of a :class:`SimulatedCell`, commanded in the frame of a base that stands beside it.

    Args:
        planner: has the sizes.
        items: those that arrive, one at a time: size ``(w, d, h)``, centre ``(x, y)`` and yaw in the simulated bin.
        base_from_tote: ``[4, 4]``.
        bin_turns: quarter turns of the bin's frame against the tote's.
        missed, lost: numbers of the grips, from 0, that hold nothing, or lose the item on the way.
    """

    def __init__(
        self, planner: Planner, items: Sequence[tuple], base_from_tote: np.ndarray, bin_turns: int = 1,
        missed: Collection[int] = (), lost: Collection[int] = (),
    ):  # fmt: skip
        self.planner, self.arriving, self.in_bin = planner, [*items], None
        self.missed, self.lost, self.grips, self.asked = missed, lost, 0, 0
        self.cells, self.calls = [SimulatedCell(planner)], []
        (wide, deep, wall), tote = self.cell.bin, self.cell.tote
        corner = [(0, 0), (wide, 0), (wide, deep), (0, deep)][bin_turns % 4]
        self.base_from_tote = base_from_tote
        self.base_from_bin = base_from_tote @ frame(90 * bin_turns, *(self.cell.gantry.bin + corner))
        self.highest = base_from_tote[2, 3] + max(wall, tote[2])  # of both rims and of what lies in the bin

    @property
    def cell(self) -> SimulatedCell:
        """The cell with the tote that is being filled."""
        return self.cells[-1]

    def look(self) -> list[tuple[Camera, np.ndarray]]:
        """Return the camera above the bin and the one above the tote, each with its depth image."""
        if self.cell.gantry.bodies:
            wait(self.cell.gantry)
        views, origins = [], {"bin": self.cell.gantry.bin, "tote": (0.0, 0.0)}
        for name, base_from_room in (("bin", self.base_from_bin), ("tote", self.base_from_tote)):
            eye = self.cell.cameras[name]
            base_from_camera = self.base_from_tote @ frame(0, *origins[name]) @ eye.pose  # a calibration says it
            pose = np.linalg.inv(base_from_room) @ base_from_camera
            views.append((Camera(eye.fx, eye.fy, eye.cx, eye.cy, pose, eye.shape), self.cell.depth_image(name)))
        return views

    def move(self, base_from_tool: np.ndarray) -> None:
        """Bring the tool frame to a pose, ``[4, 4]``, along a line."""
        goal, gantry = np.linalg.inv(self.base_from_tote) @ base_from_tool, self.cell.gantry
        turn = math.atan2(goal[1, 0], goal[0, 0]) - gantry.goal[3]
        turn = gantry.goal[3] + (turn + math.pi) % (2 * math.pi) - math.pi  # the short way round
        way = gantry.lower if goal[2, 3] < gantry.goal[2] else gantry.travel
        assert (loss := way((*goal[:3, 3], turn))) is None, loss

    def suck(self) -> None:
        """Hold the item below the lip; some grips miss it."""
        if self.grips not in self.missed:
            assert (loss := self.cell.gantry.grip()) is None, loss
        self.grips, self.asked = self.grips + 1, 0

    def holds_item(self) -> bool:
        """Ask the vacuum sensor."""
        self.asked += 1
        if self.asked == 2 and self.grips - 1 in self.lost:
            self.release()
        return self.cell.gantry.holding

    def release(self) -> None:
        """Let the item go."""
        self.cell.gantry.release()
        self.in_bin = None

    def wait_for_items(self) -> bool:
        """Put the next item into the bin; return whether there was one."""
        if self.arriving:
            self.in_bin = self.arriving.pop(0)
            self.cell.arrive(*self.in_bin)
        return self.in_bin is not None

    def change_tote(self) -> None:
        """Bring an empty tote."""
        self.cells.append(SimulatedCell(self.planner, seed=len(self.cells)))
        if self.in_bin is not None:
            self.cell.arrive(*self.in_bin)

    def call_for_help(self, reason: str) -> None:
        """Let somebody take all items out of bin and tote."""
        self.calls.append(reason)
        self.in_bin = None
        self.change_tote()
