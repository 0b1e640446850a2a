"""The paper's policy network: 4D convolutions over (pick x, pick y, place x, place y).

The 4D convolutions are computed exactly, but without a 4D kernel:

* **First layer.** Its two input channels are 2D maps broadcast to 4D: the bin's does not change along the
  place axes, the tote's not along the pick axes. So the layer is two 2D convolutions, whose kernels are the
  4D kernel summed over the other map's taps, and a broadcast sum.
* **Second layer.** A sum over the three taps of the pick x axis, each a 3D convolution over the other axes.
  With pick x outermost in memory, before the batch, each tap's input is a contiguous slice and nothing is
  copied.
  A CPU without units for matrices of bfloat16 acts by :mod:`~pickplace.policies.fcn4d.winograd`, in float32: three
  times as fast as by these 3D convolutions in float32, and 1.6 times as fast as in AVX-512's bfloat16.
* **Head.** ``1x1x1x1`` is a matrix product over the channels.
* **Single pairs** of a pick and a place. Only the features that their logits see are computed, by matrix products with
  the whole kernel.

The parameters are those of the 4D convolutions, though only sums over taps of the first kernel matter. A
kernel stored as these sums would compute the same, but start and learn differently. Its initial scale would
differ. In the full kernel, each sum has nine entries that receive the same gradient, so one step of an
optimizer moves it nine times as far. Keeping the full kernel keeps the paper's training dynamics.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pickplace.common.validate import MAX_WIDTH, number, one_of, or_null, whole_number
from pickplace.policies.depth import clip_depth
from pickplace.policies.dtypes import DTYPES, has_matrix_unit, matrix_dtype
from pickplace.policies.fcn4d.winograd import SumConvolution, tile_count

BIN_PADDING, TOTE_PADDING = -1.0, 0.0
MAX_DEPTH = 10_000  # height units; deeper than any tote
PAIRS_AT_ONCE = {"cpu": 128, "cuda": 65_536}  # pairs whose hidden activations stay in a CPU's caches
#: Pairs whose features of the first layer are gathered at a time. The gradient of each time fills whole maps.
GATHERED_PAIRS = {"cpu": 8_192, "cuda": 65_536}
FEW_TILES = 4  # for fewer it does not pay to transform the kernel
TILE_BYTES = 8 * 2**20  # of the tiles computed at a time, which stay in the caches
PADDED_PAIRS = 64  # the number of pairs is rounded up to a multiple; see PADDED_ROWS in fcn_grasp/network.py


def check_clips(place: str, bin_clip: float | None, tote_clip: float | None, floor: float | None) -> None:
    """Refuse limits of depth clipping that are no depths; ``place`` is their place in the config."""
    or_null(number, f"{place}.bin_clip", bin_clip, 0, MAX_DEPTH)
    or_null(number, f"{place}.tote_clip", tote_clip, 0, MAX_DEPTH)
    or_null(number, f"{place}.floor", floor, -MAX_DEPTH, MAX_DEPTH)


def clip_and_pad(depth: Tensor, limit: float | None, floor: float | None, padding: float) -> Tensor:
    """Return maps ``[..., W, D]`` clipped, see :func:`clip_depth`, and surrounded by two cells of ``padding``."""
    return F.pad(clip_depth(depth, limit, floor), (2,) * 4, value=padding)


class Conv4dParameters(nn.Module):
    """Weight ``[out, in, k, k, k, k]`` and bias ``[out]`` of a 4D convolution, drawn as `nn.Conv2d` does.

    The kernel's axes are pick x, pick y, place x, place y. It only holds them; `Conv4dNet` computes with them.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, *[kernel] * 4))
        self.bias = nn.Parameter(torch.empty(out_channels))
        nn.init.kaiming_uniform_(self.weight, a=math.sqrt(5))
        bound = 1 / math.sqrt(in_channels * kernel**4)
        nn.init.uniform_(self.bias, -bound, bound)


