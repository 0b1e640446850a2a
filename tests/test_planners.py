"""Planners: the reference figures of the rules, brute force, and what K candidates mean."""

import oracle
import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pickplace import PickPlaceEnv
from pickplace.evaluation.evaluate import play
from pickplace.planners import JointDBL, PolicyPlanner, RandomFeasible
from pickplace.policies.actors import FlatPolicy, GraspPolicy, OutcomePolicy, as_actor, as_collection_policy
from pickplace.task.items import Uniform

# planner, tote, R, items, occupancy and its standard error, from an independent prototype of the rules. Where no error
# is known (None): that of 100 episodes, as those of joint_dbl with mixed items are, and of rounding to 0.01.
REFERENCE = [
    ("random", (6, 6, 1), 4, "paper", 0.746, 0.006),
    ("random", (6, 6, 5), 1, "paper", 0.256, 0.003),
    ("random", (6, 6, 5), 3, "paper", 0.258, 0.003),
    ("random", (6, 6, 5), 4, "paper", 0.257, 0.003),
    ("random", (6, 6, 10), 1, "paper", 0.205, 0.002),
    ("random", (6, 6, 10), 3, "paper", 0.208, 0.002),
    ("random", (6, 6, 10), 4, "paper", 0.206, 0.002),
    ("random", (6, 6, 5), 4, "mixed", 0.36, None),
    ("random", (8, 8, 8), 4, "mixed", 0.32, None),
    ("joint_dbl", (6, 6, 1), 4, "paper", 0.931, 0.003),
    ("joint_dbl", (6, 6, 5), 1, "paper", 0.955, 0.001),
    ("joint_dbl", (6, 6, 5), 3, "paper", 0.978, 0.001),
    ("joint_dbl", (6, 6, 5), 4, "paper", 0.981, 0.001),
    ("joint_dbl", (6, 6, 10), 1, "paper", 0.959, 0.001),
    ("joint_dbl", (6, 6, 10), 3, "paper", 0.983, 0.001),
    ("joint_dbl", (6, 6, 10), 4, "paper", 0.986, 0.001),
    ("joint_dbl", (10, 10, 5), 4, "paper", 0.991, 0.001),
    ("joint_dbl", (6, 6, 5), 4, "mixed", 0.635, 0.013),
    ("joint_dbl", (8, 8, 8), 4, "mixed", 0.753, 0.007),
]
SLOW_REFERENCE = [
    ("random", (10, 10, 10), 4, "mixed", 0.31, None),
    ("joint_dbl", (10, 10, 5), 3, "paper", 0.990, 0.001),
    ("joint_dbl", (10, 10, 10), 3, "paper", 0.995, 0.001),
    ("joint_dbl", (10, 10, 10), 4, "paper", 0.995, 0.001),
    ("joint_dbl", (10, 10, 10), 4, "mixed", 0.819, 0.004),
]
PLANNERS = {"random": RandomFeasible, "joint_dbl": JointDBL}


@pytest.mark.parametrize(
    ("planner", "tote", "rotations", "items", "mean", "error", "episodes"),
    [(*row, 200) for row in REFERENCE] + [pytest.param(*row, 600, marks=pytest.mark.slow) for row in SLOW_REFERENCE],
)
def test_reference_figures(planner, tote, rotations, items, mean, error, episodes):
    """Within two standard errors of the difference."""

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

    occupancy = play(make, PLANNERS[planner](make(0, 1).rules), episodes, 200).occupancy
    variance = float(occupancy.var())
    theirs = error**2 if error else variance / 100 + 0.01**2 / 12
    assert abs(float(occupancy.mean()) - mean) < 2 * (variance / episodes + theirs) ** 0.5


def random_states(steps=12, **settings):
    """States along random feasible play, with their exact action masks."""
    env = PickPlaceEnv(**{"num_envs": 16, "seed": 3, **settings})
    planner, observation = RandomFeasible(env.rules, seed=1), env.reset()
    for _ in range(steps):
        yield env, observation
        action = planner.decide(observation)
        _, observation = env.step_and_maybe_reset(observation.set("action", action))


STATES = [
    {"num_envs": 4},
    {"num_envs": 8, "rotations": 1},
    {"num_envs": 8, "rotations": 2, "tote_size": (4, 3, 1)},
    {"num_envs": 4, "tote_size": (7, 5, 4), "effector_size": (4, 2), "bin_size": (6, 4, 2), "rotations": 3},
    {"num_envs": 4, "tote_size": (5, 6, 3), "effector_size": (2, 3), "pick_rule": "overlap", "rotations": 2},
    {"num_envs": 4, "tote_size": (5, 5, 4), "items": Uniform((1, 2), (1, 3), (1, 2)), "strict_support": True},
]


