"""The network behind ``model=afterstate_fcn``: the volume that each cell of a tote will still take."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.common.validate import MAX_WIDTH, number, or_null, whole_number, whole_numbers
from pickplace.policies.afterstate.value import ToteValue
from pickplace.policies.afterstate.waiting import WaitingItems
from pickplace.policies.dtypes import matrix_dtype
from pickplace.rules.state import State

FILLED_BEYOND = 0.93  # share of the volume beyond the horizon that will be filled


class CellsValue(ToteValue):
    """Estimates the share of the empty volume above each cell of a tote that will be filled.

    It is fully convolutional: one set of weights serves any tote. A cell outside the tote looks full, because neither
    an item nor the end effector can go lower there. Planes of the input mark the depth of each cell, the edges along x
    and along y, where the height differs from the cell before, and the cells that bear no weight. A convolution
    follows, then convolutions with stride 2, then residual ones. The residual ones also see the items that wait, and
    the mean over the tote: packing goes on for as long as items have places elsewhere. The last layer has an output for
    each cell that the strides joined.

    The estimate of each cell is a part of the value, and learns from the volume placed on that cell. The parts teach
    more than their sum. In Go, too, a network learns faster if it also predicts the owner of each point (Wu,
    Accelerating Self-Play Learning in Go, 2019).

    Args:
        depth_range: number of levels of depth; deeper cells look alike.
        level: height units of a level.
        patch: side of the squares of cells that the first convolution joins into one.
        stem: width of the first convolution.
        filters: width of the others.
        halvings: number of convolutions with stride 2; with 0 the residual ones are as wide as the first.
        layers: number of residual convolutions.
        horizon: how deep placements are judged in a tote whose mean depth is more than twice this; levels. In
            evaluation mode (``eval()``) such a tote seems to end lower, by whole levels, with this mean depth left.
            Otherwise ``depth_range`` would hide the relief of its surface, and errors of the shares would count too
            much. It should exceed the tallest item. None: every tote is judged to its top.
        **settings: of :class:`~pickplace.policies.afterstate.value.ToteValue`.
    """

    in_keys = ("tote_depth", "tote_bearing", "items")
    cells_at_once = {"cpu": 2**17, "cuda": 2**24}

    def __init__(
        self,
        depth_range: int = 10,
        level: float = 1.0,
        patch: int = 1,
        stem: int = 32,
        filters: int = 64,
        halvings: int = 1,
        layers: int = 2,
        horizon: float | None = None,
        **settings,
    ):
        super().__init__(**settings)
        self.depth_range = whole_number("model.actor.depth_range", depth_range, most=1_000)
        self.level = number("model.actor.level", level, 1e-9)
        whole_numbers("model.actor", MAX_WIDTH, stem=stem, filters=filters)
        whole_number("model.actor.halvings", halvings, 0, 4)
        whole_number("model.actor.layers", layers, 0, 100)
        self.patch = whole_number("model.actor.patch", patch, most=10)
        self.horizon = or_null(number, "model.actor.horizon", horizon, 1)
        self.joined = patch * 2**halvings  # side of the squares of cells that the strides join into one
        self.around = nn.Conv2d(depth_range + 3, stem, patch + 2, patch)
        self.halves = nn.ModuleList(
            nn.Conv2d(filters if number else stem, filters, 3, 2, padding=1) for number in range(halvings)
        )
        width = filters if halvings else stem
        self.layers = nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for _ in range(layers))
        self.means = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))
        self.waiting = WaitingItems(width)
        self.register_buffer("scale", torch.tensor([1.0, 1.0, 1.0 / self.level]), persistent=False)
        self.head = nn.Conv2d(width, self.joined**2, 1)
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.constant_(self.head.get_parameter("bias"), 0.5)

    def judge(self, before: State, *entries: Tensor) -> Tensor:
        if self.training or self.horizon is None:
            return self(*entries)
        depth, *others = entries
        # From the tote before: all placements in it must be judged by the same part of it.
        mean = (before.tote_height - before.heights.flatten(1).float().mean(1))[:, None, None] / self.level
        beyond = torch.where(mean > 2 * self.horizon, (mean - self.horizon).floor() * self.level, 0.0)
        near = torch.where(beyond > 0, (depth - beyond).clamp(min=0), depth)
        return self(near, *others) + self.reward_scale * FILLED_BEYOND * (depth - near).sum((1, 2))[:, None]

    def chunk_parts(self, *entries: Tensor) -> Tensor:
        """Return the volume that each cell will still take, scaled, float32 ``[N, W_T, D_T]``.

        Args:
            entries: the remaining height, ``[N, W_T, D_T]``, height units; 1 where a cell bears weight, else 0; and
                the items that wait, ``[N, M, 5]``.
        """
        depth, bearing, items = entries
        wide, deep = depth.shape[1:]
        dtype = matrix_dtype(self.compute_dtype, depth.device.type)
        with torch.autocast(depth.device.type, dtype, enabled=dtype != torch.float32):
            x = self.around(F.pad(self._planes(depth, bearing, dtype), [1, self.patch] * 2)).relu_()
            for halve in self.halves:
                x = halve(x).relu_()
            x = x + self.waiting(items, self.scale)[:, :, None, None]
            for layer, mean in zip(self.layers, self.means, strict=True):
                x = x + (layer(x) + mean(x.mean((2, 3)))[:, :, None, None]).relu_()
        logits = F.conv2d(x.float(), self.head.weight, self.head.bias)
        share = torch.sigmoid(F.pixel_shuffle(logits, self.joined))[:, 0]
        for axis, side in ((1, wide), (2, deep)):  # a slice would tie an exported network to even or to odd sides
            share = share.index_select(axis, torch.arange(side, device=share.device))
        return self.reward_scale * depth * share

    def learning_bytes(self, wide: int, deep: int) -> int:
        wide, deep = (side + self.joined for side in (wide, deep))
        return 8 * wide * deep * (self.depth_range + self.around.out_channels + self.head.in_channels)

    def credit(self, before: Sequence[Tensor], after: Sequence[Tensor]) -> Tensor:
        """Return equal shares for the cells that change: the item covers these, with the same volume on each."""
        covered = (before[0] != after[0]).float()
        return covered / covered.sum((1, 2), keepdim=True).clamp(min=1)

    @torch.no_grad()
    def _planes(self, depth: Tensor, bearing: Tensor, dtype: torch.dtype) -> Tensor:
        """Return planes ``[N, planes, W_T, D_T]``, channels last: the empty share of each level, the cells that bear no
        weight, and the edges along x and along y."""
        below = torch.arange(self.depth_range, device=depth.device)
        around = F.pad(depth, (1, 0, 1, 0))
        uneven = around.diff(dim=1)[..., 1:] != 0, around.diff(dim=2)[:, 1:] != 0
        levels = (depth[..., None] / self.level - below).clamp_(0, 1)
        return torch.cat([levels, torch.stack([bearing == 0, *uneven], 3)], 3).to(dtype).permute(0, 3, 1, 2)
