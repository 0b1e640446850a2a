"""Properties of every policy: its choices, its distribution over flat actions, its best action."""

from dataclasses import replace

import pytest
import torch
from problems import SETTINGS, late_state, random_states
from scipy.stats import chisquare
from torchrl.envs.utils import ExplorationType, set_exploration_type
from untrained import CELLS, POLICIES, every_policy, small

from pickplace import CellSpec, PickPlaceEnv
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.afterstate.policy import Afterstate
from pickplace.policies.base import (
    EstimatesValue,
    ScoresActions,
    ScoresAnySize,
    ScoresFootprints,
    as_actor,
    as_collection_policy,
    refuse_large_network,
)
from pickplace.policies.fcn4d.policy import Fcn4d, Typical
from pickplace.policies.fcn_grasp.policy import FcnGrasp, UnmaskedFcnGrasp
from pickplace.policies.individual.policy import IndividualGrasp, IndividualRl, UnmaskedIndividualGrasp
from pickplace.rules.grasps import all_grasps, heuristic_pick, split_action
from pickplace.rules.masks import action_footprints

INDIVIDUAL = (IndividualGrasp, UnmaskedIndividualGrasp, IndividualRl)
SEVERAL = {
    "tote_size": (4, 5, 3), "bin_size": (5, 6, 1), "bin_items": 3, "refill": "batch", "num_envs": 4, "rotations": 2,
}  # fmt: skip
#: The policies that choose among several items.
CHOOSERS = (FcnGrasp, Fcn4d, Typical)
MASKS = {"masks": ("action", "footprint", "corner")}


def at_pick(kind, env, mask):
    """Return a mask of flat actions without those of which an individual policy knows nothing."""
    if kind not in INDIVIDUAL:
        return mask
    pick = torch.nn.functional.one_hot(
        heuristic_pick(env.cell, env.state.items.rows((slice(None), 0))), env.cell.num_picks
    ).bool()
    return (mask.unflatten(1, (env.cell.num_picks, -1)) & pick[..., None]).flatten(1)


def refuses(kind, options) -> bool:
    """Return whether a policy does not serve a cell; it says so."""
    if options.get("bin_items", 1) == 1 or kind in CHOOSERS:
        return False
    with pytest.raises(ValueError, match=r"^env.bin_items=3: expected 1 with .*; model=afterstate, fcn_grasp with"):
        small(kind, CellSpec(bin_items=3, longest_side=2))
    return True


@pytest.mark.parametrize("options", [*CELLS, SEVERAL])
@every_policy
def test_the_distribution_over_flat_actions_is_one_and_its_best_is_played(kind, options):
    if refuses(kind, options):
        return
    for env, observation in random_states(steps=5, **MASKS, **options):
        policy, mask = small(kind, env.cell), observation["action_mask"]
        log_probs = policy.action_log_probs(observation)
        assert log_probs.shape == (env.num_envs, env.cell.num_actions)
        torch.testing.assert_close(log_probs.exp().sum(1), torch.ones(env.num_envs), rtol=1e-4, atol=1e-4)
        unmasked = observation.exclude("action_mask", "footprint_mask", "corner_mask")
        action = PolicyPlanner(env.cell, policy, "all").decide(unmasked)
        possible = at_pick(kind, env, mask).any(1)
        assert possible.all() or kind in INDIVIDUAL
        assert torch.equal(mask.gather(1, action[:, None])[:, 0], possible)
        if isinstance(
            policy, ScoresFootprints
        ):  # which never lists the actions: the best feasible footprint, by any way to it
            reached = action_footprints(env.cell, env.state.items).gather(1, action[:, None])[:, 0]
            assert torch.equal(reached, policy.logits(observation).argmax(1))
        elif kind is not IndividualGrasp:
            best = log_probs.masked_fill(~mask, -torch.inf).argmax(1)
            assert torch.equal(action[possible], best[possible])


