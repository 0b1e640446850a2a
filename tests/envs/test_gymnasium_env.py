"""The Gymnasium environments: other projects' checkers, and the batched environment underneath."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from commands import composed
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from omegaconf import OmegaConf
from tensordict import TensorDict

from pickplace import Failure, PickPlaceEnv
from pickplace.config.registry import build
from pickplace.items.distributions import Kinds, Recorded
from pickplace.rules.cell import CELL_SETTINGS
from pickplace.rules.reach.annulus import Annulus

ID = "pickplace/PickPlace-v0"
SMALL = {"tote_size": (4, 5, 2), "items": [(1, 1, 1), (2, 1, 1), (2, 2, 1)]}


def make(**kwargs):
    return gymnasium.make(ID, **{**SMALL, **kwargs})


def vector(**kwargs):
    return gymnasium.make_vec(ID, **{"num_envs": 2, **SMALL, **kwargs}).unwrapped


def feasible(masks, generator):
    """Return a feasible action of each row, drawn evenly."""
    return np.array([generator.choice(np.flatnonzero(mask)) if mask.any() else 0 for mask in masks])


def assert_equal(a, b, keys=None):
    if keys is None:
        assert a.keys() == b.keys()
    for key in keys or a:
        assert a[key].dtype == b[key].dtype and np.array_equal(a[key], b[key]), key


@pytest.mark.parametrize(
    "kwargs", [{}, {"bin_size": (4, 6, 2), "effector_size": (2, 3), "rotations": 3}, {"bin_items": 3, "preview": 2}]
)
def test_checkers_of_other_projects(kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(**kwargs).unwrapped, skip_render_check=True)
        checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs stable-baselines3")
        warnings.filterwarnings("ignore", ".*unconventional shape.*")  # depth maps are neither vectors nor RGB images
        checker.check_env(make(**kwargs).unwrapped)


def test_maskable_ppo_runs():
    contrib = pytest.importorskip("sb3_contrib", reason="needs sb3-contrib")
    model = contrib.MaskablePPO("MultiInputPolicy", make(), n_steps=32, batch_size=32, n_epochs=1, seed=0)
    assert model.learn(64).num_timesteps == 64


@pytest.mark.parametrize(("seed", "height"), [(0, 1), (3, 2), (2**31, 2)])
def test_a_single_environment_against_the_batched_one(seed, height):
    """It plays the episodes of a seed one after the other, and shows all that an agent gets."""
    below = PickPlaceEnv(tote_size=(4, 5, 2), items=SMALL["items"], num_envs=1, seed=seed)
    env, generator = make(), np.random.default_rng(seed)
    for episode in range(3):
        state = below.reset(TensorDict({"tote_height": torch.tensor([[height]])}, [1]))
        observation, info = env.reset(seed=seed if episode == 0 else None, options={"tote_height": height})
        ended = False
        while True:
            assert_equal(observation, {key: state[key][0].numpy() for key in below.terms})
            assert np.array_equal(info["action_mask"], state["action_mask"][0].numpy())
            assert np.array_equal(info["action_mask"], env.action_masks())
            assert info["occupancy"] == pytest.approx(float(state["occupancy"]))
            assert info["failure"] == Failure(int(state["failure"])).name.lower()
            if ended:
                break
            action = feasible([info["action_mask"]], generator)[0]
            state = below.step(TensorDict({"action": torch.tensor([action])}, [1]))["next"]
            observation, reward, ended, truncated, info = env.step(action)
            assert (reward, ended, truncated) == (state["reward"].item(), state["terminated"].item(), False)


def test_a_cup_and_a_reach_against_the_batched_environment_of_the_config():
    """And against distances computed here: centres of cells, as the end effector's sides are odd."""
    words = ["gripper=cup_round", "reach=annulus", "env.bin_size=[9,8,2]", "env.tote_size=[14,12,8]"]
    words += ["env.reach.radii=[8.5,15.5]", "env.reach.bin=[-16,-4,0]", "env.reach.tote=[4,-5,0]"]
    cfg, items = OmegaConf.to_container(composed(*words).env), Kinds([(5, 4, 2), (4, 4, 3), (6, 5, 2)])
    below = build("env", {**cfg, "num_envs": 1}, items=items, seed=6)
    settings = {key: cfg[key] for key in CELL_SETTINGS if key not in ("gripper", "reach")}
    reach = Annulus((8.5, 15.5), (0, 10), (-16, -4, 0), (4, -5, 0))
    settings |= {"effector_size": (7, 7), "body": "disc", "cup": "disc", "cup_size": (3, 3), "pick_rule": "seal"}
    env, free = (gymnasium.make(ID, items=items, **settings, reach=given) for given in (reach, None))
    generator, forbidden, steps = np.random.default_rng(0), 0, 0
    for episode in range(10):
        seed = 6 if episode == 0 else None
        state, (_, info), (_, unlimited) = below.reset(), env.reset(seed=seed), free.reset(seed=seed)
        ended = False
        while not ended:
            mask = info["action_mask"]
            assert np.array_equal(mask, state["action_mask"][0].numpy())
            x_b, y_b, x_t, y_t, _ = np.unravel_index(np.arange(mask.size), (9, 8, 14, 12, 4))
            picks, places = np.hypot(x_b - 15.5, y_b - 3.5), np.hypot(x_t + 4.5, y_t - 4.5)
            within = np.logical_and.reduce([(part >= 8.5) & (part <= 15.5) for part in (picks, places)])
            assert np.array_equal(mask, unlimited["action_mask"] & within)
            forbidden, steps = forbidden + (unlimited["action_mask"] & ~within).sum(), steps + 1
            action = feasible([mask], generator)[0]
            state = below.step(TensorDict({"action": torch.tensor([action])}, [1]))["next"]
            (_, _, ended, _, info), (*_, unlimited) = env.step(action), free.step(action)
    assert forbidden > 0 and steps > 20


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vector_environment_against_gymnasiums_own(mode):
    """Slot ``i`` plays what a single environment plays as episodes ``i``, ``i + N``, ...; resets as SyncVectorEnv's."""
    count, seed = 3, 5
    slots = [lambda slot=slot: make(first_episode=slot, episode_stride=count) for slot in range(count)]
    theirs, ours = SyncVectorEnv(slots, autoreset_mode=mode), vector(num_envs=count, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] == mode
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    expected, their_info = theirs.reset(seed=[seed] * count)
    observation, info = ours.reset(seed=seed)
    assert_equal(observation, expected)
    generator, endings = np.random.default_rng(0), 0
    for step in range(40):
        assert np.array_equal(ours.action_masks(), info["action_mask"])
        actions = feasible(info["action_mask"], generator)
        if step % 7 == 6:
            actions[0] = 0  # most likely fails
        expected, *their_rest, their_info = theirs.step(actions)
        observation, *rest, info = ours.step(actions)
        assert_equal(observation, expected)
        assert_equal(dict(enumerate(rest)), dict(enumerate(their_rest)))
        assert info.keys() == their_info.keys()
        ended = rest[1] | rest[2]
        endings += ended.sum()
        if mode == AutoresetMode.NEXT_STEP:  # the action is ignored, but a learner that masks needs one
            their_info["action_mask"][ended] = np.arange(ours.single_action_space.n) == 0
        for key in ("occupancy", "failure", "action_mask", "_occupancy"):
            assert np.array_equal(info[key], their_info[key]), key
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
            info["action_mask"] = ours.action_masks()
    assert endings > 5


