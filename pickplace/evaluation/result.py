"""The result of an evaluation (``evaluation.json``): figures, intervals, and the comparison with another result."""

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from pickplace.common.files import read_file
from pickplace.common.validate import excerpt, is_name, is_number, refuse_if, reword_errors
from pickplace.config.allowlist import refuse_foreign_targets
from pickplace.config.registry import build, node_of, with_defaults
from pickplace.evaluation.play import Episodes
from pickplace.physics.engine import Engine
from pickplace.planners.base import BatchPlanner
from pickplace.policies.restore import build_cell, cell_settings, differences
from pickplace.rules.state import Failure
from pickplace.rules.support.rules import read_support
from pickplace.runs.provenance import commit, versions
from pickplace.views.motion import Outcome

MAX_EVALUATION = 2**26  # greatest size of an evaluation.json that is read, in bytes


def confidence95(values: Tensor, least: float = 0.0, most: float = 1.0) -> tuple[float, float]:
    """Return the 95% confidence interval of the mean, by Student's t, cut to the range of the values.

    Args:
        values: ``[E]``; with fewer than two the interval is the whole range.
        least, most: the range of a value.
    """
    if len(values) < 2:
        return least, most
    from scipy.stats import t  # takes a second to import, and only evaluation needs it

    mean, error = values.double().mean(), values.double().std() / len(values) ** 0.5
    margin = t.ppf(0.975, len(values) - 1) * error
    return max(float(mean - margin), least), min(float(mean + margin), most)


def describe(planner: BatchPlanner, facts: dict, episodes: Episodes) -> dict:
    """Return the content of ``evaluation.json``, except the times of decisions.

    Args:
        planner: the planner; it may add ``statistics``.
        facts: about the planner and its checkpoint, and :func:`episode_settings`.
        episodes: the results.
    """
    occupancy, true, count = episodes.occupancy, episodes.true_occupancy, episodes.num_items
    placed = _share(episodes.items_placed.double() / count) if (count > 0).all() else None
    reasons = Counter(Failure(code).name.lower() for code in episodes.failure.tolist())
    return {
        "planner": planner.name,
        **facts,
        "occupancy": {
            "mean": float(occupancy.mean()),
            "ci95": list(confidence95(occupancy)),
            "min": float(occupancy.min()),
            "per_episode": occupancy.tolist(),
        },
        "true_occupancy": _share(true),
        **({} if placed is None else {"share_placed": placed}),
        "items_placed": float(episodes.items_placed.double().mean()),
        "failures": dict(sorted(reasons.items())),
        "feasible_action_share": episodes.feasible_share,
        **(planner.statistics() if hasattr(planner, "statistics") else {}),
        "versions": versions(),
        "commit": commit(),
    }


def _share(values: Tensor) -> dict:
    """Return the mean of shares, one an episode, with its interval."""
    return {"mean": float(values.double().mean()), "ci95": list(confidence95(values))}


def summarise_physics(engine: Engine, settings: dict, outcomes: Sequence[Outcome]) -> dict:
    """Return the figures of ``evaluation.json`` that come from carrying out the episodes in a physics engine.

    Args:
        engine: the physics engine.
        settings: its config.
        outcomes: one an episode.
    """
    occupancy = torch.tensor([outcome.occupancy for outcome in outcomes], dtype=torch.float64)
    done = torch.tensor([outcome.ending == "done" for outcome in outcomes])
    return {
        "method": engine.name,
        "settings": {key: value for key, value in settings.items() if key != "_target_"},
        "carried_out": {"mean": float(done.double().mean()), "ci95": list(proportion95(int(done.sum()), len(done)))},
        "occupancy": {
            "mean": float(occupancy.mean()),
            "ci95": list(confidence95(occupancy)),
            "per_episode": occupancy.tolist(),
        },
        "endings": dict(sorted(Counter(outcome.ending for outcome in outcomes).items())),
        "drift": max(outcome.drift for outcome in outcomes),
        "cpu_seconds": sum(outcome.cpu_seconds for outcome in outcomes) / len(outcomes),
        "episodes": [outcome.facts() for outcome in outcomes],
    }


def proportion95(successes: int, count: int) -> tuple[float, float]:
    """Return the 95% confidence interval of a share, by Clopper and Pearson. Its width is not 0 for shares 0 and 1."""
    from scipy.stats import beta

    low = beta.ppf(0.025, successes, count - successes + 1) if successes else 0.0
    high = beta.ppf(0.975, successes + 1, count - successes) if successes < count else 1.0
    return float(low), float(high)