@pytest.mark.parametrize("options", SETTINGS)
@pytest.mark.parametrize("kind", [kind for kind in POLICIES if kind is not Typical])  # its layer is large here
def test_choices_are_classes_of_actions(kind, options):
    """The choices of all feasible actions, and back: a random action of the class when exploring, else the lowest."""
    if refuses(kind, options):
        return
    env, observation = late_state(4, **MASKS, **options)
    policy, mask = small(kind, env.cell), at_pick(kind, env, observation["action_mask"])
    for row in range(env.num_envs):
        actions = mask[row].nonzero()[:, 0]
        choices = policy.to_choice(actions, observation[[row] * len(actions)])
        lowest = {}
        for action, choice in zip(actions.tolist(), choices.tolist(), strict=True):
            lowest.setdefault(choice, action)
        if kind is FcnGrasp:
            assert sorted(lowest) == observation["footprint_mask"][row].nonzero()[:, 0].tolist()
        several, distinct = observation[[row] * len(lowest)], torch.tensor([*lowest], dtype=torch.int64)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            assert policy.to_action(distinct, several).tolist() == [*lowest.values()]
        with set_exploration_type(ExplorationType.RANDOM):
            again = policy.to_action(distinct, several)
        assert mask[row][again].all() and policy.to_choice(again, several).tolist() == [*lowest]


