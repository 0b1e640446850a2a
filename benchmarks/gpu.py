"""Measure environment and training on a GPU, in some five minutes: python benchmarks/gpu.py [--device cpu]

The environment is measured against Jumanji's BinPack-v2 on the same card (pip install jumanji and JAX for CUDA; without
them only ours is measured). *Busy* is the share of the time in which the device works, as PyTorch's profiler sees it.
Adds a section to docs/performance.md. ``--device cpu`` shows that the script works: it prints the section, of few
problems and without graphs.
"""

import argparse
import logging
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import report
import torch
from common import console_command, save
from environment import Jumanji
from hydra import compose, initialize_config_dir
from tensordict import TensorDict

from pickplace.common.graphs import CompileSettings
from pickplace.config.words import conf_dir
from pickplace.planners.heuristics import RandomFeasible
from pickplace.training.trainer import Trainer, training_env

MARK = 0.975
COMPILED = {"plain": "none", "recorded": "cudagraphs"}


class Sizes(NamedTuple):
    """Parallel problems of the environment; trainings with their overrides, and batches of each; the timed training."""

    problems: tuple[int, ...]
    trainings: dict[str, list[str]]
    batches: int
    quick: list[str]


GPU = Sizes(
    (256, 1_024, 4_096, 16_384, 65_536),
    {
        "quick_gpu": [],
        "paper_fast_gpu": [],
        "paper_gpu": [],
        "afterstate_gpu benchmark=gopt_rs": [],
    },
    8,
    ["experiment=quick_gpu", "evaluation_interval=250_000"],
)
CPU = Sizes(
    (64,),
    {
        "quick_gpu": ["env.num_envs=64", "algo.minibatch_size=128"],
        "paper_gpu": ["env.num_envs=4", "algo.minibatch_size=64"],
        "afterstate_gpu benchmark=gopt_rs": ["env.num_envs=16", "algo.minibatch_size=64"],
    },
    5,
    ["experiment=smoke", "device=cpu"],
)


