"""A container and boxes in it as a MuJoCo model; in metres, kilograms and seconds.

The frame's origin is the container's near corner on its floor, z points up.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

#: Contacts are stiff: a tower of six boxes sinks by 0.02 mm.
SOLREF, SOLIMP = (0.005, 1.0), (0.99, 0.999, 0.0001, 0.5, 2.0)
TIMESTEP = 0.002
WALL = 0.01  # thickness of floor and walls
MARGIN = 0.002  # how far above its planned pose an item appears

Vector = Sequence[float]


class Scene:
    """A container and the boxes that were added to it.

    Args:
        size: inner sides of the container; m.
        friction: sliding friction between all surfaces.
        density: of the boxes.
        gap: what a box is narrower than planned, along x and y.
        sleep: let bodies that do not move sleep.

    Attributes:
        model, data: MuJoCo's; new ones after each :meth:`add`.
        planned: centre of each box where it was planned to rest, ``[n, 3]``.
    """

    def __init__(self, size: Vector, friction: float, density: float, gap: float, sleep: bool = True):
        self.friction, self.density, self.gap = friction, density, gap
        self.spec = mujoco.MjSpec()
        option = self.spec.option
        option.timestep, option.cone, option.impratio = TIMESTEP, mujoco.mjtCone.mjCONE_ELLIPTIC, 10
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        if sleep:
            option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        width, depth, height = size
        self._add_geom(self.spec.worldbody, (width + 2 * WALL, depth + 2 * WALL, WALL), (width / 2, depth / 2, -WALL / 2))
        for x in (-WALL / 2, width + WALL / 2):
            self._add_geom(self.spec.worldbody, (WALL, depth + 2 * WALL, height), (x, depth / 2, height / 2))
        for y in (-WALL / 2, depth + WALL / 2):
            self._add_geom(self.spec.worldbody, (width, WALL, height), (width / 2, y, height / 2))
        self.model = self.spec.compile()
        self.data = mujoco.MjData(self.model)
        self.planned = np.zeros((0, 3))

    def add(self, corner: Vector, size: Vector, shift: Vector = (0.0, 0.0)) -> None:
        """Let a box appear a little above where it is planned to rest.

        Args:
            corner: planned near corner; m.
            size: planned sides; m.
            shift: error of its position along x and y; m.
        """
        centre = np.asarray(corner, float) + np.asarray(size, float) / 2
        self.planned = np.vstack([self.planned, centre])
        body = self.spec.worldbody.add_body(pos=centre + (*shift, MARGIN))
        body.add_freejoint()
        self._add_geom(body, np.asarray(size, float) - (self.gap, self.gap, 0), (0, 0, 0))
        self.model, self.data = self.spec.recompile(self.model, self.data)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        mujoco.mj_step(self.model, self.data, nstep=round(seconds / TIMESTEP))

    @property
    def shifts(self) -> np.ndarray:
        """How far the centre of each box is from where it was planned, m, ``[n]``."""
        return np.linalg.norm(self.data.xpos[1:] - self.planned, axis=1)

    @property
    def tilts(self) -> np.ndarray:
        """The angle between each box's axis and the vertical, degrees, ``[n]``."""
        upright = self.data.xmat[1:, 8]
        return np.degrees(np.arccos(np.clip(upright, -1, 1)))

    def _add_geom(self, body, size: Vector, centre: Vector) -> None:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=np.asarray(size, float) / 2, pos=centre,
            friction=[self.friction, 0.005, 0.0001], density=self.density,
            solref=SOLREF, solimp=SOLIMP,
        )  # fmt: skip
