"""The examples in docs/examples/ train, evaluate and plan."""

import importlib
import json
import logging
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from pickplace import PickPlaceEnv, Planner, State
from pickplace.evaluation import evaluate
from pickplace.robot import json_lines
from pickplace.runs import checkpoint
from pickplace.runs import hydra_app as config
from pickplace.runs.registry import build
from pickplace.training import train

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "docs" / "examples"
EVALUATION = ["evaluation.episodes=3", "evaluation.latency_decisions=0", "evaluation.replay=0", "threads=1"]
TRAINING = ["env.num_envs=8", "total_frames=64", "evaluation.episodes=4", "threads=1"]
BIN, TOTE = np.zeros((5, 5)), np.full((6, 6), 5)
BIN[1:3, 2] = 1


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Run a command with an example's folder, in this process, from the root of the checkout; return its run folder."""
    monkeypatch.chdir(ROOT)

    def call(command, example, *arguments, folder="out"):
        monkeypatch.syspath_prepend(str(EXAMPLES / example))
        words = ["--config-dir", str(EXAMPLES / example), *arguments, f"hydra.run.dir={tmp_path / folder}"]
        if any(word.startswith("resume=") for word in arguments):
            words = list(arguments)
        monkeypatch.setattr(sys, "argv", [f"pickplace-{command}", *words])
        threads = torch.get_num_threads()
        try:
            {"train": train.main, "evaluate": evaluate.main}[command]()
        finally:
            logging.root.handlers.clear()
            torch.set_num_threads(threads)
        return tmp_path / folder

    return call


def result(folder):
    return json.loads((folder / "evaluation.json").read_text())


def test_own_planner(run):
    ours = [result(run("evaluate", "own_planner", "planner=soft_dbl", *EVALUATION, folder=name)) for name in "ab"]
    assert ours[0]["planner"] == "soft_dbl" and set(ours[0]["failures"]) == {"stuck"}
    assert ours[0]["occupancy"]["mean"] > 0.8 and ours[0]["occupancy"] == ours[1]["occupancy"]
    assert ours[0]["planner_settings"] == {"temperature": 0.05, "seed": 0}


def test_own_model(run):
    folder = run("train", "own_model", "model=mlp", "model.actor.hidden=8", *TRAINING)
    words = [f"checkpoint={folder}", "trust=own_model", *EVALUATION]
    ours = result(run("evaluate", "own_model", *words, folder="evaluation"))
    assert ours["planner"] == "policy" and set(ours["failures"]) == {"stuck"}


def test_a_module_is_trusted_by_name_and_each_time(run, capsys, tmp_path):
    folder = run("train", "own_model", "model=mlp", "model.actor.hidden=8", "trust=own_model", *TRAINING)
    for trust in ([], ["trust=[own_models,model]"]):
        for command, words in (
            ("train", [f"resume={folder}", "total_frames=128"]),
            ("evaluate", [f"checkpoint={folder}"]),
        ):
            with pytest.raises(SystemExit):
                run(command, "own_model", *words, *trust, folder="refused")
            assert "'own_model.Mlp': the checkpoint is refused" in capsys.readouterr().err
    run("train", "own_model", f"resume={folder}", "total_frames=128", "trust=[own_model]")
    assert checkpoint.read(checkpoint.locate(folder, prefer="last"))[1]["frames"] == 128
    with pytest.raises(ValueError, match=r"own_model\.Mlp"):
        Planner.load(folder)
    assert Planner.load(folder, trust=["own_model"]).plan(BIN, TOTE).status == "ok"
    np.save(tmp_path / "bin.npy", BIN)
    np.save(tmp_path / "tote.npy", TOTE)
    maps = ["--bin", str(tmp_path / "bin.npy"), "--tote", str(tmp_path / "tote.npy")]
    json_lines.run(json_lines.parser().parse_args([str(folder), *maps, "--trust", "own_model"]))
    assert '"status": "ok"' in capsys.readouterr().out


def test_a_teacher_of_a_trusted_module(run, capsys):
    teacher = run("train", "own_model", "model=mlp", "model.actor.hidden=8", *TRAINING)
    imitate = ["warm_start=imitate", "planner@warm_start.teacher=policy", "warm_start.frames=64"]
    words = [*imitate, f"warm_start.checkpoint={teacher}", *TRAINING]
    with pytest.raises(SystemExit):
        run("train", "own_model", *words, folder="refused")
    assert "if own_model is yours, say trust=own_model" in capsys.readouterr().err
    run("train", "own_model", *words, "trust=own_model", folder="taught")


