"""Depth maps as the networks of the paper see them: clipped to a fixed range, then padded."""

import torch.nn.functional as F
from torch import Tensor


def clip_depth(depth: Tensor, limit: float | None, floor: float | None = None) -> Tensor:
    """Shift each depth map down until nothing in it is greater than ``limit`` (depth clipping, eq. 4).

    ``s - max(max(s) - limit, 0)``, the inner maximum over the whole map of one environment. Differences
    between cells are kept, only the greatest value is bounded, so that a policy serves any tote height. What
    lies further than ``limit`` below the maximum goes negative, as eq. 4 has it; ``floor`` (not in the paper)
    clamps it.

    Args:
        depth: ``[..., W, D]``; every leading dimension is a batch dimension.
        limit: ``H_max`` of eq. 4, or None for no clipping.
        floor: least value of the result, or None for no floor. Applied after the clipping.

    Returns:
        ``[..., W, D]``
    """
    if limit is not None:
        depth = depth - (depth.amax((-2, -1), keepdim=True) - limit).clamp_min(0)
    return depth if floor is None else depth.clamp_min(floor)


def pad_depth(depth: Tensor, cells: int, value: float) -> Tensor:
    """Surround each map ``[..., W, D]`` by ``cells`` cells of ``value``: ``[..., W + 2 cells, D + 2 cells]``.

    The paper pads the bin with -1 and the tote with 0, after clipping and before broadcasting the maps to 4D.
    """
    return F.pad(depth, (cells,) * 4, value=value)
