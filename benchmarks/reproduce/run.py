"""Compute the cells of the comparison that ``docs/results/results.csv`` lacks: ``make reproduce``.

A finished evaluation becomes a row at once, so the run can be stopped and started again; a training continues from its
last checkpoint in outputs/reproduce/train/. To use several cores, start several runs with different --match.
"""

import argparse
import csv
import json
import logging
import os
import platform
import re
import resource
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import cells as definitions
import claims
import table
from cells import Cell

log = logging.getLogger(__name__)
OUTPUTS = table.ROOT / "outputs" / "reproduce"


class Failed(Exception):
    """A cell that ended with an error; no row is written about it."""


def folder_of(cell: Cell) -> Path:
    """Return the run folder of a cell."""
    return OUTPUTS / ("train" if cell.command == "pickplace-train" else "evaluate") / cell.name


def execute(cell: Cell, overrides: list[str]) -> dict:
    """Run the command of a cell; return ``cpu_seconds`` and why it was cut short; raise Failed for other errors."""
    script, log = cell.command.endswith(".py"), OUTPUTS / "logs" / f"{cell.name}.log"
    program = table.ROOT / "benchmarks" / cell.command if script else Path(sys.executable).parent / cell.command
    command = [*[sys.executable] * script, str(program), *overrides]
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as out:
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(command, stdout=out, stderr=out, cwd=table.ROOT, env=environment)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    late = False
    try:
        process.wait(60 * cell.minutes)
    except subprocess.TimeoutExpired:
        late = True
        process.terminate()  # a training saves and ends
    code, after = process.wait(), resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    cost, last_words = {"cpu_seconds": round(seconds, 1)}, (log.read_text().strip().splitlines() or [""])[-1]
    if late or (code and "memory" in last_words):
        cost["attempted"] = f"not done within {cell.minutes:g} minutes" if late else last_words
    elif code:
        raise Failed(f"exit code {code}: {last_words}")
    return cost


def read_json(path: Path) -> dict:
    """Return the content of a JSON file; empty without one."""
    return json.loads(path.read_text()) if path.is_file() else {}


def metrics(folder: Path, column: str) -> list[tuple[int, float]]:
    """Return frames and value of a column of a run's ``metrics.csv``, where it has one."""
    path = folder / "metrics.csv"
    rows = csv.DictReader(path.read_text().splitlines() if path.is_file() else ())
    return [(int(float(row["frames"])), float(row[column])) for row in rows if row.get(column)]


def train(cell: Cell) -> str:
    """Train, or continue a training that was stopped, and write its learning curve; ``cost.json`` says it is done."""
    folder = folder_of(cell)
    folder.mkdir(parents=True, exist_ok=True)
    begun = (folder / "checkpoints" / "last").is_dir()
    cost = execute(cell, [f"resume={folder}"] if begun else [*cell.overrides, "threads=1", f"hydra.run.dir={folder}"])
    (folder / "cost.json").write_text(json.dumps(cost))
    curve = metrics(folder, "eval/occupancy")
    points = [{"training": cell.name, "frames": frames, "occupancy": round(value, 5)} for frames, value in curve]
    before = [row for row in table.read("learning_curves").values() if row["training"] == cell.name]
    table.update("learning_curves", points, drop=lambda row: row["training"] == cell.name)
    if points != before:
        forget_differences(cell.name)
    return f"{cost['cpu_seconds']:.0f} s"


def training_columns(cell: Cell) -> dict:
    """Return the columns of a result that describe its training."""
    folder = folder_of(cell)
    row = {"training": cell.name, "training_cpu_seconds": read_json(folder / "cost.json")["cpu_seconds"]}
    state = read_json(folder / "checkpoints" / "last" / "state.json")
    if not state:
        return row
    config, levels = state["config"], metrics(folder, "curriculum/level")
    row |= {"frames": state["frames"], "frames_asked": config["total_frames"], "training_seed": config["seed"]}
    row |= {"training_tote_height": config["env"]["tote_size"][2], "height_reached": int(levels[-1][1])}
    row |= {"trained_with_mask": table.text(config["model"]["mask_infeasible"])}
    teacher = (config.get("warm_start") or {}).get("teacher") or {}
    return row | {"warm_start": teacher.get("_target_")}


def evaluate(cell: Cell, trainings: dict[str, Cell]) -> str:
    """Evaluate a cell and write its row."""
    folder, overrides, cost = folder_of(cell), list(cell.overrides), {}
    words = dict(word.split("=", 1) for word in overrides)
    more = {"checkpoint": words.get("checkpoint")}
    if cell.training is not None:
        source = folder_of(trainings[cell.training])
        if not (spent := read_json(source / "cost.json")):
            raise Failed(f"its training {cell.training} is not done")
        more = training_columns(trainings[cell.training])
        more["checkpoint"] = "best" if (source / "checkpoints" / "best").is_dir() else "last"
        overrides.append(f"checkpoint={source / 'checkpoints' / more['checkpoint']}")
        cost = {} if "frames" in more else {"attempted": f"its training: {spent.get('attempted')}"}
    path = folder / "evaluation.json"
    path.unlink(missing_ok=True)
    if not cost:
        script = cell.command.endswith(".py")
        overrides += [f"result={path}"] if script else ["threads=1", f"hydra.run.dir={folder}"]
        cost = execute(cell, overrides)
    result = {"batch_size": int(words.get("evaluation.batch_size", 128)), **read_json(path)} if path.is_file() else cost
    more |= {"cpu_seconds": cost.get("cpu_seconds"), "processor": processor()}
    row, before = table.result_row(cell.name, result, **more), table.read("results").get(cell.name, {})
    table.update("results", [row])
    if [row.get(key) for key in ("mean", "episodes")] != [before.get(key) for key in ("mean", "episodes")]:
        forget_differences(cell.name)
    return f"{row['mean']:.4f}, {row['episodes']} episodes" if "mean" in row else row["attempted"]


def processor() -> str:
    """Return the model name of the processor, on which timings and trainings depend."""
    path = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*: (.*)", path.read_text()) if path.is_file() else None
    return found[1] if found else platform.machine()


def forget_differences(name: str) -> None:
    """Drop the differences that a new result or training changes."""
    table.update("differences", drop=lambda row: fnmatch(name, row["a"]) or fnmatch(name, row["b"]))


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--match", default="", help="only cells in whose name this regular expression is found")
    parser.add_argument("--again", action="store_true", help="also evaluate cells that have a row")
    arguments = parser.parse_args()
    trainings, evaluations = definitions.read()
    known = {} if arguments.again else table.read("results")
    todo = [cell for name, cell in evaluations.items() if re.search(arguments.match, name) and name not in known]
    to_train = [trainings[name] for name in dict.fromkeys(cell.training for cell in todo if cell.training)]
    todo = [cell for cell in to_train if not (folder_of(cell) / "cost.json").is_file()] + todo
    for number, cell in enumerate(todo, 1):
        log.info("%d/%d %s: %s %s", number, len(todo), cell.name, cell.command, " ".join(cell.overrides))
        try:
            log.info(train(cell) if cell.command == "pickplace-train" else evaluate(cell, trainings))
        except Failed as error:  # one cell of a run of days
            log.error("failed: %s", error)
    played = {path.parent.name: read_json(path) for path in OUTPUTS.glob("evaluate/*/evaluation.json")}
    episodes = {name: result["occupancy"]["per_episode"] for name, result in played.items()}
    results, differences, curves = (table.read(name) for name in ("results", "differences", "learning_curves"))
    table.update("differences", claims.measure(results, differences, curves.values(), episodes))


if __name__ == "__main__":
    main()
