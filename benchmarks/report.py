"""Write docs/performance.md from the figures in benchmarks/results: python benchmarks/report.py"""

import json
from pathlib import Path

from common import RESULTS

PAGE = Path(__file__).parent.parent / "docs" / "performance.md"
HEAD = """# Performance

After {seconds:.0f} s of training on two CPU cores (`experiment=quick threads=null`), {good} of {seeds} policies fill
97.5% of the paper's tote. On one core the environment makes {steps:,} steps/s with 256 problems, and a decision takes
{decision:.0f} ms.

`make bench` measures all this on an idle machine, and writes this page from `benchmarks/results/`. Times are medians,
with the 10th to 90th percentile in brackets, with `env=paper`. There are no measurements on a GPU.
"""


def time(figures: dict) -> str:
    return f"{figures['ms']:,.1f} ({figures['low']:,.1f}-{figures['high']:,.1f})"


def table(head: str, rows) -> str:
    """Return a table from column names, split by ``|``, and the cells of each row."""
    columns = [column.strip() for column in head.split("|")]
    lines = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, row))} |" for row in rows)])


def machine(result: dict) -> str:
    """Return a short description of the machine of a measurement."""
    m = result["machine"]
    return f"{m['cpu']}, torch {m['torch']}, {m['threads']} thread{'s' * (m['threads'] > 1)}"


def section(title: str, *paragraphs: str) -> str:
    return "\n\n".join([f"## {title}", *paragraphs]) + "\n"


def learning(result: dict) -> str:
    marks = list(result["ours"][0]["reached"])
    rows = []
    for run in result["ours"]:
        seconds, frames, occupancy = run["curve"][-1]
        cells = [f"{value:.0f} s" if value else "never" for value in run["reached"].values()]
        rows.append([run["seed"], *cells, f"{occupancy:.3f}", f"{seconds:.0f} s, {frames:,} frames"])
    return section(
        "Time until the tote is packed well",
        "`experiment=quick` at `6x6x5`, `R=4`, on all cores, from the start of the process. Every 50,000 frames "
        "a validation plays 128 episodes. Seed 0 trains to the end; the others stop when they reach "
        f"{marks[-1]}. No time before the first validation can be seen.",
        table(f"seed | {' | '.join(f'until {mark}' for mark in marks)} | last occupancy | time and frames then", rows),
    )


def training(result: dict) -> str:
    rows = [
        (f"`{preset}`", f"{row['frames per second']:,.0f}", *(f"{share:.0%}" for share in row["share"].values()))
        for preset, row in result["trainings"].items()
    ]
    parts = " | ".join(next(iter(result["trainings"].values()))["share"])
    return section(
        "Parts of the training time",
        "Frames per second of the median batch, on all cores, and the share of its time that each part takes. "
        "`paper` and `paper_fast` train the same network without a mask.",
        table(f"`experiment=` | frames/s | {parts}", rows),
    )


def workers(result: dict) -> str:
    rows = [
        (case, name, time(figures), f"{row['single']['ms'] / figures['ms']:.2f}")
        for case, row in result["rows"].items()
        for name, figures in row.items()
    ]
    return section(
        "Worker processes",
        f"Time to collect a batch and to learn from it, in {result['repeats']} trainings of {result['frames']:,} "
        "frames.",
        table("training | `collector=` | ms | speed-up", rows),
    )


def environment(result: dict) -> str:
    rows = []
    for batch, row in result["batches"].items():
        ours, peer = row["pickplace"], row.get("jumanji")
        cells = [batch, time(ours), f"{ours['steps_per_second']:,}"]
        cells += [time(peer), f"{peer['steps_per_second']:,}", f"{row['ratio']:.1f}"] if peer else [""] * 3
        rows.append(cells)
    return section(
        "Environment",
        "A call of `step_and_maybe_reset`, which also finds the mask over all 3,600 actions, at the paper's sizes. The "
        f"peer is {result['peer'] or 'not installed'} with `BinPack-v2`, compiled by JAX. Its task differs: the "
        "ratio of the steps/s compares only the cost of a step. Both were measured in turn.",
        table("batch | ms | steps/s | peer, ms | peer, steps/s | ratio", rows),
    )


def decision(result: dict) -> str:
    totes = [name for name in next(iter(result["rows"].values())) if name != "growth"]
    rows = (
        (name, *(time(row[tote]) for tote in totes), f"{row['growth']:.1f}") for name, row in result["rows"].items()
    )
    return section(
        "One decision",
        "Milliseconds for one state, `R=4`: the network, and the mask or the `K` candidates that are tried. *Growth*: "
        f"the time in the last tote divided by that in the first; the area grows {result['area grows by']:.0f} times.",
        table(f"policy | {' | '.join(totes)} | growth", rows),
    )


def answers(result: dict) -> str:
    keys = ("median ms", "95% ms", "greatest ms")
    shipped = sorted(result["rows"].items(), key=lambda row: row[1]["all"]["median ms"])
    asked = [(f"a plan by `{name}`, {what} shipped", row["all"]) for what, (name, row) in zip(
        ("the quickest", "the slowest"), (shipped[0], shipped[-1]), strict=True)]  # fmt: skip
    asked.append(("a scene from two images of 640 x 480 pixels", result["images"]))
    rows = [(what, *(f"{figures[key]:.0f}" for key in keys)) for what, figures in asked]
    return section(
        "One answer to a robot",
        "Milliseconds for a call of `Planner.plan` with ten alternatives, in cells and in metres, from an empty tote "
        "to a full one.",
        table("what | median | 95th percentile | slowest", rows),
    )


def main() -> None:
    results = {path.stem: json.loads(path.read_text()) for path in RESULTS.glob("*.json")}
    sections = []
    for write in (learning, training, workers, environment, decision, answers):
        result = results[write.__name__]
        sections.append(f"{write(result)}\n{machine(result)}.\n")
    batch, seeds = results["environment"]["batches"]["256"], results["learning"]["ours"]
    reached = [run["reached"]["0.975"] for run in seeds if run["reached"]["0.975"]]
    figures = {
        "seconds": max(reached, default=0),
        "good": len(reached),
        "seeds": len(seeds),
        "steps": batch["pickplace"]["steps_per_second"] // 1000 * 1000,
        "decision": next(iter(results["decision"]["rows"].values()))["6x6x5"]["ms"],
    }
    profiles = (Path(__file__).parent / "profiles.md").read_text()
    PAGE.write_text("\n".join([HEAD.format(**figures), *sections, profiles]))


if __name__ == "__main__":
    main()
