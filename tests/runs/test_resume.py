"""A run that is killed, stopped and resumed equals one that never was, bit for bit, with either collector."""

import html
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import commands
import pytest
import torch
from commands import ITERATION, SETTINGS, Training, assert_same, composed, state_of
from omegaconf import OmegaConf

from pickplace.runs import checkpoint
from pickplace.runs.folder import claim
from pickplace.runs.loggers import read_csv
from pickplace.runs.references import saved_form
from pickplace.runs.resume import checkpoint_config, checkpoint_hint, resumed_config
from pickplace.training import train as train_module
from pickplace.training.train import resume_run, train


def saved_frames(run_dir):
    return json.loads((checkpoint.locate(run_dir, "last") / checkpoint.FACTS).read_text())["frames"]


@pytest.fixture(scope="module")
def references(tmp_path_factory):
    """Undisturbed runs with either collector, made when first asked for."""
    folder = tmp_path_factory.mktemp("references")

    def reference(collector):
        if not (folder / collector).exists():
            Training(*SETTINGS, f"collector={collector}", f"hydra.run.dir={folder / collector}").finish()
        return folder / collector

    return reference


@pytest.fixture
def reference(references, tmp_path):
    """A copy of the undisturbed run with one process."""
    return shutil.copytree(references("single"), tmp_path / "reference")


@pytest.mark.parametrize("collector", ["single", "multi_sync"])
def test_a_run_that_is_killed_and_stopped_equals_an_undisturbed_one(collector, references, tmp_path):
    run_dir = tmp_path / "disturbed"
    first = Training(*SETTINGS, f"collector={collector}", f"hydra.run.dir={run_dir}")
    first.wait_for_rows(run_dir, 5)  # beyond the checkpoint of iteration 3
    first.kill()
    assert ITERATION <= saved_frames(run_dir) < 24 * ITERATION
    rows = len(read_csv(run_dir / "metrics.csv"))
    # A scheduler sends SIGTERM to the whole group: workers leave the stopping to the main process.
    second = Training(f"resume={run_dir}", own_group=True)
    second.wait_for_rows(run_dir, rows + 2)
    os.killpg(second.pid, signal.SIGTERM)
    assert f"continue with: pickplace-train resume={run_dir}" in second.finish()
    assert read_csv(run_dir / "metrics.csv")[-1]["frames"] == saved_frames(run_dir) < 24 * ITERATION
    Training(f"resume={run_dir}").finish()
    assert_same(references(collector), run_dir)


def test_the_reference_really_trains(reference):
    rows = read_csv(reference / "metrics.csv")
    assert [row["frames"] for row in rows] == [ITERATION * (i + 1) for i in range(24)]
    assert rows[0]["curriculum/level"] < rows[-1]["curriculum/level"]
    assert sum("eval/occupancy" in row for row in rows) == 3  # at 10, 20 and 24 iterations


def test_a_run_killed_before_its_first_last_resumes_from_best(references, reference):
    shutil.rmtree(reference / "checkpoints/last")
    shutil.rmtree(reference / "checkpoints/previous")
    Training(f"resume={reference}").finish()
    assert_same(references("single"), reference)


def test_a_new_run_in_a_used_folder_is_refused(run, reference):
    """Before anything in the folder is changed, Hydra's notes included."""
    before = {path: path.read_bytes() for path in reference.rglob("*") if path.is_file()}
    code, _, err = run("train", *SETTINGS, "seed=7", f"hydra.run.dir={reference}")
    sentence = f"error: {reference}: there is a training already; expected another run folder, or resume={reference}."
    assert code == 2 and err.strip().splitlines()[-1] == sentence
    assert {path: path.read_bytes() for path in reference.rglob("*") if path.is_file()} == before
    with pytest.raises(ValueError, match="there is a training already"):
        train(OmegaConf.create({"resume": None}), reference)


