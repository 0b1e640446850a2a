"""Measure what a choice among several items gains: python benchmarks/bins.py

Plays the test stream with 1 to 10 items to choose from, and with one item and previews of the next ones. Writes
docs/results/bins.csv and docs/results/bins.png, and prints a table. outputs/bins keeps what was played, so that it is
not played again. ``python benchmarks/bins.py gopt_rs`` plays only this task, so that several processes can share the
work; the table and the figure then wait for the others. Delete outputs/bins after a change of what is played.
"""

import csv
import sys
from typing import NamedTuple

from common import ROOT, evaluate

from pickplace.views.figures import COLOURS, INK, figure_of

RESULTS, RUNS = ROOT / "docs" / "results", ROOT / "outputs" / "bins"
EPISODES = 100  # of all methods but values


class Task(NamedTuple):
    """Items, tote, gripper and weights."""

    label: str
    words: tuple[str, ...]  # for pickplace-evaluate
    bin_size: str  # with several items: room for all of them nearly always
    counts: tuple[int, ...]  # of items to choose from
    previews: tuple[int, ...] = ()  # of the next items, with one item to choose from
    episodes: int = 1000  # of the values without search


TASKS = {
    "gopt_rs": Task("gopt_rs, no gripper", ("checkpoint=pretrained/gopt_rs",), "[20,20,1]", (1, 3, 5, 10), (1, 4, 9)),
    "plate_5x5": Task("gopt_rs, plate of 5x5", ("checkpoint=pretrained/plate_5x5",), "[20,20,1]", (1, 3, 5, 10)),
    "mixed": Task(
        "27 kinds, 8x8x8, gripper", ("checkpoint=pretrained/mixed", "env.tote_size=[8,8,8]"), "[8,8,1]", (1, 2, 3, 5),
        episodes=200,
    ),
}  # fmt: skip
#: Method -> its label, and words for pickplace-evaluate.
METHODS = {
    "beam": ("values, beam search", ("planner=beam", "physics=settle")),
    "values": ("values", ()),
    "best_fit": ("best_fit", ("planner=best_fit",)),
    "joint_dbl": ("joint_dbl", ("planner=joint_dbl",)),
}
COLUMNS = ("task", "bin_items", "preview", "method", "episodes", "mean", "low", "high", "settle_keeps", "ms")


def measure(name: str, count: int, preview: int, method: str) -> dict:
    """Return a row of the table."""
    task = TASKS[name]
    episodes = task.episodes if method == "values" else EPISODES
    words = [*task.words, f"env.bin_items={count}", f"env.preview={preview}", f"evaluation.episodes={episodes}"]
    words += [f"env.bin_size={task.bin_size}"] if count > 1 else []
    words += [f"planner.depth={preview + 1}"] if preview else []  # looks at all of them
    result = evaluate(RUNS / f"{name}-{count}-{preview}-{method}", *words, *METHODS[method][1])
    occupancy, physics = result["occupancy"], result.get("physics")
    row = {"task": name, "bin_items": count, "preview": preview, "method": method, "episodes": result["episodes"]}
    row |= {"mean": occupancy["mean"], "low": occupancy["ci95"][0], "high": occupancy["ci95"][1]}
    return row | {"settle_keeps": physics and physics["carried_out"]["mean"], "ms": result["latency_ms"]["p50"]}


def draw(rows: list[dict]) -> None:
    """Draw the occupancy over the number of items to choose from, with intervals; an area for each task."""
    figure = figure_of(10, 4)
    areas = figure.subplots(1, len(TASKS), sharey=True)
    for axes, (name, task) in zip(areas, TASKS.items(), strict=True):
        for colour, (method, (label, _)) in zip(COLOURS, METHODS.items(), strict=False):
            line = [row for row in rows if (row["task"], row["method"], row["preview"]) == (name, method, 0)]
            counts, means = [row["bin_items"] for row in line], [row["mean"] for row in line]
            errors = [[row["mean"] - row["low"] for row in line], [row["high"] - row["mean"] for row in line]]
            style = "-" if method in ("beam", "values") else "--"
            axes.errorbar(counts, means, errors, label=label, color=colour, marker="o", ls=style, capsize=3)
        axes.set_title(task.label, fontsize=10)
        axes.set_xticks(task.counts)
        axes.set_xlabel("items to choose from")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(colors=INK)
    areas[0].set_ylabel("occupancy, mean and 95% interval")
    figure.legend(*areas[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(RESULTS / "bins.png", dpi=120)


def main(names: list[str]) -> None:
    if unknown := {*names} - {*TASKS}:
        sys.exit(f"unknown task {min(unknown)}; expected one of {', '.join(TASKS)}")
    rows = []
    for name in names or TASKS:
        task = TASKS[name]
        rows += [measure(name, count, 0, method) for count in task.counts for method in METHODS]
        rows += [measure(name, 1, preview, "beam") for preview in task.previews]
    if names:
        return
    with (RESULTS / "bins.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: round(v, 4) if isinstance(v, float) else v for key, v in row.items()} for row in rows)
    draw(rows)
    sys.stdout.write((RESULTS / "bins.csv").read_text())


if __name__ == "__main__":
    main(sys.argv[1:])
