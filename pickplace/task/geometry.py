"""The rules of picking and placing, as pure tensor functions on batched height maps.

No TorchRL in here: the environment, the policies, the heuristics and the planners all call these functions, so that
there is one implementation of the rules. Nothing branches on data, so everything can be batched and compiled.

Symbols used in shapes: ``N`` problems in the batch, ``P = W_B * D_B`` pick cells, ``R`` rotations, ``Q`` parities of a
rotation (1 if ``R == 1``, else 2: parity 1 turns footprint and end effector by 90 degrees), ``O`` offsets along one
axis at which the item may lie under the end effector, ``S`` the longest item side that can be gripped.

Two ideas keep the joint feasibility of all ``N_a = P * W_T * D_T * R`` actions cheap:

* the bin matters only through the *grasp class* ``(parity, offset of the item under the rotated end effector)``; many
  pick cells and rotations share one;
* the end effector (EE) collides if and only if the highest thing under it, the rim counting as a wall of height ``H_T``
  around the tote, is higher than the placed item's top. So one maximum over the EE's rectangle decides.

Maps of many problems are kept with the batch last in memory: what is done to them is shifting, and then every inner
loop runs over the problems instead of over a row of a few cells. ``K = O * O`` counts the offsets, ``C = Q * K`` the
grasp classes.
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, reduce
from numbers import Integral
from typing import NamedTuple

import torch
from torch import Tensor

FAR = 1 << 20  # higher than any wall: what lies outside the tote when only the inside is allowed
NEVER = -1  # the "top" of a footprint on which the item cannot rest; no EE clearance is that low


class Failure(IntEnum):
    """Why an episode ended, in the order of the checks."""

    NONE = 0
    PICK_MISS = 1
    BIN_COLLISION = 2
    TOTE_COLLISION = 3
    OVERFLOW = 4
    ITEM_COLLISION = 5
    UNSTABLE = 6
    STUCK = 7


class Item(NamedTuple):
    """One item per problem, lying in its bin: minimum corner ``(x, y)`` and size ``(w, d, h)``, int64 ``[N]`` each.

    A bin in which nothing lies has size ``(0, 0, 0)``.
    """

    x: Tensor
    y: Tensor
    w: Tensor
    d: Tensor
    h: Tensor


class Placements(NamedTuple):
    """Everything that decides which actions succeed in a state; made by :meth:`Rules.placements`."""

    top: Tensor  # int32 [N, Q, W_T, D_T]: height of the item's top with its footprint's min corner there, or NEVER
    clearance: Tensor  # int32 [N, Q, W_T, D_T]: highest thing under the EE when its reference cell is there
    item: Item  # what is picked

    def rows(self, index: Tensor) -> "Placements":
        """Those of some problems, by their numbers, which may come up more than once."""
        return Placements(self.top[index], self.clearance[index], Item(*(part[index] for part in self.item)))


class Step(NamedTuple):
    """The effect of one action; made by :meth:`Rules.apply`."""

    heights: Tensor  # int32 [N, W_T, D_T]
    failure: Tensor  # int64 [N]
    top: Tensor  # int64 [N]: height of the item's top, meaningful without failure
    footprint: Tensor  # int64 [N, 4]: x, y, w, d of the footprint in the tote


def _is_whole(value) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _sizes(name: str, value, count: int) -> tuple[int, ...]:
    """``value`` as a tuple of ``count`` positive ints."""
    try:
        sizes = tuple(int(v) for v in value)
        exact = all(int(v) == v and not isinstance(v, bool) for v in value)
    except (TypeError, ValueError):
        sizes, exact = (), False
    if not exact or len(sizes) != count or min(sizes) < 1 or max(sizes) >= FAR:
        raise ValueError(f"{name}={value!r}: expected {count} positive whole numbers of cells, below {FAR}.")
    return sizes


@dataclass(frozen=True)
class Rules:
    """The task's sizes and options, and the functions that follow from them.

    Args:
        bin_size: ``(W_B, D_B, H_B)``, grid of the bin and height of its walls, in cells.
        tote_size: ``(W_T, D_T, H_T)``; an episode's tote height may be lower than ``H_T``.
        effector_size: ``(W_E, D_E)`` of the flat suction rectangle.
        rotations: ``R``, the number of quarter turns to choose from, 1 to 4.
        pick_rule: ``"contain"`` (the EE covers the whole footprint) or ``"overlap"`` (one shared cell is enough).
        min_support: least share of the footprint that must rest on the highest cells below it.
        strict_support: require more than ``min_support`` instead of at least.
        longest_side: longest side of any item, where it is known; saves time only.

    Raises:
        ValueError: naming the argument, what it was, and what was expected.
    """

    bin_size: tuple[int, int, int] = (5, 5, 1)
    tote_size: tuple[int, int, int] = (6, 6, 5)
    effector_size: tuple[int, int] = (3, 3)
    rotations: int = 4
    pick_rule: str = "contain"
    min_support: float = 0.5
    strict_support: bool = False
    longest_side: int | None = None

    def __post_init__(self):
        object.__setattr__(self, "bin_size", _sizes("bin_size", self.bin_size, 3))
        object.__setattr__(self, "tote_size", _sizes("tote_size", self.tote_size, 3))
        object.__setattr__(self, "effector_size", _sizes("effector_size", self.effector_size, 2))
        if not _is_whole(self.rotations) or not 1 <= self.rotations <= 4:
            raise ValueError(f"rotations={self.rotations!r}: expected 1, 2, 3 or 4 (quarter turns to choose from).")
        if self.pick_rule not in ("contain", "overlap"):
            raise ValueError(f"pick_rule={self.pick_rule!r}: expected 'contain' or 'overlap'.")
        if not isinstance(self.min_support, (int, float)) or not 0 <= self.min_support <= 1:
            raise ValueError(f"min_support={self.min_support!r}: expected a share between 0 and 1.")
        if not isinstance(self.strict_support, bool):
            raise ValueError(f"strict_support={self.strict_support!r}: expected true or false.")
        if self.longest_side is not None and (not _is_whole(self.longest_side) or self.longest_side < 1):
            raise ValueError(f"longest_side={self.longest_side!r}: expected a whole number >= 1, or None.")

    # ------------------------------------------------------------------ sizes
    @property
    def num_picks(self) -> int:
        """``P``, the number of pick cells."""
        return self.bin_size[0] * self.bin_size[1]

    @property
    def num_places(self) -> int:
        """The number of place cells."""
        return self.tote_size[0] * self.tote_size[1]

    @property
    def num_actions(self) -> int:
        """``N_a``, the number of flat actions."""
        return self.num_picks * self.num_places * self.rotations

    @property
    def parities(self) -> int:
        """``Q``: 1 if items are never turned, else 2."""
        return 1 if self.rotations == 1 else 2

    @property
    def num_outcomes(self) -> int:
        """The number of footprints ``(parity, x, y)``; what an action leaves in the tote is one of them."""
        return self.parities * self.num_places

    @cached_property
    def max_side(self) -> int:
        """``S``: the longest item side that fits the bin and, where it must be contained, the end effector."""
        limits = self.effector_size if self.pick_rule == "contain" else self.bin_size[:2]
        longest = max(min(a, b) for a, b in zip(limits, self.bin_size[:2], strict=True))
        return longest if self.longest_side is None else min(longest, self.longest_side)

    @cached_property
    def min_offset(self) -> int:
        """The lowest offset of an item under the end effector along either axis."""
        return 0 if self.pick_rule == "contain" else 1 - self.max_side

    @cached_property
    def num_offsets(self) -> int:
        """``O``: how many offsets there are along one axis."""
        return max(self.effector_size) - self.min_offset

    @cached_property
    def effectors(self) -> tuple[tuple[int, int, int, int], ...]:
        """For each parity the rotated end effector's ``(width, depth, reference x, reference y)``."""
        w, d = self.effector_size
        shapes = ((w, d), (d, w))[: self.parities]
        return tuple((a, b, (a - 1) // 2, (b - 1) // 2) for a, b in shapes)

    def describe(self) -> str:
        """The sizes in one short line, for messages."""
        join = "x".join
        return (
            f"bin {join(map(str, self.bin_size))}, tote {join(map(str, self.tote_size))}, "
            f"EE {join(map(str, self.effector_size))}, R={self.rotations}"
        )

    # ------------------------------------------------------------------ depth maps
    def bin_depth(self, item: Item) -> Tensor:
        """Height above the bin's floor, float32 ``[N, W_B, D_B]``: the item's height under its footprint, else 0."""
        inside = _rectangle(self.bin_size[:2], item.x, item.y, item.w, item.d)
        return (inside * item.h.float()).permute(2, 0, 1).contiguous()

    @staticmethod
    def read_item(bin_depth: Tensor) -> Item:
        """The item that a bin's depth map ``[N, W_B, D_B]`` shows, as the bounding box of its non-zero cells."""
        filled = bin_depth > 0
        columns, rows = filled.any(2), filled.any(1)  # [N, W_B], [N, D_B]
        # argmax of a 0/1 map is its first 1: where the item begins.
        return Item(
            x=columns.int().argmax(1),
            y=rows.int().argmax(1),
            w=columns.sum(1),
            d=rows.sum(1),
            h=bin_depth.amax((1, 2)).long(),
        )

    # ------------------------------------------------------------------ picking
    def grasps(self, item: Item) -> tuple[Tensor, Tensor]:
        """What each pick cell does to the item: ``pick_failure [N, P]`` and ``offset [N, P, R, 2]`` (int64).

        ``offset`` is the item's minimum corner in the frame of the EE's rectangle after rotation ``r``.
        """
        (bin_w, bin_d, wall), (ee_w, ee_d) = self.bin_size, self.effector_size
        device = item.x.device
        cell = torch.arange(self.num_picks, device=device)
        left, front = cell // bin_d - (ee_w - 1) // 2, cell % bin_d - (ee_d - 1) // 2  # the EE's min corner, [P]
        w, d = item.w[:, None], item.d[:, None]
        ox, oy = item.x[:, None] - left, item.y[:, None] - front  # [N, P]
        if self.pick_rule == "contain":
            gripped = (ox >= 0) & (oy >= 0) & (ox + w <= ee_w) & (oy + d <= ee_d)
        else:
            gripped = (ox < ee_w) & (oy < ee_d) & (ox + w > 0) & (oy + d > 0)
        gripped = gripped & (w > 0)
        leaves_bin = (left < 0) | (front < 0) | (left + ee_w > bin_w) | (front + ee_d > bin_d)
        # The only thing in a bin is its item, which is never higher than its own top: just the walls can be hit.
        hits_wall = leaves_bin & (item.h[:, None] < wall)
        failure = torch.where(gripped, hits_wall * int(Failure.BIN_COLLISION), int(Failure.PICK_MISS))
        turned = [(ox, oy), (ee_d - oy - d, ox), (ee_w - ox - w, ee_d - oy - d), (oy, ee_w - ox - w)]
        offset = torch.stack([torch.stack(pair, -1) for pair in turned[: self.rotations]], 2)
        return failure, offset

    def heuristic_pick(self, item: Item) -> Tensor:
        """The pick cell of individual planning, which does not look at the tote, int64 ``[N]``.

        The one with the least offset ``ox + oy``, then ``oy``, among those that succeed: the item lies in the end
        effector's corner where possible.
        """
        failure, offset = self.grasps(item)
        ox, oy = offset[:, :, 0].unbind(-1)  # before turning, [N, P]
        return torch.where(failure == 0, (ox + oy) * FAR + oy, FAR**2).argmin(1)

    def at_pick(self, actions: Tensor, pick: Tensor) -> Tensor:
        """The part of ``[N, N_a]`` that belongs to the pick cells ``[N]``: ``[N, W_T * D_T * R]``."""
        return actions.unflatten(1, (self.num_picks, -1))[torch.arange(len(pick), device=pick.device), pick]

    def _offsets(self, item: Item) -> tuple[Tensor, Tensor]:
        """Which offsets a pick can have, and what they become by turning; offsets are ``(ox, oy)`` row by row.

        Returns:
            bool ``[K, N]``: some pick cell lifts the item with this offset under the EE before turning (it is the only
            one); int64 ``[R, K, N]``: the grasp class that this offset becomes by each rotation, clamped into range.
        """
        (bin_w, bin_d, wall), (ee_w, ee_d), count = self.bin_size, self.effector_size, self.num_offsets
        step = torch.arange(self.min_offset, self.min_offset + count, device=item.x.device)[:, None]
        gripped, leaves, backs = [], [], []
        for at, size, ee, room in ((item.x, item.w, ee_w, bin_w), (item.y, item.d, ee_d, bin_d)):
            corner, back = at - step, ee - size - step  # of the EE; from the item's far end to the EE's; [O, N]
            held = (torch.minimum(step, back) >= 0) if self.pick_rule == "contain" else (step < ee) & (step + size > 0)
            cell = corner + (ee - 1) // 2
            gripped.append(held & (cell >= 0) & (cell < room))
            leaves.append((corner < 0) | (corner > room - ee))
            backs.append((back - self.min_offset).clamp_(0, count - 1))
        hits_wall = (leaves[0][:, None] | leaves[1]) & (item.h < wall)
        available = gripped[0][:, None] & gripped[1] & ~hits_wall & (item.w > 0)  # [O, O, N]
        here, (back_x, back_y) = torch.arange(count, device=item.x.device)[:, None], backs
        # An offset (x, y) is (along, across) the EE's width after turning; its class counts (parity, x, y) up.
        turned = (
            (here[:, None] * count + here).expand_as(available),
            here[:, None] + (back_y + count) * count,
            back_x[:, None] * count + back_y,
            here * count + back_x[:, None] + count * count,
        )
        return available.flatten(0, 1), torch.stack(turned[: self.rotations]).flatten(1, 2)

    # ------------------------------------------------------------------ placing
    def resting_top(self, heights: Tensor, tote_height: Tensor, item: Item) -> Tensor:
        """Height of the item's top for every footprint, int32 ``[N, Q, W_T, D_T]``; NEVER where it cannot rest.

        It cannot rest where the footprint leaves the tote, the top passes the rim, or the support is too small.

        Args:
            heights: int32 ``[N, W_T, D_T]``.
            tote_height: int64 ``[N]``.
        """
        side = self.max_side
        padded = _surround(heights.permute(1, 2, 0), (0, side - 1, 0, side - 1), FAR)  # [.., .., N]
        below = _windows(padded, side).flatten(0, 1).unbind(0)
        w, d = (torch.stack(pair)[: self.parities] for pair in ((item.w, item.d), (item.d, item.w)))
        w, d = w[:, None, None], d[:, None, None]  # [Q, 1, 1, N]
        under = [(i < w) & (j < d) for i in range(side) for j in range(side)]
        # Loops over the S * S cells under an item: the inner loops then run over whole maps, which is fast.
        z = torch.full((), NEVER, dtype=heights.dtype, device=heights.device)
        for cell, used in zip(below, under, strict=True):
            z = torch.maximum(z, torch.where(used, cell, NEVER))
        level = torch.zeros_like(z)
        for cell, used in zip(below, under, strict=True):
            level += (cell == z) & used
        stable = self._supported(level, w * d)
        top = z + item.h.to(z.dtype)
        fits = stable & (top <= tote_height) & (item.h > 0)
        return torch.where(fits, top, NEVER).permute(3, 0, 1, 2)

    def clearance(self, heights: Tensor, tote_height: Tensor) -> Tensor:
        """The least top at which the EE hits nothing, per place cell, int32 ``[N, Q, W_T, D_T]``.

        That is the highest tote cell under the EE's rectangle; where the rectangle leaves the tote, the rim.
        """
        tote_w, tote_d, _ = self.tote_size
        maps = heights.new_empty(self.parities, tote_w, tote_d, len(heights))
        rim = tote_height.to(heights.dtype)
        for parity, (ee_w, ee_d, ref_x, ref_y) in enumerate(self.effectors):
            walled = _surround(heights.permute(1, 2, 0), (ref_x, ee_w - 1 - ref_x, ref_y, ee_d - 1 - ref_y), rim)
            # The maximum over a rectangle is a maximum along one axis, then along the other.
            for axis, size, room in ((0, ee_w, tote_w), (1, ee_d, tote_d)):
                walled = reduce(torch.maximum, [walled.narrow(axis, i, room) for i in range(size)])
            maps[parity] = walled
        return maps.permute(3, 0, 1, 2)

    def placements(self, heights: Tensor, tote_height: Tensor, item: Item) -> Placements:
        """Everything that decides which actions succeed: see :class:`Placements`."""
        return Placements(self.resting_top(heights, tote_height, item), self.clearance(heights, tote_height), item)

    def placements_from_depth(self, bin_depth: Tensor, tote_depth: Tensor, tote_height: Tensor) -> Placements:
        """:meth:`placements` from what the agent sees: the depth maps and ``tote_height [N, 1]``."""
        tote_height = tote_height.reshape(-1)
        heights = (tote_height[:, None, None] - tote_depth).int()
        return self.placements(heights, tote_height, self.read_item(bin_depth))

    def grasp_class(self, offset: Tensor) -> Tensor:
        """Index of ``(parity, offset x, offset y)`` for every pick cell and rotation, int64 ``[N, P, R]``.

        Args:
            offset: int64 ``[N, P, R, 2]`` from :meth:`grasps`. The index means something where the pick succeeds;
                elsewhere it is clamped into range.
        """
        parity = torch.arange(self.rotations, device=offset.device) % 2
        step = (offset - self.min_offset).clamp(0, self.num_offsets - 1)
        return (parity * self.num_offsets + step[..., 0]) * self.num_offsets + step[..., 1]

    def class_mask(self, placements: Placements) -> Tensor:
        """Does placing succeed, per grasp class and place cell? bool ``[C, W_T * D_T, N]``, batch last."""
        low, count = self.min_offset, self.num_offsets
        tote_w, tote_d, _ = self.tote_size
        batch = len(placements.top)
        mask = placements.top.new_empty(self.parities, count, count, tote_w, tote_d, batch, dtype=torch.bool)
        for parity, (_, _, ref_x, ref_y) in enumerate(self.effectors):
            # With the EE's reference cell at p and the item at offset o, the footprint begins at p - ref + o.
            pad = (ref_x - low, low + count - 1 - ref_x, ref_y - low, low + count - 1 - ref_y)
            top = _surround(placements.top[:, parity].permute(1, 2, 0), pad, NEVER)
            clear = placements.clearance[:, parity].permute(1, 2, 0)
            torch.le(clear, _windows(top, count), out=mask[parity])
        return mask.flatten(3, 4).flatten(0, 2)

    def num_feasible(self, placements: Placements) -> Tensor:
        """How many flat actions succeed, int64 ``[N]``, without listing them."""
        available, classes = self._offsets(placements.item)
        places = self.class_mask(placements).sum(1)  # [C, N]
        return reduce(torch.add, [(places.gather(0, turned) * available).sum(0) for turned in classes])

    def action_mask(self, placements: Placements) -> Tensor:
        """Exactly the flat actions that succeed, bool ``[N, N_a]``."""
        places, batch, rotations = self.num_places, len(placements.top), self.rotations
        available, classes = self._offsets(placements.item)
        by_class = self.class_mask(placements).permute(2, 0, 1).reshape(-1, places).view(torch.uint8)  # [N * C, places]
        # The flags of all rotations side by side in one number, so that a pick cell's whole block is copied at once:
        # blocks [N * K + 1, places], of which the last, for picks that fail, is empty.
        packed, slots = {1: (torch.uint8, 1), 2: (torch.int16, 2)}.get(rotations, (torch.int32, 4))
        flags = torch.eye(slots, dtype=torch.uint8).view(packed)[:, 0].tolist()
        count = len(available)
        first = torch.arange(batch, device=by_class.device)
        blocks = by_class.new_zeros(batch * count + 1, places, dtype=packed)
        for flag, turned in zip(flags, classes, strict=False):
            row = (turned + first * (self.parities * count)).t().reshape(-1)
            blocks[:-1].add_(by_class.index_select(0, row).to(packed), alpha=flag)
        # Which block each pick cell has.
        block = self._pick_offsets(placements.item)
        usable = torch.cat([available.t(), available.new_zeros(batch, 1)], 1)
        block = torch.where(usable.gather(1, block), block + first[:, None] * count, batch * count)
        mask = blocks.index_select(0, block.flatten()).view(torch.bool)
        mask = mask.view(batch, self.num_picks, places, slots)
        return mask[..., :rotations].reshape(batch, self.num_actions)

    def _pick_offsets(self, item: Item) -> Tensor:
        """The number of each pick cell's offset, int64 ``[N, P]``; ``K`` where the item is out of reach."""
        (_, bin_d, _), (ee_w, ee_d), count = self.bin_size, self.effector_size, self.num_offsets
        cell = torch.arange(self.num_picks, device=item.x.device)
        x = item.x[:, None] - (cell // bin_d - (ee_w - 1) // 2) - self.min_offset
        y = item.y[:, None] - (cell % bin_d - (ee_d - 1) // 2) - self.min_offset
        inside = (x >= 0) & (x < count) & (y >= 0) & (y < count)
        return torch.where(inside, x * count + y, count * count)

    def outcome_mask(self, placements: Placements) -> Tensor:
        """The footprints that some action reaches, bool ``[N, Q, W_T, D_T]`` by ``(parity, min corner)``.

        A square footprint is the same in both parities; it is listed under parity 0 only, so that distinct entries
        are distinct outcomes.
        """
        count, batch = self.num_offsets, len(placements.top)
        tote_w, tote_d, _ = self.tote_size
        high = self.min_offset + count - 1
        available, classes = self._offsets(placements.item)
        # Each class that some pick has; the last row takes what is not available.
        grasped = available.new_zeros(self.parities * count**2 + 1, batch)
        grasped.scatter_(0, torch.where(available, classes, len(grasped) - 1).flatten(0, 1), True)
        grasped = grasped[:-1].view(self.parities, count, count, 1, 1, batch)
        maps = available.new_empty(self.parities, tote_w, tote_d, batch)
        for parity, (_, _, ref_x, ref_y) in enumerate(self.effectors):
            # The footprint at f is reached with offset o if the EE's reference cell is at f + ref - o.
            pad = (high - ref_x, ref_x - self.min_offset, high - ref_y, ref_y - self.min_offset)
            clear = _surround(placements.clearance[:, parity].permute(1, 2, 0), pad, FAR)  # cell f + high - o
            usable = (
                torch.where(grasped[parity, count - 1 - i, count - 1 - j], clear[i : i + tote_w, j : j + tote_d], FAR)
                for i in range(count)
                for j in range(count)
            )
            torch.le(reduce(torch.minimum, usable), placements.top[:, parity].permute(1, 2, 0), out=maps[parity])
        if self.parities == 2:
            square = placements.item.w == placements.item.d
            maps[0] |= square & maps[1]
            maps[1] &= ~square
        return maps.permute(3, 0, 1, 2).contiguous()

    def actions_reaching(self, placements: Placements, outcome: Tensor) -> Tensor:
        """All successful flat actions that leave the item in a given footprint.

        Args:
            outcome: int64 ``[N]``, index ``(parity * W_T + x) * D_T + y`` of a footprint.

        Returns:
            int64 ``[N, P * R]``: for each pick cell and rotation the flat action, or -1 if it does not succeed.
        """
        tote_w, tote_d, _ = self.tote_size
        device = outcome.device
        failure, offset = self.grasps(placements.item)
        parity = torch.arange(self.rotations, device=device) % 2  # [R]
        refs = torch.tensor([e[2:] for e in self.effectors], device=device)[parity]  # [R, 2]
        corner = torch.stack([outcome // tote_d % tote_w, outcome % tote_d], -1)
        place = corner[:, None, None] + refs - offset  # [N, P, R, 2]
        px, py = place.unbind(-1)
        in_grid = (px >= 0) & (px < tote_w) & (py >= 0) & (py < tote_d)
        cell = px.clamp(0, tote_w - 1) * tote_d + py.clamp(0, tote_d - 1)
        index = (parity * self.num_places + cell).flatten(1)
        clear = placements.clearance.flatten(1).gather(1, index).view_as(cell)
        top = placements.top.flatten(1).gather(1, outcome[:, None])[..., None]
        turned = (outcome // self.num_places)[:, None, None]
        same = (placements.item.w == placements.item.d)[:, None, None] | (parity == turned)
        good = in_grid & same & (clear <= top) & (failure == 0)[..., None]
        pick = torch.arange(self.num_picks, device=device)[:, None]
        rotation = torch.arange(self.rotations, device=device)
        action = (pick * self.num_places + cell) * self.rotations + rotation
        return torch.where(good, action, -1).flatten(1)

    def action_outcomes(self, item: Item) -> Tensor:
        """The outcome that each flat action would leave if nothing collided, int64 ``[N, N_a]``.

        An outcome is the index ``(parity * W_T + x) * D_T + y`` of a footprint, as in :meth:`outcome_mask`; -1 where
        the pick fails or the footprint leaves the tote.
        """
        tote_w, tote_d, _ = self.tote_size
        failure, offset = self.grasps(item)
        turned = torch.arange(self.rotations, device=offset.device) % 2  # [R]
        refs = torch.tensor([e[2:] for e in self.effectors], device=offset.device)[turned]  # [R, 2]
        corner = (offset - refs)[:, :, None, None]  # [N, P, 1, 1, R, 2]
        x = corner[..., 0] + torch.arange(tote_w, device=offset.device)[:, None, None]
        y = corner[..., 1] + torch.arange(tote_d, device=offset.device)[:, None]
        w = torch.where(turned == 1, item.d[:, None], item.w[:, None])[:, None, None, None]  # [N, 1, 1, 1, R]
        d = torch.where(turned == 1, item.w[:, None], item.d[:, None])[:, None, None, None]
        inside = (x >= 0) & (y >= 0) & (x + w <= tote_w) & (y + d <= tote_d)
        parity = (turned * (item.w != item.d)[:, None])[:, None, None, None]
        outcome = (parity * tote_w + x) * tote_d + y
        return torch.where(inside & (failure == 0)[..., None, None, None], outcome, -1).flatten(1)

    # ------------------------------------------------------------------ acting
    def split_action(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The flat action ``[N]`` as ``(x_B, y_B, x_T, y_T, r)``, int64 ``[N]`` each."""
        pick, rest = action // (self.num_places * self.rotations), action % (self.num_places * self.rotations)
        place, rotation = rest // self.rotations, rest % self.rotations
        return (
            pick // self.bin_size[1],
            pick % self.bin_size[1],
            place // self.tote_size[1],
            place % self.tote_size[1],
            rotation,
        )

    def flat_action(self, x_bin: Tensor, y_bin: Tensor, x_tote: Tensor, y_tote: Tensor, rotation: Tensor) -> Tensor:
        """The inverse of :meth:`split_action`."""
        pick = x_bin * self.bin_size[1] + y_bin
        place = x_tote * self.tote_size[1] + y_tote
        return (pick * self.num_places + place) * self.rotations + rotation

    def apply(self, heights: Tensor, tote_height: Tensor, item: Item, action: Tensor) -> Step:
        """Try one action per problem, with the checks in the order of the rules.

        Args:
            heights: int32 ``[N, W_T, D_T]``.
            tote_height: int64 ``[N]``.
            action: int64 ``[N]``, the flat index, in ``[0, N_a)``.
        """
        (bin_w, bin_d, wall), (tote_w, tote_d, _) = self.bin_size, self.tote_size
        xb, yb, xt, yt, rotation = self.split_action(action)
        odd = rotation % 2 == 1

        # Picking, as in `grasps`, at one cell.
        ee_w, ee_d = self.effector_size
        left, front = xb - (ee_w - 1) // 2, yb - (ee_d - 1) // 2
        ox, oy = item.x - left, item.y - front
        back_x, back_y = ee_w - ox - item.w, ee_d - oy - item.d
        if self.pick_rule == "contain":
            gripped = torch.minimum(torch.minimum(ox, oy), torch.minimum(back_x, back_y)) >= 0
        else:
            gripped = (ox < ee_w) & (oy < ee_d) & (ox + item.w > 0) & (oy + item.d > 0)
        leaves_bin = (left < 0) | (front < 0) | (left + ee_w > bin_w) | (front + ee_d > bin_d)

        # Turning.
        w, d = torch.where(odd, item.d, item.w), torch.where(odd, item.w, item.d)
        turned_x = torch.where(odd, torch.where(rotation == 1, back_y, oy), torch.where(rotation == 0, ox, back_x))
        turned_y = torch.where(odd, torch.where(rotation == 1, ox, back_x), torch.where(rotation == 0, oy, back_y))
        wide, deep = torch.where(odd, ee_d, ee_w), torch.where(odd, ee_w, ee_d)  # the turned EE
        left, front = xt - (wide - 1) // 2, yt - (deep - 1) // 2  # its min corner in the tote
        fx, fy = left + turned_x, front + turned_y

        # Placing.
        footprint = _rectangle((tote_w, tote_d), fx, fy, w, d)
        by_cell = heights.permute(1, 2, 0).contiguous()  # batch last
        z = torch.where(footprint, by_cell, 0).flatten(0, 1).amax(0)
        top = z.long() + item.h
        level = (footprint & (by_cell == z)).flatten(0, 1).sum(0)
        highest = torch.where(_rectangle((tote_w, tote_d), left, front, wide, deep), by_cell, 0).flatten(0, 1).amax(0)
        item_outside = (fx < 0) | (fy < 0) | (fx + w > tote_w) | (fy + d > tote_d)
        ee_outside = (left < 0) | (front < 0) | (left + wide > tote_w) | (front + deep > tote_d)

        checks = (  # from the last to the first, so that the first failure has the last word
            (Failure.UNSTABLE, ~self._supported(level, w * d)),
            (Failure.ITEM_COLLISION, highest > top),
            (Failure.OVERFLOW, top > tote_height),
            (Failure.TOTE_COLLISION, item_outside | (ee_outside & (tote_height > top))),
            # The only thing in a bin is its item, which is never higher than its own top: just the walls can be hit.
            (Failure.BIN_COLLISION, leaves_bin & (item.h < wall)),
            (Failure.PICK_MISS, ~gripped | (item.w <= 0)),
        )
        code = torch.zeros_like(action)
        for kind, failed in checks:
            code = torch.where(failed, int(kind), code)
        placed = footprint & (code == 0)
        by_cell = torch.where(placed, top.to(heights.dtype), by_cell)
        return Step(by_cell.permute(2, 0, 1).contiguous(), code, top, torch.stack([fx, fy, w, d], -1))

    def put_down(self, heights: Tensor, placements: Placements, outcome: Tensor) -> Tensor:
        """The tote after a success that leaves the item in a given footprint, int32 ``[N, W_T, D_T]``.

        Args:
            heights: int32 ``[N, W_T, D_T]``, of which ``placements`` were made.
            outcome: int64 ``[N]``, index ``(parity * W_T + x) * D_T + y``, one of :meth:`outcome_mask`.
        """
        tote_w, tote_d, _ = self.tote_size
        odd, item = outcome >= self.num_places, placements.item
        w, d = torch.where(odd, item.d, item.w), torch.where(odd, item.w, item.d)
        footprint = _rectangle((tote_w, tote_d), outcome // tote_d % tote_w, outcome % tote_d, w, d)
        top = placements.top.flatten(1).gather(1, outcome[:, None])[:, 0]
        return torch.where(footprint, top, heights.permute(1, 2, 0)).permute(2, 0, 1).contiguous()

    def _supported(self, level: Tensor, area: Tensor) -> Tensor:
        share = level.double() / area
        return share > self.min_support if self.strict_support else share >= self.min_support


def _surround(maps: Tensor, margins: tuple[int, int, int, int], value) -> Tensor:
    """Maps ``[W, D, N]`` with margins (before and after along x, then y) of a value, or of one for each problem."""
    x0, x1, y0, y1 = margins
    wide, deep, batch = maps.shape
    out = maps.new_empty(wide + x0 + x1, deep + y0 + y1, batch)
    if isinstance(value, Tensor):
        out.copy_(value.expand_as(out))
    else:
        out.fill_(value)
    out[x0 : x0 + wide, y0 : y0 + deep] = maps
    return out


def _windows(maps: Tensor, count: int) -> Tensor:
    """All shifts of maps ``[W + count - 1, D + count - 1, N]`` by up to ``count - 1`` cells, a view
    ``[count, count, W, D, N]``."""
    return maps.unfold(0, count, 1).unfold(1, count, 1).permute(3, 4, 0, 1, 2)


def _rectangle(grid: tuple[int, int], x: Tensor, y: Tensor, w: Tensor, d: Tensor) -> Tensor:
    """Cells of a grid inside the rectangle of size ``(w, d)`` at ``(x, y)``, bool ``[*grid, N]``, batch last."""
    column = torch.arange(grid[0], device=x.device)[:, None]
    row = torch.arange(grid[1], device=x.device)[:, None]
    in_x = (column >= x) & (column < x + w)
    in_y = (row >= y) & (row < y + d)
    return in_x[:, None] & in_y
