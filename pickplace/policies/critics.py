"""Value networks, separate from the policies. They are not needed to act, except by ``planner=lookahead``."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.common.capture import is_capturing
from pickplace.common.validate import MAX_WIDTH, check_inputs, number, odd_number, one_of, refuse_if, whole_numbers
from pickplace.policies.base import MAP_KEYS
from pickplace.policies.depth import clip_depth, item_code
from pickplace.policies.dtypes import DTYPES, matrix_dtype
from pickplace.policies.fcn4d.network import BIN_PADDING, TOTE_PADDING, check_clips, clip_and_pad
from pickplace.policies.fcn_grasp.network import MAX_LEVELS
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Item, read_items
from pickplace.rules.observation import item_keys


class Pooled(nn.Module):
    """The critic of ``fcn_grasp``: the sum of the volumes that the columns of the tote will still take.

    A convolution sees the clipped tote, one-hot (a cell outside it is in no plane). The item's size is added. For each
    cell, ``1x1`` layers then estimate the share of its unclipped depth that will be filled, and a correction. The value
    is the sum over the cells, so one set of weights serves any tote.

    Args:
        cell: the sizes.
        filters: width of the convolution.
        receptive_field: side of the square that is seen around a cell, odd; cells.
        hidden: width of the 1x1 layer before the output.
        tote_clip, depth_range, item_range, compute_dtype: as in :class:`FootprintFcn`; depths in levels.
        level: height units in one level of depth; depths and the item's height are rounded down to levels.
        stride: of the convolution, in cells; more than 1 skips columns, for fine grids.

    Shapes:
        ``bin_depth [..., W_B, D_B]``, ``tote_depth`` and ``tote_bearing [..., W_T, D_T]`` -> ``[..., 1]``. With several
        items in the bin also ``items [..., M, 5]``, of whose codes it sees the mean.
    """

    any_size = True

    def __init__(
        self,
        cell: CellSpec,
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
        whole_numbers("model.critic", MAX_WIDTH, filters=filters, hidden=hidden, level=level, stride=stride)
        levels = {"tote_clip": tote_clip, "depth_range": depth_range, "item_range": item_range}
        whole_numbers("model.critic", MAX_LEVELS, **levels)
        check_inputs(f"model.critic.receptive_field={receptive_field}", depth_range * receptive_field**2)
        self.in_keys, self.level, self.stride = self.keys_for(cell.bin_items), level, stride
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
        levels = (self.tote_clip - clip_depth(tote_depth, self.tote_clip)).clamp(0, self.depth_range - 1)
        planes = torch.arange(self.depth_range, device=levels.device)[:, None, None] == levels.to(torch.uint8)[:, None]
        room = tote_depth[:, :: self.stride, :: self.stride, None] / 5
        dtype = matrix_dtype(self.compute_dtype, tote_depth.device.type)
        with torch.autocast(tote_depth.device.type, dtype, enabled=dtype != torch.float32):
            x = self.around(planes.to(dtype, memory_format=torch.channels_last))
            x = x + F.conv2d(1 - bearing[:, None].to(dtype), self.weak, None, self.stride, len(self.weak[0, 0]) // 2)
            code = self._item_code(read_items(bin_depth, None if items is None else items.flatten(0, -3)))
            x = x.permute(0, 2, 3, 1) + self.item(code.to(dtype))[:, None, None] + room.to(dtype) * self.room.to(dtype)
            x = F.relu(self.hidden(F.relu(x)))
        share, more = self.head(x.float()).unbind(-1)
        return (share * room[..., 0] + more / 5).sum((1, 2)).view(*batch, 1)

    @staticmethod
    def keys_for(bin_items: int) -> tuple[str, ...]:
        """Return the entries of the observation to read for bins with this number of items."""
        return (*MAP_KEYS, *item_keys(bin_items))

    def _item_code(self, items: Item) -> Tensor:
        """Return the mean code of the items ``[N, M]`` in each bin, ``[N, 3 * item_range]``."""
        code = item_code(items, self.item_range, self.level) * items.exists[..., None]
        return code.sum(1) / items.exists.sum(1, keepdim=True).clamp(min=1)


class Conv4d(nn.Module):
    """The value of a state, by a network that shares nothing with the policy.

    The paper only says that the value function has its own network with a fully connected end. The rest is our
    choice. The policy's 4D layers would double the cost of an update. So each map, clipped and padded as for the
    policy, passes two 2D convolutions of ``filters`` ``3x3``, each with a ReLU. A hidden layer with a ReLU and a linear
    output follow. The hidden layer also sees the mean and the greatest *unclipped* remaining depth of the tote: the
    clipped map hides how much is left, and the return depends on it. The fully connected end ties the network to one
    size of bin and tote.

    Args:
        cell: the sizes.
        filters: channels of the 2D convolutions.
        hidden: width of the fully connected layer.
        bin_clip, tote_clip, floor: as in :class:`~pickplace.policies.fcn4d.network.Conv4dNet`.
        depth_scale: divisor of the two unclipped depths.
        compute_dtype: of all but the last layer, as in :class:`~pickplace.policies.fcn4d.network.Conv4dNet`.
    """

    def __init__(
        self,
        cell: CellSpec,
        filters: int = 64,
        hidden: int = 256,
        bin_clip: float | None = 1.0,
        tote_clip: float | None = 5.0,
        floor: float | None = None,
        depth_scale: float = 5.0,
        compute_dtype: str = "float32",
    ):
        super().__init__()
        whole_numbers("model.critic", MAX_WIDTH, filters=filters, hidden=hidden)
        one_of("model.critic.compute_dtype", compute_dtype, DTYPES)
        check_clips("model.critic", bin_clip, tote_clip, floor)
        number("model.critic.depth_scale", depth_scale, 1e-3, 1e6)
        self.bin_size, self.tote_size = cell.bin_size[:2], cell.tote_size[:2]
        self.bin_clip, self.tote_clip, self.floor = bin_clip, tote_clip, floor
        self.depth_scale, self.compute_dtype = depth_scale, compute_dtype
        self.bin_layers = self._map_layers(filters)
        self.tote_layers = self._map_layers(filters)
        cells = math.prod(self.bin_size) + math.prod(self.tote_size)
        self.value = nn.Sequential(nn.Linear(filters * cells + 2, hidden), nn.ReLU(), nn.Linear(hidden, 1))

    @staticmethod
    def _map_layers(filters: int) -> nn.Sequential:
        return nn.Sequential(
            nn.Conv2d(1, filters, 3), nn.ReLU(), nn.Conv2d(filters, filters, 3), nn.ReLU(), nn.Flatten()
        )

    def forward(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        """Return values ``[..., 1]`` of bin depth ``[..., W_B, D_B]`` and tote depth ``[..., W_T, D_T]``."""
        for name, depth, size in (("bin", bin_depth, self.bin_size), ("tote", tote_depth, self.tote_size)):
            refuse_if(
                depth.shape[-2:] != size,
                f"{name}_depth: got {[*depth.shape[-2:]]}, expected {list(size)}, for which the critic was made.",
            )
        batch, dtype = tote_depth.shape[:-2], next(self.parameters()).dtype
        bins = bin_depth.to(dtype).reshape(-1, 1, *self.bin_size)
        totes = tote_depth.to(dtype).reshape(-1, 1, *self.tote_size)
        left = torch.stack((totes.mean((1, 2, 3)), totes.amax((1, 2, 3))), dim=-1) / self.depth_scale
        bins = clip_and_pad(bins, self.bin_clip, self.floor, BIN_PADDING)
        totes = clip_and_pad(totes, self.tote_clip, self.floor, TOTE_PADDING)
        fast = matrix_dtype(self.compute_dtype, bins.device.type)
        bins, row = _distinct(bins)
        weight, bias = self.value[0].parameters()
        with torch.autocast(bins.device.type, fast, enabled=fast != torch.float32):
            of_bin, of_tote = self.bin_layers(bins), torch.cat((self.tote_layers(totes), left), dim=-1)
            by_bin, by_tote = weight.split((of_bin.shape[1], of_tote.shape[1]), dim=1)
            hidden = F.linear(of_bin, by_bin).index_select(0, row) + F.linear(of_tote, by_tote, bias)
        return self.value[1:](hidden.to(dtype)).reshape(*batch, 1)


def _distinct(maps: Tensor) -> tuple[Tensor, Tensor]:
    """Return the different maps among ``[N, 1, W, D]``, and each one's number among these, int64 ``[N]``.

    A single item in a bin has few sizes and places, so a batch has few different bins: about 80 of 1,024. A GPU would
    have to wait for their number.
    """
    if is_capturing() or maps.device.type != "cpu":
        return maps, torch.arange(len(maps), device=maps.device)
    return maps.unique(dim=0, return_inverse=True)
