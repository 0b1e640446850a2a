"""``pickplace-evaluate``: what it writes, what it compares, and planners of the user's own."""

import json

import numpy
import pytest
import torch
from untrained import write_checkpoint

from pickplace import CellSpec, PickPlaceEnv
from pickplace.evaluation.play import play
from pickplace.planners.heuristics import JointDBL
from pickplace.views.tables import evaluation_table

SMALL = ["env.tote_size=[4,4,2]", "evaluation.latency_decisions=0", "evaluation.replay=0"]
JOINT = ["planner=joint_dbl", *SMALL]


@pytest.fixture
def evaluation(run, tmp_path):
    """Evaluate in this process, in an empty folder; return exit code, standard error and ``evaluation.json``."""

    def call(*arguments):
        folder = tmp_path / f"result{len(list(tmp_path.iterdir()))}"
        code, _, err = run("evaluate", *arguments, f"hydra.run.dir={folder}")
        path = folder / "evaluation.json"
        return code, err, json.loads(path.read_text()) if path.is_file() else None

    return call


@pytest.mark.parametrize(("group", "stream", "seed"), [("default", "test", 7), ("validation", "validation", 3)])
def test_evaluation_json(evaluation, group, stream, seed):
    settings = [f"evaluation={group}", f"evaluation.seed={seed}", "evaluation.episodes=5"]
    settings += ["evaluation.latency_decisions=3", "env.tote_size=[4,5,2]"]
    code, err, result = evaluation("planner=joint_dbl", *settings)
    assert (code, err) == (0, "")
    assert (result["planner"], result["episodes"], result["seed"], result["stream"]) == ("joint_dbl", 5, seed, stream)
    assert result["env"]["tote_size"] == [4, 5, 2] and result["env"]["rotations"] == 4
    occupancy, latency = result["occupancy"], result["latency_ms"]
    assert sum(result["failures"].values()) == 5 and occupancy["min"] == min(occupancy["per_episode"])
    assert occupancy["mean"] == pytest.approx(sum(occupancy["per_episode"]) / 5)
    assert occupancy["ci95"][0] <= occupancy["mean"] <= occupancy["ci95"][1]
    assert 0 < latency["p50"] <= latency["p95"] and 0 < latency["cpu_p50"] < 60_000 and 0 < latency["cpu_mean"] < 60_000
    assert set(result["versions"]) >= {"pickplace", "torch", "torchrl", "tensordict", "python"}

    def make_env(first, count):
        settings = {"tote_size": (4, 5, 2), "stream": stream, "seed": seed, "masks": ()}
        return PickPlaceEnv(num_envs=count, first_episode=first, **settings)

    assert play(make_env, JointDBL(make_env(0, 1).cell), 5, 5).occupancy.tolist() == occupancy["per_episode"]


def test_candidates(evaluation, tmp_path):
    folder = write_checkpoint(tmp_path / "it", CellSpec(rotations=2), "env.rotations=2")
    arguments = [f"checkpoint={folder}", *SMALL, "env.tote_size=[5,5,2]", "evaluation.episodes=8"]
    results = {}
    for candidates in ("1", "all"):
        code, err, results[candidates] = evaluation(*arguments, f"planner.candidates={candidates}")
        assert code == 0, err
    one, best = results["1"], results["all"]
    assert one["trained"]["frames"] == 256 and one["latency_ms"] is None
    # With a mask in training it has never learnt to avoid what cannot be picked, and cannot choose it either.
    outside = "failed picks and footprints outside the tote"
    assert (one["candidates"], one["mask_in_training"], one["mask_at_decision"]) == (1, True, outside)
    assert (best["candidates"], best["mask_in_training"], best["mask_at_decision"]) == ("all", True, True)
    assert best["failures"] == {"stuck": 8}
    assert set(one["failures"]) != {"stuck"}  # not trained, without a mask: some actions fail
    assert one["occupancy"]["mean"] < best["occupancy"]["mean"]
    search = ["planner=lookahead", "planner.samples=2", "planner.rounds=1", "planner.candidates=2"]
    code, err, found = evaluation(*arguments, *search, "evaluation.episodes=1")
    assert code == 0 and (found["candidates"], found["mask_at_decision"]) == ("all", True), err


def test_recorded_items_are_compared_by_content_and_not_by_path(evaluation, tmp_path):
    table, moved = tmp_path / "items.csv", tmp_path / "moved.csv"
    arguments = [*JOINT, "items=recorded", "evaluation.episodes=1"]
    table.write_text("w,d,h\n1,1,1\n2,1,1\n")
    code, err, result = evaluation(*arguments, f"items.path={table}")
    assert code == 0 and "same_items" not in result, err
    other = next(tmp_path.glob("*/evaluation.json"))
    arguments += [f"items.path={table.rename(moved)}", f"compare={other}"]
    code, err, result = evaluation(*arguments)
    assert code == 0 and result["paired_difference"]["mean"] == 0, err
    moved.write_text("w,d,h\n1,1,1\n2,2,1\n")
    code, err, _ = evaluation(*arguments)
    assert code == 2 and "its items is" in err


def test_items_of_a_checkpoint_and_other_ones(evaluation):
    """A key of the checkpoint's items is not one of the command's own items."""
    arguments = ["checkpoint=pretrained/mixed", *SMALL, "env.tote_size=[6,6,1]", "evaluation.episodes=2"]
    code, err, result = evaluation(*arguments, "items.height=[1,1]")
    assert code == 0, err
    assert (result["items"]["width"], result["items"]["height"]) == ([1, 3], [1, 1])
    code, err, _ = evaluation(*arguments, "items=paper", "items.kinds=[[1,1,1]]")
    assert code == 0, err


class Counting(JointDBL):
    """Keeps what JSON does not know."""

    name = "counting"

    def __init__(self, cell, weights):
        super().__init__(cell)
        self.weights = weights

    def evaluation_facts(self):
        return {"heaviest": max(self.weights[1].values())}

    def statistics(self):
        return {"seen": torch.tensor([3, 4]), "share": numpy.float32(0.5), "device": torch.device("cpu")}


class Nameless(JointDBL):
    name = None


def test_own_planners_add_to_the_result(evaluation):
    arguments = [*JOINT, "evaluation.episodes=2", "trust=[test_evaluate]"]
    code, err, result = evaluation(
        *arguments, "planner._target_=test_evaluate.Counting", "+planner.weights=[1,{a:2.5}]"
    )
    assert code == 0, err
    assert result["planner_settings"]["weights"] == [1, {"a": 2.5}]
    assert (result["heaviest"], result["seen"], result["share"], result["device"]) == (2.5, [3, 4], 0.5, "cpu")
    code, err, result = evaluation(*arguments, "planner._target_=test_evaluate.Nameless")
    assert code == 2 and "planner: Nameless has no name; expected" in err and result is None


def test_recorded_items_with_places_are_the_same_in_every_episode(evaluation, tmp_path):
    (tmp_path / "items.csv").write_text("w,d,h,x,y\n2,1,1,0,3\n2,1,1,0,3\n")
    arguments = [*JOINT, "items=recorded", f"items.path={tmp_path / 'items.csv'}", "evaluation.episodes=3"]
    code, err, result = evaluation(*arguments)
    assert code == 0 and result["same_items"], err
    assert ", all of the same items" in evaluation_table(result)