def actions_by_hand(env, observation, row):
    """Every feasible flat action of a problem, in plain Python: {action: (top, footprint y, footprint x, w, d)}."""
    rules = env.rules
    plain = oracle.Rules(
        rules.bin_size, rules.tote_size, rules.effector_size, rules.rotations,
        rules.pick_rule, rules.min_support, rules.strict_support,
    )  # fmt: skip
    item = [int(part[row]) for part in env.current_item]
    state = oracle.Oracle(
        plain, int(observation["tote_height"][row]), tuple(item[2:]), tuple(item[:2]), env.heights[row].tolist()
    )
    found = {}
    for action in observation["action_mask"][row].nonzero()[:, 0].tolist():
        failure, after = state.try_action(action)
        assert failure == oracle.SUCCESS
        # What the item changed is its footprint, for it has a height and lands on top.
        changed = [(x, y) for x, y in oracle.cells((0, 0), rules.tote_size[:2]) if after[x][y] != state.heights[x][y]]
        (x, y), (x1, y1) = min(changed), max(changed)
        found[action] = (after[x][y], y, x, x1 - x + 1, y1 - y + 1)
    return found


@pytest.mark.parametrize("settings", STATES)
def test_joint_dbl_is_the_least_top_y_x_over_all_actions(settings):
    for env, observation in random_states(**settings):
        chosen = JointDBL(env.rules).decide(observation)
        unmasked = observation.exclude("action_mask")
        assert torch.equal(JointDBL(env.rules).decide(unmasked), chosen)
        for n in range(env.num_envs):
            found = actions_by_hand(env, observation, n)
            assert int(chosen[n]) == min(found, key=lambda action: (found[action][:3], action))


def test_random_feasible_is_uniform():
    env = PickPlaceEnv(num_envs=1, tote_size=(4, 4, 2))
    observation = env.reset().expand(20_000).contiguous()
    count = torch.bincount(RandomFeasible(env.rules).decide(observation), minlength=env.rules.num_actions)
    mask = observation["action_mask"][0]
    assert not count[~mask].any()
    assert chisquare(count[mask]).pvalue > 1e-4


@pytest.mark.parametrize("settings", STATES)
def test_random_feasible_plays_feasible_actions_only(settings):
    for env, observation in random_states(**settings):
        action = RandomFeasible(env.rules, seed=7).decide(observation)
        assert observation["action_mask"].gather(1, action[:, None]).all()
        unmasked = observation.exclude("action_mask")  # as in an evaluation, where the planner makes its own mask
        assert torch.equal(RandomFeasible(env.rules, seed=7).decide(unmasked), action)


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

    def forward(self, bin_depth, tote_depth, action_mask):
        return torch.where(action_mask, self.action_log_probs(bin_depth, tote_depth), -1e9)


def test_candidates_are_tried_in_order_without_a_mask():
    env = PickPlaceEnv(num_envs=1)
    observation = env.reset()
    mask = observation["action_mask"][0]
    good, bad = mask.nonzero()[:, 0].tolist(), (~mask).nonzero()[:, 0].tolist()
    order = [bad[0], bad[1], good[5], good[0], good[9]]
    policy = Scripted(order, env.rules.num_actions)

    def play_with(candidates):
        return int(PolicyPlanner(env.rules, policy, candidates).decide(observation))

    assert play_with(1) == bad[0]  # not masked
    assert play_with(2) == bad[0]  # neither succeeds: the most probable is played, and fails
    assert play_with(3) == play_with(5) == play_with(env.rules.num_actions + 1) == play_with("all") == good[5]


class Noise(torch.nn.Module):
    """A policy whose flat distribution is noise, a different one for each problem."""

    choice_key = "action"

    def __init__(self, count, batch):
        super().__init__()
        self.scores = torch.randn(batch, count, generator=torch.Generator().manual_seed(0)).log_softmax(1)

    def action_log_probs(self, bin_depth, tote_depth):
        return self.scores

    def forward(self, bin_depth, tote_depth, action_mask):
        return torch.where(action_mask, self.action_log_probs(bin_depth, tote_depth), -1e9)


