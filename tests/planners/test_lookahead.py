"""Search on top of a policy: fair comparisons, no peeking, and better than the policy alone."""

import pytest
import torch
from omegaconf import OmegaConf
from problems import occupancies

from pickplace import CellSpec, PickPlaceEnv
from pickplace.items.distributions import Kinds, Recorded
from pickplace.planners.lookahead import Lookahead
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.afterstate.policy import Afterstate
from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.policies.restore import RestoredCritic, restore_critic, restore_policy
from pickplace.rules.item import Item
from pickplace.rules.masks import choice_mask, placing_maps
from pickplace.rules.state import EMPTY, State
from pickplace.rules.step import put_down
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate


def untrained(cell):
    torch.manual_seed(0)
    return FcnGrasp(cell, filters=8, hidden=8, head_std=1.0)


def make_env(count=1, tote_size=(4, 4, 1), **settings):
    return PickPlaceEnv(num_envs=count, stream="validation", masks=(), tote_size=tote_size, **settings)


def search_of(env, critic=None, **settings):
    return Lookahead(env.cell, untrained(env.cell), env.items, critic, **settings)


def played_out(search, problem, streams, horizon=None):
    """Return what the search expects of empty totes, ``[problems, streams]``."""
    count = len(problem)
    empty, rims = torch.full((count, 4, 4), EMPTY, dtype=torch.int32), torch.ones(count, dtype=torch.int64)
    state = State(empty, rims, Item(*torch.zeros(5, count, 1, dtype=torch.int64)))
    return search._play_out(state, torch.tensor(problem), streams, horizon)


def test_equal_candidates_meet_equal_items_and_each_call_others():
    search = search_of(make_env(3))
    volume = played_out(search, [0, 0, 1, 2], 16)
    assert volume.shape == (4, 16) and torch.equal(volume[0], volume[1])
    assert not torch.equal(volume[0], volume[2]) and not torch.equal(volume[2], volume[3])
    assert volume.unique().numel() > 2 and volume.max() <= 16
    assert not torch.equal(played_out(search, [0, 0, 1, 2], 16)[0], volume[0])


def test_with_as_many_streams_as_kinds_the_mean_over_the_next_item_is_exact():
    kinds = [(1, 1, 1), (2, 1, 1), (2, 2, 1), (3, 3, 1)]
    search = search_of(make_env(items=Kinds(kinds)), lambda observation: torch.zeros(len(observation["tote_depth"]), 1))
    volume = played_out(search, [0, 1, 2], 4, 1)
    assert volume.sort().values.tolist() == 3 * [[1, 2, 4, 9]]


@pytest.mark.parametrize("bin_items", [1, 2])
def test_imagined_items_are_spread_where_the_next_one_lies_alone(bin_items, monkeypatch):
    calls, spread = [], Kinds.spread
    monkeypatch.setattr(Kinds, "spread", lambda *args: calls.append(args) or spread(*args))
    env = make_env(2, bin_items=bin_items)
    search_of(env, samples=2, rounds=1).decide(env.reset())
    assert bool(calls) == (bin_items == 1)


def test_the_horizon_adds_the_critics_value():
    seen = []

    def critic(observation):
        seen.append(len(observation["tote_depth"]))
        return torch.full((seen[-1], 1), 100.0)

    volume = played_out(search_of(make_env(), critic, horizon=2), [0], 64, 2)
    assert len(seen) == 1 and (volume >= 100).sum() == seen[0]
    assert (volume[volume >= 100] <= 100 + 2 * 4).all()


def test_a_critic_that_sees_the_tote_alone_judges_it_before_the_next_item_arrives():
    def empty_volume(observation):
        assert set(observation) == set(empty_volume.in_keys)
        return observation["tote_depth"].sum((1, 2))[:, None]

    empty_volume.in_keys = ("tote_depth", "tote_height")
    volume = played_out(search_of(make_env(), empty_volume, horizon=1), [0, 1], 16, 1)
    assert (volume == 16).all()  # the item, and what is empty after it


def test_what_wins_by_the_values_of_afterstates_is_not_played_to_the_end(monkeypatch):
    """The policy follows from the same values."""
    monkeypatch.setattr(Lookahead, "_confirm", None)
    torch.manual_seed(0)
    env, sizes = make_env(1, (4, 4, 2)), {"grid": (4, 4, 2), "filters": 4, "hidden": 8}
    policy = Afterstate(env.cell, **sizes).eval()
    critic = RestoredCritic(policy.network, list(policy.network.in_keys), 1.0)
    search = Lookahead(env.cell, policy, env.items, critic, horizon=3, candidates=8, rounds=1)
    alone = occupancies(PolicyPlanner(env.cell, policy), make_env(24, (4, 4, 2)))
    assert gain_bounds(occupancies(search, make_env(24, (4, 4, 2))) - alone)[0] > 0


def test_what_lies_in_the_bin_is_played_before_anything_is_imagined():
    """A batch of three kinds of volumes 1, 2 and 4: after one of them is placed the other two follow, in any stream."""
    kinds = [(1, 1, 1), (2, 1, 1), (2, 2, 1)]
    sizes = {"items": Kinds(kinds), "bin_items": 3, "refill": "batch", "bin_size": (6, 6, 1)}
    env = make_env(64, (6, 6, 5), **sizes)
    env.reset()
    search = search_of(env, lambda observation: torch.zeros(len(observation["tote_depth"]), 1), horizon=2)
    state = env.state
    choice = choice_mask(env.cell, placing_maps(env.cell, state)).int().argmax(1)
    after, placed = put_down(env.cell, state, choice)
    left = state.items.volume.sum(1) - placed.volume
    volume = search._play_out(after, torch.arange(64), 4, 2)
    assert torch.equal(volume, left.double()[:, None].expand(64, 4))
    returns = search._returns(state, torch.arange(64), choice, 4, 2)
    assert torch.equal(returns, state.items.volume.sum(1).double()[:, None].expand(64, 4))  # whichever is first
    further = search._play_out(after, torch.arange(64), 4, 3)
    assert further.std(1).max() > 0  # then comes an imagined batch


