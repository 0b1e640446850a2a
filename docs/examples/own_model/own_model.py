"""A model of one's own: a fully connected policy over all flat actions."""

import torch
from torch import nn

from pickplace.policies.actors import MASKED
from pickplace.policies.networks.depth import clip_depth


class Mlp(nn.Module):
    """Two fully connected layers from both depth maps to the logits of all ``N_a`` flat actions.

    Args:
        rules: the task's sizes; :class:`pickplace.Rules`.
        mask_infeasible: choose among feasible actions only.
        hidden: width of the hidden layer.
    """

    choice_key = "action"  # it chooses among flat actions, not among classes of them
    excludes = None  # no action has probability 0 by construction

    def __init__(self, rules, mask_infeasible: bool, hidden: int = 64):
        super().__init__()
        self.mask_infeasible = mask_infeasible
        self.masks = ("action",) if mask_infeasible else ()  # what the environment must emit
        self.in_keys = ["bin_depth", "tote_depth", *["action_mask"] * mask_infeasible]  # what forward reads
        cells = rules.num_picks + rules.num_places
        self.network = nn.Sequential(nn.Linear(cells, hidden), nn.ReLU(), nn.Linear(hidden, rules.num_actions))
        # It sees every cell. The check of eq. 2 and 3 asks for the side of a square, at most the shortest side.
        self.network.receptive_field = min(*rules.bin_size[:2], *rules.tote_size[:2])

    def forward(self, bin_depth, tote_depth, action_mask=None):
        """Logits, float32 ``[N, N_a]``."""
        maps = torch.cat([bin_depth.flatten(1), clip_depth(tote_depth, 5).flatten(1)], 1)
        logits = self.network(maps)
        return logits if action_mask is None else torch.where(action_mask, logits, MASKED)

    def to_action(self, choice, *_):
        """A flat action of the chosen class: here the choice itself."""
        return choice

    def to_choice(self, action, *_):
        """The class of a flat action: here the action itself."""
        return action

    def action_log_probs(self, bin_depth, tote_depth):
        """Log-probabilities of all flat actions without any mask, ``[N, N_a]``."""
        return self(bin_depth, tote_depth).log_softmax(-1)
