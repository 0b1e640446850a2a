"""Write docs/performance.md from the figures in benchmarks/results: python benchmarks/report.py"""

import json
from pathlib import Path

from common import RESULTS

PAGE = Path(__file__).parent.parent / "docs" / "performance.md"
HEAD = """# Performance

Written by `make bench` from `benchmarks/results/`. Times are medians, with the 10th to 90th percentile in brackets.
The peer runs in turn with ours, on an idle machine. "All cores" means `threads=null OMP_WAIT_POLICY=ACTIVE`.
The figures are of `env=paper`, the default when they were measured.
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
        "`experiment=quick` at `6x6x5`, `R=4`, on all cores, from the start of the process. Every 50,000 "
        "frames 128 episodes are played for validation. All seeds but the first stop at the last mark.",
        table(f"seed | {' | '.join(f'until {mark}' for mark in marks)} | last occupancy | after", rows),
    )


def training(result: dict) -> str:
    rows = [
        (f"`{preset}`", f"{row['frames per second']:,.0f}", *(f"{share:.0%}" for share in row["share"].values()))
        for preset, row in result["trainings"].items()
    ]
    parts = " | ".join(next(iter(result["trainings"].values()))["share"])
    return section(
        "Parts of the training time",
        "Frames/s of the median batch, on all cores, and the share of each part. `paper` and `paper_fast` train the "
        "same network without a mask.",
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
        f"Time of a batch, collected and learned from; {result['repeats']} trainings of {result['frames']:,} frames "
        "each, on all cores.",
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
        "`step_and_maybe_reset` with the mask over all 3,600 actions, at the paper's sizes. The peer, "
        f"{result['peer'] or 'not installed'}, plays `BinPack-v2`, a different task.",
        table("batch | ms | steps/s | peer, ms | peer, steps/s | ratio", rows),
    )


def decision(result: dict) -> str:
    totes = [name for name in next(iter(result["rows"].values())) if name != "growth"]
    rows = (
        (name, *(time(row[tote]) for tote in totes), f"{row['growth']:.1f}") for name, row in result["rows"].items()
    )
    return section(
        "One decision",
        "Milliseconds, batch 1, `R=4`, feasibility and candidates included. *Growth*: from the first to the last tote, "
        f"whose area grows {result['area grows by']:.0f} times.",
        table(f"policy | {' | '.join(totes)} | growth", rows),
    )


def answers(result: dict) -> str:
    keys = ("median ms", "95% ms", "greatest ms")
    seen = " / ".join(f"{result['images'][key]:.0f}" for key in keys)
    rows = (
        (f"`{name}`", *(f"{figures[key]:.0f}" for figures in row.values() for key in keys))
        for name, row in result["rows"].items()
    )
    return section(
        "One answer to a robot",
        "`Planner.plan` with ten alternatives, in cells and in metres, until the tote is full: all answers of `ok`, "
        "`stuck` and `impossible`, and refused scenes. `K=1`: with `candidates=1`; many answers are `rejected`. "
        "Milliseconds. Two images of 640 x 480 pixels become a scene before that, or are refused, in "
        f"{seen} (median, 95%, slowest).",
        table("checkpoint | median | 95% | slowest | K=1, median | K=1, 95% | K=1, slowest", rows),
    )


def startup(result: dict) -> str:
    rows = ((f"`{name}`", time(figures)) for name, figures in result["rows"].items())
    return section("Start-up", table("command | ms", rows))


def main() -> None:
    sections: list[str] = []
    machines: dict[str, list[str]] = {}
    for write in (learning, training, workers, environment, decision, answers, startup):
        path = RESULTS / f"{write.__name__}.json"
        if path.is_file():
            result = json.loads(path.read_text())
            sections.append(write(result))
            title = sections[-1].partition("\n")[0].removeprefix("## ")
            machines.setdefault(machine(result), []).append(title)
    measured = [f"* {name}: {'; '.join(titles)}." for name, titles in machines.items()]
    profiles = (Path(__file__).parent / "profiles.md").read_text()
    PAGE.write_text("\n".join([HEAD, *measured, "", *sections, profiles]))


if __name__ == "__main__":
    main()
