"""One table, ``sweep.csv``, and one figure, ``sweep.png``, of all runs of a sweep, by whatever sweeper and launcher.

``python -m pickplace.training.sweep outputs/sweep/...`` makes them again, such as after a run was resumed.
"""

import csv
import logging
import sys
from dataclasses import dataclass, field
from pathlib import Path

from omegaconf import DictConfig, OmegaConf, read_write

from pickplace.runs.checkpoint import read_facts
from pickplace.runs.errors import one_sentence
from pickplace.runs.folder import FAILURE, is_claimed, noted_overrides
from pickplace.runs.hydra_app import SweepCallback
from pickplace.runs.loggers import read_csv

log = logging.getLogger(__name__)

TABLE, FIGURE = "sweep.csv", "sweep.png"
YELLOW = "#f0e442"  # too pale for a line
SHOWN = 40  # runs that the figure names; of more, the best


class SweepSummary(SweepCallback):
    """Writes table and figure when a sweep of trainings ends, however it ends, in the process that launched it.

    Optuna minimises unless it is told otherwise, and training returns an occupancy: here it is told.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs) -> None:
        super().on_multirun_start(config, **kwargs)
        logging.getLogger("alembic").setLevel(logging.WARNING)  # Optuna's tool for databases tells of all its parts
        told = any(word.startswith("hydra.sweeper.direction=") for word in config.hydra.overrides.hydra)
        if "direction" in config.hydra.sweeper and not told:
            with read_write(config.hydra):
                config.hydra.sweeper.direction = "maximize"

    def on_multirun_end(self, config: DictConfig, **kwargs) -> None:
        summarize(Path(config.hydra.sweep.dir))


@dataclass
class Run:
    """What a run folder of a sweep tells.

    Attributes:
        name: the folder's.
        overrides: what was set on the command line, by key.
        status: ``finished``, ``running``, ``stopped`` before its last frame, or ``failed``.
        frames: environment steps trained.
        validations: rows of ``metrics.csv`` with a validation: ``frames``, ``eval/occupancy`` and its interval.
        error: why it failed, in one sentence.
    """

    name: str
    overrides: dict[str, str]
    status: str = "stopped"
    frames: int = 0
    validations: list[dict[str, float]] = field(default_factory=list)
    error: str = ""

    @property
    def best(self) -> float | None:
        """The best validation occupancy; None without a validation."""
        return max((row["eval/occupancy"] for row in self.validations), default=None)

    @property
    def final(self) -> float | None:
        """The latest validation occupancy; None without a validation."""
        return self.validations[-1]["eval/occupancy"] if self.validations else None


def read_run(folder: Path) -> Run:
    """Read a run folder, whatever state the run was left in."""
    run = Run(folder.name, dict(word.lstrip("+").partition("=")[::2] for word in noted_overrides(folder)))
    facts = read_facts(folder, "last")
    if (folder / "metrics.csv").is_file():
        rows = read_csv(folder / "metrics.csv")
        run.frames = int(rows[-1]["frames"]) if rows else 0
        run.validations = [row for row in rows if "eval/occupancy" in row]
    elif facts:  # logger=none
        run.frames = facts["frames"]
        if latest := facts.get("latest"):
            run.validations = [{"frames": run.frames, **{f"eval/{key}": value for key, value in latest.items()}}]
    if (folder / FAILURE).is_file():
        run.status, run.error = "failed", (folder / FAILURE).read_text().strip()
    elif is_claimed(folder):
        run.status = "running"
    else:
        # By the checkpoint's config, if there is one: a resumed run may be given more frames.
        cfg = OmegaConf.create(facts["config"]) if facts else OmegaConf.load(folder / ".hydra" / "config.yaml")
        if run.frames >= cfg.total_frames:
            run.status = "finished"
    return run


def summarize(folder: Path) -> list[Run]:
    """Write table and figure of a sweep into its folder.

    Args:
        folder: the sweep's, with a run folder for each job.

    Returns:
        The runs, in the order of the jobs.

    Raises:
        FileNotFoundError: if there is no run in it.
    """
    found = [path.parent.parent for path in Path(folder).glob("*/.hydra/overrides.yaml")]
    if not found:
        raise FileNotFoundError(f"{folder}: no run in it; expected the folder of a sweep.")
    found.sort(key=lambda path: (not path.name.isdecimal(), path.name.zfill(9)))
    runs = [read_run(path) for path in found]
    write_table(runs, folder / TABLE)
    draw(runs, folder / FIGURE)
    best = max(runs, key=lambda run: -1.0 if run.best is None else run.best)
    if best.best is not None:
        log.info("best validation occupancy: %.4f, %s (%s)", best.best, folder / best.name, labels(runs)[best.name])
    log.info("the sweep's table and figure: %s, %s", folder / TABLE, folder / FIGURE)
    return runs


def write_table(runs: list[Run], path: Path) -> None:
    """Write a row for each run: its status, its overrides, frames, best and final validation occupancy."""
    keys = list(dict.fromkeys(key for run in runs for key in run.overrides))
    outcome = ["frames", "best_occupancy", "final_occupancy", "final_ci95_low", "final_ci95_high", "error"]
    with Path(path).open("w", newline="") as file:
        table = csv.DictWriter(file, ["run", "status", *keys, *outcome])
        table.writeheader()
        for run in runs:
            last = run.validations[-1] if run.validations else {}
            interval = (last.get("eval/ci95_low"), last.get("eval/ci95_high"))
            values = (run.frames, run.best, run.final, *interval, run.error)
            table.writerow(
                {"run": run.name, "status": run.status, **run.overrides, **dict(zip(outcome, values, strict=True))}
            )


def labels(runs: list[Run]) -> dict[str, str]:
    """A short name of each run, by its folder's: the overrides in which the runs differ."""
    keys = dict.fromkeys(key for run in runs for key in run.overrides)
    differing = [key for key in keys if len({run.overrides.get(key) for run in runs}) > 1]
    leaves = [key.rpartition(".")[2] for key in differing]
    short = {key: leaf if leaves.count(leaf) == 1 else key for key, leaf in zip(differing, leaves, strict=True)}

    def value(text: str) -> str:
        try:
            return text if text.lstrip("-").isdecimal() else f"{float(text):.3g}"
        except ValueError:
            return text

    return {
        run.name: ", ".join(f"{short[key]}={value(run.overrides[key])}" for key in differing if key in run.overrides)
        or f"run {run.name}"
        for run in runs
    }


