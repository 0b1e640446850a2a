"""Write docs/performance.md from the figures in benchmarks/results: python benchmarks/report.py"""

import json
from pathlib import Path

from common import RESULTS

PAGE = Path(__file__).parent.parent / "docs" / "performance.md"
HEAD = """# Performance

- **Training.** {good} of {seeds} trainings reach an occupancy of 0.975 in at most {seconds:.0f} s, on two CPU cores
  (`experiment=quick threads=null`).
- **Environment.** 256 parallel environments make {steps:,} steps/s on one core.
- **Decision.** `fcn_grasp` decides in {decision:.0f} ms on one core.

`make bench` measures the tables on an idle machine, and writes this page. All but the answers to a robot were
measured with the stability rule of `env=paper`. Times are medians, with the 10th to 90th percentile in brackets.{gpu}
"""
NO_GPU = " Nothing was measured on a GPU. `python benchmarks/gpu.py` measures one, and adds a section."


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
        "`experiment=quick` at 6x6x5, R=4, on all cores. Times count from the start of the process. "
        "Validations (128 episodes) come every 50,000 frames: the first is the earliest possible time. Seed 0 "
        f"trains to the end; the others stop at {marks[-1]}.",
        table(f"seed | {' | '.join(f'until {mark}' for mark in marks)} | occupancy at the end | end", rows),
    )


def training(result: dict) -> str:
    rows = [
        (f"`{preset}`", f"{row['frames per second']:,.0f}", *(f"{share:.0%}" for share in row["share"].values()))
        for preset, row in result["trainings"].items()
    ]
    parts = " | ".join(next(iter(result["trainings"].values()))["share"])
    return section(
        "Parts of the training time",
        "Frames/s of the median batch, and each part's share of the whole training; on all cores.",
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
        f"Time to collect and learn from one batch, in {result['repeats']} trainings of {result['frames']:,} frames.",
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
        "A call of `step_and_maybe_reset` at the paper's sizes, with the mask over all 3,600 actions. The peer is "
        f"{result['peer'] or 'not installed'} with `BinPack-v2`, compiled by JAX. It has another task: the ratio "
        "compares only the cost of a step.",
        table("batch | ms | steps/s | peer, ms | peer, steps/s | ratio", rows),
    )


def decision(result: dict) -> str:
    totes = [name for name in next(iter(result["rows"].values())) if name != "growth"]
    rows = (
        (name, *(time(row[tote]) for tote in totes), f"{row['growth']:.1f}") for name, row in result["rows"].items()
    )
    return section(
        "One decision",
        "Milliseconds for one state, R=4: the network, then the mask (K=all) or the trial of K candidates. *Growth*: "
        f"the time at 30x30x10 divided by the time at 6x6x5; the area grows {result['area grows by']:.0f} times.",
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
        "Milliseconds for a call of `Planner.plan` with ten alternatives, over totes from empty to full, in cells and "
        "in metres.",
        table("what | median | 95th percentile | slowest", rows),
    )


def gpu(result: dict) -> str:
    """Return the section of benchmarks/gpu.py: the environment, the trainings, and the time to a good policy."""

    def steps(row: dict) -> list[str]:
        return [f"{row['ms']:,.1f}", f"{row['steps/s']:,.0f}"]

    environment = []
    for problems, row in result["environment"].items():
        share = f"{row['recorded']['device ms'] / row['recorded']['ms']:.0%}"
        peer = steps(row["jumanji"]) if "jumanji" in row else ["", ""]
        environment.append([problems, *steps(row["plain"]), *steps(row["recorded"]), share, *peer])
    trainings = [
        [
            f"`{name}`, {key}",
            *(f"{row[part]:,.0f}" for part in ("collect ms", "learn ms", "frames/s")),
            f"{row['busy']:.0%}",
        ]
        for name, both in result["trainings"].items()
        for key, row in both.items()
    ]
    reached, paper = result["seconds until the mark"], result["trainings"]["paper_gpu"]["recorded"]["frames/s"]
    words = f"after {reached:.0f} s, from the start of the process" if reached else "not at all"
    return section(
        "A GPU",
        f"On {result['device']}. *Recorded* is `compile=cudagraphs`; *busy* is the share of the time in which the "
        f"device works. `experiment=quick_gpu` reaches {result['mark']} {words}. The 25 million frames of "
        f"`experiment=paper_gpu` take {25e6 / paper / 60:.0f} minutes, without validations.",
        table("batch | plain, ms | steps/s | recorded, ms | steps/s | busy | Jumanji, ms | steps/s", environment),
        table("`experiment=` | collect a batch, ms | learn, ms | frames/s | busy", trainings),
    )


def main() -> None:
    results = {path.stem: json.loads(path.read_text()) for path in RESULTS.glob("*.json")}
    sections = []
    written = (learning, training, workers, environment, decision, answers)
    for write in (*written, *([gpu] if "gpu" in results else [])):
        result = results[write.__name__]
        sections.append(f"{write(result)}\n{machine(result)}.\n")
    batch, seeds = results["environment"]["batches"]["256"], results["learning"]["ours"]
    reached = [run["reached"]["0.975"] for run in seeds if run["reached"]["0.975"]]
    figures = {
        "seconds": max(reached, default=0),
        "good": len(reached),
        "seeds": len(seeds),
        "steps": round(batch["pickplace"]["steps_per_second"], -3),
        "gpu": "" if "gpu" in results else NO_GPU,
        "decision": results["decision"]["rows"]["fcn_grasp, K=all"]["6x6x5"]["ms"],
    }
    PAGE.write_text("\n".join([HEAD.format(**figures), *sections]))


if __name__ == "__main__":
    main()
