"""Frames per second of a training and the shares of a batch's time, on all cores: python benchmarks/training.py"""

import logging
import statistics
import tempfile
import time
from pathlib import Path

import torch
from common import save
from hydra import compose, initialize_config_dir
from torchrl.envs import TransformedEnv

from pickplace.policies.base import Policy
from pickplace.policies.fcn4d.policy import Fcn4d
from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.runs.hydra_app import conf_dir
from pickplace.runs.loggers import read_csv
from pickplace.training.train import train

#: Preset, the class of its policy, frames.
TRAININGS = (("quick", FcnGrasp, 300_000), ("paper", Fcn4d, 8_000), ("paper_fast", Fcn4d, 60_000))


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


def measure(preset: str, policy: type[Policy], frames: int) -> dict:
    """Train, and return frames per second of the median batch, and the shares of its parts."""
    spent = {"environment": 0.0, "policy": 0.0}
    originals = [(TransformedEnv, "step_and_maybe_reset", "environment"), (policy, "forward", "policy")]
    originals.append((policy, "to_action", "policy"))
    methods = [(owner, name, getattr(owner, name)) for owner, name, _ in originals]
    for owner, name, part in originals:
        timed(owner, name, part, spent)
    with tempfile.TemporaryDirectory() as folder:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            # One validation, after the last batch, too short to count.
            overrides = [f"total_frames={frames}", "evaluation_interval=1_000_000_000", "evaluation.episodes=1"]
            cfg = compose("train", [f"experiment={preset}", "threads=null", "evaluation.batch_size=1", *overrides])
        train(cfg, Path(folder))
        rows = read_csv(Path(folder) / "metrics.csv")
    for owner, name, method in methods:
        setattr(owner, name, method)
    total = {key: sum(row[f"time/{key}"] for row in rows) / 1e3 for key in ("collect_ms", "update_ms")}
    parts = {**spent, "collector": total["collect_ms"] - sum(spent.values()), "update": total["update_ms"]}
    speed = statistics.median(row["time/fps"] for row in rows)
    share = {part: seconds / sum(parts.values()) for part, seconds in parts.items()}
    return {"frames": frames, "frames per second": speed, "share": share}


def main() -> None:
    logging.disable(logging.CRITICAL)
    results = {preset: measure(preset, policy, frames) for preset, policy, frames in TRAININGS}
    save("training", {"trainings": results})


if __name__ == "__main__":
    main()
