"""Draws the figures of the comparison and writes docs/results.md from the JSON in docs/results/: make results."""

import json
import re
import sys
from collections import Counter
from pathlib import Path

import cells as definitions
import claims
import figures
import torch
from run import RESULTS, one_line_a_list

from pickplace.evaluation.evaluate import confidence95

ROOT = RESULTS.parents[1]
HEAD = """# The paper's comparison, run again

Made by `make results` from the JSON in [`results/`](results), which `make reproduce` computes cell by cell; each JSON
holds the command of its cell. All methods meet the same episodes of the test stream, seed 0. Brackets are 95%
confidence intervals of the mean over episodes; ° marks fewer than {few} episodes: indicative. *Budget* is what the
method was trained with: frames, and minutes of one core; a cell has an hour, seeds 1 and 2 of fcn4d with R=4 six
minutes more, and less where its definition says so. s0, s1 and s2 are training seeds; what has one of them alone was
trained once. *No better than random* marks a policy that is not surely above random feasible choices on the same
episodes, which know the mask; a policy that was trained with a mask does not without one. *Attempted* cells could not
be done within their budget, or within 20 GiB, and tell how far off they were. The time of a decision is a mean of CPU
time, of one tote in one thread, over 20 or more; older cells have the median, and the oldest by the clock, on a
machine that did other work beside. Processors differ, and so do times, what a budget of minutes is worth, and what a
seed comes to ([how much](experiments.md#the-same-seeds-on-another-processor)). Computed on: {processors}

In the figures a point is the mean over episodes, and over seeds where there are several. Bars are 95% confidence
intervals over episodes, widened to the range of the seeds; they have no width where all episodes are alike. Hollow:
fewer than {few} episodes. Pale: the training was cut short before half of its frames. An "a": attempted.

{done} of {total} cells are done.
"""


def load() -> dict[str, dict]:
    """Every result that there is, by the name of its cell."""
    paths = [*(RESULTS / "cells").glob("*.json"), *(RESULTS / "trainings").glob("*.json")]
    results = {path.stem: json.loads(path.read_text()) for path in sorted(paths)}
    for result in results.values():
        if "occupancy" in result:  # older cells' intervals go beyond what an occupancy can be
            low, high = result["occupancy"]["ci95"]
            result["occupancy"]["ci95"] = [max(low, 0.0), min(high, 1.0)]
    return results


def processors(results) -> str:
    """A sentence on what the cells were computed on."""
    count = Counter(result.get("processor", "") for result in results.values())
    unknown = count.pop("", 0)
    words = [f"{name}, {number} cells" for name, number in sorted(count.items())]
    return "; ".join([*words, *[f"not noted, {unknown} cells"] * bool(unknown)]) + "."


def table(cells, results) -> list[str]:
    """One row for each cell, done or not."""
    lines = ["| method | cell | occupancy | episodes | a decision | budget |", "|---|---|---|---|---|---|"]
    for cell in cells:
        labels = " ".join(definitions.AXES[axis][0].format(value) for axis, value in cell.axes)
        labels = f"{figures.trained_for(cell.method)[1].removesuffix('small')} {labels}".strip()
        result = results.get(cell.name)
        masked = cell.method.startswith("mcts") and "planner.mask=true" in cell.overrides
        method = figures.label("mcts_outcomes" if masked else cell.method)
        lines.append(
            f"| {method} | {labels} | {occupancy(result)} | {episodes(result)} | "
            f"{decision(result)} | {budget(cell, results)}{no_better_than_random(result, results)} |"
        )
    return lines


def occupancy(result) -> str:
    if result is None:
        return "not yet"
    if "attempted" in result:
        memory = f", {result['peak_mib'] / 1024:.1f} GiB" if result.get("peak_mib") else ""
        return f"attempted: {result['attempted'].removesuffix('.')}{memory}"
    low, high = result["occupancy"]["ci95"]
    return f"{result['occupancy']['mean']:.4f} ({low:.4f} to {high:.4f})"


def episodes(result) -> str:
    if result is None or "occupancy" not in result:
        return ""
    return f"{result['episodes']}{'°' if result['episodes'] < figures.FEW else ''}"


def decision(result) -> str:
    latency = (result or {}).get("latency_ms")
    if not latency:
        return ""
    time = figures.milliseconds(result)
    older = "" if "cpu_mean" in latency else " (median)" if "cpu_p50" in latency else " (median, wall)"
    return (f"{time / 1e3:.1f} s" if time >= 1e3 else f"{time:.1f} ms") + older


def budget(cell, results) -> str:
    """What was spent on the policy that the cell evaluates."""
    if cell.training is None:
        given = next((o[11:] for o in cell.overrides if o.startswith("checkpoint=")), None)
        result = results.get(cell.name, {})
        trained = (result.get("trained") or {}).get("frames")
        words = [f"`{given}`" if given else "none", f"{trained:,} frames" if trained else ""]
        words += ["warm start"] if result.get("warm_start") else []
        return ", ".join(filter(None, words))
    trained = results.get(cell.training)
    if trained is None:
        return "not yet"
    if "attempted" in trained:
        return f"attempted, {trained['cpu_seconds'] / 60:.0f} min, {trained['peak_mib'] / 1024:.1f} GiB"
    words = [f"{trained['frames']:,} frames", f"{trained['cpu_seconds'] / 60:.0f} min"]
    if trained["frames"] < trained["frames_asked"]:
        words[0] += f" of {trained['frames_asked']:,}"
    if (trained["peak_mib"] or 0) > 4096:
        words.append(f"{trained['peak_mib'] / 1024:.1f} GiB")
    if trained["warm_start"]:
        words.append("warm start")
    return ", ".join(words)


