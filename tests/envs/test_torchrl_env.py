"""The environment as TorchRL wants it, its episodes and their items, and properties that any packing must have."""

import copy
import re

import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from oracle import OVERFLOW, STUCK, SUCCESS
from problems import late_state, random_limits
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs, step_mdp

from pickplace import CellSpec, PickPlaceEnv
from pickplace.task.feasibility import action_mask, footprint_mask, placing_maps
from pickplace.task.items import PAPER_KINDS, Kinds

OBSERVATION = ("bin_depth", "tote_depth", "tote_height", "action_mask")


def make_env(kinds=PAPER_KINDS, **kwargs):
    """Return a small environment: the paper's, but for what is given."""
    return PickPlaceEnv(**{"items": Kinds(kinds), "num_envs": 4} | kwargs)


def rows(chosen, **entries):
    """Return a request to reset some rows, ``[N]``."""
    return TensorDict({"_reset": torch.as_tensor(chosen)[:, None], **entries}, [len(chosen)])


def first_feasible(td):
    return td["action_mask"].int().argmax(-1)


def ending(td, done):
    """Return feasible actions, but for the rows to end: there the first infeasible one."""
    return torch.where(done, (~td["action_mask"]).int().argmax(-1), first_feasible(td))


def play(env, steps):
    """Play the first feasible action on across episodes; return ``[(observation and next, ...)]``, one entry a step."""
    td, history = env.reset(), []
    for _ in range(steps):
        td, following = env.step_and_maybe_reset(td.set("action", first_feasible(td)))
        history.append(td.clone())
        td = following
    return history


def same(left, right):
    """Return whether two TensorDicts, or lists of them, hold the same keys and equal values."""
    if isinstance(left, list):
        return len(left) == len(right) and all(map(same, left, right))
    return set(left.keys(True, True)) == set(right.keys(True, True)) and bool((left == right).all())


# ---------------------------------------------------------------------- TorchRL
@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"num_envs": 1, "rotations": 3, "masks": ()},
        {"pick_rule": "overlap", "min_support": 0.25, "strict_support": True, "masks": ("footprint", "action")},
        {"kinds": [(2, 3, 2), (1, 1, 1)], "bin_size": (4, 6, 2), "tote_size": (5, 7, 6), "effector_size": (2, 4)},
        {"limits": random_limits(CellSpec(rotations=2), 0), "rotations": 2, "kinds": [(1, 1, 1)]},
    ],
)
def test_specs_hold(kwargs):
    check_env_specs(make_env(**kwargs))


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
        **{("next", key): ((3, 1), torch.bool) for key in ("terminated", "truncated", "done")},
        ("next", "failure"): ((3, 1), torch.int64),
        ("next", "occupancy"): ((3, 1), torch.float32),
    }
    expected |= {("next", key): expected[key] for key in OBSERVATION}
    assert {key: (tuple(td[key].shape), td[key].dtype) for key in expected} == expected
    assert env.rollout(12, break_when_any_done=False).batch_size == torch.Size([3, 12])


def test_reset_shows_an_empty_tote_and_one_item():
    td = make_env(num_envs=64).reset()
    assert (td["tote_height"] == 5).all() and (td["tote_depth"] == 5).all() and not td["done"].any()
    assert set(td["bin_depth"].sum((1, 2)).tolist()) == {1.0, 2.0, 4.0}


@pytest.mark.parametrize("chosen", [[True, False, True, False], [False, False, False, True], [False] * 4])
@pytest.mark.parametrize("only_reset", [True, False])
def test_partial_reset_touches_only_the_requested_rows(chosen, only_reset):
    chosen = torch.tensor(chosen)
    (env, td), (other, other_td) = (late_state(4, num_envs=4, seed=0) for _ in range(2))
    before = td.select(*OBSERVATION).clone()
    reset = env.reset(rows(chosen) if only_reset else td.update(rows(chosen)))
    assert (reset["tote_depth"][chosen] == 5).all()
    assert reset["action_mask"][chosen].any(-1).all()
    assert same(reset.select(*OBSERVATION)[~chosen], before[~chosen])
    # The running episodes go on as they do in the other environment, which was not reset.
    action = torch.where(chosen, first_feasible(reset), first_feasible(before))
    left, right = env.step(reset.set("action", action)), other.step(other_td.set("action", action))
    assert same(left["next"][~chosen], right["next"][~chosen])
    assert left["next", "reward"].gt(0).all()


