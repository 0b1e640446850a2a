"""Episode settings: environments whose episodes differ in all of them, against the oracle; bad ones; and Gymnasium."""

from collections import Counter
from dataclasses import dataclass, replace
from itertools import combinations
from random import Random

import pytest
import torch
from oracle import FORBIDDEN_TURN, can_always_start
from tensordict import TensorDict
from test_env_oracle import (
    choose_action,
    compare_arrivals,
    compare_maps,
    compare_mask,
    draw_config,
    fresh_oracle,
    make_env,
    read_items,
)

from pickplace import PickPlaceEnv
from pickplace.envs import torchrl
from pickplace.envs.episode import SETTINGS
from pickplace.items.arrival import refill
from pickplace.items.distributions import PAPER_KINDS, ItemDistribution, Kinds, hashed_uniform, place_at_random
from pickplace.planners import lookahead, mcts
from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.rules.state import REFILLS
from pickplace.rules.support.base import Support

NUM_ENVS, STEPS = 8, 12


class Settings:
    """The settings of one episode, and what an oracle must know of them."""

    def __init__(self, rng, rules, kinds, mix, turns):
        self.mix, self.turns, self.kinds, self.level = mix, turns, kinds, rng.randrange(100)
        self.tote_height = rng.randint(max(h for _, _, h in kinds), rules.tote_size[2])
        self.rules = replace(rules, turns=turns, bin_items=rng.randint(1, rules.bin_items), refill=rng.choice(REFILLS))

    def entries(self):
        """Return the entries that a reset is given."""
        return {
            "tote_height": torch.tensor([self.tote_height]), "item_mix": torch.tensor([self.mix]),
            "rotations": torch.tensor([turn in self.turns for turn in range(self.rules.rotations)]),
            "bin_items": torch.tensor([self.rules.bin_items]), "level": torch.tensor([self.level]),
            "refill": torch.tensor([REFILLS.index(self.rules.refill)]),
        }  # fmt: skip


def play_config(rng, codes, kept):
    """Play episodes of one configuration, whose settings are drawn anew for each, and compare them with oracles."""
    rules, kinds = draw_config(rng)
    if not can_always_start(rules, kinds):
        return
    mixes = [[1] * len(kinds), *([rng.randrange(2) for _ in kinds] for _ in range(2))]
    mixes = [mix for mix in mixes if any(mix)]
    items = Kinds(kinds).mixed([{"weights": mix} for mix in mixes[1:]])
    env = make_env(rules, kinds, num_envs=NUM_ENVS, seed=rng.randrange(1000), items=items, varies=tuple(SETTINGS))
    starts = [(0, tuple(range(rules.rotations)), kinds)]
    for _ in range(3):
        mix, turns = rng.randrange(len(mixes)), range(rules.rotations)
        turns = rng.choice([some for size in turns for some in combinations(turns, size + 1)])
        used = [kind for kind, weight in zip(kinds, mixes[mix], strict=True) if weight]
        if can_always_start(replace(rules, turns=turns), used):
            starts.append((mix, turns, used))
        else:
            kept["impossible"] += 1
            slots = [Settings(rng, rules, used, mix, turns) for _ in range(NUM_ENVS)]
            with pytest.raises(ValueError, match="has no feasible action on the empty tote"):
                env.reset(TensorDict.stack([TensorDict(slot.entries()) for slot in slots]))

    def draw():
        mix, turns, used = rng.choice(starts)
        return Settings(rng, rules, used, mix, turns)

    slots = [draw() for _ in range(NUM_ENVS)]
    td = env.reset(TensorDict.stack([TensorDict(slot.entries()) for slot in slots]))
    oracles = [fresh_oracle(slot.rules, slot.kinds, td, row) for row, slot in enumerate(slots)]
    for _ in range(STEPS):
        for row, slot in enumerate(slots):
            for key, value in slot.entries().items():
                assert td[key][row].equal(value)
        for oracle, mask in zip(oracles, td["action_mask"], strict=True):
            compare_mask(oracle, mask, rng.random() < 0.02, rng)
        actions = [choose_action(slot.rules, mask, rng) for slot, mask in zip(slots, td["action_mask"], strict=True)]
        td = env.step(td.set("action", torch.tensor(actions)))["next"]
        for row, (oracle, action, slot) in enumerate(zip(oracles, actions, slots, strict=True)):
            (item, position), *others = read_items(td, row)
            feasible = td["action_mask"][row].nonzero().flatten().tolist()[:1]
            left, taken = oracle.contents, oracle.taken(action)
            reward, terminated, failure = oracle.step(action, item, position, try_first=feasible, others=others)
            assert [td[key][row].item() for key in ("failure", "reward", "done")] == [failure, reward, terminated]
            if reward:
                left = compare_arrivals(slot.rules, slot.kinds, [*left[:taken], *left[taken + 1 :]], oracle.contents)
            assert left == oracle.contents
            compare_maps(oracle, td, row)
            codes[failure] += 1
            kept["fewer items"] += len(left) == slot.rules.bin_items < rules.bin_items
        if td["done"].any():
            ended = td["done"][:, 0].tolist()
            slots = [draw() if end else slot for slot, end in zip(slots, ended, strict=True)]
            given = TensorDict.stack([TensorDict(slot.entries()) for slot in slots])
            td = env.reset(td.update(given).set("_reset", td["done"]))
            oracles = [
                fresh_oracle(slot.rules, slot.kinds, td, row) if end else oracle
                for row, (slot, oracle, end) in enumerate(zip(slots, oracles, ended, strict=True))
            ]


