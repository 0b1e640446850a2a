"""The environment as TorchRL wants it: specs, resets, item streams, masks, and what it refuses."""

import copy
import re

import pytest
import torch
from oracle import OVERFLOW, STUCK
from problems import late_state, random_limits
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs, step_mdp

from pickplace import CellSpec, PickPlaceEnv
from pickplace.items.distributions import PAPER_KINDS, Kinds
from pickplace.rules.masks import action_mask, footprint_mask, placing_maps
from pickplace.rules.support.rules import Hull

OBSERVATION = ("bin_depth", "tote_depth", "tote_height", "action_mask")


def make_env(kinds=PAPER_KINDS, **kwargs):
    """Return a small environment: the paper's, but for what is given."""
    return PickPlaceEnv(**{"items": Kinds(kinds), "num_envs": 4} | kwargs)


def rows(chosen, **entries):
    """Return a request to reset some rows, ``[N]``."""
    return TensorDict({"_reset": torch.as_tensor(chosen)[:, None], **entries}, [len(chosen)])


def actions(td, ending=False):
    """Return the first feasible action of each row, but for the rows to end: there the first infeasible one."""
    first, bad = td["action_mask"].int().argmax(-1), (~td["action_mask"]).int().argmax(-1)
    return torch.where(torch.as_tensor(ending), bad, first)


def same(left, right):
    """Return whether two TensorDicts hold the same keys and equal values."""
    return set(left.keys(True, True)) == set(right.keys(True, True)) and bool((left == right).all())


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"num_envs": 1, "rotations": 3, "masks": ()},
        {"pick_rule": "overlap", "support": Hull(0.1), "masks": ("footprint", "action")},
        {"kinds": [(2, 3, 2), (1, 1, 1)], "bin_size": (4, 6, 2), "tote_size": (5, 7, 6), "effector_size": (2, 4)},
        {"reach": random_limits(CellSpec(rotations=2), 1), "rotations": 2, "kinds": [(1, 1, 1)]},
        {"bin_items": 3, "masks": ("footprint", "action")},
        {"preview": 2, "handling": True},
        {"bin_items": 4, "refill": "batch", "kinds": [(2, 3, 2), (1, 1, 1)], "bin_size": (4, 6, 1)},
    ],
)
def test_specs_hold(kwargs):
    check_env_specs(make_env(**kwargs))


def test_shapes_and_dtypes():
    env = make_env([(1, 2, 1)], bin_size=(3, 4, 1), tote_size=(5, 6, 7), effector_size=(1, 2), rotations=2, num_envs=3)
    td, one = env.rand_step(env.reset()), (3, 1)
    maps = {"bin_depth": (3, 3, 4), "tote_depth": (3, 5, 6), "tote_height": one, "action_mask": (3, 3 * 4 * 5 * 6 * 2)}
    flags = {("next", key): one for key in ("terminated", "truncated", "done", "reward", "failure", "occupancy")}
    expected = {"action": (3,), **maps, **{("next", key): shape for key, shape in maps.items()}, **flags}
    assert {key: tuple(td[key].shape) for key in expected} == expected
    types = [td["next"][key].dtype for key in ("tote_depth", "tote_height", "action_mask", "reward", "failure")]
    assert types == [torch.float32, torch.int64, torch.bool, torch.float32, torch.int64]
    assert env.rollout(12, break_when_any_done=False).batch_size == torch.Size([3, 12])


@pytest.mark.parametrize("chosen", [[True, False, True, False], [False, False, False, True], [False] * 4])
@pytest.mark.parametrize("only_reset", [True, False])
def test_partial_reset_touches_only_the_requested_rows(chosen, only_reset):
    chosen = torch.tensor(chosen)
    (env, td), (other, other_td) = (late_state(4, num_envs=4, seed=0) for _ in range(2))
    before = td.select(*OBSERVATION).clone()
    reset = env.reset(rows(chosen) if only_reset else td.update(rows(chosen)))
    assert (reset["tote_depth"][chosen] == 5).all() and reset["action_mask"][chosen].any(-1).all()
    assert same(reset.select(*OBSERVATION)[~chosen], before[~chosen])
    # The running episodes go on as they do in the other environment, which was not reset.
    action = torch.where(chosen, actions(reset), actions(before))
    left, right = env.step(reset.set("action", action)), other.step(other_td.set("action", action))
    assert same(left["next"][~chosen], right["next"][~chosen]) and left["next", "reward"].gt(0).all()


