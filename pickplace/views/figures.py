"""Figures of a training run: the learning curve, and the reasons for which episodes ended."""

from pathlib import Path

import numpy as np

from pickplace.runs.loggers import read_csv

WALL, INK, POINT, LINE = "#9aa3ab", "#263238", "#c2410c", "#0072b2"

#: Okabe and Ito's colours, told apart by colour-blind readers too.
COLOURS = ["#56b4e9", "#e69f00", "#009e73", "#f0e442", "#cc79a7", "#0072b2", "#d55e00", "#8c8c8c"]

#: A colour for each reason that ends an episode, by its name in the metrics; ``stuck``, the good one, is grey.
FAILURES = {
    "stuck": "#cfd5da", "none": "#eceff1", "pick_miss": "#d55e00", "bin_collision": "#e69f00",
    "tote_collision": "#0072b2", "overflow": "#56b4e9", "item_collision": "#009e73", "unstable": "#cc79a7",
    "out_of_reach": "#f0e442",
}  # fmt: skip


def figure_of(width: float, height: float):
    """Return a figure that needs no display; matplotlib is imported here, so that importing pickplace stays fast."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    return FigureCanvasAgg(Figure(figsize=(width, height), layout="constrained")).figure


def learning_curve(metrics: Path, path: Path, level_name: str = "tote height") -> None:
    """Draw occupancy over frames, and below it the level that the curriculum had reached.

    What the table lacks is left out: a run that was stopped early has no validation, one batch may end no episode.

    Args:
        metrics: a ``metrics.csv``, see :class:`pickplace.runs.loggers.CsvLogger`.
        path: the PNG or SVG to write.
    """
    from matplotlib.ticker import MaxNLocator

    rows = read_csv(metrics)
    frames, level = _columns(rows, "curriculum/level")
    ratios = [4, 1] if len(frames) else [4]
    figure = figure_of(8, sum(ratios))
    upper, *lower = figure.subplots(len(ratios), squeeze=False, sharex=True, height_ratios=ratios)[:, 0]
    for axes in lower:
        for frame in frames[1:][np.diff(level) != 0]:
            upper.axvline(frame, color=WALL, lw=0.8, ls=":", zorder=0)
        axes.step(frames, level, _line(frames), where="post", color=INK)
        axes.set(ylabel=level_name, ylim=(0, level.max() + 0.5))
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        axes.grid(alpha=0.3)
    _draw_occupancy(upper, rows)
    _show_frames(figure.axes[-1], rows)
    figure.savefig(path, dpi=120)


def _columns(rows: list[dict], *keys: str) -> np.ndarray:
    """Return frames and metrics ``[1 + keys, rows]``, of the rows that have them all."""
    table = [[row[key] for key in ("frames", *keys)] for row in rows if all(key in row for key in keys)]
    return np.array(table, dtype=float).reshape(-1, 1 + len(keys)).T


def _line(values: np.ndarray) -> str:
    return ".-" if len(values) < 20 else "-"


def _running_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the weighted mean over the latest 1% of the batches, for each batch that has as many before it."""
    window = np.ones(max(1, len(values) // 100))
    total = np.maximum(np.convolve(weights, window, mode="valid"), 1e-9)
    return np.convolve(values * weights, window, mode="valid") / total


def _show_frames(axes, rows: list[dict]) -> None:
    from matplotlib.ticker import EngFormatter

    most = max([row["frames"] for row in rows], default=100)
    axes.set(xlabel="frames (environment steps)", xlim=(0, 1.02 * most))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _draw_occupancy(axes, rows: list[dict]) -> None:
    frames, occupancy = _columns(rows, "train/occupancy")
    if len(frames):
        smooth = _running_mean(occupancy, np.ones(len(frames)))
        axes.plot(
            frames[-len(smooth) :], smooth, _line(smooth), color=LINE,
            label="training episodes, at the curriculum's level, actions sampled",
        )  # fmt: skip
    frames, mean = _columns(rows, "eval/occupancy")
    if len(frames):
        axes.plot(frames, mean, "o-", color=POINT, label="validation at full height, 95% interval")
    frames, mean, low, high = _columns(rows, "eval/occupancy", "eval/ci95_low", "eval/ci95_high")
    if len(frames):
        # The mean of few episodes may lie outside its interval by rounding; a bar has no negative length.
        bars = np.maximum([mean - low, high - mean], 0)
        axes.errorbar(frames, mean, yerr=bars, fmt="none", ecolor=POINT, capsize=3)
    axes.set_title("Learning curve: share of the tote's volume filled when an episode ends")
    axes.set(ylabel="occupancy (0 to 1)", ylim=(0, 1.02))
    axes.grid(alpha=0.3)
    _draw_legend(axes, loc="best")


def _draw_legend(axes, **place) -> None:
    """Draw a legend; or say that there is nothing to see."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(**place)
    else:
        axes.text(0.5, 0.5, "no episode has ended yet", transform=axes.transAxes, ha="center", color=INK)


def failure_mix(metrics: Path, path) -> None:
    """Draw the share of training episodes that ended for each reason, over frames.

    Args:
        metrics: a ``metrics.csv``.
        path: the PNG or SVG to write, or a file object.
    """
    from matplotlib.ticker import PercentFormatter

    prefix = "train/failure_"
    rows = [row for row in read_csv(metrics) if any(key.startswith(prefix) for key in row)]
    names = [name for name in FAILURES if any(row.get(prefix + name, 0) > 0 for row in rows)]
    figure = figure_of(8, 3.2)
    axes = figure.subplots()
    if names:
        weights = np.array([row.get("train/episodes", 1.0) for row in rows])
        stack = [_running_mean(np.array([row.get(prefix + name, 0.0) for row in rows]), weights) for name in names]
        axes.stackplot(
            [row["frames"] for row in rows[-len(stack[0]):]], stack,
            labels=[name.replace("_", " ") for name in names], colors=[FAILURES[name] for name in names],
        )  # fmt: skip
    _draw_legend(axes, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    axes.set(ylim=(0, 1), ylabel="training episodes")
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    _show_frames(axes, rows)
    figure.savefig(path, dpi=120)
