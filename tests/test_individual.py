"""Individual planning against brute force and the reference's figures."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import Item, PickPlaceEnv, Rules
from pickplace.evaluation.evaluate import play
from pickplace.planners import IndividualHeuristic, PolicyPlanner, RandomFeasible
from pickplace.planners.individual import corner_footprints
from pickplace.policies.actors import fcn4d, fcn_grasp, individual_grasp, individual_rl


def maximal_rectangles(free):
    """All ``(x, y, width, depth)`` of free cells that no side of which can move outwards, by trying every one."""
    wide, deep = len(free), len(free[0])

    def is_free(x, y, w, d):
        inside = x >= 0 and y >= 0 and x + w <= wide and y + d <= deep
        return inside and all(free[i][j] for i in range(x, x + w) for j in range(y, y + d))

    for x, y in itertools.product(range(wide), range(deep)):
        for w, d in itertools.product(range(1, wide - x + 1), range(1, deep - y + 1)):
            larger = ((x - 1, y, w + 1, d), (x, y - 1, w, d + 1), (x, y, w + 1, d), (x, y, w, d + 1))
            if is_free(x, y, w, d) and not any(is_free(*each) for each in larger):
                yield x, y, w, d


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), wide=st.integers(2, 6), deep=st.integers(2, 6), steps=st.integers(1, 4))
def test_corners_of_maximal_rectangles(seed, wide, deep, steps):
    generator = torch.Generator().manual_seed(seed)
    rules = Rules(tote_size=(wide, deep, 6), rotations=4)
    heights = torch.randint(steps, (3, wide, deep), generator=generator).int()
    w, d, h = (torch.randint(1, 3, (3,), generator=generator) for _ in range(3))
    item = Item(torch.zeros_like(w), torch.zeros_like(w), w, d, h)
    top = rules.resting_top(heights, torch.full((3,), 6), item)
    found = corner_footprints(rules, heights, top, item)
    for n, parity in itertools.product(range(3), range(2)):
        size = (int(w[n]), int(d[n])) if parity == 0 else (int(d[n]), int(w[n]))
        expected = torch.zeros(wide, deep, dtype=torch.bool)
        for z in range(steps):
            for x, y, a, b in maximal_rectangles((heights[n] <= z).tolist()):
                if a >= size[0] and b >= size[1]:
                    for i, j in itertools.product((x, x + a - size[0]), (y, y + b - size[1])):
                        expected[i, j] |= int(top[n, parity, i, j]) == z + int(h[n])
        assert torch.equal(found[n, parity], expected)


@pytest.mark.parametrize("wall", [1, 2])
def test_the_pick_is_the_corner_of_the_effector_where_it_can_be(wall):
    rules = Rules(bin_size=(5, 5, wall))
    x, y = torch.arange(25) // 5, torch.arange(25) % 5
    one = torch.ones(25, dtype=torch.int64)
    # The reference cell is the middle of the 3x3 effector; it must be a cell of the bin, and under walls that are
    # higher than the item the whole effector must stay inside.
    most = 4 if wall == 1 else 3
    expected = (x + 1).clamp(max=most) * 5 + (y + 1).clamp(max=most)
    assert torch.equal(rules.heuristic_pick(Item(x, y, one, one, one)), expected)


@pytest.mark.parametrize(("rotations", "reference"), [(1, 0.569), (3, 0.922)])
def test_every_cell_meets_the_reference(rotations, reference):
    rules = PickPlaceEnv(rotations=rotations, num_envs=1).rules
    planner = IndividualHeuristic(rules, "cells")

    def make_env(first, count):
        return PickPlaceEnv(rotations=rotations, num_envs=count, masks=(), stream="test", seed=5, first_episode=first)

    occupancy = play(make_env, planner, 500, 250).occupancy
    error = float(occupancy.std() / len(occupancy) ** 0.5)
    assert abs(float(occupancy.mean()) - reference) < 3 * error + 0.0005


def random_states(rules, count, seed, steps=8):
    """Bins and totes in the middle of a random episode."""
    sizes = {"rotations": rules.rotations, "effector_size": rules.effector_size}
    env = PickPlaceEnv(**sizes, num_envs=count, masks=("action",), seed=seed)
    planner = RandomFeasible(rules, seed)
    td = env.reset()
    for _ in range(steps):
        _, td = env.step_and_maybe_reset(td.set("action", planner.decide(td)))
    return td


#: Individual policies, and the joint ones whose networks they have.
NETWORKS = {individual_rl: fcn4d, individual_grasp: fcn_grasp}
both = pytest.mark.parametrize("individual", NETWORKS)


@pytest.mark.parametrize("rotations", [1, 3, 4])
@both
def test_an_individual_policy_is_the_joint_one_at_the_heuristic_pick(individual, rotations):
    rules = PickPlaceEnv(rotations=rotations, num_envs=1).rules
    td = random_states(rules, 32, rotations)
    maps = td["bin_depth"], td["tote_depth"]
    policy = individual(rules, mask_infeasible=False, filters=6, head_std=1.0)
    joint = NETWORKS[individual](rules, mask_infeasible=False, filters=6)
    joint.load_state_dict(policy.state_dict())
    pick = rules.heuristic_pick(rules.read_item(td["bin_depth"]))
    rows = torch.arange(32)
    expected = joint.action_log_probs(*maps).unflatten(1, (rules.num_picks, -1))[rows, pick].log_softmax(-1)
    assert torch.allclose(policy(*maps).log_softmax(-1), expected, atol=1e-5)
    # Over the flat actions it is the same distribution, with nothing at any other pick.
    over_actions = policy.action_log_probs(*maps).exp().unflatten(1, (rules.num_picks, -1))
    assert torch.allclose(over_actions.sum((1, 2)), torch.ones(32))
    assert torch.allclose(over_actions[rows, pick].sum(1), torch.ones(32))


@pytest.mark.parametrize("candidates", [1, 200, "all"])
@both
def test_an_individual_policy_never_picks_elsewhere(individual, candidates):
    rules = PickPlaceEnv(rotations=1, num_envs=1).rules
    td = random_states(rules, 512, 0, steps=12)
    policy = individual(rules, mask_infeasible=False, filters=6, head_std=1.0)
    action = PolicyPlanner(rules, policy, candidates).decide(td)
    pick = rules.heuristic_pick(rules.read_item(td["bin_depth"]))
    assert torch.equal(action // (rules.num_places * rules.rotations), pick)
    # Without turning, some items cannot be put down from this pick though they could be from another.
    at_pick = td["action_mask"].unflatten(1, (rules.num_picks, -1))[torch.arange(512), pick].any(1)
    assert td["action_mask"].any(1).all() and not at_pick.all()
    if candidates != 1:
        assert torch.equal(td["action_mask"].gather(1, action[:, None])[:, 0], at_pick)


@pytest.mark.parametrize("rotations, effector", [(1, (3, 3)), (4, (3, 3)), (4, (2, 3))])
@both
def test_an_individual_policy_under_a_mask_fails_where_it_must(individual, rotations, effector):
    rules = PickPlaceEnv(rotations=rotations, effector_size=effector, num_envs=1).rules
    td = random_states(rules, 512, 0, steps=12)
    maps = td["bin_depth"], td["tote_depth"], td["tote_height"][:, 0]
    policy = individual(rules, mask_infeasible=True, filters=6, head_std=1.0)
    choice = policy(*maps[:2], td["action_mask"]).argmax(1)
    pick = rules.heuristic_pick(rules.read_item(td["bin_depth"]))
    possible = td["action_mask"].unflatten(1, (rules.num_picks, -1))[torch.arange(512), pick].any(1)
    assert possible.any() and (rotations > 1 or not possible.all())
    for action in (policy.to_action(choice, *maps), PolicyPlanner(rules, policy, "all").decide(td)):
        assert torch.equal(action // (rules.num_places * rotations), pick)
        assert torch.equal(td["action_mask"].gather(1, action[:, None])[:, 0], possible)


def test_with_a_mask_it_is_the_joint_network_among_the_footprints_that_the_heuristic_pick_reaches():
    rules = PickPlaceEnv(rotations=4, num_envs=1).rules
    td = random_states(rules, 16, 1, steps=9)
    maps = td["bin_depth"], td["tote_depth"], td["tote_height"][:, 0]
    policy = individual_grasp(rules, mask_infeasible=True, filters=6, head_std=1.0)
    joint = fcn_grasp(rules, mask_infeasible=True, filters=6)
    joint.load_state_dict(policy.state_dict())
    pick = rules.heuristic_pick(rules.read_item(td["bin_depth"]))
    reached = torch.zeros(16, rules.num_outcomes, dtype=torch.bool)
    each = rules.num_places * rules.rotations
    for row in range(16):
        for action in range(int(pick[row]) * each, (int(pick[row]) + 1) * each):
            if td["action_mask"][row, action]:
                reached[row, joint.to_choice(torch.tensor([action]), *(part[row : row + 1] for part in maps))] = True
    assert reached.any(1).all()
    logits = policy(*maps[:2], td["action_mask"])
    assert torch.allclose(logits.softmax(1), joint(*maps[:2], reached).softmax(1), atol=1e-6)
    # Over the flat actions, without the mask: one, at the heuristic pick, even over the ways to a footprint.
    over_actions = policy.action_log_probs(*maps[:2]).exp()
    assert torch.allclose(over_actions.sum(1), torch.ones(16))
    assert torch.allclose(over_actions.unflatten(1, (-1, each))[torch.arange(16), pick].sum(1), torch.ones(16))


def test_bad_candidates():
    with pytest.raises(ValueError, match=r"planner.candidates='all': expected 'corners' or 'cells'"):
        IndividualHeuristic(Rules(), "all")


@pytest.mark.parametrize("candidates", ["corners", "cells"])
@pytest.mark.parametrize(("rotations", "tote"), [(1, (6, 6, 5)), (3, (5, 7, 3)), (4, (7, 5, 3))])
def test_the_first_candidate_that_succeeds_is_played(candidates, rotations, tote):
    """In the order (top, y, x, flat index); if all fail the first; and corners are fewer than cells."""
    env = PickPlaceEnv(rotations=rotations, tote_size=tote, num_envs=48, masks=("action",), seed=1)
    rules, td = env.rules, env.reset()
    for _ in range(6):
        _, td = env.step_and_maybe_reset(td.set("action", RandomFeasible(rules, 1).decide(td)))
    item, heights, height = env.current_item, env.heights, env.tote_height
    top = rules.resting_top(heights, height, item)
    corners = corner_footprints(rules, heights, top, item)
    each = rules.num_places * rules.rotations
    first = rules.heuristic_pick(item) * each
    failed = torch.stack([rules.apply(heights, height, item, first + n).failure for n in range(each)], 1)
    lies = torch.stack([rules.apply(heights, height, item, first + n).footprint for n in range(each)], 1)
    chosen = IndividualHeuristic(rules, candidates).decide(td) - first
    missed = 0
    for row in range(48):
        found = []
        for n, (x, y, w, d) in enumerate(lies[row].tolist()):
            if min(x, y) < 0 or x + w > tote[0] or y + d > tote[1]:
                continue
            parity = n % rotations % 2
            if candidates == "cells" or corners[row, parity, x, y]:
                found.append((failed[row, n].item() > 0, top[row, parity, x, y].item(), y, x, n))
        if found:
            assert chosen[row] == min(found)[-1]
            missed += min(found)[0]
    assert candidates == "cells" or missed > 0
