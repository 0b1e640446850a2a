"""One step: the effect of an action on a state, with the checks in the order of the rules."""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.rules.bin import remove_item, select_item, take_item
from pickplace.rules.cell import CellSpec
from pickplace.rules.checks import EffectorOverTote, Resting, first_failure
from pickplace.rules.grasps import (
    carry,
    is_outside,
    split_action,
    split_footprint,
    turned_size,
)
from pickplace.rules.gripper.base import EffectorShape
from pickplace.rules.item import NO_LIMIT, Item, flags_from_turns
from pickplace.rules.maps import NEVER, is_under, rectangle, square_cells
from pickplace.rules.pile import Pile
from pickplace.rules.state import State, surface_from
from pickplace.rules.support.contact import Contact, Neighbours


class Step(NamedTuple):
    """The effect of one action."""

    surface: Tensor  # int32 [N, W_T, D_T], see State
    failure: Tensor  # int64 [N]
    top: Tensor  # int64 [N]: height of the item's top, meaningful without failure
    footprint: Tensor  # int64 [N, 4]: x, y, w, d of the footprint in the tote
    item: Item  # the item that is taken, [N]
    taken: Tensor  # int64 [N]: its number in the bin
    pile: Pile | None  # the items in the tote, see State
    boxes: Tensor | None  # in the totes, see State


def apply(cell: CellSpec, state: State, action: Tensor) -> Step:
    """Try one action per problem.

    Args:
        action: int64 ``[N]``, the flat index, in ``[0, N_a)``.
    """
    (surface, tote_height, items, _, pile, _, boxes), (tote_w, tote_d, _), (ee_w, ee_d) = (
        state,
        cell.tote_size,
        cell.gripper.size,
    )
    taken, item, blocked = take_item(cell, items, action)
    picked, rotation, (left, front, wide, deep), (x, y, w, d) = carry(cell, item, action, blocked)
    # Cells outside the tote do not matter: an item there fails, and some cell of the end effector is always inside.
    contact, index = _contact(cell, surface, x, y, w, d, None if boxes is None else Neighbours(boxes, x, y, item.h))
    top, reach = contact.z.long() + item.h, max(ee_w, ee_d)
    covered = body_cells(cell.effectors, reach, action.device)  # [reach * reach, B]
    if len(cell.effectors) > 1:
        covered = covered[:, rotation % len(cell.effectors)]
    under = surface.flatten(1).t().gather(0, square_cells(surface.shape[1:], left, front, reach))
    highest = torch.where(covered, under, 0).amax(0) >> 1
    effector = EffectorOverTote(is_outside(left, wide, tote_w) | is_outside(front, deep, tote_d), tote_height, highest)
    if cell.limits is not None:
        limits, place = cell.limits.to(action.device), (rotation, *split_action(cell, action)[2:4])
        effector = effector._replace(lowest=limits.lowest_top[place], highest=limits.highest_top[place])
    inside = ~(is_outside(x, w, tote_w) | is_outside(y, d, tote_d))
    borne = None if pile is None else _least_capacity(pile, contact, index) >= item.grams
    resting = Resting(inside, top, tote_height, cell.support.stable(contact), borne)
    turn = (
        flags_from_turns(item.turns, cell.rotations).gather(1, rotation[:, None])[:, 0] if cell.forbids_turns else None
    )
    failure = first_failure(picked, resting, effector, turn)
    height = torch.where(failure == 0, item.h, 0)
    after, pile = _add_item(cell, surface, pile, item, x, y, contact, index, height)
    boxes = _add_box(boxes, x, y, contact, height)
    return Step(after, failure, top, torch.stack([x, y, w, d], -1), item, taken, pile, boxes)


@lru_cache(maxsize=64)
def body_cells(shapes: tuple[EffectorShape, ...], side: int, device: torch.device) -> Tensor:
    """Return the cells of a square that the body covers, row by row, for each shape, bool ``[side * side, B]``."""
    covered = torch.zeros(len(shapes), side, side, dtype=torch.bool)
    for square, shape in zip(covered, shapes, strict=True):
        for box in shape.body:
            square[box.x : box.x + box.width, box.y : box.y + box.depth] = True
    return covered.flatten(1).t().contiguous().to(device)


