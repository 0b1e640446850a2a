"""A MuJoCo model of containers and boxes; in metres, kilograms and seconds.

The frame's origin is the tote's near corner on its floor; z points up.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pickplace.views.motion import INTERVAL, Motion

try:
    import mujoco

    mujoco.set_mju_user_warning(lambda *_: None)  # else it writes MUJOCO_LOG.TXT; `diverged` reports what matters
except ImportError:  # MuJoCo is an extra; Simulation reports that it is missing
    mujoco = None

#: Contacts and welds are stiff: a tower of six boxes sinks by 0.02 mm.
STIFF = {"solref": (0.005, 1.0), "solimp": (0.99, 0.999, 0.0001, 0.5, 2.0)}  # of contacts: time in s, damping ratio
TIMESTEP = 0.002
WALL = 0.01  # thickness of floor and walls

Vector = Sequence[float] | np.ndarray


class Scene:
    """Containers, and the boxes that were added to them.

    Args:
        friction: sliding friction between all surfaces.
        density: of boxes of unknown mass.
        gap: total narrowing of a box along x and along y.
        sleep: let bodies that do not move sleep.
        contact_damping: damping ratio of contacts.

    Attributes:
        spec, model, data: MuJoCo's; each :meth:`add` replaces the last two.
        bodies: MuJoCo's body of each box, in the order in which they were added.
        boxes: the bodies in the tote or on the way to it, in the order of the placements.
        waiting: the bodies in the bin, by near corner and sides at their planned places there, x, y, w, d, h.
        plate: MuJoCo's body of the end effector, if there is one.
        bin: near corner of the bin, if there is one.
        planned: planned centre at rest of each of :attr:`boxes`, ``[n, 3]``.
        motion: recorder of the poses, if there is one.
    """

    plate: Any = None
    bin: Any = None

    def __init__(self, friction: float, density: float, gap: float, sleep: bool = True, contact_damping: float = 1.0):
        self.gap = gap
        self._surface = {
            **STIFF,
            "solref": (STIFF["solref"][0], contact_damping),
            "friction": [friction, 0.005, 0.0001],
            "density": density,
        }
        self.spec = mujoco.MjSpec()
        option = self.spec.option
        option.timestep, option.cone, option.impratio = TIMESTEP, mujoco.mjtCone.mjCONE_ELLIPTIC, 10
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        if sleep:
            option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
            # In m/s. At MuJoCo's default, 1e-3, items fall asleep while they begin to tilt; at 2e-4 `execute` is slow.
            option.sleep_tolerance = 5e-4
        self.bodies: list = []
        self.boxes: list = []
        self.waiting: dict[tuple[float, ...], Any] = {}
        self.planned = np.zeros((0, 3))
        self.motion: Motion | None = None
        self._next_picture = 0.0  # s
        self.model = self.spec.compile()
        self.data = mujoco.MjData(self.model)

    def compile(self) -> None:
        """Compile the model again, and keep its state."""
        self.model, self.data = self.spec.recompile(self.model, self.data)

    def add_container(self, size: Vector, origin: Vector = (0.0, 0.0)) -> None:
        """Add floor and walls around the inner sides ``size``, with the near corner at ``origin``."""
        (width, depth, height), (x, y) = size, origin
        outer, middle = width + 2 * WALL, (x + width / 2, y + depth / 2)
        self.add_geom(self.spec.worldbody, (outer, depth + 2 * WALL, WALL), (*middle, -WALL / 2))
        for at in (x - WALL / 2, x + width + WALL / 2):
            self.add_geom(self.spec.worldbody, (WALL, depth + 2 * WALL, height), (at, middle[1], height / 2))
        for at in (y - WALL / 2, y + depth + WALL / 2):
            self.add_geom(self.spec.worldbody, (width, WALL, height), (middle[0], at, height / 2))

    def add(self, corner: Vector, size: Vector, planned: Vector, yaw: float = 0.0, mass: float = 0.0) -> None:
        """Add a box.

        Args:
            corner: its near corner now, before it is turned about its centre.
            size: its planned sides.
            planned: planned centre of the box at rest.
            yaw: its turn, rad.
            mass: of the box; 0: the density gives it.
        """
        self.planned = np.vstack([self.planned, planned])
        self.boxes.append(self._add_body(corner, size, yaw))
        self.weigh(mass)
        self.compile()
        self.record()

    def weigh(self, mass: float) -> None:
        """Set the mass of the last one of :attr:`boxes`; 0: the density gives it."""
        if mass:
            self.boxes[-1].geoms[0].mass = mass

    def _add_body(self, corner: Vector, size: Vector, yaw: float = 0.0):
        body = self.spec.worldbody.add_body(
            name=f"item{len(self.bodies)}",
            pos=np.add(corner, np.divide(size, 2)),
            quat=(np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)),
        )
        body.add_freejoint()
        self.add_geom(body, np.subtract(size, (self.gap, self.gap, 0)))
        self.bodies.append(body)
        return body

    def add_geom(self, body, size: Vector, centre: Vector = (0.0, 0.0, 0.0)):
        """Add a box-shaped surface to a body."""
        return body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=np.divide(size, 2), pos=centre, **self._surface)

    def run(self, seconds: float) -> None:
        """Simulate a time in seconds."""
        self.step(round(seconds / TIMESTEP))

    def step(self, count: int) -> None:
        """Simulate ``count`` time steps."""
        if self.motion is None:
            mujoco.mj_step(self.model, self.data, nstep=count)
            return
        for _ in range(count):
            if self.data.time >= self._next_picture:
                self.record()
            mujoco.mj_step(self.model, self.data)

    def record(self) -> None:
        """Add a picture to the motion, if there is one."""
        if self.motion is None:
            return
        mujoco.mj_kinematics(self.model, self.data)  # includes boxes that were added since the last step
        poses = np.hstack([self.data.xpos, self.data.xquat])
        plate = None if self.plate is None else poses[self.plate.id]
        self.motion.add(poses[[body.id for body in self.bodies]], plate)
        self._next_picture = self.data.time + INTERVAL

    def finish_motion(self) -> None:
        """Add the last picture to the motion, and sort its boxes: the placed ones first."""
        assert self.motion is not None
        self.record()
        poses = {body.name: poses for body, poses in zip(self.bodies, self.motion.boxes, strict=True)}
        self.motion.boxes = [poses[body.name] for body in [*self.boxes, *self.waiting.values()]]
        self.motion.left = [box[2:] for box in self.waiting]

    @property
    def diverged(self) -> bool:
        """Whether the simulation has failed: unbounded forces or speeds, or too many contacts."""
        return bool(self.data.warning.number[: mujoco.mjtWarning.mjWARN_BADCTRL].any())

    @property
    def shifts(self) -> np.ndarray:
        """The distance of each box's centre from its planned place, ``[n]``."""
        return np.linalg.norm(self.data.xpos[[body.id for body in self.boxes]] - self.planned, axis=1)

    @property
    def tilts(self) -> np.ndarray:
        """The angle between each box's axis and the vertical, ``[n]``; degrees."""
        return np.degrees(np.arccos(np.clip(self.data.xmat[[body.id for body in self.boxes], 8], -1, 1)))
