"""Draw the figures and write the tables of docs/results.md from docs/results/paper.csv: python benchmarks/results.py

`--add NAME evaluation.json ...` first adds a row for each evaluation; NAME may hold {R}, {seed} (of the training),
{tote} and {K}, such as "fcn4d-R{R}-s{seed}-{tote}-K{K}". Figures and tables (results.yaml) choose rows by these names.

A point is the mean over training seeds; its bar reaches from the lowest to the highest 95% limit of any seed. Hollow:
fewer than 20 episodes. Pale: the training ended two or more cells below its tote's full height.
"""

import argparse
import csv
import json
import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import yaml
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from PIL import Image

from pickplace.runs.loggers import read_csv

RESULTS = Path(__file__).parents[1] / "docs" / "results"
TABLE, PAGE = RESULTS / "paper.csv", RESULTS.parent / "results.md"
STYLE, FIGURES, TABLES = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text()).values()
FEW = 20  # episodes below which a mean is marked
KEY = ("kind", "cell", "versus", "frames")  # columns that identify a row of the table


def read() -> list[dict]:
    """Return the rows of the table. Numbers are numbers; empty values are left out."""
    with TABLE.open(newline="") as file:
        return [{key: number(key, text) for key, text in row.items() if text} for row in csv.DictReader(file)]


