"""Recorded work: it does what the plain work does, with fixed shapes, and never looks at a result on the way."""

import shutil
from functools import partial

import commands
import pytest
import torch
from commands import TINY, after_batch, assert_same, composed
from emulated_graphs import Graph, emulate
from problems import SETTINGS
from tensordict import TensorDict
from test_presets import ONE_NETWORK

from pickplace import PickPlaceEnv
from pickplace.common.capture import capturing
from pickplace.common.graphs import CaptureChecker, CapturedWork, CompileSettings
from pickplace.config.registry import build
from pickplace.planners.heuristics import RandomFeasible
from pickplace.policies.afterstate.cells import CellsValue
from pickplace.rules.reach.annulus import Annulus
from pickplace.runs.loggers import read_csv
from pickplace.training.train import resume_run, train
from pickplace.training.trainer import Trainer, training_env

MASKS = ("action", "footprint", "corner")


def recorded(work, *arguments):
    """Return the result of recorded work, and the places where it looks at results."""
    with capturing(), CaptureChecker() as found:
        return work(*arguments), found.places


def assert_equal(found: TensorDict, expected: TensorDict):
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        assert torch.equal(found[key], value), key


#: An arm that does not reach every place.
REACH = Annulus([4.6, 9.7], [0, 10], [-9, -2.5, 0], [4, -3, 0])


#: Those of the settings that have the most in them; the others run with the slow tests.
OFTEN_RECORDED = (3, 6, 7, 10, 11)


@pytest.mark.parametrize(
    "settings",
    [
        *(
            pytest.param(each, marks=[pytest.mark.slow] * (number not in OFTEN_RECORDED))
            for number, each in enumerate(SETTINGS)
        ),
        {"num_envs": 4, "handling": True, "bin_items": 2, "preview": 1},
        {"num_envs": 4, "reach": REACH, "tote_size": (6, 6, 4)},
    ],
)
def test_a_recorded_environment_does_the_same(settings):
    """Through full and partial resets, successes and failures; an observation stays as it was handed out."""
    plain, other = (PickPlaceEnv(**settings, masks=MASKS, seed=3) for _ in range(2))
    planner, generator, count = RandomFeasible(plain.cell), torch.Generator().manual_seed(0), plain.num_envs
    everything = TensorDict({"_reset": torch.ones(count, 1, dtype=torch.bool)}, [count])
    state = plain._reset(everything)
    assert_equal(recorded(other._reset, everything)[0], state)
    for step in range(25):
        action = planner.decide(state)
        if step % 5 == 4:
            action = torch.randint(plain.cell.num_actions, action.shape, generator=generator)
        act = TensorDict({"action": action}, [count])
        after = plain._step(act)
        found, places = recorded(other._step, act)
        assert_equal(found, after)
        again = TensorDict({"_reset": after["done"]}, [count])
        state = plain._reset(again)
        start, more = recorded(other._reset, again)
        assert_equal(start, state)
        assert_equal(found, after)
        # In the first calls constants are made.
        assert step == 0 or places + more == []


def test_an_action_out_of_range_stops_a_recorded_environment():
    env = PickPlaceEnv(num_envs=1)
    env.reset()
    with capturing(), pytest.raises(RuntimeError):
        env._step(TensorDict({"action": torch.tensor([env.cell.num_actions])}, [1]))


@pytest.mark.parametrize(
    ("work", "place"),
    [
        (lambda x: x["a"] * x["a"].sum().item(), "_local_scalar_dense"),
        (lambda x: x["a"].nonzero(), "nonzero"),
        (lambda x: x["a"][x["a"] > 0], "index.Tensor"),
        (lambda x: x["a"] + torch.tensor(1.0), "lift_fresh"),
        (lambda x: x["a"].multinomial(1), "multinomial"),
        (lambda x: x["a"] if torch.equal(x["a"], x["a"]) else -x["a"], "equal"),
    ],
)
def test_work_that_looks_at_results_is_refused(work, place):
    """With the line where it does."""
    step = CapturedWork(lambda x: {"b": work(x)}, "the gradient step")
    step({"a": torch.ones(3)})
    with pytest.raises(ValueError, match=rf"the gradient step .*\({place} in test_compile.py:\d+\); expected compile"):
        step({"a": torch.ones(3)})


def test_work_of_another_shape_is_not_recorded():
    step = CapturedWork(lambda x: {"b": 2 * x["a"]}, "")
    for count in (3, 2, 3):
        assert step({"a": torch.ones(count)})["b"].tolist() == [2] * count
    assert step.calls == 2


