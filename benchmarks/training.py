"""Where a training batch's time goes, with ``experiment=quick`` on all cores: python benchmarks/training.py"""

import csv
import logging
import os
import sys
import tempfile
import time
from pathlib import Path

import torch
from common import save
from hydra import compose, initialize_config_dir
from torchrl.envs import TransformedEnv

from pickplace.policies.actors import OutcomePolicy
from pickplace.runs import hydra_app as config
from pickplace.training.train import train

FRAMES = 300_000


def timed(owner, name: str, part: str, spent: dict) -> None:
    """Add up the time spent in a method while frames are collected."""
    method = getattr(owner, name)

    def wrapped(self, *args, **kwargs):
        if torch.is_grad_enabled():  # an update, or a reset between batches
            return method(self, *args, **kwargs)
        start = time.perf_counter()
        result = method(self, *args, **kwargs)
        spent[part] += time.perf_counter() - start
        return result

    setattr(owner, name, wrapped)


def main() -> None:
    logging.disable(logging.CRITICAL)
    spent = {"environment": 0.0, "policy": 0.0}
    timed(TransformedEnv, "step_and_maybe_reset", "environment", spent)
    timed(OutcomePolicy, "forward", "policy", spent)
    timed(OutcomePolicy, "to_action", "policy", spent)
    with tempfile.TemporaryDirectory() as folder:
        with initialize_config_dir(str(config.conf_dir()), version_base="1.3"):
            # The one validation, after the last batch, is so short that it does not count.
            overrides = [f"total_frames={FRAMES}", "evaluation_interval=1_000_000_000", "evaluation.episodes=1"]
            cfg = compose("train", ["experiment=quick", *overrides])
        cfg.evaluation.batch_size = 1
        train(cfg, Path(folder))
        with (Path(folder) / "metrics.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
    total = {key: sum(float(row[f"time/{key}"]) for row in rows) / 1e3 for key in ("collect_ms", "update_ms")}
    parts = {**spent, "collector": total["collect_ms"] - sum(spent.values()), "update": total["update_ms"]}
    whole = sum(parts.values())
    speed = sorted(float(row["time/fps"]) for row in rows)
    result = {
        "frames": FRAMES,
        "threads": torch.get_num_threads(),
        "frames per second": {"median": speed[len(speed) // 2], "low": speed[len(speed) // 10]},
        "share": {part: seconds / whole for part, seconds in parts.items()},
    }
    save("training", result)


if __name__ == "__main__":
    os.environ.setdefault("RL_WARNINGS", "False")
    sys.exit(main())
