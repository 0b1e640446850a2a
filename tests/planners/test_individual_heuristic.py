"""Individual planning by heuristics against brute force and the reference's figures."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import late_state, occupancies, random_states, spaces_by_hand

from pickplace import CellSpec, Item, PickPlaceEnv, State
from pickplace.items.distributions import Uniform
from pickplace.planners.heuristics import IndividualHeuristic, corner_footprints
from pickplace.rules.grasps import PICKS, all_grasps
from pickplace.rules.masks import placing_maps
from pickplace.rules.state import Failure, surface_from
from pickplace.rules.step import apply


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), wide=st.integers(2, 6), deep=st.integers(2, 6), steps=st.integers(1, 4))
def test_corners_of_empty_spaces(seed, wide, deep, steps):
    generator = torch.Generator().manual_seed(seed)
    cell = CellSpec(tote_size=(wide, deep, 6))
    heights = torch.randint(steps, (3, wide, deep), generator=generator).int()
    w, d, h = (torch.randint(1, 3, (3,), generator=generator) for _ in range(3))
    items = Item(*(part[:, None] for part in (w * 0, w * 0, w, d, h)))
    maps = placing_maps(cell, State(surface_from(heights), torch.full((3,), 6), items))
    found = corner_footprints(cell, heights, maps)
    for n in range(3):
        spaces = [*spaces_by_hand(heights[n].tolist())]
        for quarter_turned, (wide_, deep_) in enumerate(((int(w[n]), int(d[n])), (int(d[n]), int(w[n])))):
            expected = torch.zeros(wide, deep, dtype=torch.bool)
            for z, x0, y0, x1, y1 in spaces:
                if x1 - x0 >= wide_ and y1 - y0 >= deep_:
                    for i, j in itertools.product((x0, x1 - wide_), (y0, y1 - deep_)):
                        expected[i, j] |= int(maps.top[n, quarter_turned, i, j]) == z + int(h[n])
            assert torch.equal(found[n, quarter_turned], expected)


@pytest.mark.parametrize(("rotations", "reference"), [(1, 0.569), (3, 0.922)])
def test_every_cell_meets_the_reference(rotations, reference):
    env = PickPlaceEnv(rotations=rotations, num_envs=250, masks=(), stream="test", seed=5, support="half")
    occupancy = occupancies(IndividualHeuristic(env.cell, "cells"), env)
    error = float(occupancy.std() / len(occupancy) ** 0.5)
    assert abs(float(occupancy.mean()) - reference) < 3 * error + 0.0005


@pytest.mark.parametrize("candidates", ["corners", "cells"])
@pytest.mark.parametrize(
    ("rotations", "tote", "pick"),
    [(1, (6, 6, 5), "least_offset"), (3, (5, 7, 3), "middle"), (4, (7, 5, 3), "least_offset")],
)
def test_the_first_candidate_that_succeeds_is_played(candidates, rotations, tote, pick):
    """In the order (top, y, x, narrower side along x, flat index); if all fail the first. Corners are fewer."""
    env, observation = late_state(7, rotations=rotations, tote_size=tote, num_envs=48, seed=1)
    cell, state = env.cell, env.state
    maps = placing_maps(cell, state)
    top, corners, each = maps.top, corner_footprints(cell, state.heights, maps), cell.num_places * rotations
    first = PICKS[pick](cell, maps.item) * each
    steps = [apply(cell, state, first + n) for n in range(each)]
    failed, lies = (torch.stack([getattr(step, key) for step in steps], 1) for key in ("failure", "footprint"))
    chosen = IndividualHeuristic(cell, candidates, pick=pick).decide(observation) - first
    missed = 0
    for row in range(48):
        found = []
        for n, (x, y, w, d) in enumerate(lies[row].tolist()):
            if min(x, y) < 0 or x + w > tote[0] or y + d > tote[1]:
                continue
            quarter_turned = n % rotations % 2
            if candidates == "cells" or corners[row, quarter_turned, x, y]:
                found.append((failed[row, n].item() > 0, top[row, quarter_turned, x, y].item(), y, x, w > d, n))
        if found:
            assert chosen[row] == min(found)[-1]
            missed += min(found)[0]
    assert candidates == "cells" or missed > 0


@pytest.mark.parametrize("rule", ["first", "nearest"])
def test_of_several_items_it_takes_the_first_that_can_be_picked(rule):
    """In the order of the rule; an item that its neighbours block is passed over."""
    kinds = Uniform((1, 3), (1, 3), (1, 1))  # all of one height
    others = 0
    for env, observation in random_states(bin_items=4, bin_size=(5, 5, 1), items=kinds, tote_size=(5, 5, 3)):
        step = apply(env.cell, env.state, IndividualHeuristic(env.cell, item=rule).decide(observation))
        assert not ((step.failure == Failure.PICK_MISS) | (step.failure == Failure.BIN_COLLISION)).any()
        for n in range(env.num_envs):
            items = env.state.rows([n])
            table = items.items.table[0].tolist()
            order = [k for k in range(4) if table[k][4]]
            if rule == "nearest":
                order.sort(key=lambda k: (table[k][0] + table[k][2] / 2) ** 2 + (table[k][1] + table[k][3] / 2) ** 2)
            maps = placing_maps(env.cell, items)
            lifted = all_grasps(env.cell, maps.item, maps.blocked)[0].any(1)
            number = next(k for k in order if lifted[k])
            assert step.taken[n] == number
            others += number != order[0]
    assert others > 0


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match=r"planner.candidates='all': expected 'corners' or 'cells'"):
        IndividualHeuristic(CellSpec(), "all")
    with pytest.raises(ValueError, match=r"planner.pick='center': expected 'least_offset' or 'middle'"):
        IndividualHeuristic(CellSpec(), pick="center")
