"""The Gymnasium face: other projects' checkers, and the batched environment behind it."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

import pickplace
from pickplace import PickPlaceEnv
from pickplace.envs.gymnasium import KEYS
from pickplace.task.items import Recorded

ID = "pickplace/PickPlace-v0"
SMALL = {"tote_size": (4, 5, 2), "items": [(1, 1, 1), (2, 1, 1), (2, 2, 1)]}


def make(**kwargs):
    return gymnasium.make(ID, **{**SMALL, **kwargs})


def feasible(masks, generator):
    """A feasible action of each row, drawn evenly."""
    return np.array([generator.choice(np.flatnonzero(mask)) if mask.any() else 0 for mask in masks])


def assert_equal(a, b):
    assert a.keys() == b.keys()
    for key in a:
        assert a[key].dtype == b[key].dtype and np.array_equal(a[key], b[key]), key


@pytest.mark.parametrize("kwargs", [{}, {"bin_size": (4, 6, 2), "effector_size": (2, 3), "rotations": 3}])
def test_gymnasium_checker(kwargs, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*no display.*")
        check_env(make(**kwargs).unwrapped)
        check_env(make(render_mode="rgb_array", **kwargs).unwrapped)


def test_stable_baselines_checker():
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs stable-baselines3")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*unconventional shape.*")  # depth maps are neither vectors nor RGB images
        checker.check_env(make().unwrapped)


@settings(max_examples=10)
@given(st.integers(0, 2**31), st.integers(1, 3), st.sampled_from([1, 2]))
def test_single_against_the_batched_environment(seed, slots, height):
    """Episode ``e`` of a seed is slot ``e`` of the environment underneath, in all that an agent gets."""
    below = PickPlaceEnv(
        tote_size=(4, 5, 2), items=pickplace.envs.gymnasium.Kinds(SMALL["items"]), num_envs=slots, seed=seed
    )
    states = below.reset(TensorDict({"tote_height": torch.full((slots, 1), height)}, [slots]))
    env, generator = make(), np.random.default_rng(seed)
    histories = []
    for slot in range(slots):
        observation, info = env.reset(seed=seed if slot == 0 else None, options={"tote_height": height})
        history = [(observation, info, None)]
        for _ in range(4):
            masks = env.get_wrapper_attr("action_masks")()
            assert np.array_equal(masks, info["action_mask"])
            action = feasible([masks], generator)[0]
            observation, *rest, info = env.step(action)
            history.append((observation, info, (action, *rest)))
            if rest[1]:
                break
        histories.append(history)
    for step in range(5):
        actions = torch.zeros(slots, dtype=torch.int64)
        for slot, history in enumerate(histories):
            if step < len(history):
                observation, info, taken = history[step]
                for key in KEYS:
                    assert np.array_equal(observation[key], states[key][slot].numpy())
                assert np.array_equal(info["action_mask"], states["action_mask"][slot].numpy())
                assert info["occupancy"] == pytest.approx(float(states["occupancy"][slot]))
                if taken:
                    assert taken[1:] == (states["reward"][slot].item(), states["terminated"][slot].item(), False)
            if step + 1 < len(history):
                actions[slot] = int(history[step + 1][2][0])
        states = below.step(TensorDict({"action": actions}, [slots]))["next"]


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vector_environment_against_gymnasiums_own(mode):
    """Slot ``i`` plays what a single environment plays as episodes ``i``, ``i + N``, ...; resets as SyncVectorEnv's."""
    count, seed = 3, 5

    def slot(number):
        def build():
            return make(first_episode=number, episode_stride=count)

        return build

    theirs = SyncVectorEnv([slot(i) for i in range(count)], autoreset_mode=mode)
    ours = gymnasium.make_vec(ID, num_envs=count, autoreset_mode=mode, **SMALL)
    assert ours.metadata["autoreset_mode"] == mode
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    expected, their_info = theirs.reset(seed=[seed] * count)
    observation, info = ours.reset(seed=seed)
    assert_equal(observation, expected)
    generator, endings = np.random.default_rng(0), 0
    for step in range(60):
        assert np.array_equal(ours.unwrapped.action_masks(), info["action_mask"])
        actions = feasible(info["action_mask"], generator)
        if step % 7 == 6:
            actions[0] = 0  # most likely fails
        expected, *their_rest, their_info = theirs.step(actions)
        observation, *rest, info = ours.step(actions)
        assert_equal(observation, expected)
        for mine, other in zip(rest, their_rest, strict=True):
            assert mine.dtype == other.dtype and np.array_equal(mine, other)
        assert info.keys() == their_info.keys()
        for key in ("occupancy", "failure", "action_mask", "_occupancy"):
            assert np.array_equal(info[key], their_info[key]), key
        ended = rest[1] | rest[2]
        endings += ended.sum()
        if mode == AutoresetMode.SAME_STEP and ended.any():
            assert np.array_equal(info["_final_obs"], their_info["_final_obs"])
            for i in np.flatnonzero(ended):
                assert_equal(info["final_obs"][i], their_info["final_obs"][i])
            for key in ("occupancy", "failure", "action_mask", "_failure"):
                assert np.array_equal(info["final_info"][key], their_info["final_info"][key]), key
        if mode == AutoresetMode.DISABLED and ended.any():
            with pytest.raises(gymnasium.error.ResetNeeded):
                ours.step(actions)
            expected, _ = theirs.reset(options={"reset_mask": ended})
            observation, fresh = ours.reset(options={"reset_mask": ended})
            assert_equal(observation, expected)
            assert np.array_equal(fresh["_failure"], ended)
            info["action_mask"] = ours.unwrapped.action_masks()
    assert endings > 5


