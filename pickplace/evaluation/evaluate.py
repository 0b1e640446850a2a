"""Evaluation: one code path for every planner, on fixed item streams; and the ``pickplace-evaluate`` command."""

import hashlib
import json
import logging
import time
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict
from torch import Tensor
from torchrl.envs.utils import step_mdp

from pickplace.planners.base import BatchPlanner, plain_settings, planner_parts
from pickplace.planners.policy import PolicyPlanner
from pickplace.runs import checkpoint
from pickplace.runs.allowlist import own_modules, trusted_config
from pickplace.runs.hydra_app import apply_overrides, command
from pickplace.runs.machine import use_machine
from pickplace.runs.provenance import commit, imitated_planner, versions
from pickplace.runs.registry import build
from pickplace.task.cell import CELL_SETTINGS
from pickplace.task.feasibility import num_feasible, placing_maps
from pickplace.task.state import Failure
from pickplace.views.figures import evaluation_table
from pickplace.views.recording import Recording, record_moves
from pickplace.views.replay import animation, page, picture

log = logging.getLogger(__name__)


@dataclass
class Episodes:
    """What a planner achieved, one entry an episode."""

    occupancy: Tensor  # float64 [E]
    items_placed: Tensor  # int64 [E]
    failure: Tensor  # int64 [E], a Failure; NONE where a recorded stream ended
    feasible_share: float  # mean share of the N_a actions that were feasible, over all decisions
    final_heights: Tensor  # int32 [E, W_T, D_T]: the tote when the episode ended
    tote_height: Tensor  # int64 [E]
    decisions: int  # over all episodes
    seconds: float  # spent in the planner
    recordings: list[Recording] = field(default_factory=list)  # of the episodes that were to be recorded


def confidence95(values: Tensor, least: float = 0.0, most: float = 1.0) -> tuple[float, float]:
    """95% confidence interval of the mean, by Student's t, as far as such a value can be.

    Args:
        values: ``[E]``; fewer than two tell nothing, and give the whole range.
        least, most: the range of such a value.
    """
    if len(values) < 2:
        return least, most
    from scipy.stats import t  # takes a second to import, and only evaluation needs it

    mean, error = values.double().mean(), values.double().std() / len(values) ** 0.5
    margin = t.ppf(0.975, len(values) - 1) * error
    return max(float(mean - margin), least), min(float(mean + margin), most)


@torch.no_grad()
def play(
    make_env, planner, episodes: int, batch_size: int, record: Collection[int] = (), until: float | None = None
) -> Episodes:
    """Play episodes ``0 .. episodes - 1``, each in a slot of its own, all finished and all counted.

    Collecting "the first n episodes to finish" would favour short ones, and short ones are the bad ones.

    Args:
        make_env: ``make_env(first_episode, num_envs)`` builds the environment for a share of the episodes.
        planner: anything with ``decide``, see :mod:`pickplace.planners`.
        batch_size: episodes played side by side. It changes no result, but that of a planner that draws: which numbers
            an episode gets from the planner's one generator depends on the episodes beside it.
        record: numbers of the episodes to record move by move.
        until: CPU time of this process (``time.process_time()``) after which no further batch is begun; None: never.
    """
    feasible, decisions, seconds = 0.0, 0, 0.0
    parts: list[tuple[Tensor, ...]] = []
    recordings: list[Recording] = []
    for first in range(0, episodes, batch_size):
        if parts and until is not None and time.process_time() > until:
            break
        env = make_env(first, min(batch_size, episodes - first))
        cell, count = env.cell, env.num_envs
        observation = env.reset()
        running = torch.ones(count, dtype=torch.bool, device=env.device)
        occupancy = torch.zeros(count, dtype=torch.float64, device=env.device)
        placed_items = torch.zeros(count, dtype=torch.int64, device=env.device)
        failure = torch.zeros(count, dtype=torch.int64, device=env.device)
        final = env.heights.clone()
        totes = enumerate(env.tote_height.tolist())
        recorded = {slot: Recording(first + slot, height) for slot, height in totes if first + slot in record}
        while running.any():
            state = env.state._replace(heights=env.heights.clone())
            feasible += float((num_feasible(cell, placing_maps(cell, state)) / cell.num_actions)[running].sum())
            decisions += int(running.sum())
            start = time.perf_counter()
            action = planner.decide(observation)
            seconds += time.perf_counter() - start
            if rows := [slot for slot in recorded if running[slot]]:
                moves = record_moves(cell, planner, observation[rows], state.rows(rows), action[rows])
                for row, move in zip(rows, moves, strict=True):
                    recorded[row].moves.append(move)
            after = env.step(observation.set("action", action))["next"]
            done = after["done"][:, 0]
            ends = running & done
            reached = env.exact_occupancy
            occupancy = torch.where(ends, reached, occupancy)
            placed_items = torch.where(ends, env.steps, placed_items)
            failure = torch.where(ends, after["failure"][:, 0], failure)
            final = torch.where(ends[:, None, None], env.heights, final)
            for row in [slot for slot in recorded if ends[slot]]:
                recorded[row].ending, recorded[row].occupancy = Failure(int(failure[row])), float(reached[row])
                if recorded[row].ending == Failure.STUCK:
                    recorded[row].waiting = tuple(env.item[row].tolist())
            running = running & ~done
            observation = step_mdp(observation)
            if done.any() and running.any():  # a finished slot plays on, uncounted, until all have finished
                observation = env.reset(observation.set("_reset", after["done"]))
        parts.append((occupancy, placed_items, failure, final, env.tote_height))
        recordings += recorded.values()
    columns = [torch.cat(column).cpu() for column in zip(*parts, strict=True)]
    occupancy, placed_items, failure, final, tote_height = columns
    return Episodes(
        occupancy, placed_items, failure, feasible / decisions, final, tote_height, decisions, seconds, recordings
    )