def number(column: str, text: str) -> int | float | str:
    """Return the text as a number if it is one and the column may hold numbers; else return the text."""
    for kind in () if column in ("cell", "versus", "commit") else (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def add(name: str, path: Path) -> None:
    """Add the row of an evaluation to the table, and the validations of the training if its run folder is there."""
    result = json.loads(path.read_text())
    env, trained, source = result["env"], result.get("trained"), Path(result["checkpoint"] or "")
    tote, seed = "x".join(map(str, env["tote_size"])), trained and trained["seed"]
    found = {"R": env["rotations"], "seed": seed, "tote": tote, "K": result.get("candidates")}
    cell = name.format(**found)
    row = {"kind": "evaluation", "cell": cell, "method": cell.partition("-")[0], "training_seed": seed}
    row |= {column: found[column] for column in ("R", "tote", "K")}
    row |= {"bin": "x".join(map(str, env["bin_size"])), "mask": result.get("mask_at_decision")}
    row |= {column: result[column] for column in ("planner", "episodes", "items_placed", "commit")}
    row |= {"settings": " ".join(f"{key}={value}" for key, value in result["planner_settings"].items())}
    row |= {"mean": result["occupancy"]["mean"], "min": result["occupancy"]["min"]}
    row |= dict(zip(("low", "high"), result["occupancy"]["ci95"], strict=True))
    row |= {"endings": " ".join(f"{reason}={count}" for reason, count in result["failures"].items())}
    row |= {"feasible_share": result["feasible_action_share"], "decision_ms": (result["latency_ms"] or {}).get("p50")}
    rows = [row]
    metrics = source.parents[1] / "metrics.csv" if trained else None
    if metrics and metrics.is_file():
        training, curve = cell.partition(f"-{tote}")[0], read_csv(metrics)
        row |= {"training": training, "frames": curve[-1]["frames"], "training_tote_height": env["tote_size"][2]}
        row |= {"height_reached": max(point.get("curriculum/level", 0) for point in curve)}
        points = [point for point in curve if "eval/occupancy" in point]
        rows += [
            {"kind": "validation", "cell": training, "frames": int(point["frames"]), "mean": point["eval/occupancy"]}
            for point in points
        ]
    if paired := result.get("paired_difference"):
        low, high = paired["ci95"]
        difference = {"kind": "difference", "cell": cell, "versus": paired["against"], "mean": paired["mean"]}
        rows.append(difference | {"low": low, "high": high, "episodes": result["episodes"]})
    update(rows)


def update(rows: list[dict]) -> None:
    """Add rows to the table; a row replaces an older one with the same :data:`KEY`."""

    def key(row):
        return [str(row.get(name, "")) for name in (KEY if row["kind"] == "validation" else KEY[:3])]

    with TABLE.open(newline="") as file:
        reader = csv.DictReader(file)
        kept, columns = [row for row in reader if key(row) not in [key(new) for new in rows]], reader.fieldnames or []
    added = [
        {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()} for row in rows
    ]
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(kept + added)


def seeds_of(name: str, known: dict) -> dict[int | None, str]:
    """Return the known cells that a name stands for, by training seed (None without ``s*``)."""
    names = {seed: name.replace("s*", f"s{seed}") for seed in range(3)} if "s*" in name else {None: name}
    return {seed: cell for seed, cell in names.items() if cell in known}


def pooled(names: str | list[str], results: dict[str, dict]) -> dict | None:
    """Return mean, limits and episodes over the seeds of the first name that has results; None without any."""
    for name in [names] if isinstance(names, str) else names:
        if rows := [results[cell] for cell in seeds_of(name, results).values() if "mean" in results[cell]]:
            mean, low, high = (np.array([row[key] for row in rows]) for key in ("mean", "low", "high"))
            untrained = any(
                row["height_reached"] <= row["training_tote_height"] - 2 for row in rows if "height_reached" in row
            )
            found = {"mean": mean.mean(), "low": low.min(), "high": high.max(), "untrained": untrained}
            return found | {"episodes": min(row["episodes"] for row in rows), "ms": rows[0].get("decision_ms")}
    return None


def widen(axes) -> None:
    """Stretch an axis of occupancies near 1: it is logarithmic in the empty share."""
    axes.set_yscale("function", functions=(lambda y: -np.log10(np.maximum(1 - y, 1e-4)), lambda z: 1 - 10.0**-z))
    ticks = (0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 0.9998)
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_ylim(0, 0.9999)
    axes.minorticks_off()


def draw_points(axes, figure: dict, panel: str, results: dict[str, dict]) -> None:
    """Draw the cells of one panel."""
    xs, rows, lines, time = figure["xs"], figure["rows"], figure.get("lines"), figure.get("time")
    for order, (method, patterns) in enumerate(rows.items()):
        label, colour, marker = STYLE[method]
        shift, line = (0.25 if lines else 0.7) * ((order + 0.5) / len(rows) - 0.5), []
        for place, x in enumerate(xs):
            kind, _, tote = str(x).rpartition("-")
            names = [patterns] if isinstance(patterns, str) else patterns
            cell = pooled([name.format(x=x, panel=panel, kind=kind, tote=tote) for name in names], results)
            if cell is None:
                continue
            line.append((cell["ms"] if time else place + shift, cell["mean"]))
            bars = [[max(0.0, cell["mean"] - cell["low"])], [max(0.0, cell["high"] - cell["mean"])]]
            look = {"color": colour, "marker": marker, "alpha": 0.4 if cell["untrained"] else 1.0}
            look["markerfacecolor"] = "white" if cell["episodes"] < FEW else colour
            axes.errorbar(*line[-1], yerr=bars, ls="", ms=5, capsize=2, elinewidth=1, **look)
            if time and x:
                axes.annotate(x.replace("s", " s", 1), line[-1], (6, -9), textcoords="offset points", fontsize=7)
        if line:
            axes.plot(*zip(*line, strict=True), ls="-" if lines else "", color=colour, lw=1, alpha=0.5)
            axes.plot([], [], label=label, color=colour, marker=marker, ls="")
    if time:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.margins(x=0.12)
        return
    axes.set_xticks(range(len(xs)), xs)
    axes.set_xlim(-0.5, len(xs) - 0.5)
    if not lines:
        axes.grid(axis="x", alpha=0)
        axes.vlines(np.arange(1, len(xs)) - 0.5, 0, 1, color="#dddddd", lw=0.8)


def draw_curves(axes, figure: dict, curves: dict[str, list]) -> None:
    """Draw one learning curve for each seed."""
    for method, name in figure["rows"].items():
        label, colour, marker = STYLE[method]
        for order, run in enumerate(seeds_of(name, curves).values()):
            look = {"color": colour, "lw": 1, "ms": 3, "marker": marker, "label": None if order else label}
            axes.plot(*zip(*curves[run], strict=True), **look)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_ylim(0, 1.02)


def draw(figure: dict, results: dict[str, dict], curves: dict[str, list], path: Path) -> None:
    """Draw a figure of ``results.yaml`` into a PNG file."""
    panels = figure.get("panels", [""])
    columns, size = (len(panels) // 2, (10, 7.5)) if len(panels) > 1 else (1, (8.5, 4.6))
    canvas = Figure(figsize=size, layout="constrained")
    every = canvas.subplots(len(panels) // columns, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, panel in zip(every, panels, strict=True):
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_title(panel, fontsize=10)
        if figure.get("curves"):
            draw_curves(axes, figure, curves)
        else:
            draw_points(axes, figure, panel, results)
            widen(axes) if figure.get("widen") else axes.set_ylim(*figure.get("ylim", (-0.02, 1.02)))
    for axes in every[-columns:]:
        axes.set_xlabel(figure["xlabel"])
    for axes in every[::columns]:
        axes.set_ylabel(figure["ylabel"])
    handles = {label: handle for axes in every for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    canvas.legend(handles.values(), handles, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    canvas.savefig(path, dpi=110)
    Image.open(path).convert("RGB").quantize(128).save(path, optimize=True)


def occupancy_table(table: dict, results: dict[str, dict]) -> list[str]:
    """Return the lines of a table of ``results.yaml``: cells in whose names ``{}`` stands for the column."""
    columns = table["columns"]
    lines = [f"| method | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    for name, values in table.get("given", {}).items():
        lines.append(f"| {name} | {' | '.join(f'{value:.4f}' for value in values)} |")
    for method, name in table["rows"].items():
        found = [pooled(name.format(column), results) for column in columns]
        marks = [cell and "°" * (cell["episodes"] < FEW) + "†" * cell["untrained"] for cell in found]
        values = [f"{cell['mean']:.4f}{mark}" if cell else "" for cell, mark in zip(found, marks, strict=True)]
        k = name.partition("-K")[2]
        lines.append(f"| {STYLE[method][0]}{f', K={k}' if k else ''} | {' | '.join(values)} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--add", nargs="+", metavar=("NAME", "FILE"), help="name of the rows, and evaluations")
    name, *paths = parser.parse_args().add or [""]
    for path in paths:
        add(name, Path(path))
    rows = read()
    results = {row["cell"]: row for row in rows if row["kind"] == "evaluation"}
    curves: dict[str, list] = {}
    for row in rows:
        if row["kind"] == "validation":
            curves.setdefault(row["cell"], []).append((row["frames"], row["mean"]))
    for figure, content in FIGURES.items():
        draw(content, results, curves, RESULTS / f"{figure}.png")
    text = PAGE.read_text()
    for table, content in TABLES.items():
        pattern = re.compile(rf"(<!-- {table}: [^\n]*-->\n).*?(<!-- end -->)", re.DOTALL)
        lines = "\n".join(occupancy_table(content, results))
        text = pattern.sub(lambda found, lines=lines: f"{found[1]}\n{lines}\n\n{found[2]}", text)
    PAGE.write_text(text)


if __name__ == "__main__":
    main()
