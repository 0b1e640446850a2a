"""The cells of the comparison, read from ``definitions.yaml``: a name and the overrides of one command each."""

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import yaml

DEFINITIONS = Path(__file__).with_name("definitions.yaml")
#: The override that an axis sets. Of `method` there is none: it only stands in names.
AXES = {"R": "env.rotations", "tote": "env.tote_size", "K": "planner.candidates", "seed": "seed", "items": "items"}
AXES |= {"env": "env", "planner": "planner", "packer": "packer", "mask": "planner.mask", "method": ""}
AXES |= {"simulations": "planner.simulations", "samples": "planner.samples"}
#: All cells have the paper's rule for stability.
PAPERS_RULE = "env.support=half"


@dataclass(frozen=True)
class Cell:
    """One command of the comparison: its name, program, arguments, training (of an evaluation) and time limit."""

    name: str
    command: str
    overrides: tuple[str, ...]
    training: str | None = None
    minutes: float = 60


def expand(entry: dict, command: str) -> list[Cell]:
    """Return the cells of one entry of ``definitions.yaml``.

    Raises:
        ValueError: for an unknown key.
    """
    if unknown := set(entry) - {*AXES, "name", "set", "training", "minutes"}:
        raise ValueError(f"{entry.get('name')}: unknown key {sorted(unknown)[0]!r}, expected one of {sorted(AXES)}.")
    axes, cells = {key: values for key, values in entry.items() if isinstance(values, list)}, []
    for values in product(*axes.values()):
        point = dict(zip(axes, values, strict=True))
        set_ = {axis: f"[{value.replace('x', ',')}]" if axis == "tote" else value for axis, value in point.items()}
        if command == "pickplace-evaluate":  # all play the same episodes: the seed is that of the training
            set_.pop("seed", None)
        overrides = [] if "packer" in point else [PAPERS_RULE]
        overrides += [f"{AXES[axis]}={value}" for axis, value in set_.items() if AXES[axis]]
        overrides += entry.get("set", "").split()
        training = entry["training"].format(**point) if "training" in entry else None
        program = "placement_only.py" if "packer" in point else command
        cells.append(Cell(entry["name"].format(**point), program, tuple(overrides), training, entry.get("minutes", 60)))
    return cells


def read(path: Path = DEFINITIONS) -> tuple[dict[str, Cell], dict[str, Cell]]:
    """Return the trainings and the evaluations, both by name.

    Raises:
        ValueError: for two different cells of one name, or an evaluation of an unknown training.
    """
    definitions, trainings, evaluations = yaml.safe_load(path.read_text()), {}, {}
    for key, program, cells in (
        ("trainings", "pickplace-train", trainings),
        ("evaluations", "pickplace-evaluate", evaluations),
    ):
        for cell in (cell for entry in definitions[key] for cell in expand(entry, program)):
            if cells.setdefault(cell.name, cell) != cell:
                raise ValueError(f"{cell.name}: defined twice, differently.")
            if cell.training is not None and cell.training not in trainings:
                raise ValueError(f"{cell.name}: unknown training {cell.training!r}.")
    return trainings, evaluations