def test_what_is_seen_to_come_is_played_before_anything_is_imagined():
    env = make_env(64, (6, 6, 5), preview=2)
    env.reset()
    search = search_of(env, lambda observation: torch.zeros(len(observation["tote_depth"]), 1))
    state = env.state
    choice = choice_mask(env.cell, placing_maps(env.cell, state)).int().argmax(1)
    expected = (state.items.volume + state.coming.volume.sum(1, keepdim=True)).double().expand(64, 4)
    assert torch.equal(search._returns(state, torch.arange(64), choice, 4, 2), expected)
    assert search._returns(state, torch.arange(64), choice, 4, 3).std(1).max() > 0


def gain_bounds(gain):
    """Return mean -+ two standard errors."""
    error = 2 * gain.std() / len(gain) ** 0.5
    return gain.mean() - error, gain.mean() + error


@pytest.mark.slow
def test_it_is_better_than_its_policy_and_a_critic_that_errs_does_not_make_it_worse(monkeypatch):
    def worst(observation):  # of any two states, the one with fewer columns full
        return -100.0 * (observation["tote_depth"] == 0).flatten(1).sum(1, keepdim=True)

    def pack(planner):
        return occupancies(planner, make_env(24, (4, 4, 2)))

    env, settings = make_env(1, (4, 4, 2)), {"candidates": 8, "samples": 16, "rounds": 1}
    alone = pack(PolicyPlanner(env.cell, untrained(env.cell)))
    assert gain_bounds(pack(search_of(env, **settings)) - alone)[0] > 0.1
    assert gain_bounds(pack(search_of(env, worst, **settings)) - alone)[0] > 0
    monkeypatch.setattr(Lookahead, "_confirm", lambda self, best, *state: best)
    assert gain_bounds(pack(search_of(env, worst, **settings)) - alone)[1] < 0


@pytest.mark.slow
def test_it_is_better_than_its_policy_with_several_items():
    sizes = {"tote_size": (4, 4, 2), "bin_items": 2}
    env = make_env(1, **sizes)
    search = search_of(env, candidates=8, samples=8, rounds=1)
    alone = occupancies(PolicyPlanner(env.cell, untrained(env.cell)), make_env(16, **sizes))
    assert gain_bounds(occupancies(search, make_env(16, **sizes)) - alone)[0] > 0.02


def test_with_no_doubt_allowed_it_is_its_policy():
    env = make_env()
    search = search_of(env, samples=16, rounds=1, confidence=1e9)
    alone = PolicyPlanner(env.cell, untrained(env.cell))
    assert torch.equal(*(occupancies(planner, make_env(8)) for planner in (search, alone)))


def test_a_recorded_stream_is_not_looked_up(tmp_path):
    (tmp_path / "items.csv").write_text("w,d,h\n" + "1,1,1\n2,1,1\n" * 4)
    assert isinstance(search_of(make_env(items=Recorded(tmp_path / "items.csv"))).items, Kinds)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"candidates": 0}, "planner.candidates=0: expected a whole number >= 1"),
        ({"samples": 1}, "planner.samples=1: expected a whole number >= 2"),
        ({"rounds": 1.5}, "planner.rounds=1.5"),
        ({"horizon": 0}, "planner.horizon=0"),
        ({"confidence": -1}, "planner.confidence=-1: expected a number >= 0"),
        ({"seed": -1}, "planner.seed=-1"),
        ({"policy": None}, "expected a checkpoint of model=fcn_grasp"),
    ],
)
def test_bad_settings_are_refused(settings, words):
    env = make_env()
    with pytest.raises(ValueError, match=words):
        Lookahead(**{"cell": env.cell, "policy": untrained(env.cell), "items": env.items, **settings})


@pytest.mark.parametrize(("gain", "departs"), [(0.8, True), (0.6, False)])
def test_a_candidate_must_win_by_standard_errors_of_its_mean(gain, departs, monkeypatch):
    """Of 32 streams, each of which differs from the mean by 2: the standard error is 2 / sqrt(31), 0.36."""
    env = make_env()
    observation, search = env.reset(), search_of(env, candidates=2, samples=32, rounds=1, confidence=2.0)
    noise = torch.tensor([2.0, -2.0], dtype=torch.float64).repeat(16)
    monkeypatch.setattr(search, "_play_out", lambda *_: torch.stack([torch.zeros_like(noise), gain + noise]))
    own = PolicyPlanner(env.cell, search.policy).decide(observation)
    assert (search.decide(observation) != own).item() == departs


def test_the_critic_of_a_checkpoint_judges_in_cells():
    """Nearly all of an empty tote's 180 cells, a little less for the discount; near nothing in a full one."""
    state, facts = checkpoint.read(locate("pretrained/r4"))
    cfg = OmegaConf.create({**facts["config"], "device": "cpu"})
    policy = restore_policy(cfg, CellSpec(), state["policy"], facts["config"]["env"])
    critic = restore_critic(cfg, policy, state, facts["config"]["env"])
    bins = torch.zeros(1, 5, 5)
    bins[0, 1:3, 2] = 1.0
    tote = torch.ones(1, 6, 6)
    empty, full = (
        critic({"bin_depth": bins, "tote_depth": depth * tote, "tote_bearing": tote}).item() for depth in (5.0, 0.0)
    )
    assert 100 < empty < 185 and abs(full) < 10