def synchronize(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize()


def timed(work: Callable[[], object], device: str) -> float:
    """Return the milliseconds of a call, with the work of the device."""
    synchronize(device)
    start = time.perf_counter()
    work()
    synchronize(device)
    return (time.perf_counter() - start) * 1e3


def profiled(work: Callable[[], object], device: str) -> dict[str, float]:
    """Return the milliseconds in which the device works in a call, and the number of its kernels."""
    if device == "cpu":
        work()
        return {"device ms": 0.0, "kernels": 0}
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        timed(work, device)
    kernels = [each for each in profile.events() if each.device_type == torch.autograd.DeviceType.CUDA]
    return {"device ms": sum(each.self_device_time_total for each in kernels) / 1e3, "kernels": len(kernels)}


def made_trainer(device: str, compile: str, *words: str) -> Trainer:
    """Return the parts of a training that validates and saves nothing."""
    with initialize_config_dir(str(conf_dir()), version_base=None):
        cfg = compose("train", overrides=[*words, f"device={device}", f"compile={compile}", "logger=none"])
    return Trainer(cfg, Path(tempfile.mkdtemp()))


def measure_environment(problems: int, device: str, compile: CompileSettings, steps: int = 30) -> dict:
    """Return the time of a step with the resets that follow it, and the mask of all actions, for random actions."""
    trainer = made_trainer(device, "none", "experiment=quick", "curriculum=none", "env.num_envs=1")
    make = partial(trainer.build_training_env, masks=("action",), episode_stride=problems)
    env = training_env(make, trainer.curriculum, compile, 0, problems)
    planner, times = RandomFeasible(env.base_env.cell), []
    state = env.reset()

    def step(frames: TensorDict) -> None:
        nonlocal state
        _, state = env.step_and_maybe_reset(frames)

    for number in range(steps + 5):
        frames = state.set("action", planner.decide(state))
        passed = timed(partial(step, frames), device)
        if number >= 5:
            times.append(passed)
    median = statistics.median(times)
    frames = state.set("action", planner.decide(state))
    return {"ms": median, "steps/s": problems / median * 1e3, **profiled(partial(step, frames), device)}


def measure_peer(problems: int, device: str, steps: int = 30) -> dict | None:
    """Return the time of a step of Jumanji's environment; None without it, or if JAX has another device."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # JAX then leaves memory for torch
    try:
        world = Jumanji(problems)
    except ImportError:
        return None
    if world.jax.default_backend() != {"cuda": "gpu"}.get(device, device):
        sys.stderr.write(f"JAX runs on {world.jax.default_backend()}, not on the GPU: the peer is skipped\n")
        return None
    times = [world.time_step() for _ in range(steps + 5)][5:]
    return {"ms": statistics.median(times), "steps/s": problems / statistics.median(times) * 1e3}


def measure_training(device: str, compile: str, batches: int, *words: str) -> dict:
    """Return the times of a batch's parts, frames/s, and the share of the time in which the device works."""
    trainer = made_trainer(device, compile, *words, "total_frames=1_000_000_000")
    rows, batch = [], None

    def collect() -> None:
        nonlocal batch
        batch = next(stream)

    with trainer.running():
        stream = iter(trainer.collector)
        for _ in range(batches):
            trainer.collector.update_policy_weights_(TensorDict.from_module(trainer.acting).data)
            rows.append([timed(collect, device), timed(lambda: trainer.learn(batch), device)])
        busy = profiled(collect, device), profiled(lambda: trainer.learn(batch), device)
    # The first four batches make, check and record the work.
    collecting, learning = (statistics.median(column) for column in zip(*rows[4:], strict=True))
    whole, works = collecting + learning, sum(each.get("device ms", 0.0) for each in busy)
    found = {"frames": trainer.task.batch_frames, "collect ms": collecting, "learn ms": learning}
    return found | {"frames/s": trainer.task.batch_frames / whole * 1e3, "busy": works / whole}


def measure_learning(words: list[str]) -> float | None:
    """Return the seconds from the start of the process until a validation reaches :data:`MARK`; None: it does not."""
    with tempfile.TemporaryDirectory() as folder:
        start, command = time.perf_counter(), [console_command("pickplace-train"), *words, f"hydra.run.dir={folder}"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            for line in process.stdout or ():
                found = re.search(r"validation occupancy ([\d.]+)", line)
                if found and float(found[1]) >= MARK:
                    process.terminate()  # it finishes its batch and saves
                    return time.perf_counter() - start
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    device = parser.parse_args().device
    if device == "cuda" and not torch.cuda.is_available():
        sys.exit("benchmarks/gpu.py: there is no GPU; expected one, or --device cpu to try the script.")
    logging.disable(logging.WARNING)
    sizes = GPU if device == "cuda" else CPU
    name = torch.cuda.get_device_name() if device == "cuda" else "cpu"
    result: dict = {"device": name, "environment": {}, "trainings": {}, "mark": MARK}
    for problems in sizes.problems:
        rows = {
            key: measure_environment(problems, device, CompileSettings(cudagraphs=key == "recorded"))
            for key in COMPILED
        }
        peer = measure_peer(problems, device)
        result["environment"][problems] = rows | ({"jumanji": peer} if peer else {})
        sys.stderr.write(f"{problems} problems: {result['environment'][problems]}\n")
    for experiment, words in sizes.trainings.items():
        each = [f"experiment={word}" if "=" not in word else word for word in experiment.split()]
        row = {
            key: measure_training(device, compile, sizes.batches, *each, *words) for key, compile in COMPILED.items()
        }
        result["trainings"][experiment] = row
        sys.stderr.write(f"{experiment}: {row}\n")
    result["seconds until the mark"] = measure_learning(sizes.quick)
    if device == "cuda":
        save("gpu", result)
        report.main()
    else:
        sys.stdout.write(report.gpu(result))


if __name__ == "__main__":
    main()
