"""The environment against the plain-Python oracle, on random sizes, effectors, items, options and limits."""

from collections import Counter
from dataclasses import asdict, fields, replace
from itertools import product
from random import Random

import pytest
import torch
from oracle import FORBIDDEN_TURN, OVERLOADED, SUCCESS, Oracle, Rules, can_always_start, cells, loads, piles_below
from problems import SUPPORTS, random_effector, support_of
from tensordict import TensorDict

from pickplace import PickPlaceEnv
from pickplace.items.distributions import Kinds
from pickplace.rules.item import NO_LIMIT
from pickplace.rules.reach.base import Limits

NUM_ENVS, STEPS = (3, 6, 12), 10  # per configuration: 30 to 120 transitions


def draw_config(rng: Random, shaped=0.5, handling=0.0):
    """Return rules and item kinds: small, of every shape, and usually possible.

    A share of end effectors is shaped, and of configurations the items have handling instructions.
    """
    effector, bin_sides = (tuple(rng.randint(*sides) for _ in range(2)) for sides in ((1, 4), (2, 5)))
    shape = random_effector(rng, effector) if rng.random() < shaped else {}
    pick_rule = rng.choice(("contain", "seal", "overlap") if shape else ("contain", "contain", "overlap"))
    limit = [min(3, side) for side in bin_sides]
    if pick_rule == "contain" and rng.random() < 0.95:
        limit = [min(pair) for pair in zip(limit, effector, strict=True)]
    kinds = {tuple(rng.randint(1, most) for most in (*limit, 3)) for _ in range(rng.randint(1, 5))}
    wide, deep, height = rng.randint(2, 6), rng.randint(2, 6), max(h for _, _, h in kinds) + rng.randint(0, 4)
    rules = Rules(
        (*bin_sides, rng.choice((1, 2, 3, 3))), (wide, deep, height), effector, rng.randint(1, 4), pick_rule,
        **dict(zip(("support", "support_margin"), rng.choice(SUPPORTS), strict=True)), **shape,
    )  # fmt: skip
    if rng.random() < 0.5:
        bin_size = (*(side + rng.randint(0, 3) for side in bin_sides), rules.bin_size[2])
        rules = replace(rules, bin_items=rng.randint(2, 5), refill=rng.choice(("each", "batch")), bin_size=bin_size)
        bin_sides = bin_size[:2]
    if rng.random() < 0.4:  # limits that seldom leave an item nowhere to go
        lowest, highest = (
            [[rng.choices(values, k=deep) for _ in range(wide)] for _ in range(rules.rotations)]
            for values in ((0, 0, 1, 2, 4), (0, 2, 3, 4, 9))
        )
        pick_ok = [rng.random() < 0.95 for _ in range(bin_sides[0] * bin_sides[1])]
        rules = replace(rules, pick_ok=pick_ok, lowest_top=lowest, highest_top=highest)
        if rng.random() < 0.5:
            lowest, highest = (rng.choices(values, k=len(pick_ok)) for values in ((0, 0, 0, 2), (9, 9, 9, 1)))
            rules = replace(rules, lowest_pick=lowest, highest_pick=highest)
    if rng.random() < handling:
        masses = rng.choice(((0, 1, 3), (2,), (1, 5, 9)))
        allowed = [rng.sample(range(rules.rotations), rng.randint(1, rules.rotations)) for _ in kinds]
        allowed = [range(rules.rotations) if rng.random() < 0.6 else each for each in allowed]
        loads = (None, None, 0, 1, 4, 7, 12)
        given = [(tuple(turns), rng.choice(masses), rng.choice(loads)) for turns in allowed]
        rules = replace(rules, handling=dict(zip(sorted(kinds), given, strict=True)))
    return rules, sorted(kinds)


