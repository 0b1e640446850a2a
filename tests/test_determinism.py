"""docs/determinism.md, held to its word."""

import json
import sys

import pytest
import torch
from commands import assert_same

from pickplace import Planner
from pickplace.evaluation import evaluate

PAPER = [(1, 1, 1), (2, 1, 1), (1, 2, 1), (2, 2, 1)]


@pytest.mark.parametrize(
    "settings", [["curriculum=mixture"], ["algo=a2c", "warm_start=random", "warm_start.frames=256"]], ids=" ".join
)
def test_the_same_training_twice(smoke, tmp_path, settings):
    for name in "ab":
        smoke(tmp_path / name, "total_frames=768", "seed=3", *settings)
    assert_same(tmp_path / "a", tmp_path / "b")


@pytest.mark.parametrize("planner", ["joint_dbl", "random", "mcts", "lookahead", "policy"])
def test_the_same_evaluation_twice(tmp_path, monkeypatch, planner):
    results = []
    more = {"mcts": ["planner.simulations=20"], "lookahead": ["planner.samples=2"]}.get(planner, [])
    if planner in ("lookahead", "policy"):
        more = [*more, "checkpoint=pretrained/r4"]
    for name in "ab":
        settings = ["env.tote_size=[4,4,2]", "evaluation.episodes=6", "threads=1", f"hydra.run.dir={tmp_path / name}"]
        monkeypatch.setattr(sys, "argv", ["pickplace-evaluate", f"planner={planner}", *settings, *more])
        evaluate.main()
        results.append(json.loads((tmp_path / name / "evaluation.json").read_text()))
        del results[-1]["latency_ms"]
    assert results[0] == results[1]


def test_the_batch_does_not_change_what_a_policy_does(tmp_path, monkeypatch):
    occupancy = []
    for batch in (1, 5, 12):
        settings = ["env.tote_size=[4,4,2]", "evaluation.episodes=12", f"evaluation.batch_size={batch}", "threads=1"]
        run_dir = tmp_path / str(batch)
        monkeypatch.setattr(
            sys, "argv", ["pickplace-evaluate", "checkpoint=pretrained/r4", *settings, f"hydra.run.dir={run_dir}"]
        )
        evaluate.main()
        occupancy.append(json.loads((run_dir / "evaluation.json").read_text())["occupancy"])
    assert occupancy[0] == occupancy[1] == occupancy[2]


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