def test_seeds_and_tote_heights():
    env = make()
    assert_equal(*(env.reset(seed=3)[0] for _ in range(2)))
    streams = [[env.reset(seed=seed)[0], *(env.reset()[0] for _ in range(9))] for seed in (3, 4)]
    assert not np.array_equal(*([observation["bin_depth"] for observation in stream] for stream in streams))
    low, _ = env.reset(options={"tote_height": 1})
    assert low["tote_height"] == [1] and (low["tote_depth"] == 1).all()
    assert env.reset()[0]["tote_height"] == [2]
    unseeded = {tuple(make().reset()[0]["bin_depth"].flatten()) for _ in range(12)}
    assert len(unseeded) > 1  # without a seed, a fresh environment is not always the same
    heights, _ = vector().reset(seed=0, options={"tote_height": np.array([1, 2])})
    assert heights["tote_height"].tolist() == [[1], [2]]


def test_observations_are_copies():
    env = make()
    observation, info = env.reset(seed=0)
    kept, mask = {key: value.copy() for key, value in observation.items()}, info["action_mask"].copy()
    env.step(int(np.flatnonzero(mask)[0]))
    assert_equal(observation, kept)
    assert np.array_equal(info["action_mask"], mask)
    observation["tote_depth"][:] = 99
    assert env.reset(seed=0)[0]["tote_depth"].max() == 2


def test_a_recorded_stream_truncates(tmp_path):
    (tmp_path / "items.csv").write_text("w,d,h\n1,1,1\n2,1,1\n")
    env = make(items=Recorded(tmp_path / "items.csv"))
    _, info = env.reset(seed=0)
    for expected in (False, True):
        *_, terminated, truncated, info = env.step(int(np.flatnonzero(info["action_mask"])[0]))
        assert (terminated, truncated) == (False, expected)


def test_a_step_that_resets_hides_what_its_action_would_have_done(tmp_path):
    """After a failure the environment underneath plays action 0, which may place a recorded stream's last item."""
    (tmp_path / "items.csv").write_text("w,d,h,x,y\n1,1,1,0,0\n1,1,1,0,0\n")
    env = vector(tote_size=(4, 5, 1), items=Recorded(tmp_path / "items.csv"))
    _, info = env.reset(seed=0)
    _, _, *flags, info = env.step(np.array([np.flatnonzero(mask)[-1] for mask in info["action_mask"]]))
    assert info["action_mask"][:, 0].all() and not np.any(flags)
    _, _, terminated, truncated, _ = env.step(np.array([np.flatnonzero(~mask)[0] for mask in info["action_mask"]]))
    assert terminated.all() and not truncated.any()
    observation, reward, *flags, info = env.step(np.zeros(2, dtype=np.int64))
    assert not np.any(flags) and not reward.any() and (observation["tote_depth"] == 1).all()
    assert info["failure"].tolist() == ["none"] * 2


