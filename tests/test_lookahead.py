"""Search on top of a policy: fair comparisons, no peeking, and better than the policy alone."""

from functools import partial

import pytest
import torch
from omegaconf import OmegaConf

from pickplace import PickPlaceEnv, Rules
from pickplace.evaluation.evaluate import confidence95, play
from pickplace.planners import Lookahead, PolicyPlanner
from pickplace.planners.policy import restore_critic
from pickplace.policies.actors import fcn_grasp
from pickplace.runs import checkpoint
from pickplace.task.items import Kinds, Recorded

SMALL = {"tote_size": (4, 4, 1)}


def untrained(rules):
    torch.manual_seed(0)
    return fcn_grasp(rules, True, filters=8, hidden=8, head_std=1.0)


def make_env(first, count, **sizes):
    return PickPlaceEnv(num_envs=count, first_episode=first, stream="validation", masks=(), **{**SMALL, **sizes})


def test_put_down_is_what_an_action_does():
    env = PickPlaceEnv(num_envs=32, masks=("outcome",), tote_size=(5, 4, 3))
    state = env.rollout(5, break_when_any_done=False)[:, -1]["next"]
    rules, item = env.rules, env.current_item
    placements = rules.placements(env.heights, env.tote_height, item)
    for _ in range(5):
        outcome = torch.rand(state["outcome_mask"].shape).mul(state["outcome_mask"]).argmax(1)
        action = rules.actions_reaching(placements, outcome).amax(1)
        after = rules.apply(env.heights, env.tote_height, item, action)
        assert (after.failure == 0).all()
        assert torch.equal(rules.put_down(env.heights, placements, outcome), after.heights)
        some = torch.tensor([3, 3, 0])
        assert torch.equal(rules.put_down(env.heights[some], placements.rows(some), outcome[some]), after.heights[some])


def test_equal_candidates_meet_equal_items():
    env = make_env(0, 3)
    planner = Lookahead(env.rules, untrained(env.rules), env.items)
    heights = torch.zeros(4, 4, 4, dtype=torch.int32)
    volume = planner._play_out(heights, torch.ones(4, dtype=torch.int64), torch.tensor([0, 0, 1, 2]), 16, None)
    assert volume.shape == (4, 16) and torch.equal(volume[0], volume[1])
    assert not torch.equal(volume[0], volume[2]) and not torch.equal(volume[2], volume[3])
    assert volume.unique().numel() > 2 and volume.max() <= 16


def test_the_horizon_adds_the_critics_value():
    env = make_env(0, 1)
    policy, seen = untrained(env.rules), []

    def critic(bin_depth, tote_depth):
        seen.append(len(tote_depth))
        return torch.full((len(tote_depth), 1), 100.0)

    planner = Lookahead(env.rules, policy, env.items, critic, horizon=2)
    volume = planner._play_out(torch.zeros(1, 4, 4).int(), torch.ones(1).long(), torch.zeros(1).long(), 64, 2)
    assert len(seen) == 1 and (volume >= 100).sum() == seen[0]
    assert (volume[volume >= 100] <= 100 + 2 * 4).all()


def test_it_is_better_than_its_policy():
    make = partial(make_env, tote_size=(4, 4, 2))
    rules = make(0, 1).rules
    alone = play(make, PolicyPlanner(rules, untrained(rules)), 32, 32).occupancy
    search = Lookahead(rules, untrained(rules), make(0, 1).items, candidates=8, samples=16, rounds=1)
    improved = play(make, search, 32, 32).occupancy
    assert confidence95(improved - alone, least=-1.0)[0] > 0.1


