"""Policies of individual planning against the joint ones whose networks they have."""

import pytest
import torch
from problems import late_state

from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.fcn4d.policy import Fcn4d
from pickplace.policies.fcn_grasp.policy import fcn_grasp
from pickplace.policies.individual.policy import IndividualRl, individual_grasp
from pickplace.rules.grasps import heuristic_pick, select_pick

NETWORKS = {IndividualRl: Fcn4d, individual_grasp: fcn_grasp}
both = pytest.mark.parametrize("individual", NETWORKS)


def prepared(individual, masked, **settings):
    """Return environment, observation, the policy, the joint one with its weights, and the heuristic pick."""
    env, observation = late_state(**settings)
    torch.manual_seed(0)
    policy = individual(env.cell, mask_infeasible=masked, filters=6, head_std=1.0)
    joint = NETWORKS[individual](env.cell, mask_infeasible=masked, filters=6)
    joint.load_state_dict(policy.state_dict())
    return env, observation, policy, joint, heuristic_pick(env.cell, env.state.items.rows((slice(None), 0)))


@pytest.mark.parametrize("rotations", [1, 3, 4])
@both
def test_an_individual_policy_is_the_joint_one_at_the_heuristic_pick(individual, rotations):
    env, observation, policy, joint, pick = prepared(individual, False, rotations=rotations)
    expected = select_pick(env.cell, joint.action_log_probs(observation), pick).log_softmax(-1)
    torch.testing.assert_close(policy.logits(observation).log_softmax(-1), expected, rtol=1e-5, atol=1e-5)
    # Over the flat actions it is the same distribution, with nothing at any other pick.
    over_actions = policy.action_log_probs(observation).exp()
    torch.testing.assert_close(over_actions.sum(1), torch.ones(16))
    torch.testing.assert_close(select_pick(env.cell, over_actions, pick), expected.exp(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("rotations", "effector"), [(1, (3, 3)), (4, (3, 3)), (4, (2, 3))])
@both
def test_an_individual_policy_picks_nowhere_else_and_fails_where_it_must(individual, masked, rotations, effector):
    settings = {"rotations": rotations, "effector_size": effector, "num_envs": 192, "steps": 12, "seed": 0}
    env, observation, policy, _, pick = prepared(individual, masked, **settings)
    # Without turning, some items cannot be put down from this pick though they could be from another.
    possible = select_pick(env.cell, observation["action_mask"], pick).any(1)
    assert observation["action_mask"].any(1).all() and possible.any() and (rotations > 1 or not possible.all())
    actions = [PolicyPlanner(env.cell, policy, candidates).decide(observation) for candidates in ("all", 200, 1)]
    if masked:
        actions[1] = policy.to_action(policy.logits(observation).argmax(1), observation)
    for number, action in enumerate(actions):
        assert torch.equal(action // (env.cell.num_places * rotations), pick)
        if number < 2:
            assert torch.equal(observation["action_mask"].gather(1, action[:, None])[:, 0], possible)


def test_with_a_mask_it_is_the_joint_network_among_the_footprints_that_the_heuristic_pick_reaches():
    env, observation, policy, joint, pick = prepared(individual_grasp, True, seed=1)
    reached = torch.zeros(16, env.cell.num_footprints, dtype=torch.bool)
    each = env.cell.num_places * env.cell.rotations
    for row in range(16):
        for action in observation["action_mask"][row].nonzero()[:, 0]:
            if action // each == pick[row]:
                reached[row, joint.to_choice(action[None], observation[[row]])] = True
    assert reached.any(1).all()
    expected = joint.footprint_logits(observation, reached).softmax(1)
    torch.testing.assert_close(policy.logits(observation).softmax(1), expected, rtol=1e-5, atol=1e-6)