def test_seeds_and_tote_heights():
    env = make()
    first, _ = env.reset(seed=3)
    second, _ = env.reset()
    again, _ = env.reset(seed=3)
    assert_equal(first, again)
    runs = [
        np.stack([env.reset(seed=seed)[0]["bin_depth"]] + [env.reset()[0]["bin_depth"] for _ in range(9)])
        for seed in (3, 4)
    ]
    assert not np.array_equal(*runs)
    low, _ = env.reset(options={"tote_height": 1})
    assert low["tote_height"] == [1] and (low["tote_depth"] == 1).all()
    assert env.reset()[0]["tote_height"] == [2]
    unseeded = {tuple(make().reset()[0]["bin_depth"].flatten()) for _ in range(12)}
    assert len(unseeded) > 1  # without a seed, a fresh environment is not always the same

    vector = gymnasium.make_vec(ID, num_envs=2, **SMALL)
    heights, _ = vector.reset(seed=0, options={"tote_height": np.array([1, 2])})
    assert heights["tote_height"].tolist() == [[1], [2]]


def test_observations_are_copies():
    env = make()
    observation, info = env.reset(seed=0)
    kept = {key: value.copy() for key, value in observation.items()}
    mask = info["action_mask"].copy()
    env.step(int(np.flatnonzero(mask)[0]))
    assert_equal(observation, kept)
    assert np.array_equal(info["action_mask"], mask)
    observation["tote_depth"][:] = 99
    assert env.reset(seed=0)[0]["tote_depth"].max() == 2


def test_a_recorded_stream_truncates(tmp_path):
    (tmp_path / "items.csv").write_text("w,d,h\n1,1,1\n2,1,1\n")
    env = make(items=pickplace.task.items.Recorded(tmp_path / "items.csv"), render_mode="rgb_array")
    _, info = env.reset(seed=0)
    for expected in (False, True):
        _, _, terminated, truncated, info = env.step(int(np.flatnonzero(info["action_mask"])[0]))
        assert (terminated, truncated) == (False, expected)
    assert env.render().shape == (600, 1200, 3)


