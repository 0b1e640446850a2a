"""Watch resident memory for an hour and a half: python tests/long/memory.py [planner] [single] [multi_sync]

A planner and a training must not grow once they are warm: in the last fifth of the time their median memory is at most
5% above that in the second fifth.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ALLOWED_GROWTH, COMMANDS = 0.05, Path(sys.executable).parent


def resident(pid: int) -> float:
    """Return the resident memory of a process and its children, in MiB."""
    listed = subprocess.run(["ps", "-o", "rss=", "-p", str(pid), "--ppid", str(pid)], capture_output=True, text=True)
    return sum(map(int, listed.stdout.split())) / 1024


def summary(name: str, samples: list[float]) -> str:
    """Return a line about samples of memory; raise if it grew."""
    fifth = len(samples) // 5
    early, late = np.median(samples[fifth : 2 * fifth]), np.median(samples[-fifth:])
    line = f"{name}: {early:.0f} MiB when warm, {late:.0f} MiB at the end, {max(samples):.0f} MiB at most"
    if late > (1 + ALLOWED_GROWTH) * early:
        raise RuntimeError(f"{line}: it grew")
    return line


def watch_training(minutes: float, *overrides: str) -> str:
    """Train for some minutes, with many validations and checkpoints."""
    with tempfile.TemporaryDirectory() as folder:
        command = [COMMANDS / "pickplace-train", "experiment=quick", "total_frames=1_000_000_000", "threads=1"]
        command += ["evaluation_interval=8192", "checkpoint_interval=4096", f"hydra.run.dir={folder}/run", *overrides]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        samples, end = [], time.monotonic() + 60 * minutes
        while time.monotonic() < end:
            time.sleep(minutes * 60 / 500)
            if process.poll() is not None:
                raise RuntimeError(f"the training ended by itself with exit code {process.returncode}")
            samples.append(resident(process.pid))
        process.terminate()
        process.wait()
    return summary(" ".join([f"training for {minutes:g} minutes", *overrides]), samples)


def watch_planner(lines: int) -> str:
    """Send requests to the planner, a tenth of them cut off."""
    draw = np.random.default_rng(0)
    command = [COMMANDS / "pickplace-plan", "pretrained/r4", "--threads", "1"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    samples = []
    for number in range(lines):
        bin_depth = np.zeros((5, 5), dtype=int)
        x, y = draw.integers(0, 4, 2)
        bin_depth[x : x + 2, y] = 1
        request = {"id": number, "bin_depth": bin_depth.tolist(), "tote_depth": draw.integers(0, 6, (6, 6)).tolist()}
        text, is_good = json.dumps(request), number % 10 > 0
        process.stdin.write(text[: None if is_good else draw.integers(1, 90)].encode() + b"\n")
        process.stdin.flush()
        reply = json.loads(process.stdout.readline())
        if ("error" in reply) == is_good:
            raise RuntimeError(f"line {number}: {reply}")
        if number % max(1, lines // 500) == 0:
            samples.append(resident(process.pid))
    process.stdin.close()
    if process.wait():
        raise RuntimeError(f"the planner ended with exit code {process.returncode}")
    return summary(f"planner over {lines:,} lines", samples)


if __name__ == "__main__":
    for part in sys.argv[1:] or ("planner", "single", "multi_sync"):
        line = watch_planner(100_000) if part == "planner" else watch_training(30, f"collector={part}")
        sys.stdout.write(line + "\n")
        sys.stdout.flush()
