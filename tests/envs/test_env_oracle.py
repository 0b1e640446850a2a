"""The environment against the plain-Python oracle, on random sizes, effectors, items and options."""

from collections import Counter
from dataclasses import asdict, replace
from random import Random

import pytest
import torch
from oracle import SUCCESS, Oracle, Rules, can_always_start
from tensordict import TensorDict

from pickplace import PickPlaceEnv
from pickplace.task.cell import Limits
from pickplace.task.items import Kinds

NUM_ENVS, STEPS = (1, 6, 12, 24), 25  # per configuration: 25 to 600 transitions
SUPPORTS = (0.0, 0.25, 1 / 3, 0.5, 0.6, 2 / 3, 0.75, 1.0)


def draw_config(rng: Random):
    """Return rules and item kinds: small, of every shape, and usually possible."""
    effector = rng.randint(1, 4), rng.randint(1, 4)
    bin_sides = rng.randint(2, 5), rng.randint(2, 5)
    tote_sides = rng.randint(2, 6), rng.randint(2, 6)
    pick_rule = rng.choice(("contain", "contain", "overlap"))
    limit = [min(3, bin_side) for bin_side in bin_sides]
    if pick_rule == "contain" and rng.random() < 0.95:
        limit = [min(side, effector_side) for side, effector_side in zip(limit, effector, strict=True)]
    kinds = {(rng.randint(1, limit[0]), rng.randint(1, limit[1]), rng.randint(1, 3)) for _ in range(rng.randint(1, 5))}
    greatest = max(h for _, _, h in kinds)
    rules = Rules(
        bin_size=(*bin_sides, rng.randint(1, 3)),
        tote_size=(*tote_sides, greatest + rng.randint(0, 4)),
        effector_size=effector,
        rotations=rng.randint(1, 4),
        pick_rule=pick_rule,
        min_support=rng.choice(SUPPORTS),
        strict_support=rng.random() < 0.3,
    )
    return draw_limits(rules, rng) if rng.random() < 0.4 else rules, sorted(kinds)


def draw_limits(rules, rng):
    """Return the rules with tables of what the robot may do, which seldom leave an item nowhere to go."""

    def grids(values):
        wide, deep, _ = rules.tote_size
        return [[rng.choices(values, k=deep) for _ in range(wide)] for _ in range(rules.rotations)]

    return replace(
        rules,
        pick_ok=[rng.random() < 0.95 for _ in range(rules.bin_size[0] * rules.bin_size[1])],
        lowest_top=grids((0, 0, 1, 2, 4)),
        highest_top=grids((0, 2, 3, 4, 9)),
    )


def make_env(rules, kinds, **settings):
    """Return the package's environment for the oracle's rules."""
    given = asdict(rules)
    tables = [given.pop(key) for key in ("pick_ok", "lowest_top", "highest_top")]
    limits = None if tables[0] is None else Limits(*map(torch.tensor, tables))
    return PickPlaceEnv(**given, limits=limits, items=Kinds(kinds), **settings)


def read_item(bin_depth):
    """Return the item `(w, d, h)` and its corner `(x, y)` that a `[W_B][D_B]` depth map shows."""
    filled = [(x, y) for x, column in enumerate(bin_depth) for y, height in enumerate(column) if height]
    (x0, y0), (x1, y1) = filled[0], filled[-1]
    return (x1 - x0 + 1, y1 - y0 + 1, int(bin_depth[x0][y0])), (x0, y0)


def fresh_oracle(rules, kinds, observation, row):
    """Return an oracle for an episode that has just begun in this row of an observation."""
    tote_height = int(observation["tote_height"][row])
    oracle = Oracle(rules, tote_height, *read_item(observation["bin_depth"][row].tolist()))
    assert oracle.item in kinds
    assert max(h for _, _, h in kinds) <= tote_height <= rules.tote_size[2]
    compare_maps(oracle, observation, row)
    assert observation["action_mask"][row].any()
    return oracle


def compare_maps(oracle, observation, row):
    assert observation["bin_depth"][row].tolist() == oracle.bin_depth()
    assert observation["tote_depth"][row].tolist() == oracle.tote_depth()
    assert observation["tote_height"][row].item() == oracle.tote_height