def test_async_vectorisation():
    env = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="async", **SMALL)
    observation, info = env.reset(seed=1)
    actions = feasible(info["action_mask"], np.random.default_rng(0))
    _, reward, *_ = env.step(actions)
    assert observation["bin_depth"].shape == (2, 5, 5) and (reward > 0).all()
    env.close()


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: make(render_mode="ascii"), "render_mode"),
        (lambda: make(masks=()), "masks"),
        (lambda: make(tote_sizes=(1, 1, 1)), "tote_sizes"),
        (lambda: make(rotations=7), "rotations=7"),
        (lambda: make(items=[(9, 9, 9)]), "item 9x9x9"),
        (lambda: make().reset(options={"tote_height": 3}), r"options\['tote_height'\]=3: expected a whole number"),
        (lambda: make().reset(options={"tote_height": 1.5}), r"options\['tote_height'\]=1.5"),
        (lambda: make().reset(options={"height": 1}), r"options\['height'\]: there is no such option"),
        (lambda: make().unwrapped.step(0), "before reset"),
        (lambda: make().unwrapped.render() or make(render_mode="rgb_array").unwrapped.render(), "before reset"),
        (lambda: step_after_reset(make().unwrapped, 10**9), "action=1000000000: expected"),
        (lambda: step_after_reset(make().unwrapped, 0.5), "action=0.5"),
        (lambda: vector(autoreset_mode="Never"), "autoreset_mode='Never'"),
        (lambda: vector(render_mode="human"), "render_mode='human'"),
        (lambda: vector().reset(seed=[1, 2]), r"seed=\[1, 2\]"),
        (lambda: vector().reset(options={"reset_mask": [True]}), "reset_mask"),
        (
            lambda: vector().reset(options={"reset_mask": np.array([True, False])}),
            "reset_mask.* in the first reset: expected none",
        ),
        (lambda: vector().reset(options={"tote_height": [1, 2, 2]}), r"\[1, 2, 2\]"),
        (lambda: vector().step(np.zeros(2, dtype=np.int64)), "before reset"),
        (lambda: step_after_reset(vector(), np.array([0, -1])), "actions="),
        (lambda: step_after_reset(vector(), np.array([0])), "actions="),
        (lambda: step_after_reset(vector(), np.array([0.0, 1.7])), "actions="),
        (lambda: make(seed=5), r"seed=5: expected no such argument; reset\(seed=...\)"),
        (lambda: vector(seed=5), "seed=5: expected no such argument"),
        (lambda: make().reset(seed=2**63), "seed=.*expected a whole number"),
        (lambda: vector().reset(seed=2**63), "seed=.*expected a whole number"),
    ],
)
def test_bad_input_is_refused_in_a_sentence(act, message):
    with pytest.raises((ValueError, TypeError, gymnasium.error.Error), match=message) as caught:
        act()
    assert str(caught.value).count("\n") == 0


def vector(**kwargs):
    return gymnasium.make_vec(ID, num_envs=2, **{**SMALL, **kwargs}).unwrapped


def step_after_reset(env, action):
    env.reset(seed=0)
    env.step(action)


def test_maskable_ppo_runs():
    contrib = pytest.importorskip("sb3_contrib", reason="needs sb3-contrib")
    model = contrib.MaskablePPO("MultiInputPolicy", make(), n_steps=64, batch_size=32, seed=0)
    model.learn(128)
    assert model.num_timesteps == 128


def test_a_step_that_resets_says_nothing_of_what_its_action_would_have_done(tmp_path):
    """After a failure the environment underneath plays action 0, which may place a recorded stream's last item."""
    (tmp_path / "items.csv").write_text("w,d,h,x,y\n1,1,1,0,0\n1,1,1,0,0\n")
    items = Recorded(tmp_path / "items.csv")
    env = gymnasium.make_vec(ID, num_envs=2, **{**SMALL, "tote_size": (4, 5, 1), "items": items})
    _, info = env.reset(seed=0)
    _, _, *flags, info = env.step(np.array([np.flatnonzero(mask)[-1] for mask in info["action_mask"]]))
    assert info["action_mask"][:, 0].all() and not np.any(flags)
    _, _, terminated, truncated, _ = env.step(np.array([np.flatnonzero(~mask)[0] for mask in info["action_mask"]]))
    assert terminated.all() and not truncated.any()
    observation, reward, *flags, info = env.step(np.zeros(2, dtype=np.int64))
    assert not np.any(flags) and not reward.any() and (observation["tote_depth"] == 1).all()
    assert info["failure"].tolist() == ["none"] * 2
