"""Tipping: the poses in which an item may be put down, one for each of its three pairs of faces.

With ``env.tipping`` an item lies in the bin once in each pose. A pick of one pose takes the item: the others leave
the bin, too. Poses follow one another in the bin's table: upright as it arrives, then ``w, h, d``, then ``d, h, w``.
"""

import torch
from torch import Tensor

from pickplace.common.capture import constant_on
from pickplace.common.validate import expect, refuse_any, refuse_if
from pickplace.items.distributions import ItemDistribution
from pickplace.rules.cell import POSES, CellSpec
from pickplace.rules.item import ALL_TURNS, Item

#: For each pose, the columns of the item's sides along x, y and z.
SIDES = (("w", "d", "h"), ("w", "h", "d"), ("d", "h", "w"))


def tipped_items(cell: CellSpec, source: ItemDistribution, item: Item, pose: int) -> Item:
    """Return arriving items, ``[N]``, as they lie in a pose, in the corner of the bin; unchanged without ``tipping``.

    Args:
        cell: says whether items may be tipped.
        source: the item distribution; its ``tipped_turns`` say how a tipped item may be turned, None: as upright.
        item: the items as they arrive.
        pose: 0, 1 or 2.
    """
    if not cell.tipping:
        return item
    turns = item.turns
    if pose > 0 and source.tipped_turns is not None:
        turns = constant_on(source.tipped_turns, turns.device)[item.kind, pose - 1]
    w, d, h = (getattr(item, side) for side in SIDES[pose])
    corner = torch.zeros_like(item.x)
    return Item(corner, corner, w, d, h, item.kind, turns, item.grams, item.max_load)


def sizes_in_bin(cell: CellSpec, items: ItemDistribution) -> Tensor:
    """Return the sizes with which kinds may lie in the bin, int64 ``[K * poses, 3]``."""
    columns = dict(zip("wdh", items.sizes.unbind(1), strict=True))
    return torch.cat([torch.stack([columns[side] for side in sides], 1) for sides in SIDES[: cell.poses]])


def longest_side(cell: CellSpec, items: ItemDistribution) -> int:
    """Return the longest side along x or y that an item may have in the bin; cells."""
    return int(sizes_in_bin(cell, items)[:, :2].max())


def check_tipping(cell: CellSpec, items: ItemDistribution) -> None:
    """Refuse items that a cell with ``tipping`` cannot handle.

    Raises:
        ValueError: naming the setting, and what was expected.
    """
    if not cell.tipping:
        return
    wide, deep, side = *cell.bin_size[:2], int(items.sizes.max())
    expect(
        wide >= POSES * side and deep >= side, "env.bin_size", [*cell.bin_size],
        f"at least {POSES * side}x{side} cells with env.tipping=true: an item lies there in its three poses",
    )  # fmt: skip
    refuse_any(
        (key for key in ("bin_items", "rotations") if key in cell.varies),
        lambda key: f"env.tipping=true: episodes cannot differ in {key} then; expected false, or another curriculum.",
    )
    limited = items.tipped_turns is not None and bool((items.tipped_turns != ALL_TURNS).any())
    refuse_if(
        limited and not cell.handling,
        "env.handling=false: some items may not lie on every side; expected env.handling=true.",
    )
