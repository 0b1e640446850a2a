"""The fully convolutional network behind ``fcn_grasp``: it sees the tote around a footprint."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.common.validate import MAX_WIDTH, check_inputs, number, odd_number, one_of, whole_numbers
from pickplace.policies.depth import ScoredItems, clip_depth
from pickplace.policies.dtypes import DTYPES, matrix_dtype
from pickplace.rules.grasps import split_footprint
from pickplace.rules.gripper.base import reference_cell
from pickplace.rules.maps import rectangle

CHUNK_BYTES = 2**29  # inputs of the first layer that are held at a time when gradients are off
MAX_LEVELS = 255  # levels are uint8
OUTSIDE = -1000  # the depth of a cell that is not in the tote
FAR_DOWN = 10_000  # deeper than any tote

#: Pairs ``(beyond, step)``: more than ``beyond`` rows of a bf16 product are rounded up to a multiple of ``step``. A
#: kernel is prepared and kept for each number of rows, which takes time and memory. Small numbers of rows are
#: rounded up, too: else their products are summed in another order, and the size of the batch decides near ties.
PADDED_ROWS = ((4096, 512), (0, 64))


class FootprintFcn(nn.Module):
    """Scores footprints by the heights around them, relative to the item that would lie there.

    The network is a convolution of ``receptive_field x receptive_field`` and two of ``1x1``, so one set of weights
    serves any tote. It is computed as matrix products over the patches around the requested footprints. A patch is
    centred on its footprint and turned with it, so a turned item looks like one that is not turned. Its cells are
    one-hot. Around the footprint they encode the height above the top that the item would have; under it, the depth of
    the hole that the item would close; outside the tote, nothing. After the patch come five one-hot codes: the item's
    width, depth and height, the headroom above its top (too little, none, or how much), and its height above the
    deepest place of the tote (the clipped depth of eq. 4). Cells that bear no weight are marked, too. With several
    items in the bin the network also sees the mean of the others' codes. The weights of these two inputs start at zero,
    so weights that were trained without them still serve.

    Args:
        out_channels: number of scores of each footprint.
        filters: width of the convolution.
        receptive_field: side of the square that is seen, odd, at least 3; cells.
        hidden: width of the 1x1 layer before the output.
        tote_clip: ``H_1_max`` of eq. 4, in whole cells.
        depth_range: number of clipped depths that have a code.
        headroom_bins: number of headrooms that have a code: too little, none, 1, 2, ...; None: ``depth_range``. A small
            number serves totes that are higher than those in training.
        reach: heights around a footprint are limited to this many cells above and below the item's top.
        item_range: sides and heights from this one on look alike.
        head_std: standard deviation of the last layer's initial weights.
        compute_dtype: ``"float32"``, ``"bfloat16"`` (autocast of the matrix products), or ``"auto"``: bfloat16 where
            the processor has units for it.
    """

    def __init__(
        self,
        out_channels: int = 1,
        /,
        filters: int = 96,
        receptive_field: int = 5,
        hidden: int = 64,
        tote_clip: int = 3,
        depth_range: int = 5,
        reach: int = 3,
        item_range: int = 3,
        head_std: float = 0.01,
        compute_dtype: str = "auto",
        headroom_bins: int | None = None,
    ):
        super().__init__()
        self.headroom_bins = headroom_bins = depth_range if headroom_bins is None else headroom_bins
        self.receptive_field, self.reach = odd_number("model.actor.receptive_field", receptive_field, least=3), reach
        self.tote_clip, self.depth_range, self.item_range = tote_clip, depth_range, item_range
        whole_numbers("model.actor", MAX_WIDTH, filters=filters, hidden=hidden)
        levels = {"tote_clip": tote_clip, "depth_range": depth_range, "item_range": item_range, "reach": reach}
        whole_numbers("model.actor", MAX_LEVELS, **levels, headroom_bins=headroom_bins)
        number("model.actor.head_std", head_std, most=1e3)
        self.compute_dtype = one_of("model.actor.compute_dtype", compute_dtype, DTYPES)
        # Around the footprint -reach .. reach, under it holes 0 .. reach.
        self.planes = max(3 * reach + 2, depth_range, item_range, headroom_bins)
        inputs = self.planes * (receptive_field**2 + 5)
        check_inputs(f"model.actor.receptive_field={receptive_field}, {self.planes} planes", inputs)
        self.patch = nn.Linear(inputs, filters)
        self.weak = nn.Parameter(torch.zeros(filters, receptive_field**2))
        self.rest_of_bin = nn.Parameter(torch.zeros(filters, 3 * item_range))
        self.hidden = nn.Linear(filters, hidden)
        self.head = nn.Linear(hidden, out_channels)
        nn.init.normal_(self.head.weight, std=head_std)
        nn.init.zeros_(self.head.bias)

    def footprint_scores(
        self, bin_depth: Tensor, tote_depth: Tensor, bearing: Tensor, row: Tensor, footprint: Tensor,
        contents: ScoredItems,
    ) -> Tensor:  # fmt: skip
        """Return the scores of the given footprints, float32 ``[M, out_channels]``.

        Args:
            bin_depth, tote_depth: ``[N, W_B, D_B]``, ``[N, W_T, D_T]``.
            bearing: 1 where a cell of the tote bears weight, else 0, ``[N, W_T, D_T]``.
            row: index of the problem, int64 ``[M]``.
            footprint: index ``(quarter_turned * W_T + x) * D_T + y`` of the footprint, int64 ``[M]``.
            contents: the items in the bins, and the number of each footprint's item.
        """
        at_once = CHUNK_BYTES // (4 * self.patch.in_features)
        if not torch.is_grad_enabled() and len(row) > at_once:  # large totes: a part at a time, to save memory
            split = (index.split(at_once) for index in (row, footprint, contents.number))
            parts = ((*part, contents._replace(number=number)) for *part, number in zip(*split, strict=True))
            return torch.cat([self.footprint_scores(bin_depth, tote_depth, bearing, *part) for part in parts])
        dtype, count = matrix_dtype(self.compute_dtype, tote_depth.device.type), row.shape[0]
        lower = dtype != torch.float32
        if lower:
            padding = next((-count % step for beyond, step in PADDED_ROWS if count > beyond), 0)
            row, footprint = (F.pad(index, (0, padding)) for index in (row, footprint))
            contents = contents._replace(number=F.pad(contents.number, (0, padding)))
        x, weak = self._inputs(bin_depth, tote_depth, bearing, row, footprint, contents.sizes(row), dtype)
        with torch.autocast(tote_depth.device.type, dtype, enabled=lower):
            x = self.patch(x) + F.linear(weak, self.weak)
            if contents.items.x.shape[1] > 1:  # else a gradient of zeros would change the norm that clipping sees
                x = x + F.linear(contents.rest_code(row, self.item_range).to(dtype), self.rest_of_bin)
            x = F.relu(self.hidden(F.relu(x)))
        return self.head(x.float())[:count]  # float32: rounding must not make ties of scores that differ a little

    def _inputs(
        self, bin_depth: Tensor, tote_depth: Tensor, bearing: Tensor, row: Tensor, footprint: Tensor,
        sizes: list[Tensor], dtype: torch.dtype,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Return the inputs of the first layer, ``[M, inputs]``: the one-hot cells, then the five codes; and marks of
        the cells that bear no weight, ``[M, side * side]``."""
        side, reach, (w, d, h) = self.receptive_field, self.reach, sizes
        _, wide, long = tote_depth.shape
        quarter_turned, x, y = split_footprint((wide, long), footprint)
        turned = quarter_turned == 1
        # Patches begin some cells before their footprint along the item's own axes, so that it is in their middle.
        before_w, before_d = (reference_cell(side) - reference_cell(size) for size in (w, d))
        margin = side + max(bin_depth.shape[1:])
        stride = long + 2 * margin
        x = x + margin - torch.where(turned, before_d, before_w)
        y = y + margin - torch.where(turned, before_w, before_d)
        tap = torch.arange(side, device=row.device)
        steps = torch.stack([tap[:, None] * stride + tap, tap[:, None] + tap * stride]).flatten(1)
        # Depths as small whole numbers: comparing them takes most of the time.
        small = torch.int32 if torch.compiler.is_exporting() else torch.int16  # onnxruntime lacks int16
        depth = clip_depth(tote_depth, 8_000, floor=-900).to(small)
        deepest = depth.amax((1, 2)).clamp(min=self.tote_clip)[row]
        depth = F.pad(depth, (margin,) * 4, value=OUTSIDE)
        first = (row * (wide + 2 * margin) + x) * stride + y
        cells = steps[turned.long()] + first[:, None]  # [M, side * side]
        seen = depth.flatten()[cells]
        weak = F.pad(1 - bearing, (margin,) * 4).flatten()[cells].to(dtype)
        under = rectangle((side, side), before_w, before_d, w, d).flatten(0, 1).t()
        rest = torch.where(under, seen, FAR_DOWN).amin(1)  # depth of what the item rests on
        headroom = rest - h.to(small)  # above its top
        around = (headroom[:, None] - seen).clamp_(-reach, reach).add_(reach)
        hole = (seen - rest[:, None]).clamp_(0, reach).add_(2 * reach + 1)
        level = torch.where(under, hole, around).masked_fill_(seen == OUTSIDE, self.planes)
        codes = [
            *((size - 1).clamp(0, self.item_range - 1).to(small) for size in sizes),
            (headroom + 1).clamp(0, self.headroom_bins - 1),
            (deepest - rest).clamp(0, self.depth_range - 1),
        ]
        planes = torch.eye(self.planes + 1, self.planes, dtype=dtype, device=row.device)
        return F.embedding(torch.cat([level, torch.stack(codes, 1)], 1).int(), planes).flatten(1), weak
