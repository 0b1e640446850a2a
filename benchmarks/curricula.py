"""Count the frames that a policy needs with each curriculum: python benchmarks/curricula.py [mixed|gopt_rs] [seeds]

A training ends at the first validation that reaches 95% of the occupancy of the shipped weights, or after the frames of
its preset. What was trained before is read, and what was stopped goes on. Writes docs/results/curricula.csv.
"""

import csv
import json
import sys

from common import ROOT, run

from pickplace.runs.loggers import read_csv

TABLE, RUNS = ROOT / "docs" / "results" / "curricula.csv", ROOT / "outputs" / "curricula"
#: Problem -> occupancy that is to be reached, and words of the training.
PROBLEMS = {
    "mixed": (0.95 * 0.8879, ["experiment=mixed", "evaluation_interval=50_000", "evaluation.episodes=256"]),
    "gopt_rs": (
        0.95 * 0.8053,
        ["experiment=afterstate", "benchmark=gopt_rs", "evaluation_interval=8_000"],
    ),
}
#: Small items first: the greatest side of each level, of the greatest side of all. The tote of each level, if it grows.
SMALL = {"mixed": (2, None), "gopt_rs": (3, 4, None)}
TOTES = {"mixed": (4, None), "gopt_rs": (6, 8, None)}


def levels(problem: str, grows: bool) -> str:
    """Return ``curriculum.levels`` with items from small to large, and with a tote that grows along."""
    each = []
    for side, height in zip(SMALL[problem], TOTES[problem], strict=True):
        items = {"items": {key: [1, side] for key in ("width", "depth", "height")}} if side else {}
        each.append(items | ({"tote_height": height} if grows and height else {}))
    return f"curriculum.levels={json.dumps(each).replace(': ', ':')}".replace('"', "")


def curricula(problem: str) -> dict[str, list[str]]:
    """Return the words of each curriculum. A level ends when it is packed well, or after 50,000 frames."""
    staircase = ["curriculum=adaptive", "curriculum.advance.occupancy=0.75"]
    staircase.append("curriculum.advance.max_frames_per_level=50_000")
    return {
        "none": ["curriculum=none"],
        "height": staircase,
        "items": [*staircase, levels(problem, grows=False)],
        "both": [*staircase, levels(problem, grows=True)],
        "learning_progress": ["curriculum=learning_progress", levels(problem, grows=True)],
    }


def measure(problem: str, name: str, seed: int) -> dict:
    """Return a row of the table."""
    target, words = PROBLEMS[problem]
    folder = RUNS / problem / f"{name}-{seed}"
    if not (folder / "report.html").is_file():
        ending = ["callbacks=early_stopping", f"callbacks.early_stopping.occupancy={target}", "threads=1"]
        new = [*words, *curricula(problem)[name], *ending, f"seed={seed}", f"hydra.run.dir={folder}"]
        run("pickplace-train", *([f"resume={folder}"] if (folder / "checkpoints").is_dir() else new))
    rows = [row for row in read_csv(folder / "metrics.csv") if "eval/occupancy" in row]
    reached = [row["frames"] for row in rows if row["eval/occupancy"] >= target]
    row = {"problem": problem, "curriculum": name, "seed": seed, "target": target, "frames": min(reached, default="")}
    return row | {"last": rows[-1]["eval/occupancy"], "trained": rows[-1]["frames"]}


def main() -> None:
    given = sys.argv[1:]
    problems, seeds = given[:1] or [*PROBLEMS], range(int((given[1:] or ["3"])[0]))
    cases = [(problem, name, seed) for problem in problems for seed in seeds for name in curricula(problem)]
    rows = [measure(*case) for case in cases]
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
