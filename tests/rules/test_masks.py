"""Masks, the single step and the plain-Python oracle agree on random cells, with and without limits on the robot."""

import math
from dataclasses import replace
from random import Random
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracle import SUCCESS, UNSTABLE
from problems import Case, oracle_of, problems, random_effector, state_of
from scipy.spatial import ConvexHull, QhullError

from pickplace import CellSpec, Failure, Item, PickPlaceEnv, State
from pickplace.items.distributions import Uniform
from pickplace.planners.heuristics import JointDBL
from pickplace.planners.use import decide
from pickplace.rules import placing
from pickplace.rules.grasps import all_grasps, central_pick, heuristic_pick
from pickplace.rules.gripper.rules import Contain, Overlap
from pickplace.rules.masks import (
    action_footprints,
    action_mask,
    actions_reaching,
    first_action_reaching,
    footprint_mask,
    num_feasible,
    placing_maps,
)
from pickplace.rules.placing import resting_top
from pickplace.rules.reach.base import Limits
from pickplace.rules.state import EMPTY, surface_from
from pickplace.rules.step import apply, put_down
from pickplace.rules.support.rules import Hull


@settings(max_examples=80)
@given(problems(limited=st.booleans(), count=2, shaped=st.booleans()), st.sampled_from([1, placing.MIN_SIDE]))
def test_masks_equal_the_step_and_the_oracle(problem, least_side):
    cell, cases = problem
    state, actions = state_of(*cases), torch.arange(cell.num_actions)
    with patch.object(placing, "MIN_SIDE", least_side):
        maps = placing_maps(cell, state)
    masks, reached = action_mask(cell, maps), footprint_mask(cell, maps)
    footprints = action_footprints(cell, state.items)
    assert torch.equal(num_feasible(cell, maps), masks.sum(1))
    for row, case in enumerate(cases):
        plain, mask = oracle_of(cell, case), masks[row]
        tried = [plain.try_action(action) for action in range(cell.num_actions)]
        step = apply(cell, state.rows(torch.full_like(actions, row)), actions)
        assert step.failure.tolist() == [failure for failure, _ in tried]
        assert (step.surface >> 1)[mask].tolist() == [after for failure, after in tried if failure == SUCCESS]
        assert (step.surface[~mask] == state.surface[row]).all()
        bearing = [plain.bearing_after(action) for action in mask.nonzero()[:, 0].tolist()]
        assert (step.surface[mask] & 1).tolist() == bearing
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
        after, placed = put_down(cell, state.rows(same), each)
        assert torch.equal(after.surface, step.surface[first]) and not after.items.exists.any()
        assert torch.equal(placed.table, step.item.rows(first).table)


@pytest.mark.parametrize("seed", range(25))
def test_bodies_among_towers(seed):
    """Masks of body and cup in a wide tote with a few towers, where the cells of the body decide."""
    random = Random(seed)
    size = random.choice(((3, 3), (2, 3), (4, 2), (3, 4), (5, 5)))
    body = random_effector(random, size, kind="mask")["body"]
    shape = {"body": body, "cup": body, "min_seal": random.choice((0.1, 0.4))}
    rotations, rule = random.choice((1, 2, 3, 4)), random.choice(("overlap", "seal", "seal"))
    sizes = {"bin_size": (5, 4, 1), "tote_size": (8, 7, 9), "effector_size": size, "longest_side": 3}
    cell = CellSpec(**sizes, rotations=rotations, pick_rule=rule, support=0.0, **shape)
    towers = np.array(random.choices((0, 0, 0, 0, 0, 3, 5), k=56)).reshape(8, 7)
    w, d = random.randint(1, 3), random.randint(1, 3)
    item = (random.randint(0, 5 - w), random.randint(0, 4 - d), w, d, random.randint(1, 3))
    case = Case(9, towers, np.ones_like(towers), item)
    state, plain = state_of(case), oracle_of(cell, case)
    maps = placing_maps(cell, state)
    mask, actions = action_mask(cell, maps)[0], torch.arange(cell.num_actions)
    step, footprints = apply(cell, state.repeat(len(actions)), actions), action_footprints(cell, state.items)[0]
    assert torch.equal(mask, step.failure == 0) and num_feasible(cell, maps).item() == mask.sum()
    reached = footprint_mask(cell, maps)[0].flatten().nonzero()[:, 0]
    assert torch.equal(reached, footprints[mask].unique())
    found = actions_reaching(cell, maps.rows(torch.zeros_like(reached)), reached)
    assert torch.equal(found[found >= 0].sort()[0], mask.nonzero()[:, 0])
    lifted = (step.failure > Failure.BIN_COLLISION).logical_or(mask).nonzero()[:, 0].tolist()
    tried = random.sample(lifted, min(400, len(lifted))) + random.sample(range(len(actions)), 100)
    assert step.failure[tried].tolist() == [plain.try_action(action)[0] for action in tried]


