"""The base class of ``settle`` and ``execute``: options, the first loss, and the outcome."""

import signal
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from math import prod
from multiprocessing import get_context
from time import process_time
from typing import ClassVar, NamedTuple

import numpy as np

from pickplace.common.validate import flag, number, refuse_if, whole_number
from pickplace.physics.plans import EpisodePlan, Placement
from pickplace.physics.scene import Scene, mujoco
from pickplace.views.motion import Motion, Outcome

#: Linear and angular speeds below which an item is at rest; m/s and rad/s.
REST_SPEEDS = np.repeat((0.002, 0.02), 3)
#: Time for items to come to rest after a placement, at least and at most, and at the end of an episode; s.
MIN_WAIT, MAX_WAIT, FINAL_WAIT = 0.06, 1.0, 1.0
TIME_AFTER_LOSS = 1.0  # a recorded motion ends this long after a collapse, s
CHECK_INTERVAL = 0.02  # time between two looks at the speeds, s


class Loss(NamedTuple):
    """The first loss of an episode: its reason, and the number of the lost item, from 0."""

    reason: str
    item: int


@dataclass(frozen=True)
class Simulation(ABC):
    """Base class of physics engines with MuJoCo (see :class:`~pickplace.physics.engine.Engine`), and their options.

    An episode ends at the first loss. ``collapsed``: an item has moved or tilted too far from its planned pose.
    ``diverged``: the simulation has failed.

    Args:
        friction: sliding friction between all surfaces.
        density: of the items of unknown mass; kg/m^3.
        gap: total narrowing of an item along x and along y; m.
        noise: standard deviation of the error of a placement along x and along y; m. With ``settle``, an error of
            more than half the gap may make an item overlap its neighbour.
        max_shift: distance beyond which an item is lost, m.
        max_tilt: angle beyond which an item is lost; degrees.
        contact_damping: damping ratio of contacts. With 1, a light item on another one may tremble and creep by up to
            some millimetres in an episode; with 2 it does not.
        sleep: let bodies that hardly move sleep, which is faster.
        seed: of the errors of placement.
        workers: number of processes; each simulates one episode at a time.
    """

    friction: float = 0.6
    density: float = 300.0
    gap: float = 0.001
    noise: float = 0.0
    max_shift: float = 0.0125
    max_tilt: float = 14.0
    contact_damping: float = 1.0
    sleep: bool = True
    seed: int = 0
    workers: int = 1

    name: ClassVar[str]
    #: Texts of a replay for each ending: a sentence about the lost item, and a label of a few words.
    endings: ClassVar[dict[str, tuple[str, str]]] = {
        "done": ("Carried out: every item stayed in its place.", "carried out"),
        "collapsed": ("Item {} left its place.", "item {} left its place"),
        "diverged": ("The simulation became impossible.", "simulation diverged"),
    }
    #: Least and greatest value of each option that is a number.
    limits: ClassVar[dict[str, tuple[float, float]]] = {
        "friction": (0, 10), "density": (1, 1e5), "gap": (0, 0.1), "noise": (0, 0.1),
        "max_shift": (1e-4, 1), "max_tilt": (0.1, 90), "contact_damping": (0.1, 100),
    }  # fmt: skip

    def __post_init__(self):
        for key, (least, most) in self.limits.items():
            number(f"physics.{key}", getattr(self, key), least, most)
        flag("physics.sleep", self.sleep)
        whole_number("physics.seed", self.seed, 0)
        whole_number("physics.workers", self.workers, 1, 64)
        refuse_if(mujoco is None, f"physics={self.name}: MuJoCo is missing; pip install 'pickplace[physics]'.")

    @abstractmethod
    def make_scene(self, plan: EpisodePlan) -> Scene:
        """Return the scene before the first placement."""

    @abstractmethod
    def place(self, scene, placement: Placement, error: np.ndarray) -> Loss | None:
        """Place the next item, with an error along x and y, m, ``[2]``; return the loss if there is one."""

    def carry_out(self, plans: Iterable[EpisodePlan], record: Collection[int] = ()) -> Iterator[Outcome]:
        """Yield the outcome of each plan; it includes the motion for the episodes in ``record``."""
        plans = list(plans)
        recorded = [plan.episode in record for plan in plans]
        if self.workers == 1:
            yield from map(self.carry_out_one, plans, recorded)
        else:
            # Ctrl-C reaches all processes. The workers ignore it, and this process ends them.
            with ProcessPoolExecutor(
                self.workers, get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
            ) as pool:
                yield from pool.map(self.carry_out_one, plans, recorded)

    def carry_out_one(self, plan: EpisodePlan, record: bool = False) -> Outcome:
        """Return the outcome of a plan; it includes the motion if ``record``.

        Raises:
            ValueError: for an item or an end effector that is less than twice as wide as the gap.
        """
        for index, placement in enumerate(plan.placements, 1):
            self.check_width(f"episode {plan.episode}, item {index}", placement.size)
        started, count = process_time(), len(plan.placements)
        errors = self.noise * np.random.default_rng((self.seed, plan.episode)).standard_normal((count, 2))
        scene, loss, placed = self.make_scene(plan), None, 0
        if record:
            scene.motion = Motion(None if scene.bin is None else tuple(scene.bin.tolist()))
        for placement, error in zip(plan.placements, errors, strict=True):
            if loss := self.place(scene, placement, error) or self.find_loss(scene):
                break
            placed += 1
            if scene.motion:
                scene.motion.ends.append(scene.motion.pictures)
        else:
            scene.run(FINAL_WAIT)
            loss = self.find_loss(scene)
        ending, lost, during = (loss.reason, loss.item, placed) if loss else ("done", None, None)
        kept = [number for number in range(placed) if number != lost]
        words = self.endings.get(ending, (f"Item {{}}: {ending}.", ending))
        sentence, label = (text.format("" if lost is None else lost + 1) for text in words)
        outcome = Outcome(
            episode=plan.episode,
            ending=ending,
            lost=lost,
            during=during,
            placed=placed,
            occupancy=min(1.0, sum(placement.volume for placement in plan.placements[:placed]) / prod(plan.tote)),
            drift=float(scene.shifts[kept].max(initial=0.0)),
            cpu_seconds=process_time() - started,
            sentence=sentence,
            label=label,
            motion=scene.motion,
        )
        if scene.motion:
            if loss and loss.reason == "collapsed":
                scene.run(TIME_AFTER_LOSS)
            scene.finish_motion()
            scene.motion.ends = [*scene.motion.ends[: count - 1], scene.motion.pictures]
        return outcome

    def check_width(self, name: str, size: Sequence[float]) -> None:
        """Refuse a body less than twice as wide as the gap, with a ``ValueError`` that names it."""
        refuse_if(
            min(size[:2]) < 2 * self.gap,
            f"{name}: {min(size[:2]):g} m wide; expected sides of at least twice physics.gap, {2 * self.gap:g} m.",
        )

    def find_loss(self, scene: Scene) -> Loss | None:
        """Return the loss of the item that moved furthest, among those that moved or tilted too far; else None."""
        if scene.diverged:
            return Loss("diverged", len(scene.boxes) - 1)
        shifts, tilts = scene.shifts, scene.tilts
        lost = (shifts > self.max_shift) | (tilts > self.max_tilt)
        return Loss("collapsed", int(np.where(lost, shifts, -1).argmax())) if lost.any() else None


def wait(scene: Scene) -> None:
    """Simulate until all items are at rest, for at most :data:`MAX_WAIT`."""
    scene.run(MIN_WAIT)
    for _ in range(round((MAX_WAIT - MIN_WAIT) / CHECK_INTERVAL)):
        if (np.abs(scene.data.qvel[-6 * len(scene.bodies) :].reshape(-1, 6)) < REST_SPEEDS).all():  # six speeds a body
            return
        scene.run(CHECK_INTERVAL)
