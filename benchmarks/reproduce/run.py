"""Computes the cells of the comparison that are not there yet, and writes docs/results/: make reproduce.

    python benchmarks/reproduce/run.py [--figure NAME ...] [--match TEXT] [--minutes M] [--jobs 1] [--again] [--list]

Each cell runs in a process of its own, in one thread; its budget is CPU time. What stops early is taken up again: a
training goes on from its last checkpoint, an evaluation begins anew. A finished cell is one JSON file that holds its
command. What a smaller budget cut short is computed again, and so is an evaluation whose training has gone on. A
training whose run folder is not here, but on the machine that it ran on, is repeated where an evaluation needs it.
With --again all chosen evaluations are; git tells how they differ.
"""

import argparse
import hashlib
import json
import os
import platform
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cells as definitions
from cells import Cell

from pickplace.evaluation.evaluate import commit, versions
from pickplace.runs.checkpoint import CheckpointError, locate
from pickplace.runs.loggers import read_csv

ROOT = Path(__file__).parents[2]
RESULTS, OUTPUTS = ROOT / "docs" / "results", ROOT / "outputs" / "reproduce"
SPENT = "cost.json"  # in the folder of a training
NOTHING = {"cpu_seconds": 0.0, "peak_mib": 0}
MEMORY = 20 * 2**30  # bytes that a cell may reserve: what asks for more is told so, and takes nothing from others


def result_of(cell: Cell) -> Path:
    """Where a cell's result stands."""
    return RESULTS / ("trainings" if cell.kind == "train" else "cells") / f"{cell.name}.json"


def run_dir_of(cell: Cell) -> Path:
    """Where a cell works."""
    return OUTPUTS / cell.kind / cell.name


