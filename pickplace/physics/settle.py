"""``settle``: items appear a little above their planned poses, one after the other, and come to rest."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pickplace.physics.plans import Plan
from pickplace.physics.simulation import Loss, Simulation, wait

if TYPE_CHECKING:
    from pickplace.physics.scene import Scene

HEIGHT = 0.002  # above its planned pose in which an item appears, m


@dataclass(frozen=True)
class Settle(Simulation):
    """Items appear 2 mm above their planned poses and come to rest, one after the other (config ``physics=settle``)."""

    name: ClassVar[str] = "settle"

    def place_all(self, plan: Plan, errors: np.ndarray) -> Iterator[tuple["Scene", Loss | None]]:
        from pickplace.physics.scene import Scene  # MuJoCo is an extra

        scene = Scene(self.friction, self.density, self.gap, self.sleep)
        scene.add_container(plan.tote)
        for placement, error in zip(plan.placements, errors, strict=True):
            scene.add(np.add(placement.corner, (*error, HEIGHT)), placement.size, placement.centre)
            wait(scene)
            yield scene, self.find_collapsed(scene)