@pytest.mark.parametrize(("transitions", "seed"), [(1_000, 2), pytest.param(100_000, 0, marks=pytest.mark.slow)])
def test_episodes_that_differ_in_all_settings_equal_the_oracle(transitions, seed):
    """Each failure comes up."""
    rng, codes, kept = Random(seed), Counter(), Counter()
    while codes.total() < transitions:
        play_config(rng, codes, kept)
    assert set(codes) == set(range(FORBIDDEN_TURN + 1)), codes
    assert kept["fewer items"] > 10 and kept["impossible"]


@pytest.mark.parametrize("bin_items", [1, 2])
def test_a_search_imagines_what_may_arrive_in_the_episode(bin_items, monkeypatch):
    arrived = []
    items = Kinds(PAPER_KINDS).mixed([{"weights": [1, 0, 0, 0]}])
    settings = {"bin_items": bin_items, "tote_size": (4, 4, 2), "varies": ("item_mix", "rotations", "bin_items")}
    env = PickPlaceEnv(items, num_envs=2, masks=(), **settings)
    flags = torch.tensor([[True, False, False, False], [True, True, False, False]])
    given = {"item_mix": torch.tensor([[1], [0]]), "rotations": flags, "bin_items": torch.ones(2, 1).long()}
    td = env.reset(TensorDict(given, [2]))
    for module in (lookahead, mcts):
        monkeypatch.setattr(module, "refill", lambda *args: arrived.append((args[-1], refill(*args))) or arrived[-1][1])
    policy = FcnGrasp(env.cell, filters=8, hidden=8)
    for planner in (
        lookahead.Lookahead(env.cell, policy, items, samples=2, rounds=1),
        mcts.MCTS(env.cell, items, 8, True),
    ):
        arrived.clear()
        action = planner.decide(td)
        assert (action % 4)[0] == 0 and (action % 4)[1] <= 1
        assert 1 in {mix for settings, _ in arrived for mix in settings.item_mix.tolist()}
        for settings, (found, _) in arrived:
            small = settings.item_mix == 1
            assert (found.volume[small] <= 1).all() and (found.exists.sum(1) <= 1).all()
            assert (found.turns[found.exists] == settings.turns[:, None].expand_as(found.turns)[found.exists]).all()


def test_a_reset_that_is_refused_changes_nothing():
    items = Kinds([(1, 1, 1), (1, 1, 3)]).mixed([{"height": [1, 1]}])
    env = PickPlaceEnv(items, num_envs=2, tote_size=(4, 4, 4), varies=("rotations", "item_mix"))
    env.reset()
    before = {key: value.clone() for key, value in env.state_dict().items()}
    given = {"rotations": torch.tensor([[True, False, False, False]] * 2), "tote_height": torch.tensor([[2], [2]])}
    with pytest.raises(ValueError, match="tote_height=2: expected at least 3, the height of the tallest item"):
        env.reset(TensorDict(given, [2]))
    assert all(value.equal(before[key]) for key, value in env.state_dict().items())


def test_what_fits_the_empty_tote_is_checked_once_for_each_mix(monkeypatch):
    calls, check = [], torchrl.check_items
    monkeypatch.setattr(torchrl, "check_items", lambda *args: calls.append(args) or check(*args))
    items = Kinds(PAPER_KINDS).mixed([{"weights": [1, 0, 0, number]} for number in range(1, 101)])
    env = PickPlaceEnv(items, num_envs=100, varies=("item_mix",))
    for _ in range(2):
        env.reset(TensorDict({"item_mix": torch.arange(1, 101)[:, None]}, [100]))
    assert len(calls) == 101


@dataclass
class OwnSupport(Support):
    """A stability rule that cannot be hashed, as a plain dataclass."""

    share: float = 0.5

    def stable(self, contact):
        return contact.share >= self.share


class OwnItems(ItemDistribution):
    """A distribution without mixes, whose methods have no such argument."""

    sizes = torch.tensor([[1, 1, 1]])

    def sample(self, stream, seed, episode, step, bin_size):
        return place_at_random(self.sizes[step * 0], *hashed_uniform(stream, seed, episode, step, 2), bin_size)

    def spread(self, seed, rank, count, bin_size):
        return self.sample("train", seed, rank, rank, bin_size)


def test_parts_of_the_users_own_need_not_know_of_mixes_or_hashes():
    env = PickPlaceEnv(OwnItems(), num_envs=2, tote_size=(3, 3, 1), support=OwnSupport(), varies=("item_mix",))
    policy = FcnGrasp(env.cell, filters=8, hidden=8)
    search = lookahead.Lookahead(env.cell, policy, env.items, samples=2, rounds=1)
    td = env.reset()
    assert env.step(td.set("action", search.decide(td)))["next", "reward"].eq(1).all()
