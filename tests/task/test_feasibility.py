"""Masks, the single step and the plain-Python oracle agree on random cells, with and without limits on the robot."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import SUCCESS, UNSTABLE
from problems import oracle_of, problems, state_of

from pickplace import CellSpec, Failure, Item, State
from pickplace.task.cell import Limits
from pickplace.task.feasibility import (
    action_footprints,
    action_mask,
    actions_reaching,
    first_action_reaching,
    footprint_mask,
    num_feasible,
    placing_maps,
)
from pickplace.task.grasps import all_grasps, heuristic_pick
from pickplace.task.transition import apply, put_down


@settings(max_examples=60)
@given(problems(limited=st.booleans(), count=2))
def test_masks_equal_the_step_and_the_oracle(problem):
    cell, cases = problem
    state, actions = state_of(*cases), torch.arange(cell.num_actions)
    maps = placing_maps(cell, state)
    masks, reached = action_mask(cell, maps), footprint_mask(cell, maps)
    footprints = action_footprints(cell, state.item)
    assert torch.equal(num_feasible(cell, maps), masks.sum(1))
    for row, case in enumerate(cases):
        plain, mask = oracle_of(cell, case), masks[row]
        tried = [plain.try_action(action) for action in range(cell.num_actions)]
        step = apply(cell, state.rows(torch.full_like(actions, row)), actions)
        assert step.failure.tolist() == [failure for failure, _ in tried]
        assert step.heights[mask].tolist() == [after for failure, after in tried if failure == SUCCESS]
        assert (step.heights[~mask] == state.heights[row]).all()
        assert torch.equal(mask, step.failure == 0)
        # What each success leaves is its footprint; the distinct ones are those of the mask.
        x, y, w, d = step.footprint[mask].unbind(1)
        turned = (torch.stack([w, d], 1) != torch.tensor(case.item[2:4])).any(1)
        left = (turned * cell.tote_size[0] + x) * cell.tote_size[1] + y
        assert torch.equal(footprints[row][mask], left)
        assert torch.equal(reached[row].flatten().nonzero()[:, 0], left.unique())
        # The other way round: the actions that leave each footprint, the lowest of them, and the tote after it.
        each = left.unique()
        same = torch.full_like(each, row)
        found = actions_reaching(cell, maps.rows(same), each)
        index, reaching = (found >= 0).nonzero(as_tuple=True)[0], found[found >= 0]
        assert torch.equal(reaching.sort()[0], mask.nonzero()[:, 0])
        assert torch.equal(footprints[row][reaching], each[index])
        first = first_action_reaching(cell, maps.rows(same), each)
        assert torch.equal(first, torch.where(found >= 0, found, cell.num_actions).amin(1))
        after = put_down(cell, state.heights[same], maps.rows(same), each)
        assert torch.equal(after, step.heights[first])


@settings(max_examples=40)
@given(problems(count=3))
def test_footprints_without_the_tote(problem):
    """Every action whose pick succeeds and whose item stays in the tote has a footprint, whatever lies there."""
    cell, cases = problem
    flat = state_of(*(case._replace(heights=case.heights * 0) for case in cases))
    step = apply(cell, flat.repeat(cell.num_actions), torch.arange(cell.num_actions).repeat(3))
    x, y, w, d = step.footprint.unbind(-1)
    inside = (x >= 0) & (y >= 0) & (x + w <= cell.tote_size[0]) & (y + d <= cell.tote_size[1])
    lifted = (step.failure != Failure.PICK_MISS) & (step.failure != Failure.BIN_COLLISION)
    assert torch.equal(action_footprints(cell, flat.item).flatten() >= 0, inside & lifted)


def open_limits(cell):
    """Return tables that allow everything."""
    top = torch.full((cell.rotations, *cell.tote_size[:2]), 99)
    return Limits(torch.ones(cell.num_picks, dtype=torch.bool), -top, top)


@settings(max_examples=20)
@given(problems(count=3))
def test_tables_that_allow_everything_change_nothing(problem):
    cell, cases = problem
    free = replace(cell, limits=open_limits(cell))
    maps = placing_maps(cell, state_of(*cases))
    for function in (action_mask, footprint_mask, num_feasible):
        assert torch.equal(function(cell, maps), function(free, maps))


def test_limits_by_hand():
    """One of each: a pick out of reach, and an item's top too low and too high, in one rotation at one place cell."""
    cell = CellSpec()
    item = (1, 1, 2, 1, 1)
    state = State(torch.zeros(1, 6, 6).int(), torch.tensor([5]), Item(*torch.tensor([item]).unbind(1)))
    actions = torch.arange(cell.num_actions)
    before = apply(cell, state.repeat(len(actions)), actions).failure.view(5, 5, 6, 6, 4)
    limits = open_limits(cell)
    limits.pick_ok[2 * 5 + 1] = False
    limits.lowest_top[1, 2, 3], limits.highest_top[3, 4, 1] = 2, 0  # the top is 1
    limits.lowest_top[0, 1, 1] = limits.highest_top[0, 1, 1] = 1  # allowed exactly
    after = apply(replace(cell, limits=limits), state.repeat(len(actions)), actions).failure.view(5, 5, 6, 6, 4)
    expected = before.clone()
    for index in ((2, 1), (slice(None), slice(None), 2, 3, 1), (slice(None), slice(None), 4, 1, 3)):
        # Reach is judged last: what failed before fails for the same reason.
        expected[index] = torch.where(before[index] == 0, int(Failure.OUT_OF_REACH), before[index])
    assert torch.equal(after, expected) and (after != before).sum() == 74
    # The heuristic pick is another one where its first choice is out of reach.
    pick = heuristic_pick(cell, state.item)
    limits.pick_ok[pick] = False
    assert heuristic_pick(replace(cell, limits=limits), state.item) != pick


