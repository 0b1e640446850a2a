"""Time of a training batch, with and without worker processes: python benchmarks/workers.py

``collector=single`` and ``multi_sync`` train in turn. A batch's time is that of collecting it and learning from it.
"""

import subprocess
import tempfile
from pathlib import Path

from common import console_command, save, spread

from pickplace.runs.loggers import read_csv

FRAMES, REPEATS = 65_536, 3
NO_EVALUATION = ["evaluation_interval=1_000_000_000", "evaluation.episodes=1", "evaluation.batch_size=1"]
CASES = {
    "`quick`, all cores": ["experiment=quick", "threads=null"],
    "`quick`, one thread a process": ["experiment=quick"],
    "`quick`, one thread a process, one pass over a batch": ["experiment=quick", "algo.epochs=1"],
}
COLLECTORS = {"single": ["collector=single"], "multi_sync, 2 workers": ["collector=multi_sync", "collector.workers=2"]}


def batches(overrides: list[str]) -> list[float]:
    """Return the milliseconds of each batch of a training, without the first four, which warm up."""
    with tempfile.TemporaryDirectory() as folder:
        command = [console_command("pickplace-train"), f"total_frames={FRAMES}", *overrides, *NO_EVALUATION]
        command += [f"hydra.run.dir={folder}/run"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        rows = read_csv(Path(folder) / "run" / "metrics.csv")
    return [row["time/collect_ms"] + row["time/update_ms"] for row in rows[4:]]


def main() -> None:
    times = {case: {name: [] for name in COLLECTORS} for case in CASES}
    for _ in range(REPEATS):
        for case, overrides in CASES.items():
            for name, collector in COLLECTORS.items():
                times[case][name] += batches([*overrides, *collector])
    rows = {case: {name: spread(values) for name, values in row.items()} for case, row in times.items()}
    save("workers", {"frames": FRAMES, "repeats": REPEATS, "rows": rows})


if __name__ == "__main__":
    main()
