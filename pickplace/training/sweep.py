"""The tables and the figure of a sweep, for any sweeper and launcher.

``sweep.csv`` has a row for each run. ``sweep_settings.csv`` has a row for each setting, over its seeds. ``sweep.png``,
with PDF and SVG beside it, shows the validation curves of each setting: their mean, and each seed.

``python -m pickplace.training.sweep outputs/sweep/...`` writes them again, for example after a run was resumed.
"""

import csv
import logging
import re
import sys
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pickplace.common.errors import one_sentence, sentence
from pickplace.common.files import read_text, replaced_file
from pickplace.common.validate import expect, refuse_if
from pickplace.runs.folder import FAILURE, is_claimed, read_note
from pickplace.runs.locate import read_facts
from pickplace.runs.loggers import read_csv
from pickplace.views.figures import figure_of, save

log = logging.getLogger(__name__)

TABLE, SETTINGS_TABLE, FIGURE = "sweep.csv", "sweep_settings.csv", "sweep.png"
LARGEST_LEGEND = 40  # greatest number of settings that figure and console name, best first
COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c8c8c"]  # Okabe and Ito's, no yellow


@dataclass
class SweepRun:
    """One run of a sweep."""

    name: str  # of its folder
    overrides: dict[str, str] = field(default_factory=dict)  # of the command line, by key
    status: str = "stopped"  # or finished, running, failed, unreadable
    frames: int = 0  # environment steps trained
    validations: list[dict[str, float]] = field(default_factory=list)  # rows of metrics.csv with a validation
    best: float | None = None  # greatest occupancy of a validation
    seed: str = "0"  # as on the command line
    ended: str = ""  # why a callback ended a finished run before its budget was spent
    error: str = ""  # of a failed or unreadable run, in one sentence

    @property
    def last(self) -> dict[str, float]:
        """The latest validation, by the names of its metrics; empty without one."""
        return self.validations[-1] if self.validations else {}

    @property
    def curve(self) -> np.ndarray:
        """Frames, occupancies, and the lower and upper ends of their 95% intervals (or NaN), ``[4, V]``."""
        keys = ("frames", "eval/occupancy", "eval/ci95_low", "eval/ci95_high")
        return np.array([[row.get(key, np.nan) for row in self.validations] for key in keys])


def read_run(folder: Path) -> SweepRun:
    """Read a run folder, in whatever state the run left it."""
    run = SweepRun(folder.name)
    try:
        words = read_note(folder, "overrides.yaml")
        expect(
            isinstance(words, list) and all(isinstance(word, str) for word in words),
            f"{folder}/.hydra/overrides.yaml",
            words,
            "the overrides of the run, as Hydra notes them",
        )
        run.overrides = dict(word.lstrip("+").partition("=")[::2] for word in words)
        facts = read_facts(folder, "last")
        if (folder / "metrics.csv").is_file():
            rows = read_csv(folder / "metrics.csv")
        else:  # logger=none
            latest = {f"eval/{key}": float(value) for key, value in (facts.get("latest") or {}).items()}
            rows = [{"frames": facts["frames"], **latest}] if facts else []
        run.frames = int(rows[-1]["frames"]) if rows else 0
        run.validations = [row for row in rows if "eval/occupancy" in row]
        best = [float(facts["best"])] if "best" in facts else []
        run.best = max(best + [row["eval/occupancy"] for row in run.validations]) if run.validations else None
        # The checkpoint's config first: a resumed run may have a larger budget.
        config = facts.get("config") or read_note(folder, "config.yaml")
        config = config if isinstance(config, dict) else {}
        run.seed = run.overrides.get("seed", str(config.get("seed", 0)))
        if (folder / FAILURE).is_file():
            run.status, run.error = "failed", read_text(folder / FAILURE).strip()
        elif is_claimed(folder):
            run.status = "running"
        else:
            budget = config.get("total_frames")
            run.ended = str(facts.get("ended") or "")
            if run.ended or (isinstance(budget, int) and run.frames >= budget):
                run.status = "finished"
    except Exception as error:  # of any type: the checkpoint's facts are unchecked
        run.status, run.error = "unreadable", sentence(error)
    return run