class Child:
    """A command in one thread, its output in a file; its memory is limited, its peak and its CPU time are measured."""

    def __init__(self, command: list[str], log: Path):
        threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        log.parent.mkdir(parents=True, exist_ok=True)
        self.log, self.started = log, time.monotonic()
        with log.open("ab") as out:
            self.process = subprocess.Popen(
                command, stdout=out, stderr=out, cwd=ROOT, env={**os.environ, **threads}, start_new_session=True
            )
        if hasattr(resource, "prlimit"):  # Linux
            _, hard = resource.prlimit(self.process.pid, resource.RLIMIT_AS)
            limit = MEMORY if hard == resource.RLIM_INFINITY else min(MEMORY, hard)
            resource.prlimit(self.process.pid, resource.RLIMIT_AS, (limit, hard))

    def wait(self, minutes: float) -> dict:
        """``{"rc", "cpu_seconds", "peak_mib", "ended_by"}``, the last one ``itself``, ``budget`` or ``user``.

        A command that has used its time, or that the user stops, is told so once, and killed ten minutes of CPU time
        later if it has not ended.
        """
        ended_by, limit = "itself", None
        while True:
            pid, status, usage = os.wait4(self.process.pid, os.WNOHANG)
            if pid:
                break
            if limit is None and (stopped.is_set() or self.used() > 60 * minutes):
                ended_by = "user" if stopped.is_set() else "budget"
                limit = self.used() + 600
                os.kill(self.process.pid, signal.SIGTERM)
            elif limit is not None and self.used() > limit:
                os.kill(self.process.pid, signal.SIGKILL)
            time.sleep(0.5)
        self.process.returncode = os.waitstatus_to_exitcode(status)  # or Popen would wait for it again
        return {
            "rc": self.process.returncode,
            "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 1),
            "peak_mib": usage.ru_maxrss // (2**20 if sys.platform == "darwin" else 1024),
            "ended_by": ended_by,
        }

    def used(self) -> float:
        """Seconds of CPU time, so that what else the machine does changes nothing; of the clock where it is unknown."""
        try:
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
            return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        except OSError:
            return time.monotonic() - self.started

    def last_words(self) -> str:
        """The last line of its output, fit for a table."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1].replace(f"{ROOT}/", "").replace("|", ";") if lines else ""


class Failed(Exception):
    """A cell that may well succeed the next time: nothing is written about it."""


def attempted(child: Child, cost: dict, reason: str) -> dict:
    """What to write about a cell that cannot be done within its budget or in memory.

    Raises:
        Failed: if neither was the reason.
    """
    words = child.last_words()
    if cost["ended_by"] == "budget":
        return {"attempted": reason, **cost}
    if "memory" in words:
        return {"attempted": words.removeprefix("error: "), **cost}
    raise Failed(f"exit code {cost['rc']}: {words}")


def train(cell: Cell, minutes: float) -> dict:
    """Train, or go on training, for at most so many minutes in all; the curve and what it cost."""
    folder = run_dir_of(cell)
    last = folder / "checkpoints" / "last"
    try:
        begun = bool(locate(folder, prefer="last"))
    except CheckpointError:
        begun = False
    before = spent(folder) if begun else NOTHING  # without a checkpoint it begins anew
    if not (last.is_dir() and before["cpu_seconds"] >= 60 * minutes):
        action = [f"resume={folder}"] if begun else [*cell.overrides, "threads=1", f"hydra.run.dir={folder}"]
        child = Child(
            [sys.executable, "-m", "pickplace.training.train", *action], OUTPUTS / "logs" / f"{cell.name}.log"
        )
        cost = child.wait(minutes - before["cpu_seconds"] / 60)
        cost["cpu_seconds"] += before["cpu_seconds"]
        cost["peak_mib"] = max(cost["peak_mib"], before["peak_mib"])
        if folder.is_dir():
            (folder / SPENT).write_text(json.dumps({key: cost[key] for key in ("cpu_seconds", "peak_mib")}))
        if not last.is_dir() or (cost["rc"] and cost["ended_by"] == "itself"):
            return attempted(child, cost, "no batch was finished within the budget")
    facts = json.loads((last / "state.json").read_text())
    cost = spent(folder)
    return {
        "frames": facts["frames"],
        "frames_asked": facts["config"]["total_frames"],
        "cpu_seconds": round(cost["cpu_seconds"], 1),
        "frames_a_second": round(facts["frames"] / cost["cpu_seconds"], 1),
        "peak_mib": cost["peak_mib"],
        "warm_start": (facts["config"].get("warm_start") or {}).get("frames", 0),
        "mask_in_training": facts["config"]["algo"]["mask_infeasible"],
        "trained_with": {"commit": facts["commit"], "versions": facts["versions"]},
        "curve": curve_until(facts["frames"], folder),
    }


def spent(folder: Path) -> dict:
    """CPU time and peak memory of a training so far, over all its resumptions."""
    path = folder / SPENT
    return json.loads(path.read_text()) if path.is_file() else NOTHING


def curve_until(frames: int, folder: Path) -> dict:
    """The curve of a run folder, as far as its last checkpoint."""
    return curve([row for row in read_csv(folder / "metrics.csv") if row["frames"] <= frames])


def curve(rows: list[dict], points: int = 100) -> dict:
    """Training occupancy and tote height in some hundred means, and every validation."""
    size = max(1, len(rows) // points)
    parts = [rows[first : first + size] for first in range(0, len(rows), size)]
    parts = [[row for row in part if "train/occupancy" in row] for part in parts]
    parts = [part for part in parts if part]
    tested = [row for row in rows if "eval/occupancy" in row]

    def mean(part, key):
        return round(sum(row[key] for row in part) / len(part), 5)

    return {
        "frames": [int(part[-1]["frames"]) for part in parts],
        "training_occupancy": [mean(part, "train/occupancy") for part in parts],
        "level": [int(part[-1]["curriculum/level"]) for part in parts],
        "validation_frames": [int(row["frames"]) for row in tested],
        "validation_occupancy": [round(row["eval/occupancy"], 5) for row in tested],
    }


def evaluate(cell: Cell, minutes: float) -> dict:
    """Play the test stream within the budget."""
    folder = run_dir_of(cell)
    for name in ("evaluation.json", "pilot.json"):
        (folder / name).unlink(missing_ok=True)
    action = [*cell.overrides, "threads=1", f"hydra.run.dir={folder}"]
    if cell.training is not None:
        action.append(f"checkpoint={checkpoint_of(cell.training)}")
    command = [sys.executable, str(Path(__file__).parent / "cell.py"), str(minutes), *action]
    child = Child(command, OUTPUTS / "logs" / f"{cell.name}.log")
    cost = child.wait(3 * minutes)
    pilot = json.loads((folder / "pilot.json").read_text()) if (folder / "pilot.json").is_file() else {}
    if not (folder / "evaluation.json").is_file():
        if cost["rc"] == 0:
            hours = pilot["seconds_a_filled_episode"] / 3600
            return {
                "attempted": f"to fill one tote would take {hours:.1f} hours",
                **pilot,
                "peak_mib": cost["peak_mib"],
            }
        return {**pilot, **attempted(child, cost, "no episode was finished within three times the budget")}
    result = json.loads((folder / "evaluation.json").read_text())
    result["occupancy"]["per_episode"] = [round(value, 6) for value in result["occupancy"]["per_episode"]]
    if result["checkpoint"]:
        given = next((word[11:] for word in cell.overrides if word.startswith("checkpoint=")), None)
        which = Path(result["checkpoint"]).name  # best, or last
        result["checkpoint"] = f"{cell.training}/{which}" if cell.training else given
    return {**result, "peak_mib": cost["peak_mib"], "cpu_seconds": cost["cpu_seconds"]}


def checkpoint_of(training: str) -> Path:
    """The best checkpoint of a training, or the last one where the budget ended before the first validation."""
    folder = OUTPUTS / "train" / training / "checkpoints"
    return folder / ("best" if (folder / "best").is_dir() else "last")


def placement_only(cell: Cell, minutes: float) -> dict:
    """Replay the packings of a placement-only packer, see ``placement_only.py``."""
    folder = run_dir_of(cell)
    folder.mkdir(parents=True, exist_ok=True)
    script = Path(__file__).parent / "placement_only.py"
    child = Child(
        [sys.executable, str(script), str(folder / "result.json"), *cell.overrides],
        OUTPUTS / "logs" / f"{cell.name}.log",
    )
    cost = child.wait(minutes)
    if cost["rc"]:
        return attempted(child, cost, "it did not finish within the budget")
    return {**json.loads((folder / "result.json").read_text()), **cost}


def result_if_any(cell: Cell) -> dict | None:
    """A cell's result, None if there is none yet."""
    path = result_of(cell)
    return json.loads(path.read_text()) if path.is_file() else None


