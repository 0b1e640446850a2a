"""``settle``: the placements of an episode, one after the other, under gravity and friction."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing import get_context
from time import process_time

import numpy as np

from pickplace.physics.plans import Plan
from pickplace.task.checks import flag, number, whole_number

#: An item is at rest below these speeds; m/s and rad/s.
STILL = np.repeat((0.002, 0.02), 3)
CHUNK, SHORTEST, LONGEST, AT_THE_END = 0.02, 0.06, 1.0, 1.0  # seconds between looks, and for an item to come to rest


@dataclass(frozen=True)
class Outcome:
    """The end of an episode that was carried out."""

    episode: int
    ending: str  # "done", or the first loss: "collapsed"
    lost: int | None  # number of the lost item, from 0
    during: int | None  # number of the placement after which it was lost; the number of placements: at the end
    placed: int  # items placed before the loss
    occupancy: float  # share of the tote that they fill
    drift: float  # greatest distance of an item that was not lost from its planned pose, m
    cpu_seconds: float


@dataclass(frozen=True)
class Settle:
    """Items appear 2 mm above their planned pose and come to rest, one after the other (config ``physics=settle``).

    An episode ends at the first loss: an item has moved or tilted too far from its planned pose.

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

    name = "settle"

    def __post_init__(self):
        limits = {
            "cell_size": (1e-3, 10), "friction": (0, 10), "density": (1, 1e5), "gap": (0, 0.1), "noise": (0, 0.1),
            "max_shift": (1e-3, 10), "max_tilt": (0.1, 90),
        }  # fmt: skip
        for key, (least, most) in limits.items():
            number(f"physics.{key}", getattr(self, key), least, most)
        flag("physics.sleep", self.sleep)
        whole_number("physics.seed", self.seed, 0)
        whole_number("physics.workers", self.workers, 1, 64)
        if find_spec("mujoco") is None:
            raise ValueError(f"physics={self.name}: MuJoCo is missing; pip install 'pickplace[physics]'.")

    def carry_out(self, plans: Iterable[Plan]) -> Iterator[Outcome]:
        """Yield the outcome of each plan."""
        if self.workers == 1:
            yield from map(self.carry_out_one, plans)
        else:
            with ProcessPoolExecutor(self.workers, get_context("spawn")) as pool:
                yield from pool.map(self.carry_out_one, plans)

    def carry_out_one(self, plan: Plan) -> Outcome:
        """Return the outcome of a plan."""
        from pickplace.physics.scene import Scene

        started, scene = process_time(), Scene(plan.tote, self.friction, self.density, self.gap, self.sleep)
        errors = self.noise * np.random.default_rng((self.seed, plan.episode)).standard_normal((len(plan.placements), 2))
        lost, during = None, None
        for index, (placement, error) in enumerate(zip(plan.placements, errors, strict=True)):
            scene.add(placement.corner, placement.size, error)
            wait(scene)
            if (lost := self.find_lost(scene)) is not None:
                during = index
                break
        else:
            scene.run(AT_THE_END)
            if (lost := self.find_lost(scene)) is not None:
                during = len(plan.placements)
        placed = len(plan.placements) if during is None else during
        kept = [index for index in range(len(scene.shifts)) if index != lost]
        return Outcome(
            plan.episode, "done" if lost is None else "collapsed", lost, during, placed,
            sum(placement.volume for placement in plan.placements[:placed]) / float(np.prod(plan.tote)),
            float(scene.shifts[kept].max(initial=0)), process_time() - started,
        )  # fmt: skip

    def find_lost(self, scene) -> int | None:
        """Return the number of the item that has moved furthest, if it or its tilt is beyond what is allowed."""
        lost = (scene.shifts > self.max_shift * self.cell_size) | (scene.tilts > self.max_tilt)
        return int(np.where(lost, scene.shifts, -1).argmax()) if lost.any() else None


def wait(scene) -> None:
    """Let time pass until all items are at rest, or :data:`LONGEST`."""
    scene.run(SHORTEST)
    for _ in range(round((LONGEST - SHORTEST) / CHUNK)):
        if (np.abs(scene.data.qvel.reshape(-1, 6)) < STILL).all():
            return
        scene.run(CHUNK)
