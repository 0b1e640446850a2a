"""Draw the figures that ``figures.yaml`` lists.

A point is the mean over training seeds; its bar reaches from the lowest to the highest 95% limit of any seed. Hollow:
fewer than 20 episodes. Pale: the training ended two or more cells below its tote's full height.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import yaml
from claims import FEW, seeds_of, untrained
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from PIL import Image

STYLE, FIGURES, TABLES = yaml.safe_load(Path(__file__).with_name("figures.yaml").read_text()).values()


def pooled(names: list[str], results: dict) -> dict | None:
    """Return mean, limits and episodes over the seeds of the first name that has results; None without any."""
    for name in names:
        if rows := [results[cell] for cell in seeds_of(name, results).values() if "mean" in results[cell]]:
            mean, low, high = (np.array([row[key] for row in rows]) for key in ("mean", "low", "high"))
            found = {"mean": mean.mean(), "low": low.min(), "high": high.max(), "seeds": len(rows)}
            found |= {"episodes": min(row["episodes"] for row in rows), "untrained": untrained(name, results)}
            return found | {"ms": rows[0].get("decision_ms")}
    return None


def widen(axes) -> None:
    """Widen an axis of occupancies towards 1: logarithmic in the empty share."""
    axes.set_yscale("function", functions=(lambda y: -np.log10(np.maximum(1 - y, 1e-4)), lambda z: 1 - 10.0**-z))
    ticks = (0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 0.9998)
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_ylim(0, 0.9999)
    axes.minorticks_off()


def draw_points(axes, figure: dict, panel: str, results: dict) -> None:
    """Draw the cells of one panel."""
    xs, rows, lines, time = figure["xs"], figure["rows"], figure.get("lines"), figure.get("time")
    for number, (method, patterns) in enumerate(rows.items()):
        label, colour, marker = STYLE[method]
        shift, line = (0.25 if lines else 0.7) * ((number + 0.5) / len(rows) - 0.5), []
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


def draw_curves(axes, figure: dict, curves: Iterable[dict]) -> None:
    """Draw one learning curve for each seed."""
    runs: dict[str, list] = {}
    for point in curves:
        runs.setdefault(point["training"], []).append((point["frames"], point["occupancy"]))
    for method, name in figure["rows"].items():
        label, colour, marker = STYLE[method]
        for number, run in enumerate(seeds_of(name, runs).values()):
            look = {"color": colour, "lw": 1, "ms": 3, "marker": marker, "label": None if number else label}
            axes.plot(*zip(*runs[run], strict=True), **look)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_ylim(0, 1.02)


def draw(name: str, results: dict, curves: Iterable[dict], path: Path) -> None:
    """Draw a figure of ``figures.yaml`` into a PNG file."""
    figure = FIGURES[name]
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
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas.savefig(path, dpi=110)
    Image.open(path).convert("RGB").quantize(128).save(path, optimize=True)
