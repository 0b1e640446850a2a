"""The commands: bad input ends in one sentence, a code other than 0, and leaves nothing behind."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import save

from pickplace.runs import checkpoint


@pytest.fixture(scope="module")
def smoke_run(tmp_path_factory):
    """A small finished run."""
    run_dir = tmp_path_factory.mktemp("smoke") / "run"
    command = [sys.executable, "-m", "pickplace.training.train", "experiment=smoke", f"hydra.run.dir={run_dir}"]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    return run_dir


BAD = [
    ("train", ["algo.gama=0.9"], ["algo.gama", "'gamma'"]),
    ("train", ["+algo.gama=0.9"], ["algo.gama", "'gamma'"]),
    ("train", ["+env.foo=1"], ["PickPlaceEnv", "'foo'"]),
    ("train", ["+curriculum.advance.foo=1"], ["Threshold", "foo"]),
    ("train", ["-m", "algo.gama=0.9,1"], ["algo.gama", "'gamma'"]),
    ("train", ["-m", "env.rotations=5,6"], ["rotations=5", "1, 2, 3 or 4"]),
    ("train", ["-m", "curriculum=none,mien"], ["curriculum/mien", "adaptive"]),
    ("train", ["algo.gama=0.9", "--help"], ["algo.gama", "'gamma'"]),
    ("train", ["--config-dir", "nowhere"], ["nowhere"]),
    ("train", ["nonsense=1"], ["nonsense", "there is no key"]),
    ("train", ["algo=null"], ["algo=null"]),
    ("train", ["env.tote_size=[6,6"], ["'env.tote_size=[6,6'", "<key>=<value>"]),
    ("train", ["env.tote_size"], ["'env.tote_size'", "<key>=<value>"]),
    ("train", ["seed=1,2"], ["seed=1,2", "--multirun"]),
    ("train", ["curriculum=mien"], ["curriculum/mien", "adaptive"]),
    ("train", ["experiment=quik"], ["experiment/quik", "quick"]),
    ("train", ["env.tote_size=[6,6,-5]"], ["tote_size=[6, 6, -5]", "positive whole numbers"]),
    ("train", ["env.tote_size=[6,6]"], ["tote_size=[6, 6]", "3 positive"]),
    ("train", ["env.rotations=5"], ["rotations=5", "1, 2, 3 or 4"]),
    ("train", ["env.pick_rule=contains"], ["pick_rule='contains'", "'overlap'"]),
    ("train", ["env.bin_size=[1,1,1]"], ["item 2x1x1", "bin_size"]),
    ("train", ["env.num_envs=0"], ["env.num_envs=0", ">= 1"]),
    ("train", ["env.min_support=2"], ["min_support=2", "between 0 and 1"]),
    ("train", ["seed=99999999999999999999"], ["seed=9", "2**62"]),
    ("train", ["threads=0"], ["threads=0", ">= 1"]),
    ("train", ["device=tpu"], ["device=tpu", "cpu"]),
    ("train", ["device=meta"], ["device=meta", "cpu"]),
    ("train", ["threads=10000000000"], ["threads=10000000000", "<= 1024"]),
    ("train", ["algo.lr=fast"], ["algo.lr=fast", ">= 0"]),
    ("train", ["algo.lr_decay_start=2"], ["algo.lr_decay_start=2", "between 0 and 1"]),
    ("train", ["algo.mask_infeasible=maybe"], ["algo.mask_infeasible=maybe", "true or false"]),
    ("train", ["evaluation.stream=test"], ["evaluation.stream=test", "validation"]),
    ("train", ["planner=random"], ["RandomFeasible", "planner=policy"]),
    ("train", ["algo.loss=dqn"], ["algo.loss=dqn", "ppo or a2c"]),
    ("train", ["algo.lr=-1"], ["algo.lr=-1", ">= 0"]),
    ("train", ["algo.gamma=1.5"], ["algo.gamma=1.5", "<= 1"]),
    ("train", ["algo.clip_epsilon=1.5"], ["algo.clip_epsilon=1.5", "<= 1"]),
    ("train", ["curriculum/advance=staged", "curriculum.advance.stages=5"], ["stages=5", "a list of"]),
    ("train", ["total_frames=many"], ["total_frames=many", "whole number"]),
    ("train", ["items.kinds=[[9,9,1]]"], ["item 9x9x1", "bin_size"]),
    ("train", ["items.kinds=[[1,1,9]]"], ["item 1x1x9", "tote_size[2]=5"]),
    ("train", ["items.kinds=[]"], ["items.kinds=[]", "at least one"]),
    ("train", ["items=recorded", "items.path=nowhere.csv"], ["items.path='nowhere.csv'", "no such file"]),
    ("train", ["items=recorded"], ["items.path", "no value"]),
    ("train", ["model.actor.filters=-4"], ["model.actor.filters=-4", ">= 1"]),
    ("train", ["model.actor._target_=os.system"], ["os.system"]),
    ("train", ["trust=[os]"], ["trust='os'", "modules of your own"]),
    ("evaluate", ["planner=joint_dbl", "trust=5"], ["trust=5", "modules of your own"]),
    ("train", ["model.actor.receptive_field=4"], ["model.actor.receptive_field=4", "odd"]),
    ("train", ["model.actor.compute_dtype=float8"], ["float8", "bfloat16"]),
    ("train", ["model=fcn4d", "env.tote_size=[4,4,1]"], ["tote_size=[4, 4, 1]", "eq. 3"]),
    ("train", ["model=fcn4d", "items.kinds=[[4,1,1]]", "env.effector_size=[4,4]"], ["longest side is 4", "eq. 2"]),
    ("train", ["curriculum.start_height=9"], ["start_height=9"]),
    ("train", ["collector=multi_sync", "collector.workers=3"], ["collector.workers=3", "divisor"]),
    ("train", ["planner.candidates=0"], ["candidates=0", "'all'"]),
    ("train", ["curriculum.advance=foo"], ["curriculum.advance='foo'", "curriculum/advance=threshold"]),
    ("train", ["curriculum.sample=null"], ["curriculum.sample=None", "curriculum/sample=recent"]),
    ("train", ["model.critic=null"], ["model.critic=None", "_target_"]),
    ("train", ["curriculum=null"], ["curriculum=null", "adaptive", "paper"]),
    ("train", ["model.actor.head_std=-1"], ["model.actor.head_std=-1", ">= 0"]),
    ("train", ["algo.lr_decay_start=true"], ["algo.lr_decay_start=True", "between 0 and 1"]),
    ("train", ["evaluation.seed=-1"], ["evaluation.seed=-1", "2**62"]),
    ("train", ["algo=a2c", "env.num_envs=1", "algo.rollout_length=1"], ["algo.normalize_advantage=True", "one frame"]),
    ("train", ["resume=nowhere"], ["nowhere'", "run folder"]),
    ("train", ["resume=nowhere", "-m"], ["resume", "flags"]),
    ("train", ["++resume=nowhere"], ["resume=nowhere", "without a +"]),
    ("train", ["algo.lr=inf"], ["algo.lr=inf", ">= 0"]),
    ("train", ["env.tote_size=[5,5,3000000000]"], ["3000000000", "below 1048576"]),
    ("train", ["model.critic.hidden=-1"], ["model.critic.hidden=-1", ">= 1"]),
    ("train", ["model=fcn4d", "model.actor.filters=-1"], ["model.actor.filters=-1", ">= 1"]),
    ("evaluate", [], ["checkpoint=null", "run folder"]),
    ("evaluate", ["checkpoint=nowhere"], ["nowhere'", "run folder"]),
    ("evaluate", ["planner=joint_dbl", "model.actor.filters=8"], ["model", "checkpoint=<run folder>"]),
    ("evaluate", ["planner=joint_dbl", "planner.seed=1"], ["planner.seed", "no key"]),
    ("evaluate", ["planner=random", "planner.seed=one"], ["planner.seed='one'", "whole number"]),
    ("evaluate", ["planner=joint_dbl", "evaluation.latency_decisions=x"], ["latency_decisions=x", ">= 0"]),
    ("evaluate", ["planner=uniform", "planner.seed=one"], ["planner.seed='one'", "whole number"]),
    ("evaluate", ["planner=joint_dbl", "compare=nowhere.json"], ["compare='nowhere.json'", "evaluation.json"]),
    ("evaluate", ["planner=joint_dbl", "evaluation.replay=-1"], ["evaluation.replay=-1", ">= 0"]),
    ("evaluate", ["planner=joint_dbl", "evaluation.gif=1"], ["evaluation.gif=1", "true or false"]),
    ("evaluate", ["planner=mcts", "planner.seed=99999999999999999999"], ["planner.seed=9", "2**62"]),
    ("evaluate", ["planner=joint_dbl", "items.widht=1"], ["items.widht", "no key 'widht'", "'weights'"]),
    ("evaluate", ["planner=joint_dbl", "+items.side=1"], ["items.side", "no key 'side'", "kinds, weights"]),
    ("evaluate", ["checkpoint=pretrained/mixed", "items.kinds=[[1,1,1]]"], ["items.kinds", "width, depth, height"]),
    ("evaluate", ["planner=greedy"], ["planner/greedy", "joint_dbl"]),
    ("evaluate", ["planner=joint_dbl", "evaluation.episodes=0"], ["evaluation.episodes=0", ">= 1"]),
    ("evaluate", ["planner=joint_dbl", "evaluation.stream=exam"], ["stream=exam", "validation"]),
]


@pytest.mark.parametrize(("command", "arguments", "expected"), BAD)
def test_bad_input_is_one_sentence(run, tmp_path, command, arguments, expected):
    code, _, err = run(command, *arguments)
    noise = "Error executing job with overrides"  # of a sweep: Hydra's own line
    lines = [line for line in err.splitlines() if line.strip() and "Warning" not in line and noise not in line]
    assert code not in (0, None)
    assert len(lines) == 1 and lines[0].startswith("error: "), err
    for part in expected:
        assert part in lines[0]
    folders = {"outputs", "outputs/train", "outputs/evaluate", "outputs/sweep"}
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} <= folders


def test_csv_with_a_bad_row(run, tmp_path):
    (tmp_path / "items.csv").write_text("w,d,h\n1,1,1\n1,x,1\n")
    code, _, err = run("train", "items=recorded", "items.path=items.csv")
    assert code == 2
    assert "items.csv, line 3" in err and "'1,x,1'" in err


def test_a_preset_with_a_misspelt_key(run, tmp_path):
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    (tmp_path / "mine" / "experiment" / "typo.yaml").write_text("# @package _global_\nalgo: {gama: 0.9}\n")
    code, _, err = run("train", "--config-dir", "mine", "experiment=typo")
    assert code == 2
    assert "algo.gama: there is no key 'gama' in algo; did you mean 'gamma'?" in err


def test_a_failure_leaves_earlier_results_in_the_folder(run, tmp_path):
    (tmp_path / "evaluation.json").write_text("{}")
    code, _, err = run("evaluate", "planner=joint_dbl", "env.rotations=5", "hydra.run.dir=.")
    assert code == 2 and "rotations=5" in err
    assert (tmp_path / "evaluation.json").read_text() == "{}"


def test_full_error_shows_the_traceback(run, monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(ValueError, match="rotations=5"):
        run("train", "env.rotations=5")


def test_checkpoint_for_fewer_rotations(run, smoke_run, tmp_path):
    state, facts = checkpoint.read(smoke_run / "checkpoints" / "last")
    facts["config"]["env"]["rotations"] = 2
    del facts["schema"], facts["sha256"]
    checkpoint.write(tmp_path / "two", state, facts)
    code, _, err = run("evaluate", f"checkpoint={tmp_path / 'two'}", "env.rotations=4")
    assert code == 2 and "env.rotations=4: the checkpoint was trained with 2" in err


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.rotations=1", "env.rotations=1: the run began with 4"),
        ("env.tote_size=[5,5,1]", "the run began with [4, 4, 1]"),
        ("env.num_envs=4", "env.num_envs=4: the run began with 8"),
        ("env.effector_size=[2,3]", "the run began with [3, 3]"),
        ("env.min_support=1.0", "env.min_support=1.0: the run began with 0.5"),
        ("env.pick_rule=overlap", "the run began with contain"),
        ("items.kinds=[[1,1,1]]", "items={"),
        ("algo.mask_infeasible=false", "the run began with True"),
        ("model.actor.filters=16", "does not fit"),
        ("curriculum=paper", "cannot be exchanged"),
        ("+algo.gama=0.9", "did you mean 'gamma'?"),
        ("algo.lr=1,2", "one value"),
        ("algo.lr", "<key>=<value>"),
        ("~algo.lr", "<key>=<value>"),
        ("total_frames=100", "total_frames=100: the run has trained 512 frames already; expected more"),
    ],
)
def test_incompatible_resume_is_refused_and_changes_nothing(run, smoke_run, override, message):
    files = {path: path.read_bytes() for path in smoke_run.rglob("*") if path.is_file() and path.suffix != ".log"}
    code, _, err = run("train", f"resume={smoke_run}", "total_frames=1024", override)
    assert code == 2
    assert message in err and err.count("\n") == 1
    assert files == {path: path.read_bytes() for path in files}


@pytest.mark.parametrize(
    "damage", ["truncate", "flip", "remove", "facts", "schema", "target", "state", "config", "frames", "no policy"]
)
def test_damaged_checkpoints_are_refused(run, smoke_run, tmp_path, damage):
    folder = tmp_path / "copy"
    folder.mkdir()
    for name in (checkpoint.TENSORS, checkpoint.FACTS):
        (folder / name).write_bytes((smoke_run / "checkpoints" / "last" / name).read_bytes())
    tensors, facts = folder / checkpoint.TENSORS, folder / checkpoint.FACTS
    if damage == "truncate":
        tensors.write_bytes(tensors.read_bytes()[:-10])
    elif damage == "flip":
        blob = bytearray(tensors.read_bytes())
        blob[len(blob) // 2] ^= 1
        tensors.write_bytes(blob)
    elif damage == "remove":
        tensors.unlink()
    elif damage == "facts":
        facts.write_text(facts.read_text()[:-20])
    else:
        content = json.loads(facts.read_text())
        if damage == "schema":
            content["schema"] = 99
        elif damage in ("state", "frames"):
            del content[damage]
        elif damage == "config":
            content["config"] = []
        elif damage == "no policy":
            tensors = folder / checkpoint.TENSORS
            tensors.write_bytes(save({"other": torch.zeros(1)}))
            content["sha256"] = hashlib.sha256(tensors.read_bytes()).hexdigest()
        else:
            content["config"]["model"]["actor"]["_target_"] = "os.system"
        facts.write_text(json.dumps(content))
    code, _, err = run("evaluate", f"checkpoint={folder}")
    assert code == 2 and err.startswith("error: ") and err.count("\n") == 1


@pytest.mark.parametrize(
    "search", [["lookahead", "planner.samples=2", "planner.rounds=1"], ["mcts", "planner.simulations=8"]]
)
def test_evaluation_of_a_search(search, run, smoke_run, tmp_path):
    arguments = [f"planner={search[0]}", *search[1:], f"checkpoint={smoke_run}", "evaluation.episodes=2"]
    code, _, err = run("evaluate", *arguments, "evaluation.latency_decisions=0", "hydra.run.dir=result")
    assert code == 0, err
    result = json.loads((tmp_path / "result" / "evaluation.json").read_text())
    assert result["planner"] == search[0] and 0 < result["occupancy"]["mean"] <= 1
    wanted = dict(word.removeprefix("planner.").split("=") for word in search[1:])
    assert {key: str(result["planner_settings"][key]) for key in wanted} == wanted
    assert ("mean_tree_depth" in result) == (search[0] == "mcts")


def test_evaluation_of_a_run(run, smoke_run, tmp_path):
    arguments = [f"checkpoint={smoke_run}", "evaluation.episodes=6", "env.tote_size=[5,5,2]", "planner.candidates=10"]
    arguments += ["model.actor.compute_dtype=bfloat16"]
    code, out, err = run("evaluate", *arguments, "hydra.run.dir=result")
    assert code == 0, err
    assert "occupancy" in out
    result = json.loads((tmp_path / "result" / "evaluation.json").read_text())
    assert set(result) >= {
        "planner", "env", "episodes", "seed", "occupancy", "items_placed", "failures", "feasible_action_share",
        "latency_ms", "versions", "commit", "mask_in_training", "mask_at_decision", "candidates",
    }  # fmt: skip
    assert set(result["occupancy"]) == {"mean", "ci95", "min", "per_episode"}
    assert len(result["occupancy"]["per_episode"]) == 6
    assert result["env"]["tote_size"] == [5, 5, 2] and result["candidates"] == 10
    assert result["mask_in_training"] is True and result["mask_at_decision"].startswith("failed picks")
    assert {path.name for path in (tmp_path / "result").iterdir()} >= {"tote.png", "evaluation.md"}


def test_a_tote_that_did_not_grow_is_told(run):
    settings = ["experiment=smoke", "env.tote_size=[4,4,2]", "curriculum.start_height=1", "curriculum.advance.window=4"]
    for needed, told in ((1.0, True), (0.0, False)):
        threshold = [f"curriculum.advance.occupancy={needed}", f"hydra.run.dir={needed}"]
        code, out, err = run("train", *settings, "curriculum=adaptive", *threshold)
        assert code == 0, err
        assert ("the tote grew to height 1 of 2 only" in out) == told


def test_sweep_and_own_curriculum(run, tmp_path):
    folder = tmp_path / "mine" / "curriculum"
    folder.mkdir(parents=True)
    (folder / "mine.yaml").write_text(
        "defaults:\n  - advance: threshold\n  - sample: recent\n  - _self_\n"
        "_target_: pickplace.training.curriculum.Curriculum\nstart_height: 1\nend_height: null\n"
        "advance: {occupancy: 0.1, window: 5}\n"
    )
    settings = ["experiment=smoke", "curriculum=mine", "env.tote_size=[4,4,2]", "hydra.sweep.dir=sweep"]
    code, _, err = run("train", "-m", "seed=0,1", *settings, "--config-dir", str(tmp_path / "mine"))
    assert code == 0, err
    for job in ("0", "1"):
        assert (tmp_path / "sweep" / job / "checkpoints" / "last").is_dir()


@pytest.mark.parametrize(
    "command",
    [[sys.executable, "-m", "pickplace.training.train"], [str(Path(sys.executable).with_name("pickplace-evaluate"))]],
    ids=["module", "script"],
)
def test_help_from_any_directory(command, tmp_path):
    result = subprocess.run([*command, "--help"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "env: deep_bin, paper" in result.stdout
    assert list(tmp_path.iterdir()) == []


def test_paired_difference(run, tmp_path):
    settings = ["env.tote_size=[4,4,1]", "evaluation.episodes=20", "evaluation.latency_decisions=0"]
    assert run("evaluate", "planner=random", *settings, "hydra.run.dir=a")[0] == 0
    code, out, err = run("evaluate", "planner=joint_dbl", *settings, "hydra.run.dir=b", "compare=a/evaluation.json")
    assert code == 0, err
    a, b = (json.loads((tmp_path / name / "evaluation.json").read_text()) for name in "ab")
    paired = b["paired_difference"]
    assert paired["against"] == "random" and "minus random" in out
    assert paired["mean"] == pytest.approx(b["occupancy"]["mean"] - a["occupancy"]["mean"])
    assert paired["ci95"][0] < paired["mean"] < paired["ci95"][1]
    code, _, err = run("evaluate", "planner=joint_dbl", *settings, "evaluation.seed=1", "compare=a/evaluation.json")
    assert code == 2 and "its seed is 0, expected 1" in err


def test_only_the_same_episodes_are_compared(run):
    settings = ["env.tote_size=[4,4,1]", "evaluation.episodes=2", "evaluation.latency_decisions=0", "planner=joint_dbl"]
    assert run("evaluate", *settings, "hydra.run.dir=a")[0] == 0
    for key, value in (
        ("env.rotations", 2), ("env.effector_size", [2, 3]), ("env.bin_size", [5, 4, 1]), ("env.tote_size", [4, 5, 1]),
        ("env.pick_rule", "overlap"), ("env.min_support", 0.25), ("env.strict_support", True),
        ("evaluation.episodes", 3), ("evaluation.stream", "validation"), ("items", "mixed"),
    ):  # fmt: skip
        more = ["env.tote_size=[7,7,3]"] if key == "items" else []
        code, _, err = run("evaluate", *settings, *more, f"{key}={value}".replace(" ", ""), "compare=a/evaluation.json")
        wanted = key if key.startswith("env.") else f"its {key.removeprefix('evaluation.')} is"
        assert code == 2 and wanted in err, (key, err)
