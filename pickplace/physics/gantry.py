"""A gantry in a scene: a suction plate on three slides and a hinge, whose drives follow a path."""

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from pickplace.physics.plans import Plan
from pickplace.physics.scene import STIFF, TIMESTEP, Scene
from pickplace.physics.simulation import Loss

if TYPE_CHECKING:
    from pickplace.physics.execute import Execute

STIFFNESS = 2e5, 2e3  # of the drives of the slides, N/m, and of the hinge, N m/rad
SLOW_WAY = 0.03  # the last way down and the first way up that is done slowly, m
SETTLING = 0.05  # time for the plate to come to rest at the end of a way, s
REACH = 0.0005  # by which a lip is drawn out, m
WAKING = 1e-6  # force that wakes a body, N
STEPS = 2  # of the simulation between looks


class Gantry(Scene):
    """Tote, bin and plate.

    Args:
        options: of the simulation.
        plan: has the sizes.
        origin: near corner of the bin, ``[2]``.
    """

    def __init__(self, options: "Execute", plan: Plan, origin: np.ndarray):
        super().__init__(options.friction, options.density, options.gap, options.sleep)
        self.options = options
        self.add_container(plan.tote)
        self.add_container(plan.bin, origin)
        self.safe_height = max(plan.tote[2], plan.bin[2])
        self.held: int | None = None
        self.weld = None
        self._add_plate(plan)
        self.goal = np.zeros(4)  # of x, y, z of the lower face, and the turn
        start = (*(origin + np.divide(plan.bin[:2], 2)), 2 * self.safe_height, 0.0)
        self.compile()
        self.goal = np.array(start)
        self.data.qpos[:4] = self.data.ctrl[:4] = start

    def _add_plate(self, plan: Plan) -> None:
        thickness, mass = self.options.plate_thickness, self.options.plate_mass
        self.plate = self.spec.worldbody.add_body(name="plate", gravcomp=1.0)
        for axis, name in enumerate(("x", "y", "z", "turn")):
            slide = name != "turn"
            kind = mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE
            direction = np.eye(3)[axis] if slide else (0, 0, 1)
            self.plate.add_joint(name=name, type=kind, axis=direction, armature=0.0 if slide else 0.01)
            stiffness = STIFFNESS[not slide]
            drive = self.spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            drive.set_to_position(kp=stiffness, dampratio=1.0)
        sides = np.subtract(plan.effector, self.gap)
        geom = self.add_geom(self.plate, (*sides, thickness), (0, 0, thickness / 2))
        geom.name, geom.density = "plate", mass / float(np.prod((*sides, thickness)))

    def add(self, corner, size, planned) -> None:
        number = len(self.boxes)
        super().add(corner, size, planned)
        self.boxes[number].name = f"item{number}"
        self.boxes[number].geoms[0].name = f"item{number}"
        self.weld = self.spec.add_equality(
            type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1="plate", name2=f"item{number}",
            active=False, **STIFF,
        )  # fmt: skip
        self.compile()
        self.data.ctrl[:] = self.goal

    def position(self, number: int) -> np.ndarray:
        """Return the centre of an item, ``[3]``."""
        return self.data.xpos[self.boxes[number].id].copy()

    def move(self, point, turn: float) -> Loss | None:
        """Move the plate's lower face along a line, slowly near its lower end; return the first loss on the way."""
        goal = np.array((*point, turn))
        way, level = goal - self.goal, np.abs(goal - self.goal)[:2].max() > 0 or turn != self.goal[3]
        length, sign = np.linalg.norm(way[:3]), np.sign(way[2])
        slow = 0.0 if level else min(SLOW_WAY, length)
        parts = [(length - slow, self.options.speed), (slow, self.options.slow_speed)]
        if sign > 0:
            parts.reverse()
        start, done = self.goal, 0.0
        for part, speed in parts:
            seconds = max(part / speed, (abs(way[3]) / 4.0 if level else 0.0) if part else 0.0) * 1.5
            count = round(seconds / TIMESTEP / STEPS)
            for step in range(1, count + 1):
                share = step / count
                share = share * share * (3 - 2 * share)  # gently from rest to rest
                self.data.ctrl[:] = start + way * ((done + part * share) / length if length else share)
                if loss := self._step():
                    return loss
            done += part
        self.goal = goal
        self.data.ctrl[:] = goal
        for _ in range(round(SETTLING / TIMESTEP / STEPS)):
            if loss := self._step():
                return loss
        return None

    def grip(self, number: int) -> Loss | None:
        """Suck the item below the plate; return the loss if the lip does not reach it."""
        geoms = self.plate.geoms[0].id, self.boxes[number].geoms[0].id
        if mujoco.mj_geomDistance(self.model, self.data, *geoms, 0.1, None) > self.options.lip + REACH:
            return Loss("dropped", number)
        plate, item = self.plate.id, self.boxes[number].id
        rotation = self.data.xmat[plate].reshape(3, 3)
        inverse, relative = np.zeros(4), np.zeros(4)
        mujoco.mju_negQuat(inverse, self.data.xquat[plate])
        mujoco.mju_mulQuat(relative, inverse, self.data.xquat[item])
        offset = rotation.T @ (self.data.xpos[item] - self.data.xpos[plate])
        index = self.weld.id
        self.model.eq_data[index, :11] = (0, 0, 0, *offset, *relative, 1.0)
        self.data.eq_active[index] = 1
        self.held = number
        return None

    def release(self) -> None:
        """Let go of the item."""
        self.data.eq_active[self.weld.id] = 0
        item = self.boxes[self.held].id
        self.held = None
        self.data.xfrc_applied[item, 2] = -WAKING  # else an item that was held still would sleep on in the air
        mujoco.mj_step(self.model, self.data)
        self.data.xfrc_applied[item, 2] = 0.0

    def _step(self) -> Loss | None:
        """Let a little time pass; return what was lost in it."""
        before = self.speeds[-1, :3].copy() if self.boxes else None
        mujoco.mj_step(self.model, self.data, nstep=STEPS)
        held = None if self.held is None else self.boxes[self.held].geoms[0].id
        plate = self.plate.geoms[0].id
        pairs = self.data.contact.geom
        force, total = np.zeros(6), 0.0
        for index in np.nonzero((pairs == plate).any(1))[0]:
            if held not in pairs[index]:
                mujoco.mj_contactForce(self.model, self.data, index, force)
                total += abs(force[0])
        if total > self.options.contact_force:
            return Loss("effector_contact", len(self.boxes) - 1)
        if self.held is not None:
            # From the motion: with drives that are integrated implicitly, the weld's force is not what it transmits.
            acceleration = (self.speeds[-1, :3] - before) / (STEPS * TIMESTEP) - self.model.opt.gravity
            mass = self.model.body_mass[self.boxes[self.held].id]
            if mass * np.linalg.norm(acceleration) > self.options.suction:
                self.release()
                return Loss("dropped", len(self.boxes) - 1)
        return None
