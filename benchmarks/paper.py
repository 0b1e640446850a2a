"""Make the paper's comparison: python benchmarks/paper.py

Trains with three seeds, plays the test stream, and writes a table and figures into docs/results/paper.
Finished trainings and episodes in outputs/paper are read; stopped trainings go on.
``python benchmarks/paper.py fcn4d-R4-0`` runs only this training, so that several processes can share the work.
"""

import csv
import sys
from collections import defaultdict
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
from common import ROOT, evaluate, run
from matplotlib.ticker import EngFormatter
from scipy.stats import t

from pickplace.runs.loggers import read_csv
from pickplace.views.figures import COLOURS, figure_of

RESULTS, RUNS = ROOT / "docs" / "results" / "paper", ROOT / "outputs" / "paper"
SMALL, LARGE = ("6x6x5", "6x6x10", "10x10x5", "10x10x10"), ("30x30x5", "30x30x10")
CANDIDATES = (1, 2, 3, 5, 10, 20, 50)
MOST, MANY, FEW = 500, 100, 10  # numbers of episodes: where a tote takes a moment, seconds, or minutes


class Training(NamedTuple):
    """A method that is trained."""

    words: str  # for pickplace-train
    hours: float  # of one core, for each seed
    totes: tuple[str, ...] = SMALL  # it plays
    seeds: int = 3


#: By method and R.
TRAININGS = {
    ("fcn4d", 4): Training("experiment=paper_fast", 2.5, SMALL + LARGE),
    ("fcn4d", 3): Training("experiment=paper_fast env.rotations=3", 2.5),
    ("individual_rl", 4): Training("experiment=paper_fast model=individual_rl", 0.7),
    ("individual_rl", 3): Training("experiment=paper_fast model=individual_rl env.rotations=3", 0.7),
    ("fcn4d_noclip", 4): Training("experiment=paper_fast model=fcn4d_noclip env.tote_size=[6,6,10]", 2.5, ("6x6x10",)),
    ("typical", 4): Training("experiment=paper_fast model=typical", 4.0, ("6x6x5",), 1),
    ("paper", 4): Training("experiment=paper total_frames=250_000", 2.0, ("6x6x5",), 1),
}
#: Method -> its label in the figures.
LABELS = {
    "individual_heuristic": "individual_heuristic",
    "individual_rl": "individual_rl",
    "typical": "typical",
    "mcts": "mcts",
    "fcn4d_noclip": "fcn4d_noclip, trained at 6x6x10",
    "fcn4d": "fcn4d (proposed)",
    "joint_dbl": "joint_dbl (not in the paper)",
    "paper": "fcn4d, the paper's settings",
}
STYLE = dict(zip(LABELS, COLOURS, strict=True))


class Cell(NamedTuple):
    """A method, trained or not, in totes of one size."""

    method: str
    R: int
    tote: str
    K: int | None = None
    seed: int | None = None  # of the training; None: of all trainings, or not trained

    @property
    def episodes(self) -> int:
        if self.tote in LARGE or self.method == "mcts":
            return FEW
        return MOST if self.tote == "6x6x5" else MANY


def cells() -> Iterator[Cell]:
    """Yield all cells that are played."""
    for (method, turns), training in TRAININGS.items():
        for tote, seed in product(training.totes, range(training.seeds)):
            every = CANDIDATES if (turns, tote) == (3, "6x6x5") else (1, 10)
            if tote in SMALL or seed == 0:
                yield from (Cell(method, turns, tote, k, seed) for k in every)
    for method, turns, tote in product(("joint_dbl", "individual_heuristic"), (3, 4), SMALL + LARGE):
        yield Cell(method, turns, tote)
    yield from (Cell("mcts", 4, tote) for tote in SMALL[:3])


def train(method: str, turns: int, seed: int) -> None:
    """Train, or go on with a training, unless it is finished."""
    folder = RUNS / f"{method}-R{turns}-{seed}"
    if not (folder / "report.html").is_file():
        new = [*TRAININGS[method, turns].words.split(), f"seed={seed}", f"hydra.run.dir={folder}"]
        run("pickplace-train", *([f"resume={folder}"] if (folder / "checkpoints").is_dir() else new), "threads=1")


