"""Hulls of supporting cells: whether they contain an item's centre, or cells.

An item tilts unless the vertical line through its centre passes the hull of what supports it. The hull is never
computed. A point lies in a convex polygon if the polygon reaches as far along the normal of each of its edges. Those of
a hull of cells are parallel to the axes, or to a line from one cell to another: a few directions. For the centre, a
supporting cell reaches beyond it along some of their normals, which is a pattern of bits; the item is stable if the
patterns of its supporting cells cover all of them. That is exact, and as fast as counting for items of up to 3 cells.
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from math import gcd

import torch
from torch import Tensor

BITS = 32  # normals in a word of a pattern
MAX_HULL_SIDE = 16  # longest side of an item with the rules of the hull, in cells: the tables grow with its sixth power


def is_centre_in_hull_of_middles(rows: Iterable[tuple[Tensor, Tensor]], w: Tensor, d: Tensor, side: int) -> Tensor:
    """Return whether the item's centre lies in the hull of the middles of the supporting cells, or on its edge.

    It does if some line between two of these middles passes the centre on its far side along y, and some on its near
    side. Such a line goes from one at ``(-a, b)`` to one at ``(a', b')``, as seen from the centre, and passes at a
    height of the sign of ``b / a + b' / a'``: so the steepest on each side decide, and no pairs are compared.
    """
    exact = torch.float32 if side <= 64 else torch.float64  # tells apart all ratios of whole numbers up to the side
    w, d, lowest = w.short(), d.short(), torch.tensor(-torch.inf, dtype=exact, device=w.device)
    steepest = [[lowest, lowest], [lowest, lowest]]  # to the far side, left and right of the centre; to the near side
    for x, (first, last) in enumerate(rows):
        offset = (2 * x + 1 - w).to(exact)
        gap = torch.where(last >= 0, 0.0, torch.inf).to(exact)
        for parts, beyond in zip(steepest, (2 * last + 1 - d, d - 2 * first - 1), strict=True):
            slope = (beyond - gap) / offset.abs()  # on the line through the centre +-inf, and nan for 0 / 0
            slope = torch.where(slope.isnan(), torch.inf, slope)
            parts[0] = torch.maximum(parts[0], torch.where(offset <= 0, slope, -torch.inf))
            parts[1] = torch.maximum(parts[1], torch.where(offset >= 0, slope, -torch.inf))
    (left, right), (near_left, near_right) = steepest
    return (left + right >= 0) & (near_left + near_right >= 0)


def is_centre_inside(
    cells: Sequence[Tensor] | Tensor, supporting: Tensor, w: Tensor, d: Tensor, margin: float
) -> Tensor:
    """Return whether the item's centre lies inside the hull, further than ``margin`` from its edge."""
    side = round(len(cells) ** 0.5)
    sizes = w.clamp(1, side) - 1, d.clamp(1, side) - 1
    words = [(patterns[:, *sizes], whole[sizes]) for patterns, whole in hull_patterns(side, margin, supporting.device)]
    reached = [torch.zeros_like(supporting, dtype=patterns.dtype) for patterns, _ in words]
    for number, surface in enumerate(cells):
        supports = surface == supporting
        if len(words) == 1:
            reached[0] |= supports * words[0][0][number]
            continue
        # With many words: all bits of a cell that supports, or none, are combined faster than numbers are multiplied.
        supports = supports.int().neg_()
        for bits, (patterns, _) in zip(reached, words, strict=True):
            bits |= supports & patterns[number]
    return torch.stack([bits == whole for bits, (_, whole) in zip(reached, words, strict=True)]).all(0)


def cells_inside(supporting: Tensor, under: Tensor) -> Tensor:
    """Return which cells of squares lie under the items and inside the hull, bool ``[side * side, N]``.

    Args:
        supporting, under: which cells support the item, and which it covers; of that shape, by cell row by row.
    """
    inside = under.clone()
    for along in _extents(round(len(under) ** 0.5), under.device):
        reached = torch.where(supporting, along[:, :, None], along.min() - 1).amax(1, keepdim=True)  # [normals, 1, N]
        inside &= (along[:, :, None] <= reached).all(0)
    return inside


@lru_cache(maxsize=64)
def _extents(side: int, device: torch.device) -> list[Tensor]:
    """Return how far the cells of a square reach along normals, from its corner: int32 ``[BITS, side * side]`` each."""
    near = torch.arange(side)
    ends = torch.stack([near, near + 1])
    furthest = (_normals(side)[:, :, None, None] * ends).amax(2)  # [normals, axis, cell]
    along = furthest[:, 0, :, None] + furthest[:, 1, None, :]
    return [part.int().to(device) for part in along.flatten(1).split(BITS)]


def _normals(side: int) -> Tensor:
    """Return the normals of all edges that a hull of cells of a square can have, int64 ``[normals, 2]``."""
    furthest = max(side - 1, 1)
    steps = range(-furthest, furthest + 1)
    return torch.tensor([(x, y) for x in steps for y in steps if gcd(x, y) == 1])


@lru_cache(maxsize=64)
def hull_patterns(side: int, margin: float, device: torch.device) -> list[tuple[Tensor, Tensor]]:
    """Return the patterns of the cells of every footprint up to ``side x side``, in words of :data:`BITS` normals.

    Args:
        side: longest side of a footprint, in cells.
        margin: distance from the centre that a cell has to pass along a normal, in cells.
        device: place of the tables.

    Returns:
        for each word the patterns of the cells, ``[side * side, side, side]`` by cell, width and depth, 0 for cells
        outside the footprint; and the pattern that covers all normals, ``[side, side]``; of 8, 16 or 32 bits.

    Raises:
        ValueError: for a side beyond :data:`MAX_HULL_SIDE`.
    """
    if side > MAX_HULL_SIDE:
        raise ValueError(
            f"items may be {side} cells long; with support=hull and bearing expected at most {MAX_HULL_SIDE}."
        )
    size, near = torch.arange(1, side + 1), torch.arange(side)
    # Twice the distance from the centre to the near and the far edge of each cell, by cell and size of the footprint.
    ends = torch.stack([2 * near[:, None] - size, 2 * near[:, None] + 2 - size])  # [2, cell, size]
    inside = near[:, None] < size
    inside = inside[:, None, :, None] & inside[None, :, None, :]  # [x, y, w, d]
    words, normals = [], _normals(side)
    for chunk in normals.split(BITS):
        furthest = (chunk[:, :, None, None, None] * ends).amax(2)  # [normals, axis, cell, size]
        along = furthest[:, 0, :, None, :, None] + furthest[:, 1, None, :, None, :]  # [normals, x, y, w, d]
        distance = 2 * margin * chunk.double().norm(dim=1).view(-1, 1, 1, 1, 1)
        beyond = along > distance
        # No edge has the direction from one cell to another that is not in the footprint.
        x, y = chunk.abs()[:, :, None, None].unbind(1)
        fits = ((y < size[:, None]) & (x < size)) | (x + y == 1)
        flags = torch.tensor([1 << bit for bit in range(BITS)])[: len(chunk)]
        pattern = ((beyond & inside & fits[:, None, None]) * flags.view(-1, 1, 1, 1, 1)).sum(0)
        whole = (fits * flags.view(-1, 1, 1)).sum(0)
        dtype = torch.uint8 if len(normals) <= 8 else torch.int16 if len(normals) <= 16 else torch.int32
        words.append((pattern.flatten(0, 1).to(device, dtype), whole.to(device, dtype)))
    return words
