"""Contact of an item at rest with what supports it: on the grid, and on a measured surface.

The *supporting cells* are the cells under the footprint that are as high as the highest of them, and bear weight.
"""

from collections.abc import Iterator
from functools import cached_property
from itertools import chain, product
from math import inf
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from pickplace.rules.state import surface_from
from pickplace.rules.support.hull import COVERED, PATTERN_SIDE, exact_dtype, hull_arcs, hull_patterns


class Neighbours(NamedTuple):
    """The boxes in the tote, and where the item comes to rest; for rules with ``sees_boxes``."""

    boxes: Tensor  # int64 [N, L, 6]: x, y, z, w, d, h of the items in the tote, in their order, then zeros
    x: Tensor  # minimum corner of the footprint, broadcastable to the shape of ``Contact.z``, whose last axis is N
    y: Tensor
    h: Tensor  # height of the item, broadcastable to that shape


class Contact:
    """The supporting cells of many items; each quantity is computed when a rule asks for it.

    Args:
        surfaces: surface of each cell of a square at the footprint's minimum corner, row by row, int32: one tensor
            ``[S * S, ...]``, or a tensor for each cell.
        under: whether the item covers these cells, bool, broadcastable.
        z: the height on which the item rests, int32.
        w, d: the footprint's sides, broadcastable; 0 for no item.
        recorded: the boxes in the tote, for rules with ``sees_boxes``; None: they are not known.

    Attributes:
        supporting: the surface of a supporting cell, int32 of the shape of ``z``.
        side: ``S``, side of the square.
    """

    def __init__(
        self, surfaces: Tensor, under: Tensor, z: Tensor, w: Tensor, d: Tensor, recorded: Neighbours | None = None
    ):
        self.surfaces, self.under, self.z, self.w, self.d, self.recorded = surfaces, under, z, w, d, recorded
        self.supporting, self.side = surface_from(z), round(len(under) ** 0.5)

    @property
    def neighbours(self) -> Neighbours:
        """The boxes in the tote; raise ``ValueError`` if they are not known."""
        if self.recorded is None:
            raise ValueError("The state has no boxes, but the stability rule looks at them: expected State.boxes.")
        return self.recorded

    def cells(self) -> Iterator[Tensor]:
        """Yield for each cell of the square, row by row, whether it supports the item, bool of the shape of ``z``."""
        for surface, used in zip(self.surfaces, self.under, strict=True):
            yield (surface == self.supporting) & used

    @property
    def count(self) -> Tensor:
        """The number of supporting cells, of the shape of ``z``."""
        count = torch.zeros_like(self.z)
        for supports in self.cells():
            count += supports
        return count

    def ends(self) -> Iterator[Tensor]:
        """Yield for each row of the square along y how far its supporting cells reach, int32 ``[2, *shape of z]``.

        The first number counts the cells from the near side (y = 0) to the last supporting cell, the second one those
        from the far side to the first. Both are 0 in a row without any.
        """
        rows = ((self.surfaces == self.supporting) & self.under).unflatten(0, (self.side, self.side))
        step = torch.arange(self.side, dtype=torch.int32, device=rows.device)[:, None]
        reached = torch.stack([rows * (step + 1), rows * (self.d.int() - step)], 1).amax(2)  # [S, 2, N]
        yield from reached.unbind(0)

    def rows(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield the first and the last supporting cell of each row of the square along y, int32 of the shape of ``z``.

        They are counted from the square's corner. In a row without any, the first is ``side``, and the last is -1.
        """
        for far, near in self.ends():
            yield torch.where(near > 0, self.d.int() - near, self.side), far - 1

    @cached_property
    def share(self) -> Tensor:
        """The supported share of the footprint, float64 of the shape of ``z``."""
        return self.count.double() / (self.w * self.d)

    def corner_surfaces(self) -> Iterator[Tensor]:
        """Yield the surface of the cell in each of the footprint's four corners, int32 of the shape of ``z``."""
        along_x, along_y = ((0 * size, size.clamp(1, self.side) - 1) for size in (self.w, self.d))
        for x, y in product(along_x, along_y):
            yield self.surfaces.gather(0, (x * self.side + y).expand_as(self.z)[None])[0]

    @property
    def num_supported_corners(self) -> Tensor:
        """The number of the footprint's corners that are supported, 0 to 4; one cell may have several corners."""
        return torch.stack([surface == self.supporting for surface in self.corner_surfaces()]).sum(0, dtype=torch.int32)

    @property
    def num_level_corners(self) -> Tensor:
        """The number of the footprint's corners whose cells are as high as the highest of them, supported or not."""
        heights = torch.stack([*self.corner_surfaces()]) >> 1
        return (heights == heights.amax(0)).sum(0, dtype=torch.int32)

    def is_centre_in_hull(self, margin: float = 0.0) -> Tensor:
        """Return whether the item's centre lies inside the hull of the supporting cells, bool of the shape of ``z``.

        Args:
            margin: distance from the hull's edge that the centre must exceed, in cells.
        """
        if self.side > PATTERN_SIDE:
            return self._is_centre_among_corners(margin)
        sizes = self.w.clamp(1, self.side) - 1, self.d.clamp(1, self.side) - 1
        table, whole = hull_patterns(self.side, margin, self.supporting.device)
        patterns, reached = table[(slice(None), *sizes)], torch.zeros_like(self.supporting, dtype=table.dtype)
        for surface, pattern in zip(self.surfaces, patterns, strict=True):
            reached |= (surface == self.supporting) * pattern
        return reached == whole[sizes]

    def _is_centre_among_corners(self, margin: float) -> Tensor:
        """Return the same as :meth:`is_centre_in_hull`, for items of any size.

        In the upper and in the lower half circle, find the direction up to which the arcs of corners reach without a
        gap. As a direction turns, the corners that are furthest in it follow one another along x. So each corner is
        visited once, by increasing x, with the table's x mirrored.
        """
        begins, ends = hull_arcs(self.side, margin, self.supporting.device)
        w, d = (size.clamp(1, self.side).int() for size in (self.w, self.d))
        columns = 2 * self.side + 2  # of the table
        before = none = torch.zeros_like(self.z, dtype=torch.int32).expand(2, *self.z.shape)
        covered = none + 1
        for x, after in enumerate(chain(self.ends(), [none])):
            furthest = torch.maximum(before, after)  # of the corners on the edge between this row and the one before
            start = (w - 2 * x + 2 * self.side - 1) * columns + self.side + 1 - d
            # Without a corner: the first entry of the table, an empty arc.
            entry = torch.minimum(torch.add(start, furthest, alpha=2), furthest * len(begins)).flatten()
            begin, end = (table.index_select(0, entry).view_as(covered) for table in (begins, ends))
            joins = begin.sub_(covered).bitwise_right_shift_(31)  # all bits, if the arc begins in what is covered
            covered, before = torch.maximum(covered, joins.bitwise_and_(end)), after
        return (covered == COVERED).all(0)

    def is_centre_in_hull_of_middles(self) -> Tensor:
        """Return whether the item's centre lies in the hull of the middles of the supporting cells, or on its edge.

        It does if one line between two of these middles passes the centre on its far side along y, and one on its near
        side. A line from ``(-a, b)`` to ``(a', b')``, relative to the centre, passes on the side given by the sign of
        ``b / a + b' / a'``. So only the steepest slopes on each side count, and no pairs are compared.
        """
        exact = exact_dtype(self.side)
        w, d = self.w.short(), self.d.short()
        left = right = torch.full((), -inf, dtype=exact, device=w.device)  # steepest to the far side, and to the near
        for x, ends in enumerate(self.ends()):
            offset = (2 * x + 1 - w).to(exact)
            beyond = torch.where(ends > 0, 2 * ends - 1 - d, -inf).to(exact)
            slope = beyond / offset.abs()  # on the line through the centre +-inf, and nan for 0 / 0
            slope = torch.where(slope.isnan(), inf, slope)
            left = torch.maximum(left, torch.where(offset <= 0, slope, -inf))
            right = torch.maximum(right, torch.where(offset >= 0, slope, -inf))
        return (left + right >= 0).all(0)

    def is_centre_on_near_edge(self) -> Tensor:
        """Return whether the centre lies on the hull's edge of least y: no supporting cell's middle has a smaller y.

        It is false if all middles are on one line. Valid only for a centre in the hull of the middles or on its edge:
        then such a line passes through the centre, and they lie in one direction from there, or in the opposite one.
        """
        exact = exact_dtype(self.side)
        w, d, nan = self.w.short(), self.d.short(), torch.nan
        before = torch.zeros_like(self.z, dtype=torch.bool)
        least, most = (torch.full_like(self.z, value, dtype=exact) for value in (inf, -inf))
        for x, (last, first) in enumerate(self.ends()):
            offset = (2 * x + 1 - w).to(exact)
            before = before | (2 * first > d + 1)
            for along in (torch.where(last > 0, 2 * last - 1 - d, nan), torch.where(first > 0, d + 1 - 2 * first, nan)):
                slope = along.to(exact) / offset  # nan for the centre's own cell, too
                least = torch.where(slope < least, slope, least)
                most = torch.where(slope > most, slope, most)
        return ~before & (least < most)

    def hull_mask(self) -> Tensor:
        """Return a mask of the cells under the items inside the hull of the supporting cells, bool ``[S * S, N]``.

        Valid only for one footprint of each problem, with ``surfaces`` in one tensor. The hull is followed on its far
        and its near side, from one edge between rows to the next. After each corner comes the corner ahead with the
        steepest slope outwards. Only quotients of whole numbers are compared.
        """
        side, exact = self.side, exact_dtype(self.side)
        step = torch.arange(side + 1, dtype=exact, device=self.z.device).view(-1, 1, 1)
        bounds = torch.stack([step[1:], -step[:-1]])[..., 0]  # of each cell, to the far side and to the near one
        rows = ((self.surfaces == self.supporting) & self.under).view(side, 1, side, -1)
        none = -4.0 * side**2  # so far back that a line from there to the hull begins at the hull's first corner
        reached = torch.where(rows, bounds, none).amax(2)  # by the supporting cells of each row, [S, 2, N]
        reached = F.pad(reached, (0, 0, 0, 0, 1, 1), value=none)
        ends = torch.maximum(reached[:-1], reached[1:])  # of the edges between rows, [S + 1, 2, N]
        at, corner = torch.zeros_like(ends[0]), ends[0]
        hull = [corner]
        for x in range(1, side + 1):
            slopes = (ends[x:] - corner) / (step[x:] - at)
            slope = slopes.amax(0)
            hull.append(corner + slope * (x - at))
            turns = slopes[0] == slope
            at, corner = torch.where(turns, x, at), torch.where(turns, ends[x], corner)
        # Between corners, the hull passes an edge at a multiple of 1 / (their distance), so this is a safe tolerance.
        held = torch.stack(hull) + 0.5 / side
        return (bounds <= torch.minimum(held[:-1], held[1:]).view(side, 2, 1, -1)).all(1).flatten(0, 1)


class Patches:
    """The patches of a measured surface that are wholly under an item, for each place of the item.

    The item may be set down with an error in any direction. A patch counts only if it is under the item despite the
    error. The surface does not move with the error; the item's centre does.

    Args:
        supports: whether the patches carry the item, bool ``[W, D, patches]``; they are those of a rectangle of
            ``[X, Y]``, row by row.
        along: how far a patch reaches from the item's centre in each direction, float64 ``[directions, patches]``.
        cells: cell of the footprint in which each patch lies, row by row, int64 ``[patches]``.
        per_cell: number of patches along a side of a cell.
        slack: greatest error of ``along`` for a direction between two of these, in patches.
        touched: area of the item, in patches.
        error: greatest distance of the item from its place, in patches.
        uncovered: share of each row and of each line of patches that an error to either side uncovers, float64
            ``[2, X]`` and ``[2, Y]``.
        quartered: whether each quarter of the item contains a whole patch, whatever the error.
    """

    #: Least distance of an item's centre from the hull's edge, in patches, as a patch may be covered only in part.
    MARGIN = 1.5

    def __init__(
        self, supports: Tensor, along: Tensor, cells: Tensor, per_cell: int, slack: float, touched: float,
        error: float, uncovered: tuple[Tensor, Tensor], quartered: bool,
    ):  # fmt: skip
        self.supports, self.along, self.cells, self.per_cell = supports, along, cells, per_cell
        self.slack, self.touched, self.error, self.quartered = slack, touched, error, quartered
        self.uncovered, self.always = uncovered, [(part == 0).all(0) for part in uncovered]
        self._inside: dict[float, Tensor] = {}

    @cached_property
    def robust(self) -> tuple[Tensor, Tensor]:
        """``supports`` and ``along`` of the patches that are under the item whatever the error."""
        rows, lines = self.always
        if rows.all() and lines.all():
            return self.supports, self.along
        under = (rows[:, None] & lines).flatten()
        return self.supports[..., under], self.along[:, under]

    @property
    def share(self) -> Tensor:
        """The share of the item that is carried whatever the error, float64 ``[W, D]``."""
        carries = self.supports.double()
        lines = carries.unflatten(-1, [part.shape[1] for part in self.uncovered])
        lost = sum((lines.sum(axis) @ part.t()).amax(-1) for axis, part in zip((-1, -2), self.uncovered, strict=True))
        return (carries.sum(-1) - lost) / self.touched

    @property
    def full(self) -> Tensor:
        """Whether the whole item is carried and stays up whatever the error, bool ``[W, D]``.

        Each quarter of the item must then be carried, as a patch may be covered only in part. (With one patch a cell,
        only level cells bear weight.)
        """
        stays = self.is_centre_in_hull() if self.per_cell == 1 else self.quartered
        return self.supports.all(-1) & stays

    def is_centre_in_hull(self, margin: float = 0.0) -> Tensor:
        """Return whether the item's centre lies inside the hull of what carries it, bool ``[W, D]``.

        A patch that is covered in part counts as whole. The centre may be off by the error, and so may an item below,
        which then sticks out over what carries it.

        Args:
            margin: distance from the hull's edge that the centre must exceed, in cells.
        """
        margin = max(margin * self.per_cell, self.MARGIN if self.per_cell > 1 else 0.0, self.error)
        margin += self.error + self.slack
        if margin not in self._inside:
            supports, along = self.robust
            # [W, D, directions], of which the last is combined.
            self._inside[margin] = (supports.double() @ (along > margin).double().t() > 0).all(-1)
        return self._inside[margin]

    def hull_mask(self) -> Tensor:
        """Return a mask of the patches inside the hull of what carries the item, bool ``[patches]``; of one place.

        With an error, the item may not reach a patch at its edge. If it does, it reaches all patches of the same row
        that are further inside, but perhaps not those of the next rows on that side. So a patch at the edge counts if
        it carries the item, or lies between two patches of its row that do.
        """
        (rows, lines), flags = self.always, self.supports[0, 0]
        supports, along = self.robust
        reached = torch.where(supports[0, 0], along, -inf).amax(1, keepdim=True) if supports.shape[-1] else -inf
        flags = flags.view(len(rows), len(lines))
        held = flags | (self.along <= reached + 1e-9).all(0).view_as(flags)
        for axis, inner in ((0, flags & rows[:, None]), (1, flags & lines)):
            carries = inner.int()
            held |= (carries.cummax(axis).values & carries.flip(axis).cummax(axis).values.flip(axis)).bool()
        return held.flatten()