def test_own_observation(run):
    """A term and a policy that reads it: imitated, trained, evaluated, searched and planned with."""
    small = ["env=pits", "model=pit_policy", "model.actor.filters=8", "curriculum=none", "env.tote_size=[6,6,2]"]
    words = [
        *small,
        *TRAINING,
        "total_frames=384",
        "warm_start=imitate",
        "warm_start.frames=128",
        "warm_start.critic_frames=64",
    ]
    folder = run("train", "own_observation", *words)
    weights = checkpoint.read(checkpoint.locate(folder, prefer="last"))[0]["policy"]
    given = [f"checkpoint={folder}", "trust=own_observation", *EVALUATION]
    for planner in (["planner.candidates=10"], ["planner=lookahead", "planner.samples=2", "planner.candidates=2"], []):
        ours = result(run("evaluate", "own_observation", *given, *planner, folder=f"evaluation{len(planner)}"))
        assert list(ours["env"]["observation"]) == ["bin_depth", "tote_depth", "tote_height", "pit_depth"]
    assert ours["occupancy"]["mean"] > 0.2 and any("pits" in name for name in weights)
    with pytest.raises(ValueError, match=r"own_observation\.P"):
        Planner.load(folder)
    assert Planner.load(folder, trust=["own_observation"]).plan(BIN, np.full((6, 6), 2)).status == "ok"


def test_pit_depth(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES / "own_observation"))
    own = importlib.import_module("own_observation")
    standard = PickPlaceEnv(num_envs=2).terms
    env = PickPlaceEnv(num_envs=2, observation={**standard, "pit_depth": own.PitDepth()})
    observation = env.rollout(8)
    assert env.observation_spec.is_in(observation[:, 0].select(*env.observation_spec.keys()))
    heights = torch.tensor([[[0, 2, 1], [2, 2, 2], [3, 1, 3]]], dtype=torch.int32)
    pits = own.PitDepth().value(env.cell, State(heights, torch.tensor([5]), None))
    assert pits.tolist() == [[[2, 0, 1], [0, 0, 0], [0, 1, 0]]]


def test_own_items(run):
    folder = run("train", "own_items", "items=batches", *TRAINING, "model.actor.filters=8", "env.tote_size=[4,4,2]")
    words = [f"checkpoint={folder}", "trust=own_items", *EVALUATION]
    ours = result(run("evaluate", "own_items", *words, folder="evaluation"))
    assert ours["items"]["run"] == 3 and ours["env"]["tote_size"] == [4, 4, 2]


def test_own_items_arrive_in_batches(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES / "own_items"))
    batches = importlib.import_module("own_items").Batches
    steps = torch.arange(300)
    kinds = [[1, 1, 1], [2, 1, 1], [1, 2, 1]]
    item = batches(kinds, run=3).sample("train", torch.tensor(0), torch.zeros_like(steps), steps, (5, 5, 1))
    sizes = torch.stack([item.w, item.d], 1).view(100, 3, 2)
    assert (sizes == sizes[:, :1]).all() and len(sizes[:, 0].unique(dim=0)) == 3
    assert len(torch.stack([item.x, item.y], 1).unique(dim=0)) > 10
    with pytest.raises(ValueError, match="items.run=0"):
        batches(kinds, run=0)


def test_recorded_items(run):
    ours = result(run("evaluate", "recorded_items", "items=morning", "planner=joint_dbl", *EVALUATION))
    assert ours["items"]["loop"] is True and ours["occupancy"]["mean"] > 0.8


@pytest.mark.parametrize(("name", "levels"), [("ramp", [2, 3, 3, 3, 4]), ("careful", [3, 4, 3, 4, 4])])
def test_own_curriculum(name, levels):
    search = f"hydra.searchpath=[file://{EXAMPLES / 'own_curriculum'}]"
    with initialize_config_dir(str(config.conf_dir()), version_base="1.3"):
        curriculum = build("curriculum", compose("train", [search, f"curriculum={name}"]).curriculum)
    curriculum.setup(1, 4, 400_000)
    assert (curriculum.level, curriculum.end) == (2, 4) and curriculum.check_budget(400_000) is None
    seen = []
    for frames in range(0, 200_001, 50_000):
        occupancy = torch.full((200,), 0.45 if frames == 100_000 else 0.9)
        curriculum.update(torch.full((200,), curriculum.level), occupancy, frames)
        seen.append(curriculum.level)
    assert seen == levels


def test_torchrl_script(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    assert 0.5 < importlib.import_module("torchrl_script").train(total_frames=4096) < 1