@settings(max_examples=60)
@given(problems(count=3, shaped=st.booleans()))
def test_footprints_without_the_tote(problem):
    """Every action whose pick succeeds and whose item stays in the tote has a footprint, whatever lies there."""
    cell, cases = problem
    flat = state_of(*(case._replace(heights=case.heights * 0) for case in cases))
    step = apply(cell, flat.repeat(cell.num_actions), torch.arange(cell.num_actions).repeat(3))
    x, y, w, d = step.footprint.unbind(-1)
    inside = (x >= 0) & (y >= 0) & (x + w <= cell.tote_size[0]) & (y + d <= cell.tote_size[1])
    lifted = (step.failure != Failure.PICK_MISS) & (step.failure != Failure.BIN_COLLISION)
    assert torch.equal(action_footprints(cell, flat.items).flatten() >= 0, inside & lifted)


def open_limits(cell):
    """Return tables that allow everything."""
    top = torch.full((cell.rotations, *cell.tote_size[:2]), 99)
    return Limits(torch.ones(cell.num_picks, dtype=torch.bool), -top, top)


@settings(max_examples=40)
@given(problems(count=3, shaped=st.booleans()))
def test_tables_that_allow_everything_change_nothing(problem):
    cell, cases = problem
    free = replace(cell, reach=open_limits(cell))
    maps = placing_maps(cell, state_of(*cases))
    for function in (action_mask, footprint_mask, num_feasible):
        assert torch.equal(function(cell, maps), function(free, maps))


def test_limits_by_hand():
    """One of each: a pick out of reach, and an item's top too low and too high, in one rotation at one place cell."""
    cell = CellSpec()
    item = (1, 1, 2, 1, 1)
    state = State(torch.full((1, 6, 6), EMPTY).int(), torch.tensor([5]), Item.from_table(torch.tensor([[item]])))
    actions = torch.arange(cell.num_actions)
    before = apply(cell, state.repeat(len(actions)), actions).failure.view(5, 5, 6, 6, 4)
    limits = open_limits(cell)
    limits.pick_ok[2 * 5 + 1] = False
    limits.lowest_top[1, 2, 3], limits.highest_top[3, 4, 1] = 2, 0  # the top is 1
    limits.lowest_top[0, 1, 1] = limits.highest_top[0, 1, 1] = 1  # allowed exactly
    after = apply(replace(cell, reach=limits), state.repeat(len(actions)), actions).failure.view(5, 5, 6, 6, 4)
    expected = before.clone()
    for index in ((2, 1), (slice(None), slice(None), 2, 3, 1), (slice(None), slice(None), 4, 1, 3)):
        # Reach is judged last: what failed before fails for the same reason.
        expected[index] = torch.where(before[index] == 0, int(Failure.OUT_OF_REACH), before[index])
    assert torch.equal(after, expected) and (after != before).sum() == 74
    # The heuristic pick is another one where its first choice is out of reach.
    pick = heuristic_pick(cell, state.items.rows(0))
    limits.pick_ok[pick] = False
    assert heuristic_pick(replace(cell, reach=limits), state.items.rows(0)) != pick


def rest_on(heights, item, support):
    """Return the failure of an item that is set down on the near corner of a tote of these heights."""
    (w, d, h), (wide, deep) = item, heights.shape
    cell = CellSpec((w, d, h), (wide, deep, 9), Overlap((1, 1)), 1, support)
    state = State(surface_from(heights)[None], torch.tensor([9]), Item.from_table(torch.tensor([[[0, 0, *item]]])))
    failure = apply(cell, state, torch.tensor([0])).failure.item()
    maps = placing_maps(cell, state)
    assert footprint_mask(cell, maps)[0, 0, 0, 0] == (failure == SUCCESS)
    assert max(w, d) > 7 or action_mask(cell, maps)[0, 0] == (failure == SUCCESS)
    return failure


@pytest.mark.parametrize(("width", "held"), [(2, 1), (3, 2), (5, 3), (7, 5), (9, 3)])
def test_shares_are_compared_exactly_in_float64(width, held):
    """Some of the cells below a long item are one cell high."""
    share, heights = held / width, (torch.arange(width) < held).int()[:, None]
    expected = {share: SUCCESS, math.nextafter(share, 1): UNSTABLE, "full": UNSTABLE}
    expected |= {"half": SUCCESS if 2 * held >= width else UNSTABLE}
    expected |= {"more_than_half": SUCCESS if 2 * held > width else UNSTABLE}
    for support, failure in expected.items():
        assert rest_on(heights, (width, 1, 1), support) == failure, support


