"""An observation of your own, and a policy that reads it."""

import torch
from torch import nn

from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.rules.observation import Bounds, Term


class PitDepth(Term):
    """Depth of each tote cell below the lowest of its four neighbours, float32 ``[N, W_T, D_T]``; the rim is a wall."""

    def bounds(self, cell, tallest):
        return Bounds(0, cell.tote_size[2], cell.tote_size[:2])

    def value(self, cell, state):
        count, wide, deep = state.heights.shape
        walled = state.tote_height[:, None, None].expand(count, wide + 2, deep + 2).clone()
        walled[:, 1:-1, 1:-1] = state.heights
        along_x = torch.minimum(walled[:, :-2, 1:-1], walled[:, 2:, 1:-1])
        along_y = torch.minimum(walled[:, 1:-1, :-2], walled[:, 1:-1, 2:])
        return (torch.minimum(along_x, along_y) - state.heights).clamp(min=0).float()


class PitPolicy(FcnGrasp):
    """``fcn_grasp`` with a mask, which also sees the pits around each footprint.

    Args:
        cell: the sizes; pickplace passes them.
        mask_infeasible: must be true; pickplace passes ``model.mask_infeasible``.
        network: settings of ``fcn_grasp``'s network.
    """

    def __init__(self, cell, mask_infeasible: bool, **network):
        super().__init__(cell, mask_infeasible, **network)
        self.in_keys = [*self.in_keys, "pit_depth"]  # the key under which env/pits.yaml lists the term
        # A score for each footprint's first cell.
        self.pits = nn.Conv2d(1, cell.footprint_turns, kernel_size=5, padding=2)

    def scores(self, observation, row, footprint):
        """Return the scores of footprints, float32 ``[M]``; ``row`` is the problem of each."""
        pits = self.pits(observation["pit_depth"][:, None]).flatten(1)  # [N, Q * W_T * D_T]
        return super().scores(observation, row, footprint) + pits[row, footprint % pits.shape[1]]