class Conv4dNet(nn.Module):
    """Logits of every (pick, place, rotation) from local information (the paper's policy network).

    Clip (eq. 4), floor, pad by 2 cells (bin -1, tote 0), broadcast to two 4D channels; then valid 4D
    convolutions: ``filters`` of ``3x3x3x3``, ReLU, ``filters`` of ``3x3x3x3``, ReLU, ``rotations`` of
    ``1x1x1x1``. A logit sees 5 x 5 cells of the bin and of the tote. The same weights serve any bin and any
    tote.

    Args:
        rotations: ``R``, output channels.
        filters: channels of the two hidden layers.
        bin_clip: ``H_0_max`` of eq. 4; None for no clipping.
        tote_clip: ``H_1_max`` of eq. 4; None for no clipping, the "4D FCN" that the paper compares with.
        floor: least value of both clipped maps; None, as in the paper, for no floor.
        compute_dtype: dtype of the hidden activations: ``float32`` (strictly, the dtype of the parameters),
            ``bfloat16``, or ``auto``: bfloat16 where the device has units for matrices of it, which are 3 to 5 times as
            fast. Parameters, head and logits stay float32.
        head_std: standard deviation of the head's initial weights; its bias is 0. If it is small, the policy
            starts near uniform. None: PyTorch's default.
        chunk_bytes: bytes of hidden activations held at a time without gradients. Large batches are cut along the
            batch, and a single state that is too large along pick x. The result is the same up to rounding.
    """

    receptive_field = 5

    def __init__(
        self,
        rotations: int,
        /,
        filters: int = 64,
        bin_clip: float | None = 1.0,
        tote_clip: float | None = 5.0,
        floor: float | None = None,
        compute_dtype: str = "float32",
        head_std: float | None = 0.01,
        chunk_bytes: int = 64 * 2**20,
    ):
        super().__init__()
        whole_number("model.actor.filters", filters, most=MAX_WIDTH)
        one_of("model.actor.compute_dtype", compute_dtype, DTYPES)
        check_clips("model.actor", bin_clip, tote_clip, floor)
        or_null(number, "model.actor.head_std", head_std, 0, 1e3)
        whole_number("model.actor.chunk_bytes", chunk_bytes, most=2**30)
        self.rotations, self.filters = rotations, filters
        self.bin_clip, self.tote_clip, self.floor = bin_clip, tote_clip, floor
        self.compute_dtype, self.chunk_bytes = compute_dtype, chunk_bytes
        self.first = Conv4dParameters(2, filters, 3)
        self.second = Conv4dParameters(filters, filters, 3)
        self.head = Conv4dParameters(filters, rotations, 1)
        if head_std is not None:
            nn.init.normal_(self.head.weight, std=head_std)
            nn.init.zeros_(self.head.bias)

    def forward(self, bin_depth: Tensor, tote_depth: Tensor, pick: Tensor | None = None) -> Tensor:
        """Return logits in the flat order of actions: pick x, pick y, place x, place y, rotation.

        Args:
            bin_depth: height above the bin's floor, ``[..., W_B, D_B]``.
            tote_depth: remaining height, ``[..., W_T, D_T]``, same leading dimensions.
            pick: flat pick cells ``x * D_B + y``, ``[...]``, if they are already chosen (the paper's
                individual planning). Then only their part is computed, 10 to 20 times faster on a 5x5 bin.

        Returns:
            ``[..., W_B * D_B * W_T * D_T * R]``, or ``[..., W_T * D_T * R]`` for given pick cells.
        """
        bins, totes = self._prepare(bin_depth, tote_depth)
        if pick is not None:  # the windows around these cells
            pick, field, row = pick.flatten(), self.receptive_field, torch.arange(len(bins), device=bins.device)
            windows, deep = bins.unfold(1, field, 1).unfold(2, field, 1), bin_depth.shape[-1]
            bins = windows[row, pick // deep, pick % deep]
        if torch.compiler.is_exporting():  # in one piece: the number of pieces would depend on the sizes
            out = self._logits(bins, totes)
        elif pick is None and self._uses_tiles(bins, totes):  # a single pick is faster without tiles
            out = self._logits_by_tiles(bins, totes)
        else:
            out = self._logits_by_chunks(bins, totes)
        out = out.flatten(1)
        return out.reshape(*tote_depth.shape[:-2], out.shape[1])

    def pair_logits(self, bin_depth: Tensor, tote_depth: Tensor, row: Tensor, pick: Tensor, place: Tensor) -> Tensor:
        """Return the logits of single pairs of a pick and a place, each from its 5x5 windows of the maps.

        A pair takes 1/900 of the arithmetic of `forward` at a 5x5 bin and a 6x6 tote.

        Args:
            bin_depth: as in `forward`, ``[N, W_B, D_B]``.
            tote_depth: as in `forward`, ``[N, W_T, D_T]``.
            row: the problem of each pair, int64 ``[M]``.
            pick, place: flat cells of each pair, int64 ``[M]``.

        Returns:
            ``[M, rotations]``
        """
        count = len(row)
        row, pick, place = (F.pad(index, (0, -count % PADDED_PAIRS)) for index in (row, pick, place))
        maps = self._first_layer(*self._prepare(bin_depth, tote_depth))
        first = [part.permute(0, 2, 3, 1).flatten(0, 2) for part in maps]
        gathered, at_once = (pairs[row.device.type] for pairs in (GATHERED_PAIRS, PAIRS_AT_ONCE))
        patches = _patches(bin_depth, row, pick).split(gathered), _patches(tote_depth, row, place).split(gathered)
        # [filters, place tap * pick tap * filters]
        kernel = self.second.weight.to(self._dtype).permute(0, 4, 5, 2, 3, 1).flatten(1)
        bias = self.second.bias.to(self._dtype)
        parts = []
        for patch in zip(*patches, strict=True):
            pieces = (F.embedding(index, maps).split(at_once) for index, maps in zip(patch, first, strict=True))
            for from_bin, from_tote in zip(*pieces, strict=True):
                hidden = (from_tote[:, :, None] + from_bin[:, None]).relu_().flatten(1)
                parts.append(F.linear(hidden, kernel, bias).relu_())
        features = torch.cat(parts).to(self.head.weight.dtype)
        return F.linear(features, self.head.weight.flatten(1), self.head.bias)[:count]

    def _prepare(self, bin_depth: Tensor, tote_depth: Tensor) -> tuple[Tensor, Tensor]:
        """Return the maps clipped and padded, ``[N, W + 4, D + 4]`` each, with all leading dimensions in one."""
        bins, totes = (depth.to(self.first.weight.dtype)[None].flatten(0, -3) for depth in (bin_depth, tote_depth))
        bins = clip_and_pad(bins, self.bin_clip, self.floor, BIN_PADDING)
        return bins, clip_and_pad(totes, self.tote_clip, self.floor, TOTE_PADDING)

    def _logits_by_chunks(self, bins: Tensor, totes: Tensor) -> Tensor:
        """Return `_logits` of padded maps, computed piece by piece."""
        rows = bins.shape[1] - 4
        states_at_once, rows_at_once = self._chunk_sizes(bins, totes)
        parts = [
            torch.cat(
                [self._logits(b[:, row : row + rows_at_once + 4], t) for row in range(0, rows, rows_at_once)], dim=1
            )
            for b, t in zip(bins.split(states_at_once), totes.split(states_at_once), strict=True)
        ]
        return torch.cat(parts)

    def _chunk_sizes(self, bins: Tensor, totes: Tensor) -> tuple[int, int]:
        """Return the number of states, and of rows of pick cells of each, to compute at a time."""
        states, rows = len(bins), bins.shape[1] - 4
        if torch.is_grad_enabled():
            return max(states, 1), rows
        element = self._dtype.itemsize
        depth, cells = bins.shape[2] - 2, (totes.shape[1] - 2) * (totes.shape[2] - 2)
        row_bytes = 3 * element * self.filters * depth * cells  # first layer, second layer, one tap of it
        if row_bytes * (rows + 2) <= self.chunk_bytes:
            return self.chunk_bytes // (row_bytes * (rows + 2)), rows
        return 1, max(1, self.chunk_bytes // row_bytes - 2)

    def _hidden(self, bins: Tensor, totes: Tensor) -> Tensor:
        """Return the second layer's activations, ``[W_B, N, D_B, W_T, D_T, C]``, of padded maps ``[N, ...]``."""
        from_bin, from_tote = self._first_layer(bins, totes)
        from_tote = from_tote.permute(0, 2, 3, 1).contiguous()  # [N, W_T + 2, D_T + 2, filters]
        if bins.shape[1:] == (5, 5):
            return self._convolve_one_pick(from_bin.permute(0, 2, 3, 1).contiguous(), from_tote)
        from_bin = from_bin.permute(2, 0, 3, 1).contiguous()  # [W_B + 2, N, D_B + 2, filters]
        # One axis after the other: the gradient is then summed over one axis at a time, which is six times as fast.
        from_tote = from_tote[:, None].expand(-1, from_bin.shape[2], -1, -1, -1)
        from_tote = from_tote[None].expand(from_bin.shape[0], -1, -1, -1, -1, -1)
        hidden = (from_bin[:, :, :, None, None] + from_tote).relu_()

        rows, weight = hidden.shape[0] - 2, self.second.weight.to(self._dtype)

        def convolve(tap: int, bias: Tensor | None = None) -> Tensor:
            volume = hidden[tap : tap + rows].flatten(0, 1).permute(0, 4, 1, 2, 3)  # a channels-last view
            kernel = weight[:, :, tap].contiguous(memory_format=torch.channels_last_3d)
            return F.conv3d(volume, kernel, bias)

        out = convolve(0, self.second.bias.to(self._dtype)).add_(convolve(1)).add_(convolve(2))
        return out.relu_().permute(0, 2, 3, 4, 1).unflatten(0, (rows, bins.shape[0]))

    def _uses_tiles(self, bins: Tensor, totes: Tensor) -> bool:
        """Return whether to use minimal filtering: where it is faster, and not with gradients, for which it holds more
        memory."""
        if bins.device.type != "cpu" or torch.is_grad_enabled() or torch.is_autocast_enabled("cpu"):
            return False
        is_exact = self._dtype in (torch.float32, torch.float64)  # in lower precision the transforms lose many digits
        return is_exact and len(bins) * tile_count(*_sizes(bins, totes)) >= FEW_TILES

    def _logits_by_tiles(self, bins: Tensor, totes: Tensor) -> Tensor:
        """Return `_logits` of padded maps by minimal filtering, up to rounding."""
        layer = SumConvolution(self.second.weight, *_sizes(bins, totes))
        tiles = layer.cut(*self._first_layer(bins, totes))
        at_once = max(1, TILE_BYTES // (layer.tile_values() * self.filters * self._dtype.itemsize))
        parts = [
            self._head(layer(*part).add_(self.second.bias).relu_())
            for part in zip(*(maps.split(at_once) for maps in tiles), strict=True)
        ]
        return layer.join(torch.cat(parts, dim=3))

    @property
    def _dtype(self) -> torch.dtype:
        device = self.first.weight.device.type
        by_vectors = self.compute_dtype == "auto" and device == "cpu" and not has_matrix_unit()
        fast = matrix_dtype("float32" if by_vectors else self.compute_dtype, device)
        return self.first.weight.dtype if fast == torch.float32 else fast

    def _first_layer(self, bins: Tensor, totes: Tensor) -> tuple[Tensor, Tensor]:
        """Return the bin's and the tote's part of the first layer, before its ReLU: ``[N, filters, W + 2, D + 2]``."""
        # The bin's channel is equal under all place taps, the tote's under all pick taps.
        from_bin = F.conv2d(bins[:, None], self.first.weight[:, 0].sum((3, 4))[:, None])
        from_tote = F.conv2d(totes[:, None], self.first.weight[:, 1].sum((1, 2))[:, None], self.first.bias)
        return from_bin.to(self._dtype), from_tote.to(self._dtype)

    def _convolve_one_pick(self, from_bin: Tensor, from_tote: Tensor) -> Tensor:
        """Return the second layer for one pick cell: a 2D convolution, with the pick's taps as further channels.

        Args:
            from_bin, from_tote: the first layer's parts, ``[N, 3, 3, filters]``, ``[N, W_T + 2, D_T + 2, filters]``.
        """
        hidden = (from_bin.flatten(1, 2)[:, None, None] + from_tote[:, :, :, None]).relu_().flatten(3)
        kernel = self.second.weight.to(hidden.dtype).permute(0, 2, 3, 1, 4, 5).flatten(1, 3)
        kernel, bias = kernel.contiguous(memory_format=torch.channels_last), self.second.bias.to(hidden.dtype)
        return F.conv2d(hidden.permute(0, 3, 1, 2), kernel, bias).relu_().permute(0, 2, 3, 1)[None, :, None]

    def _logits(self, bins: Tensor, totes: Tensor) -> Tensor:
        """Return ``[N, W_B, D_B, W_T, D_T, rotations]`` of padded maps."""
        return self._head(self._hidden(bins, totes).to(bins.dtype)).transpose(0, 1)

    def _head(self, hidden: Tensor) -> Tensor:
        return F.linear(hidden, self.head.weight.flatten(1), self.head.bias)


def _sizes(*maps: Tensor) -> list[tuple[int, int]]:
    """Return ``W, D`` of padded maps, without their padding."""
    return [(m.shape[1] - 4, m.shape[2] - 4) for m in maps]


def _patches(maps: Tensor, row: Tensor, cell: Tensor) -> Tensor:
    """Return the flat indices of outputs of the first layer, ``[N, W + 2, D + 2]``, under the 3x3 taps around cells.

    Args:
        maps: ``[N, W, D]``, for its sizes.
        row, cell: map and flat cell, int64 ``[M]``.

    Returns:
        int64 ``[M, 9]``
    """
    wide, long = maps.shape[-2] + 2, maps.shape[-1] + 2
    tap = torch.arange(3, device=row.device)
    first = (row * wide + cell // (long - 2)) * long + cell % (long - 2)
    return first[:, None] + (tap[:, None] * long + tap).flatten()
