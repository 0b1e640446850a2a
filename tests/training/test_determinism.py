"""docs/determinism.md, held to its word."""

import json
import sys

import pytest
import torch

from pickplace import Planner
from pickplace.evaluation import evaluate
from pickplace.runs import checkpoint
from pickplace.runs.loggers import read_csv

PAPER = [(1, 1, 1), (2, 1, 1), (1, 2, 1), (2, 2, 1)]


def outcome(run_dir):
    """Tensors, facts and metrics of a run, without times."""
    state, facts = checkpoint.read(run_dir / "checkpoints" / "last")
    tensors, rest = checkpoint.flatten(state)
    rows = [{k: v for k, v in row.items() if not k.startswith("time/")} for row in read_csv(run_dir / "metrics.csv")]
    return tensors, (rest, rows, {key: facts[key] for key in ("frames", "iteration", "best", "curriculum")})


def test_the_same_training_twice(smoke, tmp_path):
    """For PPO see test_resume: a run that is killed equals one that is not."""
    settings = ["algo=a2c", "curriculum=mixture", "warm_start=imitate", "planner@warm_start.teacher=random"]
    quick = ["total_frames=384", "warm_start.frames=128", "evaluation.episodes=2", "seed=3"]
    for name in "ab":
        smoke(tmp_path / name, *quick, *settings)
    (tensors, rest), (others, other_rest) = outcome(tmp_path / "a"), outcome(tmp_path / "b")
    assert rest == other_rest and tensors.keys() == others.keys()
    assert all(torch.equal(value, others[key]) for key, value in tensors.items())


@pytest.fixture
def evaluated(tmp_path, monkeypatch):
    """Evaluates in this process, and returns evaluation.json without times."""

    def run(name, *settings):
        fixed = ["env.tote_size=[4,4,2]", "threads=1", "evaluation.replay=0", f"hydra.run.dir={tmp_path / name}"]
        monkeypatch.setattr(sys, "argv", ["pickplace-evaluate", *settings, *fixed])
        evaluate.main()
        result = json.loads((tmp_path / name / "evaluation.json").read_text())
        return {key: value for key, value in result.items() if key != "latency_ms"}

    return run


@pytest.mark.parametrize(
    "settings",
    [
        ["planner=joint_dbl"],
        ["planner=random"],
        ["planner=mcts", "planner.simulations=20"],
        ["planner=lookahead", "planner.samples=2", "checkpoint=pretrained/r4"],
        ["planner=policy", "checkpoint=pretrained/r4"],
    ],
    ids=lambda settings: settings[0],
)
def test_the_same_evaluation_twice(evaluated, settings):
    settings = [*settings, "evaluation.episodes=3", "evaluation.latency_decisions=0"]
    assert evaluated("a", *settings) == evaluated("b", *settings)


def test_the_batch_does_not_change_what_a_policy_does(evaluated):
    settings = ["checkpoint=pretrained/r4", "evaluation.episodes=8"]
    runs = [evaluated(str(batch), *settings, f"evaluation.batch_size={batch}") for batch in (1, 3, 8)]
    assert runs[0]["occupancy"] == runs[1]["occupancy"] == runs[2]["occupancy"]


def test_a_plan_depends_on_its_own_maps_alone():
    def maps(seed):
        generator = torch.Generator().manual_seed(seed)
        w, d, h = PAPER[seed % len(PAPER)]
        item = torch.zeros(5, 5)
        item[1 : 1 + w, 2 : 2 + d] = h
        return item, torch.randint(0, 6, (6, 6), generator=generator)

    planner = Planner.load("pretrained/r4")
    forwards = [planner.plan(*maps(seed)) for seed in range(12)]
    torch.manual_seed(99)
    backwards = [planner.plan(*maps(seed)) for seed in reversed(range(12))]
    assert forwards == backwards[::-1]
