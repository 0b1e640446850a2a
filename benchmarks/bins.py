"""Measure what a choice among several items gains: python benchmarks/bins.py

Plays the test stream with 1 to 10 items to choose from, and with one item and previews of the next ones.
docs/results/bins.csv keeps what was measured, and bins.png beside it draws this. What is there is not played again; to
repeat a row, delete it. ``python benchmarks/bins.py mixed`` plays only this task, so that several processes can share
the work.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from common import ROOT, append_rows, evaluate, read_rows

from pickplace.views.figures import COLOURS, INK, figure_of

TABLE = ROOT / "docs" / "results" / "bins.csv"
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
    "gopt_rs": Task(
        "gopt_rs, no gripper", ("checkpoint=pretrained/gopt_buffer",), "[20,20,1]", (1, 3, 5, 10), (1, 4, 9)
    ),
    "plate_5x5": Task("gopt_rs, plate of 5x5", ("checkpoint=pretrained/plate_5x5",), "[20,20,1]", (1, 3, 5, 10)),
    "mixed": Task(
        "27 kinds, 8x8x8, gripper", ("checkpoint=pretrained/mixed", "env.tote_size=[8,8,8]"), "[8,8,1]", (1, 2, 3, 5),
        episodes=200,
    ),
    "plate_3x3": Task("gopt_rs, plate of 3x3", ("checkpoint=pretrained/plate_3x3",), "[20,20,1]", (1, 10)),
    "cdrl_rs": Task("cdrl_rs", ("checkpoint=pretrained/cdrl_rs",), "[20,20,1]", (1, 10)),
    "cut1": Task("cut1", ("checkpoint=pretrained/cut1",), "[20,20,1]", (1, 10)),
    "cut2": Task("cut2", ("checkpoint=pretrained/cut2",), "[20,20,1]", (1, 10)),
}  # fmt: skip
DRAWN = ("gopt_rs", "plate_5x5", "mixed")
#: Method -> its label, and words for pickplace-evaluate.
METHODS = {
    "beam": ("values, beam search", ("planner=beam", "physics=settle")),
    "values": ("values", ()),
    "best_fit": ("best_fit", ("planner=best_fit",)),
    "joint_dbl": ("joint_dbl", ("planner=joint_dbl",)),
}


class Cell(NamedTuple):
    """A method with one task; the first columns of the table."""

    task: str
    bin_items: int
    preview: int
    method: str

    @property
    def words(self) -> list[str]:
        """For pickplace-evaluate."""
        task, count, preview = TASKS[self.task], self.bin_items, self.preview
        episodes = task.episodes if self.method == "values" else EPISODES
        words = [*task.words, f"env.bin_items={count}", f"env.preview={preview}", f"evaluation.episodes={episodes}"]
        words += [f"env.bin_size={task.bin_size}"] if count > 1 else []
        words += [f"planner.depth={preview + 1}"] if preview else []  # looks at all of them
        return [*words, *METHODS[self.method][1]]


def cells(names: list[str]) -> Iterator[Cell]:
    """Yield what is played of some tasks."""
    for name in names:
        task = TASKS[name]
        yield from (Cell(name, count, 0, method) for count in task.counts for method in METHODS)
        yield from (Cell(name, 1, preview, "beam") for preview in task.previews)


def play(cell: Cell) -> dict:
    """Return a row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        result = evaluate(Path(folder, "run"), *cell.words)
    occupancy, physics = result["occupancy"], result.get("physics")
    row = {**cell._asdict(), "episodes": result["episodes"]}
    row |= {"mean": occupancy["mean"], "low": occupancy["ci95"][0], "high": occupancy["ci95"][1]}
    return row | {"settle_keeps": physics and physics["carried_out"]["mean"], "ms": result["latency_ms"]["p50"]}


def read() -> dict[Cell, dict]:
    """Return what was measured."""
    rows = {}
    for row in read_rows(TABLE):
        cell = Cell(row["task"], int(row["bin_items"]), int(row["preview"]), row["method"])
        rows[cell] = {key: float(row[key]) for key in ("mean", "low", "high")}
    return rows


def draw() -> None:
    """Draw the occupancy over the number of items to choose from, with intervals; an area for each task."""
    rows = read()
    names = [name for name in DRAWN if rows.keys() >= {*cells([name])}]  # a task that is being played waits
    figure = figure_of(10, 4)
    areas = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(areas, names, strict=True):
        for colour, (method, (label, _)) in zip(COLOURS, METHODS.items(), strict=False):
            counts = TASKS[name].counts
            line = [rows[Cell(name, count, 0, method)] for count in counts]
            errors = [[row["mean"] - row["low"] for row in line], [row["high"] - row["mean"] for row in line]]
            style = "-" if method in ("beam", "values") else "--"
            means = [row["mean"] for row in line]
            axes.errorbar(counts, means, errors, label=label, color=colour, marker="o", ls=style, capsize=3)
        axes.set_title(TASKS[name].label, fontsize=10)
        axes.set_xticks(TASKS[name].counts)
        axes.set_xlabel("items to choose from")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(colors=INK)
    areas[0].set_ylabel("occupancy, mean and 95% interval")
    figure.legend(*areas[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(TABLE.with_suffix(".png"), dpi=120)


def main(names: list[str]) -> None:
    if unknown := {*names} - {*TASKS}:
        sys.exit(f"unknown task {min(unknown)}; expected one of {', '.join(TASKS)}")
    known = read()
    for cell in cells(names or [*TASKS]):
        if cell not in known:
            append_rows(TABLE, [play(cell)])
    draw()


if __name__ == "__main__":
    main(sys.argv[1:])
