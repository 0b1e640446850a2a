"""Figures of a training run: the learning curve, and the reasons why episodes ended."""

import io
import logging
import textwrap
from pathlib import Path

import numpy as np

from pickplace.common.files import replaced_file
from pickplace.runs.loggers import read_csv

WALL, INK, POINT, LINE = "#9aa3ab", "#263238", "#c2410c", "#0072b2"

#: Okabe and Ito's colours, which colour-blind readers can tell apart, too.
COLOURS = ["#56b4e9", "#e69f00", "#009e73", "#f0e442", "#cc79a7", "#0072b2", "#d55e00", "#8c8c8c"]

#: A colour for each reason that ends an episode, by its name in the metrics; ``stuck``, the good one, is grey.
FAILURES = {
    "stuck": "#cfd5da", "none": "#eceff1", "pick_miss": "#d55e00", "bin_collision": "#e69f00",
    "tote_collision": "#0072b2", "overflow": "#56b4e9", "item_collision": "#009e73", "unstable": "#cc79a7",
    "out_of_reach": "#f0e442", "forbidden_turn": "#5d4037", "overloaded": "#000000",
}  # fmt: skip


def figure_of(width: float, height: float):
    """Return a figure that needs no display. matplotlib is imported here, so that importing pickplace stays fast."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    return FigureCanvasAgg(Figure(figsize=(width, height), layout="constrained")).figure


def save(figure, path: Path) -> None:
    """Write a figure as PNG, and beside it as PDF and SVG for a paper; no file is left half-written.

    Args:
        figure: the figure.
        path: the PNG to write.

    Raises:
        OSError: naming the file that cannot be written.
    """
    from matplotlib import rc_context

    legends = [legend for axes in figure.axes if (legend := axes.get_legend())]
    for legend in legends:
        legend.set_in_layout(False)  # a legend enlarges the picture; the axes keep their size
    shown = [*figure.get_default_bbox_extra_artists(), *legends]
    logging.getLogger("fontTools").setLevel(logging.WARNING)  # else it logs the omitted parts of each font
    with rc_context({"pdf.fonttype": 42, "svg.hashsalt": "pickplace"}):  # no Type 3 fonts; the same file each time
        for kind, dates in ((".png", {}), (".pdf", {"CreationDate": None}), (".svg", {"Date": None})):
            with replaced_file(path.with_suffix(kind)) as new:
                figure.savefig(new, dpi=150, bbox_inches="tight", bbox_extra_artists=shown, metadata=dates)


def learning_curve(metrics: Path, path: Path, levels: tuple[str, int] = ("level", 1), ended: str = "") -> None:
    """Draw occupancy over frames, and below it the occupancy at each level, unless only the last level was played.

    Missing values are left out: a run that was stopped early has no validation, and a batch may end no episode.

    Args:
        metrics: a ``metrics.csv``, see :class:`pickplace.runs.loggers.CsvLogger`.
        path: the PNG to write; PDF and SVG beside it.
        levels: name of a level of the curriculum, and the number of the last level.
        ended: the reason why a callback ended the training; empty if none did.
    """
    rows = read_csv(metrics)
    played = played_levels(rows)
    is_shown = bool(played) and played != [levels[1]]
    ratios = [3.6, min(0.6 + 0.15 * len(played), 3)][: 1 + is_shown]
    figure = figure_of(7, sum(ratios))
    upper, *lower = figure.subplots(len(ratios), squeeze=False, sharex=True, height_ratios=ratios)[:, 0]
    for axes in lower:
        _draw_levels(axes, rows, range(played[0], max(played[-1], levels[1]) + 1))
        axes.set_ylabel(levels[0].replace(" ", "\n"))
    _draw_occupancy(upper, rows, ended)
    _show_frames(figure.axes[len(lower)], rows)
    save(figure, path)


def played_levels(rows: list[dict]) -> list[int]:
    """Return the numbers of the levels at which an episode has ended, ascending."""
    prefix = "curriculum/occupancy_at_"
    names = {key.removeprefix(prefix) for row in rows for key in row if key.startswith(prefix)}
    return sorted(int(name) for name in names if name.isdecimal())  # a rule may log other names


def _draw_levels(axes, rows: list[dict], levels: range) -> None:
    """Draw the occupancy of training episodes as a colour for each level, in at most 100 spans of frames."""
    from matplotlib.ticker import MaxNLocator

    edges = np.linspace(0, rows[-1]["frames"], min(len(rows), 100) + 1)
    means = np.full((len(levels), len(edges) - 1), np.nan)
    for line, level in enumerate(levels):
        frames, occupancy = _columns(rows, f"curriculum/occupancy_at_{level}")
        # A batch belongs to the span that it ends.
        counts, sums = (np.histogram(frames - 0.5, edges, weights=weights)[0] for weights in (None, occupancy))
        np.divide(sums, counts, out=means[line], where=counts > 0)
    image = axes.pcolormesh(edges, np.arange(len(levels) + 1) + levels[0] - 0.5, means, rasterized=True)
    axes.figure.colorbar(image, ax=axes, label="occupancy\nin training")
    axes.yaxis.set_major_locator(MaxNLocator(8, integer=True))


def _columns(rows: list[dict], *keys: str) -> np.ndarray:
    """Return frames and metrics ``[1 + keys, rows]`` of the rows that have all of them."""
    table = [[row[key] for key in ("frames", *keys)] for row in rows if all(key in row for key in keys)]
    return np.array(table, dtype=float).reshape(-1, 1 + len(keys)).T


def _running_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the weighted mean over a window of 1% of the batches, for each batch that ends a whole window."""
    window = np.ones(max(1, len(values) // 100))
    total = np.maximum(np.convolve(weights, window, mode="valid"), 1e-9)
    return np.convolve(values * weights, window, mode="valid") / total


def _show_frames(axes, rows: list[dict]) -> None:
    from matplotlib.ticker import EngFormatter

    axes.set(xlabel="frames (environment steps)", xlim=(0, 1.02 * rows[-1]["frames"] if rows else 100))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _draw_occupancy(axes, rows: list[dict], ended: str) -> None:
    frames, occupancy = _columns(rows, "train/occupancy")
    if len(frames):
        smooth = _running_mean(occupancy, np.ones(len(frames)))
        axes.plot(
            frames[-len(smooth) :], smooth, ".-" if len(smooth) < 20 else "-", color=LINE,
            label="training episodes, at their levels, actions sampled",
        )  # fmt: skip
    frames, mean, low, high = _columns(rows, "eval/occupancy", "eval/ci95_low", "eval/ci95_high")
    if len(frames):
        # The mean of few episodes may lie outside its interval by rounding; a bar has no negative length.
        bars = np.maximum([mean - low, high - mean], 0)
        axes.errorbar(
            frames, mean, yerr=bars, fmt="o-", ms=4, capsize=2, color=POINT,
            label="validation on the full task, 95% interval",
        )  # fmt: skip
    if ended:
        text = textwrap.fill(f"end: {textwrap.shorten(ended, 300, placeholder=' ...')}", 80)
        axes.axvline(rows[-1]["frames"], color=INK, ls="--", lw=1, label=text)
    axes.set(ylabel="occupancy (0 to 1)")
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), frameon=False)
    else:
        axes.text(0.5, 0.5, "no episode has ended yet", transform=axes.transAxes, ha="center", color=INK)


def failure_mix(rows: list[dict]) -> bytes:
    """Return a PNG of the share of training episodes that ended for each reason, over frames; empty for one reason.

    Args:
        rows: of a ``metrics.csv``.
    """
    from matplotlib.ticker import PercentFormatter

    prefix = "train/failure_"
    rows = [row for row in rows if any(key.startswith(prefix) for key in row)]
    names = [name for name in FAILURES if any(row.get(prefix + name, 0) > 0 for row in rows)]
    if len(names) < 2:
        return b""
    figure = figure_of(8, 3.2)
    axes = figure.subplots()
    weights = np.array([row.get("train/episodes", 1.0) for row in rows])
    stack = [_running_mean(np.array([row.get(prefix + name, 0.0) for row in rows]), weights) for name in names]
    axes.stackplot(
        [row["frames"] for row in rows[-len(stack[0]):]], stack,
        labels=[name.replace("_", " ") for name in names], colors=[FAILURES[name] for name in names],
    )  # fmt: skip
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, reverse=True)
    axes.set(ylim=(0, 1), ylabel="training episodes")
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    _show_frames(axes, rows)
    file = io.BytesIO()
    figure.savefig(file, dpi=120)
    return file.getvalue()
