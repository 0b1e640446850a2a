"""What ``settle`` and ``execute`` have in common: options, losses, and outcomes."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from math import prod
from multiprocessing import get_context
from time import process_time
from typing import ClassVar, NamedTuple

import numpy as np

from pickplace.physics.plans import Placement, Plan
from pickplace.physics.scene import Scene
from pickplace.task.checks import flag, number, whole_number

#: An item is at rest below these speeds; m/s and rad/s.
STILL = np.repeat((0.002, 0.02), 3)
CHUNK, SHORTEST, LONGEST, AT_THE_END = 0.02, 0.06, 1.0, 1.0  # seconds between looks, and for items to come to rest


class Loss(NamedTuple):
    """The first loss of an episode."""

    reason: str
    item: int  # number of the item, from 0


@dataclass(frozen=True)
class Outcome:
    """The end of an episode that was carried out."""

    episode: int
    ending: str  # "done", or the reason of the first loss
    lost: int | None  # number of the lost item, from 0
    during: int | None  # number of the placement during which it was lost; the number of placements: at the end
    placed: int  # items placed before the loss
    occupancy: float  # share of the tote that they fill
    drift: float  # greatest distance of a placed item that was not lost from its planned pose, m
    cpu_seconds: float


@dataclass(frozen=True)
class Simulation(ABC):
    """Options that every simulation has.

    An episode ends at the first loss. ``collapsed``: an item has moved or tilted too far from its planned pose.

    Args:
        cell_size: side of a cell; m.
        friction: sliding friction between all surfaces.
        density: of the items; kg/m^3.
        gap: what an item is narrower than planned, along x and y; m.
        noise: standard deviation of the error of a placement along x and along y; m.
        max_shift: distance beyond which an item is lost, in cells.
        max_tilt: angle beyond which an item is lost; degrees.
        sleep: let bodies that do not move sleep, which is faster and changes nothing.
        seed: of the errors of placement.
        workers: processes, each with an episode of its own.
    """

    cell_size: float = 0.05
    friction: float = 0.6
    density: float = 300.0
    gap: float = 0.001
    noise: float = 0.0
    max_shift: float = 0.25
    max_tilt: float = 14.0
    sleep: bool = True
    seed: int = 0
    workers: int = 1

    name: ClassVar[str]
    #: Least and greatest value of each option that is a number.
    limits: ClassVar[dict[str, tuple[float, float]]] = {
        "cell_size": (1e-3, 10), "friction": (0, 10), "density": (1, 1e5), "gap": (0, 0.1), "noise": (0, 0.1),
        "max_shift": (1e-3, 10), "max_tilt": (0.1, 90),
    }  # fmt: skip

    def __post_init__(self):
        for key, (least, most) in self.limits.items():
            number(f"physics.{key}", getattr(self, key), least, most)
        flag("physics.sleep", self.sleep)
        whole_number("physics.seed", self.seed, 0)
        whole_number("physics.workers", self.workers, 1, 64)
        if find_spec("mujoco") is None:
            raise ValueError(f"physics={self.name}: MuJoCo is missing; pip install 'pickplace[physics]'.")

    @abstractmethod
    def make_scene(self, plan: Plan) -> Scene:
        """Return the scene before the first placement."""

    @abstractmethod
    def place(self, scene, placement: Placement, error: np.ndarray) -> Loss | None:
        """Place the next item, with an error along x and y, m, ``[2]``; return the loss if there is one."""

    def carry_out(self, plans: Iterable[Plan]) -> Iterator[Outcome]:
        """Yield the outcome of each plan."""
        if self.workers == 1:
            yield from map(self.carry_out_one, plans)
        else:
            with ProcessPoolExecutor(self.workers, get_context("spawn")) as pool:
                yield from pool.map(self.carry_out_one, plans)

    def carry_out_one(self, plan: Plan) -> Outcome:
        """Return the outcome of a plan."""
        started, count = process_time(), len(plan.placements)
        errors = self.noise * np.random.default_rng((self.seed, plan.episode)).standard_normal((count, 2))
        scene, loss, placed = self.make_scene(plan), None, 0
        for placement, error in zip(plan.placements, errors, strict=True):
            if loss := self.place(scene, placement, error) or self.find_collapsed(scene):
                break
            placed += 1
        else:
            scene.run(AT_THE_END)
            loss = self.find_collapsed(scene)
        kept = [number for number in range(placed) if loss is None or number != loss.item]
        return Outcome(
            episode=plan.episode,
            ending=loss.reason if loss else "done",
            lost=loss.item if loss else None,
            during=placed if loss else None,
            placed=placed,
            occupancy=sum(placement.volume for placement in plan.placements[:placed]) / prod(plan.tote),
            drift=float(scene.shifts[kept].max(initial=0.0)),
            cpu_seconds=process_time() - started,
        )

    def find_collapsed(self, scene: Scene) -> Loss | None:
        """Return the item that has moved furthest of those that have moved or tilted too far, if any has."""
        shifts, tilts = scene.shifts, scene.tilts
        lost = (shifts > self.max_shift * self.cell_size) | (tilts > self.max_tilt)
        return Loss("collapsed", int(np.where(lost, shifts, -1).argmax())) if lost.any() else None


def wait(scene: Scene) -> None:
    """Let time pass until all items are at rest, or :data:`LONGEST`."""
    scene.run(SHORTEST)
    for _ in range(round((LONGEST - SHORTEST) / CHUNK)):
        if (np.abs(scene.speeds) < STILL).all():
            return
        scene.run(CHUNK)
