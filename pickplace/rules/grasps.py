"""Picking: which pick cells lift the item, and how it then lies under the turned end effector.

A pick affects the placement only through its *grasp class*: the turn and the item's offset under the end effector. Many
pick cells and rotations share a class, which keeps the masks over all actions cheap. ``O`` offsets are possible along
one axis, ``K = O * O`` in all. There are two turns, 0 and 90 degrees, if rotations that differ by 180 degrees are
equivalent for the end effector, the robot's limits and the item. Else each rotation is a turn.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.rules.cell import CellSpec
from pickplace.rules.checks import PICK, combine
from pickplace.rules.gripper.base import reference_cell
from pickplace.rules.item import Item
from pickplace.rules.maps import FAR


def is_outside(corner: Tensor, side: Tensor | int, grid: int) -> Tensor:
    """Return whether ``side`` cells from ``corner`` on leave the grid, along one axis."""
    return (corner < 0) | (corner > grid - side)


def turned_offsets(near_x: Tensor, near_y: Tensor, back_x: Tensor, back_y: Tensor) -> tuple[tuple[Tensor, Tensor], ...]:
    """Return the item's offset ``(x, y)`` under the end effector for each rotation ``0..3``.

    | rotation | x, y |
    |---|---|
    | 0 | ``near_x``, ``near_y`` |
    | 90 degrees | ``back_y``, ``near_x`` |
    | 180 degrees | ``back_x``, ``back_y`` |
    | 270 degrees | ``near_y``, ``back_x`` |

    Args:
        near_x, near_y: the offset before turning.
        back_x, back_y: from the item's maximum corner to the end effector's, before turning.
    """
    return (near_x, near_y), (back_y, near_x), (back_x, back_y), (near_y, back_x)


class Grasp(NamedTuple):
    """The effect of a pick on the item; the fields broadcast to the shape of the pick's coordinates and the item."""

    grips: Tensor
    collides: Tensor
    reachable: Tensor | None  # None: the robot has no limits
    near_x: Tensor
    near_y: Tensor
    back_x: Tensor
    back_y: Tensor

    @property
    def succeeds(self) -> Tensor:
        """Whether the pick lifts the item."""
        return combine(PICK, self)


def grasp(cell: CellSpec, item: Item, x: Tensor, y: Tensor, blocked: Tensor | None = None) -> Grasp:
    """Return the effect of picks at cells ``(x, y)``.

    Args:
        item: ``[N]``; the batch is the last axis.
        x, y: tensors that broadcast with ``[..., N]``.
        blocked: bool ``[N, P]``, see :func:`~pickplace.rules.bin.blocked_picks`; None: the item lies alone.
    """
    (bin_w, bin_d, wall), (ee_w, ee_d) = cell.bin_size, cell.gripper.size
    left, front = x - reference_cell(ee_w), y - reference_cell(ee_d)  # the end effector's minimum corner
    near_x, near_y = item.x - left, item.y - front
    back_x, back_y = ee_w - item.w - near_x, ee_d - item.d - near_y
    gripped = cell.gripper.is_gripped(near_x, near_y, item.w, item.d, cell.item_inset)
    # Every edge of the rectangle has a cell of the body.
    leaves_bin = is_outside(left, ee_w, bin_w) | is_outside(front, ee_d, bin_d)
    # The body is level with the item's top: it can hit only the walls and other items.
    collides = leaves_bin & (item.h < wall)
    reachable = None
    if blocked is not None or cell.limits is not None:
        pick = (x.clamp(0, bin_w - 1) * bin_d + y.clamp(0, bin_d - 1)).expand_as(gripped)
    if blocked is not None:
        collides = collides | blocked.t().gather(0, pick.reshape(-1, pick.shape[-1])).view_as(pick)
    if cell.limits is not None:
        reachable = cell.limits.to(pick.device).allow_pick(pick, item.h)
    return Grasp(gripped & item.exists, collides, reachable, near_x, near_y, back_x, back_y)


