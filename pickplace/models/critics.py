"""Value networks. A critic is not needed to act, so it may be tied to the sizes it was trained on."""

import torch
from torch import Tensor, nn

from pickplace.geometry import Rules
from pickplace.models.conv4d import Conv4dCritic, check_width
from pickplace.models.depth import depth_levels, item_code, one_hot


class DepthCritic(nn.Module):
    """The critic beside ``fcn_grasp``: fully connected over the one-hot clipped tote and the item's size.

    It shares nothing with the policy, and is tied to the tote's size; acting needs no value.

    Args:
        rules: sizes of the tote.
        filters: width of the first layer, which sees the whole tote.
        hidden: width of the second.
        tote_clip, depth_range, item_range: as in :class:`FootprintFcn`.

    Shapes:
        ``bin_depth [..., W_B, D_B]``, ``tote_depth [..., W_T, D_T]`` -> ``[..., 1]``.
    """

    def __init__(
        self,
        rules: Rules,
        filters: int = 256,
        hidden: int = 128,
        tote_clip: int = 3,
        depth_range: int = 5,
        item_range: int = 3,
    ):
        super().__init__()
        widths = {"filters": filters, "hidden": hidden, "tote_clip": tote_clip}
        for key, value in {**widths, "depth_range": depth_range, "item_range": item_range}.items():
            check_width(f"model.critic.{key}", value)
        self.tote_clip, self.depth_range, self.item_range = tote_clip, depth_range, item_range
        inputs = depth_range * rules.num_places + 3 * item_range + 1
        self.layers = nn.Sequential(
            nn.Linear(inputs, filters), nn.ReLU(), nn.Linear(filters, hidden), nn.ReLU(), nn.Linear(hidden, 1)
        )

    def forward(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        batch = tote_depth.shape[:-2]
        bin_depth, tote_depth = bin_depth.flatten(0, -3), tote_depth.flatten(0, -3)
        planes = one_hot(depth_levels(tote_depth, self.tote_clip, self.depth_range).flatten(1), self.depth_range)
        room = tote_depth.mean((1, 2))[:, None] / 5  # clipping hides how much room is left
        x = torch.cat([planes, item_code(bin_depth, self.item_range), room], 1)
        return self.layers(x).unflatten(0, batch)


def conv4d_critic(rules: Rules, **network) -> Conv4dCritic:
    """The critic beside ``fcn4d``, for these sizes (config ``model=fcn4d``)."""
    return Conv4dCritic(rules.bin_size, rules.tote_size, **network)