def put_down(cell: CellSpec, state: State, choice: Tensor) -> tuple[State, Item]:
    """Return the state after a successful choice, before other items arrive, and the item that is placed, ``[N]``.

    :func:`~pickplace.rules.bin.admit_coming_items` then adds the items of the preview.

    Args:
        choice: int64 ``[N]``, ``item * num_footprints + footprint``, with the index of
            :func:`~pickplace.rules.grasps.footprint_index`; some action must reach it.
    """
    wide, deep = state.surface.shape[1:]  # an exported network serves any tote
    places = cell.footprint_turns * wide * deep
    taken = choice // places
    item = select_item(state.items, taken)
    quarter_turned, x, y = split_footprint((wide, deep), choice - taken * places)
    w, d = turned_size(item, quarter_turned == 1)
    on = _contact(cell, state.surface, x, y, w, d)
    surface, pile = _add_item(cell, state.surface, state.pile, item, x, y, *on, item.h)
    items, boxes = remove_item(cell, state.items, taken), _add_box(state.boxes, x, y, on[0], item.h)
    return state._replace(surface=surface, items=items, pile=pile, boxes=boxes), item


def _contact(
    cell: CellSpec, surface: Tensor, x: Tensor, y: Tensor, w: Tensor, d: Tensor, recorded: Neighbours | None = None
) -> tuple[Contact, Tensor]:
    """Return the supporting cells under items on footprints, and the flat cells of the squares there.

    Args:
        surface: int32 ``[N, W_T, D_T]``.
        x, y, w, d: minimum corner and sides of the footprints, int64 ``[N]``.
        recorded: see :class:`~pickplace.rules.support.contact.Contact`.

    Returns:
        the contact, with quantities ``[N]``; int64 ``[S * S, N]``, see :func:`~pickplace.rules.maps.square_cells`.
    """
    index = square_cells(surface.shape[1:], x, y, cell.max_side)
    cells, under = surface.flatten(1).t().gather(0, index), is_under(w, d, cell.max_side)
    return Contact(cells, under, torch.where(under, cells, NEVER).amax(0) >> 1, w, d, recorded), index


def _least_capacity(pile: Pile, contact: Contact, index: Tensor) -> Tensor:
    """Return the greatest mass that items may have, int64 ``[N]``; for the arguments see :func:`_contact`."""
    capacity = pile.capacity.flatten(1).t().gather(0, index)
    return torch.where(_touched(contact), capacity, NO_LIMIT).amin(0)


def _touched(contact: Contact) -> Tensor:
    """Return a mask of the cells that items rest on, whether these bear weight or not, bool ``[S * S, N]``."""
    return contact.under & (contact.surfaces >> 1 == contact.z)


def _add_item(
    cell: CellSpec, surface: Tensor, pile: Pile | None, item: Item, x: Tensor, y: Tensor, contact: Contact,
    index: Tensor, height: Tensor,
) -> tuple[Tensor, Pile | None]:  # fmt: skip
    """Return totes, int32 ``[N, W_T, D_T]``, and piles after an item is added.

    Args:
        surface: int32 ``[N, W_T, D_T]``.
        pile: the items in the totes.
        item: ``[N]``.
        x, y: minimum corner of the footprint, int64 ``[N]``.
        contact, index: see :func:`_contact`.
        height: height of the item, int64 ``[N]``; 0 for no item.
    """
    grid, added = surface.shape[1:], height > 0
    inside = rectangle(grid, x, y, contact.w, contact.d) & added
    highest = surface_from(contact.z + height)
    after = torch.where(inside, highest, surface.permute(1, 2, 0)).flatten(0, 1)  # [W_T * D_T, N]
    if cell.support.marks_bearing:
        weak = contact.under & added & ~cell.support.bearing(contact)
        after.scatter_add_(0, index, -weak.int())
    if pile is not None:
        pile = pile.add(item, index, _touched(contact), inside.permute(2, 0, 1))
    return after.t().unflatten(1, grid).contiguous(), pile


def _add_box(boxes: Tensor | None, x: Tensor, y: Tensor, contact: Contact, height: Tensor) -> Tensor | None:
    """Return the boxes in the totes after an item is added; for the arguments see :func:`_add_item`."""
    if boxes is None:
        return None
    box = torch.stack([x, y, contact.z.long(), contact.w, contact.d, height], -1)
    number = torch.arange(boxes.shape[1], device=boxes.device) == (boxes[..., 5] > 0).sum(1, keepdim=True)
    return torch.where((number & (height > 0)[:, None])[..., None], box[:, None], boxes)
