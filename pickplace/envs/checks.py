"""Checks of an environment: its memory, whether every item fits the empty tote, and the numbers that it is given."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from pickplace.common.capture import is_capturing
from pickplace.common.validate import refuse_above, refuse_if
from pickplace.items.distributions import ItemDistribution
from pickplace.items.tipping import longest_side
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import available_offsets
from pickplace.rules.item import ALL_TURNS, Item
from pickplace.rules.masks import footprint_mask, placing_maps
from pickplace.rules.state import EMPTY, State

MAX_POSITIONS = 2_000_000  # of items in the bin, all kinds together, that are checked one by one


def problem_bytes(cell: CellSpec, masks: Collection[str]) -> int:
    """Return about the number of bytes of one problem's masks and of the tensors from which they are computed."""
    offsets = cell.num_offsets**2
    count = 64 * cell.num_footprints + 32 * cell.rotations * (offsets + cell.num_picks)
    count += cell.handling * 16 * cell.num_footprints + 10 * cell.record_bytes
    return cell.bin_items * (count + ("action" in masks) * (4 * cell.num_actions + 8 * offsets * cell.num_places))


def most_items(cell: CellSpec, items: ItemDistribution) -> int:
    """Return the greatest number of items in a tote: as many as have room by volume, or come in an episode."""
    by_volume = cell.tote_volume(cell.tote_size[2]) // int(items.sizes.prod(1).min())
    return max(1, min(by_volume, items.longest_episode or by_volume))


def _corners(cell: CellSpec, items: ItemDistribution, kind: int) -> Iterable[tuple[int, int]]:
    """Return the positions of a kind in the bin to check: one for all positions that are equivalent.

    Without limits, positions are equivalent if the end effector's size fits between item and wall, and the kind may lie
    anywhere.
    """
    if cell.limits is not None or type(items).corners is not ItemDistribution.corners:
        return items.corners(kind, cell.bin_size)
    near = max(cell.gripper.size)
    free = [side - int(own) for side, own in zip(cell.bin_size, items.sizes[kind, :2], strict=False)]
    return product(*(sorted({*range(min(near, most) + 1), *range(max(0, most - near), most + 1)}) for most in free))


def check_samples(cell: CellSpec, items: ItemDistribution, stream: str) -> None:
    """Refuse a user's items that a resumed run, or the rules, could not use.

    Raises:
        ValueError: if equal arguments give other items, or if an item has another size, place or handling than it may.
    """
    items = getattr(items, "drawn", items)  # beside published sequences
    if type(items).__module__.partition(".")[0] == "pickplace":  # these have tests of their own
        return
    name, limits = f"items: {type(items).__name__}.sample", torch.tensor(cell.bin_size[:2])
    episode, step = torch.arange(16).repeat_interleave(4), torch.arange(4).repeat(16)
    some = torch.arange(64).flip(0)[::3]
    item, again = (
        items.sample(stream, torch.zeros_like(rows), episode[rows], step[rows], cell.bin_size)
        for rows in (torch.arange(64), some)
    )
    same = item.rows(some).table.equal(again.table)
    refuse_if(not same, f"{name} gave other items for the same seed, episode and step, in another batch.")
    there = item.exists
    found, known = item.table[:, 2:5], items.sizes
    refuse_if(not _are_in(known, found)[there].all(), f"{name} gave an item of a size that is not in `sizes`.")
    corner, size = item.table[:, :2], item.table[:, 2:4]
    inside = ((corner >= 0) & (corner + size <= limits)).all(1)
    refuse_if(not inside[there].all(), f"{name} gave an item outside the bin of {cell.bin_size[:2]} cells.")
    if items.handling is not None:
        found = torch.cat([found, torch.stack([item.turns, item.grams, item.max_load], 1)], 1)
        good = _are_in(torch.cat([known, items.handling], 1), found)
        refuse_if(not good[there].all(), f"{name} gave an item without its `handling`; of_kind() adds it.")


def _are_in(known: Tensor, rows: Tensor) -> Tensor:
    """Return whether each row, int64 ``[N, C]``, is one of the known ones ``[K, C]``, bool ``[N]``."""
    return torch.stack([(known == row).all(1).any() for row in rows])