def test_async_vectorisation():
    # Not the default "fork" or "spawn": a process that has imported torch already.
    env = gymnasium.make_vec(
        ID, num_envs=1, vectorization_mode="async", vector_kwargs={"context": "forkserver"}, **SMALL
    )
    _, info = env.reset(seed=1)
    observation, reward, *_ = env.step(feasible(info["action_mask"], np.random.default_rng(0)))
    assert observation["bin_depth"].shape == (1, 5, 5) and reward > 0
    env.close()


def step(env, action):
    env.reset(seed=0)
    env.step(action)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: make(masks=()), "masks=.*expected no such argument"),
        (lambda: make(seed=5), r"seed=5: expected no such argument; reset\(seed=...\)"),
        (lambda: vector(seed=5), "seed=5: expected no such argument"),
        (lambda: make(tote_sizes=(1, 1, 1)), "tote_sizes"),
        (lambda: make(rotations=7), "rotations=7"),
        (lambda: make(items=[(9, 9, 9)]), "item 9x9x9"),
        (lambda: make().reset(seed=2**63), "seed=.*expected a whole number"),
        (lambda: vector().reset(seed=2**63), "seed=.*expected a whole number"),
        (lambda: vector().reset(seed=[1, 2]), r"seed=\[1, 2\]"),
        (lambda: make().reset(options={"tote_height": 3}), r"options\['tote_height'\]=3: expected a whole number"),
        (lambda: make().reset(options={"tote_height": 1.5}), r"options\['tote_height'\]=1.5"),
        (lambda: vector().reset(options={"tote_height": [1, 2, 2]}), r"\[1, 2, 2\]"),
        (lambda: make().reset(options={"height": 1}), r"options\['height'\]: there is no such option"),
        (lambda: make().reset(options={"reset_mask": [True]}), "expected no reset_mask"),
        (lambda: vector().reset(options={"reset_mask": [True]}), "reset_mask"),
        (
            lambda: vector().reset(options={"reset_mask": np.array([True, False])}),
            "reset_mask.*: expected none in the first reset",
        ),
        (lambda: make().unwrapped.step(0), "before reset"),
        (lambda: vector().step(np.zeros(2, dtype=np.int64)), "before reset"),
        (lambda: step(make().unwrapped, 10**9), "action=1000000000: expected"),
        (lambda: step(make().unwrapped, 0.5), "action=0.5"),
        *(
            (lambda actions=actions: step(vector(), np.array(actions)), "actions=.*expected 2 whole numbers")
            for actions in ([0, -1], [0], [0.0, 1.7])
        ),
        (lambda: vector(autoreset_mode="Never"), "autoreset_mode='Never'"),
        (lambda: vector(render_mode="human"), "render_mode='human'"),
    ],
)
def test_bad_input_is_refused_in_a_sentence(act, message):
    with pytest.raises((ValueError, TypeError, gymnasium.error.Error), match=message) as caught:
        act()
    assert str(caught.value).count("\n") == 0


def test_options_set_what_the_environment_lets_vary():
    varies = ("rotations", "bin_items")
    env = gymnasium.make("pickplace/PickPlace-v0", varies=varies, bin_items=2, bin_size=(6, 6, 1))
    observation, info = env.reset(seed=1, options={"rotations": [0, 3], "bin_items": 1})
    assert env.observation_space.contains(observation)
    assert observation["rotations"].tolist() == [True, False, False, True]
    assert observation["bin_items"].tolist() == [1] and not observation["items"][1].any()
    assert set(np.flatnonzero(info["action_mask"]) % 4) == {0, 3}
    many = gymnasium.make_vec("pickplace/PickPlace-v0", num_envs=2, varies=("rotations",))
    observation, _ = many.reset(seed=1, options={"rotations": [1, [0, 3]], "tote_height": [2, 5]})
    assert observation["rotations"].astype(int).tolist() == [[1, 0, 0, 0], [1, 0, 0, 1]]
    for options, words in (
        ({"rotations": 5}, r"options\['rotations'\]=5: expected how many quarter turns, 1 to 4"),
        ({"refill": "batch"}, r"options\['refill'\]: there is no such option; expected tote_height, rotations or"),
    ):
        with pytest.raises(ValueError, match=words):
            many.reset(options=options)
    numbers, _ = many.reset(seed=1, options={"tote_height": np.array([2, 5]), "rotations": [1, 2]})
    assert numbers["rotations"].astype(int).tolist() == [[0, 1, 1, 0]] * 2  # a plain list is one value
    with pytest.raises(ValueError, match="varies=.*: expected any of rotations, bin_items"):
        gymnasium.make("pickplace/PickPlace-v0", varies=("gripper",))
