"""Shares of a training batch's time, with ``experiment=quick`` on all cores: python benchmarks/training.py"""

import logging
import tempfile
import time
from pathlib import Path

import torch
from common import save
from hydra import compose, initialize_config_dir
from torchrl.envs import TransformedEnv

from pickplace.policies.fcn_grasp import FootprintPolicy
from pickplace.runs.hydra_app import conf_dir
from pickplace.runs.loggers import read_csv
from pickplace.training.train import train

FRAMES = 300_000


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


def main() -> None:
    logging.disable(logging.CRITICAL)
    spent = {"environment": 0.0, "policy": 0.0}
    timed(TransformedEnv, "step_and_maybe_reset", "environment", spent)
    timed(FootprintPolicy, "forward", "policy", spent)
    timed(FootprintPolicy, "to_action", "policy", spent)
    with tempfile.TemporaryDirectory() as folder:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            # One validation, after the last batch, too short to count.
            overrides = [f"total_frames={FRAMES}", "evaluation_interval=1_000_000_000", "evaluation.episodes=1"]
            cfg = compose("train", ["experiment=quick", "threads=null", *overrides])
        cfg.evaluation.batch_size = 1
        train(cfg, Path(folder))
        rows = read_csv(Path(folder) / "metrics.csv")
    total = {key: sum(row[f"time/{key}"] for row in rows) / 1e3 for key in ("collect_ms", "update_ms")}
    parts = {**spent, "collector": total["collect_ms"] - sum(spent.values()), "update": total["update_ms"]}
    whole = sum(parts.values())
    speed = sorted(row["time/fps"] for row in rows)
    result = {
        "frames": FRAMES,
        "threads": torch.get_num_threads(),
        "frames per second": {"median": speed[len(speed) // 2], "low": speed[len(speed) // 10]},
        "share": {part: seconds / whole for part, seconds in parts.items()},
    }
    save("training", result)


if __name__ == "__main__":
    main()
