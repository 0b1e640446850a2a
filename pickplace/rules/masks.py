"""Masks: which actions succeed, and which footprints some action reaches.

Symbols used in shapes: ``N`` problems, ``P`` pick cells, ``R`` rotations, ``Q`` ways to turn a footprint (by 0 and 90
degrees), ``K`` offsets of the item under the end effector, ``T`` turns and ``T * K`` grasp classes (see
:mod:`pickplace.rules.grasps`), ``B`` distinct shapes of the turned end effector (see
:attr:`pickplace.rules.cell.CellSpec.effectors`).

Two properties make the check of all ``N_a = P * W_T * D_T * R`` actions cheap. The bin matters only through the grasp
class. And the end effector collides if and only if something under it is higher than the item's top, where the rim is a
wall around the tote: one maximum over its cells decides.
"""

from collections.abc import Callable
from functools import lru_cache, reduce
from itertools import product
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pickplace.common.capture import is_capturing
from pickplace.common.validate import check_bytes
from pickplace.rules.bin import blocked_picks
from pickplace.rules.cell import CellSpec
from pickplace.rules.checks import GREATEST_TOP, LEAST_TOP, TURN, EffectorOverTote, combine
from pickplace.rules.grasps import (
    all_grasps,
    available_offsets,
    footprint_index,
    is_outside,
    join_action,
    num_turns,
    pick_blocks,
    split_footprint,
    turned_size,
)
from pickplace.rules.gripper.base import EffectorShape
from pickplace.rules.item import Item, flags_from_turns
from pickplace.rules.maps import FAR, NEVER, surround, windows
from pickplace.rules.placing import effector_over_tote, resting_top
from pickplace.rules.state import State

CLASS_BYTES = 2**26  # of the masks of grasp classes that are counted at once