def play(cell: Cell) -> list[float]:
    """Return the occupancy of each episode of the test stream."""
    words = [f"env.tote_size=[{cell.tote.replace('x', ',')}]", f"evaluation.episodes={cell.episodes}"]
    words += ["evaluation.batch_size=50", "evaluation.latency_decisions=0"]
    if cell.seed is None:
        words += ["env=paper", f"env.rotations={cell.R}", f"planner={cell.method}"]
    else:
        words += [f"checkpoint={RUNS / f'{cell.method}-R{cell.R}-{cell.seed}'}", f"planner.candidates={cell.K}"]
    folder = RUNS / "played" / "-".join(str(part) for part in cell if part is not None)
    return evaluate(folder, *words)["occupancy"]["per_episode"]


def half_interval(values: np.ndarray) -> float:
    """Return half of Student's 95% interval of a mean; 0 for a single value."""
    return float(t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5) if len(values) > 1 else 0.0


def summary(seeds: list[list[float]]) -> dict:
    """Return the mean over training seeds and episodes, with a 95% interval. It adds, as independent errors, the
    interval over episodes, which all seeds share, and the interval over seeds."""
    values = np.array(seeds)  # [seeds, episodes]
    half = float(np.hypot(half_interval(values.mean(0)), half_interval(values.mean(1))))
    middle, counts = float(values.mean()), dict(zip(("seeds", "episodes"), values.shape, strict=True))
    return {**counts, "mean": middle, "low": middle - half, "high": middle + half}


def measure() -> list[dict]:
    """Return a row for each cell, each difference to another method in the same episodes, and each validation."""
    played: dict[Cell, list[list[float]]] = defaultdict(list)  # of each training seed, the occupancy of each episode
    for cell in cells():
        played[cell._replace(seed=None)].append(play(cell))
    rows = []
    for cell, seeds in played.items():
        same = {"method": cell.method, "R": cell.R, "tote": cell.tote, "K": cell.K}
        rows.append({"kind": "played", **same, **summary(seeds)})
        for other in played:
            same_play = other.method != cell.method == "fcn4d" and other[1:3] == cell[1:3]
            if same_play and other.K in (None, cell.K):
                rows.append({"kind": "difference", **same, "versus": other.method, **less(seeds, played[other])})
    for (method, turns), training in TRAININGS.items():
        for seed in range(training.seeds):
            for point in read_csv(RUNS / f"{method}-R{turns}-{seed}" / "metrics.csv"):
                if "eval/occupancy" in point:
                    curve = {"kind": "curve", "method": method, "R": turns, "seed": seed, "frames": point["frames"]}
                    rows.append(curve | {"height": point["curriculum/level"], "mean": point["eval/occupancy"]})
    return rows


def less(seeds: list[list[float]], others: list[list[float]]) -> dict:
    """Return the difference of two methods in the same episodes, seed by seed; a single seed is paired with all."""
    others = others * len(seeds) if len(others) == 1 else others
    return summary([[a - b for a, b in zip(*pair, strict=False)] for pair in zip(seeds, others, strict=False)])


def found(rows: list[dict], **wanted) -> dict | None:
    """Return the row of played episodes with these values; None without one."""
    return next((r for r in rows if r["kind"] == "played" and all(r.get(key) == v for key, v in wanted.items())), None)


def panels(count: int = 1, width: float = 8, height: float = 4.2, **shared):
    """Return a figure, and its axes in a plain style."""
    figure = figure_of(width, height)
    every = figure.subplots(1, count, squeeze=False, sharey=True, **shared)[0]
    for axes in every:
        axes.grid(axis="y", alpha=0.3)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, every


def finish(figure, axes, name: str) -> None:
    """Write a figure with the legend of some axes below it."""
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(RESULTS / f"{name}.png", dpi=120)


def draw_bars(axes, rows: list[dict], methods: tuple[str, ...], totes: tuple[str, ...], k: int, turns: int) -> None:
    """Draw a group of bars for each tote, one for each method, with its interval."""
    width = 0.8 / len(methods)
    for order, method in enumerate(methods):
        bars = []
        for place, tote in enumerate(totes):
            trained = (method, turns) in TRAININGS
            if row := found(rows, method=method, R=turns, tote=tote, K=k if trained else None):
                bars.append((place + (order - (len(methods) - 1) / 2) * width, row))
        if bars:
            xs, means = [x for x, _ in bars], [row["mean"] for _, row in bars]
            low, high = [row["mean"] - row["low"] for _, row in bars], [row["high"] - row["mean"] for _, row in bars]
            style = {"color": STYLE[method], "ecolor": "#37474f", "error_kw": {"elinewidth": 1}, "capsize": 2}
            drawn = axes.bar(xs, means, width * 0.92, yerr=[low, high], label=LABELS[method], **style)
            axes.bar_label(drawn, fmt="%.2f", fontsize=7, padding=2)
    axes.set_xticks(range(len(totes)), totes)
    axes.set_ylim(0, 1.1)
    axes.set_xlabel("tote")


