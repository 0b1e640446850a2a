"""Check of a saved environment before it is restored: a state that no episode leads to is refused."""

from collections.abc import Mapping

import torch
from torch import Tensor

from pickplace.common.validate import refuse_if
from pickplace.envs.episode import RESET_ENTRIES, SETTINGS
from pickplace.envs.torchrl import PickPlaceEnv
from pickplace.items.arrival import coming_items, next_item
from pickplace.items.distributions import MAX_SEED
from pickplace.items.tipping import sizes_in_bin, tipped_items
from pickplace.rules.bin import select_item
from pickplace.rules.item import NO_LIMIT, Item, bin_labels_from_items
from pickplace.rules.maps import rectangle
from pickplace.rules.observation import observe, standard_terms
from pickplace.rules.pile import Pile
from pickplace.rules.state import EpisodeSettings, State
from pickplace.runs.locate import CheckpointError


def check_saved_states(env: PickPlaceEnv, collector: Mapping) -> None:
    """Refuse a collector's state if values of its environment are out of range or inconsistent.

    Args:
        env: an environment of the same settings, with any number of problems.
        collector: the saved ``state_dict()``, or one for each worker by its name.

    Raises:
        CheckpointError: naming the first value that is impossible.
    """
    for part in (collector, *collector.values()):
        if isinstance(part, Mapping) and "environment" in part:
            _check_saved_state(env, part["environment"], part["carried"])


