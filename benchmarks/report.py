"""Writes docs/performance.md from the figures in benchmarks/results: python benchmarks/report.py"""

import json
from pathlib import Path

from common import RESULTS

HEAD = """# Performance

Made by `make bench` from the JSON in `benchmarks/results/`; each figure is a median, with the 10th and 90th percentile
in brackets. Peers run in the same process, turn by turn with ours. One core, one thread.
"""


def machine(result: dict) -> str:
    m = result["machine"]
    return f"*{m['cpu']}, torch {m['torch']}, Python {m['python']}, {m['threads']} thread.*\n"


def time(figures: dict) -> str:
    return f"{figures['ms']:.1f} ms ({figures['low']:.1f} to {figures['high']:.1f})"


def environment(result: dict) -> str:
    lines = [
        "## Environment, the full joint mask included\n",
        f"Paper's sizes, 3,600 actions, `step_and_maybe_reset`, random feasible actions; {result['steps']} steps each. "
        f"Peer: {result['peer'] or 'not installed'}, `BinPack-v2`, another task (see `benchmarks/environment.py`).\n",
        "| batch | a step | steps/s | peer, a step | peer, steps/s | ratio |",
        "|---|---|---|---|---|---|",
    ]
    for batch, row in result["batches"].items():
        ours, peer = row["pickplace"], row.get("jumanji")
        cells = [batch, time(ours), f"{ours['steps_per_second']:,}"]
        cells += [time(peer), f"{peer['steps_per_second']:,}", f"{row['ratio']:.1f}"] if peer else ["", "", ""]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", machine(result)])


def conv4d(result: dict) -> str:
    lines = [
        "## `fcn4d` against a naive 4D convolution\n",
        "64 filters. *Masked* computes the logits of the pick cells that allow something, and no others.\n",
        "| case | what | variant | time | ratio |",
        "|---|---|---|---|---|",
    ]
    for title, row in result["cases"].items():
        for what in ("forward", "forward and backward"):
            for name, figures in row[what].items():
                lines.append(f"| {title} | {what} | {name} | {time(figures)} | {figures['ratio']:.1f} |")
    lines.append("")
    for title, row in result["cases"].items():
        held = row["peak MiB, forward"]
        lines.append(
            f"Peak memory of a forward pass over all actions, {title}: naive {held['naive']} MiB, "
            f"ours {held['ours']} MiB; {row['pick cells that allow something']} pick cells allow something (mean).\n"
        )
    return "\n".join([*lines, machine(result)])


def main() -> None:
    parts = [HEAD]
    for write in (environment, conv4d):
        path = RESULTS / f"{write.__name__}.json"
        if path.is_file():
            parts.append(write(json.loads(path.read_text())))
    target = Path(__file__).parent.parent / "docs" / "performance.md"
    target.write_text("\n".join(parts))


if __name__ == "__main__":
    main()
