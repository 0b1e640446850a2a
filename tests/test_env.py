"""The environment as a TorchRL citizen, and properties that any packing must have."""

import copy
import re

import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from oracle import OVERFLOW, STUCK, SUCCESS, UNSTABLE, Oracle, Rules, rotate
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs, step_mdp

from pickplace import PickPlaceEnv
from pickplace.task.items import Kinds

PAPER = [(1, 1, 1), (2, 1, 1), (1, 2, 1), (2, 2, 1)]
OBSERVATION = ("bin_depth", "tote_depth", "tote_height", "action_mask")


def make_env(kinds=PAPER, **kwargs):
    """A small environment: the paper's, but for what is given."""
    return PickPlaceEnv(**{"items": Kinds(kinds=kinds), "num_envs": 4, "seed": 0, "device": "cpu"} | kwargs)


def narrow_env(width, length, **kwargs):
    """One item `(width, 1, 1)` that fills its bin, and a tote one cell deep: a place cell is a shift."""
    sizes = {"bin_size": (width, 1, 1), "tote_size": (length, 1, 2), "effector_size": (width, 1)}
    return make_env([(width, 1, 1)], **{"rotations": 1, "num_envs": 1, **sizes, **kwargs})


def observe(td):
    return td.select(*OBSERVATION)


def rows(mask):
    """A reset request for the rows that are True, `[N]`."""
    return TensorDict({"_reset": mask[:, None]}, mask.shape)


def first_feasible(td):
    return td["action_mask"].int().argmax(-1)


def random_feasible(td, generator):
    """A uniformly random feasible action of each row, `[N]`."""
    return torch.multinomial(td["action_mask"].float(), 1, generator=generator).squeeze(-1)


def ending(td, done):
    """Feasible actions, but for the rows to end: there the first infeasible action."""
    return torch.where(done, (~td["action_mask"]).int().argmax(-1), first_feasible(td))


def play(env, td, steps, choose=first_feasible):
    """Plays on across episodes; returns `[(observation and next, ...)]`, one entry a step."""
    history = []
    for _ in range(steps):
        td, following = env.step_and_maybe_reset(td.set("action", choose(td)))
        history.append(td.clone())
        td = following
    return history


def same(left, right):
    """Whether two TensorDicts hold the same keys and equal values."""
    return set(left.keys(True, True)) == set(right.keys(True, True)) and bool((left == right).all())


# TorchRL


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"num_envs": 1},
        {"rotations": 3},
        {"pick_rule": "overlap", "min_support": 0.25, "strict_support": True},
        {
            "kinds": [(2, 3, 2), (1, 1, 1)],
            "bin_size": (4, 6, 2),
            "tote_size": (5, 7, 6),
            "effector_size": (2, 4),
        },
    ],
)
def test_specs_hold(kwargs):
    env = make_env(**kwargs)
    env.set_seed(0)
    check_env_specs(env)


def test_shapes_and_dtypes():
    env = make_env([(1, 2, 1)], bin_size=(3, 4, 1), tote_size=(5, 6, 7), effector_size=(1, 2), rotations=2, num_envs=3)
    assert env.batch_size == torch.Size([3])
    td = env.rand_step(env.reset())
    expected = {
        "bin_depth": ((3, 3, 4), torch.float32),
        "tote_depth": ((3, 5, 6), torch.float32),
        "tote_height": ((3, 1), torch.int64),
        "action_mask": ((3, 3 * 4 * 5 * 6 * 2), torch.bool),
        "action": ((3,), torch.int64),
        ("next", "reward"): ((3, 1), torch.float32),
        ("next", "terminated"): ((3, 1), torch.bool),
        ("next", "truncated"): ((3, 1), torch.bool),
        ("next", "done"): ((3, 1), torch.bool),
        ("next", "failure"): ((3, 1), torch.int64),
        ("next", "occupancy"): ((3, 1), torch.float32),
    }
    expected |= {("next", key): expected[key] for key in OBSERVATION}
    assert {key: (tuple(td[key].shape), td[key].dtype) for key in expected} == expected