def test_a_job_of_a_sweep_that_is_started_again_goes_on(tmp_path):
    """As after a preemption. With another config it is refused, which is no failure of the run that is there."""
    sweep = ["-m", *SETTINGS, f"hydra.sweep.dir={tmp_path}", "seed=0"]
    process = Training(*sweep)
    process.wait_for_rows(tmp_path / "0", 5)
    process.kill()
    assert f"going on with {tmp_path / '0'} at " in Training(*sweep).finish()
    state = state_of(tmp_path / "0")
    assert state[1]["frames"] == 24 * ITERATION
    code, _, err = Training(*sweep, "algo.lr=1e-4").end()
    assert code == 2 and "there is a training already" in err
    assert not (tmp_path / "0" / "failure.txt").exists()
    assert state_of(tmp_path / "0")[1:] == state[1:]


def test_a_stop_request_ends_a_sweep(tmp_path):
    settings = [word for word in SETTINGS if "total_frames" not in word]
    process = Training("-m", "seed=0,1", *settings, f"hydra.sweep.dir={tmp_path}")
    process.wait_for_rows(tmp_path / "0", 2)
    os.kill(process.pid, signal.SIGINT)
    assert process.end()[0] == 130
    assert (tmp_path / "0" / "checkpoints" / "last").is_dir() and not (tmp_path / "1").exists()


def test_a_missing_report_is_written_on_resume(reference):
    (reference / "report.html").unlink()
    resume_run([f"resume={reference}", "algo.epochs=3"])
    text = html.unescape((reference / "report.html").read_text())
    assert "\n\nChanged when it was resumed: algo.epochs=3</pre>" in text
    resume_run([f"resume={reference}"])
    assert html.unescape((reference / "report.html").read_text()) == text


def test_resume_with_a_longer_budget(reference):
    resume_run([f"resume={reference}", f"total_frames={26 * ITERATION}"])
    rows = read_csv(reference / "metrics.csv")
    assert [row["frames"] for row in rows] == [ITERATION * (i + 1) for i in range(26)]


@pytest.mark.parametrize("changed", [["algo.lr=0"], []])
def test_a_stale_best_is_replaced_if_the_config_has_changed(changed, smoke, tmp_path, monkeypatch):
    """With the same config the run comes to that best again."""
    run_dir, before = tmp_path / "run", []
    smoke(run_dir, "checkpoint_interval=128", "total_frames=896")
    state, facts = checkpoint.read(run_dir / "checkpoints/previous")
    assert facts["frames"] == 768  # so that no validation follows at once
    checkpoint.write(run_dir / "checkpoints/previous", state, {**facts, "best": 0.99})
    checkpoint.write(run_dir / "checkpoints/best", state, {**facts, "frames": 896, "best": 0.995})
    validate = train_module.validate

    def watched(*args, **kwargs):
        before.append(checkpoint.read(run_dir / "checkpoints/best")[1]["frames"])
        return validate(*args, **kwargs)

    monkeypatch.setattr(train_module, "validate", watched)
    resume_run([f"resume={run_dir}/checkpoints/previous", *changed])
    best = checkpoint.read(run_dir / "checkpoints/best")[1]
    validated = {row["frames"]: row.get("eval/occupancy") for row in read_csv(run_dir / "metrics.csv")}
    assert before[0] == 896
    if changed:
        assert validated[best["frames"]] == pytest.approx(best["best"]) and best["best"] < 0.99
    else:
        assert (best["frames"], best["best"]) == (896, 0.995)