class SweepSetting:
    """The runs of a sweep that differ in their seed only, and statistics over those that finished.

    Attributes:
        overrides: without the seed.
        finished: the runs that finished, with a validation, one for each seed.
        mean: their mean final validation occupancy; None without any.
        interquartile_mean: the mean of their middle half; None with fewer than four, for which it would be the mean.
        interval: the 95% interval of their mean, see :func:`bootstrap95`; two times None with fewer than two.
        frames: the least and the greatest number of frames that they trained; two times None without any.
    """

    def __init__(self, runs: list[SweepRun]):
        from scipy.stats import trim_mean

        self.runs = runs
        self.overrides = {key: value for key, value in runs[0].overrides.items() if key != "seed"}
        # A seed that was trained twice, such as by name and by default, counts once.
        self.finished = [*{run.seed: run for run in runs if run.status == "finished" and run.last}.values()]
        finals, count = np.array([run.last["eval/occupancy"] for run in self.finished]), len(self.finished)
        self.mean = float(finals.mean()) if count else None
        self.interquartile_mean = float(trim_mean(finals, 0.25)) if count >= 4 else None
        self.interval = tuple(map(float, bootstrap95(finals))) if count >= 2 else (None, None)
        trained = [run.frames for run in self.finished]
        self.frames = (min(trained), max(trained)) if trained else (None, None)

    @property
    def curves(self) -> tuple[np.ndarray, np.ndarray]:
        """Frames ``[V]`` and validation occupancies ``[V, S]`` of the finished runs; an ended run keeps its last."""
        curves = [run.curve[:2] for run in self.finished]
        first = max((frames[0] for frames, _ in curves), default=0)  # from here on each run has a validation
        frames = np.unique([each for frames, _ in curves for each in frames if each >= first])
        values = [occupancy[np.searchsorted(seen, frames, "right") - 1] for seen, occupancy in curves]
        return frames, np.reshape(values, (len(curves), len(frames))).T


