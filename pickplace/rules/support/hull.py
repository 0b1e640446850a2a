"""Hulls of supporting cells: whether they contain an item's centre, or cells.

An item tilts unless the vertical line through its centre passes the hull of what supports it. That is asked of every
footprint, and the hull is not computed for it. A point lies in a convex polygon if the polygon reaches as far along the
normal of each of its edges. Those of a hull of cells are parallel to the axes, or to a line from one cell to another: a
few directions. For the centre, a supporting cell reaches beyond it along some of their normals, which is a pattern of
bits; the item is stable if the patterns of its supporting cells cover all of them. That is exact, and as fast as
counting for items of up to 3 cells.

Which cells a hull contains is asked of one footprint of each problem. There it is computed, row by row.
"""

from functools import lru_cache
from math import gcd

import torch
from torch import Tensor

BITS = 32  # normals in a word of a pattern
NONE = -1e4  # reach of a row without a supporting cell
MAX_HULL_SIDE = 16  # longest side of an item with the rules of the hull, in cells: the tables grow with its sixth power


@lru_cache(maxsize=64)
def hull_chords(side: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return what tells how far the hull of cells of a square goes along y, where it passes the edges between its rows.

    There it goes as far as the furthest of the chords from one edge to another. All numbers are whole, so that their
    float32 quotients compare exactly.

    Returns:
        how far each cell of a row goes, to the far side and to the near one (minus its distance from there), ``[2,
        side, 1]``; the weights of a chord's ends where it passes an edge, times its length, ``[(side + 1) * P, side +
        1]``, P chords for each edge; and the lengths, ``[(side + 1) * P, 1]``; float32.
    """
    edges = range(side + 1)
    passing = [[(start, stop) for start in edges for stop in edges if start <= edge <= stop] for edge in edges]
    most = max(map(len, passing))
    start, stop = torch.tensor([pairs + pairs[:1] * (most - len(pairs)) for pairs in passing]).flatten(0, 1).t()
    edge, numbers = torch.arange(side + 1).repeat_interleave(most), torch.arange(len(start))
    weights = torch.zeros(len(start), side + 1)
    weights[numbers, start] = (stop - edge).float()
    weights[numbers, stop] += torch.where(start == stop, 1, edge - start)
    cells = torch.arange(side, dtype=torch.float32)
    bounds = torch.stack([cells + 1, -cells])[:, :, None]
    return bounds.to(device), weights.to(device), weights.sum(1, keepdim=True).to(device)


def _normals(side: int) -> Tensor:
    """Return the normals of all edges that a hull of cells of a square can have, int64 ``[normals, 2]``."""
    steps = range(min(1 - side, -1), max(side, 2))
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
        beyond = along > 2 * margin * chunk.double().norm(dim=1).view(-1, 1, 1, 1, 1)
        # No edge has the direction from one cell to another that is not in the footprint.
        x, y = chunk.abs()[:, :, None, None].unbind(1)
        fits = ((y < size[:, None]) & (x < size)) | (x + y == 1)
        flags = torch.tensor([1 << bit for bit in range(BITS)])[: len(chunk)]
        pattern = ((beyond & inside & fits[:, None, None]) * flags.view(-1, 1, 1, 1, 1)).sum(0)
        whole = (fits * flags.view(-1, 1, 1)).sum(0)
        dtype = torch.uint8 if len(normals) <= 8 else torch.int16 if len(normals) <= 16 else torch.int32
        words.append((pattern.flatten(0, 1).to(device, dtype), whole.to(device, dtype)))
    return words