def make_env(rules, kinds, **settings):
    """Return the package's environment for the oracle's rules."""
    given = asdict(rules)
    del given["turns"]  # not of the cell, but of an episode
    instructions = [given["handling"][kind] for kind in kinds] if given["handling"] else []
    given["handling"] = bool(instructions)
    turns, grams, max_load = zip(*instructions, strict=True) if instructions else (None,) * 3
    tables = {field.name: given.pop(field.name) for field in fields(Limits)}
    tables = {name: torch.tensor(table) for name, table in tables.items() if table is not None}
    limits = Limits(**tables) if tables else None
    given["support"] = support_of(given.pop("support"), given.pop("support_margin"))
    items = Kinds(kinds, turns=turns, grams=grams, max_load=max_load)
    return PickPlaceEnv(**given, reach=limits, **{"items": items, **settings})


def read_items(observation, row):
    """Return each item `(w, d, h)` in a bin and its corner `(x, y)`."""
    if "items" not in observation.keys():  # noqa: SIM118
        return [read_item(observation["bin_depth"][row].tolist())]
    items = [tuple(item) for item in observation["items"][row].tolist()]
    labels = [[0] * len(line) for line in observation["bin_labels"][row].tolist()]
    for number, (x, y, w, d, h) in enumerate(items, 1):
        assert (h > 0) == (number <= sum(item[4] > 0 for item in items))  # empty places come last
        for column in labels[x : x + w]:
            assert not any(column[y : y + d])  # items do not overlap
            column[y : y + d] = [number] * d
    assert labels == observation["bin_labels"][row].tolist()
    return [((w, d, h), (x, y)) for x, y, w, d, h in items if h]


def read_item(bin_depth):
    """Return the item `(w, d, h)` and its corner `(x, y)` that a `[W_B][D_B]` depth map shows."""
    filled = [(x, y) for x, column in enumerate(bin_depth) for y, height in enumerate(column) if height]
    (x0, y0), (x1, y1) = filled[0], filled[-1]
    return (x1 - x0 + 1, y1 - y0 + 1, int(bin_depth[x0][y0])), (x0, y0)


def compare_maps(oracle, observation, row):
    assert observation["bin_depth"][row].tolist() == oracle.bin_depth()
    assert observation["tote_depth"][row].tolist() == oracle.tote_depth()
    assert observation["tote_bearing"][row].tolist() == oracle.bearing
    assert observation["tote_height"][row].item() == oracle.tote_height
    if oracle.rules.handling is not None:
        compare_pile(oracle, observation, row)


def compare_pile(oracle, observation, row):
    """Compare the handling instructions in the bin, and what lies on what in the tote."""
    given = [oracle.rules.handling[item] for item, _ in oracle.contents]
    expected = [
        [sum(1 << turn for turn in turns), mass, NO_LIMIT if most is None else most] for turns, mass, most in given
    ]
    assert [each for each in observation["handling"][row].tolist() if any(each)] == expected
    items, room = oracle.placed, observation["pile_spare"].shape[1]
    labels = [[0] * oracle.rules.tote_size[1] for _ in range(oracle.rules.tote_size[0])]
    for number, item in enumerate(items, 1):
        for x, y in cells(item.corner[:2], item.size[:2]):
            labels[x][y] = number  # a later item is never below an earlier one
    assert observation["tote_labels"][row].tolist() == labels
    spare = [
        NO_LIMIT if item.most is None else item.most - load for item, load in zip(items, loads(items), strict=True)
    ]
    assert observation["pile_spare"][row].tolist() == spare + [0] * (room - len(items))
    below = [on | {number} for number, on in enumerate(piles_below(items))]
    found = [{*line.nonzero()[:, 0].tolist()} for line in observation["pile_below"][row]]
    assert found == below + [set()] * (room - len(items))


def fresh_oracle(rules, kinds, observation, row):
    """Return an oracle for an episode that has just begun in this row of an observation."""
    first, *others = read_items(observation, row)
    oracle = Oracle(rules, int(observation["tote_height"][row]), *first, others=others)
    assert all(item in kinds for item, _ in oracle.contents)
    compare_maps(oracle, observation, row)
    assert observation["action_mask"][row].any() and not observation["done"][row]
    return oracle