def bootstrap95(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95% percentile bootstrap interval of the mean over the last axis.

    Two or three values give their range, which is too narrow for 95%.

    Args:
        values: ``[..., S]`` with ``S >= 2``.

    Returns:
        Low and high ends, each ``[...]``; the same for the same values.
    """
    from scipy.stats import bootstrap

    settings = {"n_resamples": 9999, "batch": 1000, "method": "percentile", "random_state": 0}
    return bootstrap((values,), np.mean, axis=-1, **settings).confidence_interval


def group_by_setting(runs: list[SweepRun]) -> list[SweepSetting]:
    """Return the settings of a sweep: its runs, grouped by their overrides without the seed.

    A run whose overrides cannot be read belongs to none.
    """
    groups: dict[frozenset, list[SweepRun]] = defaultdict(list)
    for run in runs:
        if run.status != "unreadable" or run.overrides:
            groups[frozenset(item for item in run.overrides.items() if item[0] != "seed")].append(run)
    return [*map(SweepSetting, groups.values())]


def summarize(folder: Path) -> list[SweepSetting]:
    """Write tables and figure of a sweep into its folder; return the settings in the order of their folders' names.

    Raises:
        FileNotFoundError: if it contains no run.
    """
    found = sorted(
        (path.parent.parent for path in Path(folder).glob("*/.hydra/overrides.yaml")),
        key=lambda path: [part.zfill(9) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)],
    )
    refuse_if(not found, f"{folder}: no run in it; expected the folder of a sweep.", FileNotFoundError)
    runs = [read_run(path) for path in found]
    settings = group_by_setting(runs)
    keys = list(dict.fromkeys(key for run in runs for key in run.overrides))
    _write_table(
        folder / TABLE,
        ["run", "status", *keys]
        + ["frames", "best_occupancy", "final_occupancy", "final_ci95_low", "final_ci95_high", "ended", "error"],
        [
            [run.name, run.status, *map(run.overrides.get, keys), run.frames]
            + [run.best]
            + [*map(run.last.get, ("eval/occupancy", "eval/ci95_low", "eval/ci95_high")), run.ended, run.error]
            for run in runs
        ],
    )
    keys = [key for key in keys if key != "seed"]
    _write_table(
        folder / SETTINGS_TABLE,
        [*keys, "runs", "finished", "mean_occupancy", "interquartile_mean", "mean_ci95_low", "mean_ci95_high"]
        + ["ended_early", "least_frames", "most_frames"],
        [
            [*map(each.overrides.get, keys), len(each.runs), len(each.finished), each.mean]
            + [each.interquartile_mean, *each.interval, sum(bool(run.ended) for run in each.finished), *each.frames]
            for each in settings
        ],
    )
    # The best mean first; those without a finished run are last.
    ranked = sorted(settings, key=lambda setting: -1.0 if setting.mean is None else setting.mean, reverse=True)
    draw(ranked, folder / FIGURE)
    for line in results(ranked)[:LARGEST_LEGEND]:
        log.info(line)
    log.info("tables and figure of the sweep: %s, %s, %s", folder / SETTINGS_TABLE, folder / TABLE, folder / FIGURE)
    return settings


def _write_table(path: Path, columns: list[str], rows: list[list]) -> None:
    with replaced_file(path) as new, new.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])


def label(setting: SweepSetting, settings: list[SweepSetting]) -> str:
    """Label of a setting: the overrides in which settings differ, and its runs that did not use their budget."""
    words = [
        f"{key}={value}"
        for key, value in setting.overrides.items()
        if any(other.overrides.get(key) != value for other in settings)
    ]
    ends = Counter("ended early" if run.ended else run.status for run in setting.runs)
    counts = ", ".join(f"{count} {end}" for end, count in ends.items() if end != "finished")
    return (", ".join(words) or ("all runs" if len(settings) == 1 else "defaults")) + (f" ({counts})" if counts else "")


def results(settings: list[SweepSetting]) -> list[str]:
    """A line of text for each setting, in columns: mean final occupancy, its interval, seeds, frames, and the label."""
    rows = []
    for setting in settings:
        count, (least, most), text = len(setting.finished), setting.frames, label(setting, settings)
        row = ["none finished", "", "", ""]
        if count:
            interval = "({:.4f} to {:.4f})".format(*setting.interval) if count > 1 else ""
            frames = f"{most:,}" if least == most else f"{least:,} to {most:,}"
            row = [f"{setting.mean:.4f}", interval, f"{count} seed{'s' * (count > 1)}", f"{frames} frames"]
        rows.append([*row, text if len(text) <= 140 else f"{text[:90]} ... {text[-45:]}"])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = [[text.ljust(width) for text, width in zip(row, widths, strict=True) if width] for row in rows]
    return ["  ".join(row).rstrip() for row in padded]


def draw(settings: list[SweepSetting], path: Path) -> None:
    """Draw the mean validation curve of each setting over its finished runs, with its 95% interval, in this order.

    Thin lines are runs: their spread over the seeds, where each ended, and those that did not finish. The interval of
    a single run is that of the episodes of each validation.
    """
    from matplotlib import colormaps
    from matplotlib.ticker import EngFormatter

    figure = figure_of(7, 4)
    axes = figure.subplots()
    shades = colormaps["viridis"](0.95 * np.arange(len(settings)) / max(len(settings), 1))
    for rank, (setting, text) in enumerate(zip(settings, results(settings), strict=True)):
        colour = COLOURS[rank] if len(settings) <= len(COLOURS) else shades[rank]
        for run in setting.runs:
            frames, values, *interval = run.curve
            axes.plot(frames, values, ".--" if run.status != "finished" else "-", color=colour, lw=0.7, alpha=0.7)
            if len(frames) and run.ended:
                axes.plot(frames[-1], values[-1], "X", color=colour, mec="white", ms=8, zorder=3)
            if [run] == setting.finished:
                axes.fill_between(frames, *interval, color=colour, alpha=0.2, lw=1)
        frames, values = setting.curves
        means = values.mean(1) if len(frames) else frames
        axes.plot(frames, means, "o-", color=colour, ms=3.5, label=text if rank < LARGEST_LEGEND else None)
        if len(frames) and values.shape[1] > 1:
            axes.fill_between(frames, *bootstrap95(values), color=colour, alpha=0.2, lw=1)
    runs = [run for setting in settings for run in setting.runs]
    for style, text, is_drawn in (
        ("-", "one seed", any(len(setting.finished) > 1 for setting in settings)),
        ("X", "ended early, counted on with that value", any(run.ended for run in runs)),
        (".--", "not finished", any(run.status != "finished" for run in runs)),
    ):
        axes.plot([], [], style, color="0.4", lw=0.7, label=text if is_drawn else None)
    axes.set(xlim=(0, None), xlabel="frames (environment steps)", ylabel="validation occupancy (0 to 1)")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)
    few = " (their range, if 2 or 3)" if any(1 < len(setting.finished) < 4 for setting in settings) else ""
    axes.legend(
        title=f"final occupancy: mean over seeds and its 95% interval{few}; frames", loc="upper left",
        bbox_to_anchor=(0, -0.15), frameon=False, alignment="left", prop={"family": "monospace", "size": 7},
    )  # fmt: skip
    save(figure, path)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    with one_sentence():
        refuse_if(
            len(sys.argv) != 2, "expected the folder of a sweep: python -m pickplace.training.sweep outputs/sweep/..."
        )
        summarize(Path(sys.argv[1]))
