"""A policy of your own: a fully connected network over all flat actions."""

import torch
from torch import nn

from pickplace.policies.base import MASKED, Policy
from pickplace.policies.depth import clip_depth


class Mlp(Policy):
    """Two fully connected layers from both depth maps to the logits of all ``N_a`` flat actions.

    Args:
        cell: the sizes; pickplace passes them.
        mask_infeasible: choose among feasible actions only; pickplace passes ``model.mask_infeasible``.
        hidden: width of the hidden layer.
    """

    choice_key = "action"  # the choices are the flat actions

    def __init__(self, cell, mask_infeasible: bool, hidden: int = 64):
        super().__init__(cell)
        if mask_infeasible:
            self.masks = ("action",)  # the environment must compute it
            self.in_keys = [*self.in_keys, "action_mask"]  # and `logits` reads it
        self.mask_infeasible = mask_infeasible
        inputs = cell.num_picks + cell.num_places
        self.network = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, cell.num_actions))

    def scores(self, observation):
        """Return a score for each flat action, float32 ``[N, N_a]``."""
        maps = observation["bin_depth"], clip_depth(observation["tote_depth"], 5)
        return self.network(torch.cat([depth.flatten(1) for depth in maps], 1))

    def logits(self, observation):
        scores = self.scores(observation)
        return torch.where(observation["action_mask"], scores, MASKED) if self.mask_infeasible else scores

    def to_action(self, choice, observation):
        return choice

    def to_choice(self, action, observation):
        return action

    def action_log_probs(self, observation):
        return self.scores(observation).log_softmax(-1)
