"""Helpers of the benchmarks: run commands, keep rows, use one core, time functions in turn, save results."""

import csv
import fcntl
import io
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

# Waiting threads spin, here and in the commands, as the machine is idle. OpenMP reads this when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "ACTIVE")

import torch  # noqa: E402

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"


def use_one_core() -> None:
    """Pin this process to one core and torch to one thread, so that every library has the same resources."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    torch.set_num_threads(1)


def console_command(name: str) -> str:
    """Return the path of a command that this environment's packages install, such as ``pickplace-train``."""
    return str(Path(sys.executable).with_name(name))


def run(name: str, *words: str) -> None:
    """Run a command of the package in the root of the checkout."""
    subprocess.run([console_command(name), *words], check=True, stdout=subprocess.DEVNULL, cwd=ROOT)


def evaluate(folder: Path, *words: str) -> dict:
    """Return the ``evaluation.json`` in a folder; play the evaluation first if it is missing."""
    path = folder / "evaluation.json"
    if not path.is_file():
        run("pickplace-evaluate", *words, "evaluation.replay=0", "threads=1", f"hydra.run.dir={folder}")
    return json.loads(path.read_text())


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file; none without the file."""
    return list(csv.DictReader(path.open(newline=""))) if path.is_file() else []


def append_rows(path: Path, rows: Iterable[dict]) -> None:
    """Add rows to a CSV file, to which other processes may add some, too; a new file begins with its columns' names."""
    path.parent.mkdir(exist_ok=True)
    with path.open("a", newline="") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        for row in rows:
            writer = csv.DictWriter(file, row, lineterminator="\n")
            if file.seek(0, io.SEEK_END) == 0:
                writer.writeheader()
            writer.writerow({key: round(v, 5) if isinstance(v, float) else v for key, v in row.items()})
            file.flush()


def interleave(functions: dict, repeats: int, warmup: int = 2) -> dict[str, dict[str, float]]:
    """Time functions in turn, so that a noisy moment affects all of them.

    Args:
        functions: name -> function without arguments, which returns when its work is done.
        repeats: number of timed calls of each function.
        warmup: number of untimed calls before these.

    Returns:
        name -> ``{"ms": median, "low": 10th percentile, "high": 90th percentile, "repeats": n}``.
    """
    for _ in range(warmup):
        for function in functions.values():
            function()
    times = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append((time.perf_counter() - start) * 1e3)
    return {name: spread(values) for name, values in times.items()}


def spread(values: list[float]) -> dict[str, float]:
    """Return the median and the 10th and 90th percentile of times in milliseconds."""
    ordered = sorted(values)
    low, high = (ordered[round(share * (len(ordered) - 1))] for share in (0.1, 0.9))
    return {"ms": statistics.median(ordered), "low": low, "high": high, "repeats": len(ordered)}


def write_tables(page: Path, tables: dict[str, list[str]]) -> None:
    """Write tables into a page, each between ``<!-- name: ... -->`` and ``<!-- end -->``, which must be there."""
    text = page.read_text()
    for name, lines in tables.items():
        before, mark, rest = re.split(rf"(<!-- {name}: [^\n]*-->\n)", text)
        text = before + mark + "\n".join(["", *lines, "", "<!-- end -->"]) + rest.partition("<!-- end -->")[2]
    page.write_text(text)


def machine() -> dict:
    """Return the processor, its threads and the versions of a measurement."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.split(":")[1].strip() for line in lines if "model name" in line]
    return {
        "cpu": models[0] if models else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "capability": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def save(name: str, result: dict) -> None:
    """Write a benchmark's figures to ``benchmarks/results/<name>.json``."""
    RESULTS.mkdir(exist_ok=True)
    text = json.dumps({"machine": machine(), **result}, indent=1) + "\n"
    (RESULTS / f"{name}.json").write_text(text)
    sys.stdout.write(text)