@torch.no_grad()
def decision_latency(make_env, planner, decisions: int) -> dict[str, float] | None:
    """Milliseconds of a decision for one tote, in states of episodes: ``{"p50", "p95", "cpu_p50", "cpu_mean"}``.

    The last two are CPU time, of all threads together: what else the machine does hardly changes it. A search may think
    long about few states, so that its mean is far above its median.
    """
    if decisions < 1:
        return None
    env = make_env(0, 1)
    observation, times, cpu_times = env.reset(), [], []
    planner.decide(observation)  # warm up
    for _ in range(decisions):
        start, cpu_start = time.perf_counter(), time.process_time()
        action = planner.decide(observation)
        if action.device.type == "cuda":  # where a call returns before its work is done
            torch.cuda.synchronize(action.device)
        times.append((time.perf_counter() - start) * 1e3)
        cpu_times.append((time.process_time() - cpu_start) * 1e3)
        _, observation = env.step_and_maybe_reset(observation.set("action", action))
    wall, cpu = torch.tensor([times, cpu_times], dtype=torch.float64)
    quantiles = {"p50": wall.quantile(0.5), "p95": wall.quantile(0.95), "cpu_p50": cpu.quantile(0.5)}
    return {key: float(value) for key, value in {**quantiles, "cpu_mean": cpu.mean()}.items()}


def summarise(result: Episodes) -> dict:
    """The figures of ``evaluation.json`` that come from the episodes."""
    low, high = confidence95(result.occupancy)
    reasons = Counter(Failure(code).name.lower() for code in result.failure.tolist())
    return {
        "occupancy": {
            "mean": float(result.occupancy.mean()),
            "ci95": [low, high],
            "min": float(result.occupancy.min()),
            "per_episode": result.occupancy.tolist(),
        },
        "items_placed": float(result.items_placed.double().mean()),
        "failures": dict(sorted(reasons.items())),
        "feasible_action_share": result.feasible_share,
    }


def resolved(node: DictConfig) -> Any:
    """A part of a config as plain values."""
    return OmegaConf.to_container(node, resolve=True)


