"""A run that is killed and resumed equals one that never was, bit for bit, with both collectors."""

import html
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch
from omegaconf import OmegaConf

from pickplace.runs import checkpoint
from pickplace.runs.loggers import read_csv
from pickplace.training.train import resume_run, train
from pickplace.training.trainer import Trainer

ITERATION = 8 * 16  # frames: env.num_envs * algo.rollout_length of experiment=smoke
SETTINGS = [
    "experiment=smoke",
    "env.tote_size=[5,5,3]",
    "curriculum=mixture",  # its sampler draws, so the generators matter
    "curriculum.advance.occupancy=0.3",
    "curriculum.advance.window=10",
    "warm_start=imitate",
    "planner@warm_start.teacher=random",  # a teacher that draws
    f"warm_start.frames={6 * ITERATION}",
    f"warm_start.critic_frames={3 * ITERATION}",
    f"total_frames={24 * ITERATION}",
    f"checkpoint_interval={3 * ITERATION}",
    f"evaluation_interval={10 * ITERATION}",
    "evaluation.episodes=4",
    "threads=1",
]


def start(*overrides, own_group=False):
    """A training process of its own."""
    command = [sys.executable, "-m", "pickplace.training.train", *overrides]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0 if own_group else None,
    )


def finish(process):
    """Wait for a process that must succeed; returns what it printed."""
    out, err = process.communicate(timeout=240)
    assert process.returncode == 0, err
    return out


def wait_for_rows(process, run_dir, count):
    """Wait until ``metrics.csv`` has so many rows."""
    path = run_dir / "metrics.csv"
    for _ in range(120_000):
        if path.is_file() and path.read_bytes().count(b"\n") > count:
            return
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.001)
    raise AssertionError("no metrics appeared")


def outcome(run_dir):
    """Everything that must be equal: tensors, counters, curriculum, metrics without timings."""
    state, facts = checkpoint.read(run_dir / "checkpoints" / "last")
    rows = [{k: v for k, v in row.items() if not k.startswith("time/")} for row in read_csv(run_dir / "metrics.csv")]
    return checkpoint.flatten(state), {k: facts[k] for k in ("frames", "iteration", "best", "curriculum")}, rows


def assert_same(run_a, run_b):
    (tensors_a, rest_a), facts_a, rows_a = outcome(run_a)
    (tensors_b, rest_b), facts_b, rows_b = outcome(run_b)
    assert tensors_a.keys() == tensors_b.keys()
    for key, value in tensors_a.items():
        assert torch.equal(value, tensors_b[key]), key
    assert rest_a == rest_b
    assert facts_a == facts_b
    assert rows_a == rows_b


@pytest.fixture(scope="module", params=["single", "multi_sync"])
def reference(request, tmp_path_factory):
    """A run that nothing disturbed, and its settings."""
    run_dir = tmp_path_factory.mktemp(request.param) / "reference"
    settings = [*SETTINGS, f"collector={request.param}"]
    finish(start(*settings, f"hydra.run.dir={run_dir}"))
    return run_dir, settings


def test_the_reference_really_trains(reference):
    run_dir, _ = reference
    rows = read_csv(run_dir / "metrics.csv")
    assert [row["frames"] for row in rows] == [ITERATION * (i + 1) for i in range(24)]
    assert rows[0]["curriculum/level"] < rows[-1]["curriculum/level"]
    assert sum("eval/occupancy" in row for row in rows) == 3  # at 10, 20 and 24 iterations


def test_killed_and_resumed_equals_uninterrupted(reference, tmp_path):
    reference_dir, settings = reference
    run_dir = tmp_path / "killed"
    process = start(*settings, f"hydra.run.dir={run_dir}")
    wait_for_rows(process, run_dir, 5)  # beyond the checkpoint of iteration 3
    process.kill()
    process.wait()
    saved = json.loads((checkpoint.locate(run_dir, "last") / checkpoint.FACTS).read_text())["frames"]
    assert ITERATION <= saved < 24 * ITERATION
    finish(start(f"resume={run_dir}"))
    assert_same(reference_dir, run_dir)


def test_a_run_killed_before_its_first_last_goes_on_from_best(reference, tmp_path):
    reference_dir, _ = reference
    run_dir = tmp_path / "run"
    shutil.copytree(reference_dir, run_dir)
    shutil.rmtree(run_dir / "checkpoints/last")
    with pytest.raises(checkpoint.CheckpointError, match="no best checkpoint there; expected checkpoint=.*/previous"):
        shutil.copytree(run_dir, tmp_path / "other")
        shutil.rmtree(tmp_path / "other/checkpoints/best")
        checkpoint.locate(tmp_path / "other")
    shutil.rmtree(run_dir / "checkpoints/previous")
    finish(start(f"resume={run_dir}"))
    assert_same(reference_dir, run_dir)


def test_a_new_run_where_another_has_been_is_refused(reference, tmp_path):
    """Before anything in the folder is changed, Hydra's notes included."""
    reference_dir, settings = reference
    run_dir = tmp_path / "run"
    shutil.copytree(reference_dir, run_dir)
    before = {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()}
    process = start(*settings, "seed=7", f"hydra.run.dir={run_dir}")
    error = process.communicate(timeout=240)[1]
    assert process.returncode == 2
    sentence = f"error: {run_dir}: there is a training already; expected another run folder, or resume={run_dir}."
    assert error.strip().splitlines()[-1] == sentence
    assert {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()} == before
    with pytest.raises(ValueError, match="there is a training already"):
        train(OmegaConf.create({"resume": None}), run_dir)


