"""Measure time to a good policy, parts of the training time, and worker processes: python benchmarks/training.py"""

import logging
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from common import console_command, save, spread
from hydra import compose, initialize_config_dir
from torchrl.envs import TransformedEnv

from pickplace.config.words import conf_dir
from pickplace.policies.base import Policy
from pickplace.policies.fcn4d.policy import Fcn4d
from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.runs.loggers import read_csv
from pickplace.training.train import train

#: Preset, the class of its policy, frames.
TRAININGS = (("quick", FcnGrasp, 300_000), ("paper", Fcn4d, 8_000), ("paper_fast", Fcn4d, 60_000))
#: A single validation after the last batch, too short to matter.
NO_EVALUATION = ["evaluation_interval=1_000_000_000", "evaluation.episodes=1", "evaluation.batch_size=1"]

MARKS, SEEDS = (0.95, 0.975), (0, 1, 2)

WORKER_FRAMES, WORKER_REPEATS = 65_536, 3
WORKER_CASES = {
    "`quick`, all cores": ["experiment=quick", "threads=null"],
    "`quick`, one thread a process": ["experiment=quick"],
}
COLLECTORS = {"single": ["collector=single"], "multi_sync, 2 workers": ["collector=multi_sync", "collector.workers=2"]}


def learn(seed: int) -> dict:
    """Return the validations of ``experiment=quick``: seconds since the process began, frames, occupancy.

    Only the first seed trains to the end; the others end when the last of :data:`MARKS` is reached.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = ["experiment=quick", "threads=null", f"seed={seed}", "evaluation_interval=50_000"]
        started, curve = time.perf_counter(), []
        command = [console_command("pickplace-train"), *words, f"hydra.run.dir={folder}"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            for line in process.stdout or ():
                if found := re.search(r"([\d,]+) frames: validation occupancy ([\d.]+)", line):
                    seconds = time.perf_counter() - started
                    curve.append([seconds, int(found[1].replace(",", "")), float(found[2])])
                    if seed != SEEDS[0] and curve[-1][2] >= MARKS[-1]:
                        process.terminate()  # it finishes its batch and saves
    reached = {str(mark): next((seconds for seconds, _, value in curve if value >= mark), None) for mark in MARKS}
    return {"seed": seed, "curve": curve, "reached": reached}


def timed(owner, name: str, part: str, spent: dict) -> None:
    """Add the time spent in a method to ``spent[part]``, while frames are collected."""
    method = getattr(owner, name)

    def wrapped(self, *args, **kwargs):
        if torch.is_grad_enabled():  # an update, or a reset between batches
            return method(self, *args, **kwargs)
        start = time.perf_counter()
        result = method(self, *args, **kwargs)
        spent[part] += time.perf_counter() - start
        return result

    setattr(owner, name, wrapped)


def measure_parts(preset: str, policy: type[Policy], frames: int) -> dict:
    """Train, and return frames per second of the median batch, and the shares of its parts."""
    spent = {"environment": 0.0, "policy": 0.0}
    originals = [(TransformedEnv, "step_and_maybe_reset", "environment"), (policy, "forward", "policy")]
    originals.append((policy, "to_action", "policy"))
    methods = [(owner, name, getattr(owner, name)) for owner, name, _ in originals]
    for owner, name, part in originals:
        timed(owner, name, part, spent)
    with tempfile.TemporaryDirectory() as folder:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            words = [f"experiment={preset}", "threads=null", f"total_frames={frames}", *NO_EVALUATION]
            cfg = compose("train", words)
        train(cfg, Path(folder))
        rows = read_csv(Path(folder) / "metrics.csv")
    for owner, name, method in methods:
        setattr(owner, name, method)
    total = {key: sum(row[f"time/{key}"] for row in rows) / 1e3 for key in ("collect_ms", "update_ms")}
    parts = {**spent, "collector": total["collect_ms"] - sum(spent.values()), "update": total["update_ms"]}
    speed = statistics.median(row["time/fps"] for row in rows)
    share = {part: seconds / sum(parts.values()) for part, seconds in parts.items()}
    return {"frames": frames, "frames per second": speed, "share": share}


def batches(overrides: list[str]) -> list[float]:
    """Return the milliseconds of each batch of a training, without the first four, which warm up."""
    with tempfile.TemporaryDirectory() as folder:
        words = [f"total_frames={WORKER_FRAMES}", *overrides, *NO_EVALUATION, f"hydra.run.dir={folder}/run"]
        subprocess.run([console_command("pickplace-train"), *words], check=True, stdout=subprocess.DEVNULL)
        rows = read_csv(Path(folder) / "run" / "metrics.csv")
    return [row["time/collect_ms"] + row["time/update_ms"] for row in rows[4:]]


def measure_workers() -> dict:
    """Return the times of a batch, collected in turn by one process and by workers."""
    times: dict = {case: {name: [] for name in COLLECTORS} for case in WORKER_CASES}
    for _ in range(WORKER_REPEATS):
        for case, overrides in WORKER_CASES.items():
            for name, collector in COLLECTORS.items():
                times[case][name] += batches([*overrides, *collector])
    return {case: {name: spread(values) for name, values in row.items()} for case, row in times.items()}


def main() -> None:
    logging.disable(logging.CRITICAL)
    wanted = sys.argv[1:] or ["learning", "training", "workers"]
    if "learning" in wanted:
        save("learning", {"ours": [learn(seed) for seed in SEEDS]})
    if "training" in wanted:
        save("training", {"trainings": {preset: measure_parts(preset, *rest) for preset, *rest in TRAININGS}})
    if "workers" in wanted:
        save("workers", {"frames": WORKER_FRAMES, "repeats": WORKER_REPEATS, "rows": measure_workers()})


if __name__ == "__main__":
    main()
