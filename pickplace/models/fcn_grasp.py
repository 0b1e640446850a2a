"""The fully convolutional network behind ``fcn_grasp``: the tote around each cell, given the item."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.models.conv4d import check_width
from pickplace.models.depth import depth_levels, item_code, plane_numbers

PADDED_ROWS = 512  # what bf16 products are rounded up to: one is prepared for each number of rows, which takes time


class ItemConditionedFcn(nn.Module):
    """Maps the clipped tote depth and the item's size to maps of the tote's size.

    A convolution of ``receptive_field x receptive_field``, then two of ``1x1``, so that one set of weights serves any
    tote. It is computed as matrix products over the patches around the cells that are asked for: a masked policy needs
    few of them. The depth is clipped as in eq. 4 of the paper, floored, and given as one-hot planes (a cell outside the
    tote is 0 in every plane, so walls need no input of their own), followed by the one-hot size of the item.

    Args:
        out_channels: number of maps.
        filters: width of the convolution.
        receptive_field: side of the square that an output cell sees, odd, at least 3; cells.
        hidden: width of the 1x1 layer before the output.
        tote_clip: ``H_1_max`` of eq. 4, in whole cells.
        depth_range: number of one-hot planes: clipped depths from ``tote_clip`` down; lower ones count as the last.
        item_range: sides and heights from this one on look alike.
        head_std: standard deviation of the last layer's initial weights.
        compute_dtype: ``"float32"`` or ``"bfloat16"`` (autocast of the matrix products).
    """

    def __init__(
        self,
        out_channels: int,
        filters: int = 96,
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
            check_width(f"model.{key}", value)
        if not isinstance(head_std, (int, float)) or head_std < 0:
            raise ValueError(f"model.head_std={head_std!r}: expected a number >= 0.")
        self.receptive_field = receptive_field
        self.tote_clip, self.depth_range, self.item_range = tote_clip, depth_range, item_range
        self.compute_dtype = getattr(torch, compute_dtype)
        self.patch = nn.Linear(depth_range * receptive_field**2 + 3 * item_range, filters)
        self.hidden = nn.Linear(filters, hidden)
        self.head = nn.Linear(hidden, out_channels)
        nn.init.normal_(self.head.weight, std=head_std)
        nn.init.zeros_(self.head.bias)

    def forward(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        """Bin ``[N, W_B, D_B]`` and tote ``[N, W_T, D_T]`` depth to maps ``[N, out_channels, W_T, D_T]``, float32."""
        places = tote_depth[0].numel()
        cell = torch.arange(len(tote_depth) * places, device=tote_depth.device)
        out = self.at(bin_depth, tote_depth, cell // places, cell % places)
        return out.view(*tote_depth.shape, -1).permute(0, 3, 1, 2)

    def at(self, bin_depth: Tensor, tote_depth: Tensor, row: Tensor, place: Tensor) -> Tensor:
        """The maps' values at some cells only, float32 ``[M, out_channels]``.

        Args:
            row: int64 ``[M]``, which problem.
            place: int64 ``[M]``, which place cell ``x * D_T + y`` of it.
        """
        lower, count = self.compute_dtype != torch.float32, len(row)
        if lower and count > 8 * PADDED_ROWS:
            row, place = (F.pad(index, (0, -count % PADDED_ROWS)) for index in (row, place))
        x = self._inputs(bin_depth, tote_depth, row, place)
        with torch.autocast(tote_depth.device.type, self.compute_dtype, enabled=lower):
            return self.head(F.relu(self.hidden(F.relu(self.patch(x))))).float()[:count]

    def _inputs(self, bin_depth: Tensor, tote_depth: Tensor, row: Tensor, place: Tensor) -> Tensor:
        """The tote around cells as one-hot planes, deepest first, and the item's code, ``[M, inputs]``."""
        side, deep = self.receptive_field, tote_depth.shape[2]
        levels = depth_levels(tote_depth, self.tote_clip, self.depth_range)
        levels = F.pad(levels, (side // 2,) * 4, value=self.depth_range)  # outside: no plane
        _, wide, long = levels.shape
        corner = (row * wide + place // deep) * long + place % deep
        tap = torch.arange(side, device=row.device)
        around = levels.flatten()[corner[:, None] + (tap[:, None] * long + tap).flatten()]
        x = torch.empty(len(row), self.patch.in_features, dtype=self.compute_dtype, device=row.device)
        planes, code = x.split([self.depth_range * side**2, 3 * self.item_range], 1)
        planes = planes.unflatten(1, (self.depth_range, side**2))
        torch.eq(around[:, None], plane_numbers(self.depth_range, row.device), out=planes)
        code.copy_(item_code(bin_depth, self.item_range)[row])
        return x