@pytest.mark.parametrize(("free", "size", "stable"), [
    ([], (4, 5), True),
    ([(1, 1)], (4, 5), True),  # all four corners
    ([(0, 0)], (4, 5), True),  # three, and exactly 95%
    ([(0, 0), (1, 1)], (4, 5), True),  # three, and 90%
    ([(0, 0), (3, 4)], (4, 5), False),  # two, and 90%
    ([(0, 0), (1, 1), (2, 1), (1, 2)], (4, 5), True),  # three, and exactly 80%
    ([(0, 0), (1, 1), (2, 1), (1, 2), (2, 2)], (4, 5), False),  # three, and 75%
    ([(1, y) for y in range(5)] + [(2, y) for y in range(3)], (4, 5), True),  # four, and exactly 60%
    ([(1, y) for y in range(5)] + [(2, y) for y in range(4)], (4, 5), False),  # four, and 55%
    ([(1, 0)], (3, 1), True),  # each end has two corners
    ([(0, 0)], (2, 1), False),
])  # fmt: skip
def test_corners_by_hand(free, size, stable):
    heights = torch.ones(size)
    for x, y in free:
        heights[x, y] = 0
    assert rest_on(heights, (*size, 1), "corners") == (SUCCESS if stable else UNSTABLE)


@settings(max_examples=200)
@given(st.data())
def test_half_or_hull_equals_scipys_hull(data):
    w, d = (data.draw(st.sampled_from([2, 3, 4, 5, 6, 7, *range(2, 8), 9, 21, 50])) for _ in range(2))
    held = data.draw(st.lists(st.tuples(st.integers(0, w - 1), st.integers(0, d - 1)), min_size=3, unique=True))
    heights = torch.zeros(w, d)
    for x, y in held:
        heights[x, y] = 3
    try:
        hull = ConvexHull([(x + 0.5, y + 0.5) for x, y in held]).equations
    except QhullError:  # all on a line
        assume(False)
    inside = (hull @ [w / 2, d / 2, 1]).max() < 1e-9
    assert rest_on(heights, (w, d, 1), "half_or_hull") == (SUCCESS if 2 * len(held) > w * d or inside else UNSTABLE)


@pytest.mark.parametrize(("support", "unit"), [("half_or_hull", 3), ("half_or_hull", 9), ("corners", 4), (0.7, 5)])
def test_large_items_rest_as_small_ones_do(support, unit):
    """Looked at one by one, or all at once."""
    longest = 3 if unit > 5 else 5
    sides = [longest + 2, longest + 1, 8] if unit < 5 else [longest + 1, longest + 1, 8]
    sizes = {"bin_size": (5 * unit, 5 * unit, 1), "tote_size": [side * unit for side in sides], "support": support}
    items, effector = Uniform(*[(1, longest)] * 3, unit=unit), {"effector_size": (1, 1), "pick_rule": "overlap"}
    env = PickPlaceEnv(items, num_envs=2, masks=(), rotations=2, **sizes, **effector)
    planner, seen, stable = JointDBL(env.cell), env.reset(), 0
    for _ in range(3 if unit > 5 else 8):
        each = []
        for sizes in ({"MIN_SIDE": 999}, {"MIN_SIDE": 1, "FOOTPRINTS_AT_ONCE": {"cpu": 1}},
                      {"MIN_SIDE": 1, "MAX_LEVELS": 1}, {"MIN_SIDE": 1}):  # fmt: skip
            with patch.multiple(placing, **sizes):
                each.append(resting_top(env.cell, *env.state.each_item()))
        (expected_top, expected_rest), *found = each
        assert all(torch.equal(top, expected_top) and torch.equal(rest, expected_rest) for top, rest in found)
        stable += int((expected_top >= 0).sum())
        seen["action"] = decide(planner, env.cell, seen)
        seen = env.step_and_maybe_reset(seen)[1]
    assert stable > 0