def test_partial_reset_keeps_why_the_others_ended():
    env = make_env()
    td = env.reset()
    after = env.step(td.set("action", ending(td, torch.ones(4, dtype=torch.bool))))["next"]
    assert after["terminated"].all() and same(after.select(*OBSERVATION), td.select(*OBSERVATION))
    chosen = torch.tensor([True, False, True, False])
    reset = env.reset(after.clone().update(rows(chosen)))
    for key in ("done", "terminated", "truncated", "failure"):
        assert torch.equal(reset[key][~chosen], after[key][~chosen]) and not reset[key][chosen].any(), key


def test_step_and_maybe_reset_renews_only_what_is_done():
    env = make_env()
    td, done = env.reset(), torch.tensor([False, True, False, True])
    td, following = env.step_and_maybe_reset(td.set("action", ending(td, done)))
    assert td["next", "done"].squeeze(-1).equal(done) and not td["next", "truncated"].any()
    assert (following["tote_depth"][done] == 5).all() and not following["done"].any()
    assert same(following.select(*OBSERVATION)[~done], td["next"].select(*OBSERVATION)[~done])
    assert (following["tote_depth"][~done].amin((1, 2)) == 4).all()


def test_tote_height_is_honoured_per_env_and_kept_by_running_episodes():
    env, heights = make_env(), torch.tensor([[1], [3], [5], [2]])
    td = env.reset(TensorDict({"tote_height": heights}, [4]))
    assert td["tote_height"].equal(heights) and (td["tote_depth"] == heights[..., None]).all()

    done = torch.tensor([True, False, False, True])
    td = step_mdp(env.step(td.set("action", ending(td, done))))
    assert td["tote_height"].equal(heights)
    td = env.reset(td.update(rows(done)).set("tote_height", torch.tensor([[4], [1], [1], [4]])))
    assert td["tote_height"].tolist() == [[4], [3], [5], [4]]
    after = env.step(td.set("action", first_feasible(td)))["next"]
    assert after["tote_height"].equal(td["tote_height"])
    assert after["occupancy"][done].equal(after["reward"][done] / (6 * 6 * 4))


def test_nothing_that_was_handed_out_changes():
    """Neither by a step, whose input it is or was, nor by loading a state."""
    env = make_env(masks=("action", "footprint"))
    td = env.reset()
    first, state, kept = td.clone(), copy.deepcopy(env.state_dict()), []
    for step in range(6):
        td.set("action", ending(td, torch.tensor([False, step == 2, False, step == 4])))
        before = td.clone()
        after = env.step(td)
        assert same(td.exclude("next"), before) and after["next"] is not td
        kept.append((after["next"], after["next"].clone()))
        td = step_mdp(after)
    env.load_state_dict(state)
    assert all(same(*pair) for pair in kept)
    assert same(env._observation(), first.exclude("done", "terminated", "truncated"))


# ---------------------------------------------------------------------- seeds and episodes
def test_a_seed_is_a_stream_of_episodes():
    histories = [play(make_env(seed=seed), 40) for seed in (3, 3, 4)]
    assert same(histories[0], histories[1]) and not same(histories[0], histories[2])
    used = make_env(seed=0)
    play(used, 5)
    used.set_seed(3)
    assert same(play(used, 40), histories[0])


@pytest.mark.parametrize("stream", ["train", "validation", "test"])
def test_streams_differ_and_episodes_may_be_numbered(stream):
    """Slot ``i`` plays episodes ``first + i``, ``first + i + stride``, ..."""
    one, bins = make_env(num_envs=1, stream=stream), []
    for _ in range(12):
        bins.append(one.reset()["bin_depth"][0])
    many = make_env(num_envs=3, stream=stream, first_episode=2, episode_stride=4)
    for reset in range(2):
        found = many.reset()["bin_depth"]
        assert all(torch.equal(found[slot], bins[2 + slot + 4 * reset]) for slot in range(3))
    other = make_env(num_envs=12, stream={"train": "test"}.get(stream, "train")).reset()["bin_depth"]
    assert not torch.equal(other, torch.stack(bins))


def episodes(num_envs, steps):
    """Return, for each finished episode, its bin maps; the k-th of slot i among N has number ``k * N + i``."""
    current, count, finished = [[] for _ in range(num_envs)], [0] * num_envs, {}
    for td in play(make_env(num_envs=num_envs, tote_size=(4, 4, 2), seed=11), steps):
        for i in range(num_envs):
            current[i].append(td["bin_depth"][i].tolist())
            if td["next", "done"][i]:
                finished[count[i] * num_envs + i] = [*current[i], td["next", "bin_depth"][i].tolist()]
                current[i], count[i] = [], count[i] + 1
    return finished