def test_a_job_of_a_sweep_that_is_started_again_goes_on(tmp_path):
    """As after a preemption; with another config it is refused, and what is there has not failed."""
    sweep = ["-m", *SETTINGS, f"hydra.sweep.dir={tmp_path}", "seed=0"]
    process = start(*sweep)
    wait_for_rows(process, tmp_path / "0", 5)
    process.kill()
    process.wait()
    out = finish(start(*sweep))
    assert f"going on with {tmp_path / '0'} at " in out
    state = outcome(tmp_path / "0")
    assert state[1]["frames"] == 24 * ITERATION
    process = start(*sweep, "algo.lr=1e-4")
    assert "there is a training already" in process.communicate(timeout=240)[1]
    assert process.returncode == 2 and not (tmp_path / "0" / "failure.txt").exists()
    assert outcome(tmp_path / "0")[1:] == state[1:]


def test_a_report_that_was_cut_short_is_written_by_a_resume(reference, tmp_path):
    reference_dir, _ = reference
    run_dir = tmp_path / "run"
    shutil.copytree(reference_dir, run_dir)
    (run_dir / "report.html").unlink()
    finish(start(f"resume={run_dir}", "algo.epochs=3"))
    text = html.unescape((run_dir / "report.html").read_text())
    assert "\n\nChanged when it was resumed: algo.epochs=3</pre>" in text
    finish(start(f"resume={run_dir}"))
    assert html.unescape((run_dir / "report.html").read_text()) == text  # nothing new to tell


def test_sigterm_saves_and_a_resume_goes_on_exactly(reference, tmp_path):
    reference_dir, settings = reference
    run_dir = tmp_path / "stopped"
    process = start(*settings, f"hydra.run.dir={run_dir}")
    wait_for_rows(process, run_dir, 4)
    process.send_signal(signal.SIGTERM)
    out = finish(process)
    assert f"resume={run_dir}" in out
    rows = read_csv(run_dir / "metrics.csv")
    saved = json.loads((run_dir / "checkpoints/last" / checkpoint.FACTS).read_text())["frames"]
    assert rows[-1]["frames"] == saved < 24 * ITERATION
    finish(start(f"resume={run_dir}"))
    assert_same(reference_dir, run_dir)


def test_a_stop_request_to_the_whole_process_group_saves(reference, tmp_path):
    """As schedulers and ``timeout`` send it: workers get the signal too, and leave the stopping to the main process."""
    _, settings = reference
    run_dir = tmp_path / "group"
    process = start(*settings, f"hydra.run.dir={run_dir}", own_group=True)
    wait_for_rows(process, run_dir, 4)
    os.killpg(process.pid, signal.SIGTERM)
    assert f"resume={run_dir}" in finish(process)
    saved = json.loads((run_dir / "checkpoints/last" / checkpoint.FACTS).read_text())["frames"]
    assert saved == read_csv(run_dir / "metrics.csv")[-1]["frames"] < 24 * ITERATION


def test_a_stop_request_ends_a_sweep(tmp_path):
    sweep = tmp_path / "sweep"
    process = start("-m", "seed=0,1", *[s for s in SETTINGS if "total_frames" not in s], f"hydra.sweep.dir={sweep}")
    wait_for_rows(process, sweep / "0", 2)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=120)
    assert process.returncode == 130
    assert (sweep / "0" / "checkpoints" / "last").is_dir() and not (sweep / "1").exists()


@pytest.mark.parametrize("changed", [["algo.lr=0"], []])
def test_a_best_that_the_run_never_had_is_replaced(changed, smoke, tmp_path, monkeypatch):
    """Of a course that was given up, when a run goes on with other settings; with the same it comes there again."""
    run_dir, before = tmp_path / "run", []
    smoke(run_dir, "checkpoint_interval=128", "total_frames=896")
    state, facts = checkpoint.read(run_dir / "checkpoints/previous")
    assert facts["frames"] == 768  # so that no validation follows at once
    checkpoint.write(run_dir / "checkpoints/previous", state, {**facts, "best": 0.99})
    checkpoint.write(run_dir / "checkpoints/best", state, {**facts, "frames": 896, "best": 0.995})
    validate = Trainer.validate

    def watched(*args, **kwargs):
        before.append(checkpoint.read(run_dir / "checkpoints/best")[1]["frames"])
        return validate(*args, **kwargs)

    monkeypatch.setattr(Trainer, "validate", watched)
    resume_run([f"resume={run_dir}/checkpoints/previous", *changed])
    best = checkpoint.read(run_dir / "checkpoints/best")[1]
    validated = {row["frames"]: row.get("eval/occupancy") for row in read_csv(run_dir / "metrics.csv")}
    assert before[0] == 896
    if changed:
        assert validated[best["frames"]] == pytest.approx(best["best"]) and best["best"] < 0.99
    else:
        assert (best["frames"], best["best"]) == (896, 0.995)


def test_resume_with_a_longer_budget(reference):
    run_dir, _ = reference
    finish(start(f"resume={run_dir}", f"total_frames={26 * ITERATION}"))
    rows = read_csv(run_dir / "metrics.csv")
    assert [row["frames"] for row in rows] == [ITERATION * (i + 1) for i in range(26)]
