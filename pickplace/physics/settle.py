"""``settle``: items appear slightly above their planned poses, one after the other, and come to rest."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pickplace.physics.plans import EpisodePlan, Placement
from pickplace.physics.scene import Scene
from pickplace.physics.simulation import Loss, Simulation, wait

DROP_HEIGHT = 0.002  # height above its planned pose at which an item appears, m


@dataclass(frozen=True)
class Settle(Simulation):
    """Items appear 2 mm above their planned poses and come to rest, one after the other (config ``physics=settle``)."""

    name: ClassVar[str] = "settle"

    def make_scene(self, plan: EpisodePlan) -> Scene:
        scene = Scene(self.friction, self.density, self.gap, self.sleep, self.contact_damping)
        scene.add_container(plan.tote)
        return scene

    def place(self, scene: Scene, placement: Placement, error: np.ndarray) -> Loss | None:
        corner = np.add(placement.corner, (*error, DROP_HEIGHT))
        scene.add(corner, placement.size, placement.centre, mass=placement.mass)
        wait(scene)
        return None
