"""The network behind ``model=afterstate``: the volume that a tote will still take, whatever arrives."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.common.validate import (
    MAX_WIDTH,
    check_inputs,
    expect,
    flag,
    number,
    odd_number,
    one_of,
    size_tuple,
    whole_numbers,
)
from pickplace.policies.fcn_grasp.network import DTYPES, matrix_dtype

MAX_GRID = 64  # cells of the network's picture of a tote along each axis
TOTES_AT_ONCE = {"cpu": 4_096, "cuda": 262_144}  # a CPU's caches hold the activations of this many


class ToteValue(nn.Module):
    """Estimates which share of a tote's empty volume will be filled, from the heights of its surface.

    It sees every tote as a picture of ``grid`` cells, whatever its size: a cell of the picture has the greatest height
    of the cells of the tote that it covers, and the heights are told apart in ``grid[2]`` steps of the tote's height.
    So a tote of 30 cells with items of three times the size looks like one of 10. Two more planes mark where the
    surface is not level with the cell before, along x and along y, as items rest on level cells. Two convolutions, the
    second with stride 2, and two linear layers follow.

    Args:
        grid: cells of the picture along x and y, and steps of the height.
        filters: width of the convolutions.
        receptive_field: side of the square that the first convolution sees, odd.
        hidden: width of the linear layer before the output.
        mirrored: whether totes are mirrored, and transposed where they are square, at random while it learns. The value
            is the same, unless items, end effector or reach tell the sides of the tote apart.
        reward_scale: the config's ``reward_scale``; values are volumes times this.
        compute_dtype: as in :class:`~pickplace.policies.fcn_grasp.network.FootprintFcn`.
    """

    in_keys: tuple[str, ...] = ("tote_depth", "tote_height")

    def __init__(
        self,
        grid: tuple[int, int, int] = (10, 10, 10),
        filters: int = 32,
        receptive_field: int = 3,
        hidden: int = 256,
        mirrored: bool = True,
        reward_scale: float = 1.0,
        compute_dtype: str = "auto",
    ):
        super().__init__()
        self.grid = size_tuple("model.actor.grid", grid, 3, MAX_GRID)
        expect(min(self.grid[:2]) > 1, "model.actor.grid", [*self.grid], "at least 2 cells along x and y")
        odd_number("model.actor.receptive_field", receptive_field)
        whole_numbers("model.actor", MAX_WIDTH, filters=filters, hidden=hidden)
        self.mirrored = flag("model.actor.mirrored", mirrored)
        self.reward_scale = number("model.actor.reward_scale", reward_scale)
        self.compute_dtype = one_of("model.actor.compute_dtype", compute_dtype, DTYPES)
        wide, deep, steps = self.grid
        planes = steps + 3
        check_inputs(f"model.actor.receptive_field={receptive_field}", planes * receptive_field**2)
        self.around = nn.Conv2d(planes, filters, receptive_field, padding=receptive_field // 2)
        self.wider = nn.Conv2d(filters, filters, 3, stride=2, padding=1)
        self.hidden = nn.Linear(filters * ((wide + 1) // 2) * ((deep + 1) // 2), hidden)
        self.head = nn.Linear(hidden, 1)
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.constant_(self.head.bias, 0.5)

    def forward(self, tote_depth: Tensor, tote_height: Tensor) -> Tensor:
        """Return the value of each tote, float32 ``[..., 1]``.

        Args:
            tote_depth: remaining height, ``[..., W_T, D_T]``.
            tote_height: ``[..., 1]``.
        """
        batch = tote_depth.shape[:-2]
        depth, height = tote_depth.flatten(0, -3), tote_height.reshape(-1)
        if self.training and torch.is_grad_enabled():
            depth = self._mirror(depth) if self.mirrored else depth
            return self._values(depth, height).view(*batch, 1)
        at_once = TOTES_AT_ONCE.get(depth.device.type, TOTES_AT_ONCE["cpu"])
        parts = zip(depth.split(at_once), height.split(at_once), strict=True)
        return torch.cat([self._values(*part) for part in parts]).view(*batch, 1)

    def _values(self, depth: Tensor, height: Tensor) -> Tensor:
        """Return the value of totes ``[N, W_T, D_T]`` of heights ``[N]``, ``[N]``."""
        dtype = matrix_dtype(self.compute_dtype, depth.device.type)
        with torch.autocast(depth.device.type, dtype, enabled=dtype != torch.float32):
            planes = self._picture(depth, height).to(dtype, memory_format=torch.channels_last)
            x = F.relu(self.wider(F.relu(self.around(planes))))
            x = F.relu(self.hidden(x.flatten(1)))
        return self.reward_scale * depth.sum((1, 2)) * torch.sigmoid(self.head(x.float())[:, 0])

    @torch.no_grad()
    def _picture(self, depth: Tensor, height: Tensor) -> Tensor:
        """Return which cells of the picture rise above each step of the height, a plane of ones, and the edges along x
        and y, bool ``[N, planes, *grid[:2]]``; walls are edges."""
        wide, deep, steps = self.grid
        if depth.shape[1:] != (wide, deep):
            depth = -F.adaptive_max_pool2d(-depth[:, None], (wide, deep))[:, 0]
        raised = steps * (height[:, None, None] - depth)  # in parts of the tote's height, so that it stays exact
        least = torch.arange(steps, device=depth.device)[:, None] * height
        above = raised[:, None] > least.t()[:, :, None, None]
        edges = [
            F.pad(depth.diff(dim=1) != 0, (0, 0, 1, 0), value=True),
            F.pad(depth.diff(dim=2) != 0, (1, 0), value=True),
        ]
        return torch.cat([above, torch.ones_like(above[:, :1]), torch.stack(edges, 1)], 1)

    def _mirror(self, depth: Tensor) -> Tensor:
        """Return the totes in one of the views under which their value is the same, drawn at random."""
        turned, *flips = torch.rand(3).lt(0.5).tolist()
        depth = depth.flip([axis for axis, flipped in zip((1, 2), flips, strict=True) if flipped])
        square = depth.shape[1] == depth.shape[2] and self.grid[0] == self.grid[1]
        return depth.transpose(1, 2) if turned and square else depth