def identity(trained: dict) -> dict:
    """What tells a training from one that went otherwise or further; repeated bit for bit, it stays the same."""
    curve = json.dumps(trained.get("curve"), sort_keys=True).encode()
    return {"frames": trained.get("frames"), "curve": hashlib.sha256(curve).hexdigest()[:16]}


def weights_are_here(cell: Cell, trained: dict) -> bool:
    """Does its run folder hold the training that the result tells of, not another one or a part of it?"""
    folder = run_dir_of(cell)
    state = folder / "checkpoints" / "last" / "state.json"
    if not state.is_file():
        return False
    frames = json.loads(state.read_text())["frames"]
    return identity({"frames": frames, "curve": curve_until(frames, folder)}) == identity(trained)


def is_done(cell: Cell, minutes: float, trainings: dict[str, Cell]) -> bool:
    """Is there a result that so many minutes would not better?"""
    result = result_if_any(cell)
    if result is None:
        return False
    asked = next(
        (int(word.partition("=")[2]) for word in cell.overrides if word.startswith("evaluation.episodes=")), 100
    )
    short = "attempted" in result or result.get("frames", 0) < result.get("frames_asked", 0)
    if (short or result.get("episodes", asked) < asked) and result["budget_minutes"] < minutes:
        return False
    trained = result_if_any(trainings[cell.training]) if cell.training else None
    return trained is None or result.get("of_training") == identity(trained)


def trainings_to_run(chosen: list[Cell], trainings: dict[str, Cell], missing: Callable[[Cell], bool]) -> list[Cell]:
    """What the chosen cells need: trainings that are missing, and those done elsewhere whose weights are not here."""

    def weights_gone(cell):
        trained = result_if_any(cell)
        return "attempted" not in trained and not weights_are_here(cell, trained)

    needed = list({cell.training: trainings[cell.training] for cell in chosen if cell.training}.values())
    waiting = {cell.training for cell in chosen if missing(cell)}
    return [cell for cell in needed if missing(cell) or (cell.name in waiting and weights_gone(cell))]


COMPUTE = {"train": train, "evaluate": evaluate, "placement_only": placement_only}


def compute(cell: Cell, minutes: float, trainings: dict[str, Cell]) -> str:
    """Compute a cell and write its result; a word on how it went.

    Raises:
        Failed: if there is no result, and why.
    """
    if cell.training is not None:
        trained = result_if_any(trainings[cell.training])
        if trained is None:
            raise Failed(f"its training, {cell.training}, is not done")
        if "attempted" in trained:
            words = f"its training: {trained['attempted']}"
            return write(cell, minutes, {"attempted": words, "of_training": identity(trained)})
        if not weights_are_here(trainings[cell.training], trained):
            raise Failed(f"the weights of {cell.training} are not here")
    result = COMPUTE[cell.kind](cell, minutes)
    if stopped.is_set():
        raise Failed("stopped")
    if cell.training is not None:
        result["of_training"] = identity(trained)
    return write(cell, minutes, result)


