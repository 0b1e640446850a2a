"""Commands and configs for tests: composed configs, interrupted trainings, and trainings in other processes."""

import copy
import functools
import json
import multiprocessing
import os
import sys
import tempfile
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from tensordict import TensorDict

from pickplace.algorithms.base import Task
from pickplace.config.registry import build
from pickplace.config.words import conf_dir
from pickplace.evaluation import artifacts, command, evaluate
from pickplace.rules.observation import STANDARD_TERMS
from pickplace.runs import checkpoint
from pickplace.runs.loggers import read_csv
from pickplace.training.trainer import Trainer

ITERATION = 8 * 8  # frames of a batch of SETTINGS: env.num_envs * rollout_length

#: A small training that draws random numbers in all its parts, and saves and validates at different frames.
SETTINGS = [
    "experiment=smoke",
    "rollout_length=8",
    "algo.minibatch_size=32",
    "env.tote_size=[5,5,3]",
    "algo=sampled_ppo",
    "algo.samples=2",
    "curriculum=mixture",  # its sampler draws, so the generators matter
    "curriculum.advance.occupancy=0.3",
    "curriculum.advance.window=10",
    "warm_start=imitate",
    "planner@warm_start.teacher=random",  # a teacher that draws random numbers
    f"warm_start.frames={4 * ITERATION}",
    f"warm_start.critic_frames={2 * ITERATION}",
    f"total_frames={10 * ITERATION}",
    f"checkpoint_interval={3 * ITERATION}",
    f"evaluation_interval={4 * ITERATION}",
    "evaluation.episodes=4",
    "threads=1",
]

#: A training of one batch with small networks.
TINY = [
    "env.num_envs=4", "rollout_length=4", "algo.minibatch_size=8", "algo.epochs=1", "total_frames=16",
    "evaluation.episodes=1", "evaluation_interval=16", "checkpoint_interval=16", "progress_interval=16",
    "env.tote_size=[5,5,2]", "model.actor.filters=8", "model.critic.filters=8", "model.critic.hidden=8", "threads=1",
]  # fmt: skip

#: Processes are forked from one that has imported but not used torch and more. This saves seconds for each.
FORKSERVER = multiprocessing.get_context("forkserver")
FORKSERVER.set_forkserver_preload([
    "pickplace.training.train", "scipy.stats", "matplotlib.figure", "matplotlib.backends.backend_agg",
    "torchrl.objectives.value",
])  # fmt: skip


def composed(*overrides, name="train"):
    """Return the config that a command line makes."""
    return copy.deepcopy(_composed(name, overrides))


@functools.cache
def _composed(name, overrides):
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return compose(name, list(overrides))


@contextmanager
def evaluation_config(*words):
    """Compose the config of an evaluation once, with what Hydra knows of the command line while it runs."""
    words = [f"++{word}" if word.partition(".")[0] in command.TRAINED else word for word in words]
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        merged = compose("evaluate", words, return_hydra_config=True)
        HydraConfig.instance().set_config(merged)
        cfg = OmegaConf.masked_copy(merged, [key for key in merged if key != "hydra"])
        OmegaConf.set_struct(cfg, True)
        yield cfg


def evaluated(folder, *words):
    """Evaluate as a command line says, without Hydra's application and without the picture.

    Returns the content of ``evaluation.json``, with its ``path`` and the table, ``out``.
    """
    folder.mkdir()
    with evaluation_config(*words) as cfg, pytest.MonkeyPatch.context() as patch:
        patch.setattr(artifacts, "picture", lambda recording, cell, path: path.touch())
        evaluate.run(cfg, folder)
    path = folder / "evaluation.json"
    return {**json.loads(path.read_text()), "path": path, "out": (folder / "evaluation.md").read_text()}


def algorithm_of(policy, critic, *overrides):
    """Return the algorithm of a command line, for batches of 8 slots and 6 steps."""
    cfg = composed(*overrides)
    task = Task(STANDARD_TERMS, TensorDict({}, [1]), cfg.reward_scale, num_envs=8, rollout_length=6)
    return build("algo", cfg.algo, policy=policy, critic=critic, task=task)


def options(group):
    """Return the names of a config group's files."""
    return sorted(path.stem for path in (conf_dir() / group).glob("*.yaml"))


@contextmanager
def after_batch(iteration, act):
    """Call ``act(trainer)`` once a training in this process has trained, logged and saved the batch ``iteration``."""
    finish = Trainer.finish_batch

    def finish_and_act(trainer, metrics, before):
        finish(trainer, metrics, before)
        if trainer.iteration == iteration:
            act(trainer)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "finish_batch", finish_and_act)
        yield


class Training:
    """``pickplace-train`` with these overrides in a process of its own; ``context`` makes a context there."""

    def __init__(self, *overrides, context=nullcontext):
        self.output = Path(tempfile.mkdtemp())
        self.process = FORKSERVER.Process(target=_train, args=(overrides, self.output, context))
        self.process.start()

    def end(self):
        """Wait for the end; return exit code, standard output and standard error."""
        self.process.join(240)
        return self.process.exitcode, *((self.output / name).read_text() for name in ("stdout", "stderr"))

    def finish(self):
        """Wait for a successful end; return standard output."""
        code, out, err = self.end()
        assert code == 0, err
        return out

    def kill(self):
        """Kill the process, and wait for its end."""
        self.process.kill()
        self.process.join()


def write_to(folder):
    """Redirect this process's standard output and error to files ``stdout`` and ``stderr``."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))


def _train(overrides, output, context):
    write_to(output)
    multiprocessing.set_start_method("spawn", force=True)  # the default in a process that was not forked
    from pickplace.training import command

    sys.argv = ["pickplace-train", *overrides]
    with context():
        command.main()


def assert_same(run_a, run_b):
    """Compare two runs bit for bit: tensors, counters, curriculum, metrics without times."""
    (state_a, facts_a), (state_b, facts_b) = (checkpoint.read(run / "checkpoints" / "last") for run in (run_a, run_b))
    (tensors_a, rest_a), (tensors_b, rest_b) = checkpoint.flatten(state_a), checkpoint.flatten(state_b)
    assert tensors_a.keys() == tensors_b.keys() and rest_a == rest_b
    for key, value in tensors_a.items():
        assert torch.equal(value, tensors_b[key]), key
    for key in ("frames", "iteration", "best", "curriculum"):
        assert facts_a[key] == facts_b[key], key
    rows_a, rows_b = (
        [{key: value for key, value in row.items() if not key.startswith("time/")} for row in rows]
        for rows in (read_csv(run / "metrics.csv") for run in (run_a, run_b))
    )
    assert rows_a == rows_b
