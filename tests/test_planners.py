"""Planners: the reference figures of the rules, brute force, and what K candidates mean."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pickplace import PickPlaceEnv
from pickplace.evaluate import play
from pickplace.items import Uniform
from pickplace.models.actors import FlatPolicy, GraspPolicy, OutcomePolicy, as_actor, as_collection_policy
from pickplace.planners import JointDBL, PolicyPlanner, RandomFeasible

# planner, tote, R, items, occupancy and its standard error, from an independent prototype of the rules; where no
# standard error is known, half a unit of the last digit and one unit more.
REFERENCE = [
    ("random", (6, 6, 1), 4, "paper", 0.746, 0.006),
    ("random", (6, 6, 5), 1, "paper", 0.256, 0.003),
    ("random", (6, 6, 5), 3, "paper", 0.258, 0.003),
    ("random", (6, 6, 5), 4, "paper", 0.257, 0.003),
    ("random", (6, 6, 10), 4, "paper", 0.206, 0.002),
    ("random", (6, 6, 5), 4, "mixed", 0.36, 0.010),
    ("joint_dbl", (6, 6, 1), 4, "paper", 0.931, 0.003),
    ("joint_dbl", (6, 6, 5), 1, "paper", 0.955, 0.001),
    ("joint_dbl", (6, 6, 5), 3, "paper", 0.978, 0.001),
    ("joint_dbl", (6, 6, 5), 4, "paper", 0.981, 0.001),
    ("joint_dbl", (6, 6, 10), 1, "paper", 0.959, 0.001),
    ("joint_dbl", (6, 6, 10), 4, "paper", 0.986, 0.001),
    ("joint_dbl", (10, 10, 5), 4, "paper", 0.991, 0.001),
    ("joint_dbl", (6, 6, 5), 4, "mixed", 0.635, 0.013),
    ("joint_dbl", (8, 8, 8), 4, "mixed", 0.753, 0.007),
]
PLANNERS = {"random": RandomFeasible, "joint_dbl": JointDBL}


@pytest.mark.parametrize(("planner", "tote", "rotations", "items", "mean", "error"), REFERENCE)
def test_reference_figures(planner, tote, rotations, items, mean, error):
    def make(first, count):
        kinds = None if items == "paper" else Uniform((1, 3), (1, 3), (1, 3))
        return PickPlaceEnv(
            tote_size=tote,
            rotations=rotations,
            items=kinds,
            num_envs=count,
            masks=(),
            stream="test",
            first_episode=first,
        )

    occupancy = play(make, PLANNERS[planner](make(0, 1).rules), 200, 200).occupancy
    own = float(occupancy.std() / len(occupancy) ** 0.5)
    assert abs(float(occupancy.mean()) - mean) < 2 * (own**2 + error**2) ** 0.5


def random_states(steps=12, **settings):
    """States along random feasible play, with their exact action masks."""
    env = PickPlaceEnv(**{"num_envs": 16, "seed": 3, **settings})
    planner, observation = RandomFeasible(env.rules, seed=1), env.reset()
    for _ in range(steps):
        yield env, observation
        action = planner.decide(observation)
        _, observation = env.step_and_maybe_reset(observation.set("action", action))


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"rotations": 1},
        {"tote_size": (7, 5, 4), "effector_size": (4, 2), "bin_size": (6, 4, 2), "rotations": 3},
        {"tote_size": (5, 6, 3), "effector_size": (2, 3), "pick_rule": "overlap", "rotations": 2},
    ],
)
def test_joint_dbl_is_the_least_top_y_x_over_all_actions(settings):
    for env, observation in random_states(**settings):
        rules = env.rules
        chosen = JointDBL(rules).decide(observation)
        for n in range(env.num_envs):
            actions = observation["action_mask"][n].nonzero()[:, 0]
            rows = torch.full((len(actions),), n)
            item = type(env.current_item)(*(part[rows] for part in env.current_item))
            step = rules.apply(env.heights[rows], env.tote_height[rows], item, actions)
            assert not step.failure.any()
            columns = (step.top, step.footprint[:, 1], step.footprint[:, 0], actions)
            keys = torch.stack(columns, 1).tolist()
            assert int(chosen[n]) == min(keys)[3]


def test_random_feasible_is_uniform():
    env = PickPlaceEnv(num_envs=1, tote_size=(4, 4, 2))
    observation = env.reset().expand(20_000).contiguous()
    count = torch.bincount(RandomFeasible(env.rules).decide(observation), minlength=env.rules.num_actions)
    mask = observation["action_mask"][0]
    assert not count[~mask].any()
    expected = 20_000 / int(mask.sum())
    chi2 = float(((count[mask] - expected) ** 2 / expected).sum())
    freedom = int(mask.sum()) - 1
    assert abs(chi2 - freedom) < 5 * (2 * freedom) ** 0.5


class Scripted(torch.nn.Module):
    """A policy whose most probable flat actions are the given ones, in that order."""

    choice_key = "action"

    def __init__(self, order, count):
        super().__init__()
        self.scores = torch.full((1, count), -100.0)
        for rank, action in enumerate(order):
            self.scores[0, action] = -float(rank)

    def action_log_probs(self, bin_depth, tote_depth):
        return self.scores.expand(len(bin_depth), -1)


def test_candidates_are_tried_in_order_without_a_mask():
    env = PickPlaceEnv(num_envs=1)
    observation = env.reset()
    mask = observation["action_mask"][0]
    good, bad = mask.nonzero()[:, 0].tolist(), (~mask).nonzero()[:, 0].tolist()
    order = [bad[0], bad[1], good[5], good[0], good[9]]
    policy = Scripted(order, env.rules.num_actions)

    def play_with(candidates):
        return int(PolicyPlanner(env.rules, policy, candidates).decide(observation))

    assert play_with(1) == bad[0]
    assert play_with(2) == bad[0]  # neither succeeds: the most probable is played, and fails
    assert play_with(3) == play_with(5) == play_with("all") == good[5]


@pytest.mark.parametrize("candidates", [0, -1, 1.5, True, "some"])
def test_bad_candidates(candidates):
    env = PickPlaceEnv(num_envs=1)
    with pytest.raises(ValueError, match=r"planner.candidates=.*expected 'all' or a whole number"):
        PolicyPlanner(env.rules, None, candidates)


SMALL = {"filters": 8, "hidden": 8, "head_std": 1.0}
SETTINGS = [
    {"tote_size": (4, 4, 2), "bin_size": (4, 4, 1)},
    {"tote_size": (4, 5, 3), "bin_size": (4, 3, 1), "effector_size": (3, 2), "rotations": 3},
    {"tote_size": (4, 4, 2), "bin_size": (3, 3, 1), "rotations": 1, "pick_rule": "overlap"},
]


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("policy_type", [OutcomePolicy, GraspPolicy])
def test_flat_distribution_is_one(policy_type, settings):
    torch.manual_seed(0)
    for env, observation in random_states(steps=6, **settings):
        policy = policy_type(env.rules, **SMALL)
        log_probs = policy.action_log_probs(observation["bin_depth"], observation["tote_depth"])
        assert log_probs.shape == (env.num_envs, env.rules.num_actions)
        torch.testing.assert_close(log_probs.exp().sum(1), torch.ones(env.num_envs), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("settings", SETTINGS)
def test_outcomes_are_the_distinct_results_of_the_feasible_actions(settings):
    for env, observation in random_states(masks=("action", "outcome"), **settings):
        rules = env.rules
        flat = rules.action_outcomes(env.current_item)
        reached = torch.zeros(env.num_envs, rules.num_outcomes + 1, dtype=torch.bool)
        reached.scatter_(1, torch.where(observation["action_mask"], flat, -1) + 1, True)
        assert torch.equal(reached[:, 1:], observation["outcome_mask"])
        placements = rules.placements(env.heights, env.tote_height, env.current_item)
        assert torch.equal(rules.num_feasible(placements), observation["action_mask"].sum(1))


@pytest.mark.parametrize("policy_type", [OutcomePolicy, GraspPolicy])
def test_sampled_actions_follow_the_flat_distribution(policy_type):
    """Chi-square of 40,000 draws; for the masked policy, the flat distribution restricted to what is feasible."""
    torch.manual_seed(0)
    env = PickPlaceEnv(num_envs=1, tote_size=(3, 3, 2), bin_size=(3, 3, 1), masks=("action", "outcome"), seed=5)
    policy = policy_type(env.rules, **SMALL)
    observation = env.reset()
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():  # as in a collector
        draws = as_collection_policy(policy)(observation.expand(40_000).contiguous())["action"]
    count = torch.bincount(draws, minlength=env.rules.num_actions).double()
    if policy_type is GraspPolicy:
        share = policy.action_log_probs(observation["bin_depth"], observation["tote_depth"])[0].double().exp()
    else:  # even over the feasible actions of each outcome
        flat = env.rules.action_outcomes(env.current_item)[0]
        mask = observation["action_mask"][0]
        logits = policy(observation["bin_depth"], observation["tote_depth"], observation["outcome_mask"])[0]
        outcome = logits.double().softmax(0)
        ways = torch.bincount(flat[mask], minlength=env.rules.num_outcomes)
        share = torch.where(mask, outcome[flat.clamp(min=0)] / ways[flat.clamp(min=0)].clamp(min=1), 0.0)
        assert not count[~mask].any()
    expected = share * 40_000
    kept = expected > 5
    chi2, freedom = float(((count - expected)[kept] ** 2 / expected[kept]).sum().detach()), int(kept.sum()) - 1
    assert abs(chi2 - freedom) < 5 * (2 * freedom) ** 0.5


@pytest.mark.parametrize("policy_type", [OutcomePolicy, GraspPolicy])
def test_log_prob_of_the_choice_is_what_the_loss_sees(policy_type):
    torch.manual_seed(0)
    env = PickPlaceEnv(num_envs=64, masks=("outcome",))
    policy = policy_type(env.rules, **SMALL)
    out = as_collection_policy(policy)(env.reset())
    log_prob = as_actor(policy).get_dist(out).log_prob(out[policy.choice_key])
    torch.testing.assert_close(out["log_prob"], log_prob)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        again = as_collection_policy(policy)(TensorDict(dict(out.items()), batch_size=[64]))
    assert torch.equal(again[policy.choice_key], as_actor(policy).get_dist(out).logits.argmax(1))


@pytest.mark.parametrize("policy_type", [OutcomePolicy, GraspPolicy, FlatPolicy])
def test_weights_serve_fewer_rotations_and_other_totes(policy_type):
    """The logits of the actions that remain are those of the policy trained with all four rotations."""
    torch.manual_seed(0)
    sizes = {"filters": 8, "head_std": 1.0, "compute_dtype": "float32"}
    sizes |= {} if policy_type is FlatPolicy else {"hidden": 8}
    env = PickPlaceEnv(num_envs=2)
    observation = env.reset()
    policy = policy_type(env.rules, **sizes)
    for rotations, tote in ((1, (6, 6, 5)), (3, (6, 6, 5)), (2, (7, 9, 4))):
        rules = PickPlaceEnv(rotations=rotations, tote_size=tote, num_envs=1).rules
        fewer = policy_type(rules, **sizes)
        fewer.load_state_dict(policy.state_dict())
        depth = torch.full((2, *tote[:2]), float(tote[2]))
        assert fewer.action_log_probs(observation["bin_depth"], depth).shape == (2, rules.num_actions)
        if tote == (6, 6, 5) and policy_type is FlatPolicy:
            every = policy.action_log_probs(observation["bin_depth"], depth).unflatten(1, (-1, 4))[..., :rotations]
            few = fewer.action_log_probs(observation["bin_depth"], depth)
            torch.testing.assert_close(few, every.flatten(1).log_softmax(1), rtol=1e-4, atol=1e-4)
