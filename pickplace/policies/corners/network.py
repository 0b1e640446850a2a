"""The network behind ``model=corners``: what surrounds a footprint, at points that lie relative to the item's size."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.common.validate import MAX_WIDTH, check_inputs, expect, number, whole_numbers
from pickplace.policies.depth import Contents
from pickplace.rules.grasps import split_footprint

PLANES = 6  # of each point, see `CornerNet`
SIZES = 13  # numbers beside the points


class CornerNet(nn.Module):
    """Scores footprints by the heights at points on and around them, in proportion to the item that would lie there.

    A grid of points is laid over the footprint and turned with it, so that a turned item is seen as one that is not
    turned. Along each side of the item, ``inside`` points are spread evenly; beyond each end follow the ``near`` next
    cells, since the width of a gap counts in cells, and one point half an item further. At each point the network sees
    how high the surface is above what the item would rest on, in heights of the item, and whether it is higher than the
    item's top, level with the top, level with what the item rests on, too weak to bear weight, or outside the tote.
    Beside the points come the item's sides and height, how high it rests and how much headroom is left, and how far the
    tote's walls are. No weight depends on the size of the tote or of the item.

    Args:
        filters, hidden: widths of the two hidden layers.
        inside: points along each side of the footprint.
        near: cells beyond each end that are seen one by one.
        item_scale: ``(side, height)`` of a large item, which the network sees as 1; cells and height units.
        head_std: standard deviation of the last layer's initial weights.
    """

    def __init__(
        self,
        filters: int = 128,
        hidden: int = 64,
        inside: int = 4,
        near: int = 4,
        item_scale: tuple[float, float] = (10, 30),
        head_std: float = 0.01,
    ):
        super().__init__()
        whole_numbers("model.actor", MAX_WIDTH, filters=filters, hidden=hidden)
        whole_numbers("model.actor", 64, inside=inside, near=near)
        is_pair = isinstance(item_scale, (list, tuple)) and len(item_scale) == 2
        expect(is_pair, "model.actor.item_scale", item_scale, "[side, height]")
        self.item_scale = tuple(number("model.actor.item_scale", value, 1e-3, 1e6) for value in item_scale)
        number("model.actor.head_std", head_std, most=1e3)
        self.inside, self.near = inside, near
        self.points = inside + 2 * (near + 1)
        inputs = PLANES * self.points**2 + SIZES
        check_inputs(f"model.actor.inside={inside}, near={near}", inputs)
        self.body = nn.Sequential(nn.Linear(inputs, filters), nn.ReLU(), nn.Linear(filters, hidden), nn.ReLU())
        self.head = nn.Linear(hidden, 1)
        nn.init.normal_(self.head.weight, std=head_std)
        nn.init.zeros_(self.head.bias)

    def at(
        self, bin_depth: Tensor, tote_depth: Tensor, bearing: Tensor, row: Tensor, footprint: Tensor,
        contents: Contents,
    ) -> Tensor:  # fmt: skip
        """Return the scores of some footprints, float32 ``[M, 1]``.

        Args:
            bin_depth, tote_depth: ``[N, W_B, D_B]``, ``[N, W_T, D_T]``.
            bearing: 1 where a cell of the tote bears weight, else 0, ``[N, W_T, D_T]``.
            row: int64 ``[M]``, which problem.
            footprint: int64 ``[M]``, which footprint ``(parity * W_T + x) * D_T + y`` of it.
            contents: the items in the bins, and which one each footprint is of.
        """
        return self.head(self.body(self.inputs(bin_depth, tote_depth, bearing, row, footprint, contents)))

    @torch.no_grad()
    def inputs(
        self, bin_depth: Tensor, tote_depth: Tensor, bearing: Tensor, row: Tensor, footprint: Tensor,
        contents: Contents,
    ) -> Tensor:  # fmt: skip
        """Return what the first layer sees, float32 ``[M, inputs]``; arguments as of :meth:`at`."""
        _, wide, deep = tote_depth.shape
        parity, x, y, w, d, h = (
            part[:, None] for part in (*split_footprint((wide, deep), footprint), *contents.sizes(row))
        )
        turned, h = parity == 1, h.float()

        # The points along the item's width and depth, as cells of the tote: outside it, a cell of the margin.
        begin_w, begin_d = torch.where(turned, y, x), torch.where(turned, x, y)
        size_w, size_d = torch.where(turned, deep, wide), torch.where(turned, wide, deep)
        along = torch.minimum((begin_w + self._points(w)).clamp(min=-1), size_w) + 1  # [M, points]
        across = torch.minimum((begin_d + self._points(d)).clamp(min=-1), size_d) + 1
        stride = deep + 2
        step_w, step_d = torch.where(turned, 1, stride), torch.where(turned, stride, 1)
        origin = (row * ((wide + 2) * stride))[:, None]
        cells = (origin + along * step_w)[:, :, None] + (across * step_d)[:, None]  # [M, points, points]
        maps = (tote_depth, 1.0 - bearing, torch.ones_like(tote_depth))
        depth, weak, inside = (F.pad(each, (1, 1, 1, 1)).flatten()[cells] for each in maps)

        # The cells of a square that holds any item; those beyond the footprint stand for its last row or column.
        step = torch.arange(torch.sym_max(*bin_depth.shape[1:]), device=row.device)
        wx, wy = torch.where(turned, d, w), torch.where(turned, w, d)
        column = (x + torch.minimum(step, wx - 1)).clamp(max=wide - 1)
        line = (y + torch.minimum(step, wy - 1)).clamp(max=deep - 1)
        under = (row[:, None] * wide + column)[:, :, None] * deep + line[:, None]
        rest = tote_depth.flatten()[under].amin((1, 2))[:, None]  # depth of what the item rests on, [M, 1]
        above = (rest[..., None] - depth) / h[..., None]  # of the surface, in heights of the item
        levels = [above.clamp(-1.5, 1.5), above > 1, above == 1, (above == 0) * (1 - weak)]
        planes = [*(level * inside for level in levels), weak, 1 - inside]
        side, height = self.item_scale
        # The depth of the deepest place, and of the floor, tell how high the item lies.
        deepest = tote_depth.amax((1, 2))[row][:, None]
        walls = [begin_w / w, (size_w - begin_w - w) / w, begin_d / d, (size_d - begin_d - d) / d]
        sizes = [w / side, d / side, h / height, (w * d) / side**2, (rest - h) / h, rest / height, (deepest - rest) / h]
        flags = [(rest == h).float(), (deepest == rest).float()]
        return torch.cat([torch.stack(planes, 1).flatten(1), torch.cat([*sizes, *walls, *flags], 1).clamp(max=3)], 1)

    def _points(self, side: Tensor) -> Tensor:
        """Return the points along sides of an item ``[M, 1]``, in cells from its beginning, int64 ``[M, points]``."""
        near = torch.arange(1, self.near + 1, device=side.device).expand(side.shape[0], -1)
        beyond = torch.cat([near, self.near + (side + 1) // 2], 1)
        within = (2 * torch.arange(self.inside, device=side.device) + 1) * side // (2 * self.inside)
        return torch.cat([-beyond.flip(1), within, side - 1 + beyond], 1)
