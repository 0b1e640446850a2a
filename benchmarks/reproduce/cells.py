"""What the comparison consists of: trainings and evaluations, read from the yaml files beside this one.

Each entry of a file stands for one cell for every combination of its ``grid``. A cell is one command; its name says
what varies, so that two figures that need the same cell share it.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path

import yaml

HERE = Path(__file__).parent

#: Axes of a grid: how a value is labelled, and the override that it stands for, if any.
AXES = {
    "R": ("R{}", "env.rotations={}"),
    "tote": ("{}", "env.tote_size=[{}]"),
    "K": ("K{}", "planner.candidates={}"),
    "seed": ("s{}", "seed={}"),
    "items": ("{}", "items={}"),
    "env": ("{}", "env={}"),
    "simulations": ("{}sim", "planner.simulations={}"),
    "samples": ("{}samples", "planner.samples={}"),
    "mask": ("mask_{}", "planner.mask={}"),
}


@dataclass(frozen=True)
class Cell:
    """One command to run.

    Attributes:
        name: unique; also the name of its result.
        kind: ``train``, ``evaluate`` or ``placement_only``.
        overrides: what follows the command.
        method: as figures call it.
        axes: values of the grid, by axis.
        training: the training whose checkpoint it evaluates, or None.
        minutes: its budget, CPU time of one core.
    """

    name: str
    kind: str
    overrides: tuple[str, ...]
    method: str
    axes: tuple[tuple[str, object], ...]
    training: str | None = None
    minutes: float = 60


def expand(entry: dict, kind: str) -> list[Cell]:
    """The cells of an entry of a yaml file.

    Args:
        entry: ``method``; ``set``, overrides as one line; ``grid``, lists of values by axis; ``minutes``, the budget
            of each cell, 60 by default; and, for evaluations, ``training``: the name of one, in which ``{axis}`` stands
            for the grid's value.

    Raises:
        ValueError: for a key or an axis that there is not.
    """
    known = {"method", "set", "grid", "training", "kind", "minutes"}
    if unknown := set(entry) - known:
        raise ValueError(f"{sorted(unknown)[0]}: expected one of {', '.join(sorted(known))}.")
    kind, grid = entry.get("kind", kind), entry.get("grid", {})
    if unknown := set(grid) - set(AXES):
        raise ValueError(f"grid.{sorted(unknown)[0]}: expected one of {', '.join(AXES)}.")
    cells = []
    for values in itertools.product(*grid.values()):
        axes = dict(zip(grid, values, strict=True))
        labels, overrides = [entry["method"]], entry.get("set", "").split()
        for axis, value in axes.items():
            label, override = AXES[axis]
            labels.append(label.format(value))
            if axis == "seed" and kind != "train":
                continue  # of the training; every method meets the same episodes
            overrides.append(override.format(str(value).replace("x", ",") if axis == "tote" else value))
        training = entry["training"].format(**axes) if "training" in entry else None
        name, minutes = "-".join(labels), entry.get("minutes", Cell.minutes)
        cells.append(Cell(name, kind, tuple(overrides), entry["method"], tuple(axes.items()), training, minutes))
    return cells


def read() -> tuple[dict[str, Cell], dict[str, list[Cell]]]:
    """Trainings by name, and for each figure, by the name of its file, its evaluations.

    Raises:
        ValueError: for two cells of one name that are not the same, an evaluation of a training that there is not, or a
            training that nobody needs.
    """
    trainings = {}
    for entry in yaml.safe_load((HERE / "trainings.yaml").read_text()):
        for cell in expand(entry, "train"):
            if cell.name in trainings:
                raise ValueError(f"trainings.yaml: {cell.name} stands there twice.")
            trainings[cell.name] = cell
    figures, seen = {}, {}
    for path in sorted(HERE.glob("*.yaml")):
        if path.name == "trainings.yaml":
            continue
        figures[path.stem] = [cell for entry in yaml.safe_load(path.read_text()) for cell in expand(entry, "evaluate")]
        for cell in figures[path.stem]:
            if seen.setdefault(cell.name, cell) != cell:
                raise ValueError(f"{path.name}: {cell.name} is another cell elsewhere; rename its method.")
            if cell.training is not None and cell.training not in trainings:
                raise ValueError(f"{path.name}: {cell.name} needs {cell.training}, which trainings.yaml lacks.")
    needed = {cell.training for part in figures.values() for cell in part}
    if idle := sorted(set(trainings) - needed):
        raise ValueError(f"trainings.yaml: {idle[0]} is needed by no figure.")
    if both := sorted(set(trainings) & set(seen)):
        raise ValueError(f"{both[0]}: a training and an evaluation have this name; rename one.")
    return trainings, figures
