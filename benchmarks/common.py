"""What the benchmarks share: one core, interleaved timing, medians and spread, and where the figures go."""

import json
import os
import platform
import statistics
import sys
import time
from pathlib import Path

RESULTS = Path(__file__).parent / "results"


def use_one_core() -> None:
    """Pin this process to one core and torch to one thread, so that every library has the same machine."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    import torch

    torch.set_num_threads(1)


def interleave(functions: dict, repeats: int, warmup: int = 2) -> dict[str, dict[str, float]]:
    """Time functions in turn, so that a noisy moment hits all of them alike.

    Args:
        functions: name -> function without arguments, which returns when its work is done.
        repeats: how often each is timed.
        warmup: untimed calls before.

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
    """Median and the 10th and 90th percentile of times in milliseconds."""
    ordered = sorted(values)
    pick = [ordered[round(share * (len(ordered) - 1))] for share in (0.1, 0.9)]
    return {"ms": statistics.median(ordered), "low": pick[0], "high": pick[1], "repeats": len(ordered)}


def machine() -> dict:
    """What the figures were measured on."""
    import torch

    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        model = next(
            (line.split(":")[1].strip() for line in info.read_text().splitlines() if "model name" in line), model
        )
    bf16 = torch.backends.cpu.get_cpu_capability() if hasattr(torch.backends.cpu, "get_cpu_capability") else "unknown"
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "capability": bf16,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def save(name: str, result: dict) -> None:
    """Write a benchmark's figures to ``benchmarks/results/<name>.json``."""
    RESULTS.mkdir(exist_ok=True)
    text = json.dumps({"machine": machine(), **result}, indent=1) + "\n"
    (RESULTS / f"{name}.json").write_text(text)
    sys.stdout.write(text)
