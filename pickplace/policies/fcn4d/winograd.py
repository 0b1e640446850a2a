"""The second 4D convolution by minimal filtering, with a tenth of the multiplications.

Minimal filtering (Winograd, Arithmetic Complexity of Computations, 1980; Lavin and Gray, Fast Algorithms for
Convolutional Neural Networks, 2016) computes ``m`` outputs of a kernel with three taps by ``m + 2`` multiplications
instead of ``3 m``. Inputs and kernel are multiplied with small constant matrices, then with each other. The products
are multiplied with a third constant matrix. A long axis is cut into tiles of at most 6 outputs.

Three of the four axes are computed like this: both of the place, and pick y. Over pick x the three taps are summed,
because the transformed kernel has to fit into the caches. The result is that of the convolution up to rounding: in
float32 the error is about 5e-6 of the greatest logit.
"""

import functools
import math

import torch
import torch.nn.functional as F
from torch import Tensor

MAX_OUTPUTS = 6  # of a tile along one axis; more points lose digits
POINTS = (0.0, 1.0, -1.0, 0.5, -0.5, 2.0, -2.0)  # where polynomials are evaluated, beside infinity


@functools.lru_cache
def filtering(outputs: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the matrices of minimal filtering: ``last @ ((kernel @ taps) * (first @ inputs))`` is the convolution.

    Args:
        outputs: ``m``, from 1 to :data:`MAX_OUTPUTS`.

    Returns:
        kernel: ``[m + 2, 3]``; float64, as the others.
        first: ``[m + 2, m + 2]``.
        last: ``[m, m + 2]``.
    """

    def evaluation(coefficients: int) -> Tensor:
        points = torch.tensor(POINTS[: outputs + 1], dtype=torch.float64)
        infinity = F.one_hot(torch.tensor([coefficients - 1]), coefficients)
        return torch.cat([points[:, None] ** torch.arange(coefficients), infinity])

    first = torch.linalg.inv(evaluation(outputs + 2)).T
    scale = first.abs().amax(1, keepdim=True)
    return evaluation(3) * scale, first / scale, evaluation(outputs).T.contiguous()


class Tiles:
    """An axis with ``length`` outputs, cut into ``count`` tiles of ``size``."""

    def __init__(self, length: int):
        self.length, self.count = length, math.ceil(length / MAX_OUTPUTS)
        self.size = math.ceil(length / self.count)

    def cut(self, maps: Tensor, dim: int) -> Tensor:
        """Return ``[..., length + 2, ...]`` as overlapping tiles, ``[..., count, ..., size + 2]``."""
        missing = self.size * self.count - self.length
        maps = F.pad(maps.movedim(dim, -1), (0, missing)).movedim(-1, dim)
        return maps.unfold(dim, self.size + 2, self.size)


def tile_count(bin_size: tuple[int, int], tote_size: tuple[int, int]) -> int:
    """Return the number of tiles into which a state is cut."""
    return math.prod(Tiles(length).count for length in (bin_size[1], *tote_size))


class SumConvolution:
    """A 4D convolution ``3x3x3x3`` of ``relu(from_bin + from_tote)``, tile by tile.

    Args:
        weight: kernel over pick x, pick y, place x and place y, ``[out, in, 3, 3, 3, 3]``.
        bin_size, tote_size: ``W, D``, of the outputs.
    """

    def __init__(self, weight: Tensor, bin_size: tuple[int, int], tote_size: tuple[int, int]):
        self.width, self.axes = bin_size[0], [Tiles(length) for length in (bin_size[1], *tote_size)]
        pick, x, y = ([matrix.to(weight) for matrix in filtering(axis.size)] for axis in self.axes)
        self.pick_first, self.pick_last = pick[1:]
        self.place_first, self.place_last = torch.kron(x[1], y[1]), torch.kron(x[2], y[2])
        taps = weight.permute(2, 3, 4, 5, 1, 0).flatten(4).flatten(2, 3)  # [pick x, pick y, place, in * out]
        taps = pick[0] @ (torch.kron(x[0], y[0]) @ taps).flatten(2)
        self.kernel = taps.view(3, -1, *weight.shape[1::-1])  # [pick x, points, in, out]

    def cut(self, from_bin: Tensor, from_tote: Tensor) -> tuple[Tensor, Tensor]:
        """Cut maps ``[N, in, W_B + 2, D_B + 2]`` and ``[N, in, W_T + 2, D_T + 2]`` into the tiles of all states.

        Returns:
            ``[N * tiles, in, W_B + 2, size + 2]`` and ``[N * tiles, in, size + 2, size + 2]``
        """
        pick, x, y = self.axes
        bins = pick.cut(from_bin, 3).permute(0, 3, 1, 2, 4)[:, :, None]
        totes = y.cut(x.cut(from_tote, 2), 3).permute(0, 2, 3, 1, 4, 5).flatten(1, 2)[:, None]
        bins = bins.expand(-1, -1, x.count * y.count, -1, -1, -1)
        return bins.flatten(0, 2), totes.expand(-1, pick.count, -1, -1, -1, -1).flatten(0, 2)

    def tile_values(self) -> int:
        """Return the number of values of each channel that a tile has before its multiplications."""
        return len(self.pick_first) * len(self.place_first) * (self.width + 2)

    def __call__(self, from_bin: Tensor, from_tote: Tensor) -> Tensor:
        """Return the outputs of tiles, ``[pick y, place, pick x, tiles, out]``."""
        from_bin = from_bin.permute(3, 2, 0, 1).contiguous()  # [pick y, pick x, tiles, in]
        from_tote = from_tote.permute(2, 3, 0, 1).flatten(0, 1).contiguous()  # [place, tiles, in]
        points = from_bin.new_empty(len(from_bin), len(from_tote), from_bin[0].numel())
        for row, out in zip(from_bin, points, strict=True):  # the sum of one row stays in the cache
            torch.mm(self.place_first, (row + from_tote[:, None]).relu_().flatten(1), out=out)
        points = (self.pick_first @ points.flatten(1)).view(self.kernel.shape[1], self.width + 2, *from_tote.shape[1:])
        taps = [points[:, tap : tap + self.width].flatten(1, 2) for tap in range(3)]
        out = torch.bmm(taps[0], self.kernel[0]).baddbmm_(taps[1], self.kernel[1]).baddbmm_(taps[2], self.kernel[2])
        out = (self.pick_last @ out.view(len(from_bin), -1)).view(len(self.pick_last), len(from_tote), -1)
        out = torch.stack([self.place_last @ row for row in out])
        return out.view(*out.shape[:2], self.width, from_tote.shape[1], -1)

    def join(self, tiles: Tensor) -> Tensor:
        """Join the outputs of all tiles, or values computed from them, into ``[N, W_B, D_B, W_T, D_T, channels]``."""
        pick, x, y = self.axes
        tiles = tiles.view(pick.size, x.size, y.size, self.width, -1, pick.count, x.count, y.count, tiles.shape[-1])
        whole = tiles.permute(4, 3, 5, 0, 6, 1, 7, 2, 8).flatten(2, 3).flatten(3, 4).flatten(4, 5)
        return whole[:, :, : pick.length, : x.length, : y.length]