def test_rollouts_and_random_actions_work_out_of_the_box():
    env = make_env()
    action = env.rand_action(env.reset())["action"]
    assert action.shape == (4,)
    assert ((action >= 0) & (action < 5 * 5 * 6 * 6 * 4)).all()
    assert env.rollout(5).batch_size[0] == 4
    assert env.rollout(12, break_when_any_done=False).batch_size == torch.Size([4, 12])


def test_reset_shows_an_empty_tote_and_one_item():
    td = make_env(num_envs=64).reset()
    assert (td["tote_height"] == 5).all()
    assert (td["tote_depth"] == 5).all()
    areas = td["bin_depth"].sum((1, 2))
    assert set(areas.tolist()) == {1.0, 2.0, 4.0}
    assert not td["done"].any()


def start(steps=3):
    """An environment some steps into its episodes, and its observation."""
    env = make_env()
    td = env.reset()
    for _ in range(steps):
        td = step_mdp(env.step(td.set("action", first_feasible(td))))
    return env, td


@pytest.mark.parametrize("chosen", [[True, False, True, False], [False, False, False, True], [False] * 4])
@pytest.mark.parametrize("only_reset", [True, False])
def test_partial_reset_touches_only_the_requested_rows(chosen, only_reset):
    chosen = torch.tensor(chosen)
    (env, td), (other, other_td) = start(), start()
    before = observe(td).clone()
    reset = env.reset(rows(chosen) if only_reset else td.update(rows(chosen)))
    assert (reset["tote_depth"][chosen] == 5).all()
    assert reset["action_mask"][chosen].any(-1).all()
    if not only_reset:  # TorchRL keeps the rows it was given, and has none to keep if it was given none
        assert same(observe(reset)[~chosen], before[~chosen])
    # The running episodes go on as they do in the other environment, which was not reset.
    action = first_feasible(before)
    action[chosen] = first_feasible(reset)[chosen]
    left, right = env.step(reset.set("action", action)), other.step(other_td.set("action", action))
    assert same(left["next"][~chosen], right["next"][~chosen])
    assert left["next", "reward"].gt(0).all()


def test_step_and_maybe_reset_renews_only_what_is_done():
    env = make_env()
    td = env.reset()
    done = torch.tensor([False, True, False, True])
    td, following = env.step_and_maybe_reset(td.set("action", ending(td, done)))
    assert td["next", "done"].squeeze(-1).equal(done)
    assert (following["tote_depth"][done] == 5).all()
    assert not following["done"].any()
    assert same(observe(following)[~done], observe(td["next"])[~done])
    assert (following["tote_depth"][~done].amin((1, 2)) == 4).all()


def test_tote_height_is_honoured_per_env_and_kept_by_running_episodes():
    env = make_env()
    heights = torch.tensor([[1], [3], [5], [2]])
    td = env.reset(TensorDict({"tote_height": heights}, [4]))
    assert td["tote_height"].equal(heights)
    assert (td["tote_depth"] == heights[..., None]).all()

    done = torch.tensor([True, False, False, True])
    td = step_mdp(env.step(td.set("action", ending(td, done))))
    assert td["tote_height"].equal(heights)
    td = env.reset(td.update(rows(done)).set("tote_height", torch.tensor([[4], [3], [5], [4]])))
    assert td["tote_height"].tolist() == [[4], [3], [5], [4]]
    after = env.step(td.set("action", first_feasible(td)))["next"]
    assert after["tote_height"].equal(td["tote_height"])
    assert after["occupancy"][done].equal(after["reward"][done] / (6 * 6 * 4))


@pytest.mark.parametrize("height", [0, -1, 6])
def test_a_tote_height_out_of_range_is_refused(height):
    heights = torch.tensor([[5], [height], [5], [5]])
    with pytest.raises(ValueError, match=rf"tote_height.*{height}"):
        make_env().reset(TensorDict({"tote_height": heights}, [4]))