@pytest.mark.parametrize("candidates", [1, 4, 30, "all"])
@pytest.mark.parametrize("settings", STATES)
def test_candidates_of_each_problem(settings, candidates):
    for env, observation in random_states(steps=6, **settings):
        policy = Noise(env.rules.num_actions, env.num_envs)
        chosen = PolicyPlanner(env.rules, policy, candidates).decide(observation.exclude("action_mask")).tolist()
        for n in range(env.num_envs):
            mask, ranked = observation["action_mask"][n].tolist(), policy.scores[n].argsort(descending=True).tolist()
            tried = ranked if candidates == "all" else ranked[:candidates]
            assert chosen[n] == next((action for action in tried if mask[action]), ranked[0])


@pytest.mark.parametrize("candidates", [0, -1, 1.5, True, "some"])
def test_bad_candidates(candidates):
    env = PickPlaceEnv(num_envs=1)
    with pytest.raises(ValueError, match=r"planner.candidates=.*expected 'all' or a whole number"):
        PolicyPlanner(env.rules, None, candidates)


SMALL = {"filters": 8, "hidden": 8, "head_std": 1.0}
SETTINGS = [
    {"tote_size": (4, 4, 2), "bin_size": (4, 4, 1), "num_envs": 4},
    {"tote_size": (4, 5, 3), "bin_size": (4, 3, 1), "effector_size": (3, 2), "rotations": 3, "num_envs": 4},
    {"tote_size": (4, 4, 2), "bin_size": (3, 3, 1), "rotations": 1, "pick_rule": "overlap", "num_envs": 4},
]