def trained_with(cells, results) -> str:
    """A sentence for a figure: seeds, frames and time of every method that was trained for it."""
    methods = {}
    for cell in cells:
        trained = results.get(cell.training, {})
        if "frames" in trained:
            methods.setdefault(figures.label(cell.method), {})[cell.training] = trained
    words = []
    for method, trainings in methods.items():
        alike = {}
        for part in trainings.values():
            alike.setdefault(re.sub(r"\bseed=\d+", "", part["command"]), []).append(part)
        seeds = between(sorted(map(len, alike.values())))
        frames, minutes = (
            sorted({round(part[key] / unit) for part in trainings.values()})
            for key, unit in (("frames", 1), ("cpu_seconds", 60))
        )
        cost = f"{between(frames)} frames, {between(minutes)} minutes of one core"
        words.append(f"{method}, {seeds} seed{'s' * (seeds != '1')}, {cost}")
    return f"Trained: {'; '.join(words)}.\n" if words else ""


def between(values: list[int]) -> str:
    return f"{values[0]:,}" if values[0] == values[-1] else f"{values[0]:,} to {values[-1]:,}"


def no_better_than_random(result, results) -> str:
    """A remark where a learned policy is not surely above ``random`` on the same episodes."""
    if not result or "occupancy" not in result or not result.get("checkpoint"):
        return ""
    keys = [key for key in result["env"] if key != "num_envs"]

    def same(other):
        alike = other.get("planner") == "random" and other["items"] == result["items"] and "occupancy" in other
        return alike and all(other["env"][key] == result["env"][key] for key in keys)

    for other in filter(same, results.values()):
        pairs = zip(result["occupancy"]["per_episode"], other["occupancy"]["per_episode"], strict=False)
        gaps = torch.tensor([ours - theirs for ours, theirs in pairs], dtype=torch.float64)
        return "" if len(gaps) > 1 and confidence95(gaps, least=-1.0)[0] > 0 else ", **no better than random**"
    return ""


#: What stands behind a figure; what each episode gave, from which seeds are pooled, is in the cells' own JSON.
DRAWN = (
    "method", "axes", "command", "occupancy", "episodes", "latency_ms", "attempted",
    "occupancy_planned", "share_executed", "placements", "plans_executed_whole",
)  # fmt: skip
DRAWN_OF_TRAININGS = ("command", "frames", "cpu_seconds", "curve", "attempted")


def behind(cells, results) -> dict:
    """The numbers behind a figure: ``{"cells": {name: ...}, "trainings": {name: ...}}``, of what has been computed."""

    def some(name, keys):
        found = {key: results[name][key] for key in keys if key in results[name]}
        if "occupancy" in found:
            found["occupancy"] = {key: found["occupancy"][key] for key in ("mean", "ci95")}
        return found

    trainings = dict.fromkeys(cell.training for cell in cells if cell.training in results)
    return {
        "cells": {
            cell.name: {"training": cell.training, **some(cell.name, DRAWN)} for cell in cells if cell.name in results
        },
        "trainings": {name: some(name, DRAWN_OF_TRAININGS) for name in trainings},
    }


def main() -> None:
    _, parts = definitions.read()
    results = load()
    every = {cell.name for cells in parts.values() for cell in cells}
    every |= {cell.training for cells in parts.values() for cell in cells if cell.training}
    done = sum(name in results for name in every)
    text = [HEAD.format(few=figures.FEW, done=done, total=len(every), processors=processors(results))]
    text += ["## What the paper claims, and what we find\n", claims.HOW, *claims.table(results), ""]
    for name, (title, caption, draw) in figures.FIGURES.items():
        text.append(f"## {title}\n")
        numbers, picture = behind(parts[name], results), RESULTS / "figures" / name
        if name == "optimum":
            numbers["optimum"] = {f"{tote}-R{r}": value for (tote, r), value in figures.OPTIMA.items()}
        picture.parent.mkdir(parents=True, exist_ok=True)
        picture.with_suffix(".json").write_text(one_line_a_list(numbers))
        if draw(results, picture):
            text.append(f"![{title}](results/figures/{name}.png)\n")
            text.append(f"{caption} {trained_with(parts[name], results)}")
            text.append(f"[SVG](results/figures/{name}.svg), [JSON](results/figures/{name}.json);")
            text.append(f"what it consists of: `benchmarks/reproduce/{name}.yaml`.\n")
        else:
            for suffix in (".png", ".svg"):  # of results that are no longer there
                picture.with_suffix(suffix).unlink(missing_ok=True)
        if name == "placement_only":
            text += figures.placement_table(parts[name], results)
        else:
            text += [
                "<details><summary>Every cell</summary>\n",
                *table(parts[name], results),
                "\n</details>",
            ]
        text.append("")
    path = Path(RESULTS.parent / "results.md")
    path.write_text("\n".join(text))
    sys.stdout.write(f"{path.relative_to(ROOT)}: {done} of {len(every)} cells\n")


if __name__ == "__main__":
    main()