def draw(runs: list[Run], path: Path) -> None:
    """Draw the validation curves of all runs, and beside them how each ended, best first, in the same colours."""
    import matplotlib
    from matplotlib.ticker import EngFormatter, MaxNLocator

    from pickplace.views.figures import COLOURS, INK, figure_of

    ranked = sorted(runs, key=lambda run: -1.0 if run.final is None else run.final, reverse=True)
    named, names = ranked[:SHOWN], labels(runs)
    distinct = [colour for colour in COLOURS if colour != YELLOW]
    if len(runs) <= len(distinct):
        colours: dict[str, str | tuple] = {run.name: colour for run, colour in zip(runs, distinct, strict=False)}
    else:  # from the best to the last
        scale = matplotlib.colormaps["viridis"]
        colours = {run.name: scale(0.9 * rank / len(ranked)) for rank, run in enumerate(ranked)}

    figure = figure_of(11, max(3.6, 1.4 + 0.24 * len(named)))
    curves, ends = figure.subplots(1, 2, width_ratios=[3, 2])
    for run in reversed(ranked):
        frames = [row["frames"] for row in run.validations]
        means = [row["eval/occupancy"] for row in run.validations]
        curves.plot(frames, means, ".-" if len(frames) < 30 else "-", color=colours[run.name], lw=1.4)
    curves.set_title("Validation at full height, all runs")
    curves.set_xlabel("frames (environment steps)")
    curves.set_ylabel("occupancy (0 to 1)")
    curves.xaxis.set_major_formatter(EngFormatter(sep=""))

    for place, run in enumerate(named):
        note = {"finished": None, "stopped": f"stopped at {run.frames:,} frames"}.get(run.status, run.status)
        if run.final is not None:
            last, colour = run.validations[-1], colours[run.name]
            low, high = (last.get(f"eval/ci95_{side}", run.final) for side in ("low", "high"))
            # The mean of few episodes may lie on the edge of its interval by rounding; a bar has no negative length.
            bar = [[max(run.final - low, 0)], [max(high - run.final, 0)]]
            ends.errorbar(run.final, place, xerr=bar, fmt="o", color=colour, capsize=3)
            ends.plot(run.best, place, "|", color=colour, ms=11, mew=2)
        if note:
            at = 0.02 if not run.validations else 0.98
            ends.text(
                at, place, note, transform=ends.get_yaxis_transform(), ha="left" if at < 0.5 else "right", va="center",
                color=INK, fontsize=8, style="italic",
            )  # fmt: skip
    if not any(run.validations for run in runs):
        curves.text(0.5, 0.5, "no validation yet", transform=curves.transAxes, ha="center", color=INK)
    ends.set_yticks(range(len(named)), [names[run.name] for run in named], fontsize=8)
    ends.set_ylim(len(named) - 0.4, -0.6)
    ends.xaxis.set_major_locator(MaxNLocator(5))
    share = f" ({SHOWN} best of {len(runs)})" if len(runs) > SHOWN else ""
    ends.set_title(f"Final, 95% interval; best as a bar{share}")
    ends.set_xlabel("occupancy (0 to 1)")
    for axes in (curves, ends):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    with one_sentence():
        if len(sys.argv) != 2:
            raise ValueError("expected the folder of a sweep: python -m pickplace.training.sweep outputs/sweep/...")
        summarize(Path(sys.argv[1]))
