"""A robot cell in MuJoCo, end to end: two depth cameras, the planner, and a gantry that does what the plan says.

Nothing but the depth images tells the planner what is in bin and tote. They are computed from rays, so no OpenGL is
needed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pickplace.physics.execute import Execute, Gantry
from pickplace.physics.plans import EpisodePlan
from pickplace.physics.recorded import body_of
from pickplace.physics.scene import mujoco
from pickplace.physics.simulation import Loss, wait
from pickplace.robot.box import ACCURACY, CLEARANCE
from pickplace.robot.camera import Camera
from pickplace.robot.planner import Plan, Planner
from pickplace.robot.scene import Scene

CAMERA_HEIGHT = 1.2  # above the floors, m
LEAST_ROWS = 240  # of a depth image
RAY_LENGTH = 10.0  # m


@dataclass
class Filled:
    """A tote that was filled, and why it was not filled further."""

    sizes: list[tuple[float, float, float]] = field(default_factory=list)  # of the items in it, m
    loss: Loss | None = None
    last: Plan | None = None  # the plan that was not carried out: no place was left

    @property
    def volume(self) -> float:
        """The volume of the items, m^3."""
        return sum(math.prod(size) for size in self.sizes)


class SimulatedCell:
    """Bin, tote, cameras and gantry.

    Args:
        planner: decides.
        noise: standard deviation of every value of the depth images, m.
        accuracy, clearance: of the :class:`~pickplace.robot.scene.Scene`, m.
        seed: of the noise.
        **options: of :class:`~pickplace.physics.execute.Execute`.
    """

    def __init__(
        self, planner: Planner, noise: float = 0.002, accuracy: float = ACCURACY,
        clearance: float = CLEARANCE, seed: int = 0, **options,
    ):  # fmt: skip
        self.planner, self.noise = planner, noise
        self.accuracy, self.clearance = accuracy, clearance
        self.draw = np.random.default_rng(seed)
        # The cup gives way by as much as heights may be wrong. The plate is narrower than its cells by the clearance.
        options = {"lip": 2 * accuracy, "gap": 2 * clearance, **options}
        self.simulation = Execute(**options)
        cell, cell_size = planner.cell, planner.cell.cell_size
        scale = (cell_size, cell_size, cell_size * cell.height_unit)
        self.bin, self.tote = (tuple(np.multiply(size, scale)) for size in (cell.bin_size, cell.tote_size))
        effector = tuple(np.multiply(cell.gripper.size, cell_size))
        plan = EpisodePlan(0, self.tote, self.bin, effector, body=body_of(cell))
        self.gantry: Gantry = self.simulation.make_scene(plan)
        # The image shows more than the floors, as the rims are nearer. Its pixels are at most half the clearance wide.
        shown = (max(*self.bin[:2], *self.tote[:2]) + 0.1) / 0.8
        rows = max(LEAST_ROWS, math.ceil(2 * shown / clearance))
        focal, image = CAMERA_HEIGHT * rows / shown, (rows, 4 * rows // 3)
        self.cameras = {
            name: Camera.looking_down((sides[0] / 2, sides[1] / 2), CAMERA_HEIGHT, focal, image)
            for name, sides in (("bin", self.bin), ("tote", self.tote))
        }

    def fill(self, items: Sequence[tuple]) -> Filled:
        """Fill the tote with the items that arrive one by one, until one finds no place.

        Args:
            items: size ``(w, d, h)``, centre in the bin ``(x, y)`` in metres, and yaw in degrees, of each.
        """
        filled, bearing, placed = Filled(), None, []
        for size, centre, yaw in items:
            self.arrive(size, centre, yaw)
            plan = self.look_and_plan(bearing, placed)
            if plan.status != "ok":
                filled.last = plan
                break
            if loss := self.carry_out(plan, size):
                filled.loss = loss
                break
            filled.sizes.append(tuple(size))
            bearing, placed = plan.tote_bearing, [*placed, plan.placed]
        return filled

    def look_and_plan(self, tote_bearing=None, placed=()) -> Plan:
        """Return the plan for what the cameras see."""
        views = [(camera, self.depth_image(name)) for name, camera in self.cameras.items()]
        scene = Scene.from_images(
            self.planner.cell, *views, self.planner.cell.cell_size, self.accuracy, clearance=self.clearance,
            tote_bearing=tote_bearing, placed=placed,
        )  # fmt: skip
        return self.planner.plan(scene, alternatives=0)

    def carry_out(self, plan: Plan, size: Sequence[float]) -> Loss | None:
        """Do what a plan says; return the loss if there is one."""
        assert plan.pick and plan.place and plan.rotation_degrees is not None and plan.drop_height is not None
        gantry = self.gantry
        start, turn = (math.radians(angle) for angle in (plan.pick.yaw, plan.rotation_degrees))
        turn = (turn + math.pi / 2) % (2 * math.pi) - math.pi / 2  # the short way round
        pick, place = np.array(plan.pick.center), np.array(plan.place.center)
        x, y = gantry.centre[:2] - gantry.bin - pick[:2]
        planned = place[:2] + (x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn))
        gantry.planned[-1] = (*planned, plan.drop_height + size[2] / 2)
        goals = (*(gantry.bin + pick[:2]), pick[2], start), (*place, start + turn)
        loss = gantry.bring(*goals, size[2])
        if loss is None and np.linalg.norm(gantry.centre[:2] - planned) > self.simulation.tolerance:
            loss = Loss("wedged", len(gantry.boxes) - 1)
        if loss is None:
            loss = gantry.leave(size[2])
        return loss or self.simulation.find_loss(gantry)

    def depth_image(self, name: str) -> np.ndarray:
        """Return what a camera measures, ``"bin"`` or ``"tote"``, m; the gantry is out of the way."""
        gantry, camera = self.gantry, self.cameras[name]
        mujoco.mj_forward(gantry.model, gantry.data)
        rays = camera.rays()
        length = np.linalg.norm(rays, axis=-1)
        directions = rays / length[..., None]
        origin = camera.pose[:3, 3] + ((*gantry.bin, 0.0) if name == "bin" else 0.0)
        count, hit = length.size, np.zeros(length.size, dtype=np.int32)
        distance = np.zeros(count)
        arguments = (origin, directions.ravel(), None, 1, gantry.plate.id, hit, distance, None, count, RAY_LENGTH)
        mujoco.mj_multiRay(gantry.model, gantry.data, *arguments)
        depth = np.where(hit >= 0, distance, np.nan).reshape(length.shape) / length
        return depth + self.draw.normal(0, self.noise, depth.shape)

    def arrive(self, size, centre, yaw: float) -> None:
        """Put an item into the bin, and let it come to rest."""
        gap = (self.simulation.gap, self.simulation.gap, 0.0)  # what the simulation takes off
        corner = (*(self.gantry.bin + centre - np.add(size, gap)[:2] / 2), 0.0)
        middle = np.array((*(self.gantry.bin + centre), size[2] / 2))
        self.gantry.add(corner, np.add(size, gap), middle, math.radians(yaw))
        wait(self.gantry)  # a wall of the bin may push it