def compare_mask(oracle, mask, full, rng):
    """Compare every entry of a `[N_a]` mask, or 24 of them, half of them feasible if there are so many.

    Return the tally of failure codes of these 24.
    """
    codes = Counter()
    if full:
        assert mask.tolist() == oracle.full_mask()
        return codes
    yes, no = mask.nonzero().flatten().tolist(), (~mask).nonzero().flatten().tolist()
    count = min(12, len(yes))
    for action in rng.sample(yes, count) + rng.sample(no, min(24 - count, len(no))):
        code = oracle.try_action(action)[0]
        assert (code == SUCCESS) == mask[action], action
        codes[code] += 1
    return codes


def compare_arrivals(rules, kinds, left, found):
    """Return what lies in a bin, after checking what is new: `left` are the items that were there."""
    if rules.refill == "batch" and left:
        return left
    assert len(found) <= rules.bin_items and found[: len(left)] == left
    assert len(found) > len(left) or any(has_no_room(rules, kind, left) for kind in kinds)
    if len(found) < rules.bin_items:  # the next one had no room
        assert any(has_no_room(rules, kind, found) for kind in kinds)
    assert all(item in kinds for item, _ in found)
    return found


def has_no_room(rules, kind, contents):
    """Whether an item overlaps another one wherever it is put in the bin."""
    wide, deep = rules.bin_size[:2]
    full = {cell for item, position in contents for cell in cells(position, item[:2])}
    corners = product(range(wide - kind[0] + 1), range(deep - kind[1] + 1))
    return not any(full.isdisjoint(cells(corner, kind[:2])) for corner in corners)


def choose_action(rules, mask, rng, good=0.8):
    """Return mostly a feasible action, else any action, or any placement of a pick that is known to succeed."""
    feasible, anything = rng.choice(mask.nonzero().flatten().tolist()), rng.randrange(rules.num_actions)
    draw = rng.random()
    if draw < good:
        return feasible
    return (
        anything if draw < good + 0.3 * (1 - good) else rules.join(rules.split(feasible)[0], *rules.split(anything)[1:])
    )


def options_of(rules):
    """Return what a configuration has of each option that the rules tell apart."""
    shapes = (shape if isinstance(shape, str) else "mask" for shape in (rules.body, rules.cup))
    refill = rules.refill if rules.bin_items > 1 else "one item"
    limits = (rules.pick_ok is not None) + (rules.lowest_pick is not None)
    support, handling = (rules.support, rules.support_margin), rules.handling is not None
    return {*enumerate((rules.pick_rule, support, *shapes, refill, limits, rules.rotations, handling))}


def compare_config(rules, kinds, seed, rng, full_share, steps=STEPS, good=0.8):
    """Play one configuration; return the tally of failure codes, the number of full masks compared, and the tally of
    the codes in the other masks.

    ``good`` is the share of actions that are feasible for sure.
    """
    num_envs = rng.choice(NUM_ENVS)
    env = make_env(rules, kinds, num_envs=num_envs, seed=seed)
    least, most = max(h for _, _, h in kinds), rules.tote_size[2]
    asked = torch.tensor([[rng.randint(least, most)] for _ in range(num_envs)])
    td = env.reset(TensorDict({"tote_height": asked}, [num_envs]))
    assert td["tote_height"].equal(asked)
    oracles = [fresh_oracle(rules, kinds, td, row) for row in range(num_envs)]
    codes, full_masks, in_masks = Counter(), 0, Counter()
    for _ in range(steps):
        actions = []
        for oracle, mask in zip(oracles, td["action_mask"], strict=True):
            full = rng.random() < full_share
            full_masks += full
            in_masks += compare_mask(oracle, mask, full, rng)
            actions.append(choose_action(rules, mask, rng, good))
        before = td
        td, following = env.step_and_maybe_reset(td.clone().set("action", torch.tensor(actions)))
        after = td["next"]
        for row, (oracle, action) in enumerate(zip(oracles, actions, strict=True)):
            (item, position), *others = read_items(after, row)
            mask = after["action_mask"][row]
            feasible = mask.nonzero().flatten().tolist()[:1]
            left, taken = oracle.contents, oracle.taken(action)
            reward, terminated, failure = oracle.step(action, item, position, try_first=feasible, others=others)
            found = [after[key][row].item() for key in ("failure", "reward", "terminated", "done", "truncated")]
            assert found == [failure, reward, terminated, terminated, False]
            if reward:
                left = compare_arrivals(rules, kinds, [*left[:taken], *left[taken + 1 :]], [(item, position), *others])
            assert left == [(item, position), *others]
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
    return codes, full_masks, in_masks


