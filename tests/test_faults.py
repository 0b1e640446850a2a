"""What goes wrong on shared machines overnight: nothing is lost, and one sentence says what to do."""

import csv
import multiprocessing
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from test_resume import start, wait_for_rows
from torchrl._utils import _check_for_faulty_process
from torchrl.collectors import RandomPolicy
from torchrl.envs import TransformedEnv

from pickplace import PickPlaceEnv, Planner
from pickplace.evaluation.evaluate import main as evaluate_main
from pickplace.runs import checkpoint
from pickplace.runs import hydra_app as config
from pickplace.runs.hydra_app import WorkerDied
from pickplace.runs.resume import claim, saying_what_is_safe
from pickplace.training import collectors as collector
from pickplace.training.collectors import ignore_signals, watch_workers
from pickplace.training.train import main as train_main
from pickplace.training.train import resume_run

ENDLESS = ["experiment=smoke", "total_frames=10_000_000", "threads=1"]


def test_a_dead_worker_ends_the_run_in_one_sentence(tmp_path):
    run_dir = tmp_path / "run"
    process = start(*ENDLESS, "collector=multi_sync", f"hydra.run.dir={run_dir}")
    try:
        wait_for_rows(process, run_dir, 4)
        children = subprocess.run(["pgrep", "-f", "-P", str(process.pid), "spawn_main"], capture_output=True, text=True)
        os.kill(int(children.stdout.split()[-1]), signal.SIGKILL)
        _, error = process.communicate(timeout=240)
    finally:
        process.kill()
    assert process.returncode == 2
    sentence = error.strip().splitlines()[-1]
    assert sentence.startswith("error: collector worker 2 of 2 has died (exit code -9). What was saved before")
    assert f" is whole: pickplace-train resume={run_dir}/checkpoints/" in sentence
    assert checkpoint.read(run_dir / "checkpoints" / "last")


def slots(first: int, count: int) -> TransformedEnv:
    return TransformedEnv(PickPlaceEnv(num_envs=count, first_episode=first))


def test_workers_that_cannot_begin_are_ended():
    """Left behind, they would keep the command from ending."""
    before = set(multiprocessing.active_children())
    policy = RandomPolicy(PickPlaceEnv(num_envs=2).action_spec)
    with pytest.raises(ValueError, match="seed=-1"):
        collector.multi_sync(slots, policy, num_envs=4, rollout_length=2, seed=-1)
    assert set(multiprocessing.active_children()) <= before


@pytest.mark.parametrize("seed", [2**62 - 1, 20_000_000_000_000])
def test_any_seed_is_one_for_the_workers(seed):
    seeds = collector._seeds(seed, 3)
    assert {item_seed for item_seed, _ in seeds} == {seed}
    assert len({torch.Generator().manual_seed(own).initial_seed() for _, own in seeds}) == 3


def test_a_worker_s_death_is_told_until_it_is_heard():
    """A logger or a finalizer swallows what is raised while it runs."""
    worker = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600,))
    worker.start()
    with pytest.raises(WorkerDied, match="1 of 1 has died"), watch_workers(SimpleNamespace(procs=[worker])):
        worker.kill()
        with suppress(WorkerDied):
            time.sleep(60)
        time.sleep(60)
    time.sleep(0.6)  # and not once we have left


def work(deaf, ready):
    if deaf:
        ignore_signals()
    ready.release()
    time.sleep(60)


@pytest.mark.parametrize("deaf", [True, False])
def test_a_worker_s_death_that_torchrl_sees_first_is_told(deaf):
    """Our signal handler keeps out of an error's handling, and TorchRL ends the other workers its own way."""
    spawn = multiprocessing.get_context("spawn")
    ready = spawn.Semaphore(0)
    workers = [spawn.Process(target=work, args=(deaf, ready), daemon=True) for _ in range(2)]
    for worker in workers:
        worker.start()
    for _ in workers:
        assert ready.acquire(timeout=240)
    with (
        pytest.raises(WorkerDied, match=r"1 of 2 has died \(exit code -9\)"),
        watch_workers(SimpleNamespace(procs=workers)),
    ):
        try:
            raise queue.Empty
        except queue.Empty:
            workers[0].kill()
            workers[0].join()
            _check_for_faulty_process(workers)