@pytest.mark.parametrize(("cells", "size", "distance"), [
    ([(0, 0)], (2, 1), 0.0),  # the centre is above the edge of the cell
    ([(1, 0)], (3, 1), 0.5),  # the middle cell alone
    ([(0, 0), (1, 1)], (2, 2), math.sqrt(0.5)),  # two opposite corners
    ([(0, 0), (1, 0), (0, 1)], (2, 2), math.sqrt(0.5)),  # all but a corner
    ([(0, 0), (1, 0), (2, 0)], (3, 2), 0.0),  # half, all on one side
    ([(0, 0), (2, 1)], (3, 2), 1.5 / math.sqrt(5)),  # the edge from (1, 0) to (3, 1) is nearest
    ([(0, 0), (1, 0), (0, 1), (0, 2)], (3, 3), 0.5 / math.sqrt(5)),  # the edge from (2, 1) to (1, 3)
])  # fmt: skip
def test_a_hull_by_hand(cells, size, distance):
    """The centre lies this far inside the hull of the supporting cells."""
    heights = torch.zeros(size)
    for x, y in cells:
        heights[x, y] = 2
    item = (*size, 1)
    assert rest_on(heights, item, Hull(0.0)) == (SUCCESS if distance > 0 else UNSTABLE)
    if distance > 0:
        assert rest_on(heights, item, Hull(distance - 1e-6)) == SUCCESS
        assert rest_on(heights, item, Hull(distance + 1e-6)) == UNSTABLE


@settings(max_examples=200)
@given(st.data())
def test_the_hull_rule_equals_scipys_hull(data):
    w, d = data.draw(st.integers(1, 7)), data.draw(st.integers(1, 7))
    held = data.draw(st.lists(st.tuples(st.integers(0, w - 1), st.integers(0, d - 1)), min_size=1, unique=True))
    margin = data.draw(st.sampled_from([0.0, 0.1, 0.25, 0.5, 1.3]))
    heights = torch.zeros(w, d)
    for x, y in held:
        heights[x, y] = 3
    corners = [(x + a, y + b) for x, y in held for a in (0, 1) for b in (0, 1)]
    outside = (ConvexHull(corners).equations @ [w / 2, d / 2, 1]).max()  # minus the distance to the hull's edge
    assume(abs(outside + margin) > 1e-9 or margin == 0)
    expected = SUCCESS if outside < -margin - 1e-9 else UNSTABLE
    assert rest_on(heights, (w, d, 1), Hull(margin)) == expected


@pytest.mark.parametrize(("support", "third"), [("hull", SUCCESS), ("bearing", UNSTABLE)])
def test_a_pile_that_leans_over(support, third):
    """Bricks of three cells, each one cell further. The third one would have the upper two balance on an edge."""
    cell = CellSpec((3, 1, 1), (6, 1, 9), Contain((3, 1)), 1, support)
    item = Item.from_table(torch.tensor([[[0, 0, 3, 1, 1]]]))
    state, failures = State(torch.full((1, 6, 1), EMPTY, dtype=torch.int32), torch.tensor([9]), item), []
    for middle in (1, 2, 3):
        step = apply(cell, state, torch.tensor([6 + middle]))  # picked in the middle
        failures.append(int(step.failure))
        state = state._replace(surface=step.surface)
    assert failures == [SUCCESS, SUCCESS, third]
    weak = state.bearing[0, :, 0].logical_not().nonzero()[:, 0].tolist()
    assert weak == ([3] if support == "bearing" else [])  # where the second brick sticks out


@settings(max_examples=50)
@given(problems(limited=st.booleans(), count=3, shaped=st.booleans()))
def test_picks_that_do_not_look_at_the_tote(problem):
    """Of those that succeed: least ``ox + oy``, then ``oy``; and least from the item's middle to the effector's."""
    cell, cases = problem
    item, (_, bin_d, _), (ee_w, ee_d) = state_of(*cases).items.rows((slice(None), 0)), cell.bin_size, cell.gripper.size
    picks, central, lifted = (
        heuristic_pick(cell, item).tolist(),
        central_pick(cell, item).tolist(),
        all_grasps(cell, item)[0],
    )
    for row, (x, y, w, d, _) in enumerate(case.item for case in cases):
        order, away = {}, {}
        for pick in lifted[row].nonzero()[:, 0].tolist():
            ox, oy = x - pick // bin_d + (ee_w - 1) // 2, y - pick % bin_d + (ee_d - 1) // 2
            order[pick] = (ox + oy, oy)
            away[pick] = abs(ox + w / 2 - ee_w / 2) + abs(oy + d / 2 - ee_d / 2)
        assert not order or picks[row] == min(order, key=order.get)
        assert not away or central[row] == min(away, key=away.get)


def test_an_empty_bin_has_no_feasible_action():
    cell, nothing = CellSpec(pick_rule="overlap", support=0.0), torch.zeros(2, dtype=torch.int64)
    item = Item(*[nothing[:, None]] * 5)
    maps = placing_maps(cell, State(torch.zeros(2, 6, 6).int(), nothing + 5, item))
    assert not all_grasps(cell, maps.item)[0].any() and not action_mask(cell, maps).any()
    assert not footprint_mask(cell, maps).any() and not num_feasible(cell, maps).any()
