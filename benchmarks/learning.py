"""Wall-clock time until a policy packs well at 6x6x5, R=4: ours against sb3-contrib's MaskablePPO.

python benchmarks/learning.py [seeds ...]    (the peer: pip install sb3-contrib; without it, it is skipped)

Ours is ``experiment=quick``, one seed after the other on all cores. The clock starts with the process, so imports and
validations count. The time to a mark is that of the first validation at or above it.

The peer is MaskablePPO with its CNN policy on our Gymnasium environment (``PickPlaceVectorEnv``, 128 slots, which is
faster for it than many single environments). The depth maps are a two-channel image through 3x3 convolutions, since its
default CNN needs 36x36 pixels. It gets ten times the time that we need to 0.95, validations not counted.
"""

import re
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from common import console_command, save
from torch import nn

from pickplace.runs.loggers import read_csv

MARKS = (0.95, 0.975)
EPISODES = 128
SLOTS = 128


def ours(seed: int, whole: bool) -> dict:
    """Return the validations and the median batch of one run of ``experiment=quick``.

    Args:
        whole: run to the end; else only until the last mark is reached.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [console_command("pickplace-train"), "experiment=quick", "threads=null", f"seed={seed}"]
        command += ["evaluation_interval=50_000", f"hydra.run.dir={folder}"]
        started, curve = time.perf_counter(), []
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            for line in process.stdout:
                if found := re.search(r"([\d,]+) frames: validation occupancy ([\d.]+)", line):
                    frames, occupancy = int(found[1].replace(",", "")), float(found[2])
                    curve.append([time.perf_counter() - started, frames, occupancy])
                    if not whole and None not in reached(curve).values():
                        process.terminate()  # it finishes its batch and saves
        seconds = time.perf_counter() - started
        rows = read_csv(Path(folder) / "metrics.csv")
    times = {
        key.removeprefix("time/"): float(np.median([row[key] for row in rows])) for key in rows[0] if "time/" in key
    }
    return {
        "seed": seed,
        "seconds": seconds,
        "whole": whole,
        "curve": curve,
        "reached": reached(curve),
        "median batch": times,
    }


def reached(curve: list) -> dict:
    """Return the seconds until each mark, or None."""
    return {str(mark): next((seconds for seconds, _, value in curve if value >= mark), None) for mark in MARKS}


def peer(seconds: float) -> dict | None:
    """Train MaskablePPO for some seconds and return its validations; None if it is not installed."""
    try:
        import sb3_contrib
        from gymnasium import spaces
        from stable_baselines3.common.callbacks import BaseCallback
        from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
        from stable_baselines3.common.vec_env import VecEnv
    except ImportError:
        sys.stderr.write("sb3-contrib is not installed: the peer is skipped (pip install sb3-contrib)\n")
        return None
    from pickplace.envs.gymnasium import PickPlaceVectorEnv

    class Slots(VecEnv):
        """``PickPlaceVectorEnv`` with the interface of stable-baselines3, the two maps as one image."""

        def __init__(self, count: int, stream: str):
            self.env = PickPlaceVectorEnv(count, autoreset_mode="SameStep", stream=stream)
            image = spaces.Box(-10, 10, (2, 6, 6), np.float32)
            super().__init__(count, image, self.env.single_action_space)
            self.render_mode = None

        def image(self, seen: dict) -> np.ndarray:
            bins = np.pad(seen["bin_depth"], ((0, 0), (0, 1), (0, 1)), constant_values=-1)
            return np.stack([bins, seen["tote_depth"]], 1)

        def reset(self):
            seen, _ = self.env.reset(seed=0)
            return self.image(seen)

        def step_async(self, actions):
            self.actions = actions

        def step_wait(self):
            seen, reward, terminated, truncated, infos = self.env.step(self.actions)
            done, each = terminated | truncated, [{} for _ in range(self.num_envs)]
            for slot in np.flatnonzero(done):
                final = {key: value[None] for key, value in infos["final_obs"][slot].items()}
                each[slot] = {"terminal_observation": self.image(final)[0]}
                each[slot]["occupancy"] = infos["final_info"]["occupancy"][slot]
            return self.image(seen), reward / 4, done, each

        def env_method(self, name, *args, indices=None, **kwargs):
            return list(self.env.action_masks())

        def has_attr(self, name):
            return name == "action_masks"

        def env_is_wrapped(self, wrapper, indices=None):
            return [False] * self.num_envs

        def get_attr(self, name, indices=None):
            return [None] * self.num_envs

        def set_attr(self, name, value, indices=None):
            pass

        def close(self):
            pass

    class Convolutions(BaseFeaturesExtractor):
        def __init__(self, space, features_dim: int = 256):
            super().__init__(space, features_dim)
            self.layers = nn.Sequential(
                *(nn.Conv2d(2, 48, 3, padding=1), nn.ReLU(), nn.Conv2d(48, 48, 3, padding=1), nn.ReLU(), nn.Flatten()),
                *(nn.Linear(48 * 36, features_dim), nn.ReLU()),
            )

        def forward(self, image):
            return self.layers(image)

    def validate(model) -> float:
        """Return the mean occupancy of the first episodes of the validation stream."""
        world, total = Slots(EPISODES, "validation"), np.full(EPISODES, np.nan)
        image = world.reset()
        while np.isnan(total).any():
            masks = world.env.action_masks()
            image, _, done, infos = world.step(model.predict(image, action_masks=masks, deterministic=True)[0])
            for slot in np.flatnonzero(done & np.isnan(total)):
                total[slot] = infos[slot]["occupancy"]
        return float(total.mean())

    class Clock(BaseCallback):
        """Validates every 30 seconds of training, and stops when the time is over."""

        def __init__(self):
            super().__init__()
            self.curve, self.paused, self.next = [], 0.0, 0.0

        def _on_training_start(self):
            self.started = time.perf_counter()

        def _on_step(self):
            return True

        def _on_rollout_start(self):
            now = time.perf_counter() - self.started - self.paused
            if now >= self.next:
                began = time.perf_counter()
                self.curve.append([now, self.num_timesteps, validate(self.model)])
                sys.stderr.write(f"peer: {now:.0f} s, {self.num_timesteps} frames, {self.curve[-1][2]:.3f}\n")
                self.paused += time.perf_counter() - began
                self.next = now + 30
            if now >= seconds:
                raise TimeoutError

    clock = Clock()
    model = sb3_contrib.MaskablePPO(
        "CnnPolicy",
        Slots(SLOTS, "train"),
        n_steps=16,
        batch_size=512,
        n_epochs=3,
        learning_rate=1e-3,
        ent_coef=0.002,
        vf_coef=0.25,
        policy_kwargs={"features_extractor_class": Convolutions, "normalize_images": False},
        seed=0,
    )
    with suppress(TimeoutError):
        model.learn(10**9, callback=clock)
    name = f"sb3-contrib {sb3_contrib.__version__}, MaskablePPO"
    return {"name": name, "budget": seconds, "curve": clock.curve, "reached": reached(clock.curve)}


def main() -> None:
    seeds = [int(seed) for seed in sys.argv[1:]] or [0, 1, 2]
    runs = [ours(seed, whole=seed == seeds[0]) for seed in seeds]
    needed = sorted(run["reached"]["0.95"] or float("inf") for run in runs)[len(runs) // 2]
    torch.manual_seed(0)
    save("learning", {"ours": runs, "peer": peer(10 * needed)})


if __name__ == "__main__":
    main()