def draw_candidates(rows: list[dict]) -> None:
    """Draw the occupancy over K, as the paper's Fig. 6."""
    figure, (axes,) = panels(width=6)
    for method in ("fcn4d", "individual_rl"):
        line = [found(rows, method=method, R=3, tote="6x6x5", K=k) for k in CANDIDATES]
        errors = [[row["mean"] - row["low"] for row in line], [row["high"] - row["mean"] for row in line]]
        means = [row["mean"] for row in line]
        axes.errorbar(CANDIDATES, means, errors, color=STYLE[method], label=LABELS[method], marker="o", capsize=3)
    axes.set_xscale("log")
    axes.set_xticks(CANDIDATES, CANDIDATES)
    axes.minorticks_off()
    axes.set_xlabel("K, most probable actions that are tried")
    axes.set_ylabel("occupancy, 6x6x5, R=3")
    finish(figure, axes, "candidates")


def draw_joint_or_individual(rows: list[dict]) -> None:
    """Draw joint beside individual planning, as the paper's Fig. 7."""
    figure, both = panels(2, 11)
    for axes, turns in zip(both, (3, 4), strict=True):
        draw_bars(axes, rows, ("individual_heuristic", "individual_rl", "fcn4d", "joint_dbl"), SMALL, 10, turns)
        axes.set_title(f"R={turns}, K=10", fontsize=10)
    both[0].set_ylabel("occupancy")
    finish(figure, both[0], "joint_or_individual")


def draw_learning(rows: list[dict]) -> None:
    """Draw validations over frames, and the height of the tote in training, as the paper's Fig. 8."""
    figure = figure_of(8, 5.5)
    upper, lower = figure.subplots(2, sharex=True, height_ratios=[2.5, 1])
    for method in ("fcn4d", "individual_rl", "typical", "paper"):
        for seed in range(TRAININGS[method, 4].seeds):
            line = [row for row in rows if (row["kind"], row.get("seed"), row["R"]) == ("curve", seed, 4)]
            line = [row for row in line if row["method"] == method]
            frames, label = [row["frames"] for row in line], None if seed else LABELS[method]
            upper.plot(frames, [row["mean"] for row in line], color=STYLE[method], label=label, lw=1.5)
            lower.step(frames, [row["height"] for row in line], color=STYLE[method], where="post", lw=1.5)
    upper.set_ylabel("occupancy of the full tote\n6x6x5, R=4, validation")
    lower.set_ylabel("height of the\ntraining's tote")
    lower.set_xlabel("frames")
    lower.xaxis.set_major_formatter(EngFormatter(sep=""))
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    finish(figure, upper, "learning")


def draw_methods(rows: list[dict]) -> None:
    """Draw the methods of reinforcement learning and tree search, as the paper's Fig. 9."""
    figure, (axes,) = panels(width=10)
    draw_bars(axes, rows, ("mcts", "typical", "fcn4d_noclip", "fcn4d", "joint_dbl"), SMALL + LARGE, 1, 4)
    axes.set_ylabel("occupancy, R=4, K=1")
    finish(figure, axes, "methods")


def main() -> None:
    trainings = [(*key, seed) for key, training in TRAININGS.items() for seed in range(training.seeds)]
    names = {"{}-R{}-{}".format(*key): key for key in trainings}
    if unknown := [name for name in sys.argv[1:] if name not in names]:
        sys.exit(f"{unknown[0]}: expected names of {', '.join(names)}")
    named = [names[name] for name in sys.argv[1:]]
    left = [key for key in named or trainings if not (RUNS / "{}-R{}-{}".format(*key) / "report.html").is_file()]
    hours = sum(TRAININGS[key[:2]].hours for key in left)
    sys.stdout.write(f"{len(left)} trainings are left, about {hours:.0f} hours of one core.\n")
    for key in left:
        train(*key)
    if named:
        return
    rows = measure()
    columns = [*dict.fromkeys(key for row in rows for key in row)]
    RESULTS.mkdir(exist_ok=True)
    with (RESULTS / "paper.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: round(v, 5) if isinstance(v, float) else v for key, v in row.items()} for row in rows)
    for draw in (draw_candidates, draw_joint_or_individual, draw_learning, draw_methods):
        draw(rows)


if __name__ == "__main__":
    main()
