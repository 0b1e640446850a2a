"""The planner that follows a policy: what K candidates are, and how the play of a policy is simulated."""

import pytest
import torch
from problems import SETTINGS, late_state, random_states
from untrained import untrained_policy

from pickplace import PickPlaceEnv
from pickplace.items.distributions import Uniform
from pickplace.planners.heuristics import JointDBL
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.afterstate.policy import AfterstateFcn
from pickplace.policies.base import Policy
from pickplace.rules.grasps import PICKS
from pickplace.rules.masks import placing_maps
from pickplace.rules.step import apply


class Fixed(Policy):
    """A policy whose distribution over flat actions is given."""

    def __init__(self, cell, scores):
        super().__init__(cell)
        self.scores = scores

    def logits(self, observation):
        return self.scores.expand(len(observation["bin_depth"]), -1)

    action_log_probs = logits


@pytest.mark.parametrize("candidates", [1, 4, 30, 10**6, "all"])
@pytest.mark.parametrize("options", SETTINGS)
def test_candidates_of_each_problem(options, candidates):
    """The most probable actions are tried in order, without a mask; if none succeeds the first is played, and fails."""
    for env, observation in random_states(steps=4, **options):
        generator = torch.Generator().manual_seed(0)
        scores = torch.randn(env.num_envs, env.cell.num_actions, generator=generator).log_softmax(1)
        planner = PolicyPlanner(env.cell, Fixed(env.cell, scores), candidates)
        chosen, heat = planner.decide(observation.exclude("action_mask")), planner.heat_map(observation)
        for n in range(env.num_envs):
            mask, ranked = observation["action_mask"][n], scores[n].argsort(descending=True).tolist()
            tried = ranked if candidates == "all" else ranked[:candidates]
            assert chosen[n] == next((action for action in tried if mask[action]), ranked[0])
            # The picture: for each place cell the greatest probability, of what the planner would play.
            shown = scores[n].exp() * mask if candidates == "all" else scores[n].exp()
            tote_w, tote_d, _ = env.cell.tote_size
            assert torch.equal(heat[n], shown.view(-1, tote_w, tote_d, env.cell.rotations).amax((0, 3)))


@pytest.mark.parametrize("rule", ["first", "nearest"])
def test_only_one_item_is_considered(rule):
    """The first by the rule that has a feasible footprint; and of its footprints the best one."""
    moved = 0
    for env, observation in random_states(
        bin_items=3, bin_size=(6, 6, 1), items=Uniform(), tote_size=(5, 5, 4), masks=("footprint", "action")
    ):
        policy = untrained_policy(env.cell)
        planner = PolicyPlanner(env.cell, policy, item=rule)
        chosen = policy.to_choice(planner.decide(observation), observation)
        joint = JointDBL(env.cell, item=rule).decide(observation)
        logits = policy.logits(observation)
        for n in range(env.num_envs):
            table, mask = env.item[n].tolist(), observation["footprint_mask"][n].unflatten(0, (3, -1))
            order = [0, 1, 2]
            if rule == "nearest":
                order.sort(key=lambda k: (table[k][0] + table[k][2] / 2) ** 2 + (table[k][1] + table[k][3] / 2) ** 2)
            number = next(k for k in order if mask[k].any())
            assert chosen[n] == logits[n].unflatten(0, (3, -1))[number].argmax() + number * env.cell.num_footprints
            assert policy.to_choice(joint[n : n + 1], observation[n : n + 1]) // env.cell.num_footprints == number
            moved += number != order[0]
    assert moved > 0
    with pytest.raises(ValueError, match="planner.item='last': expected 'any' or 'first' or 'nearest'"):
        JointDBL(env.cell, item="last")
    with pytest.raises(ValueError, match="planner.item='first': expected 'any', or planner.candidates=all and a"):
        PolicyPlanner(env.cell, policy, 3, "first")