@pytest.mark.parametrize(("width", "length", "shift"), [(2, 4, 1), (3, 6, 1), (3, 6, 2), (5, 9, 2), (7, 9, 2)])
def test_support_is_compared_exactly_in_float64(width, length, shift):
    """One item lies in a tote one cell deep; the next one lies on it, some cells further on."""
    share = (width - shift) / width
    up, down = torch.tensor(share, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64)
    limits = {
        (share, False): SUCCESS,
        (share, True): UNSTABLE,
        (torch.nextafter(up, up + 1).item(), False): UNSTABLE,
        (torch.nextafter(up, down).item(), True): SUCCESS,
    }
    heights = (torch.arange(length) < width).int()[None, :, None]
    state = State(heights, torch.tensor([2]), Item(*torch.tensor([[0, 0, width, 1, 1]]).unbind(1)))
    pick = (width - 1) // 2
    action = torch.tensor([pick * length + pick + shift])
    for (min_support, strict), expected in limits.items():
        cell = CellSpec((width, 1, 1), (length, 1, 2), (width, 1), 1, "contain", min_support, strict)
        assert apply(cell, state, action).failure.item() == expected, (min_support, strict)
        assert action_mask(cell, placing_maps(cell, state))[0, action].item() == (expected == SUCCESS)


@settings(max_examples=50)
@given(problems(limited=st.booleans(), count=3))
def test_the_heuristic_pick_has_the_least_offset(problem):
    """Least ``ox + oy``, then ``oy``, among the picks that succeed: the effector's corner where it can be."""
    cell, cases = problem
    item, (_, bin_d, _), (ee_w, ee_d) = state_of(*cases).item, cell.bin_size, cell.effector_size
    picks, lifted = heuristic_pick(cell, item).tolist(), all_grasps(cell, item)[0]
    for row, (x, y, *_) in enumerate(case.item for case in cases):
        order = {}
        for pick in lifted[row].nonzero()[:, 0].tolist():
            ox, oy = x - pick // bin_d + (ee_w - 1) // 2, y - pick % bin_d + (ee_d - 1) // 2
            order[pick] = (ox + oy, oy)
        assert not order or picks[row] == min(order, key=order.get)


def test_an_empty_bin_has_no_feasible_action():
    cell, nothing = CellSpec(pick_rule="overlap", min_support=0.0), torch.zeros(2, dtype=torch.int64)
    item = Item(nothing, nothing, nothing, nothing, nothing)
    maps = placing_maps(cell, State(torch.zeros(2, 6, 6).int(), nothing + 5, item))
    assert not all_grasps(cell, item)[0].any() and not action_mask(cell, maps).any()
    assert not footprint_mask(cell, maps).any() and not num_feasible(cell, maps).any()