def test_step_returns_a_new_tensordict_and_leaves_its_input_alone():
    env = make_env()
    td = env.reset()
    kept = []
    for _ in range(8):
        td.set("action", first_feasible(td))
        before = td.clone()
        after = env.step(td)
        assert same(td.exclude("next"), before)
        assert after["next"] is not td
        kept.append((after["next"], after["next"].clone()))
        td = env.step_and_maybe_reset(td)[1] if after["next", "done"].any() else step_mdp(after)
        if after["next", "done"].any():
            break
    assert all(same(live, copy) for live, copy in kept)


def test_loading_a_state_leaves_what_was_handed_out_alone():
    env = make_env(masks=("action", "outcome"))
    td = env.reset()
    state = copy.deepcopy(env.state_dict())
    after = env.step(td.set("action", first_feasible(td)))["next"]
    before = after.clone()
    env.load_state_dict(state)
    assert same(after, before)
    assert same(env._observation(), td.exclude("action", "done", "terminated", "truncated", "next"))


def test_every_row_may_fail_at_once():
    env = make_env()
    td = env.reset()
    after = env.step(td.set("action", ending(td, torch.ones(4, dtype=torch.bool))))["next"]
    assert after["terminated"].all()
    assert same(after.select(*OBSERVATION), observe(td))


def test_truncated_stays_false():
    env = make_env()
    assert not any(td["next", "truncated"].any() for td in play(env, env.reset(), 60))


# Seeds and episodes


def test_the_same_seed_gives_the_same_episodes():
    histories = [play(env, env.reset(), 40) for env in (make_env(seed=3), make_env(seed=3), make_env(seed=4))]
    assert all(same(left, right) for left, right in zip(histories[0], histories[1], strict=True))
    assert not all(same(left, right) for left, right in zip(histories[0], histories[2], strict=True))


def test_set_seed_starts_the_episodes_of_that_seed():
    used, fresh = make_env(seed=0), make_env(seed=7)
    play(used, used.reset(), 5)
    used.set_seed(7)
    left, right = play(used, used.reset(), 20), play(fresh, fresh.reset(), 20)
    assert all(same(a, b) for a, b in zip(left, right, strict=True))


def episodes(num_envs, steps):
    """Episode id -> the bin maps of that finished episode; the k-th of env i among N has id `k * N + i`."""
    env = make_env(num_envs=num_envs, tote_size=(4, 4, 2), seed=11)
    current, count, finished = [[] for _ in range(num_envs)], [0] * num_envs, {}
    for td in play(env, env.reset(), steps):
        for i in range(num_envs):
            current[i].append(td["bin_depth"][i].tolist())
            if td["next", "done"][i]:
                finished[count[i] * num_envs + i] = [*current[i], td["next", "bin_depth"][i].tolist()]
                current[i], count[i] = [], count[i] + 1
    return finished


def test_an_episode_meets_the_same_items_whatever_the_number_of_envs():
    few, many = episodes(2, 120), episodes(6, 40)
    shared = few.keys() & many.keys()
    assert len(shared) >= 8
    assert all(few[k] == many[k] for k in shared)
    assert len({str(items) for items in many.values()}) == len(many)


def test_item_positions_and_kinds_are_uniform():
    bins = make_env(num_envs=8000).reset()["bin_depth"]
    areas = bins.sum((1, 2))
    shares = torch.stack([(areas == area).float().mean() for area in (1, 2, 4)])
    assert torch.allclose(shares, torch.tensor([0.25, 0.5, 0.25]), atol=0.025)
    singles = bins[areas == 1].mean(0)
    assert torch.allclose(singles, torch.full((5, 5), 1 / 25), atol=0.02)


def test_weights_are_the_probabilities_of_the_kinds():
    items = Kinds(kinds=[(1, 1, 1), (2, 2, 1), (1, 1, 2)], weights=[3, 1, 0])
    volumes = make_env(items=items, num_envs=8000).reset()["bin_depth"].sum((1, 2))
    assert (volumes == 1).float().mean().item() == pytest.approx(0.75, abs=0.025)
    assert not (volumes == 2).any()


