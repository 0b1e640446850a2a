"""A planner of your own: low placements, drawn at random."""

import torch

from pickplace.rules.masks import first_action_reaching, footprint_mask, placing_maps
from pickplace.rules.state import State


class SoftDBL:
    """Draw a feasible footprint with probability ``softmax(-cost / temperature)``; deepest-bottom-left costs least.

    The cost is the height of the item's top; among equal heights, less y costs less, then less x.

    Args:
        cell: the sizes; pickplace passes them.
        temperature: height units; near 0 the cheapest footprint is almost always drawn.
        seed: of the planner's own generator.
    """

    name = "soft_dbl"  # shown in tables and in evaluation.json

    def __init__(self, cell, temperature: float = 0.05, seed: int = 0):
        self.cell, self.temperature = cell, temperature
        self.generator = torch.Generator().manual_seed(seed)

    def decide(self, observation):
        """Return flat actions, int64 ``[N]``."""
        cell, (wide, deep, _) = self.cell, self.cell.tote_size
        maps = placing_maps(cell, State.from_observation(observation))
        feasible = footprint_mask(cell, maps).flatten(1)  # bool [N, Q * W_T * D_T]: footprints that some action reaches
        y, x = torch.arange(deep), torch.arange(wide)[:, None]
        cost = (maps.top + (y * wide + x) / cell.num_places).flatten(1)  # [N, Q * W_T * D_T]
        weight = torch.where(feasible, -cost / self.temperature, -torch.inf).softmax(1)
        footprint = torch.multinomial(weight, 1, generator=self.generator)[:, 0]
        return first_action_reaching(cell, maps, footprint)