def compare_mask(oracle, mask, full, rng):
    """Compare every entry of a `[N_a]` mask, or 24 of them, half of them feasible if there are so many."""
    if full:
        assert mask.tolist() == oracle.full_mask()
        return
    yes, no = mask.nonzero().flatten().tolist(), (~mask).nonzero().flatten().tolist()
    for action in rng.sample(yes, min(12, len(yes))):
        assert oracle.try_action(action)[0] == SUCCESS, action
    for action in rng.sample(no, min(24 - min(12, len(yes)), len(no))):
        assert oracle.try_action(action)[0] != SUCCESS, action


def choose_action(rules, mask, rng):
    """Return mostly a feasible action, else any action, or any placement of a pick that is known to succeed."""
    feasible = rng.choice(mask.nonzero().flatten().tolist())
    draw = rng.random()
    if draw < 0.8:
        return feasible
    anything = rng.randrange(rules.num_actions)
    if draw < 0.86:
        return anything
    return rules.join(rules.split(feasible)[0], *rules.split(anything)[1:])


def compare_config(rules, kinds, seed, rng, full_share):
    """Play one configuration; return the tally of failure codes and the number of full masks compared."""
    num_envs = rng.choice(NUM_ENVS)
    env = make_env(rules, kinds, num_envs=num_envs, seed=seed)
    greatest = max(h for _, _, h in kinds)
    asked = torch.tensor([[rng.randint(greatest, rules.tote_size[2])] for _ in range(num_envs)])
    td = env.reset(TensorDict({"tote_height": asked}, [num_envs]))
    assert td["tote_height"].equal(asked)
    oracles = [fresh_oracle(rules, kinds, td, row) for row in range(num_envs)]
    codes, full_masks = Counter(), 0
    for _ in range(STEPS):
        actions = []
        for oracle, mask in zip(oracles, td["action_mask"], strict=True):
            full = rng.random() < full_share
            full_masks += full
            compare_mask(oracle, mask, full, rng)
            actions.append(choose_action(rules, mask, rng))
        before = td
        td, following = env.step_and_maybe_reset(td.clone().set("action", torch.tensor(actions)))
        after = td["next"]
        for row, (oracle, action) in enumerate(zip(oracles, actions, strict=True)):
            item, position = read_item(after["bin_depth"][row].tolist())
            assert item in kinds
            mask = after["action_mask"][row]
            feasible = mask.nonzero().flatten().tolist()[:1]
            reward, terminated, failure = oracle.step(action, item, position, try_first=feasible)
            assert after["failure"][row].item() == failure
            assert after["reward"][row].item() == reward
            assert after["terminated"][row].item() == after["done"][row].item() == terminated
            assert not after["truncated"][row].item()
            assert after["occupancy"][row].equal(torch.tensor([oracle.occupancy()], dtype=torch.float32))
            compare_maps(oracle, after, row)
            if terminated:  # stuck leaves nothing to do; another failure leaves all as it was
                assert mask.equal(before["action_mask"][row]) if reward == 0 else not mask.any()
                oracles[row] = fresh_oracle(rules, kinds, following, row)
            else:
                compare_maps(oracle, following, row)
                assert following["action_mask"][row].equal(mask)
            codes[failure] += 1
        td = following
    return codes, full_masks


@pytest.mark.parametrize(
    ("transitions", "full_masks"), [(4_000, 200), pytest.param(1_000_000, 10_000, marks=pytest.mark.slow)]
)
def test_env_equals_oracle(transitions, full_masks):
    rng = Random(transitions)
    codes, configs, refused, masks = Counter(), 0, 0, 0
    while codes.total() < transitions or masks < full_masks:
        rules, kinds = draw_config(rng)
        seed = rng.randrange(1000)
        if not can_always_start(rules, kinds):
            with pytest.raises(ValueError):
                make_env(rules, kinds, num_envs=2, seed=seed)
            refused += 1
            continue
        more_codes, more_masks = compare_config(rules, kinds, seed, rng, full_share=full_masks / transitions)
        codes, masks, configs = codes + more_codes, masks + more_masks, configs + 1
    assert set(codes) == set(range(9)), codes
    assert configs >= transitions // (max(NUM_ENVS) * STEPS)
    assert 0 < refused < 3 * configs