def test_partial_reset_keeps_why_the_others_ended():
    env = make_env()
    td = env.reset()
    after = env.step(td.set("action", actions(td, ending=True)))["next"]
    assert after["terminated"].all() and same(after.select(*OBSERVATION), td.select(*OBSERVATION))
    chosen = torch.tensor([True, False, True, False])
    reset = env.reset(after.clone().update(rows(chosen)))
    for key in ("done", "terminated", "truncated", "failure"):
        assert torch.equal(reset[key][~chosen], after[key][~chosen]) and not reset[key][chosen].any(), key


def test_tote_height_is_honoured_per_env_and_kept_by_running_episodes():
    env, heights = make_env(), torch.tensor([[1], [3], [5], [2]])
    td = env.reset(TensorDict({"tote_height": heights}, [4]))
    assert td["tote_height"].equal(heights) and (td["tote_depth"] == heights[..., None]).all()
    done = torch.tensor([True, False, False, True])
    td = step_mdp(env.step(td.set("action", actions(td, done))))
    assert td["tote_height"].equal(heights)
    td = env.reset(td.update(rows(done)).set("tote_height", torch.tensor([[4], [1], [1], [4]])))
    assert td["tote_height"].tolist() == [[4], [3], [5], [4]]
    after = env.step(td.set("action", actions(td)))["next"]
    assert after["tote_height"].equal(td["tote_height"])
    assert after["occupancy"][done].equal(after["reward"][done] / (6 * 6 * 4))
    assert (env.reset()["tote_height"] == 5).all()


def test_nothing_that_was_handed_out_changes():
    """Neither by a step, whose input it is or was, nor by loading a state."""
    env = make_env(masks=("action", "footprint"))
    td = env.reset()
    first, state, kept = td.clone(), copy.deepcopy(env.state_dict()), []
    for step in range(6):
        td.set("action", actions(td, torch.tensor([False, step == 2, False, step == 4])))
        before = td.clone()
        after = env.step(td)
        assert same(td.exclude("next"), before) and after["next"] is not td
        kept.append((after["next"], after["next"].clone()))
        td = step_mdp(after)
    env.load_state_dict(state)
    assert all(same(*pair) for pair in kept)
    assert same(TensorDict(env._observation(), [4]), first.exclude("done", "terminated", "truncated"))


@pytest.mark.parametrize(
    ("settings", "first", "stride"),
    [({"stream": "train", "seed": 7}, 0, 4), ({"stream": "test", "first_episode": 5, "episode_stride": 9}, 5, 9)],
)
def test_an_item_depends_on_its_address_alone(settings, first, stride):
    """Slot ``i`` plays episodes ``first + i``, ``first + i + stride``, ...; ``set_seed`` begins a stream again."""
    env, address = make_env(tote_size=(4, 4, 2), **settings), settings["stream"]
    for seed in (settings.get("seed", 0), 3):
        env.set_seed(seed)
        td, episode, step = env.reset(), first + torch.arange(4), torch.zeros(4, dtype=torch.int64)
        for _ in range(20):
            item = env.items.sample(address, torch.tensor(seed), episode, step, env.cell.bin_size)
            assert torch.equal(env.item, item.table[:, None])
            td, following = env.step_and_maybe_reset(td.set("action", actions(td)))
            done = td["next", "done"][:, 0]
            episode, step = episode + stride * done, torch.where(done, 0, step + 1)
            td = following
        assert (episode >= first + stride).all()


