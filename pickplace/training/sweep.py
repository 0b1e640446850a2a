"""The table ``sweep.csv`` and the figure ``sweep.png`` of all runs of a sweep, for any sweeper and launcher.

``python -m pickplace.training.sweep outputs/sweep/...`` writes them again, for example after a run was resumed.
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
from pickplace.views.figures import figure_of

log = logging.getLogger(__name__)

TABLE, FIGURE = "sweep.csv", "sweep.png"
LARGEST_LEGEND = 40  # runs that the figure names; of more, the best


class SweepSummary(SweepCallback):
    """Write table and figure in the launching process when a sweep of trainings ends, however it ends.

    Training returns an occupancy, so Optuna maximises unless ``hydra.sweeper.direction`` is set.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs) -> None:
        super().on_multirun_start(config, **kwargs)
        logging.getLogger("alembic").setLevel(logging.WARNING)  # Optuna's database tool logs every migration
        chosen = any(word.startswith("hydra.sweeper.direction=") for word in config.hydra.overrides.hydra)
        if "direction" in config.hydra.sweeper and not chosen:
            with read_write(config.hydra):
                config.hydra.sweeper.direction = "maximize"

    def on_multirun_end(self, config: DictConfig, **kwargs) -> None:
        summarize(Path(config.hydra.sweep.dir))


@dataclass
class SweepRun:
    """One run of a sweep."""

    name: str  # of its folder
    overrides: dict[str, str]  # of the command line, by key
    status: str = "stopped"  # or finished, running, failed
    frames: int = 0  # environment steps trained
    validations: list[dict[str, float]] = field(default_factory=list)  # rows of metrics.csv with a validation
    error: str = ""  # of a failed run, in one sentence

    @property
    def best(self) -> float | None:
        """The best validation occupancy; None without a validation."""
        return max((row["eval/occupancy"] for row in self.validations), default=None)

    @property
    def final(self) -> float | None:
        """The latest validation occupancy; None without a validation."""
        return self.validations[-1]["eval/occupancy"] if self.validations else None


def read_run(folder: Path) -> SweepRun:
    """Read a run folder, in whatever state the run left it."""
    run = SweepRun(folder.name, dict(word.lstrip("+").partition("=")[::2] for word in noted_overrides(folder)))
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
    else:  # the checkpoint's config first: a resumed run may have a larger budget
        cfg = OmegaConf.create(facts["config"]) if facts else OmegaConf.load(folder / ".hydra" / "config.yaml")
        is_complete = run.frames >= cfg.total_frames or facts.get("ended") is True
        run.status = "finished" if is_complete else "stopped"
    return run


def summarize(folder: Path) -> list[SweepRun]:
    """Write table and figure of a sweep into its folder; return the runs in the order of the jobs.

    Raises:
        FileNotFoundError: if it contains no run.
    """
    found = [path.parent.parent for path in Path(folder).glob("*/.hydra/overrides.yaml")]
    if not found:
        raise FileNotFoundError(f"{folder}: no run in it; expected the folder of a sweep.")
    found.sort(key=lambda path: (not path.name.isdecimal(), path.name.zfill(9)))
    runs = [read_run(path) for path in found]
    keys = list(dict.fromkeys(key for run in runs for key in run.overrides))
    with (folder / TABLE).open("w", newline="") as file:
        columns = ["frames", "best_occupancy", "final_occupancy", "final_ci95_low", "final_ci95_high", "error"]
        table = csv.writer(file)
        table.writerow(["run", "status", *keys, *columns])
        for run in runs:
            last = run.validations[-1] if run.validations else {}
            results = run.frames, run.best, run.final, last.get("eval/ci95_low"), last.get("eval/ci95_high"), run.error
            table.writerow([run.name, run.status, *(run.overrides.get(key) for key in keys), *results])
    draw(runs, folder / FIGURE)
    log.info("table and figure of the sweep: %s, %s", folder / TABLE, folder / FIGURE)
    return runs


def label(run: SweepRun, runs: list[SweepRun]) -> str:
    """Label of a run in the figure: the overrides in which the runs differ, and its status unless it finished."""
    differing = [key for key in run.overrides if len({other.overrides.get(key) for other in runs}) > 1]
    words = [f"{key}={run.overrides[key]}" for key in differing] or [f"run {run.name}"]
    return ", ".join(words) + ("" if run.status == "finished" else f" ({run.status})")


def draw(runs: list[SweepRun], path: Path) -> None:
    """Draw the validation curves of all runs; the legend names them with their final occupancy, best first."""
    from matplotlib import colormaps

    ranked = sorted(runs, key=lambda run: -1.0 if run.final is None else run.final, reverse=True)
    figure = figure_of(11, max(3.6, 1.4 + 0.24 * min(len(runs), LARGEST_LEGEND)))
    axes = figure.subplots()
    for rank, run in enumerate(ranked):
        frames, means = ([row[key] for row in run.validations] for key in ("frames", "eval/occupancy"))
        text = f"{'no validation' if run.final is None else f'{run.final:.4f}'}  {label(run, runs)}"
        named = text if rank < LARGEST_LEGEND else None
        axes.plot(frames, means, ".-", color=colormaps["viridis"](0.9 * rank / len(ranked)), label=named)
    axes.set(title="Validation at full height", xlabel="frames (environment steps)", ylabel="occupancy (0 to 1)")
    axes.legend(title="final occupancy", loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, fontsize=8)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    with one_sentence():
        if len(sys.argv) != 2:
            raise ValueError("expected the folder of a sweep: python -m pickplace.training.sweep outputs/sweep/...")
        summarize(Path(sys.argv[1]))