@pytest.fixture(scope="module")
def finished(smoke, tmp_path_factory):
    """A run with a whole checkpoint under each name."""
    run_dir = tmp_path_factory.mktemp("finished") / "run"
    smoke(run_dir, "total_frames=512", "evaluation_interval=512")
    assert sorted(path.name for path in (run_dir / "checkpoints").iterdir()) == ["best", "last", "previous"]
    return run_dir


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["env.rotations=1"], "env.rotations=1: the run began with 4"),
        (["env.tote_size=[5,5,1]"], "the run began with [4, 4, 1]"),
        (["env.num_envs=4"], "env.num_envs=4: the run began with 8"),
        (["env.effector_size=[2,3]"], "the run began with [3, 3]"),
        (["env.min_support=1.0"], "env.min_support=1.0: the run began with 0.5"),
        (["env.pick_rule=overlap"], "the run began with contain"),
        (["items.kinds=[[1,1,1]]"], "items={"),
        (["algo.mask_infeasible=false"], "the run began with True"),
        (["model.actor.filters=16"], "does not fit"),
        (["curriculum=paper"], "cannot be exchanged"),
        (["+algo.gama=0.9"], "did you mean 'gamma'?"),
        (["algo.lr=1,2"], "one value"),
        (["algo.lr"], "<key>=<value>"),
        (["~algo.lr"], "<key>=<value>"),
        (["total_frames=100"], "total_frames=100: the run has trained 512 frames already; expected more"),
    ],
)
def test_a_resume_with_other_settings_is_refused_and_changes_nothing(run, finished, overrides, message):
    files = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file() and path.suffix != ".log"}
    code, _, err = run("train", f"resume={finished}", "total_frames=1024", *overrides)
    assert code == 2 and message in err and err.count("\n") == 1
    assert files == {path: path.read_bytes() for path in files}