def test_a_reset_state_always_has_a_feasible_action():
    kinds = [(1, 1, 1), (2, 1, 2), (2, 2, 3)]
    env = make_env(kinds, bin_size=(4, 4, 2), tote_size=(4, 5, 6), num_envs=256)
    for height in range(3, 7):
        td = env.reset(TensorDict({"tote_height": torch.full((256, 1), height)}, [256]))
        assert td["action_mask"].any(-1).all()


# Bad input


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"rotations": 5}, ["rotations", "5", "4"]),
        ({"rotations": 0}, ["rotations", "0", "1"]),
        ({"kinds": [(6, 1, 1)]}, ["6x1x1", "bin_size", "5x5"]),
        ({"kinds": [(1, 1, 6)]}, ["1x1x6", "tote_size", "5"]),
        ({"kinds": [(4, 1, 1)]}, ["4x1x1", "effector_size", "3x3"]),
        ({"kinds": [(1, 0, 1)]}, ["kinds", "1, 0, 1"]),
        ({"kinds": []}, ["kinds"]),
        ({"bin_size": (-5, 5, 1)}, ["bin_size", "-5"]),
        ({"tote_size": (6, 0, 5)}, ["tote_size", "6, 0, 5"]),
        ({"tote_size": (6, 6)}, ["tote_size", "6, 6"]),
        ({"effector_size": (3, -3)}, ["effector_size", "-3"]),
        ({"effector_size": (3, 3, 1)}, ["effector_size", "3, 3, 1"]),
        ({"pick_rule": "grab"}, ["pick_rule", "grab", "contain", "overlap"]),
        ({"min_support": 1.5}, ["min_support", "1.5"]),
        ({"min_support": -0.1}, ["min_support", "-0.1"]),
        ({"min_support": 1.0, "strict_support": True}, ["1x1x1"]),
        ({"num_envs": 0}, ["num_envs", "0"]),
        ({"rotations": 4.0}, ["rotations=4.0"]),
        ({"rotations": True}, ["rotations=True"]),
        # Deep bin walls: the effector cannot reach an item in the corner of a bin smaller than itself.
        ({"kinds": [(1, 1, 1)], "bin_size": (2, 2, 2)}, ["1x1x1"]),
        # A tote smaller than the effector: only an item level with its rim can be placed.
        ({"kinds": [(1, 1, 1)], "tote_size": (2, 2, 3)}, ["1x1x1", "3"]),
    ],
)
def test_an_impossible_configuration_is_refused(kwargs, words):
    with pytest.raises(ValueError) as error:
        make_env(**kwargs)
    assert [word for word in words if word not in str(error.value)] == [], str(error.value)


@pytest.mark.parametrize("weights", [[1.0], [1.0, -1.0], [0.0, 0.0], [float("nan"), 1.0]])
def test_bad_weights_are_refused(weights):
    with pytest.raises(ValueError, match="weights"):
        make_env(items=Kinds(kinds=[(1, 1, 1), (2, 1, 1)], weights=weights))


def test_a_tote_smaller_than_the_effector_serves_items_level_with_its_rim():
    assert make_env([(1, 1, 3)], tote_size=(2, 2, 3)).reset()["action_mask"].any(-1).all()


@pytest.mark.parametrize("action", [-1, 5 * 5 * 6 * 6 * 4])
def test_an_action_out_of_range_is_refused(action):
    env = make_env()
    td = env.reset()
    with pytest.raises(ValueError, match=rf"action.*{re.escape(str(action))}"):
        env.step(td.set("action", torch.tensor([0, 0, action, 0])))


@pytest.mark.parametrize("action", [float("nan"), 0.0, 28.5])
def test_an_action_is_an_integer(action):
    env = make_env()
    with pytest.raises(ValueError, match=rf"action={action} .*: expected whole numbers"):
        env.step(env.reset().set("action", torch.full((4,), action)))


def test_reset_takes_no_seed():
    env = make_env()
    for td in (None, TensorDict({"_reset": torch.tensor([[True], [False], [True], [False]])}, [4])):
        with pytest.raises(TypeError, match=r"reset\(seed=2\): expected a TensorDict only; set_seed"):
            env.reset(td, seed=2)


