"""Evaluation: what it writes, that it counts every episode, and that nothing but the question changes the answer."""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy
import pytest
import torch

from pickplace import PickPlaceEnv
from pickplace.evaluation import evaluate
from pickplace.planners import JointDBL, RandomFeasible
from pickplace.task.geometry import Failure
from pickplace.task.items import Recorded
from pickplace.views.figures import evaluation_table


@pytest.fixture
def run(run, tmp_path):
    """Evaluate in this process, in an empty folder; returns exit code, standard error and ``evaluation.json``."""

    def call(*arguments):
        folder = tmp_path / f"result{len(list(tmp_path.iterdir()))}"
        code, _, err = run("evaluate", *arguments, f"hydra.run.dir={folder}")
        path = folder / "evaluation.json"
        return code, err, json.loads(path.read_text()) if path.is_file() else None

    return call


@pytest.fixture(scope="module")
def two_rotations(tmp_path_factory):
    """The folder of a short run with ``R = 2``."""
    run_dir = tmp_path_factory.mktemp("two") / "run"
    settings = ["experiment=smoke", "env.rotations=2", "total_frames=256", f"hydra.run.dir={run_dir}"]
    command = [sys.executable, "-m", "pickplace.training.train", *settings]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    return run_dir


def make_env(first, count, **settings):
    settings = {"tote_size": (4, 4, 2), "stream": "test", "seed": 1, "masks": (), **settings}
    return PickPlaceEnv(num_envs=count, first_episode=first, **settings)


KEYS = {
    "planner", "env", "items", "stream", "episodes", "seed", "occupancy", "items_placed", "failures",
    "feasible_action_share", "latency_ms", "versions", "commit",
}  # fmt: skip


@pytest.mark.parametrize("planner", ["joint_dbl", "random"])
def test_evaluation_json(run, planner):
    settings = ["env.tote_size=[4,5,2]", "evaluation.episodes=5", "evaluation.seed=7", "evaluation.latency_decisions=3"]
    code, err, result = run(f"planner={planner}", *settings)
    assert code == 0, err
    assert set(result) >= KEYS
    assert (result["planner"], result["episodes"], result["seed"]) == (planner, 5, 7)
    assert result["env"]["tote_size"] == [4, 5, 2] and result["env"]["rotations"] == 4
    occupancy = result["occupancy"]
    assert set(occupancy) == {"mean", "ci95", "min", "per_episode"}
    assert len(occupancy["per_episode"]) == 5 == sum(result["failures"].values())
    assert occupancy["min"] == min(occupancy["per_episode"])
    assert occupancy["mean"] == pytest.approx(sum(occupancy["per_episode"]) / 5)
    assert occupancy["ci95"][0] <= occupancy["mean"] <= occupancy["ci95"][1]
    assert set(result["failures"]) <= {failure.name.lower() for failure in Failure}
    assert 0 < result["feasible_action_share"] < 1
    assert 0 < result["latency_ms"]["p50"] <= result["latency_ms"]["p95"]
    assert 0 < result["latency_ms"]["cpu_p50"] < 60_000 and 0 < result["latency_ms"]["cpu_mean"] < 60_000
    assert set(result["versions"]) >= {"pickplace", "torch", "torchrl", "tensordict", "python"}


def test_every_episode_is_played_to_its_end_and_counted_once():
    result = evaluate.play(make_env, RandomFeasible(make_env(0, 1).rules), 7, 3)
    assert len(result.occupancy) == len(result.items_placed) == len(result.failure) == len(result.final_heights) == 7
    assert (result.failure == Failure.STUCK).all()  # a planner that knows the feasible actions ends no other way
    assert (result.items_placed > 0).all()
    # Each placement is a decision; after the last one the environment itself finds that nothing is feasible.
    assert result.decisions == int(result.items_placed.sum())


def test_placed_items_of_the_first_episode_add_up():
    result = evaluate.play(make_env, JointDBL(make_env(0, 1).rules), 3, 2, record=[0])
    boxes = result.recordings[0].boxes
    heights, volume = torch.zeros(4, 4, dtype=torch.int32), 0
    for x, y, z, w, d, h in boxes:
        space = heights[x : x + w, y : y + d]
        assert int(space.max()) == z
        space.fill_(z + h)
        volume += w * d * h
    assert torch.equal(heights, result.final_heights[0])
    assert len(boxes) == int(result.items_placed[0])
    assert volume / (4 * 4 * 2) == pytest.approx(float(result.occupancy[0]))


class Fussy(JointDBL):
    """Fails on purpose at every item of 2x2: its episodes last from one step to many, whatever plays beside them."""

    def decide(self, observation):
        keys = ("bin_depth", "tote_depth", "tote_height")
        placements = self.rules.placements_from_depth(*(observation[key] for key in keys))
        item = self.rules.read_item(observation["bin_depth"])
        infeasible = self.rules.action_mask(placements).int().argmin(1)
        return torch.where(item.w * item.d == 4, infeasible, super().decide(observation))