@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_a_damaged_checkpoint_is_refused_and_a_whole_one_is_named(finished, tmp_path, damage):
    run_dir = shutil.copytree(finished, tmp_path / "run")
    tensors = run_dir / "checkpoints" / "last" / checkpoint.TENSORS
    blob = bytearray(tensors.read_bytes())
    blob[len(blob) // 2] ^= 1
    if damage == "remove":
        tensors.unlink()
    else:
        tensors.write_bytes(blob if damage == "flip" else blob[:-1])
    with pytest.raises(checkpoint.CheckpointError, match=f"{run_dir}/checkpoints/best, at 512 frames, is whole.$"):
        resume_run([f"resume={run_dir}"])
    (run_dir / "checkpoints" / "best" / checkpoint.FACTS).unlink()
    with pytest.raises(checkpoint.CheckpointError, match=f"{run_dir}/checkpoints/previous, at 256 frames, is whole.$"):
        resume_run([f"resume={run_dir}"])
    if damage == "flip":
        resume_run([f"resume={run_dir}/checkpoints/previous"])
        assert checkpoint.read(run_dir / "checkpoints" / "last")[1]["frames"] == 512


NUMBERS = [None, "x", [], {}, float("nan"), 10**30]


@pytest.mark.parametrize(
    ("part", "value", "words"),
    [
        *(("iteration", value, "iteration is") for value in [*NUMBERS, 2.5]),
        *(("best", value, "best is") for value in NUMBERS),
        ("latest", 3, "latest is 3; expected a validation that a training wrote"),
        ("latest", {"occupancy": [1]}, "occupancy is [1]; expected a number"),
        *(("curriculum", value, "curriculum is") for value in NUMBERS),
        ("curriculum|level", 2.5, "level of the checkpoint=2.5: expected a whole number"),
        ("curriculum|frames", -1, "frames of the checkpoint=-1: expected a whole number"),
        ("curriculum|window", "abc", "window of the checkpoint='abc': expected a list"),
        ("curriculum|window", [0.5, 7], "window of the checkpoint=7: expected a number between 0 and 1"),
        ("rng", torch.zeros(5056), "rng is float32 of shape (5056,), expected uint8 of shape (5056,)"),
        ("rng", None, "rng is missing, expected uint8"),
        ("rng", torch.zeros(5056, dtype=torch.uint8), "random generator is of no use"),
        ("optimizer", None, "has no optimizer"),
        ("optimizer", {"zzz": torch.zeros(1)}, "optimizer has 'zzz'; expected numbers below"),
        ("optimizer|0|step", torch.tensor(float("inf")), "optimizer is of no use: 0|step holds values"),
        ("optimizer|0|exp_avg", torch.zeros(3), "0|exp_avg is float32 of shape (3,), expected"),
        ("critic", None, "critic does not fit"),
        ("collector", None, "environment|heights is missing"),
        ("collector|rng", torch.zeros(3), "rng is float32"),
        ("collector|carried|footprint_mask", None, "carried|footprint_mask is missing, expected bool"),
        ("collector|carried|tote_depth", torch.zeros(8, 4, 9), "tote_depth is float32 of shape (8, 4, 9)"),
        ("collector|environment|heights", torch.zeros(8, 4, 4), "of shape (8, 4, 4), expected int32"),
        ("collector|counters|frames", None, "counters|frames is missing"),
        ("policy", torch.zeros(3), "no policy"),
    ],
)
def test_a_checkpoint_that_no_training_wrote_is_not_resumed(finished, tmp_path, part, value, words):
    """With the right checksum. The files in the run folder stay as they were."""
    run_dir = shutil.copytree(finished, tmp_path / "run")
    folder = run_dir / "checkpoints" / "last"
    state, facts = checkpoint.read(folder)
    *parents, leaf = (int(word) if word.isdecimal() else word for word in part.split("|"))
    for node in (facts, state):
        for parent in parents:
            node = node.get(parent, {})
        if leaf in node:
            node[leaf] = value
            if value is None and node is not facts:
                del node[leaf]
    del facts["schema"], facts["sha256"]
    checkpoint.write(folder, state, facts)
    before = {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file() and path.suffix != ".log"}
    with pytest.raises(ValueError) as caught:
        resume_run([f"resume={run_dir}", "total_frames=1280"])
    assert words in str(caught.value) and "\n" not in str(caught.value)
    assert before == {path: path.read_bytes() for path in before}


@pytest.mark.parametrize(
    ("key", "value", "local"),
    [
        ("collector.address", "ray://192.0.2.1:1", "local"),
        ("logger.uri", "http://192.0.2.1", "null"),
        ("logger.offline", False, "true"),
    ],
)
def test_the_user_repeats_settings_that_leave_the_machine(key, value, local):
    content = saved_form(composed("experiment=quick", f"++{key}={value}"))
    facts = {"config": content, "curriculum": {}, "frames": 5, "iteration": 1, "best": 0.5, "latest": {}}
    with pytest.raises(ValueError, match=f"{key}={value}: the checkpoint would write outside .* or {key}={local}"):
        resumed_config("run", facts, [])
    assert OmegaConf.select(resumed_config("run", facts, [f"{key}={local}"]), key) != value
    _, words = checkpoint_config(OmegaConf.create(content))  # the words that a stopped run prints are enough
    assert OmegaConf.select(resumed_config("run", facts, words.split()), key) == value


@pytest.mark.parametrize("error", [ValueError("level=9"), RuntimeError("out of memory"), TypeError("no")])
def test_any_error_that_ends_a_training_names_the_checkpoint(error, tmp_path):
    words = f"{error}.*What was saved before is whole: .* resume={tmp_path}$"
    with pytest.raises(ValueError, match=words), checkpoint_hint(lambda: tmp_path):
        raise error


def test_one_process_trains_in_a_folder(tmp_path):
    run_dir = tmp_path / "run"
    endless = ["experiment=smoke", "total_frames=10_000_000", "threads=1", f"hydra.run.dir={run_dir}"]
    first = Training(*endless)
    try:
        while not (run_dir / ".lock").exists():  # so early that nothing else is there
            assert first.process.is_alive()
        taken = (
            f"error: {run_dir}: another process is training there; expected another run folder, or to wait for it.\n"
        )
        assert Training(*endless).end()[::2] == (2, taken)
        first.wait_for_rows(run_dir, 4)
        for command in ([f"resume={run_dir}"], endless):
            assert Training(*command).end()[::2] == (2, taken)
        assert first.process.is_alive()
    finally:
        first.kill()
    with claim(run_dir):  # a killed process holds nothing
        pass


def test_chaos_in_short():
    """``make chaos`` kills it a hundred times, with either collector."""
    command = [sys.executable, str(Path(commands.__file__).parent / "long" / "chaos.py"), "4"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode == 0 and "killed 4 times" in result.stdout, result.stderr
