"""The paper's policy over all flat actions, and the "typical" network that it is compared with."""

import math

import torch
from torch import Tensor, nn

from pickplace.common.capture import is_capturing
from pickplace.policies.base import MASKED, ActionPolicy
from pickplace.policies.fcn4d.network import Conv4dNet
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import split_flat
from pickplace.rules.item import Observation

FEW_PLACES = 64  # up to 8x8, single pairs of a pick and a place are faster than all places of a pick


class Conv4dPolicy(ActionPolicy):
    """Chooses among all ``N_a`` flat actions, by the paper's network.

    Args:
        cell: the sizes.
        mask_infeasible: choose among feasible actions only (the paper does not).
        network: arguments of :class:`~pickplace.policies.fcn4d.network.Conv4dNet`.
    """

    def __init__(self, cell: CellSpec, mask_infeasible: bool = False, **network):
        super().__init__(cell, mask_infeasible)
        self.network = Conv4dNet(4, **network)  # only the first R are used: the weights serve fewer rotations too

    def action_scores(self, observation: Observation, mask: Tensor | None = None) -> Tensor:
        maps, rotations = (observation["bin_depth"], observation["tote_depth"]), self.cell.rotations
        if mask is None or is_capturing():
            every = self.network(*maps).unflatten(1, (-1, 4))[..., :rotations].flatten(1)
            return every if mask is None else torch.where(mask, every, MASKED)
        # Most logits are not needed, nor is most of the arithmetic. In a small tote few places are feasible for a pick.
        if self.cell.num_places <= FEW_PLACES:
            groups = mask.unflatten(1, (-1, rotations))
            index = row, pair = groups.any(2).nonzero(as_tuple=True)
            needed = self.network.pair_logits(*maps, row, pair // self.cell.num_places, pair % self.cell.num_places)
        else:
            groups = mask.unflatten(1, (self.cell.num_picks, -1))
            index = row, pick = groups.any(2).nonzero(as_tuple=True)
            needed = self.network(maps[0][row], maps[1][row], pick)
        needed = needed.unflatten(1, (-1, 4))[..., :rotations].flatten(1)
        logits = needed.new_full(groups.shape, MASKED).index_put(index, needed)
        return torch.where(mask, logits.flatten(1), MASKED)

    def choice_logits(self, observation: Observation, choices: Tensor) -> Tensor:
        row = torch.arange(len(choices), device=choices.device).repeat_interleave(choices.shape[1])
        pick, place, rotation = split_flat(self.cell, choices.flatten())
        logits = self.network.pair_logits(observation["bin_depth"], observation["tote_depth"], row, pick, place)
        return logits.gather(1, rotation[:, None]).view(choices.shape)

    def learning_bytes(self, samples: int | None = None) -> int:
        """Return the approximate bytes of a frame, measured at bins and totes of 5x5 to 12x12."""
        if samples is not None:
            return (1 + samples) * 400 * self.network.filters
        sides = (*self.cell.bin_size[:2], *self.cell.tote_size[:2])
        return 8 * self.network.filters * math.prod(side + 2 for side in sides) + self.acting_bytes

    @property
    def acting_bytes(self) -> int:
        return 40 * self.cell.num_actions

    def check_sizes(self) -> list[str]:
        """Check the paper's conditions on sizes.

        Raises:
            ValueError: if one is not met, because then this policy cannot learn.
        """
        if found := super().check_sizes():
            raise ValueError(" ".join(found))
        return found


class Fcn4d(Conv4dPolicy):
    """The paper's policy (config ``model=fcn4d``; Sec. III); arguments as in :class:`Conv4dPolicy`."""

    score_index = "(((x_B * D_B + y_B) * W_T + x_T) * D_T + y_T) * R + r: pick cell, place cell, quarter turns"
    unmasked_scores = Conv4dPolicy.action_scores


class Typical(Conv4dPolicy):
    """``fcn4d`` with one fully connected layer over all logits (config ``model=typical``; Sec. IV of the paper).

    The layer has ``N_a x N_a`` weights. So it is tied to the sizes in training, and its memory grows with the fourth
    power of the tote's side: 50 MB at ``6x6``, 400 MB at ``10x10``, 32 GB at ``30x30`` with ``R=4``.

    Args: as in :class:`Conv4dPolicy`.

    Raises:
        ValueError: if the layer does not fit into the memory.
    """

    def __init__(self, cell: CellSpec, mask_infeasible: bool = False, **network):
        super().__init__(cell, mask_infeasible, **network)
        try:
            self.join = nn.Linear(cell.num_actions, cell.num_actions)
        except RuntimeError as error:  # torch raises this when memory is short
            size = 4 * cell.num_actions**2 / 1e9
            raise ValueError(
                f"model=typical: its last layer has {cell.num_actions:,}^2 weights, {size:.1f} GB, which memory does "
                "not hold; expected a smaller env.tote_size or env.bin_size."
            ) from error

    def action_scores(self, observation: Observation, mask: Tensor | None = None) -> Tensor:
        logits = self.join(super().action_scores(observation))
        return logits if mask is None else torch.where(mask, logits, MASKED)

    # The last layer needs all logits.
    choice_logits = ActionPolicy.choice_logits

    def learning_bytes(self, samples: int | None = None) -> int:
        return super().learning_bytes()
