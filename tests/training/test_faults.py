"""Faults of shared machines: nothing is lost, and one sentence says what to do."""

import csv
import multiprocessing
import os
import queue
import re
import shutil
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from commands import FORKSERVER, Training, after_batch
from torchrl._utils import _check_for_faulty_process
from torchrl.collectors import RandomPolicy
from torchrl.envs import TransformedEnv

from pickplace import PickPlaceEnv, Planner
from pickplace.common.errors import WorkerDied
from pickplace.config.words import conf_dir
from pickplace.evaluation.command import main as evaluate_main
from pickplace.runs import checkpoint
from pickplace.training import collectors
from pickplace.training.collectors import ignore_signals, watch_workers
from pickplace.training.command import main as train_main


@contextmanager
def killed_worker():
    """Kill the second worker after the third batch; no worker may be left at the end."""
    multiprocessing.set_start_method("fork", force=True)  # a process hears of the death of its own children only
    try:
        with after_batch(3, lambda trainer: trainer.collector.procs[1].kill()):
            yield
    finally:
        assert not multiprocessing.active_children()


def test_a_dead_worker_ends_the_run_in_one_sentence(tmp_path):
    settings = ["experiment=smoke", "collector=multi_sync", "total_frames=2048", "threads=1"]
    code, _, err = Training(*settings, f"hydra.run.dir={tmp_path}/run", context=killed_worker).end()
    last = tmp_path / "run" / "checkpoints" / "last"
    words = rf"error: collector worker 2 of 2 has died \(exit code -9\)\. .* is whole: .* resume={last}"
    assert code == 2 and re.fullmatch(words, err.splitlines()[-1]), err
    assert checkpoint.read(last)[1]["frames"] == 256


def slots(first: int, count: int) -> TransformedEnv:
    return TransformedEnv(PickPlaceEnv(num_envs=count, first_episode=first))


def test_workers_that_cannot_begin_are_ended():
    """Left behind, they would keep the command from ending."""
    before = set(multiprocessing.active_children())
    policy = RandomPolicy(PickPlaceEnv(num_envs=2).action_spec)
    with pytest.raises(ValueError, match="seed=-1"):
        collectors.multi_sync(slots, policy, num_envs=4, rollout_length=2, seed=-1)
    assert set(multiprocessing.active_children()) <= before


def test_any_seed_is_one_for_the_workers():
    for seed in (2**62 - 1, 20_000_000_000_000):
        seeds = collectors._seeds(seed, 3)
        assert {item_seed for item_seed, _ in seeds} == {seed}
        assert len({torch.Generator().manual_seed(own).initial_seed() for _, own in seeds}) == 3


def test_a_worker_s_death_is_told_until_it_is_heard():
    """A logger or a finalizer swallows what is raised while it runs."""
    worker = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
    worker.start()
    with pytest.raises(WorkerDied, match="1 of 1 has died"), watch_workers(SimpleNamespace(procs=[worker])):
        worker.kill()
        with suppress(WorkerDied):
            time.sleep(30)
        time.sleep(30)
    time.sleep(0.6)  # and not once we have left


def test_the_worker_that_was_killed_is_named():
    """Not one that failed for want of it, and that may be noticed before."""
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=os._exit, args=(1,)), context.Process(target=time.sleep, args=(60,))]
    for worker in workers:
        worker.start()
    workers[1].kill()
    for worker in workers:
        worker.join()
    with (
        pytest.raises(WorkerDied, match=r"2 of 2 has died \(exit code -9\)"),
        watch_workers(SimpleNamespace(procs=workers)),
    ):
        pass


def work(deaf, ready):
    if deaf:
        ignore_signals()
    ready.release()
    time.sleep(60)


@pytest.mark.parametrize("deaf", [True, False])
def test_a_worker_s_death_that_torchrl_sees_first_is_told(deaf):
    """Our signal handler keeps out of an error's handling, and TorchRL ends the other workers its own way."""
    ready = FORKSERVER.Semaphore(0)
    workers = [FORKSERVER.Process(target=work, args=(deaf, ready), daemon=True) for _ in range(2)]
    for worker in workers:
        worker.start()
    assert all(ready.acquire(timeout=240) for _ in workers)
    died = pytest.raises(WorkerDied, match=r"1 of 2 has died \(exit code -9\)")
    with died, watch_workers(SimpleNamespace(procs=workers)):
        try:
            raise queue.Empty
        except queue.Empty:
            workers[0].kill()
            workers[0].join()
            _check_for_faulty_process(workers)


