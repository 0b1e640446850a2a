"""Planners without training: the reference figures of the rules, brute force over all feasible actions, and chance."""

from dataclasses import replace

import pytest
import torch
from problems import SETTINGS, occupancies, random_states, results_by_hand, tie_by_hand
from scipy.stats import chisquare

from pickplace import PickPlaceEnv
from pickplace.items.distributions import Uniform
from pickplace.planners.heuristics import (
    Corner,
    HeightmapMinimisation,
    IndividualHeuristic,
    JointDBL,
    RandomFeasible,
    UniformRandom,
)
from pickplace.planners.mcts import MCTS
from pickplace.planners.spaces import BestFit, OnlineBPH
from pickplace.rules.masks import placing_maps
from pickplace.rules.state import surface_from

# Planner and items; tote, R, occupancy and its standard error, from an independent prototype of the rules. Where no
# error is known (None): that of 100 episodes, as those of joint_dbl with mixed items are, and of rounding to 0.01.
PAPER, MIXED = None, Uniform((1, 3), (1, 3), (1, 3))
REFERENCE = {
    (RandomFeasible, PAPER): [
        ((6, 6, 1), 4, 0.746, 0.006), ((6, 6, 5), 3, 0.258, 0.003), ((6, 6, 5), 4, 0.257, 0.003),
        ((6, 6, 10), 1, 0.205, 0.002),
    ],
    (RandomFeasible, MIXED): [((6, 6, 5), 4, 0.36, None), ((8, 8, 8), 4, 0.32, None)],
    (JointDBL, PAPER): [
        ((6, 6, 1), 4, 0.931, 0.003), ((6, 6, 5), 1, 0.955, 0.001), ((6, 6, 5), 4, 0.981, 0.001),
    ],
    (JointDBL, MIXED): [((6, 6, 5), 4, 0.635, 0.013)],
}  # fmt: skip
SLOW_REFERENCE = {
    (RandomFeasible, PAPER): [
        ((6, 6, 5), 1, 0.256, 0.003), ((6, 6, 10), 3, 0.208, 0.002), ((6, 6, 10), 4, 0.206, 0.002),
    ],
    (RandomFeasible, MIXED): [((10, 10, 10), 4, 0.31, None)],
    (JointDBL, PAPER): [
        ((6, 6, 5), 3, 0.978, 0.001), ((6, 6, 10), 1, 0.959, 0.001), ((6, 6, 10), 3, 0.983, 0.001),
        ((6, 6, 10), 4, 0.986, 0.001), ((10, 10, 5), 3, 0.990, 0.001), ((10, 10, 5), 4, 0.991, 0.001),
        ((10, 10, 10), 3, 0.995, 0.001), ((10, 10, 10), 4, 0.995, 0.001),
    ],
    (JointDBL, MIXED): [((8, 8, 8), 4, 0.753, 0.007), ((10, 10, 10), 4, 0.819, 0.004)],
}  # fmt: skip


@pytest.mark.parametrize(
    ("planner", "items", "tote", "rotations", "mean", "error", "episodes"),
    [(*key, *row, 200) for key, rows in REFERENCE.items() for row in rows]
    + [pytest.param(*key, *row, 600, marks=pytest.mark.slow) for key, rows in SLOW_REFERENCE.items() for row in rows],
)
def test_reference_figures(planner, items, tote, rotations, mean, error, episodes):
    """Within two standard errors of the difference."""
    sizes = {"tote_size": tote, "rotations": rotations, "items": items}
    env = PickPlaceEnv(num_envs=episodes, masks=(), stream="test", support="half", **sizes)
    occupancy = occupancies(planner(env.cell), env)
    variance = float(occupancy.var())
    theirs = error**2 if error else variance / 100 + 0.01**2 / 12
    assert abs(float(occupancy.mean()) - mean) < 2 * (variance / episodes + theirs) ** 0.5


def least_total(height_weight):
    """Return what ``Corner`` minimises: of the weighted top and the corner."""
    return lambda top, y, x, raised: height_weight * top + y + x


def least_raised(weight):
    """Return what ``HeightmapMinimisation`` minimises."""
    return lambda top, y, x, raised: raised + weight * (y + x)


#: Planners, and what they minimise: of top, y, x, and the sum of all heights after the action less that before it.
COSTS = [
    (JointDBL, lambda top, y, x, raised: (top, y, x)),
    (Corner, least_total(10)),
    (lambda cell: Corner(cell, height_weight=0.5), least_total(0.5)),
    *(
        (lambda cell, weight=weight: HeightmapMinimisation(cell, weight), least_raised(weight))
        for weight in (0.01, 0, 3)
    ),
]