def _check_saved_state(env: PickPlaceEnv, saved: Mapping[str, Tensor], carried: Mapping[str, Tensor]) -> None:
    """Check one environment.

    Args:
        env: see :func:`check_saved_states`.
        saved: the ``state_dict()`` of the saved environment.
        carried: the observation from which its next step starts. A user's term may be random, so that only the terms of
            pickplace are compared.
    """

    def check(key: str, possible: Tensor, expected: str) -> None:
        refuse_if(
            not possible.all(),
            f"The checkpoint's environment is of no use: {key}: expected {expected}.",
            CheckpointError,
        )

    cell = env.cell
    keys = ("surface", "tote_height", "volume", "steps", "episode", "item_seed")
    surface, tote_height, volume, steps, number, seed = (saved[key] for key in keys)
    for key, (low, high) in env.limits.items():
        value = saved[RESET_ENTRIES[key].field]
        check(key, (value >= low) & (value <= high), f"{low} to {high}")
    episode = EpisodeSettings(**{SETTINGS[key].field: saved[SETTINGS[key].field] for key in cell.varies})
    pile = Pile(*(saved[key] for key in Pile._fields)) if cell.handling else None
    coming = Item.from_table(saved["coming"]) if cell.preview else None
    boxes = saved["boxes"] if cell.support.sees_boxes else None
    state = State(surface, tote_height, Item.from_table(saved["item"]), episode, pile, coming, boxes)
    heights = state.heights
    check("surface", (heights >= 0) & (heights <= tote_height[:, None, None]), "heights of 0 to tote_height")
    check("surface", state.bearing | ((heights > 0) & cell.support.marks_bearing), "cells that bear weight")
    check("volume", (volume >= 0) & (volume <= heights.sum((1, 2))), "at most the volume below the surface")
    check("steps", (steps >= 0) & (steps <= volume), "at most one for each unit of volume")
    if pile is not None:
        check("pile", _is_possible(pile, steps, heights), "what lies on what after so many placements")
    if boxes is not None:
        check("boxes", _are_possible(boxes, steps, heights), "the boxes under the surface")
    check("episode", number >= 0, "at least 0")
    check("item_seed", (seed >= 0) & (seed < MAX_SEED), "at least 0 and below 2**62")
    items, limits = state.items, torch.tensor(cell.bin_size[:2])
    corner, size, cuboids = saved["item"][..., :2], saved["item"][..., 2:4], items.cuboids
    check("item", (corner >= 0) & (size >= 0) & (corner + size <= limits), "items inside the bin")
    sizes = torch.cat([sizes_in_bin(cell, env.items), torch.zeros(1, 3, dtype=torch.int64)])
    check("item", (cuboids[..., None, 2:] == sizes).all(-1).any(-1), "sizes of the distribution")
    covered = (bin_labels_from_items(items, cell.bin_size) > 0).sum((1, 2))
    check("item", covered == (items.w * items.d).sum(1), "items that do not overlap")
    count = items.exists.sum(1)
    check("arrived", saved["arrived"] == steps + count // cell.poses, "the items placed and those in the bin")
    newest = select_item(items, (count - 1).clamp(min=0)).table
    address = seed.expand_as(number), number, saved["arrived"] - 1
    arrival = tipped_items(cell, env.items, next_item(cell, env.items, env.stream, *address, episode), cell.poses - 1)
    same = (newest == arrival.table)[:, 2:].all(1)  # wherever it lies
    check("item", same | (count < cell.bin_items), "the newest item of this episode")  # it may have been taken
    if coming is not None:
        address = seed.expand_as(number), number, saved["arrived"]
        expected = coming_items(cell, env.items, env.stream, *address, episode)
        check("coming", coming.table == expected.table, "the next items of this episode")
    seen = observe(standard_terms(cell), cell, state)
    seen["occupancy"] = (volume / cell.tote_volume(tote_height))[:, None]
    seen |= {key: torch.zeros(len(steps), 1) for key in ("failure", "done", "terminated", "truncated")}
    for key, value in seen.items():
        close = (carried[key].double() - value.double()).abs() < 1e-4  # devices round differently
        check(f"the carried {key}", close, "what the state shows")


def _are_possible(boxes: Tensor, steps: Tensor, heights: Tensor) -> Tensor:
    """Return whether boxes are possible in totes with ``steps`` items, bool ``[N]``; see :func:`_is_possible`."""
    there = torch.arange(boxes.shape[1]) < steps[:, None]
    x, y, z, w, d, h = boxes.unbind(2)
    good = ((boxes[..., 3:] > 0).all(2) == there) & (boxes >= 0).all(2) & (there | (boxes == 0).all(2))
    good &= (x + w <= heights.shape[1]) & (y + d <= heights.shape[2])
    possible = good.all(1) & (steps <= boxes.shape[1])
    tops = torch.zeros_like(heights, dtype=torch.int64)
    for box in range(min(int(steps.max()), boxes.shape[1])):  # put down one after the other
        covered = rectangle(heights.shape[1:], *(part[:, box] for part in (x, y, w, d))).permute(2, 0, 1)
        possible &= (tops * covered).flatten(1).amax(1) == z[:, box]
        tops = torch.where(covered, (z + h)[:, box, None, None], tops)
    return possible & (tops == heights).flatten(1).all(1)


def _is_possible(pile: Pile, steps: Tensor, heights: Tensor) -> Tensor:
    """Return whether piles are possible in totes with ``steps`` items, bool ``[N]``.

    Args:
        steps: int64 ``[N]``.
        heights: int32 ``[N, W_T, D_T]``.
    """
    labels, spare, below = pile
    there = torch.arange(spare.shape[1]) < steps[:, None]
    within = there[:, :, None] & there[:, None]
    earlier = within.tril(-1) | within & torch.eye(spare.shape[1], dtype=torch.bool)
    through = (below.float() @ below.float()) > 0  # below an item that is below
    good = (below.diagonal(dim1=1, dim2=2) == there).all(1) & ~(below & ~earlier).flatten(1).any(1)
    good &= (through == below).flatten(1).all(1)
    good &= ((spare >= 0) & (spare <= NO_LIMIT) & (there | (spare == 0))).all(1)
    seen = (labels >= 0) & (labels <= steps[:, None, None]) & ((labels > 0) == (heights > 0))
    # All cells with the same item on top are level.
    number = labels.flatten(1)
    tops = torch.zeros(len(labels), spare.shape[1] + 1, dtype=heights.dtype)
    tops.scatter_(1, number.clamp(0, spare.shape[1]), heights.flatten(1))
    level = tops.gather(1, number.clamp(0, spare.shape[1])) == heights.flatten(1)
    return good & seen.flatten(1).all(1) & level.all(1)