def carry(
    cell: CellSpec, item: Item, action: Tensor, blocked: Tensor | None = None
) -> tuple[Grasp, Tensor, tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Return where flat actions ``[A]`` bring the items ``[A]``, without any check.

    For ``blocked`` see :func:`grasp`.

    Returns:
        the pick, the rotation, and minimum corner and sides ``(x, y, w, d)`` over the tote of the turned end effector
        and of the item, int64 ``[A]`` each.
    """
    (ee_w, ee_d), (x_bin, y_bin, x_tote, y_tote, rotation) = cell.gripper.size, split_action(cell, action)
    quarter_turned = rotation % 2 == 1
    picked = grasp(cell, item, x_bin, y_bin, blocked)
    turned = zip(
        *turned_offsets(picked.near_x, picked.near_y, picked.back_x, picked.back_y)[: cell.rotations], strict=True
    )
    offset_x, offset_y = (torch.stack(offsets).gather(0, rotation[None])[0] for offsets in turned)
    w, d = turned_size(item, quarter_turned)
    wide, deep = torch.where(quarter_turned, ee_d, ee_w), torch.where(quarter_turned, ee_w, ee_d)
    left, front = x_tote - reference_cell(wide), y_tote - reference_cell(deep)
    return picked, rotation, (left, front, wide, deep), (left + offset_x, front + offset_y, w, d)


# ---------------------------------------------------------------------- flat indices
def split_flat(cell: CellSpec, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return pick cell, place cell (flat each) and rotation of a flat action."""
    pick, rest = action // (cell.num_places * cell.rotations), action % (cell.num_places * cell.rotations)
    return pick, rest // cell.rotations, rest % cell.rotations


def split_action(cell: CellSpec, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the flat action as ``(x_B, y_B, x_T, y_T, r)``, int64 of the action's shape each."""
    pick, place, rotation = split_flat(cell, action)
    bin_d, tote_d = cell.bin_size[1], cell.tote_size[1]
    return pick // bin_d, pick % bin_d, place // tote_d, place % tote_d, rotation


def join_action(cell: CellSpec, pick: Tensor, place: Tensor, rotation: Tensor) -> Tensor:
    """Return the flat action of a pick cell, a place cell (flat each) and a rotation."""
    return (pick * cell.num_places + place) * cell.rotations + rotation


def join_pick(cell: CellSpec, pick: Tensor, place_rotation: Tensor | int) -> Tensor:
    """Return the flat action of a pick cell and the flat index of (place cell, rotation)."""
    return pick * (cell.num_places * cell.rotations) + place_rotation


def footprint_index(tote_size: Sequence[int], quarter_turned: Tensor | int, x: Tensor, y: Tensor) -> Tensor:
    """Return the index ``(quarter_turned * W_T + x) * D_T + y`` of a footprint whose minimum corner is ``(x, y)``."""
    tote_w, tote_d = tote_size[:2]
    return (quarter_turned * tote_w + x) * tote_d + y


def split_footprint(tote_size: Sequence[int], footprint: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return ``quarter_turned``, x and y of a footprint: the inverse of :func:`footprint_index`."""
    tote_w, tote_d = tote_size[:2]
    line = footprint // tote_d
    quarter_turned = line // tote_w
    # ONNX has no % by a size that is not a constant.
    return quarter_turned, line - quarter_turned * tote_w, footprint - line * tote_d


def turned_size(item: Item, quarter_turned: Tensor) -> tuple[Tensor, Tensor]:
    """Return width and depth of the item's footprint; ``quarter_turned``: whether it is turned by 90 degrees."""
    return torch.where(quarter_turned, item.d, item.w), torch.where(quarter_turned, item.w, item.d)


# ---------------------------------------------------------------------- all picks at once
def all_grasps(cell: CellSpec, item: Item, blocked: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return for each pick cell whether it lifts the item, bool ``[N, P]``, and the item's offset.

    The offset, int64 ``[N, P, R, 2]``, is the item's minimum corner in the frame of the turned end effector.
    For ``blocked`` see :func:`grasp`.
    """
    x, y = (torch.arange(side, device=item.x.device)[:, None] for side in cell.bin_size[:2])
    found = grasp(cell, item, x[:, None], y, blocked)  # [W_B, D_B, N]
    pairs = turned_offsets(found.near_x, found.near_y, found.back_x, found.back_y)[: cell.rotations]
    offset = torch.stack([torch.stack(torch.broadcast_tensors(*pair), -1) for pair in pairs], 3)  # [..., N, R, 2]
    return found.succeeds.flatten(0, 1).t(), offset.flatten(0, 1).transpose(0, 1)


def heuristic_pick(cell: CellSpec, item: Item, blocked: Tensor | None = None) -> Tensor:
    """Return the pick cell of individual planning, which does not look at the tote, int64 ``[N]``.

    It has the least offset ``ox + oy``, then ``oy``, among the picks that succeed: the item lies in the end effector's
    corner where possible. For ``blocked`` see :func:`grasp`.
    """
    succeeds, offset = all_grasps(cell, item, blocked)
    ox, oy = offset[:, :, 0].unbind(-1)  # before turning, [N, P]
    return torch.where(succeeds, (ox + oy) * FAR + oy, FAR**2).argmin(1)


def central_pick(cell: CellSpec, item: Item, blocked: Tensor | None = None) -> Tensor:
    """Return the pick cell that brings the end effector's middle nearest to the item's middle, int64 ``[N]``.

    The distance is the sum along x and y, and ties go to the lowest index. Like :func:`heuristic_pick`, it does not
    look at the tote.
    """
    succeeds, offset = all_grasps(cell, item, blocked)
    ox, oy = offset[:, :, 0].unbind(-1)  # before turning, [N, P]
    ee_w, ee_d = cell.gripper.size
    away = (2 * ox + item.w[:, None] - ee_w).abs() + (2 * oy + item.d[:, None] - ee_d).abs()
    return torch.where(succeeds, away, FAR).argmin(1)


#: Picks that do not look at the tote, by their names in a planner's setting.
PICKS = {"least_offset": heuristic_pick, "middle": central_pick}


def select_pick(cell: CellSpec, actions: Tensor, pick: Tensor) -> Tensor:
    """Return the values ``[N, W_T * D_T * R]`` at the pick cells ``[N]``, of those of all actions ``[N, N_a]``."""
    return actions.unflatten(1, (cell.num_picks, -1))[torch.arange(len(pick), device=pick.device), pick]


# ---------------------------------------------------------------------- grasp classes
def num_turns(cell: CellSpec) -> int:
    """Return the number ``T`` of distinct turns; rotation ``r`` has the turn ``r % T``.

    Each rotation is a turn of its own if the robot has limits, or an item may forbid a rotation. Else see
    :func:`num_grasp_turns`.
    """
    return num_grasp_turns(cell) if cell.limits is None and not cell.forbids_turns else cell.rotations


def num_grasp_turns(cell: CellSpec) -> int:
    """Return the number of distinct turns without limits: more than two if a half turn changes the body."""
    return max(cell.footprint_turns, len(cell.effectors))


def class_index(cell: CellSpec, turns: Tensor | int, step_x: Tensor, step_y: Tensor) -> Tensor:
    """Return the grasp class of a turn and an offset, counted from :attr:`CellSpec.min_offset`."""
    return (turns * cell.num_offsets + step_x) * cell.num_offsets + step_y


def pick_classes(cell: CellSpec, item: Item) -> Tensor:
    """Return the grasp class of every pick cell and rotation, int64 ``[N, P, R]``; -1 if the pick fails.

    The turns are those of :func:`num_grasp_turns`.
    """
    succeeds, offset = all_grasps(cell, item)
    step = (offset - cell.min_offset).clamp(0, cell.num_offsets - 1)
    turns = torch.arange(cell.rotations, device=offset.device) % num_grasp_turns(cell)
    return torch.where(succeeds[..., None], class_index(cell, turns, step[..., 0], step[..., 1]), -1)


def available_offsets(cell: CellSpec, item: Item, blocked: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return a mask of the offsets that some pick has, and the grasp class of each offset after each rotation.

    For ``blocked`` see :func:`grasp`.

    Returns:
        bool ``[K, N]``, whether the one pick cell that gives the offset before turning lifts the item; int64
        ``[R, K, N]``, the grasp class of the offset after each rotation, clamped into range.
    """
    (bin_w, bin_d, _), (ee_w, ee_d), count = cell.bin_size, cell.gripper.size, cell.num_offsets
    here = torch.arange(count, device=item.x.device)[:, None]
    step = here + cell.min_offset  # [O, 1]
    x, y = item.x - step + reference_cell(ee_w), item.y - step + reference_cell(ee_d)  # the pick cell, [O, N]
    found = grasp(cell, item, x[:, None], y, blocked)
    in_bin = ~is_outside(x, 1, bin_w)[:, None] & ~is_outside(y, 1, bin_d)
    back_x, back_y = (
        (back - cell.min_offset).clamp(0, count - 1) for back in (found.back_x, found.back_y)
    )  # [O, 1, N], [O, N]
    turns = num_turns(cell)
    turned = [
        class_index(cell, rotation % turns, step_x, step_y).expand(count, count, len(item.x))
        for rotation, (step_x, step_y) in enumerate(
            turned_offsets(here[:, None], here, back_x, back_y)[: cell.rotations]
        )
    ]
    return (found.succeeds & in_bin).flatten(0, 1), torch.stack(turned).flatten(1, 2)


def pick_blocks(cell: CellSpec, item: Item) -> Tensor:
    """Return the number of each pick cell's offset, int64 ``[N, P]``; ``K`` if it is out of range."""
    (_, bin_d, _), (ee_w, ee_d), count = cell.bin_size, cell.gripper.size, cell.num_offsets
    number = torch.arange(cell.num_picks, device=item.x.device)
    x = item.x[:, None] - (number // bin_d - reference_cell(ee_w)) - cell.min_offset
    y = item.y[:, None] - (number % bin_d - reference_cell(ee_d)) - cell.min_offset
    return torch.where(is_outside(x, 1, count) | is_outside(y, 1, count), count**2, class_index(cell, 0, x, y))
