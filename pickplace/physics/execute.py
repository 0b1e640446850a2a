"""``execute``: a gantry with a suction plate carries each item from the bin to the tote."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import pi
from typing import Any, ClassVar

import numpy as np

from pickplace.common.validate import number, or_null, refuse_if
from pickplace.physics.plans import TOLERANCE, EpisodePlan, Placement, Point
from pickplace.physics.scene import STIFF, TIMESTEP, WALL, Scene, mujoco
from pickplace.physics.simulation import Loss, Simulation, wait

HEADROOM = 0.02  # distance between the carried item and the rims, m
TURNING_SPEED = 4.0  # greatest speed of the hinge, rad/s
STIFFNESS = 2e5, 2e3  # stiffness of the drives of the slides, N/m, and of the hinge, N m/rad
SLOW_DISTANCE = 0.03  # length of the slow part, the last one of a way down and the first one of a way up; m
SETTLING_TIME = 0.05  # time for the plate to come to rest, s
WAKING_FORCE = 1e-6  # force that wakes a body, N
REACH = 0.0005  # distance by which suction can stretch a lip, m
STEPS_PER_CHECK = 2  # steps of the simulation between two looks at contacts and forces


@dataclass(frozen=True)
class Execute(Simulation):
    """A gantry carries each item (config ``physics=execute``): over the bin, down, suction, up, over the rim while it
    turns, down, release, up. An item that lies in the bin beside others stays there until it is taken.

    Losses besides ``collapsed``: ``dropped``, the plate reached no item or lost it; ``effector_contact``, the plate
    touched a wall or another item, or its lip reached another item in the bin; ``disturbed``, an item that waits in the
    bin moved, for any reason; ``wedged``, the item is not at its planned place when it is released.

    Args:
        plate_thickness: thickness of the end effector; m.
        plate_diameter: diameter of a round end effector, which lies in the middle of its cells and may cover them in
            part; m. None: it covers the cells of its body.
        plate_mass: mass of the end effector; kg.
        lip: length of the suction cup's lip, between plate and item; m.
        release_height: height of an item above its planned pose when it is released; m.
        suction: greatest force, in any direction, that the suction bears; N.
        contact_force: force on the plate above which a contact is a loss; N.
        tolerance: greatest error of an item's position at release, and in the bin while it waits; m.
        speed: greatest speed of the plate; m/s.
        slow_speed: greatest speed on the last centimetres down and the first centimetres up; m/s.
    """

    plate_thickness: float = 0.01
    plate_diameter: float | None = None
    plate_mass: float = 2.0
    lip: float = 0.001
    release_height: float = 0.0005
    suction: float = 100.0
    contact_force: float = 5.0
    tolerance: float = 0.005
    speed: float = 1.0
    slow_speed: float = 0.2

    name: ClassVar[str] = "execute"
    grips: ClassVar[bool] = True
    endings: ClassVar[dict[str, tuple[str, str]]] = Simulation.endings | {
        "dropped": ("The suction did not hold item {}.", "item {} not held"),
        "effector_contact": ("The gripper hit something while it moved item {}.", "gripper hit something"),
        "disturbed": ("Another item in the bin moved when item {} was taken.", "moved another item"),
        "wedged": ("Item {} was not in its place when it was released.", "item {} wedged"),
    }
    limits: ClassVar[dict[str, tuple[float, float]]] = Simulation.limits | {
        "plate_thickness": (1e-3, 1), "plate_mass": (0.2, 50), "lip": (0, 0.01), "release_height": (0, 0.1),
        "suction": (0, 1e5), "contact_force": (0, 1e5), "tolerance": (1e-4, 1), "speed": (0.01, 5),
        "slow_speed": (0.01, 5),
    }  # fmt: skip

    def __post_init__(self):
        super().__post_init__()
        or_null(number, "physics.plate_diameter", self.plate_diameter, 1e-3, 10)

    def make_scene(self, plan: EpisodePlan) -> "Gantry":
        refuse_if(
            not (plan.bin and plan.effector),
            f"physics=execute: episode {plan.episode} has no bin; expected plans with all keys.",
        )
        if self.plate_diameter is not None and self.plate_diameter > (most := min(plan.effector)):
            raise ValueError(f"physics.plate_diameter={self.plate_diameter:g}: expected at most {most:g}, its cells.")
        for _, _, *sides in plan_body(plan):
            self.check_width(f"episode {plan.episode}, end effector", sides)
        for index, placement in enumerate(plan.placements, 1):
            for box in placement.neighbours:
                self.check_width(f"episode {plan.episode}, a neighbour of item {index}", box[2:])
        return Gantry(self, plan)

    def place(self, gantry: "Gantry", placement: Placement, error: np.ndarray) -> Loss | None:
        w, d, height = placement.size
        gantry.fill(placement.neighbours)
        lying = (d, w, height) if placement.rotation % 180 else placement.size
        gantry.take((*placement.item, *lying), placement.centre, placement.mass)
        low = placement.corner[2] + height + self.lip + self.release_height
        turn = ((placement.rotation + 90) % 360 - 90) / 180 * pi  # the short way round
        pick, place = (*(gantry.bin + placement.pick), height + self.lip, 0.0), (*(placement.place + error), low, turn)
        if loss := gantry.bring(pick, place, height):
            return loss
        if np.linalg.norm(gantry.centre - np.add(placement.centre, (*error, self.release_height))) > self.tolerance:
            return gantry.loss("wedged")
        return gantry.leave(height)


def plan_body(plan: EpisodePlan) -> tuple[Point, ...]:
    """Return the rectangles of a plan's end effector, x, y, w, d, from its near corner; m."""
    return plan.body or ((0.0, 0.0, *plan.effector),)