def check_items(cell: CellSpec, items: ItemDistribution, mix: int = 0, turns: int = ALL_TURNS) -> None:
    """Refuse items that could make a fresh episode impossible.

    Every kind needs a feasible action on the empty tote for every position in the bin. The full tote height decides:
    a lower rim is only easier to clear, as long as it is not below the item's top.

    Args:
        cell: the sizes.
        items: the item distribution.
        mix: number of one of its mixes.
        turns: bit mask of the allowed rotations.

    Raises:
        ValueError: naming the kind, the position and the tote height.
    """
    (w_b, d_b, _), height = cell.bin_size, cell.tote_size[2]
    # (x, y, w, d, h, turns) -> the first such kind: the rows of a long recording repeat themselves
    problems: dict[tuple[int, ...], int] = {}
    widest: dict[str, tuple[int, ...]] = {"bin_size": (w_b, d_b)}
    if largest := cell.gripper.largest_item:
        widest["gripper.size" if largest == cell.gripper.size else "the cup"] = largest
    sizes_of_kinds = items.sizes.tolist()
    for kind in items.arrival_mask(mix).nonzero()[:, 0].tolist():
        w, d, h = sizes_of_kinds[kind]
        for what, (grid_w, grid_d) in widest.items():
            if w > grid_w or d > grid_d:
                raise ValueError(f"{items.label(kind)} does not fit {what}: expected at most {grid_w}x{grid_d} cells.")
        if h > height:
            raise ValueError(f"{items.label(kind)} is higher than the tote: expected at most tote_size[2]={height}.")
        allowed = turns & items.turns(kind)
        for x, y in _corners(cell, items, kind):
            if x + w > w_b or y + d > d_b:
                raise ValueError(f"{items.label(kind)} at x={x}, y={y} leaves the bin: expected it inside {w_b}x{d_b}.")
            problems.setdefault((x, y, w, d, h, allowed), kind)
        words = f"bin_size={[*cell.bin_size]}: the kinds of items have at least"
        refuse_above(words, len(problems), "positions in the bin", MAX_POSITIONS)
    description = f"{cell.describe()}, support={cell.support}" + (f", reach={cell.reach}" if cell.reach else "")
    cell = replace(cell, longest_side=longest_side(cell, items))
    rows = torch.tensor([(*item, kind) for item, kind in problems.items()])
    if cell.limits is None:
        # The lowest item of a size decides: it clears the rim least. Places far from the tote's walls are equivalent.
        rows = rows[rows[:, 4].argsort(stable=True)]
        enough = 2 * (max(cell.gripper.size) + cell.max_side)
        cell = replace(cell, tote_size=(min(cell.tote_size[0], enough), min(cell.tote_size[1], enough), height))
    # Positions in which the end effector can hold an item in the same ways have the same feasible footprints.
    distinct: dict[bytes, int] = {}
    for numbers in torch.arange(len(rows)).split(max(1, 2**22 // (cell.rotations * cell.num_offsets**2))):
        available, _ = available_offsets(cell, Item.from_table(rows[numbers, :5]))  # [K, M]
        ways = np.packbits(available.numpy(), axis=0).T
        sizes = rows[numbers][:, [2, 3, 5] if cell.limits is None else [2, 3, 4, 5]].contiguous()
        keys = np.concatenate([sizes.numpy().view(np.uint8), ways], 1)
        for key, number in zip(keys, numbers.tolist(), strict=True):
            distinct.setdefault(key.tobytes(), number)
    for chunk in rows[list(distinct.values())].split(max(1, min(1024, 2**24 // cell.num_footprints))):
        empty = torch.full((len(chunk), *cell.tote_size[:2]), EMPTY, dtype=torch.int32)
        item = Item.from_table(chunk[:, None, :5])._replace(turns=chunk[:, None, 5])
        boxes = empty.new_zeros(len(chunk), 1, 6, dtype=torch.int64) if cell.support.sees_boxes else None
        maps = placing_maps(cell, State(empty, torch.full((len(chunk),), height), item, boxes=boxes))
        feasible = footprint_mask(cell, maps).flatten(1).any(1)
        if not feasible.all():
            x, y, *_, kind = chunk[~feasible][0].tolist()
            raise ValueError(
                f"{items.label(kind)} at x={x}, y={y} in the bin has no feasible action on the empty tote of height "
                f"{height} ({description}): expected every item to fit somewhere."
            )


def check_numbers(key: str, values: torch.Tensor, low: int, high: int, expected: str) -> torch.Tensor:
    """Return whole numbers in ``[low, high]`` as int64; raise ``ValueError`` for others."""
    if not torch.can_cast(values.dtype, torch.int64):
        raise ValueError(f"{key}={values[0].item()} ({values.dtype}): expected whole numbers, as integers.")
    good = (values >= low) & (values <= high)
    require(good, lambda bad: f"{key}={values[bad][0].item()}: expected {expected}.")
    return values.to(torch.int64)


def require(good: torch.Tensor, message: Callable[[torch.Tensor], str]) -> None:
    """Raise a ``ValueError`` unless all of ``good``, bool, is true; in a capture the device stops the program later.

    Args:
        message: returns the error's text, given where ``good`` is false.
    """
    if is_capturing():
        torch._assert_async(good.all())
    elif not good.all():
        raise ValueError(message(~good))
