"""Value networks. A critic is not needed to act, so it may be tied to the sizes it was trained on."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.geometry import Rules
from pickplace.models.conv4d import Conv4dCritic
from pickplace.models.fcn_grasp import ItemConditionedFcn


class OutcomeCritic(nn.Module):
    """The critic beside ``fcn_grasp``: its own convolutions of the same kind, fully connected at the end.

    Args:
        rules: sizes of the bin and the tote.
        channels: maps handed to the fully connected part.
        hidden: width of the fully connected layer.
        network: arguments of :class:`~pickplace.models.fcn_grasp.ItemConditionedFcn`.

    Shapes:
        ``bin_depth [..., W_B, D_B]``, ``tote_depth [..., W_T, D_T]`` -> ``[..., 1]``.
    """

    def __init__(self, rules: Rules, channels: int = 16, hidden: int = 128, **network):
        super().__init__()
        if not isinstance(hidden, int) or isinstance(hidden, bool) or hidden < 1:
            raise ValueError(f"model.critic.hidden={hidden!r}: expected a whole number >= 1.")
        self.network = ItemConditionedFcn(channels, head_std=0.1, **network)
        extra = 1 + 3 * self.network.item_range
        self.join = nn.Linear(channels * rules.num_places + extra, hidden)
        self.value = nn.Linear(hidden, 1)

    def forward(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        batch = tote_depth.shape[:-2]
        bin_depth, tote_depth = bin_depth.flatten(0, -3), tote_depth.flatten(0, -3)
        maps = F.relu(self.network(bin_depth, tote_depth)).flatten(1)
        # Clipping hides how much room is left; the mean depth tells.
        room = tote_depth.mean((1, 2))[:, None] / 5
        code = self.network.item_code(bin_depth)
        return self.value(F.relu(self.join(torch.cat([maps, room, code], 1)))).unflatten(0, batch)


def conv4d_critic(rules: Rules, **network) -> Conv4dCritic:
    """The critic beside ``fcn4d``, for these sizes (config ``model=fcn4d``)."""
    return Conv4dCritic(rules.bin_size, rules.tote_size, **network)
