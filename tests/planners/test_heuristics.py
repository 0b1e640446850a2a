"""Planners without training: the reference figures of the rules, brute force over all feasible actions, and chance."""

import pytest
import torch
from problems import SETTINGS, choice_by_hand, occupancies, random_states, results_by_hand
from scipy.stats import chisquare

from pickplace import PickPlaceEnv
from pickplace.items.distributions import Uniform
from pickplace.planners.heuristics import Corner, HeightmapMinimisation, JointDBL, RandomFeasible, UniformRandom

# Planner and items; tote, R, occupancy and its standard error, from an independent prototype of the rules. Where no
# error is known (None): that of 100 episodes, as those of joint_dbl with mixed items are, and of rounding to 0.01.
PAPER, MIXED = None, Uniform((1, 3), (1, 3), (1, 3))
REFERENCE = {
    (RandomFeasible, PAPER): [
        ((6, 6, 1), 4, 0.746, 0.006), ((6, 6, 5), 1, 0.256, 0.003), ((6, 6, 5), 3, 0.258, 0.003),
        ((6, 6, 5), 4, 0.257, 0.003), ((6, 6, 10), 1, 0.205, 0.002), ((6, 6, 10), 3, 0.208, 0.002),
        ((6, 6, 10), 4, 0.206, 0.002),
    ],
    (RandomFeasible, MIXED): [((6, 6, 5), 4, 0.36, None), ((8, 8, 8), 4, 0.32, None)],
    (JointDBL, PAPER): [
        ((6, 6, 1), 4, 0.931, 0.003), ((6, 6, 5), 1, 0.955, 0.001), ((6, 6, 5), 3, 0.978, 0.001),
        ((6, 6, 5), 4, 0.981, 0.001),
    ],
    (JointDBL, MIXED): [((6, 6, 5), 4, 0.635, 0.013)],
}  # fmt: skip
SLOW_REFERENCE = {
    (RandomFeasible, MIXED): [((10, 10, 10), 4, 0.31, None)],
    (JointDBL, PAPER): [
        ((6, 6, 10), 1, 0.959, 0.001), ((6, 6, 10), 3, 0.983, 0.001), ((6, 6, 10), 4, 0.986, 0.001),
        ((10, 10, 5), 3, 0.990, 0.001), ((10, 10, 5), 4, 0.991, 0.001), ((10, 10, 10), 3, 0.995, 0.001),
        ((10, 10, 10), 4, 0.995, 0.001),
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


def corner_cost(height_weight):
    """Return what ``Corner`` minimises, of an action, its footprint and ``(top, y, x, w, d)``."""
    return lambda action, footprint, found: (height_weight * found[0] + found[1] + found[2], footprint, action)


def raised_by(env, n, found):
    """Return the sum of all heights after an entry of :func:`results_by_hand`, less the sum before."""
    top, y, x, w, d, _ = found
    heights = env.state.heights[n].tolist()
    return sum(top - heights[a][b] for a in range(x, x + w) for b in range(y, y + d))


@pytest.mark.parametrize("options", SETTINGS)
@pytest.mark.parametrize("weight", [0.01, 0, 3])
def test_heightmap_minimisation_raises_the_heights_least(weight, options):
    for env, observation in random_states(**options):
        chosen = HeightmapMinimisation(env.cell, weight).decide(observation)
        for n in range(env.num_envs):
            items = env.state.items.cuboids[n].tolist()
            costs = {
                action: (
                    raised_by(env, n, found) + weight * (found[1] + found[2]),
                    choice_by_hand(env.cell, items, found), action,
                )
                for action, found in results_by_hand(env, observation, n).items()
            }  # fmt: skip
            assert int(chosen[n]) == min(costs, key=costs.get)


@pytest.mark.parametrize(
    ("make", "cost"),
    [
        (JointDBL, lambda action, footprint, found: (*found[:3], action)),
        (Corner, corner_cost(10)),
        (lambda cell: Corner(cell, height_weight=0.5), corner_cost(0.5)),
    ],
)
@pytest.mark.parametrize("options", SETTINGS)
def test_the_least_cost_over_all_feasible_actions_is_played(make, cost, options):
    for env, observation in random_states(**options):
        chosen = make(env.cell).decide(observation)
        assert torch.equal(make(env.cell).decide(observation.exclude("action_mask")), chosen)
        for n in range(env.num_envs):
            costs = {
                action: cost(action, choice_by_hand(env.cell, env.state.items.cuboids[n].tolist(), found), found)
                for action, found in results_by_hand(env, observation, n).items()
            }
            assert int(chosen[n]) == min(costs, key=costs.get)


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
