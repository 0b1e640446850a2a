"""A policy of your own: a fully connected network over all flat actions."""

import torch
from torch import nn

from pickplace.policies.base import MASKED, ActionPolicy
from pickplace.policies.depth import clip_depth


class Mlp(ActionPolicy):
    """Two fully connected layers from both depth maps to the logits of all ``N_a`` flat actions.

    Args:
        cell: the sizes; pickplace passes them.
        mask_infeasible: choose among feasible actions only; pickplace passes ``model.mask_infeasible``.
        hidden: width of the hidden layer.
    """

    def __init__(self, cell, mask_infeasible: bool, hidden: int = 64):
        super().__init__(cell, mask_infeasible)
        inputs = cell.num_picks + cell.num_places
        self.network = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, cell.num_actions))

    def action_scores(self, observation, mask=None):
        """Return a score for each flat action, float32 ``[N, N_a]``; with a mask, ``MASKED`` where it forbids one."""
        maps = observation["bin_depth"], clip_depth(observation["tote_depth"], 5)
        scores = self.network(torch.cat([depth.flatten(1) for depth in maps], 1))
        return scores if mask is None else torch.where(mask, scores, MASKED)