class Gantry(Scene):
    """Tote, bin, and a plate on three slides and a hinge, whose drives follow a path.

    Args:
        options: of the simulation.
        plan: has the sizes.

    Attributes:
        rim: greatest height of the tote, the bin and the items that wait in it.
        goal: commanded centre of the plate's lower face and its turn, m and rad, ``[4]``.
        holding: whether the plate holds the last item of :attr:`boxes`.
    """

    def __init__(self, options: Execute, plan: EpisodePlan):
        super().__init__(options.friction, options.density, options.gap, options.sleep, options.contact_damping)
        self.options, self.holding = options, False
        self.weld: Any = None  # MuJoCo's, between the plate and the last one of the boxes
        # An end effector that hangs over a wall of one container must not hit a wall of the other.
        distance = 2 * WALL + 2 * max(plan.effector) + 0.1
        self.bin = np.array((-plan.bin[0] - distance, (plan.tote[1] - plan.bin[1]) / 2))
        self.rim = max(
            plan.tote[2], plan.bin[2], *(box[4] for placement in plan.placements for box in placement.neighbours)
        )
        self.add_container(plan.tote)
        self.add_container(plan.bin, self.bin)
        self._add_plate(plan)
        self.goal = np.array((*(self.bin + np.divide(plan.bin[:2], 2)), self.rim + HEADROOM, 0.0))
        self.compile()
        self.data.qpos[:4] = self.goal

    def _add_plate(self, plan: EpisodePlan) -> None:
        """Add the end effector: a disc, or a box for each rectangle of its body; each is narrower by the gap."""
        self.plate = self.spec.worldbody.add_body(name="plate", gravcomp=1.0)
        thickness, diameter = self.options.plate_thickness, self.options.plate_diameter
        boxes = np.array(plan_body(plan))
        sides, centres = boxes[:, 2:] - self.gap, boxes[:, :2] + boxes[:, 2:] / 2 - np.divide(plan.effector, 2)
        if diameter is not None:
            sides, centres = np.array([[diameter - self.gap] * 2]), np.zeros((1, 2))
        for side, centre in zip(sides, centres, strict=True):
            geom = self.add_geom(self.plate, (*side, thickness), (*centre, thickness / 2))
            geom.density = self.options.plate_mass / float(sides.prod(1).sum() * thickness)
            if diameter is not None:
                geom.type, geom.size = mujoco.mjtGeom.mjGEOM_CYLINDER, (side[0] / 2, thickness / 2, 0)
        for axis, name in enumerate(("x", "y", "z")):
            self.plate.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=np.eye(3)[axis])
        self.plate.add_joint(name="turn", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1), armature=0.01)
        for joint in self.plate.joints:
            drive = self.spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            drive.set_to_position(kp=STIFFNESS[joint.name == "turn"], dampratio=1.0)

    def compile(self) -> None:
        if self.boxes:
            self.weld = self.weld or self.spec.add_equality(
                type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1="plate", active=False, **STIFF
            )
            self.weld.name2 = self.boxes[-1].name
        super().compile()
        self.data.ctrl[:] = self.goal

    def fill(self, boxes: Iterable[Point]) -> None:
        """Put items into the bin, except for those that wait there already.

        Args:
            boxes: near corner in the bin and sides, x, y, w, d, h.
        """
        if new := [box for box in boxes if self._find(box) is None]:
            self.waiting |= {box: self._add_body((*(self.bin + box[:2]), 0.0), box[2:]) for box in new}
            self.compile()
            self.record()

    def take(self, box: Point, planned: Point, mass: float) -> None:
        """Choose the item to carry next, ``box`` as in :meth:`fill`; ``planned`` is its centre in the tote.

        It has its ``mass`` from now on; while it waited, the density gave its mass.
        """
        if (known := self._find(box)) is None:
            self.add((*(self.bin + box[:2]), 0.0), box[2:], planned, mass=mass)
        else:
            self.boxes.append(self.waiting.pop(known))
            self.weigh(mass)
            self.planned = np.vstack([self.planned, planned])
            self.compile()

    def _find(self, box: Point) -> Point | None:
        """Return the key in :attr:`waiting` of the item with the place and the size of ``box``; None without one."""
        return next((one for one in self.waiting if np.abs(np.subtract(one, box)).max() <= TOLERANCE), None)

    @property
    def centre(self) -> np.ndarray:
        """The centre of the carried item, the last one of :attr:`boxes`, m, ``[3]``."""
        return self.data.xpos[self.boxes[-1].id]

    def loss(self, reason: str) -> Loss:
        """Return the loss of the carried item."""
        return Loss(reason, len(self.boxes) - 1)

    def travel(self, goal, speed: float | None = None) -> Loss | None:
        """Move the plate along a line, from rest to rest; return the first loss on the way.

        Args:
            goal: as :attr:`goal`.
            speed: greatest speed; None: the fast one.
        """
        start, way = self.goal, np.subtract(goal, self.goal)
        seconds = 1.5 * max(np.linalg.norm(way[:3]) / (speed or self.options.speed), abs(way[3]) / TURNING_SPEED)
        count = 1 + round(seconds / TIMESTEP / STEPS_PER_CHECK)
        for step in range(1, count + 1):
            share = step / count
            self.data.ctrl[:] = self.goal = start + way * share**2 * (3 - 2 * share)
            if loss := self._step():
                return loss
        return None

    def bring(self, pick, place, height: float) -> Loss | None:
        """Carry the last item of :attr:`boxes` to its place, and hold it there; return the first loss.

        Args:
            pick, place: goals of the plate at the pick and before the release.
            height: of the item, m.
        """
        (*over_pick, _, start), (*over_place, _, turn), high = pick, place, self.rim + height + HEADROOM
        return (
            self.travel((*over_pick, high, start))
            or self.lower(pick)
            or self.grip()
            or self.lift(high)
            or self.travel((*over_place, high, turn))
            or self.lower(place)
        )

    def release(self) -> None:
        """Let go of the item."""
        self.data.eq_active[self.weld.id] = self.holding = False
        self.data.xfrc_applied[self.boxes[-1].id, 2] = -WAKING_FORCE  # else it could stay asleep in the air
        self.step(1)
        self.data.xfrc_applied[self.boxes[-1].id, 2] = 0.0

    def leave(self, height: float) -> Loss | None:
        """Let go of an item, move up, and wait until all items are at rest; ``height`` is the item's, m."""
        self.release()
        loss = self.lift(self.rim + height + HEADROOM)
        wait(self)
        return loss

    def lower(self, goal) -> Loss | None:
        """Move the plate down, the last centimetres slowly, and let it come to rest."""
        x, y, z, turn = goal
        loss = self.travel((x, y, z + SLOW_DISTANCE, turn)) or self.travel(goal, self.options.slow_speed)
        for _ in range(round(SETTLING_TIME / TIMESTEP / STEPS_PER_CHECK)):
            loss = loss or self._step()
        return loss

    def lift(self, z: float) -> Loss | None:
        """Move the plate up, the first centimetres slowly."""
        x, y, low, turn = self.goal
        return self.travel((x, y, low + SLOW_DISTANCE, turn), self.options.slow_speed) or self.travel((x, y, z, turn))

    def grip(self) -> Loss | None:
        """Grip the item in the bin; return a loss if the lip does not reach it, or also reaches another item."""
        plate, item = self.plate.id, self.boxes[-1].id
        if not self._is_reached(self.boxes[-1]):
            return self.loss("dropped")
        if any(self._is_reached(body, below=True) for body in self.waiting.values()):
            return self.loss("effector_contact")
        offset = self.data.xmat[plate].reshape(3, 3).T @ (self.data.xpos[item] - self.data.xpos[plate])
        inverse, relative = np.zeros(4), np.zeros(4)
        mujoco.mju_negQuat(inverse, self.data.xquat[plate])
        mujoco.mju_mulQuat(relative, inverse, self.data.xquat[item])
        self.model.eq_data[self.weld.id, :11] = (0, 0, 0, *offset, *relative, 1.0)
        self.data.eq_active[self.weld.id] = self.holding = True
        return None

    def _is_reached(self, body, below: bool = False) -> bool:
        """Return whether the lip reaches an item; with ``below``, an item beside the plate does not count."""
        for geom in self.plate.geoms:
            ends = np.zeros(6)  # ends of the shortest line between the two
            distance = mujoco.mj_geomDistance(self.model, self.data, geom.id, body.geoms[0].id, 0.1, ends)
            if distance <= self.options.lip + REACH and not (below and np.hypot(*(ends[3:5] - ends[:2])) > TOLERANCE):
                return True
        return False

    def _step(self) -> Loss | None:
        """Simulate :data:`STEPS_PER_CHECK` steps; return the loss during them."""
        item = self.boxes[-1]
        velocity = self.data.qvel[self.model.body_dofadr[item.id] :][:3]
        before = velocity.copy()
        self.step(STEPS_PER_CHECK)
        if self.diverged:
            return self.loss("diverged")
        pairs, force, total = self.data.contact.geom, np.zeros(6), 0.0
        for index in np.nonzero(np.isin(pairs, [geom.id for geom in self.plate.geoms]).any(1))[0]:
            if not self.holding or item.geoms[0].id not in pairs[index]:
                mujoco.mj_contactForce(self.model, self.data, index, force)
                total += abs(force[0])
        if total > self.options.contact_force:
            return self.loss("effector_contact")
        if self.holding:
            # From the motion: as the drives are integrated implicitly, the weld does not report the force it transmits.
            acceleration = (velocity - before) / (STEPS_PER_CHECK * TIMESTEP) - self.model.opt.gravity
            if self.model.body_mass[item.id] * np.linalg.norm(acceleration) > self.options.suction:
                return self.loss("dropped")
        waits = {body.id: (*(self.bin + box[:2]), 0.0) + np.divide(box[2:], 2) for box, body in self.waiting.items()}
        shifts = np.linalg.norm(self.data.xpos[[*waits]] - [*waits.values()], axis=1) if waits else np.zeros(1)
        return self.loss("disturbed") if (shifts > self.options.tolerance).any() else None