@pytest.mark.parametrize("exploration", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_to_miss_the_item_is_one_choice_of_the_unmasked_policy(exploration):
    env, observation = late_state(3, **SETTINGS[3])
    policy = small(UnmaskedFcnGrasp, env.cell)
    missing = torch.full((env.num_envs,), policy.classes * env.cell.num_places)
    assert torch.equal(missing, torch.full_like(missing, policy.logits(observation).shape[1] - 1))
    with set_exploration_type(exploration):
        actions = policy.to_action(missing, observation)
    assert ((actions >= 0) & (actions < env.cell.num_actions)).all()
    x, y, *_ = split_action(env.cell, actions)
    pick = x * env.cell.bin_size[1] + y
    assert not all_grasps(env.cell, env.state.items.rows((slice(None), 0)))[0].gather(1, pick[:, None]).any()
    assert torch.equal(policy.to_choice(actions, observation), missing)


@pytest.mark.parametrize("kind", [FcnGrasp, UnmaskedFcnGrasp, Fcn4d, UnmaskedIndividualGrasp])
def test_sampled_actions_follow_the_distribution_over_flat_actions(kind):
    """Chi-square of 20,000 draws; for the masked policy, the flat distribution restricted to what is feasible."""
    env = PickPlaceEnv(num_envs=1, tote_size=(3, 3, 2), bin_size=(3, 3, 1), seed=5, **MASKS)
    policy, observation, draws = small(kind, env.cell), env.reset(), []
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():  # as in a collector
        for _ in range(4):
            draws.append(as_collection_policy(policy)(observation.expand(5_000).contiguous())["action"])
        share = policy.action_log_probs(observation)[0].double().exp()
    count = torch.bincount(torch.cat(draws), minlength=env.cell.num_actions)
    if kind is FcnGrasp:
        mask = observation["action_mask"][0]
        assert not count[~mask].any()
        # A footprint's probability is spread over all actions that lead there, of which the feasible ones are played.
        flat = action_footprints(env.cell, env.state.items)[0]
        total, ways = share.new_zeros(env.cell.num_footprints), torch.bincount(flat[mask], minlength=share.numel())
        total.scatter_add_(0, flat.clamp(min=0), torch.where(flat >= 0, share, 0.0))
        share = torch.where(mask, total[flat.clamp(min=0)] / ways[flat.clamp(min=0)].clamp(min=1), 0.0)
    expected = share / share.sum() * 20_000
    often = expected > 5
    counts = torch.cat([count[often], count[~often].sum()[None]]).double()
    wanted = torch.cat([expected[often], expected[~often].sum()[None]])
    kept = wanted > 1e-6
    assert chisquare(counts[kept], wanted[kept]).pvalue > 1e-4


@every_policy
def test_the_log_probability_of_a_choice_is_what_the_loss_sees(kind):
    env = PickPlaceEnv(num_envs=64, tote_size=(4, 4, 2), bin_size=(3, 3, 1), **MASKS)
    policy, observation = small(kind, env.cell), env.reset()
    out = as_collection_policy(policy)(observation.clone())
    log_prob = as_actor(policy).get_dist(out).log_prob(out[policy.choice_key])
    torch.testing.assert_close(out["log_prob"], log_prob)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        again = as_collection_policy(policy)(observation.clone())
    assert torch.equal(again[policy.choice_key], policy.logits(observation).argmax(1))


@pytest.mark.parametrize("kind", [FcnGrasp, UnmaskedFcnGrasp, Fcn4d])
def test_weights_serve_fewer_rotations_and_other_totes(kind):
    """The logits of the actions that remain are those of the policy trained with all four rotations."""
    env = PickPlaceEnv(num_envs=2)
    observation, policy = env.reset(), small(kind, env.cell)
    for rotations, tote in ((1, (6, 6, 5)), (3, (6, 6, 5)), (2, (7, 9, 4))):
        fewer = kind(CellSpec(rotations=rotations, tote_size=tote, longest_side=2), **POLICIES[kind])
        fewer.load_state_dict(policy.state_dict())
        empty = torch.ones(2, *tote[:2])
        seen = {"bin_depth": observation["bin_depth"], "tote_depth": tote[2] * empty, "tote_bearing": empty}
        found = fewer.action_log_probs(seen)
        assert found.shape == (2, fewer.cell.num_actions)
        if tote == (6, 6, 5) and kind is Fcn4d:
            every = policy.action_log_probs(seen).unflatten(1, (-1, 4))[..., :rotations]
            torch.testing.assert_close(found, every.flatten(1).log_softmax(1), rtol=1e-4, atol=1e-4)


def test_the_papers_conditions_on_sizes():
    good, low = CellSpec(longest_side=3), CellSpec(tote_size=(6, 4, 5))
    wide = CellSpec(longest_side=4, bin_size=(6, 6, 1))
    for kind in (FcnGrasp, Fcn4d):
        assert small(kind, good).check_sizes() == []
    assert small(FcnGrasp, wide).check_sizes() == [
        "items: the longest side is 4, expected at most 3.5 (receptive field 5, the paper's eq. 2)."
    ]
    sentence = r"env.tote_size=\[6, 4, 5\]: expected sides of at least 5 \(receptive field 5, the paper's eq. 3\)."
    assert len(small(UnmaskedFcnGrasp, low).check_sizes()) == 1
    with pytest.raises(ValueError, match=sentence):  # fcn4d cannot learn then
        small(Fcn4d, low).check_sizes()


def test_protocols_say_what_a_policy_can_do():
    cell = CellSpec(longest_side=2, tote_size=(4, 4, 2), bin_size=(3, 3, 1))
    can = {
        protocol: {kind for kind in POLICIES if isinstance(small(kind, cell), protocol)}
        for protocol in (ScoresFootprints, ScoresActions, ScoresAnySize, EstimatesValue)
    }
    assert can == {
        ScoresFootprints: {FcnGrasp},
        ScoresActions: {Fcn4d, Typical, IndividualRl},
        ScoresAnySize: {FcnGrasp, Fcn4d, IndividualGrasp, IndividualRl},
        EstimatesValue: set(),
    }
    afterstate = Afterstate(cell)
    assert isinstance(afterstate, ScoresFootprints) and isinstance(afterstate, EstimatesValue)
    assert not isinstance(afterstate, ScoresAnySize)
    assert "items" in afterstate.with_cell(replace(cell, bin_items=2)).in_keys


class NeedsValues(torch.nn.Linear):
    """A layer whose constructor reads the value of a tensor."""

    def __init__(self):
        super().__init__(2, 1 + int(torch.ones(1).item()))


def test_only_networks_that_can_be_made_without_values_are_counted():
    refuse_large_network(NeedsValues, "model.actor")
    with pytest.raises(ValueError, match=r"model.actor: the network has 200,010,000 parameters; expected at most"):
        refuse_large_network(lambda: torch.nn.Linear(20_000, 10_000), "model.actor")