# The rules


@given(
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
    st.tuples(st.integers(-9, 9), st.integers(-9, 9)),
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
)
def test_the_rotation_table_is_a_group(effector, offset, size):
    turned = effector, offset, size
    for r in range(4):
        assert rotate(r, effector, offset, size) == turned
        turned = rotate(1, *turned)
    assert turned == (effector, offset, size)


@pytest.mark.parametrize(("width", "length", "shift"), [(2, 4, 1), (3, 6, 1), (3, 6, 2), (5, 9, 2), (7, 9, 2)])
def test_support_is_compared_exactly_in_float64(width, length, shift):
    share = (width - shift) / width
    up, down = torch.tensor(share, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64)
    limits = {
        (share, False): SUCCESS,
        (share, True): UNSTABLE,
        (torch.nextafter(up, up + 1).item(), False): UNSTABLE,
        (torch.nextafter(up, down).item(), True): SUCCESS,
    }
    for (min_support, strict), expected in limits.items():
        env = narrow_env(width, length, min_support=min_support, strict_support=strict)
        td = env.reset()
        pick = (width - 1) // 2
        place = [pick * length + pick, pick * length + pick + shift]
        td = step_mdp(env.step(td.set("action", torch.tensor(place[:1]))))
        assert td["action_mask"][0, place[1]].item() == (expected == SUCCESS)
        failure = env.step(td.set("action", torch.tensor(place[1:])))["next", "failure"].item()
        # A success that leaves no room for the next item is `stuck`.
        assert failure == expected or (expected == SUCCESS and failure == STUCK), (min_support, strict)


def test_a_full_tote_is_stuck_and_keeps_the_reward_of_the_last_step():
    env = narrow_env(2, 2, tote_size=(2, 1, 1))
    td = env.step(env.reset().set("action", torch.tensor([0])))["next"]
    assert td["reward"].item() == 2
    assert td["occupancy"].item() == 1
    assert td["terminated"].item() and td["done"].item()
    assert td["failure"].item() == STUCK
    assert not td["action_mask"].any()


def test_overflow_leaves_tote_bin_and_mask_as_they_were():
    env = narrow_env(2, 4, tote_size=(4, 1, 1))
    first = step_mdp(env.step(env.reset().set("action", torch.tensor([0]))))
    td = env.step(first.set("action", torch.tensor([0])))["next"]
    assert td["failure"].item() == OVERFLOW
    assert td["reward"].item() == 0
    assert td["terminated"].item()
    assert td["occupancy"].item() == 0.5
    assert same(observe(td), observe(first))


SIDES = st.integers(1, 3)


@settings(max_examples=25, suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow])
@given(
    kinds=st.lists(st.tuples(SIDES, SIDES, SIDES), min_size=1, max_size=4, unique=True),
    bin_walls=st.integers(1, 2),
    tote_size=st.tuples(st.integers(3, 6), st.integers(3, 6), st.integers(3, 6)),
    effector_size=st.tuples(SIDES, SIDES),
    rotations=st.integers(1, 4),
    pick_rule=st.sampled_from(["contain", "overlap"]),
    min_support=st.sampled_from([0.0, 0.5, 1.0]),
    seed=st.integers(0, 2**31 - 1),
)
def test_placing_only_raises_cells_up_to_the_rim_and_rewards_are_volumes(kinds, bin_walls, seed, **sizes):
    try:
        env = make_env(kinds, bin_size=(4, 5, bin_walls), seed=seed, **sizes)
    except ValueError:
        assume(False)
    generator = torch.Generator().manual_seed(seed)
    td = env.reset()
    rim = td["tote_height"][..., None]
    capacity = sizes["tote_size"][0] * sizes["tote_size"][1] * td["tote_height"]
    volume = torch.zeros(4, 1)
    for _ in range(60):
        before = td
        item_volume = td["bin_depth"].sum((1, 2))[:, None]
        td = env.step(td.set("action", random_feasible(td, generator)))["next"]
        assert (td["tote_depth"] <= before["tote_depth"]).all()
        assert ((td["tote_depth"] >= 0) & (td["tote_depth"] <= rim)).all()
        assert (before["tote_depth"] - td["tote_depth"]).sum((1, 2))[:, None].ge(item_volume).all()
        assert td["reward"].equal(item_volume)
        volume += td["reward"]
        assert torch.allclose(td["occupancy"], volume / capacity)
        assert torch.isin(td["failure"], torch.tensor([SUCCESS, STUCK])).all()
        assert (td["failure"] == STUCK).equal(td["done"])
        if td["done"].any():
            break