def small(policy_type, rules):
    """A small policy with random weights, of which the distribution is far from even."""
    if policy_type is FlatPolicy:
        return FlatPolicy(rules, filters=4, head_std=1.0, compute_dtype="float32")
    return policy_type(rules, **SMALL)


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("policy_type", [OutcomePolicy, GraspPolicy, FlatPolicy])
def test_flat_distribution_is_one(policy_type, settings):
    torch.manual_seed(0)
    for env, observation in random_states(steps=6, **settings):
        policy = small(policy_type, env.rules)
        log_probs = policy.action_log_probs(observation["bin_depth"], observation["tote_depth"])
        assert log_probs.shape == (env.num_envs, env.rules.num_actions)
        torch.testing.assert_close(log_probs.exp().sum(1), torch.ones(env.num_envs), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("policy_type", [OutcomePolicy, GraspPolicy, FlatPolicy])
def test_all_candidates_are_the_best_feasible_action(policy_type, settings):
    """Also for the policy over outcomes, which never lists the actions: there, the best feasible outcome."""
    torch.manual_seed(0)
    for env, observation in random_states(steps=6, masks=("action", "outcome"), **settings):
        policy = small(policy_type, env.rules)
        action = PolicyPlanner(env.rules, policy, "all").decide(observation.exclude("action_mask", "outcome_mask"))
        assert observation["action_mask"].gather(1, action[:, None]).all()
        if policy_type is OutcomePolicy:
            logits = policy(*(observation[key] for key in policy.in_keys))
            reached = env.rules.action_outcomes(env.current_item).gather(1, action[:, None])[:, 0]
            assert torch.equal(reached, logits.argmax(1))
        else:
            score = policy.action_log_probs(observation["bin_depth"], observation["tote_depth"])
            assert torch.equal(action, score.masked_fill(~observation["action_mask"], -torch.inf).argmax(1))


def outcome_by_hand(rules, item, found):
    """Number of the footprint that a feasible action leaves, as ``outcome_mask`` counts; ``found`` as above."""
    _, y, x, w, d = found
    turned = (w, d) != (int(item.w), int(item.d))
    return (turned * rules.tote_size[0] + x) * rules.tote_size[1] + y


@pytest.mark.parametrize("settings", STATES)
def test_outcomes_are_the_distinct_results_of_the_feasible_actions(settings):
    for env, observation in random_states(masks=("action", "outcome"), **settings):
        rules = env.rules
        flat = rules.action_outcomes(env.current_item)
        for n in range(env.num_envs):
            item = type(env.current_item)(*(part[n] for part in env.current_item))
            by_hand = {a: outcome_by_hand(rules, item, f) for a, f in actions_by_hand(env, observation, n).items()}
            assert set(observation["outcome_mask"][n].nonzero()[:, 0].tolist()) == set(by_hand.values())
            assert all(int(flat[n, action]) == outcome for action, outcome in by_hand.items())
        placements = rules.placements(env.heights, env.tote_height, env.current_item)
        assert torch.equal(rules.num_feasible(placements), observation["action_mask"].sum(1))


@pytest.mark.parametrize("exploration", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
@pytest.mark.parametrize("settings", STATES)
def test_to_action_gives_an_action_of_the_outcome(settings, exploration):
    """For every feasible outcome, at random or the lowest one."""
    for env, observation in random_states(steps=4, masks=("action", "outcome"), **settings):
        policy, n = OutcomePolicy(env.rules, **SMALL), 0
        item = type(env.current_item)(*(part[n] for part in env.current_item))
        by_hand = {a: outcome_by_hand(env.rules, item, f) for a, f in actions_by_hand(env, observation, n).items()}
        outcomes = observation["outcome_mask"][n].nonzero()[:, 0]
        same = observation[[n] * len(outcomes)]
        with set_exploration_type(exploration):
            actions = policy.to_action(outcomes, *(same[key] for key in ("bin_depth", "tote_depth", "tote_height")))
        for outcome, action in zip(outcomes.tolist(), actions.tolist(), strict=True):
            assert by_hand[action] == outcome
            if exploration == ExplorationType.DETERMINISTIC:
                assert action == min(a for a, o in by_hand.items() if o == outcome)


@pytest.mark.parametrize("exploration", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
@pytest.mark.parametrize("settings", STATES)
def test_to_action_gives_an_action_of_the_grasp(settings, exploration):
    """For every choice that has an action, the last one being to miss the item."""
    for env, observation in random_states(steps=3, **settings):
        rules, policy = env.rules, GraspPolicy(env.rules, **SMALL)
        logits = policy(observation["bin_depth"], observation["tote_depth"])
        choices = (logits[0] > -1e8).nonzero()[:, 0]
        same = observation[[0] * len(choices)]
        with set_exploration_type(exploration):
            actions = policy.to_action(choices, same["bin_depth"], same["tote_depth"], same["tote_height"])
        assert ((actions >= 0) & (actions < rules.num_actions)).all()
        item = type(env.current_item)(*(part[:1] for part in env.current_item))
        failure, offset = rules.grasps(item)
        x_bin, y_bin, x, y, rotation = rules.split_action(actions)
        pick = x_bin * rules.bin_size[1] + y_bin
        missed = choices == len(logits[0]) - 1
        assert torch.equal(failure[0, pick] > 0, missed)
        grasp = rules.grasp_class(offset)[0, pick, rotation]
        place = x * rules.tote_size[1] + y
        assert torch.equal((grasp * rules.num_places + place)[~missed], choices[~missed])


@pytest.mark.parametrize("policy_type", [OutcomePolicy, GraspPolicy, FlatPolicy])
def test_sampled_actions_follow_the_flat_distribution(policy_type):
    """Chi-square of 40,000 draws; for the masked policy, the flat distribution restricted to what is feasible."""
    torch.manual_seed(0)
    env = PickPlaceEnv(num_envs=1, tote_size=(3, 3, 2), bin_size=(3, 3, 1), masks=("action", "outcome"), seed=5)
    policy = small(policy_type, env.rules)
    observation, draws = env.reset(), []
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():  # as in a collector
        for _ in range(8):
            draws.append(as_collection_policy(policy)(observation.expand(5_000).contiguous())["action"])
        log_probs = policy.action_log_probs(observation["bin_depth"], observation["tote_depth"])[0]
    count = torch.bincount(torch.cat(draws), minlength=env.rules.num_actions)
    share = log_probs.double().exp()
    if policy_type is OutcomePolicy:
        mask = observation["action_mask"][0]
        assert not count[~mask].any()
        # An outcome's probability is spread over all actions that lead there, of which the feasible ones are played.
        flat = env.rules.action_outcomes(env.current_item)[0]
        total, ways = share.new_zeros(env.rules.num_outcomes), torch.bincount(flat[mask], minlength=share.numel())
        total.scatter_add_(0, flat.clamp(min=0), torch.where(flat >= 0, share, 0.0))
        share = torch.where(mask, total[flat.clamp(min=0)] / ways[flat.clamp(min=0)].clamp(min=1), 0.0)
    expected = share / share.sum() * 40_000
    often = expected > 5
    rest = torch.stack([count[~often].sum().double(), expected[~often].sum()])
    counts = torch.cat([count[often].double(), rest[:1]]), torch.cat([expected[often], rest[1:]])
    kept = counts[1] > 1e-6
    assert chisquare(counts[0][kept], counts[1][kept]).pvalue > 1e-4


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
