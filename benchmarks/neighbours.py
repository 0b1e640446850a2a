"""Training beside two processes that keep two cores busy: python benchmarks/neighbours.py"""

import os
import statistics
import subprocess
import sys
from contextlib import ExitStack, contextmanager

from common import save
from workers import batches

REPEATS = 3
QUICK = ["experiment=quick", "total_frames=24_576"]
#: Case -> overrides, and how OpenMP's threads wait (docs/performance.md).
CASES = {
    "`quick`: one thread": (QUICK, "PASSIVE"),
    "`threads=null`: a thread for each core": ([*QUICK, "threads=null"], "PASSIVE"),
    "`threads=null`, `OMP_WAIT_POLICY=ACTIVE`": ([*QUICK, "threads=null"], "ACTIVE"),
}


@contextmanager
def busy_process():
    """Keep a core busy."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def main() -> None:
    speeds = {case: {"idle": [], "busy": []} for case in CASES}
    for _ in range(REPEATS):
        for neighbours, when in ((0, "idle"), (2, "busy")):
            with ExitStack() as stack:
                for _ in range(neighbours):
                    stack.enter_context(busy_process())
                for case, (overrides, policy) in CASES.items():
                    os.environ["OMP_WAIT_POLICY"] = policy
                    speeds[case][when] += [2048e3 / ms for ms in batches(overrides)]
    rows = {case: {when: statistics.median(values) for when, values in row.items()} for case, row in speeds.items()}
    save("neighbours", {"repeats": REPEATS, "frames per second": rows})


if __name__ == "__main__":
    main()