@pytest.mark.parametrize("rule", ["least_offset", "middle"])
@pytest.mark.parametrize(
    "make", [untrained_policy, lambda cell: AfterstateFcn(cell, stem=4, filters=8, temperature=1.0).eval()]
)
@pytest.mark.parametrize(("effector", "rotations"), [((5, 5), 2), ((5, 3), 4)])
def test_a_pick_may_be_chosen_first(rule, make, effector, rotations):
    """Of the actions with this pick that succeed the one whose footprint the policy likes best; else one that fails."""
    stuck = others = 0
    for env, observation in random_states(
        effector_size=effector,
        cup_size=(1, 1),
        pick_rule="overlap",
        rotations=rotations,
        tote_size=(5, 5, 4),
        num_envs=8,
    ):
        cell, policy = env.cell, make(env.cell)
        policy.network.compute_dtype = "float32"
        chosen = PolicyPlanner(cell, policy, pick=rule).decide(observation)
        maps, scores = placing_maps(cell, env.state), policy.unmasked_scores(observation)
        picks, ranked = PICKS[rule](cell, maps.item).tolist(), policy.ranked(maps)
        for n, pick in enumerate(picks):
            each = cell.num_places * rotations
            actions = torch.arange(pick * each, (pick + 1) * each)
            step = apply(cell, env.state.rows([n] * len(actions)), actions)
            good = actions[step.failure == 0]
            if len(good) == 0:
                stuck += 1
                assert not observation["action_mask"][n, chosen[n]]
                continue
            footprints = policy.to_choice(good, observation[[n] * len(good)]).tolist()
            inside = [f for f in footprints if ranked[n, f]] or footprints
            taken = footprints[good.tolist().index(int(chosen[n]))]
            assert taken in inside and scores[n, taken] >= scores[n, inside].max() - 1e-5
        heat = PolicyPlanner(cell, policy, pick=rule).heat_map(observation).flatten(1)
        succeeds = observation["action_mask"].unflatten(1, (cell.num_picks, cell.num_places, -1)).any(3)
        reached = succeeds[torch.arange(len(picks)), picks]
        assert ((heat > 0) <= reached).all() and (policy.mask == "corner" or ((heat > 0) == reached).all())
        free = policy.to_choice(PolicyPlanner(cell, policy).decide(observation), observation)
        others += int((policy.to_choice(chosen, observation) != free).sum())
    assert others > 0 and (stuck > 0 or (rule, rotations) != ("least_offset", 2))


def test_a_pick_that_is_chosen_first_needs_a_policy_that_ranks_footprints():
    cell = PickPlaceEnv(num_envs=1).cell
    with pytest.raises(ValueError, match="planner.pick='center': expected 'any' or 'least_offset' or 'middle'"):
        PolicyPlanner(cell, untrained_policy(cell), pick="center")
    with pytest.raises(ValueError, match="planner.pick='middle': expected 'any', or planner.candidates=all and a"):
        PolicyPlanner(cell, untrained_policy(cell), 3, pick="middle")
    several = PickPlaceEnv(num_envs=1, bin_items=2).cell
    with pytest.raises(ValueError, match="planner.pick='middle': expected 'any' with env.bin_items=2"):
        PolicyPlanner(several, untrained_policy(several), pick="middle")


@pytest.mark.parametrize("candidates", [0, -1, 1.5, True, "some"])
def test_bad_candidates_are_refused(candidates):
    env = PickPlaceEnv(num_envs=1)
    with pytest.raises(ValueError, match=r"planner.candidates=.*expected 'all' or a whole number"):
        PolicyPlanner(env.cell, None, candidates)


@pytest.mark.parametrize("rule", ["first", "nearest"])
def test_a_heat_map_shows_the_items_that_the_rule_allows(rule):
    settings = {"bin_size": (7, 7, 1), "tote_size": (5, 6, 4), "bin_items": 3, "num_envs": 12}
    env, observation = late_state(4, masks=("action",), **settings)
    policy = untrained_policy(env.cell)
    planner, free = PolicyPlanner(env.cell, policy, item=rule), PolicyPlanner(env.cell, policy)
    heat, all_heat = (each.heat_map(observation).flatten(1) for each in (planner, free))
    place = planner.decide(observation.exclude("action_mask")) // env.cell.rotations % env.cell.num_places
    assert (heat.gather(1, place[:, None]) > 0).all()
    assert (heat <= all_heat).all() and ((heat == 0) & (all_heat > 0)).any()
