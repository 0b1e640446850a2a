"""Planners of maximal empty spaces against a search over all rectangles, cell by cell."""

import time

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import SETTINGS, occupancies, random_states, results_by_hand, spaces_by_hand, tie_by_hand

from pickplace import PickPlaceEnv
from pickplace.planners.empty_spaces import empty_spaces
from pickplace.planners.spaces import BestFit, OnlineBPH


def best_space(planner, spaces, found, height, tote_height):
    """Return what the planner minimises of the spaces that begin where an item lies; None if there is none."""
    _, y, x, w, d, _ = found
    orders = []
    for floor, x0, y0, x1, y1 in spaces:
        left = x1 - x0 - w, y1 - y0 - d
        has_room = min(left) >= 0 and floor + height <= tote_height
        if (x0, y0) == (x, y) and (has_room or planner is OnlineBPH):
            orders.append((floor, min(left) if planner is BestFit else 0))
    return min(orders, default=None)


@pytest.mark.parametrize("options", SETTINGS)
def test_the_first_space_is_filled(options):
    for env, observation in random_states(**options):
        chosen, strict = (
            {planner: planner(env.cell, **settings).decide(observation) for planner in (BestFit, OnlineBPH)}
            for settings in ({}, {"dbl_fallback": False})
        )
        for n in range(env.num_envs):
            spaces = list(spaces_by_hand(env.state.heights[n].tolist()))
            items, results = env.state.items.cuboids[n].tolist(), results_by_hand(env, observation, n)
            for planner in (BestFit, OnlineBPH):
                in_corner, elsewhere = {}, {}
                for action, found in results.items():
                    top, y, x, _, _, number = found
                    rest = y, x, *tie_by_hand(found), action
                    elsewhere[action] = top, *rest
                    order = best_space(planner, spaces, found, items[number][4], int(env.tote_height[n]))
                    if order is not None:
                        in_corner[action] = *order, *rest
                costs, played, bare = in_corner or elsewhere, int(chosen[planner][n]), int(strict[planner][n])
                assert played == min(costs, key=costs.get)
                assert bare == played if in_corner else bare not in results


def test_an_episode_may_end_where_no_corner_is_left():
    env = {"num_envs": 40, "masks": (), "stream": "test", "tote_size": (6, 6, 6), "effector_size": (1, 1)}
    packed = []
    for fallback in (True, False):
        episodes = PickPlaceEnv(**env, pick_rule="overlap", rotations=1)
        packed.append(occupancies(BestFit(episodes.cell, dbl_fallback=fallback), episodes).mean())
    assert packed[0] > packed[1] > 0.3
    with pytest.raises(ValueError, match="planner.dbl_fallback='no'"):
        BestFit(PickPlaceEnv(num_envs=1).cell, dbl_fallback="no")
    with pytest.raises(ValueError, match="planner.item='last'"):
        OnlineBPH(PickPlaceEnv(num_envs=1).cell, item="last")


@settings(max_examples=60, deadline=None)
@given(st.data(), st.integers(1, 6), st.integers(1, 6), st.integers(1, 3))
def test_all_spaces_are_found(data, wide, deep, totes):
    """Of several totes at once, which have other heights."""
    row = st.lists(st.integers(0, 3), min_size=deep, max_size=deep)
    heights = data.draw(st.lists(st.lists(row, min_size=wide, max_size=wide), min_size=totes, max_size=totes))
    found = empty_spaces(torch.tensor(heights, dtype=torch.int32))
    expected = {(n, *space) for n, each in enumerate(heights) for space in spaces_by_hand(each)}
    assert {*zip(*(part.tolist() for part in found), strict=True)} == expected


def test_a_surface_is_level_up_to_a_step():
    """The cell of 7 is lower than the floor of 8 and the cell of 9 is as high; 10 is in the way."""
    found = empty_spaces(torch.tensor([[[7, 8, 9, 10]]], dtype=torch.int32), level_step=1)
    spaces = {*zip(*(part.tolist() for part in found), strict=True)}
    assert spaces == {(0, 7, 0, 0, 1, 2), (0, 8, 0, 0, 1, 3), (0, 9, 0, 0, 1, 4), (0, 10, 0, 0, 1, 4)}


def test_a_fine_grid_needs_neither_memory_nor_time():
    """62,500 cells have 10**9 rectangles."""
    env = PickPlaceEnv(num_envs=1, tote_size=(250, 250, 2))
    observation = env.reset()
    begin = time.process_time()
    action = BestFit(env.cell).decide(observation)
    assert env.step(observation.set("action", action))["next", "reward"].item() > 0
    assert time.process_time() - begin < 20
