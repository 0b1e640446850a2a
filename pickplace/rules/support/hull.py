"""Hulls of supporting cells: tables that tell whether they contain an item's centre.

An item tilts unless the vertical line through its centre passes the hull of what supports it. This is tested for every
footprint, without computing the hull: the centre is inside by a margin if in every direction some corner of a
supporting cell lies beyond the margin. Two kinds of tables give the exact answer.

For short items, *patterns*: the edges of the hull have only a few possible normals. A cell's pattern has a bit for each
normal along which the cell reaches beyond the centre. The item is stable if the patterns of its supporting cells
together have all bits. That is as fast as counting for items of up to 3 cells.

For longer items, *arcs*: a corner lies beyond the margin in an open arc of directions. The item is stable if the arcs
of the outermost corners cover the circle. The hull has two such corners on each edge between rows of cells, so the work
grows with the length of a footprint, and the table with its square.
"""

from functools import lru_cache
from math import gcd, pi

import torch
from torch import Tensor

PATTERN_SIDE = 5  # longest side of items with patterns: their 48 normals are bits of one number
WORDS = {8: torch.uint8, 16: torch.int16, 32: torch.int32, 64: torch.int64}
COVERED = 2**30  # rank of a direction beyond the half circle
TIE = 1e-12  # radians; directions that differ by less are equal, as rounding errors are about 1e-15


def exact_dtype(side: int) -> torch.dtype:
    """Return a dtype in which quotients of whole numbers up to ``side`` compare equal only if they are equal."""
    return torch.float32 if side <= 64 else torch.float64


def _normals(side: int) -> Tensor:
    """Return the normals of all edges that a hull of cells of a square can have, int64 ``[normals, 2]``."""
    steps = range(min(1 - side, -1), max(side, 2))
    return torch.tensor([(x, y) for x in steps for y in steps if gcd(x, y) == 1])


@lru_cache(maxsize=64)
def hull_patterns(side: int, margin: float, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the patterns of the cells of every footprint up to ``side x side``, a bit for each normal.

    Args:
        side: longest side of a footprint, in cells, at most :data:`PATTERN_SIDE`.
        margin: distance from the centre that a cell has to pass along a normal, in cells.
        device: place of the tables.

    Returns:
        the patterns of the cells, ``[side * side, side, side]`` by cell, width and depth, 0 for cells outside the
        footprint; and the pattern that covers all normals, ``[side, side]``; of as many bits as are needed.
    """
    size, near, normals = torch.arange(1, side + 1), torch.arange(side), _normals(side)
    # Twice the distance from the centre to the near and the far edge of each cell, by cell and size of the footprint.
    ends = torch.stack([2 * near[:, None] - size, 2 * near[:, None] + 2 - size])  # [2, cell, size]
    inside = near[:, None] < size
    inside = inside[:, None, :, None] & inside[None, :, None, :]  # [x, y, w, d]
    furthest = (normals[:, :, None, None, None] * ends).amax(2)  # [normals, axis, cell, size]
    along = furthest[:, 0, :, None, :, None] + furthest[:, 1, None, :, None, :]  # [normals, x, y, w, d]
    beyond = along > 2 * margin * normals.double().norm(dim=1).view(-1, 1, 1, 1, 1)
    # An edge joins two cells of the footprint, so normals of longer edges do not occur.
    x, y = normals.abs()[:, :, None, None].unbind(1)
    fits = ((y < size[:, None]) & (x < size)) | (x + y == 1)
    flags = torch.tensor([1 << bit for bit in range(len(normals))])
    pattern = ((beyond & inside & fits[:, None, None]) * flags.view(-1, 1, 1, 1, 1)).sum(0)
    whole = (fits * flags.view(-1, 1, 1)).sum(0)
    dtype = next(dtype for bits, dtype in WORDS.items() if len(normals) <= bits)
    return pattern.flatten(0, 1).to(device, dtype), whole.to(device, dtype)


@lru_cache(maxsize=16)
def hull_arcs(side: int, margin: float, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the arc of directions, in a half circle, in which each corner of a cell lies beyond a margin.

    A corner is at ``(x, y)``, in half cells from the item's centre; ``x`` is from ``1 - 2 * side`` to ``side``, and
    ``y`` from ``-side`` to ``side``. A direction is an angle from 0, along x, to 180 degrees; angles between point to
    greater y. Directions are compared by their ranks, so that equal directions compare equal.

    Args:
        side: longest side of a footprint, in cells.
        margin: distance from the centre that a corner must exceed, in cells.
        device: place of the table.

    Returns:
        the ranks at which each corner's arc begins and ends, int32 ``[3 * side * (2 * side + 2)]`` each, by x, then y.
        The arc is open. It begins at 0 if it contains the angle 0, and ends at :data:`COVERED` if it contains 180
        degrees. An empty arc begins beyond that, and so does the first y, which is no corner.
    """
    x = torch.arange(1 - 2 * side, side + 1, dtype=torch.float64)[:, None]
    y = torch.arange(-side - 1, side + 1, dtype=torch.float64)
    distance = (x**2 + y**2).sqrt()
    middle = torch.atan2(y.expand_as(distance), x.expand_as(distance))
    middle = torch.where(middle < -pi / 2, middle + 2 * pi, middle)
    half = torch.acos((2 * margin / distance).clamp(max=1))
    begin, end = middle - half, middle + half
    empty = (half <= TIE) | (end <= TIE) | (begin >= pi - TIE) | (y < -side)
    angles, order = torch.cat([begin[~empty], end[~empty]]).clamp(0, pi).sort()
    ranks = torch.empty(len(order), dtype=torch.int32)
    ranks[order] = 1 + (angles.diff(prepend=angles[:1]) > TIE).cumsum(0, dtype=torch.int32)
    begins, ends = torch.full_like(begin, COVERED + 1, dtype=torch.int32), torch.zeros_like(end, dtype=torch.int32)
    begins[~empty], ends[~empty] = ranks.chunk(2)
    begins[~empty & (begin < -TIE)], ends[~empty & (end > pi + TIE)] = 0, COVERED
    return begins.flatten().to(device), ends.flatten().to(device)