@pytest.mark.parametrize("planner", [JointDBL, Fussy])
@pytest.mark.parametrize("batch_size", [3, 100])
def test_batch_size_does_not_change_the_episodes(planner, batch_size):
    rules = make_env(0, 1).rules
    expected = evaluate.play(make_env, planner(rules), 12, 1, record=range(4))  # one at a time: no slot waits
    result = evaluate.play(make_env, planner(rules), 12, batch_size, record=range(4))
    if planner is Fussy:  # a slot that ends at once ends again, uncounted, while the longest one plays on
        assert expected.items_placed.min() == 0 and expected.items_placed.max() > 3
        assert (expected.failure != Failure.STUCK).any()
    for name in ("occupancy", "items_placed", "failure", "final_heights", "tote_height"):
        assert torch.equal(getattr(result, name), getattr(expected, name)), name
    assert result.recordings == expected.recordings and len(result.recordings) == 4
    assert result.decisions == expected.decisions
    assert result.feasible_share == pytest.approx(expected.feasible_share)


def test_streams_and_seeds_are_different_questions():
    rules = make_env(0, 1).rules

    def occupancy(**settings):
        return evaluate.play(lambda *a: make_env(*a, **settings), JointDBL(rules), 16, 16).occupancy

    base = occupancy()
    assert torch.equal(base, occupancy())
    assert not torch.equal(base, occupancy(seed=2))
    assert not torch.equal(base, occupancy(stream="validation"))


def test_a_recorded_stream_that_ends_is_no_failure(tmp_path):
    path = tmp_path / "items.csv"
    path.write_text("w,d,h\n1,1,1\n2,1,1\n")

    def make(first, count):
        return make_env(first, count, items=Recorded(str(path)))

    result = evaluate.play(make, JointDBL(make(0, 1).rules), 2, 2)
    assert result.failure.tolist() == [Failure.NONE] * 2
    assert result.items_placed.tolist() == [2, 2]
    assert result.occupancy.tolist() == [3 / 32] * 2


def test_candidates(run, two_rotations):
    arguments = [f"checkpoint={two_rotations}", "env.tote_size=[5,5,2]", "evaluation.episodes=8"]
    arguments += ["evaluation.latency_decisions=0", "evaluation.batch_size=4"]
    results = {}
    for candidates in ("1", "all"):
        code, err, results[candidates] = run(*arguments, f"planner.candidates={candidates}")
        assert code == 0, err
    one, best = results["1"], results["all"]
    assert set(one) >= KEYS | {"checkpoint", "trained", "mask_in_training", "mask_at_decision", "candidates"}
    assert one["trained"]["frames"] == 256
    # With a mask in training it has never learnt to avoid what cannot be picked, and cannot choose it either.
    outside = "failed picks and footprints outside the tote"
    assert (one["candidates"], one["mask_in_training"], one["mask_at_decision"]) == (1, True, outside)
    assert (best["candidates"], best["mask_in_training"], best["mask_at_decision"]) == ("all", True, True)
    assert best["failures"] == {"stuck": 8}
    assert set(one["failures"]) != {"stuck"}  # hardly trained, without a mask: some actions fail
    assert one["occupancy"]["mean"] < best["occupancy"]["mean"]
    assert one["latency_ms"] is None


def test_more_rotations_than_trained_are_refused(run, two_rotations):
    code, err, result = run(f"checkpoint={two_rotations}", "env.rotations=4")
    assert code == 2 and result is None
    assert "env.rotations=4: the checkpoint was trained with 2" in err
    assert err.startswith("error: ") and err.count("\n") == 1 and "Traceback" not in err


def test_recorded_items_are_compared_by_what_they_are(run, tmp_path):
    """Not by where they were."""
    table = tmp_path / "items.csv"
    arguments = ["planner=joint_dbl", "items=recorded", f"items.path={table}", "evaluation.episodes=1"]
    arguments += ["evaluation.latency_decisions=0"]
    table.write_text("w,d,h\n1,1,1\n2,1,1\n")
    code, err, _ = run(*arguments)
    assert code == 0, err
    other = next(tmp_path.glob("*/evaluation.json"))
    assert run(*arguments, f"compare={other}")[0] == 0
    elsewhere = table.rename(tmp_path / "moved.csv")
    arguments[2] = f"items.path={elsewhere}"
    assert run(*arguments, f"compare={other}")[0] == 0
    elsewhere.write_text("w,d,h\n1,1,1\n2,2,1\n")
    code, err, _ = run(*arguments, f"compare={other}")
    assert code == 2 and "its items is" in err


def test_a_key_of_the_checkpoint_s_items(run):
    """It is one of theirs, and not of the command's own items."""
    arguments = ["checkpoint=pretrained/mixed", "env.tote_size=[8,8,2]", "evaluation.episodes=2"]
    code, err, result = run(*arguments, "items.height=[1,1]")
    assert code == 0, err
    assert (result["items"]["width"], result["items"]["height"]) == ([1, 3], [1, 1])
    code, err, _ = run(*arguments, "items=paper", "items.kinds=[[1,1,1]]")
    assert code == 0, err


