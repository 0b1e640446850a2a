"""Watches resident memory for an hour: python tests/memory.py [planner] [single] [multi_sync].

A training and a planner process must not grow once they are warm: their memory at the end is at most 5% above what it
was after a fifth of the time.
"""

import json
import subprocess
import sys
import tempfile
import time

import numpy as np

ALLOWED = 0.05


def resident(pid: int) -> float:
    """Resident memory of a process and its children, MiB."""
    listed = subprocess.run(["ps", "-o", "rss=", "-p", str(pid), "--ppid", str(pid)], capture_output=True, text=True)
    return sum(int(word) for word in listed.stdout.split()) / 1024


def judge(name: str, samples: list[float]) -> str:
    """A line on how memory went.

    Raises:
        RuntimeError: if it grew.
    """
    warm = len(samples) // 5
    early, late = np.median(samples[warm : 2 * warm]), np.median(samples[-warm:])
    line = f"{name}: {early:.0f} MiB when warm, {late:.0f} MiB at the end, {max(samples):.0f} MiB at most"
    if late > (1 + ALLOWED) * early:
        raise RuntimeError(f"{line}: it grew")
    return line


def training(minutes: float, *overrides: str) -> str:
    """Train for so long, validations and checkpoints included."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "pickplace.training.train",
            "experiment=quick",
            "total_frames=1_000_000_000",
            "threads=1",
        ]
        command += ["evaluation_interval=8192", "checkpoint_interval=4096", f"hydra.run.dir={folder}/run", *overrides]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        samples, end = [], time.monotonic() + 60 * minutes
        while time.monotonic() < end and process.poll() is None:
            time.sleep(minutes * 60 / 500)
            samples.append(resident(process.pid))
        if process.poll() is not None:
            raise RuntimeError(f"training ended by itself with exit code {process.returncode}")
        process.terminate()
        process.wait()
    return judge(f"training for {minutes:g} minutes {' '.join(overrides)}", samples)


def planning(lines: int) -> str:
    """Answer so many requests, good and bad ones."""
    draw = np.random.default_rng(0)
    process = subprocess.Popen(
        [sys.executable, "-m", "pickplace.robot.json_lines", "pretrained/r4", "--threads", "1"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    samples = []
    for number in range(lines):
        bin_depth = np.zeros((5, 5), dtype=int)
        x, y = draw.integers(0, 4, 2)
        bin_depth[x : x + 2, y] = 1
        request = {"id": number, "bin_depth": bin_depth.tolist(), "tote_depth": draw.integers(0, 6, (6, 6)).tolist()}
        text = json.dumps(request) if number % 10 else json.dumps(request)[: draw.integers(1, 90)]
        process.stdin.write(text.encode() + b"\n")
        process.stdin.flush()
        reply = json.loads(process.stdout.readline())
        if ("error" in reply) != (number % 10 == 0):
            raise RuntimeError(f"line {number}: {reply}")
        if number % max(1, lines // 500) == 0:
            samples.append(resident(process.pid))
    process.stdin.close()
    if process.wait():
        raise RuntimeError(f"the planner ended with exit code {process.returncode}")
    return judge(f"planner over {lines:,} lines", samples)


PARTS = {
    "planner": lambda: planning(100_000),
    "single": lambda: training(30),
    "multi_sync": lambda: training(30, "collector=multi_sync"),
}


def main() -> None:
    for part in sys.argv[1:] or PARTS:
        sys.stdout.write(PARTS[part]() + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