def test_a_second_process_in_the_same_run_folder_is_refused(tmp_path):
    run_dir = tmp_path / "run"
    started = [first := start(*ENDLESS, f"hydra.run.dir={run_dir}")]
    try:
        while not (run_dir / config.LOCK).exists():  # so early that nothing else is there
            time.sleep(0.01)
        started.append(start(*ENDLESS, f"hydra.run.dir={run_dir}"))
        assert "another process" in started[-1].communicate(timeout=240)[1]
        wait_for_rows(first, run_dir, 4)
        for arguments in ([f"resume={run_dir}"], [*ENDLESS, f"hydra.run.dir={run_dir}"]):
            started.append(second := start(*arguments))
            _, error = second.communicate(timeout=240)
            assert second.returncode == 2
            assert error.strip().splitlines()[-1] == (
                f"error: {run_dir}: another process is training there; expected another run folder, or to wait for it."
            )
        assert first.poll() is None
    finally:
        for process in started:
            process.kill()
            process.wait()
    with claim(run_dir):  # a killed process holds nothing
        pass


def test_a_loss_that_is_not_finite_stops_the_run_with_a_summary(smoke, tmp_path):
    with pytest.raises(FloatingPointError) as caught:
        smoke(tmp_path / "run", "algo.reward_scale=1e38")
    message = str(caught.value)
    assert message.startswith("the loss or its gradient is not finite: loss_")
    assert "advantage" in message and "not finite)" in message
    assert message.endswith("Nothing had been saved before.")
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.parametrize("error", [ValueError("level=9"), RuntimeError("out of memory"), TypeError("no")])
def test_whatever_ends_a_training_names_the_checkpoint(error, tmp_path):
    told = pytest.raises(ValueError, match=f"{error}.*What was saved before is whole: .* resume={tmp_path}$")
    with told, saying_what_is_safe(lambda: tmp_path):
        raise error


def test_a_full_disk_ends_the_run_and_the_checkpoint_before_is_whole(smoke, tmp_path, monkeypatch):
    run_dir, synced, fsync = tmp_path / "run", [], os.fsync

    def full(number):
        synced.append(number)
        if len(synced) > 4:  # the third save: best and last of the first 256 frames went well
            raise OSError(28, "No space left on device")
        fsync(number)

    monkeypatch.setattr(checkpoint.os, "fsync", full)
    with pytest.raises(checkpoint.CheckpointError, match="cannot be written .*No space left.*resume=.*last$"):
        smoke(run_dir, "total_frames=2048")
    monkeypatch.undo()
    assert checkpoint.read(run_dir / "checkpoints" / "last")[1]["frames"] == 256
    assert not [path for path in (run_dir / "checkpoints").iterdir() if path.name.startswith(".")]


def test_a_full_disk_at_the_metrics_names_the_file_and_the_checkpoint(smoke, tmp_path, monkeypatch):
    run_dir, write = tmp_path / "run", csv.DictWriter.writerow

    def full(writer, row):
        if isinstance(row["frames"], int) and row["frames"] > 300:
            raise OSError(28, "No space left on device")
        return write(writer, row)

    monkeypatch.setattr(csv.DictWriter, "writerow", full)
    words = rf"No space left on device: '{run_dir}/metrics.csv'. What was saved before is whole: .*resume={run_dir}/"
    with pytest.raises(ValueError, match=words):
        smoke(run_dir, "total_frames=2048")
    assert checkpoint.read(run_dir / "checkpoints" / "last")[1]["frames"] == 256


@pytest.fixture(scope="module")
def finished(smoke, tmp_path_factory):
    """A run with a checkpoint that is whole under each name."""
    run_dir = tmp_path_factory.mktemp("finished") / "run"
    smoke(run_dir, "total_frames=1024", "evaluation_interval=1024")
    assert sorted(path.name for path in (run_dir / "checkpoints").iterdir()) == ["best", "last", "previous"]
    return run_dir