def test_a_loss_that_is_not_finite_stops_the_run_with_a_summary(smoke, tmp_path):
    with pytest.raises(FloatingPointError) as caught:
        smoke(tmp_path / "run", "reward_scale=1e38")
    message = str(caught.value)
    assert message.startswith("the loss or its gradient is not finite: loss_")
    assert "advantage" in message and "not finite)" in message
    assert message.endswith("Nothing had been saved before.")
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.parametrize(
    ("owner", "function", "words"),
    [
        (checkpoint.os, "fsync", "cannot be written .*No space left"),
        (csv.DictWriter, "writerow", "{}/metrics.csv: No space left on device; expected free space. What was saved"),
    ],
)
def test_a_full_disk_names_the_checkpoint_before_which_is_whole(smoke, tmp_path, monkeypatch, owner, function, words):
    run_dir = tmp_path / "run"

    def full(*_):
        raise OSError(28, "No space left on device")

    filled = after_batch(3, lambda _: monkeypatch.setattr(owner, function, full))
    with filled, pytest.raises(ValueError, match=rf"{words.format(run_dir)}.*: .*resume={run_dir}/checkpoints/last$"):
        smoke(run_dir, "total_frames=2048")
    assert checkpoint.read(run_dir / "checkpoints" / "last")[1]["frames"] == 256
    assert not [path for path in (run_dir / "checkpoints").iterdir() if path.name.startswith(".")]


@pytest.fixture
def read_only(smoke_run):
    """A finished run in a folder where nothing can be written, not even by root."""
    with tempfile.TemporaryDirectory() as base:  # pytest's own folders are closed to other users
        run_dir = Path(base) / "run"
        shutil.copytree(smoke_run, run_dir)
        for path in (Path(base), run_dir, *run_dir.rglob("*")):
            path.chmod(0o555 if path.is_dir() else 0o444)
        user = os.geteuid()
        try:
            if user == 0:
                os.seteuid(65534)
                needed = (conf_dir(), sys.prefix)
                if not all(os.access(place, os.R_OK | os.X_OK, effective_ids=True) for place in needed):
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
        (train_main, ["experiment=smoke", "hydra.run.dir={}"], ".lock"),
        (train_main, ["experiment=smoke", "hydra.run.dir={}/below"], "below"),
        (evaluate_main, ["planner=random", "hydra.run.dir={}"], ".lock"),
    ],
)
def test_a_read_only_run_folder_is_named(read_only, monkeypatch, capsys, main, arguments, name):
    monkeypatch.setattr(sys, "argv", ["pickplace", *(word.format(read_only) for word in arguments)])
    before = {path: path.read_bytes() for path in read_only.rglob("*") if path.is_file()}
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    expected = f"error: {read_only}/{name}: Permission denied; expected a place where you may read and write."
    if arguments[0].startswith("resume"):
        last = read_only / "checkpoints" / "last"
        expected += f" What was saved before is whole: pickplace-train resume={last}"
    assert capsys.readouterr().err == f"{expected}\n"
    assert before == {path: path.read_bytes() for path in read_only.rglob("*") if path.is_file()}
    Planner.load(read_only)


@pytest.mark.parametrize("rate", ["1.5", "1e37", "1e38"])
def test_a_learning_rate_that_no_network_survives_is_one_sentence(smoke, rate, tmp_path):
    with pytest.raises(ValueError, match=f"algo.lr={re.escape(str(float(rate)))}: expected a number between 0 and 1"):
        smoke(tmp_path / "run", f"algo.lr={rate}")


def test_the_greatest_learning_rate_trains_or_says_what_is_not_finite(smoke, tmp_path):
    try:
        smoke(tmp_path / "run", "algo.lr=1", "total_frames=256")
    except FloatingPointError as error:
        assert "not finite" in str(error)
