"""The base of policies that choose among all flat actions."""

from abc import abstractmethod

from torch import Tensor

from pickplace.policies.base import Policy
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Observation
from pickplace.rules.masks import PlacingMaps, action_mask


class ActionPolicy(Policy):
    """Chooses among all ``N_a`` flat actions, by a score for each.

    Args:
        cell: the sizes.
        mask_infeasible: choose among feasible actions only.
    """

    choice_key = "action"

    def __init__(self, cell: CellSpec, mask_infeasible: bool = False):
        super().__init__(cell, masks=("action",) if mask_infeasible else ())

    @abstractmethod
    def action_scores(self, observation: Observation, mask: Tensor | None = None) -> Tensor:
        """Return logits ``[N, N_a]``; with a mask, bool ``[N, N_a]``, :data:`~pickplace.policies.base.MASKED` where it
        forbids an action."""

    def logits(self, observation: Observation) -> Tensor:
        return self.action_scores(observation, observation["action_mask"] if self.masks else None)

    def to_action(self, choice: Tensor, observation: Observation) -> Tensor:
        return choice

    def to_choice(self, action: Tensor, observation: Observation) -> Tensor:
        return action

    def action_log_probs(self, observation: Observation) -> Tensor:
        return self.action_scores(observation).log_softmax(-1)

    def best_feasible(self, observation: Observation, maps: PlacingMaps) -> Tensor:
        return self.action_scores(observation, action_mask(self.cell, maps)).argmax(1)
