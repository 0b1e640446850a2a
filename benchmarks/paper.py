"""Make the paper's comparison: python benchmarks/paper.py

Trains with three seeds and plays the test stream. docs/results/paper keeps what was measured: the occupancy of each
episode (episodes.csv) and the learning curves (curves.csv). A table of means (summary.csv), the figures and the table
of docs/results.md are made from them; ``python benchmarks/paper.py figures`` makes only these, of what is measured.
What these files have is not measured again. To measure everything again, remove docs/results/paper/*.csv and
outputs/paper, which has the run folders: stopped trainings there go on, and finished ones are not repeated.
``python benchmarks/paper.py fcn4d-R4-0`` trains and plays only this, so that several processes can share the work.
"""

import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import ROOT, append_rows, evaluate, read_rows, run, write_tables
from matplotlib.ticker import EngFormatter
from scipy.stats import t

from pickplace.runs.loggers import read_csv
from pickplace.views.figures import COLOURS, figure_of

RESULTS, RUNS = ROOT / "docs" / "results" / "paper", ROOT / "outputs" / "paper"
EPISODES_FILE, CURVES_FILE, PAGE = RESULTS / "episodes.csv", RESULTS / "curves.csv", ROOT / "docs" / "results.md"
SMALL, LARGE = ("6x6x5", "6x6x10", "10x10x5", "10x10x10"), ("30x30x5", "30x30x10")
CANDIDATES = (1, 2, 3, 5, 10, 20, 50)
QUICK_EPISODES, EPISODES, SLOW_EPISODES = 500, 100, 10  # where a tote takes a moment, seconds, or minutes
LARGE_SEED = 1  # only this training seed plays the large totes


class Training(NamedTuple):
    """A method that is trained."""

    words: str  # for pickplace-train
    hours: float  # of one core, for each seed
    totes: tuple[str, ...] = SMALL  # it plays
    seeds: int = 3


