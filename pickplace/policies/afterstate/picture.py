"""The network behind ``model=afterstate``: it sees totes of any size as pictures of one size."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.common.validate import MAX_WIDTH, check_inputs, expect, odd_number, size_tuple, whole_numbers
from pickplace.policies.afterstate.value import ToteValue
from pickplace.policies.afterstate.waiting import WaitingItems
from pickplace.policies.dtypes import matrix_dtype

MAX_GRID = 64  # cells of the network's picture of a tote along each axis


class PictureValue(ToteValue):
    """Estimates the share of a tote's empty volume that will be filled, from the heights of its surface.

    It sees every tote as a picture of ``grid`` cells. A cell of the picture has the greatest height of the tote's cells
    that it covers, rounded up to one of ``grid[2]`` steps of the tote's height. So a tote of 30 cells with items of
    three times the size looks like one of 10. Items rest on level cells. Therefore two more planes mark edges along x
    and along y, where the height differs from the cell before. Two convolutions, the second with stride 2, and two
    linear layers follow. The first linear layer also sees the items that wait.

    A cell of the picture can look in few ways only. So, without gradients, a CPU finds the terms of the first
    convolution in a table and only adds them. The result is the same up to rounding.

    Args:
        grid: cells of the picture along x and y, and steps of the height.
        filters: width of the convolutions.
        receptive_field: side of the square that the first convolution sees, odd.
        hidden: width of the linear layer before the output.
        **settings: of :class:`~pickplace.policies.afterstate.value.ToteValue`.
    """

    in_keys = ("tote_depth", "tote_height", "items")
    cell_planes: Tensor

    def __init__(
        self,
        grid: tuple[int, int, int] = (10, 10, 10),
        filters: int = 32,
        receptive_field: int = 3,
        hidden: int = 256,
        **settings,
    ):
        super().__init__(**settings)
        self.grid = size_tuple("model.actor.grid", grid, 3, MAX_GRID)
        expect(min(self.grid[:2]) > 1, "model.actor.grid", [*self.grid], "at least 2 cells along x and y")
        odd_number("model.actor.receptive_field", receptive_field)
        whole_numbers("model.actor", MAX_WIDTH, filters=filters, hidden=hidden)
        wide, deep, steps = self.grid
        planes = steps + 3
        check_inputs(f"model.actor.receptive_field={receptive_field}", planes * receptive_field**2)
        self.around = nn.Conv2d(planes, filters, receptive_field, padding=receptive_field // 2)
        self.wider = nn.Conv2d(filters, filters, 3, stride=2, padding=1)
        self.hidden = nn.Linear(filters * ((wide + 1) // 2) * ((deep + 1) // 2), hidden)
        self.waiting = WaitingItems(hidden)
        self.head = nn.Linear(hidden, 1)
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.constant_(self.head.bias, 0.5)
        self.register_buffer("cell_planes", cell_planes(steps), persistent=False)

    def chunk_parts(self, *entries: Tensor) -> Tensor:
        """Return the values, ``[N, 1]``, one part each, of totes ``[N, W_T, D_T]`` with heights ``[N, 1]`` and waiting
        items ``[N, M, 5]``."""
        depth, height, items = entries
        picture, dtype = self._picture(depth, height[:, 0]), matrix_dtype(self.compute_dtype, depth.device.type)
        with torch.autocast(depth.device.type, dtype, enabled=dtype != torch.float32):
            by_table = depth.device.type == "cpu" and dtype == torch.float32  # where it is faster
            by_table &= not (torch.is_grad_enabled() or torch.compiler.is_exporting())
            x = self._around_by_table(picture) if by_table else self.around(self._planes(picture, dtype))
            x = self.wider(x.relu_()).relu_()
            x = (self.hidden(x.flatten(1)) + self.waiting(items, self._scale(depth, height))).relu_()
        return self.reward_scale * depth.sum((1, 2))[:, None] * torch.sigmoid(self.head(x.float()))

    def credit(self, before: Sequence[Tensor], after: Sequence[Tensor]) -> Tensor:
        return torch.ones_like(before[0][:, :1, 0])

    def cells(self, wide: int, deep: int) -> int:
        return self.grid[0] * self.grid[1]

    def learning_bytes(self, wide: int, deep: int) -> int:
        return 8 * (wide * deep + self.cells(wide, deep) * (self.grid[2] + 3 + self.around.out_channels))

    def can_transpose(self, wide: int, deep: int) -> bool:
        return wide == deep and self.grid[0] == self.grid[1]

    def _scale(self, depth: Tensor, height: Tensor) -> Tensor:
        """Return the factors that convert sides of items into cells and steps of the picture, float32 ``[N, 3]``."""
        wide, deep, steps = self.grid
        along_z = steps / height[:, 0]
        along_x, along_y = (torch.full_like(along_z, ratio) for ratio in (wide / depth.shape[1], deep / depth.shape[2]))
        return torch.stack([along_x, along_y, along_z], 1)

    @torch.no_grad()
    def _picture(self, depth: Tensor, height: Tensor) -> Tensor:
        """Return pictures, int32 ``[N, *grid[:2]]``: for each cell the row of :func:`cell_planes`. Walls are edges."""
        wide, deep, steps = self.grid
        if depth.shape[1:] != (wide, deep):
            depth = -F.adaptive_max_pool2d(-depth[:, None], (wide, deep))[:, 0]
        above = height[:, None, None]
        above = (steps * (above - depth) / above).ceil_()  # multiplied first, so that whole steps are exact
        above = above.clamp_(0, steps).int()
        along_x = F.pad(depth.diff(dim=1) != 0, (0, 0, 1, 0), value=True)
        along_y = F.pad(depth.diff(dim=2) != 0, (1, 0), value=True)
        return (above * 4).add_(along_x, alpha=2).add_(along_y).add_(1)

    def _planes(self, picture: Tensor, dtype: torch.dtype) -> Tensor:
        """Return the planes of a picture, ``[N, planes, *grid[:2]]``, channels last."""
        return F.embedding(picture, self.cell_planes).to(dtype).permute(0, 3, 1, 2)

    def _around_by_table(self, picture: Tensor) -> Tensor:
        """Return the output of the first convolution, ``[N, filters, *grid[:2]]``, channels last: for each cell the sum
        of table entries of the cells around it."""
        weight, (wide, deep, _) = self.around.weight, self.grid
        side = weight.shape[-1]
        margin = side // 2
        table = self.cell_planes @ weight.permute(2, 3, 1, 0)  # [side, side, rows, filters]
        table[margin, margin] += self.around.get_parameter("bias")  # with the cell itself, which is never outside
        begins = torch.arange(side**2, dtype=torch.int32) * len(self.cell_planes)
        padded = F.pad(picture, [margin] * 4)
        around = [padded[:, x : x + wide, y : y + deep] for x in range(side) for y in range(side)]
        terms = torch.stack(around, -1).view(-1, side**2).add_(begins)
        x = F.embedding_bag(terms, table.flatten(0, 2), mode="sum")
        return x.view(-1, wide, deep, x.shape[1]).permute(0, 3, 1, 2)


def cell_planes(steps: int) -> Tensor:
    """Return the planes of all cells that a picture can have, float32 ``[1 + 4 * (steps + 1), steps + 3]``.

    Row 0 is a cell outside the tote. Row ``1 + 4 * above + 2 * x + y`` is a cell that is ``above`` steps high; x and y
    are 1 if it is an edge along that axis. Columns: one for each step, a 1, and the edges along x and y.
    """
    above, along_x, along_y = torch.meshgrid(torch.arange(steps + 1), *2 * [torch.arange(2)], indexing="ij")
    columns = [*(above > step for step in range(steps)), torch.ones_like(above), along_x, along_y]
    return F.pad(torch.stack([column.flatten() for column in columns], 1).float(), (0, 0, 1, 0))
