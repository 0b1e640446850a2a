"""Planners that need no training."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pickplace.task.geometry import FAR, Rules
from pickplace.task.items import check_seed


class UniformRandom:
    """Uniform over all ``N_a`` flat actions, feasible or not: where a policy that is trained without a mask begins.

    Args:
        rules: the task's sizes.
        seed: seed of the planner's own generator.
    """

    name = "uniform"

    def __init__(self, rules: Rules, seed: int = 0):
        self.rules, self._generator = rules, torch.Generator().manual_seed(check_seed(seed, "planner.seed"))

    def decide(self, observation: TensorDictBase) -> Tensor:
        """Flat actions, int64 ``[N]``."""
        depth = observation["bin_depth"]
        draw = torch.randint(self.rules.num_actions, (len(depth),), generator=self._generator)
        return draw.to(depth.device)


class RandomFeasible:
    """Uniform over the feasible flat actions.

    Args:
        rules: the task's sizes.
        seed: seed of the planner's own generator.
    """

    name = "random"

    def __init__(self, rules: Rules, seed: int = 0):
        self.rules, self.seed = rules, check_seed(seed, "planner.seed")
        self._generator: torch.Generator | None = None

    def decide(self, observation: TensorDictBase) -> Tensor:
        mask = observation.get("action_mask", None)
        if mask is None:
            mask = self.rules.action_mask(_placements(self.rules, observation))
        if self._generator is None:
            self._generator = torch.Generator(mask.device).manual_seed(self.seed)
        # The k-th feasible action, k uniform: exact for any N_a, unlike a float32 multinomial.
        rank = mask.cumsum(1, dtype=torch.int32)
        draw = torch.rand(len(mask), dtype=torch.float64, device=mask.device, generator=self._generator)
        wanted = (draw * rank[:, -1]).int() + 1
        return torch.searchsorted(rank, wanted[:, None])[:, 0].clamp(max=self.rules.num_actions - 1)


class JointDBL:
    """Deepest-bottom-left over all feasible (pick, place, rotation) triples; not in the paper, and strong.

    Minimises (height of the item's top, footprint y, footprint x); ties go to the lowest flat index.
    """

    name = "joint_dbl"

    def __init__(self, rules: Rules):
        self.rules = rules

    def decide(self, observation: TensorDictBase) -> Tensor:
        rules = self.rules
        tote_w, tote_d, _ = rules.tote_size
        placements = _placements(rules, observation)
        feasible = rules.outcome_mask(placements)  # [N, Q, W_T, D_T]
        x = torch.arange(tote_w, device=feasible.device)[:, None]
        y = torch.arange(tote_d, device=feasible.device)
        # One number that orders (top, y, x); the parities that share the least one are tied.
        order = (placements.top.long() * tote_d + y) * tote_w + x
        order = torch.where(feasible, order, FAR**2).flatten(2)
        best, cell = order.min(2)  # [N, Q]
        least = best.amin(1, keepdim=True)
        highest = rules.num_actions
        action = torch.full_like(least, highest)
        for parity in range(rules.parities):
            reaching = rules.actions_reaching(placements, parity * rules.num_places + cell[:, parity])
            reaching = torch.where((reaching >= 0) & (best[:, parity, None] == least), reaching, highest)
            action = torch.minimum(action, reaching.amin(1, keepdim=True))
        return action[:, 0].clamp(max=highest - 1)


def _placements(rules: Rules, observation: TensorDictBase):
    return rules.placements_from_depth(observation["bin_depth"], observation["tote_depth"], observation["tote_height"])
