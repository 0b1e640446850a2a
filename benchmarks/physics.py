"""Measure how well plans hold in a physics engine: python benchmarks/physics.py

Plans of the test stream are carried out by `settle` or `execute`. A row of docs/results/physics.csv is a set of totes:

- each stability rule, 200 totes at friction 0.6 and a gap of 1 mm, and 50 at other values, one changed at a time;
- methods with and without joint planning, 100 totes, `execute`;
- the trained policy on 27 kinds of items, 50 totes, `execute`, with errors of placement, other gaps and frictions.

Existing rows are not computed again, so the run can be stopped and started again. To use several cores, start several
runs with different --match; each kind of items has its own plans. Prints the tables of docs/physics.md, and draws
docs/physics.png.
"""

import argparse
import csv
import fcntl
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch
from common import ROOT, evaluate, run

from pickplace import PickPlaceEnv
from pickplace.config.registry import build
from pickplace.evaluation.result import confidence95, proportion95
from pickplace.physics.plans import EpisodePlan, Placement, read_plans
from pickplace.rules.item import Item

TABLE, RUNS = ROOT / "docs" / "results" / "physics.csv", ROOT / "outputs" / "physics"
ITEMS = {"kinds": "6x6x5", "mixed": "8x8x8", "tall": "6x6x5"}
RULES = ("half", "more_than_half", "hull", "bearing", "bearing+0.25", "full")  # and the margin after the +
OF_METHODS = "bearing+0.25"  # the rule under which methods are compared
#: Words for pickplace-evaluate that name what decides; rectpack plans only places.
METHODS = {
    "rectpack": None,
    "individual_heuristic": ["planner=individual_heuristic"],
    "individual_grasp": ["checkpoint=outputs/physics/train/individual_grasp-R{R}"],  # trained here, see `plan`
    "joint_dbl": ["planner=joint_dbl"],
    "fcn_grasp": ["checkpoint=pretrained/{weights}"],
    "random": ["planner=random"],
}
COMPARED = [name for name in METHODS if name != "random"]
#: Friction and gap of the second table.
CONDITIONS = ((0.3, 1.0), (0.9, 1.0), (0.6, 0.0), (0.6, 3.0))
#: Panels of the figure: the varied quantity, the legend, and friction, gap and noise of each point.
ROBUSTNESS = (
    ("error of placement, standard deviation, mm", "gap 1 mm", [(0.6, 1.0, noise) for noise in (0.0, 0.5, 1.0, 2.0)]),
    ("error of placement, standard deviation, mm", "gap 4 mm", [(0.6, 4.0, n) for n in (0.0, 0.5, 1.0, 2.0, 3.0, 5.0)]),
    ("gap, mm", "no error", [(0.6, gap, 0.0) for gap in (0.0, 1.0, 2.0, 3.0, 4.0)]),
    ("friction", "gap 1 mm", [(friction, 1.0, 0.0) for friction in (0.3, 0.6, 0.9)]),
)


class Cell(NamedTuple):
    """The settings of a row of the table: items, planner and simulation."""

    items: str
    tote: str
    method: str
    R: int
    support: str
    simulation: str  # settle or execute
    friction: float = 0.6
    gap_mm: float = 1.0
    noise_mm: float = 0.0

    @property
    def name(self) -> str:
        return "-".join(map(str, self))

    @property
    def folder(self) -> Path:
        """The run folder of the evaluation that plans."""
        return RUNS / f"{self.method}-{self.items}-{self.tote}-R{self.R}-{self.support}"


FIGURES = ("totes", "lost", "planned", "planned_low", "planned_high", "kept", "kept_low", "kept_high", "cpu_seconds")


def wanted() -> Iterator[tuple[Cell, int]]:
    """Yield all cells and their numbers of totes, the most important ones first."""
    for method in ("joint_dbl", "random"):
        for items, tote in ITEMS.items():
            for rule in RULES:
                yield Cell(items, tote, method, 4, rule, "settle"), 200
    for rotations in (1, 4):
        for method in COMPARED:
            yield Cell("kinds", "6x6x5", method, rotations, OF_METHODS, "execute"), 100
    for condition in dict.fromkeys(point for _, _, points in ROBUSTNESS for point in points):
        yield Cell("mixed", "8x8x8", "fcn_grasp", 4, OF_METHODS, "execute", *condition), 50
    for friction, gap in CONDITIONS:
        for items, tote in ITEMS.items():
            for rule in RULES:
                yield Cell(items, tote, "joint_dbl", 4, rule, "settle", friction, gap), 50


def read() -> dict[Cell, dict[str, float]]:
    """Return the values of the table's rows."""
    if not TABLE.is_file():
        return {}
    rows = {}
    with TABLE.open(newline="") as file:
        for row in csv.DictReader(file):
            values = [kind(row[key]) for key, kind in Cell.__annotations__.items()]
            rows[Cell(*values)] = {key: (int if key in ("totes", "lost") else float)(row[key]) for key in FIGURES}
    return rows


