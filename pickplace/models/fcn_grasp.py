"""The 2D fully convolutional network behind ``fcn_grasp``: the tote around each cell, given the item."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.geometry import Rules
from pickplace.models.depth import clip_depth


class ItemConditionedFcn(nn.Module):
    """Maps the clipped tote depth and the item's size to maps of the tote's size.

    The depth is clipped as in eq. 4 of the paper, floored, and given as one-hot planes (a cell outside the tote is 0 in
    every plane, so walls need no input of their own). The item's size enters each convolution as a bias. All layers are
    convolutions, so one set of weights serves any tote.

    Args:
        out_channels: number of maps.
        filters: width of the 3x3 layers.
        receptive_field: side of the square that an output cell sees, odd, at least 3; (side - 1) / 2 layers of 3x3.
        hidden: width of the 1x1 layer before the output.
        tote_clip: ``H_1_max`` of eq. 4, in whole cells.
        depth_range: number of one-hot planes: clipped depths from ``tote_clip`` down; lower ones count as the last.
        item_range: sides and heights from this one on look alike.
        head_std: standard deviation of the last layer's initial weights.
        compute_dtype: ``"float32"`` or ``"bfloat16"`` (autocast of the convolutions).

    Shapes:
        ``tote_depth`` float32 ``[N, W_T, D_T]``, ``bin_depth`` float32 ``[N, W_B, D_B]`` -> float32
        ``[N, out_channels, W_T, D_T]``.
    """

    def __init__(
        self,
        out_channels: int,
        filters: int = 48,
        receptive_field: int = 5,
        hidden: int = 64,
        tote_clip: int = 3,
        depth_range: int = 5,
        item_range: int = 3,
        head_std: float = 0.01,
        compute_dtype: str = "float32",
    ):
        super().__init__()
        if not isinstance(receptive_field, int) or receptive_field < 3 or receptive_field % 2 == 0:
            raise ValueError(f"model.receptive_field={receptive_field!r}: expected an odd number >= 3.")
        if compute_dtype not in ("float32", "bfloat16"):
            raise ValueError(f"model.compute_dtype={compute_dtype!r}: expected 'float32' or 'bfloat16'.")
        sizes = {"filters": filters, "hidden": hidden, "depth_range": depth_range, "item_range": item_range}
        for key, value in {**sizes, "tote_clip": tote_clip, "out_channels": out_channels}.items():
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise ValueError(f"model.{key}={value!r}: expected a whole number >= 1.")
        if not isinstance(head_std, (int, float)) or head_std < 0:
            raise ValueError(f"model.head_std={head_std!r}: expected a number >= 0.")
        self.receptive_field = receptive_field
        self.tote_clip, self.depth_range, self.item_range = tote_clip, depth_range, item_range
        self.compute_dtype = getattr(torch, compute_dtype)
        widths = [depth_range] + [filters] * ((receptive_field - 1) // 2)
        pairs = list(zip(widths[:-1], widths[1:], strict=True))
        self.convs = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in pairs)
        self.item_bias = nn.Linear(3 * item_range, filters * len(pairs))
        self.hidden = nn.Conv2d(filters, hidden, 1)
        self.head = nn.Conv2d(hidden, out_channels, 1)
        nn.init.normal_(self.head.weight, std=head_std)
        nn.init.zeros_(self.head.bias)
        self.to(memory_format=torch.channels_last)  # several times faster than NCHW on small maps

    def planes(self, tote_depth: Tensor) -> Tensor:
        """The clipped depth as one-hot planes, float32 ``[N, depth_range, W_T, D_T]``, deepest first."""
        clipped = clip_depth(tote_depth, self.tote_clip)
        index = (self.tote_clip - clipped).long().clamp(0, self.depth_range - 1)
        return F.one_hot(index, self.depth_range).float().permute(0, 3, 1, 2)  # channels last in memory

    def item_code(self, bin_depth: Tensor) -> Tensor:
        """The item's width, depth and height as one-hot codes, float32 ``[N, 3 * item_range]``."""
        item = Rules.read_item(bin_depth)
        size = torch.stack([item.w, item.d, item.h], -1) - 1
        return F.one_hot(size.clamp(0, self.item_range - 1), self.item_range).flatten(1).float()

    def features(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        """Activations before the output layer, ``[N, hidden, W_T, D_T]``."""
        x = self.planes(tote_depth)
        biases = self.item_bias(self.item_code(bin_depth)).chunk(len(self.convs), 1)
        for conv, bias in zip(self.convs, biases, strict=True):
            x = F.relu(conv(x) + bias[:, :, None, None])
        return F.relu(self.hidden(x))

    def forward(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        """The maps, see the shapes above."""
        lower = self.compute_dtype != torch.float32
        with torch.autocast(tote_depth.device.type, self.compute_dtype, enabled=lower):
            return self.head(self.features(bin_depth, tote_depth)).float()
