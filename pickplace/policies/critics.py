"""Value networks. They share nothing with the policies; acting needs none, but ``planner=lookahead`` asks one."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.common.validate import MAX_WIDTH, check_inputs, odd_number, one_of, whole_number
from pickplace.policies.base import MAP_KEYS
from pickplace.policies.depth import depth_levels, item_code, one_hot
from pickplace.policies.fcn4d.network import Conv4dCritic
from pickplace.policies.fcn_grasp.network import DTYPES, MAX_LEVELS, matrix_dtype
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Item, item_from_depth


class PooledCritic(nn.Module):
    """The critic beside ``fcn_grasp``: the volume that each column of the tote will still take, summed.

    A convolution over the one-hot clipped tote (a cell outside it is in no plane), the item's size added, then ``1x1``
    layers that estimate for each cell which share of its unclipped depth will be filled, and a correction. The sum over
    the cells is the value, so that one set of weights serves any tote.

    Args:
        filters: width of the convolution.
        receptive_field: side of the square that is seen around a cell, odd; cells.
        hidden: width of the 1x1 layer before the output.
        tote_clip, depth_range, item_range, compute_dtype: as in :class:`FootprintFcn`; depths in levels.
        level: height units that one level of depth spans; depths and the item's height are rounded down to levels.
        stride: of the convolution, in cells; on fine grids not every column need be looked at.

    Shapes:
        ``bin_depth [..., W_B, D_B]``, ``tote_depth`` and ``tote_bearing [..., W_T, D_T]``, and of several items in the
        bin ``items [..., M, 5]``, of which it sees the mean -> ``[..., 1]``.
    """

    any_size = True
    in_keys: tuple[str, ...] = MAP_KEYS

    def __init__(
        self,
        filters: int = 32,
        receptive_field: int = 5,
        hidden: int = 32,
        tote_clip: int = 3,
        depth_range: int = 5,
        item_range: int = 3,
        compute_dtype: str = "auto",
        level: int = 1,
        stride: int = 1,
    ):
        super().__init__()
        odd_number("model.critic.receptive_field", receptive_field)
        for key, value in {"filters": filters, "hidden": hidden, "level": level, "stride": stride}.items():
            whole_number(f"model.critic.{key}", value, most=MAX_WIDTH)
        self.level, self.stride = level, stride
        for key, value in {"tote_clip": tote_clip, "depth_range": depth_range, "item_range": item_range}.items():
            whole_number(f"model.critic.{key}", value, most=MAX_LEVELS)
        check_inputs(f"model.critic.receptive_field={receptive_field}", depth_range * receptive_field**2)
        self.tote_clip, self.depth_range, self.item_range = tote_clip, depth_range, item_range
        self.compute_dtype = one_of("model.critic.compute_dtype", compute_dtype, DTYPES)
        self.around = nn.Conv2d(depth_range, filters, receptive_field, stride, padding=receptive_field // 2)
        self.weak = nn.Parameter(torch.zeros(filters, 1, receptive_field, receptive_field))  # see FootprintFcn
        self.item = nn.Linear(3 * item_range, filters, bias=False)
        self.room = nn.Parameter(torch.zeros(filters))
        self.hidden = nn.Linear(filters, hidden)
        self.head = nn.Linear(hidden, 2)
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.zeros_(self.head.bias)

    def forward(
        self, bin_depth: Tensor, tote_depth: Tensor, tote_bearing: Tensor, items: Tensor | None = None
    ) -> Tensor:
        batch = tote_depth.shape[:-2]
        bin_depth, tote_depth, bearing = (maps.flatten(0, -3) for maps in (bin_depth, tote_depth, tote_bearing))
        tote_depth = tote_depth / self.level
        levels = depth_levels(tote_depth, self.tote_clip, self.depth_range)
        planes = one_hot(levels.flatten(1), self.depth_range).view(-1, self.depth_range, *levels.shape[1:])
        room = tote_depth[:, :: self.stride, :: self.stride, None] / 5
        dtype = matrix_dtype(self.compute_dtype, tote_depth.device.type)
        with torch.autocast(tote_depth.device.type, dtype, enabled=dtype != torch.float32):
            x = self.around(planes.to(dtype, memory_format=torch.channels_last))
            x = x + F.conv2d(1 - bearing[:, None].to(dtype), self.weak, None, self.stride, len(self.weak[0, 0]) // 2)
            x = x.permute(0, 2, 3, 1)
            code = self._item_code(bin_depth, None if items is None else items.flatten(0, -3))
            x = x + self.item(code.to(dtype))[:, None, None]
            x = x + room.to(dtype) * self.room.to(dtype)
            x = F.relu(self.hidden(F.relu(x)))
        share, more = self.head(x.float()).unbind(-1)
        value = (share * room[..., 0] + more / 5).sum((1, 2))
        return value.view(*batch, 1)

    @staticmethod
    def keys_for(bin_items: int) -> tuple[str, ...]:
        """Return the entries of the observation to read where a bin holds so many items."""
        return (*MAP_KEYS, "items") if bin_items > 1 else MAP_KEYS

    def _item_code(self, bin_depth: Tensor, items: Tensor | None) -> Tensor:
        """Return the code of what lies in the bin, ``[N, 3 * item_range]``; of several items the mean."""
        if items is None:
            return item_code(item_from_depth(bin_depth), self.item_range, self.level)
        several = Item.from_table(items)
        code = item_code(several, self.item_range, self.level) * ~several.is_empty[..., None]
        return code.sum(1) / (~several.is_empty).sum(1, keepdim=True).clamp(min=1)


def pooled_critic(cell: CellSpec, **network) -> PooledCritic:
    """Return the critic beside ``fcn_grasp``, for any sizes (config ``model=fcn_grasp``)."""
    critic = PooledCritic(**network)
    critic.in_keys = critic.keys_for(cell.bin_items)
    return critic


def conv4d_critic(cell: CellSpec, **network) -> Conv4dCritic:
    """Return the critic beside ``fcn4d``, for these sizes (config ``model=fcn4d``)."""
    return Conv4dCritic(cell.bin_size, cell.tote_size, **network)
