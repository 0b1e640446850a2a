"""Count the frames that a policy needs with each curriculum, with three seeds: python benchmarks/curricula.py

A training ends at the first validation that reaches 95% of the occupancy of the shipped weights. It also ends after
about three times the frames that this takes without a curriculum. Finished trainings are read, stopped ones go on.
Writes docs/results/curricula.csv.
"""

import csv
import json
from itertools import product

from common import ROOT, run

from pickplace.runs.loggers import read_csv

TABLE, RUNS = ROOT / "docs" / "results" / "curricula.csv", ROOT / "outputs" / "curricula"
#: Problem -> occupancy to reach, and words of the training.
PROBLEMS = {
    "mixed": (
        0.95 * 0.8879,
        ["experiment=mixed_grasp", "total_frames=1_000_000", "evaluation_interval=50_000", "evaluation.episodes=256"],
    ),
    "gopt_rs": (
        0.95 * 0.8053,
        ["experiment=afterstate", "benchmark=gopt_rs", "total_frames=240_000", "evaluation_interval=8_000"],
    ),
}
#: Greatest side of the items and height of the tote at each level; None: as in the full task.
SIDES = {"mixed": (2, None), "gopt_rs": (3, 4, None)}
TOTES = {"mixed": (4, None), "gopt_rs": (6, 8, None)}
#: Frames after which a staircase leaves a level, even if it is not packed well yet: a share of the full task's frames.
FRAMES = {"mixed": 50_000, "gopt_rs": 10_000}


def levels(problem: str, items: bool = False, height: bool = False) -> str:
    """Return ``curriculum.levels`` with items from small to large, a tote that grows, or both."""
    each = []
    for side, top in zip(SIDES[problem], TOTES[problem], strict=True):
        small = {"items": {key: [1, side] for key in ("width", "depth", "height")}} if items and side else {}
        each.append(small | ({"tote_height": top} if height and top else {}))
    return f"curriculum.levels={json.dumps(each).replace(': ', ':')}".replace('"', "")


def curricula(problem: str) -> dict[str, list[str]]:
    """Return the words of each curriculum. A level of a staircase ends when it is packed well, or after some frames."""
    staircase = ["curriculum=adaptive", "curriculum.advance.occupancy=0.75"]
    staircase.append(f"curriculum.advance.max_frames_per_level={FRAMES[problem]}")
    return {
        "none": ["curriculum=none"],
        "height": [*staircase, levels(problem, height=True)],
        "items": [*staircase, levels(problem, items=True)],
        "both": [*staircase, levels(problem, items=True, height=True)],
        "learning_progress": ["curriculum=learning_progress", levels(problem, items=True, height=True)],
    }


def measure(problem: str, name: str, seed: int) -> dict:
    """Return a row of the table."""
    target, words = PROBLEMS[problem]
    folder = RUNS / problem / f"{name}-{seed}"
    if not (folder / "report.html").is_file():
        ending = ["callbacks=early_stopping", f"callbacks.early_stopping.occupancy={target}", "threads=1"]
        ending.append("algo.lr_decay_start=null")
        new = [*words, *curricula(problem)[name], *ending, f"seed={seed}", f"hydra.run.dir={folder}"]
        run("pickplace-train", *([f"resume={folder}"] if (folder / "checkpoints").is_dir() else new))
    rows = [row for row in read_csv(folder / "metrics.csv") if "eval/occupancy" in row]
    reached = [row["frames"] for row in rows if row["eval/occupancy"] >= target]
    row = {"problem": problem, "curriculum": name, "seed": seed, "target": target, "frames": min(reached, default="")}
    return row | {"last": rows[-1]["eval/occupancy"], "trained": rows[-1]["frames"]}


def main() -> None:
    rows = []
    for problem, seed in product(PROBLEMS, range(3)):
        for name in curricula(problem):
            rows.append(measure(problem, name, seed))
            with TABLE.open("w", newline="") as file:
                writer = csv.DictWriter(file, rows[0])
                writer.writeheader()
                writer.writerows(rows)


if __name__ == "__main__":
    main()