def test_an_episode_meets_the_same_items_whatever_the_number_of_envs():
    few, many = episodes(2, 70), episodes(6, 25)
    shared = few.keys() & many.keys()
    assert len(shared) >= 8 and all(few[k] == many[k] for k in shared)
    assert len({str(items) for items in many.values()}) == len(many)


def test_kinds_and_positions_are_uniform():
    bins = make_env(num_envs=8000).reset()["bin_depth"]
    areas = bins.sum((1, 2))
    shares = torch.stack([(areas == area).float().mean() for area in (1, 2, 4)])
    assert torch.allclose(shares, torch.tensor([0.25, 0.5, 0.25]), atol=0.025)
    assert torch.allclose(bins[areas == 1].mean(0), torch.full((5, 5), 1 / 25), atol=0.02)


def test_a_reset_state_always_has_a_feasible_action():
    env = make_env([(1, 1, 1), (2, 1, 2), (2, 2, 3)], bin_size=(4, 4, 2), tote_size=(4, 5, 6), num_envs=256)
    for height in range(3, 7):
        td = env.reset(TensorDict({"tote_height": torch.full((256, 1), height)}, [256]))
        assert td["action_mask"].any(-1).all()
    # A tote smaller than the effector serves items that are level with its rim.
    assert make_env([(1, 1, 3)], tote_size=(2, 2, 3)).reset()["action_mask"].any(-1).all()


# ---------------------------------------------------------------------- bad input
@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"rotations": 5}, "rotations=5: expected 1, 2, 3 or 4"),
        ({"size": 3}, "size=3: expected one of bin_size"),
        ({"kinds": [(6, 1, 1)]}, "item 6x1x1 does not fit bin_size: expected at most 5x5"),
        ({"kinds": [(4, 1, 1)]}, "item 4x1x1 does not fit effector_size: expected at most 3x3"),
        ({"kinds": [(1, 1, 6)]}, r"item 1x1x6 is higher than the tote: expected at most tote_size\[2\]=5"),
        ({"min_support": 1.0, "strict_support": True}, "item 1x1x1 .* has no feasible action"),
        # Deep bin walls: the effector cannot reach an item in the corner of a bin smaller than itself.
        ({"kinds": [(1, 1, 1)], "bin_size": (2, 2, 2)}, "1x1x1 at x=0, y=0 in the bin has no feasible action"),
        # A tote smaller than the effector: only an item level with its rim can be placed.
        ({"kinds": [(1, 1, 1)], "tote_size": (2, 2, 3)}, "1x1x1 .* empty tote of height 3 .bin 5x5x1, tote 2x2x3"),
        ({"items": [(1, 1, 1)]}, "items=.*expected an ItemDistribution"),
        *(({"num_envs": value}, f"num_envs={value}: expected a whole number >= 1") for value in (0, 1.5, True)),
        ({"seed": -1}, "seed=-1: expected a whole number >= 0"),
        ({"stream": "dev"}, "stream='dev': expected one of train, validation, test"),
        ({"masks": ("all",)}, "masks=.'all',.: expected any of 'action', 'footprint'"),
    ],
)
def test_an_impossible_configuration_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_env(**kwargs)


def test_limits_that_leave_an_item_no_place_are_refused():
    limits = random_limits(CellSpec(), 0)
    limits.highest_top.fill_(0)
    with pytest.raises(ValueError, match="has no feasible action on the empty tote"):
        make_env(limits=limits)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.tensor([0, 0, -1, 0]), "action=-1: expected between 0 and 3599"),
        (torch.tensor([0, 0, 3600, 0]), "action=3600: expected between"),
        *((torch.full((4,), value), f"action={value} .*: expected whole") for value in (float("nan"), 0.0, 28.5)),
    ],
)
def test_bad_actions_are_refused(action, message):
    env = make_env()
    with pytest.raises(ValueError, match=message):
        env.step(env.reset().set("action", action))


@pytest.mark.parametrize("height", [0, -1, 6, 4.5, 4.0, float("nan")])
def test_bad_tote_heights_are_refused(height):
    heights = torch.tensor([[5], [height], [5], [5]]) if isinstance(height, int) else torch.full((4, 1), height)
    with pytest.raises(ValueError, match=rf"tote_height={re.escape(str(height))}.*: expected"):
        make_env().reset(TensorDict({"tote_height": heights}, [4]))


def test_reset_takes_no_seed():
    for td in (None, rows([True, False, True, False])):
        with pytest.raises(TypeError, match=r"reset\(seed=2\): expected a TensorDict only; set_seed"):
            make_env().reset(td, seed=2)
    with pytest.raises(ValueError, match="seed=1.5: expected a whole number"):
        make_env().set_seed(1.5)


