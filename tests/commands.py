"""Commands and configs for tests: composed configs, and trainings in processes of their own."""

import multiprocessing
import os
import sys
import tempfile
import time
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir

from pickplace.runs import checkpoint
from pickplace.runs.hydra_app import conf_dir
from pickplace.runs.loggers import read_csv

ITERATION = 8 * 16  # frames: env.num_envs * algo.rollout_length of experiment=smoke

#: A small training that draws in all its parts.
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

#: Processes are forked from one that has imported torch and has not used it, which saves seconds for each.
FORKSERVER = multiprocessing.get_context("forkserver")
FORKSERVER.set_forkserver_preload(["pickplace.training.train", "pickplace.training.report"])


def composed(*overrides, name="train"):
    """Return the config that a command line makes."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return compose(name, list(overrides))


def options(group):
    """Return the names of a config group's files."""
    return sorted(path.stem for path in (conf_dir() / group).glob("*.yaml"))


class Training:
    """``pickplace-train`` in a process of its own.

    Args:
        overrides: the command line.
        own_group: whether it leads a process group.
    """

    def __init__(self, *overrides, own_group=False):
        self.output = Path(tempfile.mkdtemp())
        self.process = FORKSERVER.Process(target=_train, args=(overrides, self.output, own_group))
        self.process.start()
        self.pid = self.process.pid

    def end(self):
        """Wait for the end; return exit code, standard output and standard error."""
        self.process.join(240)
        return self.process.exitcode, *((self.output / name).read_text() for name in ("stdout", "stderr"))

    def finish(self):
        """Wait for the end, which must be a success; return standard output."""
        code, out, err = self.end()
        assert code == 0, err
        return out

    def kill(self):
        """Kill it, and wait."""
        self.process.kill()
        self.process.join()

    def wait_for_rows(self, run_dir, count):
        """Wait until ``metrics.csv`` has so many rows."""
        path = Path(run_dir) / "metrics.csv"
        for _ in range(120_000):
            if path.is_file() and path.read_bytes().count(b"\n") > count:
                return
            assert self.process.is_alive(), self.end()
            time.sleep(0.001)
        raise AssertionError("no metrics appeared")


def _train(overrides, output, own_group):
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(output / name, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))
    multiprocessing.set_start_method("spawn", force=True)  # as in a process that nobody forked
    if own_group:
        os.setpgrp()
    from pickplace.training import train

    sys.argv = ["pickplace-train", *overrides]
    train.main()


def state_of(run_dir):
    """Return what two equal runs have in common: tensors, counters, curriculum, metrics without times."""
    state, facts = checkpoint.read(run_dir / "checkpoints" / "last")
    rows = [{k: v for k, v in row.items() if not k.startswith("time/")} for row in read_csv(run_dir / "metrics.csv")]
    return checkpoint.flatten(state), {k: facts[k] for k in ("frames", "iteration", "best", "curriculum")}, rows


def assert_same(run_a, run_b):
    """Compare two runs bit for bit."""
    (tensors_a, rest_a), *others_a = state_of(run_a)
    (tensors_b, rest_b), *others_b = state_of(run_b)
    assert tensors_a.keys() == tensors_b.keys()
    for key, value in tensors_a.items():
        assert torch.equal(value, tensors_b[key]), key
    assert rest_a == rest_b and others_a == others_b