def test_a_critic_that_errs_does_not_make_it_worse_than_its_policy(monkeypatch):
    make = partial(make_env, tote_size=(4, 4, 2))
    rules, items = make(0, 1).rules, make(0, 1).items
    policy = PolicyPlanner(rules, untrained(rules))

    def worst(bin_depth, tote_depth):  # of any two states, the one with fewer columns full
        return -100.0 * (tote_depth == 0).flatten(1).sum(1, keepdim=True)

    def search():
        return Lookahead(rules, untrained(rules), items, worst, candidates=8, samples=16, rounds=1)

    alone, checked = (play(make, planner, 48, 48).occupancy for planner in (policy, search()))
    monkeypatch.setattr(Lookahead, "_confirm", lambda self, best, *state: best)
    misled = play(make, search(), 48, 48).occupancy
    assert confidence95(misled - alone, least=-1.0)[1] < 0
    assert confidence95(checked - alone, least=-1.0)[0] > 0


def test_with_no_doubt_allowed_it_is_its_policy():
    rules = make_env(0, 1).rules
    search = Lookahead(rules, untrained(rules), make_env(0, 1).items, samples=16, rounds=1, confidence=1e9)
    alone = PolicyPlanner(rules, untrained(rules))
    results = [play(make_env, planner, 16, 16).occupancy for planner in (search, alone)]
    assert torch.equal(*results)


def test_a_recorded_stream_is_not_looked_up(tmp_path):
    table = tmp_path / "items.csv"
    table.write_text("w,d,h\n" + "1,1,1\n2,1,1\n" * 4)
    env = PickPlaceEnv(num_envs=2, items=Recorded(table), **SMALL)
    planner = Lookahead(env.rules, untrained(env.rules), env.items)
    assert isinstance(planner.items, Kinds) and planner.items.length is None


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"candidates": 0}, "planner.candidates=0: expected a whole number >= 1"),
        ({"samples": 1}, "planner.samples=1: expected a whole number >= 2"),
        ({"rounds": 1.5}, "planner.rounds=1.5"),
        ({"horizon": 0}, "planner.horizon=0"),
        ({"confidence": -1}, "planner.confidence=-1: expected a number >= 0"),
        ({"policy": None}, "expected a checkpoint of model=fcn_grasp"),
    ],
)
def test_bad_settings_are_refused(settings, words):
    env = make_env(0, 1)
    with pytest.raises(ValueError, match=words):
        Lookahead(**{"rules": env.rules, "policy": untrained(env.rules), "items": env.items, **settings})


def test_each_call_imagines_other_items():
    env = make_env(0, 3)
    search = Lookahead(env.rules, untrained(env.rules), env.items)
    state = torch.zeros(1, 4, 4, dtype=torch.int32), torch.ones(1, dtype=torch.int64), torch.tensor([0])
    assert not torch.equal(search._play_out(*state, 16, None), search._play_out(*state, 16, None))


@pytest.mark.parametrize(("gain", "departs"), [(0.8, True), (0.6, False)])
def test_a_candidate_must_win_by_standard_errors_of_its_mean(gain, departs, monkeypatch):
    """Of 32 streams, each of which differs from the mean by 2: the standard error is 2 / sqrt(31), 0.36."""
    env = make_env(0, 1)
    observation, policy = env.reset(), untrained(env.rules)
    search = Lookahead(env.rules, policy, env.items, candidates=2, samples=32, rounds=1, confidence=2.0)
    noise = torch.tensor([2.0, -2.0], dtype=torch.float64).repeat(16)
    monkeypatch.setattr(search, "_play_out", lambda *_: torch.stack([torch.zeros_like(noise), gain + noise]))
    own = PolicyPlanner(env.rules, policy).decide(observation)
    assert (search.decide(observation) != own).item() == departs


def test_a_checkpoints_critic_judges_in_cells():
    """Nearly all of an empty tote's 180 cells, a little less for the discount; near nothing in a full one."""
    state, facts = checkpoint.read(checkpoint.locate("pretrained/r4"))
    cfg = OmegaConf.create({**facts["config"], "device": "cpu"})
    critic = restore_critic(cfg, Rules(), state, [6, 6, 5])
    item = torch.zeros(1, 5, 5)
    item[0, 1:3, 2] = 1.0
    empty, full = (critic(item, torch.full((1, 6, 6), depth)).item() for depth in (5.0, 0.0))
    assert 100 < empty < 185 and abs(full) < 10