SHAPES = "rectangle", "disc", "mask"
EACH = (
    ("contain", "overlap", "seal"), SUPPORTS, SHAPES, SHAPES, ("one item", "each", "batch"), range(3), range(1, 5),
    (False, True),
)  # fmt: skip
OPTIONS = {(number, value) for number, values in enumerate(EACH) for value in values}


@pytest.mark.parametrize(
    ("transitions", "full_masks", "handling", "seed"),
    [
        (2_000, 45, 0.4, 2),
        pytest.param(1_000_000, 10_000, 0.2, 0, marks=pytest.mark.slow),
        pytest.param(200_000, 2_000, 1.0, 1, marks=pytest.mark.slow),
    ],
)
def test_env_equals_oracle(transitions, full_masks, handling, seed):
    """Each option and each failure comes up."""
    draw, rng = Random(seed), Random(seed)
    codes, configs, refused, masks, met = Counter(), 0, 0, 0, set()
    while codes.total() < transitions or masks < full_masks:
        rules, kinds = draw_config(draw, handling=handling)
        env_seed = draw.randrange(1000)
        if not can_always_start(rules, kinds):
            with pytest.raises(ValueError):
                make_env(rules, kinds, num_envs=2, seed=env_seed)
            refused += 1
            continue
        more_codes, more_masks, _ = compare_config(rules, kinds, env_seed, rng, full_share=full_masks / transitions)
        codes, masks, configs = codes + more_codes, masks + more_masks, configs + 1
        met |= options_of(rules)
    assert set(codes) == set(range(11)), codes
    missing = OPTIONS - met - ({(len(EACH) - 1, False)} if handling == 1 else set())
    assert met <= OPTIONS and not missing, missing
    assert configs >= transitions // (max(NUM_ENVS) * STEPS)
    assert 0 < refused < 3 * configs


@pytest.mark.parametrize(("configs", "steps"), [(5, 25), pytest.param(400, 100, marks=pytest.mark.slow)])
def test_high_piles_equal_the_oracle(configs, steps):
    """Small items without a gripper on a small base, so that many lie on others, and over edges."""
    rng, codes, in_masks, full = Random(configs), Counter(), Counter(), 0
    for seed in range(configs):
        kinds = sorted({tuple(rng.randint(1, most) for most in (3, 2, 2)) for _ in range(4)})
        turns = [rng.choice(((0, 1), (0, 1), (0,))) for _ in kinds]
        given = [(each, rng.randint(0, 5), rng.choice((None, None, 0, 6, 12, 20))) for each in turns]
        rules = Rules(
            (3, 2, 1), (rng.randint(3, 5), rng.randint(3, 4), 9), (1, 1), 2, "overlap",
            rng.choice((0.0, 0.5, "bearing")), bin_items=rng.choice((1, 2)),
            handling=dict(zip(kinds, given, strict=True)),
        )  # fmt: skip
        some, count, others = compare_config(rules, kinds, seed, rng, 0.05, steps, 0.97)
        codes, full, in_masks = codes + some, full + count, in_masks + others
    assert in_masks[OVERLOADED] > 10 * configs and in_masks[FORBIDDEN_TURN] > configs and full
    assert codes[SUCCESS] > 0.8 * codes.total()