def test_the_order_of_the_inputs_does_not_matter(monkeypatch):
    emulate(monkeypatch)
    step, one, two = CapturedWork(lambda x: {"c": x["a"] - x["b"]}, ""), torch.ones(2), torch.full((2,), 5.0)
    for _ in range(4):
        assert step({"a": two, "b": one})["c"].tolist() == [4.0, 4.0]
    assert step({"b": one, "a": two})["c"].tolist() == [4.0, 4.0]
    assert Graph.replays == 2


def test_a_repeated_step_that_keeps_a_number_is_found_by_the_emulator(monkeypatch):
    """The emulator itself: Python that would not run again on a GPU does not run again here."""
    emulate(monkeypatch)
    calls = []
    step = CapturedWork(lambda x: {"b": x["a"] + len(calls)} if calls.append(1) is None else {}, "")
    assert [step({"a": torch.zeros(1)})["b"].item() for _ in range(5)] == [1, 2, 3, 4, 4]


@pytest.mark.parametrize("key", ["compile", "compile_mode", "cudagraphs"])
def test_a_wrong_setting_is_named(key):
    with pytest.raises(ValueError, match=f"compile.{key}=3: expected"):
        CompileSettings(**{key: 3})


@pytest.mark.parametrize("sides", [(5, 5), (4, 6)])
def test_a_view_of_a_recorded_tote_is_one_of_the_same(sides):
    """A tote that is not square is mirrored only: a transposed one has another shape."""
    net, depth = CellsValue(), torch.rand(1, *sides)
    items = torch.tensor([[[0, 1, 2, 3, 4]]])
    views = {}
    for seed in range(60):
        torch.manual_seed(seed)
        expected = net.random_view(depth, items)
        torch.manual_seed(seed)
        found, places = recorded(net.random_view, depth, items)
        assert places == [] or seed == 0
        if sides[0] == sides[1]:
            assert all(map(torch.equal, found, expected))
        views[tuple(found[0].flatten().tolist())] = found
    assert len(views) == (8 if sides[0] == sides[1] else 4)


#: Trainings whose parts are all recorded, and whether the recorded steps are as exact as the plain ones.
TRAININGS = {
    "ppo": (["algo=ppo"], False),
    "a2c": (["algo=a2c"], False),
    "sampled_ppo": (["model=fcn4d", "model.mask_infeasible=false", "algo=sampled_ppo"], False),
    "masked fcn4d": (["model=fcn4d", "algo=sampled_ppo"], False),
    "individual": (["model=individual_rl", "algo=sampled_ppo", "algo.advantages=gae"], False),
    "td": (["experiment=afterstate"], True),
    "td by cells": (["experiment=afterstate", "model=afterstate_fcn"], True),
    "a warm start": (["warm_start=imitate", "warm_start.frames=16", "warm_start.critic_frames=16"], False),
}


#: The other trainings differ from these in a few lines only.
OFTEN = ("sampled_ppo", "td", "a warm start")
NAMES = [pytest.param(name, marks=[] if name in OFTEN else pytest.mark.slow) for name in TRAININGS]


def words(name: str) -> list[str]:
    tiny = ONE_NETWORK if name.startswith("td") else TINY
    size = "env.tote_size=[6,6,3]"  # for the receptive field of fcn4d
    return [*TRAININGS[name][0], *tiny, size, "total_frames=64", "curriculum=none", "evaluation_interval=64"]


@pytest.mark.parametrize("name", NAMES)
def test_a_training_learns_the_same_recorded(name, tmp_path, no_report):
    """The first batch has the same metrics up to rounding, after which draws may differ; values draw the same."""
    rows = {}
    for option in ("none", "cudagraphs"):
        train(composed(*words(name), f"compile={option}"), tmp_path / option)
        rows[option] = read_csv(tmp_path / option / "metrics.csv")
    compared = rows["none"] if TRAININGS[name][1] else rows["none"][:1]
    for plain, found in zip(compared, rows["cudagraphs"], strict=False):
        keys = {key for key in plain if not key.startswith("time/")}
        assert keys == {key for key in found if not key.startswith("time/")}
        for key in keys:
            assert found[key] == pytest.approx(plain[key], rel=1e-3, abs=1e-5), key


