"""Play the public packing benchmarks, without a gripper and with one: python benchmarks/packing.py

Writes docs/results/packing.csv, leaderboard.png beside it, and the tables of docs/benchmarks.md after each row, and
prints the row. All rows take hours. `--match` plays only some, such as `^cut1`, and keeps the others; `--tables` plays
none.
"""

import argparse
import csv
import re
import sys
import tempfile
from itertools import product
from pathlib import Path
from typing import NamedTuple

from common import ROOT, evaluate, write_tables

from pickplace.views.figures import COLOURS, INK, figure_of

TABLE, PAGE = ROOT / "docs" / "results" / "packing.csv", ROOT / "docs" / "benchmarks.md"
PLATES = {"plate_3x3": 3, "plate_5x5": 5}
SCALED = {"gopt_30": 3, "gopt_50": 5, "gopt_100": 10}  # factor of the cells along each side to gopt_rs
#: By their names in the table. Those that pick first grip the item in its middle, independent of the tote.
PLANNERS = {
    "learned": [],
    "learned_pick_first": ["planner.pick=middle"],
    "joint_dbl": ["planner=joint_dbl"],
    "dbl_pick_first": ["planner=individual_heuristic", "planner.candidates=cells", "planner.pick=middle"],
}
#: Rotations of the weights; ``pct1`` and the larger totes use the weights of ``gopt_rs``.
TRAINED = {"gopt_rs": 2, "pct1": 2, "cdrl_rs": 1, "cut1": 1, "cut2": 1}
#: The best published result, and others; the page names their sources.
PUBLISHED = {
    "gopt_rs": ("GOPT 76.1", "Xiong 73.8, PCT 72.7, Zhao 70.9"),
    "gopt_30": ("GOPT 76.0", ""),
    "gopt_50": ("GOPT 75.8", ""),
    "gopt_100": ("GOPT 76.3", ""),
    "pct1": ("AR2L 77.6 (a reproduction)", "PCT 76.0"),
    "cdrl_rs": ("Zhao 50.5", ""),
    "cut1": ("Zhao 73.4", ""),
    "cut2": ("Zhao 66.9", ""),
}
#: The benchmarks in the figure.
LABELS = {"gopt_rs": "GOPT", "pct1": "PCT", "cdrl_rs": "Zhao, random", "cut1": "Zhao, CUT-1", "cut2": "Zhao, CUT-2"}
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
        if self.benchmark == "gopt_rs" and self.effector in PLATES:
            weights = self.effector
        learned = self.planner.startswith("learned")
        words = [f"benchmark={self.benchmark}", f"gripper={self.effector}", f"env.rotations={self.rotations}"]
        words += [f"checkpoint=pretrained/{weights}" if learned else "evaluation.episodes=300"]
        if self.benchmark in SCALED and self.effector in PLATES:  # the plate grows with the tote
            scale, side = SCALED[self.benchmark], PLATES[self.effector] * SCALED[self.benchmark]
            words += [f"env.gripper.size=[{side},{side}]", f"env.gripper.cup_size=[{scale},{scale}]"]
        return [*words, *PLANNERS[self.planner], "physics=settle"]


def rows() -> list[Row]:
    """Return all rows: without a gripper and with one, then the larger totes.

    Weights serve at most the rotations of their training. A point has only one way to pick.
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
    for name in SCALED:
        listed += [Row(name, "point", 2, "learned")]
        if name == "gopt_30":  # the others take hours
            listed += [Row(name, plate, 2, planner) for plate in PLATES for planner in ("learned", "joint_dbl")]
    return listed


def play(row: Row) -> dict:
    """Return a line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        result = evaluate(Path(folder, "run"), *row.words())
    occupancy, kept = result["occupancy"], result["physics"]["carried_out"]
    line = {**row._asdict(), "episodes": result["episodes"], "ms": result["latency_ms"]["p50"]}
    line |= {"mean": occupancy["mean"], "low": occupancy["ci95"][0], "high": occupancy["ci95"][1]}
    return line | {"kept": kept["mean"], "kept_low": kept["ci95"][0], "kept_high": kept["ci95"][1]}


def read() -> dict[str, dict]:
    """Return the lines of the table, by the names of their rows."""
    with TABLE.open(newline="") as file:
        return {Row(*list(line.values())[:4]).name: line for line in csv.DictReader(file)}


def update(row: Row, line: dict) -> None:
    """Write a line into the table, which keeps the order of :func:`rows`."""
    lines = read()
    lines[row.name] = {key: round(value, 4) if isinstance(value, float) else value for key, value in line.items()}
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines[name] for each in rows() if (name := each.name) in lines)