#: The paper's network needs this long. The other methods get the same.
RECIPE = "experiment=paper_fast"
ONE_ROTATION = "env.rotations=1 total_frames=800_000"  # there are a quarter of the actions to learn
#: By method and R.
TRAININGS = {
    ("fcn4d", 4): Training(RECIPE, 2.0, SMALL + LARGE),
    ("fcn4d", 3): Training(f"{RECIPE} env.rotations=3", 2.0),
    ("fcn4d", 1): Training(f"{RECIPE} {ONE_ROTATION}", 2.0, seeds=1),
    ("individual_rl", 4): Training(f"{RECIPE} model=individual_rl", 1.0),
    ("individual_rl", 3): Training(f"{RECIPE} model=individual_rl env.rotations=3", 1.0),
    ("individual_rl", 1): Training(f"{RECIPE} model=individual_rl {ONE_ROTATION}", 1.0, seeds=1),
    ("fcn4d_noclip", 4): Training(f"{RECIPE} model=fcn4d_noclip env.tote_size=[6,6,10]", 2.0, ("6x6x10",)),
    ("typical", 4): Training(f"{RECIPE} model=typical", 6.0, ("6x6x5",), 1),
    ("paper", 4): Training("experiment=paper total_frames=72_000", 2.0, ("6x6x5",), 1),
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
            return SLOW_EPISODES
        return QUICK_EPISODES if self.tote == "6x6x5" else EPISODES


class Run(NamedTuple):
    """A training with one seed."""

    method: str
    R: int
    seed: int

    @property
    def name(self) -> str:
        return f"{self.method}-R{self.R}-{self.seed}"

    @property
    def folder(self) -> Path:
        return RUNS / self.name

    def cells(self) -> Iterator[Cell]:
        """Yield what its policy plays."""
        for tote in TRAININGS[self.method, self.R].totes:
            if tote in LARGE:
                every = (1,) if self.seed == LARGE_SEED else ()
            else:
                every = CANDIDATES if tote == "6x6x5" else (1, 10)
            yield from (Cell(self.method, self.R, tote, k, self.seed) for k in every)


def heuristic_cells() -> Iterator[Cell]:
    """Yield what the methods that are not trained play."""
    for method, turns, tote in product(("joint_dbl", "individual_heuristic"), (1, 3, 4), SMALL + LARGE):
        if turns == 4 or tote not in LARGE:
            yield Cell(method, turns, tote)
    yield from (Cell("mcts", 4, tote) for tote in SMALL[:3])


def read_episodes() -> dict[Cell, list[float]]:
    """Return the occupancy of each episode, by cell, of all that was played."""
    episodes = {}
    for row in read_rows(EPISODES_FILE):
        candidates, seed = (int(row[key]) if row[key] else None for key in ("K", "seed"))
        cell = Cell(row["method"], int(row["R"]), row["tote"], candidates, seed)
        episodes[cell] = [float(x) for x in row["occupancies"].split()]
    return episodes


def train(one: Run) -> None:
    """Train, or go on with a training, unless it is finished."""
    if not (one.folder / "report.html").is_file():
        words = TRAININGS[one.method, one.R].words.split()
        new = [*words, f"seed={one.seed}", f"hydra.run.dir={one.folder}"]
        stopped = (one.folder / "checkpoints" / "last").is_dir()
        run("pickplace-train", *([f"resume={one.folder}"] if stopped else new), "threads=1")


def unplayed(cells: Iterable[Cell]) -> list[Cell]:
    """Return the cells that have not been played yet."""
    known = read_episodes()
    return [cell for cell in cells if cell not in known]


def play(cells: Iterable[Cell]) -> None:
    """Play the test stream in each cell, unless it was played."""
    for cell in unplayed(cells):
        words = [f"env.tote_size=[{cell.tote.replace('x', ',')}]", f"evaluation.episodes={cell.episodes}"]
        words += ["evaluation.batch_size=50", "evaluation.latency_decisions=0"]
        if cell.seed is None:
            words += ["env=paper", f"env.rotations={cell.R}", f"planner={cell.method}"]
        else:
            words += [f"checkpoint={Run(cell.method, cell.R, cell.seed).folder}", f"planner.candidates={cell.K}"]
        folder = RUNS / "played" / "-".join(str(part) for part in cell if part is not None)
        episodes = evaluate(folder, *words)["occupancy"]["per_episode"]
        append_rows(EPISODES_FILE, [{**cell._asdict(), "occupancies": " ".join(f"{x:.4g}" for x in episodes)}])


def has_curve(one: Run) -> bool:
    """Return whether the learning curve of a training is kept."""
    return any(one == (row["method"], int(row["R"]), int(row["seed"])) for row in read_rows(CURVES_FILE))


def curve(one: Run) -> list[dict]:
    """Return the validations of a finished training."""
    return [
        {**one._asdict(), "frames": int(row["frames"]), "height": int(row["curriculum/level"]), "occupancy": value}
        for row in read_csv(one.folder / "metrics.csv")
        if (value := row.get("eval/occupancy")) is not None
    ]


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


def summaries() -> list[dict]:
    """Return a row for each cell, of all training seeds, and one for its difference to each other method."""
    seeds: dict[Cell, dict[int | None, list[float]]] = defaultdict(dict)  # the occupancies of each training seed
    for cell, episodes in sorted(read_episodes().items(), key=str):
        seeds[cell._replace(seed=None)][cell.seed] = episodes
    rows = []
    for cell, by_seed in seeds.items():
        setting = {"method": cell.method, "R": cell.R, "tote": cell.tote, "K": cell.K}
        means = summary([*by_seed.values()])
        rows.append({**setting, "versus": None, **means, "high": min(means["high"], 1.0)})
        for other, theirs in seeds.items():
            is_pair = other.method != cell.method == "fcn4d" and other[1:3] == cell[1:3]
            if is_pair and other.K in (None, cell.K) and (pairs := paired(by_seed, theirs)):
                rows.append({**setting, "versus": other.method, **summary(pairs)})
    return rows


def paired(seeds: dict, others: dict) -> list[list[float]]:
    """Return the differences of two methods in the same episodes, for each training seed that both have. A method with
    a single seed, or without training, is paired with all."""
    only = next(iter(others.values())) if len(others) == 1 else None
    pairs = [(mine, others.get(seed, only)) for seed, mine in seeds.items()]
    return [[a - b for a, b in zip(*pair, strict=False)] for pair in pairs if pair[1] is not None]


def found(rows: list[dict], **wanted) -> dict | None:
    """Return the row with these values that is not a difference; None without one."""
    return next((row for row in rows if not row["versus"] and all(row[key] == v for key, v in wanted.items())), None)


def trained_rotations(rows: list[dict]) -> list[int]:
    """Return the values of R for which the proposed network is measured."""
    return sorted({row["R"] for row in rows if row["method"] == "fcn4d"})


def panels(count: int = 1, width: float = 8, height: float = 4.2, **shared):
    """Return a figure, and its axes in a plain style."""
    figure = figure_of(width, height)
    every = figure.subplots(1, count, squeeze=False, sharey=True, **shared)[0]
    for axes in every:
        axes.grid(axis="y", alpha=0.3)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, every


def finish(figure, every, name: str) -> None:
    """Write a figure, with one legend of all its axes below it."""
    labels = {label: line for axes in every for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(labels.values(), labels, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(RESULTS / f"{name}.png", dpi=120)


def draw_bars(axes, rows: list[dict], methods: tuple[str, ...], totes: tuple[str, ...], k: int, turns: int) -> None:
    """Draw a group of bars for each tote, one for each method that is measured, with its interval."""
    bars = defaultdict(list)  # of each method: places of totes and rows
    for method, (place, tote) in product(methods, enumerate(totes)):
        trained = (method, turns) in TRAININGS
        if row := found(rows, method=method, R=turns, tote=tote, K=k if trained else None):
            bars[method].append((place, row))
    width = 0.8 / max(len(bars), 1)
    for order, (method, line) in enumerate(bars.items()):
        xs, means = [place + (order - (len(bars) - 1) / 2) * width for place, _ in line], [r["mean"] for _, r in line]
        errors = [[row["mean"] - row["low"] for _, row in line], [row["high"] - row["mean"] for _, row in line]]
        style = {"color": STYLE[method], "ecolor": "#37474f", "error_kw": {"elinewidth": 1}, "capsize": 2}
        drawn = axes.bar(xs, means, width * 0.92, yerr=errors, label=LABELS[method], **style)
        texts = [f"{int(mean * 100) / 100:.2f}" for mean in means]  # never rounded up to a full tote
        axes.bar_label(drawn, texts, fontsize=7, padding=2)
    axes.set_xticks(range(len(totes)), totes)
    axes.set(xlim=(-0.5, len(totes) - 0.5), ylim=(0, 1.1), xlabel="tote")


def draw_candidates(trained: list[int]) -> None:
    """Draw the occupancy over K, a line for each training seed, as the paper's Fig. 6."""
    lines: dict[Cell, dict[int, float]] = defaultdict(dict)  # mean by K
    for cell, episodes in read_episodes().items():
        if cell.tote == "6x6x5" and cell.K:
            lines[cell._replace(K=None)][cell.K] = float(np.mean(episodes))
    figure, every = panels(len(trained), 6 + 2 * len(trained))
    for axes, turns in zip(every, trained, strict=True):
        for method in ("fcn4d", "individual_rl"):
            for line in [line for cell, line in lines.items() if (cell.method, cell.R) == (method, turns)]:
                style = {"color": STYLE[method], "label": LABELS[method], "marker": "o", "lw": 1.5}
                axes.plot(sorted(line), [line[k] for k in sorted(line)], **style)
        axes.set_title(f"R={turns}, 6x6x5", fontsize=10)
        axes.set_xscale("log")
        axes.set_xticks(CANDIDATES, CANDIDATES)
        axes.minorticks_off()
        axes.set_xlabel("K, most probable actions that are tried")
    every[0].set_ylabel("occupancy")
    finish(figure, every, "candidates")


def draw_joint_or_individual(rows: list[dict]) -> None:
    """Draw joint beside individual planning, as the paper's Fig. 7."""
    figure, every = panels(len(trained := trained_rotations(rows)), 4 + 4 * len(trained))
    for axes, turns in zip(every, trained, strict=True):
        draw_bars(axes, rows, ("individual_heuristic", "individual_rl", "fcn4d", "joint_dbl"), SMALL, 10, turns)
        axes.set_title(f"R={turns}, K=10", fontsize=10)
    every[0].set_ylabel("occupancy")
    finish(figure, every, "joint_or_individual")


def draw_learning() -> None:
    """Draw validations over frames, and the height of the tote in training, as the paper's Fig. 8."""
    lines = defaultdict(list)  # validations of each training
    for row in read_rows(CURVES_FILE):
        if row["R"] == "4" and row["method"] != "fcn4d_noclip":  # which has another tote
            lines[row["method"], row["seed"]].append(row)
    figure, labels = figure_of(8, 5.5), dict(LABELS)
    upper, lower = figure.subplots(2, sharex=True, height_ratios=[2.5, 1])
    for (method, _), line in lines.items():
        frames, style = [int(row["frames"]) for row in line], {"color": STYLE[method], "lw": 1.5}
        upper.plot(frames, [float(row["occupancy"]) for row in line], label=labels.pop(method, None), **style)
        lower.step(frames, [int(row["height"]) for row in line], where="post", **style)
    upper.set_ylabel("occupancy of the full tote\n6x6x5, R=4, validation")
    lower.set_ylabel("height of the\ntraining's tote")
    lower.set_xlabel("frames")
    lower.xaxis.set_major_formatter(EngFormatter(sep=""))
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    finish(figure, [upper], "learning")


def draw_methods(rows: list[dict]) -> None:
    """Draw the methods of reinforcement learning and tree search, as the paper's Fig. 9."""
    figure, (axes,) = panels(width=10)
    totes = tuple(tote for tote in SMALL + LARGE if found(rows, method="fcn4d", R=4, tote=tote))
    draw_bars(axes, rows, ("mcts", "typical", "fcn4d_noclip", "fcn4d", "joint_dbl"), totes, 1, 4)
    axes.set_ylabel("occupancy, R=4, K=1")
    finish(figure, [axes], "methods")


def occupancy_table(rows: list[dict]) -> list[str]:
    """Return the lines of the page's table: methods with R=4 in each tote, but for the paper's settings."""
    totes = SMALL + LARGE
    lines = ["| method | " + " | ".join(totes) + " |", "|---" * (len(totes) + 1) + "|"]
    for method, k in product([method for method in LABELS if method != "paper"], (10, 1, None)):
        of_totes = [found(rows, method=method, R=4, tote=tote, K=k) for tote in totes]
        cells = [row and f"{row['mean']:.4f} ±{row['mean'] - row['low']:.4f}" for row in of_totes]
        if any(cells):
            name = LABELS[method] + (f", K={k}" if k else "")
            lines.append(f"| {name} | {' | '.join(cell or '' for cell in cells)} |")
    return lines


def draw_all() -> None:
    """Write the table of means, the figures and the page's table, of what is measured."""
    rows = summaries()
    if not trained_rotations(rows):
        sys.exit("nothing to draw: no training of fcn4d has been played yet.")
    (RESULTS / "summary.csv").unlink(missing_ok=True)
    append_rows(RESULTS / "summary.csv", rows)
    draw_learning()
    draw_candidates(trained_rotations(rows))
    draw_joint_or_individual(rows)
    draw_methods(rows)
    write_tables(PAGE, {"occupancy": occupancy_table(rows)})


def main() -> None:
    if sys.argv[1:] == ["figures"]:
        draw_all()
        return
    every = [Run(*key, seed) for key, training in TRAININGS.items() for seed in range(training.seeds)]
    names = {each.name: each for each in every}
    if unknown := [name for name in sys.argv[1:] if name not in names]:
        sys.exit(f"{unknown[0]}: expected names of {', '.join(names)}")
    named = [names[name] for name in sys.argv[1:]]
    left = [each for each in named or every if not has_curve(each) or unplayed(each.cells())]
    hours = sum(TRAININGS[each.method, each.R].hours for each in left)
    sys.stdout.write(f"{len(left)} trainings are not finished or not played: at most {hours:.0f} hours of one core.\n")
    for each in left:
        train(each)
        if not has_curve(each):
            append_rows(CURVES_FILE, curve(each))
        play(each.cells())
    if named:
        return
    play(heuristic_cells())
    draw_all()


if __name__ == "__main__":
    main()
