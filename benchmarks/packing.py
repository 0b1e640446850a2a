"""Play the public packing benchmarks, without a gripper and with one: python benchmarks/packing.py

Writes docs/results/packing.csv after each row, and prints it. All rows take hours; `--match` plays some, such as
`^cut1`, and the others of the file stay as they are.
"""

import argparse
import csv
import json
import re
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path
from typing import NamedTuple

from common import console_command

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "docs" / "results" / "packing.csv"
PLATES = ("plate_3x3", "plate_5x5")
SCALED = ("gopt_30", "gopt_50", "gopt_100")
#: By their names in the table. Those that pick first grip the item in its middle, whatever lies in the tote.
PLANNERS = {
    "learned": [],
    "learned_pick_first": ["planner.pick=middle"],
    "joint_dbl": ["planner=joint_dbl"],
    "dbl_pick_first": ["planner=individual_heuristic", "planner.candidates=cells", "planner.pick=middle"],
}
#: Rotations of the weights; ``pct1`` and the larger totes have those of ``gopt_rs``.
TRAINED = {"gopt_rs": 2, "pct1": 2, "cdrl_rs": 1, "cut1": 1, "cut2": 1}
COLUMNS = ("benchmark", "effector", "rotations", "planner", "episodes", "mean", "low", "high")
COLUMNS += ("kept", "kept_low", "kept_high", "ms")


class Row(NamedTuple):
    """Row of the table: options of ``benchmark`` and ``effector``, rotations, and the planner's name in the table."""

    benchmark: str
    effector: str
    rotations: int
    planner: str

    @property
    def name(self) -> str:
        return f"{self.benchmark}-{self.effector}-R{self.rotations}-{self.planner}"

    def words(self) -> list[str]:
        """Return overrides of pickplace-evaluate."""
        weights = self.benchmark if self.benchmark in ("cdrl_rs", "cut1", "cut2") else "gopt_rs"
        learned = self.planner.startswith("learned")
        words = [f"benchmark={self.benchmark}", f"effector={self.effector}", f"env.rotations={self.rotations}"]
        words += [f"checkpoint=pretrained/{weights}" if learned else "evaluation.episodes=300"]
        return [*words, *PLANNERS[self.planner], "physics=settle", "evaluation.replay=0", "threads=1"]


def rows() -> list[Row]:
    """Return all rows: without a gripper and with one; then the larger totes.

    Weights serve no more rotations than they were trained with. A point has but one way to pick.
    """
    listed = []
    for name, rotations in TRAINED.items():
        listed += [Row(name, "point", rotations, planner) for planner in ("learned", "joint_dbl")]
        for plate, turns in product(PLATES, (2, 4)):
            listed += [
                Row(name, plate, turns, planner)
                for planner in PLANNERS
                if turns == rotations or not planner.startswith("learned")
            ]
    return listed + [Row(name, "point", 2, "learned") for name in SCALED]


def play(row: Row) -> dict:
    """Return a line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        words = [console_command("pickplace-evaluate"), *row.words(), f"hydra.run.dir={folder}/run"]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL, cwd=ROOT)
        result = json.loads(Path(folder, "run", "evaluation.json").read_text())
    occupancy, kept = result["occupancy"], result["physics"]["carried_out"]
    line = {**row._asdict(), "episodes": result["episodes"], "ms": result["latency_ms"]["p50"]}
    line |= {"mean": occupancy["mean"], "low": occupancy["ci95"][0], "high": occupancy["ci95"][1]}
    return line | {"kept": kept["mean"], "kept_low": kept["ci95"][0], "kept_high": kept["ci95"][1]}


def update(row: Row, line: dict) -> None:
    """Write a line into the table, which has those of :func:`rows` in their order."""
    with TABLE.open(newline="") as file:
        lines = {Row(*list(old.values())[:4]).name: old for old in csv.DictReader(file)}
    lines[row.name] = {key: round(value, 4) if isinstance(value, float) else value for key, value in line.items()}
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines[name] for each in rows() if (name := each.name) in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--match", default="", help="regular expression; plays the rows in whose name it is found")
    match = parser.parse_args().match
    for row in rows():
        if re.search(match, row.name):
            line = play(row)
            update(row, line)
            share = " ".join(f"{100 * line[key]:.1f}" for key in COLUMNS[5:11])
            sys.stdout.write(f"{row.name} | {line['episodes']} | {share} | {line['ms']:.1f} ms\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
