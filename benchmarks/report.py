"""Writes docs/performance.md from the figures in benchmarks/results: python benchmarks/report.py"""

import json
from pathlib import Path

from common import RESULTS

HEAD = """# Performance

Made by `make bench` from the JSON in `benchmarks/results/`; each figure is a median, with the 10th and 90th percentile
in brackets. Peers run turn by turn with ours. One core and one thread unless it says otherwise; a
machine that does nothing else.
"""


def machine(result: dict) -> str:
    m = result["machine"]
    return f"*{m['cpu']}, torch {m['torch']}, Python {m['python']}, {m['threads']} thread{'s' * (m['threads'] > 1)}.*\n"


def time(figures: dict) -> str:
    return f"{figures['ms']:.1f} ms ({figures['low']:.1f} to {figures['high']:.1f})"


def table(head: str, rows) -> list[str]:
    """Lines of a table: the head's columns, split by ``|``, and the cells of each row."""
    columns = [column.strip() for column in head.split("|")]
    lines = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    return [*lines, *(f"| {' | '.join(map(str, row))} |" for row in rows), ""]


def environment(result: dict) -> str:
    rows = []
    for batch, row in result["batches"].items():
        ours, peer = row["pickplace"], row.get("jumanji")
        cells = [batch, time(ours), f"{ours['steps_per_second']:,}"]
        rows.append(
            cells + ([time(peer), f"{peer['steps_per_second']:,}", f"{row['ratio']:.1f}"] if peer else ["", "", ""])
        )
    lines = [
        "## Environment, the full joint mask included\n",
        f"Paper's sizes, 3,600 actions, `step_and_maybe_reset`, random feasible actions; {result['steps']} steps each. "
        f"Peer: {result['peer'] or 'not installed'}, `BinPack-v2`, another task (see `benchmarks/environment.py`).\n",
        *table("batch | a step | steps/s | peer, a step | peer, steps/s | ratio", rows),
    ]
    return "\n".join([*lines, machine(result)])


def collector(result: dict) -> str:
    rows = (
        (name, time(row["raw loop"]), time(row["collector"]), f"{row['added ms']:.2f} ms")
        for name, row in result["rows"].items()
    )
    lines = [
        "## What the collector adds\n",
        "A vector step with a random choice among feasible actions: a raw loop over `step_and_maybe_reset`, and the"
        " `Collector`, which also keeps all frames and masks for the learner. `fcn_grasp` trains on outcome masks (72"
        " entries), `fcn4d` with a mask on action masks (3,600 entries).\n",
        *table("batch, mask | raw loop | collector | added", rows),
    ]
    return "\n".join([*lines, machine(result)])


def startup(result: dict) -> str:
    rows = ((f"`{name}`", time(figures)) for name, figures in result["rows"].items())
    return "\n".join(["## Starting up\n", *table("what | time, from the start of the process", rows), machine(result)])


def conv4d(result: dict) -> str:
    times, peaks = [], []
    for title, row in result["cases"].items():
        for what in ("forward", "forward and backward"):
            for name, figures in row[what].items():
                share = figures.get("share of matrix product")
                share = "" if share is None else f"{share:.0%}"
                times.append((title, what, name, time(figures), f"{figures['ratio']:.1f}", share))
        peaks += [(title, name, held) for name, held in row["peak MiB, forward"].items()]
    lines = [
        "## `fcn4d` against a naive 4D convolution\n",
        "64 filters. *Masked* computes the logits of the pick cells that allow something, and no others. *Of peak*: "
        "arithmetic operations a second, as a share of those of a 2048 x 2048 matrix product of the same type in the "
        "same run.\n",
        *table("case | what | variant | time | ratio | of peak", times),
        "Peak memory of a forward pass, beyond inputs and weights:\n",
        *table("case | variant | MiB", peaks),
    ]
    for title, row in result["cases"].items():
        speed = ", ".join(
            f"{dtype} {row[f'GFLOPS of a matrix product, {dtype}']:,.0f}" for dtype in ("float32", "bfloat16")
        )
        lines.append(
            f"{title}: {row['pick cells that allow something']} of the pick cells allow something (mean); "
            f"GFLOPS of the matrix product: {speed}.\n"
        )
    return "\n".join([*lines, machine(result)])


def decision(result: dict) -> str:
    totes = [name for name in next(iter(result["rows"].values())) if name != "growth"]
    rows = (
        (name, *(time(row[tote]) for tote in totes), f"{row['growth']:.1f}") for name, row in result["rows"].items()
    )
    lines = [
        "## One decision\n",
        "Batch 1, `R=4`, feasibility and candidates included. The last column says how the time grows from the first "
        f"to the last tote, whose area grows by {result['area grows by']:.0f}.\n",
        *table(f"policy | {' | '.join(totes)} | grows by", rows),
    ]
    return "\n".join([*lines, machine(result)])


def learning(result: dict) -> str:
    rows, medians = [], []
    runs = [(f"pickplace, seed {run['seed']}", run) for run in result["ours"]]
    if result["peer"]:
        runs.append((result["peer"]["name"], result["peer"]))
    for name, run in runs:
        cells = [f"{value:.0f} s" if value else "never" for value in run["reached"].values()]
        seconds, frames, occupancy = run["curve"][-1]
        cells.append(f"{occupancy:.3f} after {seconds:.0f} s, {frames:,} frames")
        rows.append([name, *cells])
    for mark in ("0.95", "0.975"):
        values = sorted(run["reached"][mark] or float("inf") for run in result["ours"])
        medians.append(f"{values[len(values) // 2]:.0f} s until {mark}")
    lines = [
        "## Wall-clock until the tote is packed well\n",
        "`experiment=quick`, all cores, one run after the other, from the start of the process; validated every 50,000 "
        "frames on 128 episodes at `6x6x5`, `R=4`. See `benchmarks/learning.py` for the peer's settings.\n",
        *table("who | until 0.95 | until 0.975 | last validation", rows),
        f"Median of our seeds: {', '.join(medians)}.",
        "",
    ]
    return "\n".join([*lines, machine(result)])


def training(result: dict) -> str:
    speed, parts = result["frames per second"], result["share"]
    share = ", ".join(f"{part} {value:.0%}" for part, value in parts.items())
    return (
        "## Where training time goes\n\n"
        f"`experiment=quick`, {result['frames']:,} frames: {speed['median']:,.0f} frames/s in the median batch. "
        f"{share}.\n\n" + machine(result)
    )


def workers(result: dict) -> str:
    rows = [
        (case, name, time(figures), f"{row['single']['ms'] / figures['ms']:.2f}")
        for case, row in result["rows"].items()
        for name, figures in row.items()
    ]
    lines = [
        "## Collecting in worker processes\n",
        f"Batches of {result['repeats']} trainings of {result['frames']:,} frames each, turn by turn, on all cores of "
        "the machine.\n",
        *table("training | `collector=` | a batch, collected and learnt from | speed against `single`", rows),
    ]
    return "\n".join([*lines, machine(result)])


def main() -> None:
    parts = [HEAD]
    for write in (learning, training, workers, environment, collector, conv4d, decision, startup):
        path = RESULTS / f"{write.__name__}.json"
        if path.is_file():
            parts.append(write(json.loads(path.read_text())))
    parts.append((Path(__file__).parent / "profiles.md").read_text())
    target = Path(__file__).parent.parent / "docs" / "performance.md"
    target.write_text("\n".join(parts))


if __name__ == "__main__":
    main()
