"""``execute``: a gantry with a suction plate carries each item from the bin to the tote."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import pi, prod
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pickplace.physics.plans import Placement, Plan
from pickplace.physics.simulation import Loss, Simulation, wait

if TYPE_CHECKING:
    from pickplace.physics.gantry import Gantry

BIN_DISTANCE = 0.1  # between the outer walls of tote and bin, m
HEADROOM = 0.02  # between what is carried and the rims, m


@dataclass(frozen=True)
class Execute(Simulation):
    """A gantry does all of it (config ``physics=execute``): over the bin, down, suction, up, turn, over the rim, down,
    release, back.

    Losses besides ``collapsed``: ``dropped``, the plate reached no item or lost it; ``effector_contact``, the plate
    touched a wall or another item; ``wedged``, the item is not where it was planned to be at its release.

    Args:
        plate_thickness: of the end effector; m.
        plate_mass: of the end effector; kg.
        lip: length of the suction cup's lip, between plate and item; m.
        release_height: of an item above its planned pose when it is released; m.
        suction: force along any direction that the suction bears; N.
        contact_force: force on the plate from which on a contact counts; N.
        tolerance: of an item's position at release; m.
        speed: of the plate; m/s.
        slow_speed: of the plate on its last centimetres down and its first ones up; m/s.
    """

    plate_thickness: float = 0.01
    plate_mass: float = 2.0
    lip: float = 0.001
    release_height: float = 0.0005
    suction: float = 100.0
    contact_force: float = 5.0
    tolerance: float = 0.005
    speed: float = 1.0
    slow_speed: float = 0.2

    name: ClassVar[str] = "execute"
    limits: ClassVar[dict[str, tuple[float, float]]] = Simulation.limits | {
        "plate_thickness": (1e-3, 1), "plate_mass": (0.01, 100), "lip": (0, 0.01), "release_height": (0, 0.1), "suction": (0, 1e5),
        "contact_force": (0, 1e5), "tolerance": (1e-4, 1), "speed": (0.01, 5), "slow_speed": (0.01, 5),
    }  # fmt: skip

    def place_all(self, plan: Plan, errors: np.ndarray) -> Iterator[tuple["Gantry", Loss | None]]:
        from pickplace.physics.gantry import Gantry  # MuJoCo is an extra

        if plan.bin is None or plan.effector is None:
            raise ValueError(f"physics=execute: episode {plan.episode} has no bin; expected plans with all keys.")
        origin = np.array((plan.tote[0] + BIN_DISTANCE, 0.0))  # of the bin
        gantry = Gantry(self, plan, origin)
        for number, (placement, error) in enumerate(zip(plan.placements, errors, strict=True)):
            gantry.add((*(origin + placement.item), 0.0), bin_size(placement), placement.centre)
            yield gantry, self._carry(gantry, placement, number, origin, error) or self.find_collapsed(gantry)

    def _carry(self, gantry: "Gantry", placement: Placement, number: int, origin, error) -> Loss | None:
        """Carry the item that lies in the bin to its place; return what is lost on the way."""
        height = placement.size[2]
        above = gantry.safe_height + height + HEADROOM  # of the plate's lower face, with an item below it
        pick, place = origin + placement.pick, np.add(placement.place, error)
        turn = placement.rotation / 180 * pi
        top = placement.corner[2] + height
        loss = (
            gantry.move((*pick, above), 0.0)
            or gantry.move((*pick, height + self.lip), 0.0)
            or gantry.grip(number)
            or gantry.move((*pick, above), 0.0)
            or gantry.move((*place, above), turn)
            or gantry.move((*place, top + self.lip + self.release_height), turn)
        )
        if loss:
            return loss
        if np.linalg.norm(gantry.position(number) - placement.centre) > self.tolerance + np.linalg.norm(error):
            return Loss("wedged", number)
        gantry.release()
        loss = gantry.move((*place, above), turn)
        wait(gantry)
        return loss


def bin_size(placement: Placement) -> tuple[float, ...]:
    """Return the sides of an item as it lies in the bin."""
    w, d, h = placement.size
    return (d, w, h) if placement.rotation % 180 else (w, d, h)