def plain(value: Any) -> Any:
    """What JSON writes for a tensor, a number of numpy's, or anything else that a planner of your own counts."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def episodes_of(cfg: DictConfig) -> dict:
    """What says which episodes an evaluation plays."""
    items = resolved(cfg["items"])
    path = items.get("path")
    if isinstance(path, str) and Path(path).is_file():  # recorded: what it held, not only where it was
        items["sha256"] = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    return {
        "env": resolved(cfg.env),
        "items": items,
        "stream": cfg.evaluation.stream,
        "episodes": cfg.evaluation.episodes,
        "seed": cfg.evaluation.seed,
    }


def evaluate(cfg: DictConfig, make_env, planner, facts: dict, record=(), until=None) -> tuple[dict, Episodes]:
    """Evaluate a planner as the config group ``evaluation`` says: what goes into ``evaluation.json``.

    Args:
        facts: more to put into it.
        record, until: as of :func:`play`.
    """
    ev = cfg.evaluation
    result = play(make_env, planner, ev.episodes, ev.batch_size, record, until)
    report = {
        "planner": planner.name,
        **facts,
        **episodes_of(cfg),
        "episodes": len(result.occupancy),
        **summarise(result),
        **(planner.statistics() if hasattr(planner, "statistics") else {}),
        "latency_ms": decision_latency(make_env, planner, ev.latency_decisions),
        "versions": versions(),
        "commit": commit(),
    }
    return report, result


def read_comparison(path: Path, expected: dict) -> dict:
    """Another ``evaluation.json`` of the same episodes, for :func:`paired_difference`.

    Args:
        path: the file.
        expected: ``stream``, ``seed``, ``episodes``, ``items`` and ``env`` of the evaluation at hand.

    Raises:
        ValueError: if the file cannot be read, or is about other episodes.
    """
    try:
        other = json.loads(path.read_text())
        torch.tensor(other["occupancy"]["per_episode"], dtype=torch.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"compare={str(path)!r}: expected an evaluation.json ({error}).") from error
    for key in ("stream", "seed", "episodes", "items"):
        ours, theirs = expected[key], other.get(key)
        if key == "items" and isinstance(theirs, dict):  # recorded: what was there, if both know it, or where it was
            unsaid = "path" if "sha256" in ours and "sha256" in theirs else "sha256"
            ours, theirs = ({k: v for k, v in items.items() if k != unsaid} for items in (ours, theirs))
        if ours != theirs:
            raise ValueError(f"compare={str(path)!r}: its {key} is {other.get(key)!r}, expected {expected[key]!r}.")
    for key in CELL_SETTINGS:
        if expected["env"][key] != other["env"].get(key):
            raise ValueError(
                f"compare={str(path)!r}: env.{key}={other['env'].get(key)}, expected {expected['env'][key]}."
            )
    return other


def paired_difference(result: dict, other: dict) -> dict:
    """Mean occupancy of a result minus that of another one, episode by episode, with its 95% interval.

    Both have met the same items: pairing removes what one stream is luckier than another.
    """
    ours, theirs = (torch.tensor(r["occupancy"]["per_episode"], dtype=torch.float64) for r in (result, other))
    difference = ours - theirs
    return {
        "against": other["planner"],
        "mean": float(difference.mean()),
        "ci95": list(confidence95(difference, least=-1.0)),
    }


def prepare(cfg: DictConfig) -> tuple:
    """What a config evaluates (``conf/evaluate.yaml``): ``make_env(first_episode, num_envs)``, the planner, and facts.

    The groups that a checkpoint brings are put into ``cfg``.

    Raises:
        ValueError: for settings that make no sense, or a checkpoint that does not fit them.
    """
    at_least = {"evaluation.episodes": 1, "evaluation.batch_size": 1, "evaluation.latency_decisions": 0}
    for key, least in at_least.items():
        value = OmegaConf.select(cfg, key)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise ValueError(f"{key}={value}: expected a whole number >= {least}.")
    if cfg.evaluation.stream not in ("validation", "test"):
        raise ValueError(f"evaluation.stream={cfg.evaluation.stream}: expected validation or test.")
    if "model" in cfg and cfg.checkpoint is None:
        raise ValueError("model: there are no settings of a model without checkpoint=<run folder>.")
    own_modules(cfg.trust)
    use_machine(cfg)
    facts: dict[str, Any] = {"planner_settings": plain_settings(cfg.planner), "checkpoint": None}
    trained = None
    if cfg.checkpoint is not None:
        folder = checkpoint.locate(str(cfg.checkpoint))
        state, saved = checkpoint.read(folder)
        theirs = trusted_config(saved["config"], cfg.trust)
        groups = {key: OmegaConf.create(resolved(cfg[key])) for key in ("env", "items")}
        ours = [o for o in HydraConfig.get().overrides.task if o.lstrip("+~").split("=")[0].split(".")[0] in TRAINED]
        merged = apply_overrides(theirs, ours, groups)
        with open_dict(cfg):
            for group in TRAINED:  # resolved where they come from: here a reference could lead elsewhere
                cfg[group] = resolved(merged[group])
        trained = (cfg, state, resolved(theirs.env))
        facts |= {
            "checkpoint": str(folder),
            "trained": {"frames": saved["frames"], "seed": merged.seed, "commit": saved["commit"]},
            "mask_in_training": merged.algo.mask_infeasible,
            "warm_start": imitated_planner(resolved(theirs)),
        }

    ev, items = cfg.evaluation, build("items", cfg["items"])
    if not items.varies:
        facts["same_items"] = True
        if ev.episodes > 1:
            log.warning("All episodes are of the same items, in the same places: an interval tells of no others.")

    def make_env(first, count):
        return build(
            "env", cfg.env, items=items, device=cfg.device, num_envs=count, masks=(),
            stream=ev.stream, seed=ev.seed, first_episode=first,
        )  # fmt: skip

    probe = make_env(0, 1)
    parts = planner_parts(cfg.planner, probe.cell, items, probe.terms, trained)
    planner = build("planner", cfg.planner, **parts)
    if not isinstance(planner, BatchPlanner) or not isinstance(planner.name, str):  # now, not after all episodes
        raise ValueError(f"planner: {type(planner).__name__} has no name; expected an attribute name, a string.")
    if isinstance(planner, PolicyPlanner):
        masked = planner.candidates == "all" or planner.policy.excludes or False
        facts |= {"candidates": planner.candidates, "mask_at_decision": masked}
    elif "policy" in parts:
        facts |= {"candidates": "all", "mask_at_decision": True}
    return make_env, planner, facts


def run(cfg: DictConfig, run_dir: Path) -> float:
    """Evaluate as the config says (``conf/evaluate.yaml``); returns the mean occupancy.

    Writes ``evaluation.json``, a table, a picture of a packed tote and a replay into ``run_dir``.

    Raises:
        ValueError: for settings that make no sense, or a checkpoint that does not fit them.
    """
    ev = cfg.evaluation
    replay, gif = ev.get("replay", 0), ev.get("gif", False)  # evaluation=validation has neither
    if not isinstance(replay, int) or isinstance(replay, bool) or replay < 0:
        raise ValueError(f"evaluation.replay={replay}: expected a whole number >= 0.")
    if not isinstance(gif, bool):
        raise ValueError(f"evaluation.gif={gif}: expected true or false.")
    make_env, planner, facts = prepare(cfg)
    cell = make_env(0, 1).cell
    other = None if cfg.compare is None else read_comparison(Path(str(cfg.compare)), episodes_of(cfg))
    result, episodes = evaluate(cfg, make_env, planner, facts, record=range(max(replay, 1)))
    if other:
        result["paired_difference"] = paired_difference(result, other)
    (run_dir / "evaluation.json").write_text(json.dumps(result, indent=1, default=plain))
    picture(episodes.recordings[0], cell, run_dir / "tote.png")
    if replay:
        title = f"{cfg.checkpoint or planner.name}, {ev.stream} stream, seed {ev.seed}"
        (run_dir / "replay.html").write_text(page(episodes.recordings, cell, title), encoding="utf-8")
    if gif:
        animation(episodes.recordings[0], cell, run_dir / "replay.gif")
    table = evaluation_table(result)
    (run_dir / "evaluation.md").write_text(table)
    log.info("\n%s", table)
    log.info("run folder: %s", run_dir)
    return result["occupancy"]["mean"]


#: Config groups that an evaluation takes from the checkpoint.
TRAINED = ("env", "items", "model", "algo")


def main() -> None:
    """Entry point of ``pickplace-evaluate``."""
    command("evaluate", run, from_checkpoint=("model", "items"))


if __name__ == "__main__":
    main()