@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_a_damaged_checkpoint_is_refused_and_a_whole_one_is_offered(finished, tmp_path, damage):
    run_dir = tmp_path / "run"
    shutil.copytree(finished, run_dir)
    tensors = run_dir / "checkpoints" / "last" / checkpoint.TENSORS
    blob = bytearray(tensors.read_bytes())
    blob[len(blob) // 2] ^= 1
    if damage == "remove":
        tensors.unlink()
    else:
        tensors.write_bytes(blob if damage == "flip" else blob[:-1])
    with pytest.raises(checkpoint.CheckpointError, match=f"{run_dir}/checkpoints/best, at 1,024 frames, is whole.$"):
        resume_run([f"resume={run_dir}"])
    (run_dir / "checkpoints" / "best" / checkpoint.FACTS).unlink()
    with pytest.raises(checkpoint.CheckpointError, match=f"{run_dir}/checkpoints/previous, at 768 frames, is whole.$"):
        resume_run([f"resume={run_dir}"])
    resume_run([f"resume={run_dir}/checkpoints/previous", "total_frames=1280"])
    assert checkpoint.read(run_dir / "checkpoints" / "last")[1]["frames"] == 1280


@pytest.fixture
def read_only(finished):
    """A finished run in a folder where nothing can be written, not even by root."""
    with tempfile.TemporaryDirectory() as base:  # pytest's own folders are closed to other users
        run_dir = Path(base) / "run"
        shutil.copytree(finished, run_dir)
        for path in (Path(base), run_dir, *run_dir.rglob("*")):
            path.chmod(0o555 if path.is_dir() else 0o444)
        user = os.geteuid()
        try:
            if user == 0:
                os.seteuid(65534)
                if not all(
                    os.access(place, os.R_OK | os.X_OK, effective_ids=True) for place in (config.conf_dir(), sys.prefix)
                ):
                    pytest.skip("another user cannot read the package, and root may write anywhere")
            yield run_dir
        finally:
            os.seteuid(user)
            for path in (Path(base), run_dir, *run_dir.rglob("*")):
                path.chmod(0o755)


@pytest.mark.parametrize(
    ("main", "arguments", "name"),
    [
        (train_main, ["resume={}", "total_frames=1280"], ".lock"),
        (train_main, ["experiment=smoke", "hydra.run.dir={}"], "train.log"),
        (train_main, ["experiment=smoke", "hydra.run.dir={}/below"], "below"),
        (evaluate_main, ["planner=random", "hydra.run.dir={}"], "evaluate.log"),
    ],
)
def test_a_read_only_run_folder_is_named(read_only, monkeypatch, capsys, main, arguments, name):
    monkeypatch.setattr(sys, "argv", ["pickplace", *(word.format(read_only) for word in arguments)])
    before = {path: path.read_bytes() for path in read_only.rglob("*") if path.is_file()}
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    expected = f"error: {read_only}/{name}: Permission denied; expected a place where you may read and write.\n"
    assert capsys.readouterr().err == expected
    assert before == {path: path.read_bytes() for path in read_only.rglob("*") if path.is_file()}


def test_a_read_only_run_can_be_evaluated_from_elsewhere(read_only):
    Planner.load(read_only)


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
        ("collector|carried|outcome_mask", None, "carried|outcome_mask is missing, expected bool"),
        ("collector|carried|tote_depth", torch.zeros(8, 4, 9), "tote_depth is float32 of shape (8, 4, 9)"),
        (
            "collector|environment|heights",
            torch.zeros(8, 4, 4),
            "of shape (8, 4, 4), expected int32",
        ),
        ("collector|counters|frames", None, "counters|frames is missing"),
        ("policy", torch.zeros(3), "no policy"),
    ],
)
def test_a_checkpoint_that_no_training_wrote_is_not_resumed(finished, tmp_path, part, value, words):
    """With the right checksum; what was there before stays as it was."""
    run_dir = tmp_path / "run"
    shutil.copytree(finished, run_dir)
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
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert before == {path: path.read_bytes() for path in before}


def test_chaos_in_short(tmp_path):
    """``make chaos`` kills it a hundred times, with either collector."""
    result = subprocess.run(
        [sys.executable, str(Path(__file__).parent / "chaos.py"), "4"],
        env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert "killed 4 times" in result.stdout
