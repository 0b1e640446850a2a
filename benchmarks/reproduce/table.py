"""The tables in ``docs/results/``: reading, updating, and the row that an evaluation becomes."""

import csv
import fcntl
from collections.abc import Callable, Iterable
from contextlib import suppress
from operator import itemgetter
from pathlib import Path

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"

#: Columns of each table; docs/results.md says what they mean.
COLUMNS = {
    "results": """
        cell method items bin tote R planner K mask settings
        training training_seed training_tote_height height_reached trained_with_mask warm_start frames frames_asked
        training_cpu_seconds checkpoint checkpoint_frames
        stream stream_seed batch_size episodes mean low high min items_placed endings feasible_share
        decision_ms decision_clock cpu_seconds attempted commit processor
        planned planned_low planned_high executable executable_low executable_high whole_plans""",
    "learning_curves": "training frames occupancy",
    "differences": "a b mean low high episodes seeds_a seeds_b",
}
KEY = {"results": ["cell"], "learning_curves": ["training", "frames"], "differences": ["a", "b"]}
TEXT = {"a", "b", "commit"}  # columns whose values may look like numbers


def read(name: str, folder: Path = RESULTS) -> dict:
    """Return the rows of a table by key: a cell, or a pair. Numbers are numbers; empty values are left out."""
    path = folder / f"{name}.csv"
    if not path.is_file():
        return {}
    with path.open(newline="") as file:
        rows = [{key: number(key, text) for key, text in row.items() if text} for row in csv.DictReader(file)]
    return {itemgetter(*KEY[name])(row): row for row in rows}


def number(column: str, text: str) -> int | float | str:
    """Return a number where a column has numbers and the text is one, else the text."""
    for kind in () if column in TEXT else (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def update(name: str, rows: Iterable[dict] = (), drop: Callable[[dict], bool] | None = None, folder=RESULTS) -> None:
    """Drop rows of a table, then add or replace others; several processes may do so."""
    folder.mkdir(parents=True, exist_ok=True)
    with (ROOT / "outputs" / ".tables.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        kept = {key: row for key, row in read(name, folder).items() if drop is None or not drop(row)}
        kept |= {itemgetter(*KEY[name])(row): row for row in rows}
        part = folder / f"{name}.csv.part"
        with part.open("w", newline="") as file:
            table = csv.DictWriter(file, COLUMNS[name].split(), lineterminator="\n")
            table.writeheader()
            table.writerows(kept[key] for key in sorted(kept))
        part.replace(folder / f"{name}.csv")


def result_row(cell: str, result: dict, **more) -> dict:
    """Return the row of ``results.csv`` that an ``evaluation.json`` and columns from elsewhere become."""
    env, settings = result.get("env", {}), dict(result.get("planner_settings") or {})
    occupancy, latency, items = (result.get(key) or {} for key in ("occupancy", "latency_ms", "items"))
    endings = result.get("failures") or result.get("placements") or {}
    if "candidates" in result:  # K of a policy; of a heuristic or a search it is a setting
        settings.pop("candidates", None)
    clock = next((key for key in ("cpu_mean", "cpu_p50", "p50") if key in latency), None)
    row = {column: result.get(column) for column in ("planner", "stream", "batch_size", "episodes", "items_placed")}
    row |= {
        "cell": cell,
        "method": cell.partition("-")[0],
        "items": "kinds" if "kinds" in items else {3: "mixed", 2: "tall"}.get(items.get("width", [0, 0])[1]),
        "bin": "x".join(map(str, env.get("bin_size", ()))),
        "tote": "x".join(map(str, env.get("tote_size", ()))),
        "R": env.get("rotations"),
        "K": result.get("candidates"),
        "mask": text(result.get("mask_at_decision", settings.get("mask"))),
        "settings": " ".join(f"{key}={text(value)}" for key, value in settings.items()),
        "checkpoint_frames": (result.get("trained") or {}).get("frames"),
        "stream_seed": result.get("seed"),
        "mean": occupancy.get("mean"),
        "min": occupancy.get("min"),
        "endings": " ".join(f"{reason}={count}" for reason, count in endings.items()),
        "feasible_share": result.get("feasible_action_share"),
        "decision_ms": latency.get(clock),
        "decision_clock": clock,
        "attempted": result.get("attempted"),
        "commit": (result.get("commit") or "")[:10],
        "whole_plans": result.get("plans_executed_whole"),
    }
    row |= dict(zip(("low", "high"), (min(max(end, 0.0), 1.0) for end in occupancy.get("ci95", ())), strict=False))
    for column, key in (("planned", "occupancy_planned"), ("executable", "share_executed")):
        if key in result:
            row[column], (row[f"{column}_low"], row[f"{column}_high"]) = result[key]["mean"], result[key]["ci95"]
    return {key: value for key, value in (row | more).items() if value not in (None, "")}


def text(value) -> str | None:
    """Return a value as the command line writes it."""
    return str(value).lower() if isinstance(value, bool) else value if value is None else str(value)