def test_a_reset_state_always_has_a_feasible_action():
    env = make_env([(1, 1, 1), (2, 1, 2), (2, 2, 3)], bin_size=(4, 4, 2), tote_size=(4, 5, 6), num_envs=256)
    for height in range(3, 7):
        td = env.reset(TensorDict({"tote_height": torch.full((256, 1), height)}, [256]))
        assert td["action_mask"].any(-1).all()
    # A tote smaller than the effector serves items that are level with its rim.
    assert make_env([(1, 1, 3)], tote_size=(2, 2, 3)).reset()["action_mask"].any(-1).all()


NO_TOP = random_limits(CellSpec(), 0)
NO_TOP.highest_top.fill_(0)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"rotations": 5}, "rotations=5: expected 1, 2, 3 or 4"),
        ({"size": 3}, "size=3: expected one of bin_size"),
        ({"kinds": [(6, 1, 1)]}, "item 6x1x1 does not fit bin_size: expected at most 5x5"),
        ({"kinds": [(4, 1, 1)]}, "item 4x1x1 does not fit gripper.size: expected at most 3x3"),
        ({"kinds": [(1, 1, 6)]}, r"item 1x1x6 is higher than the tote: expected at most tote_size\[2\]=5"),
        ({"support": Hull(0.5)}, r"item 1x1x1 .* has no feasible action"),
        ({"reach": NO_TOP}, "item 1x1x1 .* has no feasible action"),
        # Deep bin walls: the effector cannot reach an item in the corner of a bin smaller than itself.
        ({"kinds": [(1, 1, 1)], "bin_size": (2, 2, 2)}, "1x1x1 at x=0, y=0 in the bin has no feasible action"),
        # A tote smaller than the effector: only an item level with its rim can be placed.
        ({"kinds": [(1, 1, 1)], "tote_size": (2, 2, 3)}, "1x1x1 .* empty tote of height 3 .bin 5x5x1, tote 2x2x3"),
        ({"items": "paper"}, "items='paper': expected a list of .w, d, h., or an ItemDistribution"),
        *(({"num_envs": value}, f"num_envs={value}: expected a whole number >= 1") for value in (0, 1.5, True)),
        ({"seed": -1}, "seed=-1: expected a whole number >= 0"),
        ({"stream": "dev"}, "stream='dev': expected 'train' or 'validation' or 'test'"),
        ({"masks": ("all",)}, "masks=.'all',.: expected any of 'action', 'footprint'"),
    ],
)
def test_an_impossible_configuration_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_env(**kwargs)


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


@pytest.mark.parametrize(("length", "failure", "reward"), [(2, STUCK, 2), (4, OVERFLOW, 0)])
def test_how_an_episode_ends(length, failure, reward):
    """A full tote is stuck and keeps the reward of the last step; a failure leaves tote, bin and mask as they were."""
    sizes = {"bin_size": (2, 1, 1), "tote_size": (length, 1, 1), "effector_size": (2, 1)}
    env = make_env([(2, 1, 1)], rotations=1, num_envs=1, **sizes)
    td, action = env.reset(), torch.tensor([0])
    if failure == OVERFLOW:
        td = step_mdp(env.step(td.set("action", action)))
    after = env.step(td.set("action", action))["next"]
    found = [after[key].item() for key in ("reward", "occupancy", "terminated", "done", "truncated", "failure")]
    assert found == [reward, 2 / length, True, True, False, failure]
    assert same(after.select(*OBSERVATION), td.select(*OBSERVATION)) == (failure == OVERFLOW)
    assert after["action_mask"].any() == (failure == OVERFLOW)


@pytest.mark.parametrize("kept", [0, 5000, 2**26])
@pytest.mark.parametrize("masks", [("action",), ("footprint", "action"), ()])
def test_masks_of_empty_totes_are_kept_and_are_the_same(kept, masks, monkeypatch):
    monkeypatch.setattr("pickplace.envs.masks.CACHE_BYTES", kept)
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
        assert len(env._make_masks._starts) * size <= kept + 12 * size