def test_confidence_interval_by_hand():
    # Mean 0.8; deviations -0.1, 0, 0, 0.1: variance 0.02 / 3, standard error sqrt(0.02 / 3 / 4) = 0.0408248;
    # Student's t with 3 degrees of freedom at 97.5%: 3.182446.
    low, high = evaluate.confidence95(torch.tensor([0.7, 0.8, 0.8, 0.9], dtype=torch.float64))
    assert low == pytest.approx(0.8 - 0.129923, abs=1e-6)
    assert high == pytest.approx(0.8 + 0.129923, abs=1e-6)
    assert evaluate.confidence95(torch.tensor([0.5] * 5)) == (0.5, 0.5)
    assert evaluate.confidence95(torch.tensor([0.5])) == (0.0, 1.0)
    assert evaluate.confidence95(torch.tensor([0.5]), least=-1.0) == (-1.0, 1.0)
    assert evaluate.confidence95(torch.tensor([1.0, 1.0, 0.96]))[1] == 1.0  # 1.044 is no occupancy
    assert evaluate.confidence95(torch.tensor([0.0, 0.0, 0.04]))[0] == 0.0
    low, high = evaluate.confidence95(torch.tensor([0.01, -0.01, 0.01]), least=-1.0)
    assert -1 < low < 0 < high


class Counting(JointDBL):
    """Keeps what JSON does not know."""

    name = "counting"

    def __init__(self, rules, weights):
        super().__init__(rules)
        self.weights = weights

    def statistics(self):
        return {"seen": torch.tensor([3, 4]), "share": numpy.float32(0.5), "device": torch.device("cpu")}


class Nameless(JointDBL):
    name = None


def test_planners_of_ones_own_lose_no_result(run):
    arguments = [
        "evaluation.episodes=2",
        "evaluation.latency_decisions=0",
        "trust=[test_evaluate]",
        "planner=joint_dbl",
    ]
    code, err, result = run(*arguments, "planner._target_=test_evaluate.Counting", "+planner.weights=[1,{a:2.5}]")
    assert code == 0, err
    assert result["planner_settings"]["weights"] == [1, {"a": 2.5}]
    assert (result["seen"], result["share"], result["device"]) == ([3, 4], 0.5, "cpu")
    code, err, result = run(*arguments, "planner._target_=test_evaluate.Nameless")
    assert code == 2 and "planner: Nameless has no name; expected" in err and result is None


def test_recorded_items_with_places_are_the_same_in_every_episode(run, tmp_path):
    table = tmp_path / "items.csv"
    arguments = ["planner=joint_dbl", "items=recorded", f"items.path={table}", "evaluation.episodes=3"]
    for header, row, same in (("w,d,h,x,y", "2,1,1,0,3", True), ("w,d,h", "2,1,1", None)):
        table.write_text(f"{header}\n{row}\n{row}\n")
        code, err, result = run(*arguments, "evaluation.latency_decisions=0")
        assert code == 0, err
        assert result.get("same_items") == same
        assert (", all of the same items" in evaluation_table(result)) == bool(same)


def test_the_validation_group_serves_an_evaluation_too(run):
    """It is training's, and has nothing to say about replays."""
    code, error, result = run(
        "planner=joint_dbl", "env.tote_size=[4,4,1]", "evaluation=validation", "evaluation.episodes=4"
    )
    assert (code, error, result["stream"]) == (0, "", "validation")


@pytest.mark.parametrize(("stream", "seed"), [("validation", 3), ("test", 4)])
def test_a_command_plays_the_stream_and_the_seed_that_it_names(run, tmp_path, stream, seed):
    settings = [f"evaluation.stream={stream}", f"evaluation.seed={seed}", "evaluation.latency_decisions=0"]
    code, _, result = run("planner=joint_dbl", "env.tote_size=[4,4,2]", "evaluation.episodes=6", *settings)

    def make_env(first, count):
        return PickPlaceEnv(
            tote_size=(4, 4, 2), stream=stream, seed=seed, num_envs=count, first_episode=first, masks=()
        )

    wanted = evaluate.play(make_env, JointDBL(make_env(0, 1).rules), 6, 6).occupancy.tolist()
    assert (code, result["occupancy"]["per_episode"]) == (0, wanted)


def test_latencies_are_medians_and_a_mean_in_milliseconds(monkeypatch):
    """A search may think long about few states."""

    def clock(*costs):
        readings = [reading for number, cost in enumerate(costs) for reading in (number, number + cost)]
        return iter(readings).__next__

    ticking = SimpleNamespace(perf_counter=clock(0.002, 0.002, 0.009), process_time=clock(0.001, 0.001, 0.010))
    monkeypatch.setattr(evaluate, "time", ticking)
    env = PickPlaceEnv(num_envs=1, tote_size=(4, 4, 2))
    found = evaluate.decision_latency(lambda *_: env, JointDBL(env.rules), 3)
    assert found == pytest.approx({"p50": 2.0, "p95": 8.3, "cpu_p50": 1.0, "cpu_mean": 4.0})