def test_the_oracle_by_hand():
    """A few cases of the rules worked out on paper, so that the oracle is not its own judge."""
    rules = Rules()
    oracle = Oracle(rules, 5, (2, 1, 1), (0, 0))
    # Reference cell (1, 1): the corner pick puts the effector's corner on the item's.
    assert oracle.try_action(rules.join((1, 1), (1, 1), 0))[1][:3] == [[1] + [0] * 5] * 2 + [[0] * 6]
    # A quarter turn sends offset (0, 0) of a 2x1 item in a 3x3 effector to (2, 0), size 1x2.
    heights = oracle.try_action(rules.join((1, 1), (1, 1), 1))[1]
    assert [(x, y) for x in range(6) for y in range(6) if heights[x][y]] == [(2, 0), (2, 1)]
    # The effector hangs over the tote's wall, above the item's top.
    assert oracle.try_action(rules.join((1, 1), (5, 1), 0))[0] == 3
    assert oracle.try_action(rules.join((3, 3), (1, 1), 0))[0] == 1
    # The bin's walls are level with the item, so the effector may hang over them.
    assert oracle.try_action(rules.join((0, 0), (1, 1), 0))[0] == 0
    deep = Oracle(Rules(bin_size=(5, 5, 2)), 5, (2, 1, 1), (0, 0))
    assert deep.try_action(rules.join((0, 0), (1, 1), 0))[0] == 2


@pytest.mark.parametrize("kept", [0, 5000, 2**26])
@pytest.mark.parametrize("masks", [("action",), ("outcome", "action"), ()])
def test_masks_of_empty_totes_are_kept_and_are_the_same(kept, masks, monkeypatch):
    monkeypatch.setattr("pickplace.envs.torchrl.STARTS_BYTES", kept)
    kinds = [(1, 1, 1), (2, 1, 2), (1, 3, 1)]
    env = make_env(kinds, tote_size=(4, 4, 4), num_envs=12, masks=masks)
    generator = torch.Generator().manual_seed(0)
    for _ in range(12):
        rows = torch.rand(12, 1, generator=generator) < 0.5
        heights = torch.randint(2, 5, (12, 1), generator=generator)
        td = env.reset(TensorDict({"_reset": rows, "tote_height": heights}, [12]))
        placements = env.rules.placements(env.heights, env.tote_height, env.current_item)
        expected = {
            "action": env.rules.action_mask(placements),
            "outcome": env.rules.outcome_mask(placements).flatten(1),
        }
        torch.testing.assert_close(env.feasible, expected["outcome"].any(1))
        for name in masks:
            assert torch.equal(td[f"{name}_mask"], expected[name])
        size = env.rules.num_actions * ("action" in masks) + env.rules.num_outcomes * (
            "action" not in masks or "outcome" in masks
        )
        assert len(env._starts) * size <= kept + 12 * size


def test_partial_reset_keeps_why_the_others_ended():
    env = PickPlaceEnv(num_envs=4, seed=0)
    td = env.reset()
    after = env.step(td.set("action", (~td["action_mask"]).int().argmax(-1)))["next"]
    chosen = torch.tensor([True, False, True, False])
    reset = env.reset(after.clone().set("_reset", chosen[:, None]))
    for key in ("done", "terminated", "truncated", "failure"):
        assert torch.equal(reset[key][~chosen], after[key][~chosen]) and not reset[key][chosen].any(), key
