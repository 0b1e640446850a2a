"""Planners of maximal empty spaces against a search over all rectangles, cell by cell."""

from itertools import combinations, product

import pytest
from problems import SETTINGS, occupancies, random_states, results_by_hand, tie_by_hand

from pickplace import PickPlaceEnv
from pickplace.planners.spaces import BestFit, OnlineBPH


def spaces_by_hand(heights):
    """Return the floor and the sides ``(x0, y0, x1, y1)`` of each maximal empty space above heights ``[W][D]``."""
    wide, deep = len(heights), len(heights[0])

    def highest(x0, y0, x1, y1):
        cells = product(range(x0, x1), range(y0, y1))
        return max(heights[x][y] if 0 <= x < wide and 0 <= y < deep else 10**6 for x, y in cells)

    for (x0, x1), (y0, y1) in product(combinations(range(wide + 1), 2), combinations(range(deep + 1), 2)):
        floor = highest(x0, y0, x1, y1)
        grown = (x0 - 1, y0, x1, y1), (x0, y0 - 1, x1, y1), (x0, y0, x1 + 1, y1), (x0, y0, x1, y1 + 1)
        if all(highest(*box) > floor for box in grown):
            yield floor, x0, y0, x1, y1


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


def test_memory_is_refused_before_it_is_taken():
    env = PickPlaceEnv(num_envs=1, tote_size=(250, 250, 2))
    with pytest.raises(ValueError, match="tote_size: .* rectangles of cells"):
        BestFit(env.cell).decide(env.reset())