@pytest.mark.parametrize("collector", ["single", "multi_sync"])
def test_a_recorded_collector_returns_the_same_entries(collector, tmp_path):
    """And a curriculum reaches its environment."""
    batches = []
    for option in ("none", "cudagraphs"):
        cfg = composed(*TINY, f"collector={collector}", f"compile={option}", "curriculum=paper")
        (tmp_path / option).mkdir()
        trainer = Trainer(cfg, tmp_path / option)
        with trainer.running():
            batches.append(next(iter(trainer.collector)).exclude("collector", ("next", "collector")))
    plain, found = batches
    assert sorted(found.keys(True, True), key=str) == sorted(plain.keys(True, True), key=str)
    assert found.shape == plain.shape
    assert set(found["tote_height"].flatten().tolist()) == {1}


@pytest.mark.slow
def test_a_recorded_training_that_is_killed_and_resumed_equals_one_that_is_not(tmp_path, no_report):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    with after_batch(5, lambda _: shutil.copytree(whole, killed)):
        train(composed(*commands.SETTINGS, "compile=cudagraphs"), whole)
    resume_run([f"resume={killed}"])
    assert_same(whole, killed)


def test_items_that_are_made_on_the_cpu_are_refused(tmp_path):
    cfg = composed(*TINY, "benchmark=cut1", "env.tote_size=[10,10,10]", "compile=cudagraphs")
    with pytest.raises(ValueError, match=r"the environment looks at results while it runs \(.*cut.py"):
        train(cfg, tmp_path)


def test_infinite_gradients_of_recorded_steps_are_refused(tmp_path):
    cfg = composed(*TINY, "compile=cudagraphs", "reward_scale=1e38")
    with pytest.raises(FloatingPointError, match="the loss or its gradient is not finite"):
        train(cfg, tmp_path)


@pytest.fixture(params=["emulated", "cuda"])
def device(request, monkeypatch):
    """The device of recorded work that is repeated, by an emulator on a CPU or by a GPU."""
    if request.param == "cuda":
        return "cuda" if torch.cuda.is_available() else pytest.skip("needs a GPU")
    emulate(monkeypatch)
    return "cpu"


@pytest.mark.parametrize("name", NAMES)
def test_a_repeated_training_equals_one_that_runs_each_time(name, device, tmp_path, monkeypatch, no_report):
    """Through validations, another size of the last minibatch, and new heights of the tote."""
    rows = {}
    for option in ("repeated", "run"):
        if option == "run":
            assert device == "cuda" or Graph.replays > 20
            monkeypatch.setattr(CapturedWork, "_make_graph", lambda self, device: self.work)
        more = ["compile=cudagraphs", f"device={device}", "total_frames=128", "evaluation_interval=48"]
        more += ["algo.minibatch_size=6", "curriculum=paper", "curriculum.advance.frames_per_level=32"]
        train(composed(*words(name), *more), tmp_path / option)
        rows[option] = read_csv(tmp_path / option / "metrics.csv")
    assert [row["curriculum/level"] for row in rows["run"]][::2] == [1, 2, 3, 3]
    compared = rows["run"] if device == "cpu" else rows["run"][:5]  # rounding differs, and then the draws
    for plain, found in zip(compared, rows["repeated"], strict=device == "cpu"):
        for key, value in plain.items():
            if not key.startswith("time/"):
                assert found[key] == pytest.approx(value, rel=1e-6 if device == "cpu" else 1e-2, abs=1e-6), key


@pytest.mark.parametrize("settings", [{}, {"bin_items": 2, "preview": 1, "rotations": 2}])
def test_a_repeated_environment_equals_a_plain_one(settings, device):
    """With the same actions. What it returned stays as it was."""
    cfg = composed("curriculum=none")
    curriculum = build("curriculum", cfg.curriculum)
    make = partial(PickPlaceEnv, device=device, masks=MASKS, tote_size=(6, 6, 3), **settings)
    curriculum.setup(make(num_envs=1).cell, make(num_envs=1).items, 1_000)
    plain, repeated = (training_env(make, curriculum, CompileSettings(cudagraphs=flag), 0, 8) for flag in (False, True))
    planner, state, other = RandomFeasible(plain.base_env.cell), plain.reset(), repeated.reset()
    steps = []
    for number in range(20):
        action = planner.decide(state) // (1 + number % 2)  # some of the changed ones fail
        after, state = plain.step_and_maybe_reset(state.set("action", action))
        found, other = repeated.step_and_maybe_reset(other.set("action", action))
        steps.append((after["next"], found["next"], state.exclude("action"), other.exclude("action")))
    for after, found, following, next_one in steps:
        assert_equal(found, after)
        assert_equal(next_one, following)