@pytest.mark.parametrize("options", SETTINGS)
def test_the_least_cost_over_all_feasible_actions_is_played(options):
    """Of equal cost: the first item, its narrower side along x, the least x, then y; then the lowest action."""
    for env, observation in random_states(**options):
        chosen = [make(env.cell).decide(observation).tolist() for make, _ in COSTS]
        assert chosen == [make(env.cell).decide(observation.exclude("action_mask")).tolist() for make, _ in COSTS]
        for n in range(env.num_envs):
            heights = env.state.heights[n]
            costs = [{} for _ in COSTS]
            for action, found in results_by_hand(env, observation, n).items():
                top, y, x, w, d, _ = found
                raised = int((top - heights[x : x + w, y : y + d]).sum())
                for (_, cost), each in zip(COSTS, costs, strict=True):
                    each[action] = cost(top, y, x, raised), *tie_by_hand(found), action
            assert [each[n] for each in chosen] == [min(each, key=each.get) for each in costs]


def test_a_cost_does_not_depend_on_the_unit_of_heights():
    """A robot counts in millimetres."""
    for env, observation in random_states(tote_size=(5, 5, 4), support="half"):
        (wide, deep, rim), state = env.cell.tote_size, env.state
        fine = replace(env.cell, tote_size=(wide, deep, 50 * rim), height_unit=env.cell.height_unit / 50)
        measured = state._replace(
            surface=surface_from(50 * state.heights, state.surface & 1), tote_height=50 * state.tote_height,
            items=state.items._replace(h=50 * state.items.h),
        )  # fmt: skip
        for make, _ in COSTS:
            planner = make(env.cell)
            action = planner.choose(fine, measured, placing_maps(fine, measured), observation)
            assert torch.equal(action, planner.decide(observation))


@pytest.mark.slow
def test_corner_packs_about_as_well_as_joint_dbl():
    packed = [
        occupancies(planner(PickPlaceEnv(num_envs=1).cell), PickPlaceEnv(num_envs=40, masks=(), stream="test")).mean()
        for planner in (Corner, JointDBL)
    ]
    assert packed[0] > packed[1] - 0.01
    with pytest.raises(ValueError, match="planner.height_weight=-1: expected a number >= 0"):
        Corner(PickPlaceEnv(num_envs=1).cell, -1)


def test_random_planners_are_uniform():
    env = PickPlaceEnv(num_envs=1, tote_size=(4, 4, 2), bin_size=(4, 4, 1))
    observation = env.reset().expand(20_000).contiguous()
    mask = observation["action_mask"][0]
    for planner, allowed in ((RandomFeasible, mask), (UniformRandom, torch.ones_like(mask))):
        count = torch.bincount(planner(env.cell).decide(observation), minlength=env.cell.num_actions)
        assert not count[~allowed].any() and chisquare(count[allowed]).pvalue > 1e-4
        with pytest.raises(ValueError, match="planner.seed=-1"):
            planner(env.cell, seed=-1)


@pytest.mark.parametrize("options", SETTINGS)
def test_random_feasible_plays_feasible_actions_only(options):
    for env, observation in random_states(steps=4, **options):
        action = RandomFeasible(env.cell, seed=7).decide(observation)
        assert observation["action_mask"].gather(1, action[:, None]).all()
        unmasked = observation.exclude("action_mask")  # as in an evaluation, where the planner makes its own mask
        assert torch.equal(RandomFeasible(env.cell, seed=7).decide(unmasked), action)


PLANNERS = [JointDBL, Corner, HeightmapMinimisation, IndividualHeuristic, BestFit, OnlineBPH, MCTS]


@pytest.mark.parametrize("planner", PLANNERS)
def test_it_does_not_matter_how_an_item_lies_in_the_bin(planner):
    """Three items of 4x3x3 fill the tote, also if they are written as 3x4x3."""
    for kind in ((4, 3, 3), (3, 4, 3)):
        point = {"effector_size": (1, 1), "pick_rule": "overlap", "support": "half"}
        env = PickPlaceEnv([kind], num_envs=4, tote_size=(9, 4, 3), rotations=2, **point)
        settings = {"items": env.items, "simulations": 200, "mask": True} if planner is MCTS else {}
        assert occupancies(planner(env.cell, **settings), env).tolist() == [1] * 4
