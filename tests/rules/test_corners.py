"""Corner-occupying footprints, against a plain search over the cells."""

from dataclasses import replace

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import problems, state_of

from pickplace import CellSpec, Item, State
from pickplace.rules.corners import corner_mask
from pickplace.rules.masks import footprint_mask, placing_maps
from pickplace.rules.reach.base import Limits
from pickplace.rules.state import surface_from


def plain_corners(heights, sizes, feasible, free, level_step):
    """Return the feasible (turned, x, y) that are blocked along both axes, cell by cell; the fallback if there is none.

    Args:
        heights: ``[W][D]``.
        sizes: the footprint's sides, as it is and turned by 90 degrees.
        feasible: a set of (turned, x, y).
        free: the same of those at which nothing is hit, stable or not.
        level_step: by how much the heights of a level surface may differ.
    """
    wide, deep = len(heights), len(heights[0])

    def rest(quarter_turned, x, y):
        w, d = sizes[quarter_turned]
        if min(x, y) < 0 or x + w > wide or y + d > deep:
            return float("inf")
        return max(heights[i][j] for i in range(x, x + w) for j in range(y, y + d))

    def blocked(place, step, free):
        quarter_turned, x, y = place
        there = quarter_turned, x + step[0], y + step[1]
        return rest(*there) > rest(*place) + level_step or there not in free

    def corners(free):
        return {
            place
            for place in feasible
            if any(blocked(place, step, free) for step in ((-1, 0), (1, 0)))
            and any(blocked(place, step, free) for step in ((0, -1), (0, 1)))
        }

    return corners(free) or corners(feasible)


@settings(max_examples=200)
@given(problems(limited=st.booleans(), count=3), st.sampled_from([0, 0, 1, 2]))
def test_the_mask_equals_a_plain_search(problem, level_step):
    cell, cases = problem
    if level_step:  # no step of that size ends above the rim
        cases = [case._replace(rim=max(case.rim, case.heights.max() + case.item[4])) for case in cases]
    state = state_of(*cases)
    maps = placing_maps(cell, state)._replace(level_step=level_step)
    loose = replace(cell, support=0.0)
    never_unstable = footprint_mask(loose, placing_maps(loose, state))
    feasible, mask = footprint_mask(cell, maps), corner_mask(cell, maps)
    for row, case in enumerate(cases):
        w, d = case.item[2:4]
        found = {tuple(place) for place in mask[row].nonzero().tolist()}
        among, free = ({tuple(place) for place in of[row].nonzero().tolist()} for of in (feasible, never_unstable))
        assert found == plain_corners(case.heights.tolist(), [(w, d), (d, w)], among, free, level_step)
        assert bool(found) == bool(among)


def test_where_the_gripper_stops_an_item_is_a_corner():
    """A tote whose walls the gripper does not pass: a small item stops short of them."""
    cell = CellSpec(bin_size=(5, 5, 1), tote_size=(7, 7, 5), effector_size=(3, 3), rotations=1)
    item = Item(*(torch.tensor([[value]]) for value in (0, 0, 1, 1, 1)))  # gripped at the gripper's corner, or inside
    state = State(surface_from(torch.zeros(1, 7, 7, dtype=torch.int32)), torch.tensor([5]), item)
    limits = Limits(torch.zeros(25, dtype=torch.bool).index_fill(0, torch.tensor(6), True), *unlimited(cell))
    cell = replace(cell, reach=limits)
    # Pick cell (1, 1) has the item at offset (0, 0) under the gripper: it cannot come nearer to the far walls than 2.
    mask = corner_mask(cell, placing_maps(cell, state))
    assert sorted(mask.nonzero().tolist()) == [[0, 0, x, y] for x in (0, 4) for y in (0, 4)]


def unlimited(cell):
    places = cell.rotations, *cell.tote_size[:2]
    return torch.zeros(places, dtype=torch.int64), torch.full(places, 99)


def test_an_empty_tote_has_its_four_corners_for_each_orientation():
    cell = CellSpec(bin_size=(5, 5, 1), tote_size=(9, 8, 5), effector_size=(3, 3))
    item = Item(*(torch.tensor([[value]]) for value in (1, 1, 3, 2, 1)))
    state = State(surface_from(torch.zeros(1, 9, 8, dtype=torch.int32)), torch.tensor([5]), item)
    mask = corner_mask(cell, placing_maps(cell, state))
    expected = [[0, 0, x, y] for x in (0, 6) for y in (0, 6)] + [[0, 1, x, y] for x in (0, 7) for y in (0, 5)]
    assert sorted(mask.nonzero().tolist()) == sorted(expected)