def write(cell: Cell, figures: dict) -> None:
    """Add a row to the table; several processes may do so."""
    with (RUNS / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        rows = read() | {cell: figures}
        part = TABLE.with_suffix(".part")
        with part.open("w", newline="") as file:
            table = csv.DictWriter(file, [*Cell._fields, *FIGURES], lineterminator="\n")
            table.writeheader()
            table.writerows(key._asdict() | rows[key] for key in sorted(rows))
        part.replace(TABLE)


def plan(cell: Cell, totes: int) -> tuple[list[float], list[EpisodePlan]]:
    """Return the occupancy by the rules and the plans of episodes; play the episodes unless that was done before."""
    if (words := METHODS[cell.method]) is None:
        return pack_without_gripper(cell, totes)
    trained = RUNS / "train" / f"individual_grasp-R{cell.R}"
    if cell.method == "individual_grasp" and not trained.exists():
        training = ["experiment=quick", "model=individual_grasp", "curriculum.advance.max_frames_per_level=50_000"]
        run("pickplace-train", *training, f"env.rotations={cell.R}", f"hydra.run.dir={trained}")
    rule, _, margin = cell.support.partition("+")
    weights = "mixed_grasp" if cell.items == "mixed" else f"r{cell.R}"
    result = evaluate(
        cell.folder, *(word.format(R=cell.R, weights=weights) for word in words),
        f"items={cell.items}", f"env.tote_size=[{cell.tote.replace('x', ',')}]", f"env.rotations={cell.R}",
        f"support={rule}", *([f"env.support.margin={margin or 0}"] if rule in ("hull", "bearing") else []),
        "evaluation.episodes=200", "evaluation.plans=true", "evaluation.latency_decisions=0",
    )  # fmt: skip
    occupancy = result["occupancy"]["per_episode"][:totes]
    plans = {one.episode: one for one in read_plans(cell.folder / "plans.jsonl")}
    empty = replace(next(iter(plans.values())), placements=[])  # an episode without placements has no line
    return occupancy, [plans.get(number, replace(empty, episode=number)) for number in range(totes)]


def planned_placements(env: PickPlaceEnv) -> Iterator[tuple[Item, int, int, int, int, int]]:
    """Yield the items of the environment's first episode and their places by rectpack: x, y, z and the sides.

    It places by MaxRects, bottom left, in the first layer where an item fits (https://pypi.org/project/rectpack).
    """
    from rectpack import MaxRectsBl, PackingBin, PackingMode, newPacker

    wide, deep, high = env.cell.tote_size
    packer = newPacker(PackingMode.Online, PackingBin.BFF, MaxRectsBl, rotation=env.cell.rotations > 1)
    packer.add_bin(wide, deep, count=high)
    for step in range(wide * deep * high):
        address = [torch.tensor([value]) for value in (0, env.first_episode, step)]
        item = env.items.sample("test", *address, env.cell.bin_size)
        packer.add_rect(int(item.w), int(item.d), step)
        found = [rect[:5] for rect in packer.rect_list() if rect[5] == step]
        if not found:
            return
        layer, x, y, *sides = found[0]
        yield item, x, y, layer, *sides


def pack_without_gripper(cell: Cell, totes: int) -> tuple[list[float], list[EpisodePlan]]:
    """Return the plans of rectpack, which does not know the gripper: it is put over the middle of each item."""
    occupancy, plans = [], []
    for episode in range(totes):
        size = [int(side) for side in cell.tote.split("x")]
        env = PickPlaceEnv(tote_size=size, rotations=cell.R, num_envs=1, stream="test", first_episode=episode, masks=())
        unit = env.cell.cell_size
        metres = [[side * unit for side in sides] for sides in (size, env.cell.bin_size, env.cell.gripper.size)]
        placements, volume = [], 0
        for item, x, y, z, wide, deep in planned_placements(env):
            corner = tuple(at * unit for at in (x, y, z))
            sides = tuple(side * unit for side in (wide, deep, int(item.h)))
            lies = tuple(int(at) * unit for at in (item.x, item.y))
            pick = tuple(at + int(side) * unit / 2 for at, side in zip(lies, (item.w, item.d), strict=True))
            place = tuple(at + side / 2 for at, side in zip(corner[:2], sides[:2], strict=True))
            turned = (wide, deep) != (int(item.w), int(item.d))
            placements.append(Placement(corner, sides, lies, pick, place, 90 * turned))
            volume += wide * deep * int(item.h)
        occupancy.append(volume / (size[0] * size[1] * size[2]))
        plans.append(EpisodePlan(episode, *map(tuple, metres), placements))
    return occupancy, plans


def measure(cell: Cell, totes: int) -> dict[str, float]:
    """Return the values of a cell."""
    planned, plans = plan(cell, totes)
    settings = {"friction": cell.friction, "gap": cell.gap_mm / 1e3, "noise": cell.noise_mm / 1e3}
    simulation = build("physics", {"_target_": cell.simulation, **settings})
    outcomes = list(simulation.carry_out(plans))
    figures = {"totes": totes, "lost": sum(outcome.ending != "done" for outcome in outcomes)}
    for name, values in (("planned", planned), ("kept", [outcome.occupancy for outcome in outcomes])):
        occupancy = torch.tensor(values, dtype=torch.float64)
        low, high = confidence95(occupancy)
        figures |= {name: float(occupancy.mean()), f"{name}_low": low, f"{name}_high": high}
    figures["cpu_seconds"] = sum(outcome.cpu_seconds for outcome in outcomes) / totes
    return {key: round(value, 4) for key, value in figures.items()}


# ---------------------------------------------------------------------- tables
def share(row: dict) -> str:
    """Return the number of totes that lost an item, with an interval of their share."""
    low, high = proportion95(row["lost"], row["totes"])
    return f"{row['lost']} of {row['totes']} ({low:.1%} to {high:.1%})"


def interval(row: dict, name: str) -> str:
    """Return a mean occupancy and its interval."""
    return f"{row[name]:.3f} ({row[f'{name}_low']:.3f} to {row[f'{name}_high']:.3f})"


def tables() -> str:
    """Return the tables of docs/physics.md."""
    rows = read()
    lines = ["| items, tote | planner | rule | totes that lost an item | occupancy | carried out |"]
    lines.append("|---|---|---|---|---|---|")
    for cell in dict(wanted()):
        if cell in rows and cell.simulation == "settle" and (cell.friction, cell.gap_mm) == (0.6, 1.0):
            row, about = rows[cell], f"{cell.items}, {cell.tote} | `{cell.method}` | `{cell.support}`"
            lines.append(f"| {about} | {share(row)} | {interval(row, 'planned')} | {interval(row, 'kept')} |")
    names = " | ".join(f"friction {friction:g}, gap {gap:g} mm" for friction, gap in CONDITIONS)
    lines += ["", f"| items, tote | rule | {names} |", "|---|---|---|---|---|---|"]
    for items, tote in ITEMS.items():
        for rule in RULES:
            cells = [Cell(items, tote, "joint_dbl", 4, rule, "settle", *condition) for condition in CONDITIONS]
            counts = [str(rows[cell]["lost"]) if cell in rows else "" for cell in cells]
            lines.append(f"| {items}, {tote} | `{rule}` | {' | '.join(counts)} |")
    lines += ["", "| R | method | totes carried out | occupancy planned | carried out |", "|---|---|---|---|---|"]
    for cell in dict(wanted()):
        if cell in rows and cell.simulation == "execute" and cell.items == "kinds":
            row = rows[cell]
            done = f"{row['totes'] - row['lost']} of {row['totes']}"
            planned, kept = interval(row, "planned"), interval(row, "kept")
            lines.append(f"| {cell.R} | `{cell.method}` | {done} | {planned} | {kept} |")
    return "\n".join(lines)


def figure() -> None:
    """Draw the effect of placement errors, gaps and friction on plans that a gantry carries out: docs/physics.png."""
    rows, names = read(), list(dict.fromkeys(name for name, _, _ in ROBUSTNESS))
    chart, panels = plt.subplots(1, len(names), figsize=(11, 3.2), sharey=True, layout="constrained")
    for name, label, points in ROBUSTNESS:
        cells = [Cell("mixed", "8x8x8", "fcn_grasp", 4, OF_METHODS, "execute", *point) for point in points]
        if missing := [cell.name for cell in cells if cell not in rows]:
            sys.stdout.write(f"no figure: {missing[0]} is not measured\n")
            return
        axis = {"gap, mm": 1, "friction": 0}.get(name, 2)
        totes = [rows[cell]["totes"] for cell in cells]
        done = [count - rows[cell]["lost"] for cell, count in zip(cells, totes, strict=True)]
        share = np.divide(done, totes)
        bounds = np.array([proportion95(*pair) for pair in zip(done, totes, strict=True)])
        error = abs(bounds - share[:, None]).T
        panel = panels[names.index(name)]
        panel.errorbar([point[axis] for point in points], share, error, marker="o", capsize=3, label=label)
        panel.set(xlabel=name, ylim=(-0.02, 1.05))
        panel.legend(loc="center right", frameon=False)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("share of totes carried out")
    chart.savefig(ROOT / "docs" / "physics.png", dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--match", default="", help="only cells in whose name this regular expression is found")
    parser.add_argument("--again", action="store_true", help="also compute rows that are there")
    arguments = parser.parse_args()
    RUNS.mkdir(parents=True, exist_ok=True)
    for cell, totes in wanted():
        if re.search(arguments.match, cell.name) and (arguments.again or cell not in read()):
            figures = measure(cell, totes)
            write(cell, figures)
            sys.stdout.write(f"{cell.name}: {figures['lost']} of {totes} lost an item\n")
    sys.stdout.write(tables() + "\n")
    figure()


if __name__ == "__main__":
    main()
