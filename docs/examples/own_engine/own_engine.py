"""A physics engine of your own: no item may bear more than a given load."""

from math import prod

from pickplace.views.motion import Outcome


class LoadLimit:
    """Count the whole mass of an item on every item that lies anywhere below it.

    Args:
        density: of the items, kg/m^3.
        max_load: greatest load of an item, kg.
    """

    name = "load_limit"  # shown in tables and in evaluation.json

    def __init__(self, density: float = 300.0, max_load: float = 0.2):
        self.density, self.max_load = density, max_load

    def carry_out(self, plans, record=()):
        """Yield the outcome of each plan."""
        for plan in plans:
            loads, lost = [], None
            for item in plan.placements:
                for number, other in enumerate(plan.placements[: len(loads)]):
                    if is_above(item, other):
                        loads[number] += self.density * item.volume
                if max(loads, default=0.0) > self.max_load:
                    lost = max(range(len(loads)), key=loads.__getitem__)
                    break
                loads.append(0.0)
            occupancy = sum(item.volume for item in plan.placements[: len(loads)]) / prod(plan.tote)
            ending, during = ("done", None) if lost is None else ("crushed", len(loads))
            yield Outcome(plan.episode, ending, lost, during, placed=len(loads), occupancy=occupancy)


def is_above(item, other) -> bool:
    """Return whether a placement lies above another one, seen from above."""
    shared = [
        min(item.corner[axis] + item.size[axis], other.corner[axis] + other.size[axis])
        - max(item.corner[axis], other.corner[axis])
        for axis in (0, 1)
    ]
    return min(shared) > 1e-6 and item.corner[2] > other.corner[2]
