"""Files that an evaluation writes: its result, a table, pictures, the replay page and the plans."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pickplace.common.errors import sentence
from pickplace.common.files import replaced_file
from pickplace.common.validate import flag, reword_errors, whole_number
from pickplace.physics.plans import PLANS, EpisodePlan, to_lines
from pickplace.rules.cell import POSES, CellSpec
from pickplace.runs.folder import EVALUATION
from pickplace.views.recording import Recording
from pickplace.views.replay import animation, page, picture


class Artifacts:
    """Files to write beside the result, as the config group ``evaluation`` asks for; a key that it lacks is off.

    Attributes:
        replay: number of episodes on the replay page; 0: no page.
        gif: whether to write an animation of the first episode.
        plans: whether to write the plans of all episodes.

    Raises:
        ValueError: naming the key, its value, and what was expected.
    """

    def __init__(self, evaluation: Mapping):
        self.gif, self.plans = (flag(f"evaluation.{key}", evaluation.get(key, False)) for key in ("gif", "plans"))
        self.replay = whole_number("evaluation.replay", evaluation.get("replay", 0), 0, 1_000)

    def write(
        self, run_dir: Path, result: dict, cell: CellSpec, recordings: list[Recording], plans: list[EpisodePlan],
        title: str,
    ) -> None:  # fmt: skip
        """Write the result, its table, a picture of the first tote, and the requested files.

        Args:
            run_dir: the folder.
            result: the content of ``evaluation.json``.
            cell: the sizes.
            recordings: of at least one episode, and of all episodes of the replay.
            plans: of all episodes.
            title: of the replay page.

        Raises:
            ValueError: if a file cannot be written.
        """
        texts = {EVALUATION: json.dumps(result, indent=1, default=to_json), "evaluation.md": evaluation_table(result)}
        if self.replay:
            title += f", carried out by {result['physics']['method']}" if "physics" in result else ""
            texts["replay.html"] = page(recordings[: self.replay], cell, title)
        if self.plans:
            texts[PLANS] = to_lines(plans)
        with reword_errors(
            OSError,
            lambda error: ValueError(f"{sentence(error)} The table above and the files that are there are whole."),
        ):
            for name, text in texts.items():
                with replaced_file(run_dir / name) as new:
                    new.write_text(text, encoding="utf-8")
            picture(recordings[0], cell, run_dir / "tote.png")
            if self.gif:
                with replaced_file(run_dir / "replay.gif") as new:
                    animation(recordings[0], cell, new)


def to_json(value: Any) -> Any:
    """Return a tensor or a number of numpy's as plain values for JSON; anything else as text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def evaluation_table(result: dict) -> str:
    """Return the figures of an ``evaluation.json`` as a Markdown table."""
    env, physics, paired, latency = result["env"], *map(result.get, ("physics", "paired_difference", "latency_ms"))
    count = env.get("bin_items", 1) // (POSES if env.get("tipping") else 1)
    occupancy, trained = result["occupancy"], result.get("trained", {})
    same = ", all of the same items" if result.get("same_items") else ""
    words = {True: "yes", False: "no", None: "unknown"}
    masks = (result.get(key) for key in ("mask_in_training", "mask_at_decision"))
    training, decision = (words.get(mask, mask) for mask in masks)
    given = result.get("planner_settings", {}).items()
    settings = [f"{key}={'null' if value is None else value}" for key, value in given]
    rows: dict[str, Any] = {
        "planner": " ".join([result["planner"], *settings]),
        "tote, rotations": f"{'x'.join(map(str, env['tote_size']))}, R={env['rotations']}",
        "orientations": env.get("tipping") and f"{POSES * min(env['rotations'], 2)}: items may be tipped",
        "items in the bin": count > 1 and f"up to {count}, refill: {env.get('refill', 'each')}",
        "items in the preview": str(env.get("preview") or ""),
        "episodes": f"{result['episodes']} of the {result['stream']} stream, seed {result['seed']}{same}",
        "occupancy": f"{_interval(occupancy, '.4f')}, least {occupancy['min']:.4f}",
        "occupancy of true volumes": (true := result.get("true_occupancy", occupancy))["mean"] != occupancy["mean"]
        and _interval(true, ".4f"),
        "items placed": f"{result['items_placed']:.1f} an episode",
        "share of an episode's items": "share_placed" in result and _interval(result["share_placed"], ".4f"),
        "episodes ended by": ", ".join(
            f"{'no more items' if name == 'none' else name} {count}" for name, count in result["failures"].items()
        ),
        "feasible actions": f"{result['feasible_action_share']:.2%} of all, mean over decisions",
        f"physics, {physics and physics['method']}": physics
        and _interval(physics["carried_out"], ".1%", " of the episodes to their end"),
        "occupancy carried out": physics and _interval(physics["occupancy"], ".4f"),
        f"minus {paired and paired['against']}": paired and _interval(paired, "+.4f", of=" of the paired difference"),
        "one decision": latency and f"{latency['p50']:.1f} ms (median), {latency['p95']:.1f} ms (95th percentile)",
        "checkpoint": result.get("checkpoint")
        and f"{result['checkpoint']} ({trained['frames']:,} frames, seed {trained['seed']})",
        "warm start": result.get("warm_start") and f"imitated {result['warm_start']}",
        "began with weights": result.get("first_weights"),
        "mask; candidates K": "candidates" in result
        and f"in training {training}, at decision {decision}; {result['candidates']}",
    }
    # Names may have characters that end the cell or begin a tag.
    cells = [[re.sub(r"([|<])", r"\\\1", text) for text in row] for row in rows.items() if row[1]]
    name, value = (max(map(len, column)) for column in zip(*cells, strict=True))
    head, *lines = [f"| {row[0]:<{name}} | {row[1]:<{value}} |" for row in cells]
    return "\n".join([head, f"|{'-' * (name + 2)}|{'-' * (value + 2)}|", *lines]) + "\n"


def _interval(entry: dict, form: str, after: str = "", of: str = "") -> str:
    """Return a mean and its interval, in a format, with words after the mean and after the interval's name."""
    low, high = entry["ci95"]
    return f"{entry['mean']:{form}}{after} (95% interval{of} {low:{form}} to {high:{form}})"
