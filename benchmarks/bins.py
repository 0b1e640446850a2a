"""Measure the gain from a choice among several items in the bin: python benchmarks/bins.py

Every method plays the same 100 episodes of the test stream at 8x8x8 with mixed items, for each number of items in the
bin. Writes docs/results/bins.csv and docs/bins.png, and prints a table.
"""

import csv
import sys

from common import ROOT, evaluate

from pickplace.views.figures import COLOURS, INK, figure_of

TABLE, FIGURE, RUNS = ROOT / "docs" / "results" / "bins.csv", ROOT / "docs" / "bins.png", ROOT / "outputs" / "bins"
COUNTS = (1, 2, 3, 5)
VALUES, MIXED = ["checkpoint=pretrained/mixed"], ["items=mixed"]
#: Method -> its label, and words for pickplace-evaluate.
METHODS = {
    "learned": ("values of totes, any item", VALUES),
    "beam": ("values of totes, beam search", [*VALUES, "planner=beam"]),
    "learned_first": ("values of totes, first item that has a place", [*VALUES, "planner.item=first"]),
    "joint_dbl": ("joint_dbl, any item", ["planner=joint_dbl", *MIXED]),
    "joint_dbl_first": ("joint_dbl, first item that has a place", ["planner=joint_dbl", "planner.item=first", *MIXED]),
    "individual_first": ("individual_heuristic, first item", ["planner=individual_heuristic", *MIXED]),
    "individual_nearest": (
        "individual_heuristic, nearest item",
        ["planner=individual_heuristic", "planner.item=nearest", *MIXED],
    ),
}
COLUMNS = ("method", "bin_items", "episodes", "mean", "low", "high", "minus_learned", "minus_low", "minus_high", "ms")


def measure(method: str, count: int) -> dict:
    """Return a row of the table; episodes that were played before are not played again."""
    folder, learned = (RUNS / f"{name}-{count}" for name in (method, "learned"))
    words = [*METHODS[method][1], "env.tote_size=[8,8,8]", "env.bin_size=[8,8,1]", f"env.bin_items={count}"]
    if method != "learned":
        words.append(f"compare={learned / 'evaluation.json'}")
    result = evaluate(folder, *words)
    occupancy, paired = result["occupancy"], result.get("paired_difference")
    row = {"method": method, "bin_items": count, "episodes": result["episodes"], "ms": result["latency_ms"]["p50"]}
    row |= {"mean": occupancy["mean"], "low": occupancy["ci95"][0], "high": occupancy["ci95"][1]}
    if paired:
        row |= {"minus_learned": paired["mean"], "minus_low": paired["ci95"][0], "minus_high": paired["ci95"][1]}
    return row


def draw(rows: list[dict]) -> None:
    """Draw the occupancy over the number of items in the bin, with intervals."""
    figure = figure_of(8, 4.6)
    axes = figure.subplots()
    for colour, (method, (label, _)) in zip(COLOURS, METHODS.items(), strict=False):
        line = [row for row in rows if row["method"] == method]
        counts, means = [row["bin_items"] for row in line], [row["mean"] for row in line]
        errors = [[row["mean"] - row["low"] for row in line], [row["high"] - row["mean"] for row in line]]
        style = "-" if method in ("learned", "beam") else "--"
        axes.errorbar(counts, means, errors, label=label, color=colour, marker="o", ls=style, capsize=3)
    axes.set_xticks(COUNTS)
    axes.set_xlabel("items in the bin")
    axes.set_ylabel("occupancy, mean and 95% interval")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK)
    figure.legend(loc="outside right upper", frameon=False)
    figure.savefig(FIGURE, dpi=120)


def main() -> None:
    rows = [measure(method, count) for count in COUNTS for method in METHODS]
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: round(v, 4) if isinstance(v, float) else v for key, v in row.items()} for row in rows)
    draw(rows)
    lines = ["| method | " + " | ".join(f"M={count}" for count in COUNTS) + " |", "|---" * (len(COUNTS) + 1) + "|"]
    for method, (label, _) in METHODS.items():
        cells = [
            f"{row['mean']:.3f} ({row['low']:.3f} to {row['high']:.3f})" for row in rows if row["method"] == method
        ]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