def interval(line: dict | None, column: str = "mean") -> str:
    """Return a mean with its interval in per cent, ``81.04 (80.69 to 81.39)``; empty if there is no line."""
    names = (column, "low", "high") if column == "mean" else (column, f"{column}_low", f"{column}_high")
    return "" if line is None else "{:.2f} ({:.2f} to {:.2f})".format(*(100 * float(line[name]) for name in names))


def leaderboard(lines: dict[str, dict]) -> list[str]:
    """Return the table without a gripper."""
    made = ["| `benchmark=` | best published | others | ours, learned | episodes | `settle` keeps, % |"]
    made.append("|---|---|---|---|---|---|")
    for name, published in PUBLISHED.items():
        line = lines[Row(name, "point", TRAINED.get(name, 2), "learned").name]
        cells = [f"`{name}`", *published, f"**{interval(line)}**", f"{int(line['episodes']):,}", interval(line, "kept")]
        made.append(f"| {' | '.join(cells)} |")
    return made


def gripper_table(lines: dict[str, dict]) -> list[str]:
    """Return the table of ``gopt_rs`` with and without a gripper."""
    made = ["| `gripper=` | learned | learned, picks first | DBL | DBL, picks first |"]
    made[0] += " `settle` keeps, %: learned | `settle` keeps, %: DBL |"
    made.append("|---" * 7 + "|")
    for effector in ("point", *PLATES):
        found = {planner: lines.get(Row("gopt_rs", effector, 2, planner).name) for planner in PLANNERS}
        cells = [f"`{effector}`", *map(interval, found.values())]
        cells += [interval(found[planner], "kept") for planner in ("learned", "joint_dbl")]
        made.append(f"| {' | '.join(cells)} |")
    return made


def draw(lines: dict[str, dict]) -> None:
    """Draw ours beside the published results."""
    figure, names = figure_of(7, 3.2), list(LABELS)[::-1]
    axes = figure.subplots()
    for place, name in enumerate(names):
        published = sorted(re.findall(r"(\w+) ([\d.]+)", " ".join(PUBLISHED[name])), key=lambda each: float(each[1]))
        ours = 100 * float(lines[Row(name, "point", TRAINED[name], "learned").name]["mean"])
        axes.plot([float(published[0][1]), ours], [place] * 2, color="#d9d9d9", lw=2, zorder=1)
        for number, (method, value) in enumerate(published):
            axes.plot(float(value), place, "o", color=COLOURS[-1], ms=7)
            raised = 7 if number % 2 == 0 else -15  # else the names of neighbours would overlap
            at = {"xytext": (0, raised), "textcoords": "offset points", "ha": "center"}
            axes.annotate(method, (float(value), place), fontsize=8, color=INK, **at)
        axes.plot(ours, place, "o", color=COLOURS[5], ms=10)
        at = {"xytext": (9, 0), "textcoords": "offset points", "va": "center"}
        axes.annotate(f"{ours:.1f}", (ours, place), color=COLOURS[5], weight="bold", **at)
    axes.set_yticks(range(len(names)), [LABELS[name] for name in names])
    axes.set(ylim=(-0.6, len(names) - 0.4), xlabel="filled share of the tote, %")
    axes.margins(x=0.08)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK)
    axes.plot([], [], "o", color=COLOURS[5], ms=10, label="pickplace")
    axes.plot([], [], "o", color=COLOURS[-1], ms=7, label="published")
    axes.legend(loc="lower right", frameon=False)
    figure.savefig(TABLE.with_name("leaderboard.png"), dpi=120)


def write_page() -> None:
    """Write both tables into the page, and draw the figure."""
    lines = read()
    draw(lines)
    write_tables(PAGE, {"leaderboard": leaderboard(lines), "gripper": gripper_table(lines)})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--match", default="", help="regular expression; plays the rows in whose name it is found")
    parser.add_argument("--tables", action="store_true", help="write the tables only")
    options = parser.parse_args()
    for row in [] if options.tables else rows():
        if re.search(options.match, row.name):
            line = play(row)
            update(row, line)
            share = " ".join(f"{100 * line[key]:.1f}" for key in COLUMNS[5:11])
            sys.stdout.write(f"{row.name} | {line['episodes']} | {share} | {line['ms']:.1f} ms\n")
            sys.stdout.flush()
            write_page()
    write_page()


if __name__ == "__main__":
    main()