class PlacingMaps(NamedTuple):
    """Everything that decides which actions succeed in a state.

    If bins hold ``M`` items, there is a problem for each item, and the items of a bin follow one another: ``N`` is
    ``N * M`` in the shapes of the fields.
    """

    top: Tensor  # int32 [N, Q, W_T, D_T]: height of the item's top with its footprint's min corner there, or NEVER
    clearance: Tensor  # int32 [N, B or R, W_T, D_T]: least top with the end effector's reference cell there
    item: Item  # what is picked
    rest: Tensor  # int32 [N, Q, W_T, D_T]: height on which the item would lie, stable or not; FAR outside the tote
    blocked: Tensor | None = None  # bool [N, P]: see `blocked_picks`; None: the items lie alone
    bin_items: int = 1  # M
    greatest_top: Tensor | None = None  # int [N, R, W_T, D_T]: greatest top there; None: any
    level_step: int = 0  # greatest difference of heights on a level surface; above 0 if measured

    @classmethod
    def of(
        cls, top: Tensor, rest: Tensor, effector: EffectorOverTote, item: Item, blocked: Tensor | None
    ) -> "PlacingMaps":
        """Return the maps of items; ``effector`` has the end effector over every place cell, for each bin's tote."""
        bins, count = effector.obstacle.shape[-1], len(top) // effector.obstacle.shape[-1]
        bounds = []
        for scope in (LEAST_TOP, GREATEST_TOP):
            if (bound := combine(scope, effector)) is not None:
                bound = bound.permute(3, 0, 1, 2).expand(bins, -1, -1, -1)
            bounds.append(bound if count == 1 or bound is None else bound.repeat_interleave(count, 0))
        return cls(top, bounds[0], item, rest, blocked, count, bounds[1])

    def within_turns(self, cell: CellSpec) -> "PlacingMaps":
        """Return the maps without feasible actions in the rotations that the items forbid."""
        allowed = combine(TURN, flags_from_turns(self.item.turns, cell.rotations))[..., None, None]
        each = torch.stack([self.clearance[:, turn % self.clearance.shape[1]] for turn in range(cell.rotations)], 1)
        return self._replace(clearance=torch.where(allowed, each, FAR))

    def map(self, function: Callable[[Tensor], Tensor]) -> "PlacingMaps":
        """Return the maps with a function applied to each tensor."""
        changed: dict[str, Any] = {
            key: function(part) for key, part in self._asdict().items() if isinstance(part, Tensor)
        }
        return self._replace(item=self.item.map(function), **changed)

    def rows(self, index: Tensor) -> "PlacingMaps":
        """Return the maps of some bins, by their numbers, which may repeat."""
        row = (index[:, None] * self.bin_items + torch.arange(self.bin_items, device=index.device)).flatten()
        return self.map(lambda part: part[row])

    def of_choice(self, cell: CellSpec, choice: Tensor) -> tuple["PlacingMaps", Tensor]:
        """Return the maps of each choice's item, and its footprint.

        Args:
            cell: the sizes.
            choice: int64 ``[N]``, ``item * num_footprints + footprint``.
        """
        if self.bin_items == 1:
            return self, choice
        item = choice // cell.num_footprints
        row = torch.arange(len(choice), device=choice.device) * self.bin_items + item
        return self.map(lambda part: part[row])._replace(bin_items=1), choice - item * cell.num_footprints

    def join(self, mask: Tensor) -> Tensor:
        """Return a mask over footprints ``[N * M, Q, W_T, D_T]`` as one over choices, ``[N, M * Q * W_T * D_T]``."""
        return mask.flatten(1).reshape(len(mask) // self.bin_items, -1)

    def clearance_in(self, rotation: int) -> Tensor:
        """Return the clearance in a rotation or turn, batch last, ``[W_T, D_T, N]``."""
        return self.clearance[:, rotation % self.clearance.shape[1]].permute(1, 2, 0)


def placing_maps(
    cell: CellSpec, state: State, find_top: Callable[..., tuple[Tensor, Tensor]] = resting_top
) -> PlacingMaps:
    """Return everything that decides which actions succeed: see :class:`PlacingMaps`.

    Args:
        find_top: :func:`~pickplace.rules.placing.unchecked_top`, if the footprints of interest are known to be stable
            and below the rim.
    """
    surface, tote_height, item = state.each_item()
    effector = effector_over_tote(cell, state.surface, state.tote_height)
    boxes = None if state.boxes is None else state.boxes.repeat_interleave(state.items.x.shape[1], 0)
    top, rest = find_top(cell, surface, tote_height, item, state.capacity, boxes)
    maps = PlacingMaps.of(top, rest, effector, item, blocked_picks(cell, state.items))
    return maps.within_turns(cell) if cell.forbids_turns else maps


def _tops_by_offset(cell: CellSpec, maps: PlacingMaps, turn: int) -> Tensor:
    """Return the item's top with each offset and place cell, int32 ``[O, O, W_T, D_T, N]``, in one turn; a view."""
    low, count = cell.min_offset, cell.num_offsets
    _, _, ref_x, ref_y, _ = cell.effector(turn)
    # With the reference cell at p and the item at offset o, the footprint begins at p - ref + o.
    pad = (ref_x - low, low + count - 1 - ref_x, ref_y - low, low + count - 1 - ref_y)
    return windows(surround(maps.top[:, turn % cell.footprint_turns].permute(1, 2, 0), pad, NEVER), count)


def class_mask(cell: CellSpec, maps: PlacingMaps) -> Tensor:
    """Return whether placing succeeds, per grasp class and place cell, bool ``[T * K, W_T * D_T, N]``, batch last."""
    size = num_turns(cell), cell.num_offsets, cell.num_offsets, *cell.tote_size[:2], len(maps.top)
    mask = maps.top.new_empty(*size, dtype=torch.bool)
    for number, each in enumerate(mask):
        top = _tops_by_offset(cell, maps, number)
        torch.ge(top, maps.clearance_in(number), out=each)
        if maps.greatest_top is not None:
            each &= top <= maps.greatest_top[:, number].permute(1, 2, 0)
    return mask.flatten(3, 4).flatten(0, 2)


def check_actions(cell: CellSpec, batch: int, device) -> None:
    """Raise ``ValueError`` if the memory cannot hold all flat actions of so many problems."""
    classes = num_turns(cell) * cell.num_offsets**2 * cell.num_places
    check_bytes(
        f"{cell.describe()}: {cell.num_actions:,} actions for {batch} problems at once",
        batch * (5 * cell.num_actions + classes),
        device,
    )


def num_feasible(cell: CellSpec, maps: PlacingMaps) -> Tensor:
    """Return the number of flat actions that succeed, int64 ``[N]``, without listing actions or all grasp classes."""
    at_once = max(1, CLASS_BYTES // (cell.num_offsets * cell.num_places) // maps.bin_items)
    bins = len(maps.top) // maps.bin_items
    if at_once < bins:
        parts = torch.arange(bins, device=maps.top.device).split(at_once)
        return torch.cat([num_feasible(cell, maps.rows(part)) for part in parts])
    available, classes = available_offsets(cell, maps.item, maps.blocked)
    counts = []  # numbers of the place cells where placing succeeds, by grasp class
    for number in range(num_turns(cell)):
        clearance = maps.clearance_in(number)
        for top in _tops_by_offset(cell, maps, number):  # with each offset along x
            good = top >= clearance
            if maps.greatest_top is not None:
                good &= top <= maps.greatest_top[:, number].permute(1, 2, 0)
            counts.append(good.sum((1, 2)))
    places = torch.cat(counts)  # [T * K, N]
    count = reduce(torch.add, [(places.gather(0, turned) * available).sum(0) for turned in classes])
    return count.view(bins, -1).sum(1)


def action_mask(cell: CellSpec, maps: PlacingMaps) -> Tensor:
    """Return a mask of exactly the flat actions that succeed, bool ``[N, N_a]``."""
    check_actions(cell, len(maps.top), maps.top.device)
    places, batch, rotations = cell.num_places, len(maps.top), cell.rotations
    available, classes = available_offsets(cell, maps.item, maps.blocked)
    by_class = class_mask(cell, maps).permute(2, 0, 1).reshape(-1, places).view(torch.uint8)  # [N * T * K, places]
    # The flags of all rotations are packed into one number, so that a pick cell's whole block is copied at once. The
    # last of the blocks [N * K + 1, places] is empty, for picks that fail.
    packed, slots = {1: (torch.uint8, 1), 2: (torch.int16, 2)}.get(rotations, (torch.int32, 4))
    flags = torch.eye(slots, dtype=torch.uint8).view(packed).flatten().tolist()
    count, first = len(available), torch.arange(batch, device=by_class.device)
    blocks = by_class.new_zeros(batch * count + 1, places, dtype=packed)
    for bit, turned in zip(flags, classes, strict=False):
        row = (turned + first * (num_turns(cell) * count)).t().reshape(-1)
        blocks[:-1].add_(by_class.index_select(0, row).to(packed), alpha=bit)
    # The block of each pick cell.
    block = pick_blocks(cell, maps.item)
    usable = torch.cat([available.t(), available.new_zeros(batch, 1)], 1)
    block = torch.where(usable.gather(1, block), block + first[:, None] * count, batch * count)
    mask = blocks.index_select(0, block.flatten()).view(torch.bool).view(batch, cell.num_picks, places, slots)
    mask = mask[..., :rotations].reshape(batch, cell.num_actions)
    return mask if maps.bin_items == 1 else mask.unflatten(0, (-1, maps.bin_items)).any(1)


def footprint_mask(cell: CellSpec, maps: PlacingMaps) -> Tensor:
    """Return a mask of the footprints that some action reaches, bool ``[N, Q, W_T, D_T]`` by turn and min corner.

    If bins hold several items, there is a mask for each of them, ``[N * M, Q, W_T, D_T]``; see :func:`choice_mask`.

    A square footprint is the same after a quarter turn; it is listed as not turned only, so that distinct entries leave
    distinct totes.
    """
    batch, count, turns = len(maps.top), cell.num_offsets, num_turns(cell)
    available, classes = available_offsets(cell, maps.item, maps.blocked)
    # Flags of the classes that some pick has; the last row collects the offsets that are not available.
    grasped = available.new_zeros(turns * count**2 + 1, batch)
    grasped.scatter_(0, torch.where(available, classes, len(grasped) - 1).flatten(0, 1), True)
    grasped = grasped[:-1].view(turns, count, count, 1, 1, batch)
    reached = available.new_empty(cell.footprint_turns, *cell.tote_size[:2], batch)
    for quarter_turned in range(cell.footprint_turns):
        if maps.greatest_top is None:
            top = maps.top[:, quarter_turned].permute(1, 2, 0)
            torch.ge(top, _least_clearance(cell, maps, quarter_turned, grasped), out=reached[quarter_turned])
        else:
            reached[quarter_turned] = _reached_within_limits(cell, maps, maps.greatest_top, quarter_turned, grasped)
    if cell.footprint_turns == 2:
        square = maps.item.w == maps.item.d
        reached[0] |= square & reached[1]
        reached[1] &= ~square
    return reached.permute(3, 0, 1, 2).contiguous()


def choice_mask(cell: CellSpec, maps: PlacingMaps) -> Tensor:
    """Return a mask of the (item, footprint) choices that some action reaches, bool ``[N, M * Q * W_T * D_T]``."""
    return maps.join(footprint_mask(cell, maps))


@lru_cache(maxsize=64)
def _reference_cells(shapes: tuple[EffectorShape, ...], rotations: int, device: torch.device) -> Tensor:
    """Return the reference cells of the turned end effector, int64 ``[R, 2]``."""
    turned = (shapes[rotation % len(shapes)] for rotation in range(rotations))
    return torch.tensor([(shape.ref_x, shape.ref_y) for shape in turned], device=device)


def _footprint_margins(cell: CellSpec, quarter_turned: int) -> tuple[int, int, int, int]:
    """Return the margins to add to a map over place cells before it is cut into windows.

    Window ``(i, j)`` then has, for each footprint, the value at the place cell from which offset ``O - 1 - (i, j)``
    reaches it.
    The footprint at f is reached with offset o if the reference cell is at f + ref - o.
    """
    _, _, ref_x, ref_y, _ = cell.effector(quarter_turned)
    low, high = cell.min_offset, cell.min_offset + cell.num_offsets - 1
    return high - ref_x, ref_x - low, high - ref_y, ref_y - low


def _least_clearance(cell: CellSpec, maps: PlacingMaps, quarter_turned: int, grasped: Tensor) -> Tensor:
    """Return the least clearance with which any grasp reaches each footprint, ``[W_T, D_T, N]``; FAR if none does."""
    (tote_w, tote_d, _), count = cell.tote_size, cell.num_offsets
    margins = _footprint_margins(cell, quarter_turned)
    least = []
    for turn in range(quarter_turned, len(grasped), 2):
        clear, kinds = surround(maps.clearance_in(turn), margins, FAR), grasped[turn].flip(0, 1)  # in windows' order
        if (
            count > 3
            and not is_capturing()
            and torch.equal(kinds, (in_x := kinds.any(1))[:, None] & (in_y := kinds.any(0)))
        ):
            # Mostly, the offsets are all pairs of an x and a y of two sets. Then reduce along x, then along y.
            near, far = _far_unless(in_x), _far_unless(in_y)
            along = reduce(torch.minimum, (torch.maximum(clear[i : i + tote_w], near[i]) for i in range(count)))
            usable = (torch.maximum(along[:, j : j + tote_d], far[j]) for j in range(count))
        else:
            pairs = zip(_far_unless(kinds).flatten(0, 1), product(range(count), repeat=2), strict=True)
            usable = (torch.maximum(clear[i : i + tote_w, j : j + tote_d], limit) for limit, (i, j) in pairs)
        least.append(reduce(torch.minimum, usable))
    return reduce(torch.minimum, least)


def _far_unless(used: Tensor) -> Tensor:
    """Return NEVER where ``used`` is true, else FAR.

    The maximum with it keeps used clearances and makes the others FAR; torch.maximum is faster than torch.where.
    """
    return torch.where(used, NEVER, FAR).int()


def _reached_within_limits(
    cell: CellSpec, maps: PlacingMaps, greatest_top: Tensor, quarter_turned: int, grasped: Tensor
) -> Tensor:
    """Return a mask of the footprints, turned or not, that some grasp reaches within the limits, ``[W_T, D_T, N]``."""
    (tote_w, tote_d, _), margins = cell.tote_size, _footprint_margins(cell, quarter_turned)
    top = maps.top[:, quarter_turned].permute(1, 2, 0)
    reached = torch.zeros_like(top, dtype=torch.bool)
    for rotation in range(quarter_turned, cell.rotations, 2):
        clear = surround(maps.clearance_in(rotation), margins, FAR)
        highest = surround(greatest_top[:, rotation].permute(1, 2, 0), margins, NEVER)
        kinds = grasped[rotation].flip(0, 1)  # in windows' order
        count = len(kinds)
        used = product(range(count), repeat=2) if is_capturing() else kinds.flatten(2).any(2).nonzero().tolist()
        for i, j in used:  # few for an item in metres: the whole cup lies on it
            here = slice(i, i + tote_w), slice(j, j + tote_d)
            reached |= (top >= clear[here]) & (top <= highest[here]) & kinds[i, j]
    return reached


def actions_reaching(cell: CellSpec, maps: PlacingMaps, footprint: Tensor) -> Tensor:
    """Return all successful flat actions that leave the item in a given footprint.

    Args:
        footprint: int64 ``[N]``, index ``(quarter_turned * W_T + x) * D_T + y``; with several items in a bin the
            choice, ``item * num_footprints + footprint``.

    Returns:
        int64 ``[N, P * R]``: for each pick cell and rotation the flat action, or -1 if it does not succeed.
    """
    (tote_w, tote_d, _), device = cell.tote_size, footprint.device
    maps, footprint = maps.of_choice(cell, footprint)
    lifted, offset = all_grasps(cell, maps.item, maps.blocked)
    rotation, refs = (
        torch.arange(cell.rotations, device=device),
        _reference_cells(cell.effectors, cell.rotations, device),
    )
    turned, x, y = split_footprint(cell.tote_size, footprint)
    place_x, place_y = (torch.stack([x, y], -1)[:, None, None] + refs - offset).unbind(-1)  # [N, P, R]
    in_tote = ~is_outside(place_x, 1, tote_w) & ~is_outside(place_y, 1, tote_d)
    place_x, place_y = place_x.clamp(0, tote_w - 1), place_y.clamp(0, tote_d - 1)
    index = footprint_index(cell.tote_size, rotation % maps.clearance.shape[1], place_x, place_y)
    clear = maps.clearance.flatten(1).gather(1, index.flatten(1)).view_as(index)
    top = maps.top.flatten(1).gather(1, footprint[:, None])[..., None]
    same = (maps.item.w == maps.item.d)[:, None, None] | (rotation % 2 == turned[:, None, None])
    good = in_tote & same & (top >= clear) & lifted[..., None]
    if maps.greatest_top is not None:
        good &= top <= maps.greatest_top.flatten(1).gather(1, index.flatten(1)).view_as(index)
    pick = torch.arange(cell.num_picks, device=device)[:, None]
    return torch.where(good, join_action(cell, pick, place_x * tote_d + place_y, rotation), -1).flatten(1)


def first_action_reaching(cell: CellSpec, maps: PlacingMaps, footprint: Tensor) -> Tensor:
    """Return the lowest flat action that leaves the item in a footprint, int64 ``[N]``; the last action if none does.

    For the arguments see :func:`actions_reaching`.
    """
    actions = actions_reaching(cell, maps, footprint)
    return torch.where(actions >= 0, actions, cell.num_actions - 1).amin(1)


def action_footprints(cell: CellSpec, items: Item, blocked: Tensor | None = None) -> Tensor:
    """Return the footprint that each flat action would leave if nothing collided, int64 ``[N, N_a]``.

    The value is ``item * num_footprints + footprint`` as in :func:`actions_reaching`, with square footprints as not
    turned; -1 where the pick fails or the footprint leaves the tote.

    Args:
        cell: the sizes.
        items: ``[N, M]``.
        blocked: see :attr:`PlacingMaps.blocked`; None: computed by :func:`~pickplace.rules.bin.blocked_picks`.
    """
    (tote_w, tote_d, _), count = cell.tote_size, items.x.shape[1]
    item, device = items.flatten(), items.x.device
    lifted, offset = all_grasps(cell, item, blocked_picks(cell, items) if blocked is None else blocked)
    check_actions(cell, len(lifted), device)
    turned = torch.arange(cell.rotations, device=device) % 2  # [R]
    corner = (offset - _reference_cells(cell.effectors, cell.rotations, device))[
        :, :, None, None
    ]  # [N * M, P, 1, 1, R, 2]
    x = corner[..., 0] + torch.arange(tote_w, device=device)[:, None, None]
    y = corner[..., 1] + torch.arange(tote_d, device=device)[:, None]
    w, d = (size[:, None, None, None] for size in turned_size(item.rows((slice(None), None)), turned == 1))
    inside = ~is_outside(x, w, tote_w) & ~is_outside(y, d, tote_d)
    quarter_turned = (turned * (item.w != item.d)[:, None])[:, None, None, None]
    number = (torch.arange(len(lifted), device=device) % count)[:, None, None, None, None]
    footprint = footprint_index(cell.tote_size, quarter_turned, x, y) + number * cell.num_footprints
    footprint = torch.where(inside & lifted[..., None, None, None], footprint, -1).flatten(1)
    return footprint if count == 1 else footprint.unflatten(0, (-1, count)).amax(1)  # a pick lifts one item at most