# ---------------------------------------------------------------------- the rules
def narrow_env(length, height):
    """Return one bin that an item ``(2, 1, 1)`` fills, and a tote one cell deep: a place cell is a shift."""
    sizes = {"bin_size": (2, 1, 1), "tote_size": (length, 1, height), "effector_size": (2, 1)}
    return make_env([(2, 1, 1)], rotations=1, num_envs=1, **sizes)


def test_a_full_tote_is_stuck_and_keeps_the_reward_of_the_last_step():
    env = narrow_env(2, 1)
    td = env.step(env.reset().set("action", torch.tensor([0])))["next"]
    found = [td[key].item() for key in ("reward", "occupancy", "terminated", "done", "truncated", "failure")]
    assert found == [2, 1, True, True, False, STUCK] and not td["action_mask"].any()


def test_a_failure_leaves_tote_bin_and_mask_as_they_were():
    env = narrow_env(4, 1)
    first = step_mdp(env.step(env.reset().set("action", torch.tensor([0]))))
    td = env.step(first.set("action", torch.tensor([0])))["next"]
    assert [td[key].item() for key in ("failure", "reward", "terminated", "occupancy")] == [OVERFLOW, 0, True, 0.5]
    assert same(td.select(*OBSERVATION), first.select(*OBSERVATION))


SIDES = st.integers(1, 3)


@settings(max_examples=20, suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow])
@given(
    kinds=st.lists(st.tuples(SIDES, SIDES, SIDES), min_size=1, max_size=4, unique=True),
    walls=st.integers(1, 2),
    tote_size=st.tuples(*[st.integers(3, 6)] * 3),
    effector_size=st.tuples(SIDES, SIDES),
    rotations=st.integers(1, 4),
    pick_rule=st.sampled_from(["contain", "overlap"]),
    min_support=st.sampled_from([0.0, 0.5, 1.0]),
    seed=st.integers(0, 2**31 - 1),
)
def test_placing_only_raises_cells_up_to_the_rim_and_rewards_are_volumes(kinds, walls, **sizes):
    try:
        env = make_env(kinds, bin_size=(4, 5, walls), **sizes)
    except ValueError:
        assume(False)
    torch.manual_seed(sizes["seed"])
    before = env.reset()
    rim, volume = before["tote_height"][..., None], torch.zeros(4, 1)
    for _ in range(40):
        item_volume = before["bin_depth"].sum((1, 2))[:, None]
        action = torch.multinomial(before["action_mask"].float(), 1).squeeze(-1)
        td = env.step(before.set("action", action))["next"]
        assert ((td["tote_depth"] >= 0) & (td["tote_depth"] <= before["tote_depth"]) & (td["tote_depth"] <= rim)).all()
        assert (before["tote_depth"] - td["tote_depth"]).sum((1, 2))[:, None].ge(item_volume).all()
        assert td["reward"].equal(item_volume)
        volume += td["reward"]
        assert torch.allclose(td["occupancy"], volume / (env.cell.num_places * td["tote_height"]))
        assert torch.isin(td["failure"], torch.tensor([SUCCESS, STUCK])).all()
        assert (td["failure"] == STUCK).equal(td["done"])
        if td["done"].any():
            break
        before = td


@pytest.mark.parametrize("kept", [0, 5000, 2**26])
@pytest.mark.parametrize("masks", [("action",), ("footprint", "action"), ()])
def test_masks_of_empty_totes_are_kept_and_are_the_same(kept, masks, monkeypatch):
    monkeypatch.setattr("pickplace.envs.torchrl.CACHE_BYTES", kept)
    env = make_env([(1, 1, 1), (2, 1, 2), (1, 3, 1)], tote_size=(4, 4, 4), num_envs=12, masks=masks)
    cell, generator = env.cell, torch.Generator().manual_seed(0)
    size = cell.num_actions * ("action" in masks) + cell.num_footprints * ("action" not in masks or len(masks) == 2)
    for _ in range(12):
        chosen = torch.rand(12, generator=generator) < 0.5
        td = env.reset(rows(chosen, tote_height=torch.randint(2, 5, (12, 1), generator=generator)))
        maps = placing_maps(cell, env.state)
        expected = {"action": action_mask(cell, maps), "footprint": footprint_mask(cell, maps).flatten(1)}
        assert torch.equal(env.feasible, expected["footprint"].any(1))
        assert all(torch.equal(td[f"{name}_mask"], expected[name]) for name in masks)
        assert len(env._starts) * size <= kept + 12 * size