def write(cell: Cell, minutes: float, result: dict) -> str:
    """Write a result; a word on what it says."""
    head = {
        "cell": cell.name,
        "kind": cell.kind,
        "method": cell.method,
        "axes": dict(cell.axes),
        "training": cell.training,
        "command": command_of(cell, result),
        "budget_minutes": minutes,
        "processor": processor(),
    }
    facts = {"commit": commit(), "versions": versions()} if cell.kind == "train" or "attempted" in result else {}
    path = result_of(cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".part").write_text(one_line_a_list({**head, **facts, **result}))
    path.with_suffix(".part").replace(path)
    if "attempted" in result:
        return f"attempted: {result['attempted']}"
    if cell.kind == "train":
        return f"{result['frames']:,} frames in {result['cpu_seconds']:.0f} s"
    return f"{result['occupancy']['mean']:.4f}, {result['episodes']} episodes" if "occupancy" in result else "done"


def processor() -> str:
    """What times and budgets were measured on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    facts = dict(re.split(r"\s*:\s*", line, maxsplit=1) for line in lines if ":" in line)
    units = [unit for unit in ("amx_bf16", "avx512_bf16") if unit in facts.get("flags", "").split()]
    return ", ".join([facts.get("model name", platform.machine()), *units[:1]])


def one_line_a_list(content: dict) -> str:
    """JSON, indented, with a list of numbers on one line."""
    # The pattern must not backtrack on long lists that hold something else.
    numbers = re.compile(r"\[\s+(-?[\d.e+-]+(?:,\s+-?[\d.e+-]+)*)\s+\]")
    return numbers.sub(lambda found: f"[{' '.join(found[1].split())}]", json.dumps(content, indent=1)) + "\n"


def command_of(cell: Cell, result: dict | None = None) -> str:
    """The command that a user would type for the same."""
    if cell.kind == "placement_only":
        return " ".join(["python benchmarks/reproduce/placement_only.py result.json", *cell.overrides])
    where = [f"checkpoint={checkpoint_of(cell.training).relative_to(ROOT)}"] if cell.training else []
    played = []
    if result and "batch_size" in result:  # planners that draw depend on it
        played = [f"evaluation.episodes={result['episodes']}", f"evaluation.batch_size={result['batch_size']}"]
    overrides = [word for word in cell.overrides if not (played and word.startswith("evaluation."))]
    return " ".join([f"python -m pickplace.{cell.kind}", *overrides, *where, *played, "threads=1"])


stopped = threading.Event()  # by the user: trainings save, and all end


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--figure", action="append", help="only the cells of this figure; may be repeated")
    parser.add_argument("--match", default="", help="only cells in whose name this regular expression is found")
    parser.add_argument("--minutes", type=float, help="budget of a cell, CPU time of one core (default: as defined)")
    parser.add_argument("--jobs", type=int, default=1, help="cells that run side by side, one core each")
    parser.add_argument("--again", action="store_true", help="evaluate what is done, too")
    parser.add_argument("--list", action="store_true", help="tell what is done and what is not, and end")
    arguments = parser.parse_args()
    trainings, figures = definitions.read()
    if unknown := set(arguments.figure or ()) - set(figures):
        parser.error(f"--figure {sorted(unknown)[0]}: expected one of {', '.join(figures)}.")
    chosen = [cell for name in arguments.figure or figures for cell in figures[name]]
    chosen = list({cell.name: cell for cell in chosen if re.search(arguments.match, cell.name)}.values())
    needed = {cell.training for cell in chosen if cell.training}

    def budget(cell: Cell) -> float:
        return cell.minutes if arguments.minutes is None else arguments.minutes

    def missing(cell: Cell) -> bool:
        return (arguments.again and cell.kind != "train") or not is_done(cell, budget(cell), trainings)

    to_train = trainings_to_run(chosen, trainings, missing)
    say(f"{len(needed) + len(chosen)} cells, {len(to_train) + sum(map(missing, chosen))} to compute")
    if arguments.list:
        for cell in [*to_train, *filter(missing, chosen)]:
            say(f"  {cell.kind} {cell.name}: {command_of(cell)}")
        return
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())

    def work(cell: Cell) -> None:
        if stopped.is_set():
            return
        try:
            word = compute(cell, budget(cell), trainings)
        except Exception as error:  # of a run of days, one cell
            word = f"failed, {error}" if isinstance(error, Failed) else f"failed, {type(error).__name__}: {error}"
        say(f"{cell.kind} {cell.name}: {word}")

    with ThreadPoolExecutor(arguments.jobs) as pool:
        list(pool.map(work, to_train))
        list(pool.map(work, filter(missing, chosen)))  # now that it is known whether a training went on


def say(text: str) -> None:
    sys.stdout.write(f"{time.strftime('%H:%M:%S')} {text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