def paired_difference(result: dict, other: dict) -> dict:
    """Return the mean occupancy of a result minus that of another one, episode by episode, with its 95% interval.

    Both have the same items, so the difference does not depend on how hard the items are.

    Args:
        result, other: the contents of two ``evaluation.json``.
    """
    ours, theirs = (torch.tensor(r["occupancy"]["per_episode"], dtype=torch.float64) for r in (result, other))
    interval = confidence95(ours - theirs, least=-1.0)
    return {"against": other["planner"], "mean": float((ours - theirs).mean()), "ci95": list(interval)}


def episode_settings(cfg: DictConfig) -> dict:
    """Return the settings that determine the episodes of an evaluation."""
    env = {key: with_hash(value) for key, value in resolved(cfg.env).items()}
    env["support"] = node_of("env.support", read_support(build("env.support", env["support"])))  # a short form in full
    return {
        "env": env,
        "items": with_hash(resolved(cfg["items"])),
        "stream": cfg.evaluation.stream,
        "episodes": cfg.evaluation.episodes,
        "seed": cfg.evaluation.seed,
    }


def with_hash(node: Any) -> Any:
    """Return a part of a config with the hash of its file, if it has one: the content counts, not its place."""
    path = node.get("path") if isinstance(node, dict) else None
    if isinstance(path, str) and Path(path).is_file():
        return {**node, "sha256": hashlib.sha256(read_file(path)).hexdigest()}
    return node


def is_same(ours: Any, theirs: Any) -> bool:
    """Return whether two parts of configs agree. Files are compared by hash if both have one, else by path."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        ignored = "path" if "sha256" in ours and "sha256" in theirs else "sha256"
        ours, theirs = ({key: node[key] for key in node if key != ignored} for node in (ours, theirs))
    return ours == theirs


def read_comparison(path: Path, expected: dict, trust: Collection[str] = ()) -> dict:
    """Return another ``evaluation.json`` of the same episodes, for :func:`paired_difference`.

    Args:
        path: the file.
        expected: :func:`episode_settings` of the evaluation at hand.
        trust: modules whose classes its ``env`` may name.

    Raises:
        ValueError: for a file that cannot be read, or that is about other episodes.
    """
    refused = f"compare={excerpt(str(path))}: expected an evaluation.json"
    with reword_errors(
        (OSError, ValueError, KeyError, TypeError, RecursionError), lambda error: ValueError(f"{refused} ({error}).")
    ):
        other = json.loads(read_file(path, MAX_EVALUATION, empty=False))
        env, values, name = dict(other["env"]), other["occupancy"]["per_episode"], other.get("planner")
    items = other.get("items")
    if isinstance(items, dict) and items.get("_target_") == expected["items"]["_target_"]:
        expected, other = ({**each, "items": with_defaults("items", each["items"])} for each in (expected, other))
    for key in ("stream", "seed", "episodes", "items"):
        refuse_if(
            not is_same(ours := expected[key], theirs := other.get(key)),
            f"compare={excerpt(str(path))}: its {key} is {excerpt(theirs)}, expected {excerpt(ours)}.",
        )
    cell = build_cell(expected["env"], reach=None)
    with reword_errors(ValueError, lambda error: ValueError(f"{refused} ({error})")):
        refuse_foreign_targets(env, trust, "env")
        other_cell = build_cell(env, reach=None)  # what is missing has its default
    reaches = ("env.reach", expected["env"].get("reach"), env.get("reach"))
    matters = {"env.refill": cell.bin_items > 1, "env.preview": False}  # whether a difference changes the items
    for key, ours, theirs in (*differences(cell_settings(cell), cell_settings(other_cell), "env"), reaches):
        refuse_if(
            not is_same(ours, theirs) and matters.get(key, True),
            f"compare={excerpt(str(path))}: {key}={excerpt(theirs)}, expected {ours}.",
        )
    count = expected["episodes"]
    refuse_if(
        not isinstance(values, list) or len(values) != count or not all(is_number(v) and 0 <= v <= 1 for v in values),
        f"{refused} whose occupancy.per_episode is a list of {count} numbers between 0 and 1.",
    )
    refuse_if(not is_name(name), f"{refused} whose planner is a name to print, got {excerpt(name)}.")
    return other


def resolved(node: DictConfig) -> Any:
    """Return a part of a config as plain values."""
    return OmegaConf.to_container(node, resolve=True)
